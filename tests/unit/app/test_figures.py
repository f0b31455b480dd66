"""The figures: the right things at the right places, nothing overlapping, for few and for many facets."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from output_samples import FACT_DATA, alignment_of, facet_alignment, fact_response_table, honeycomb, random_alignment

from namod_ctl.app.pictures.figure_style import ellipse_axes, figure_to_png
from namod_ctl.app.pictures.figures import PsfPanel, draw_exposure_map, draw_psf_sum
from namod_ctl.app.pictures.psf_maps import draw_psf_maps
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import deg_to_rad
from namod_ctl.reconstruction.alignment import AreaOfPsf, BadRecord
from namod_ctl.reconstruction.histograms import histogram_responses
from namod_ctl.reconstruction.responses import ResponseTable

needs_fact = pytest.mark.skipif(not FACT_DATA.is_dir(), reason="the FACT records of 2014 are not beside the project")


def overlapping_texts(figure):
    """Pairs of texts of the figure that cover each other."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    texts = [text for axes in figure.axes for text in axes.texts] + figure.texts
    for axes in figure.axes:
        texts += [axes.xaxis.label, axes.yaxis.label, axes.title]
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            ticks = [tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
            texts += [label for tick in ticks for label in (tick.label1, tick.label2)]
    for legend in figure.legends:
        texts += legend.get_texts()
    visible = [text for text in texts if text.get_text() and text.get_visible()]
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in visible]
    frame = figure.bbox.padded(1.0)
    for text, box in zip(visible, boxes, strict=True):
        assert frame.x0 <= box.x0 and box.x1 <= frame.x1, f"{text.get_text()!r} leaves the figure"  # noqa: PT018
        assert frame.y0 <= box.y0 and box.y1 <= frame.y1, f"{text.get_text()!r} leaves the figure"  # noqa: PT018
    return [
        (visible[i].get_text(), visible[j].get_text())
        for i in range(len(boxes))
        for j in range(i)
        if boxes[i].padded(-1.0).overlaps(boxes[j].padded(-1.0))
    ]


def simulated(n_facets, n_records):
    reflector = honeycomb(n_facets, 1.0, 28.0)
    alignment = random_alignment(reflector)
    rng = np.random.default_rng(3)
    theta = deg_to_rad(rng.normal(0.0, 0.13, (n_records, 2)))
    response = rng.random((n_records, n_facets))
    table = ResponseTable(
        reflector.ids, np.arange(n_records), theta, np.full(n_records, np.nan), response, np.ones(n_records)
    )
    return table, alignment


@needs_fact
def test_fact_maps_name_every_facet_and_why_it_is_not_turned():
    table = fact_response_table()
    flags = {12: FacetFlag.UNRELIABLE, 6: FacetFlag.PSF_CUT_BY_SCAN_EDGE}
    alignment = alignment_of([facet_alignment(i, flags=flags.get(i, FacetFlag.NONE)) for i in table.facet_ids])
    figure = draw_psf_maps(histogram_responses(table, deg_to_rad(0.01)), table, alignment)
    names = [text.get_text() for text in figure.axes[0].texts]
    assert len(names) == 29
    assert "12: unreliable" in names
    assert "6: cut by edge" in names
    assert overlapping_texts(figure) == []


@pytest.mark.parametrize("n_facets", [1, 4, 198])
def test_maps_of_other_telescopes(n_facets):
    table, alignment = simulated(n_facets, 400)
    figure = draw_psf_maps(histogram_responses(table, deg_to_rad(0.02)), table, alignment)
    assert len(figure.axes[0].texts) == n_facets
    if n_facets < 100:
        assert overlapping_texts(figure) == []
    image = cv2.imdecode(np.frombuffer(figure_to_png(figure), np.uint8), cv2.IMREAD_COLOR)
    assert max(image.shape) < 6000


