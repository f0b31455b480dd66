"""The star finder beside sep (SExtractor's code): the same stars, at least as well centred."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "unit" / "imaging"))

from frames import SIGMA_PX, exposed, gaussian_light, moffat_light
from imaging_instruments import STAR_CAMERA, STAR_SIZE_RAD

from namod_ctl.imaging.star import Star, star_finder

sep = pytest.importorskip("sep", reason="sep is not installed (extra 'peers')")

SHAPE = (300, 340)
N_STARS = 120


def centre_by_sep(frame):
    """SExtractor's best: windowed position, with the window its manual recommends (2 / 2.3548 of half-light radius)."""
    data = frame.astype(np.float32)
    background = sep.Background(data)
    data -= background.back()
    found = sep.extract(data, 5.0, err=background.globalrms)
    star = found[int(np.argmax(found["flux"]))]
    radius, _ = sep.flux_radius(data, [star["x"]], [star["y"]], [6.0 * star["a"]], 0.5)
    x, y, _ = sep.winpos(data, [star["x"]], [star["y"]], 2.0 / 2.3548 * radius)
    return np.array([x[0], y[0]])


@pytest.mark.parametrize(
    ("make_light", "camera"),
    [
        (lambda x, y: 200.0 * gaussian_light(SHAPE, x, y, SIGMA_PX), {}),
        (lambda x, y: 20.0 * gaussian_light(SHAPE, x, y, SIGMA_PX), {}),
        (lambda x, y: 200.0 * gaussian_light(SHAPE, x, y, SIGMA_PX), {"electrons_per_adu": 4.0}),
        (lambda x, y: 200.0 * gaussian_light(SHAPE, x, y, 1.5), {}),
        (lambda x, y: 200.0 * moffat_light(SHAPE, x, y, 10.0), {}),
    ],
    ids=["bright", "faint", "few electrons", "sharp", "wings"],
)
def test_centres_are_no_worse_than_windowed_positions(make_light, camera):
    rng = np.random.default_rng(40)
    finder = star_finder(STAR_CAMERA, STAR_SIZE_RAD, np.dtype(np.uint8))
    ours, peer = [], []
    for _ in range(N_STARS):
        true = rng.uniform(90, 200, 2)
        frame = exposed(make_light(*true), rng, **camera)
        star = finder.find(frame)
        assert isinstance(star, Star)
        ours.append(np.array([star.x_px, star.y_px]) - true)
        peer.append(centre_by_sep(frame) - true)
    rms_ours, rms_peer = (float(np.sqrt(np.mean(np.square(errors)))) for errors in (ours, peer))
    # Both see the same noise; 240 errors each leave 5 % of room for what they make of it.
    assert rms_ours < 1.05 * rms_peer