def test_the_bright_spot_of_a_map_is_where_the_star_was():
    theta = deg_to_rad(np.stack(np.meshgrid(np.arange(-9, 10), np.arange(-9, 10)), -1).reshape(-1, 2) * 0.02)
    target = deg_to_rad(np.array([0.1, -0.06]))
    response = np.where(np.linalg.norm(theta - target, axis=1) < deg_to_rad(0.03), 1.0, 0.05)[:, None]
    table = ResponseTable(
        (7,), np.arange(len(theta)), theta, np.full(len(theta), np.nan), response, np.ones(len(theta))
    )
    alignment = alignment_of([facet_alignment(7, (0.1, -0.06))])
    figure = draw_psf_maps(histogram_responses(table, deg_to_rad(0.02)), table, alignment)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    axes = figure.axes[0]
    shift = axes.collections[-1].get_offsets()[0] - np.array([0.1, -0.06])
    pixels = np.asarray(canvas.buffer_rgba())[..., :3].astype(float)
    x, y = axes.transData.transform(np.array([0.12, -0.06]) + shift)  # the record beside the mark, in the spot
    colour = pixels[round(pixels.shape[0] - y), round(x)]
    assert colour[0] > 200  # viridis ends in yellow
    assert colour[2] < 100


def test_exposure_map_marks_the_records_left_out():
    table, _ = simulated(4, 300)
    bad = tuple(BadRecord(index, "wrong_star", "") for index in (3, 17, 290))
    alignment = alignment_of([facet_alignment(i) for i in table.facet_ids], bad_records=bad)
    figure = draw_exposure_map(histogram_responses(table, deg_to_rad(0.02)), table, alignment)
    assert {text.get_text() for text in figure.axes[0].texts} == {"3", "17", "290"}
    marks = figure.axes[0].lines[1]
    np.testing.assert_allclose(marks.get_xydata(), np.rad2deg(table.theta_rad[[3, 17, 290]]), atol=1e-9)
    assert overlapping_texts(figure) == []


def test_many_bad_records_do_not_write_over_each_other():
    table, _ = simulated(4, 300)
    bad = tuple(BadRecord(index, "stray_light", "") for index in range(120))
    alignment = alignment_of([facet_alignment(i) for i in table.facet_ids], bad_records=bad)
    figure = draw_exposure_map(histogram_responses(table, deg_to_rad(0.02)), table, alignment)
    assert overlapping_texts(figure) == []


def panel(title, sigma_deg):
    x = deg_to_rad(np.arange(-0.3, 0.301, 0.01))
    cov = np.diag(deg_to_rad(np.array(sigma_deg)) ** 2)
    light = np.exp(-0.5 * (x[None, :] ** 2 / cov[0, 0] + x[:, None] ** 2 / cov[1, 1]))
    return PsfPanel(title, x, x, light, np.zeros(2), cov, AreaOfPsf(np.pi * np.sqrt(np.linalg.det(cov)), 1e-8))


def test_summed_light_and_prediction_share_one_scale():
    figure = draw_psf_sum([panel("now", (0.08, 0.07)), panel("after", (0.03, 0.02))], "FACT", AreaOfPsf(4.82e-7, 0.0))
    now, after = figure.axes[:2]
    assert now.get_xlim() == after.get_xlim()
    assert now.collections[0].norm is after.collections[0].norm
    # the ellipse's area is A_sigma: pi * 4.8' * 4.2' = 63.3 arcmin^2
    ellipse = now.patches[0]
    assert np.pi / 4 * ellipse.width * ellipse.height == pytest.approx(np.pi * 4.8 * 4.2, rel=1e-9)
    assert "63.3 ± 0.1 arcmin²" in now.get_title()
    assert any("5.7 arcmin²" in text.get_text() for text in figure.texts)
    assert overlapping_texts(figure) == []


def test_ellipse_of_a_covariance():
    turned = np.deg2rad(30)
    rotation = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    major, minor, angle = ellipse_axes(rotation @ np.diag([9.0, 4.0]) @ rotation.T)
    assert (major, minor) == pytest.approx((6.0, 4.0))
    assert angle % 180 == pytest.approx(30)
    assert np.isnan(ellipse_axes(np.full((2, 2), np.nan))).all()
