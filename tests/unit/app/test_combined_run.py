"""`namod-ctl reconstruct RUN1 RUN2 --out BOTH`: runs on different stars and cameras as one, and what is refused."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin import build_twin, with_facet_map
from namod_ctl.app.build.twin_note import note_twin
from namod_ctl.app.cli import main
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.records import Record
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.cycle.record import Equipment, Recorder, RecordSettings, StopRule
from namod_ctl.store.run import RunStore
from namod_ctl.twin.settings import PERFECT, SkySettings, TwinSettings

FACET_IDS = (2, 3, 4, 5, 12, 13, 15, 16)  # of FACT's 30
N_RECORDS = 400
WIDTH_RAD = arcmin_to_rad(1.5)
Call = Callable[..., tuple[int, str, str]]


class FixedClock:
    """A day in the year 2026."""

    def __init__(self, day: int) -> None:
        self._day = day

    def now(self) -> datetime:
        return datetime(2026, 5, self._day, 22, tzinfo=UTC)


@pytest.fixture
def namod_ctl(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """The program, called as from the command line: exit code, output and errors."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["namod-ctl", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        return (int(caught.value.code or 0), *capsys.readouterr())

    return call


def made_records(factor: float = 1.0) -> list[Record]:
    """Gaussian facets; the second half has a fainter star, another scene, and responses larger by `factor`."""
    rng = np.random.default_rng(5)
    radius, angle = deg_to_rad(0.2) * np.sqrt(rng.random(N_RECORDS)), 2 * np.pi * rng.random(N_RECORDS)
    theta = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    centres = rng.normal(0, arcmin_to_rad(3.0), (len(FACET_IDS), 2))
    distance = np.linalg.norm(theta[:, None] - centres, axis=2)
    response = np.exp(-0.5 * (distance / WIDTH_RAD) ** 2) * rng.lognormal(0, 0.05, distance.shape)
    response += 1e-3 * np.abs(rng.normal(1, 0.3, distance.shape))
    star = rng.uniform(0.9, 1.1, N_RECORDS)
    star[N_RECORDS // 2 :] /= 10.0
    response[N_RECORDS // 2 :] *= factor
    unknown = np.full(len(FACET_IDS), math.nan)
    return [
        Record(i, f"stamp{i}", theta[i], math.nan, star[i], star[i] * response[i], unknown, math.nan, math.nan)
        for i in range(N_RECORDS)
    ]


def store_run(
    folder: Path,
    records: list[Record],
    day: int = 1,
    config: InstrumentConfig | None = None,
    ids: Sequence[int] = FACET_IDS,
) -> Path:
    text = (config or load_config("fact")).to_json()
    with RunStore.create(folder, ids, text, "test", FixedClock(day)) as store:
        store.append(replace(record, index=i) for i, record in enumerate(records))
    return folder


@pytest.fixture
def halves(tmp_path: Path) -> tuple[Path, Path]:
    """Two nights of one telescope, the second on a fainter star."""
    records = made_records()
    return (
        store_run(tmp_path / "BRIGHT", records[: N_RECORDS // 2], 1),
        store_run(tmp_path / "FAINT", records[N_RECORDS // 2 :], 2),
    )


def facets_of(run: Path) -> dict[int, dict[str, float]]:
    return {facet["id"]: facet for facet in json.loads((run / "alignment.json").read_text())["facets"]}


def thetas_rad(run: Path) -> np.ndarray:
    return deg_to_rad(np.array([[f["theta_x_deg"], f["theta_y_deg"]] for f in facets_of(run).values()]))


def test_two_runs_on_different_stars_equal_one_run(halves: tuple[Path, Path], tmp_path: Path, namod_ctl: Call) -> None:
    whole = store_run(tmp_path / "WHOLE", made_records())
    assert namod_ctl("reconstruct", whole)[0] == 0
    before = [(run / "run.sqlite").read_bytes() for run in halves]
    # in whatever order they are named: the run made first comes first
    code, output, errors = namod_ctl("reconstruct", halves[1], halves[0], "--out", tmp_path / "BOTH")
    assert code == 0, errors
    assert facets_of(tmp_path / "BOTH") == facets_of(whole)
    assert "no significant difference" in output
    with RunStore.open(tmp_path / "BOTH") as store:
        assert store.source == "combined from BRIGHT, FAINT"
        assert store.labels()[200] == (200, "FAINT/0 stamp200")
    assert [(run / "run.sqlite").read_bytes() for run in halves] == before, "the runs stay as they are"
    assert not (halves[0] / "alignment.json").exists()
    assert namod_ctl("instruct", tmp_path / "BOTH")[0] == 0
    assert namod_ctl("reconstruct", tmp_path / "BOTH", "--estimator", "cog")[0] == 0


def test_another_scale_of_one_run_is_found_and_moves_nothing(tmp_path: Path, namod_ctl: Call) -> None:
    whole = store_run(tmp_path / "WHOLE", made_records())
    assert namod_ctl("reconstruct", whole)[0] == 0
    records = made_records(1.3)
    config = load_config("fact").model_dump(exclude_none=True)
    config["reflector_camera"]["radiometric_law"]["r_const"] += math.log10(1.3)
    other_camera = InstrumentConfig.model_validate(config)
    first = store_run(tmp_path / "FIRST", records[: N_RECORDS // 2], 1)
    second = store_run(tmp_path / "SECOND", records[N_RECORDS // 2 :], 2, other_camera)
    code, output, errors = namod_ctl("reconstruct", first, second, "--out", tmp_path / "BOTH")
    assert code == 0, errors
    line = next(line for line in output.splitlines() if line.strip().startswith("SECOND: "))
    factor, uncertainty = (float(line.split()[line.split().index("+-") + step]) for step in (-1, 1))
    assert abs(factor - 1.3) < 3.0 * uncertainty < 0.1
    assert "divided by that" in line
    # a tenth of the centres' own uncertainty of some 0.1 arcmin
    np.testing.assert_allclose(thetas_rad(tmp_path / "BOTH"), thetas_rad(whole), atol=arcmin_to_rad(0.02))
    with RunStore.open(tmp_path / "BOTH") as store:
        assert store.config_json == other_camera.to_json(), "the config of the newest run"
        ratio = store.records()[300].facet_intensity / records[300].facet_intensity
    np.testing.assert_allclose(ratio, 1.0 / factor, rtol=1e-3)


def test_a_bad_record_is_named_by_its_run(tmp_path: Path, namod_ctl: Call) -> None:
    records = made_records()
    # of another star: the facets' light belongs to a direction far away
    records[250] = replace(records[250], theta_rad=np.array([0.003, 0.0]), facet_intensity=np.full(8, 0.1))
    first = store_run(tmp_path / "FIRST", records[:200], 1)
    second = store_run(tmp_path / "SECOND", records[200:], 2)
    code, output, errors = namod_ctl("reconstruct", first, second, "--out", tmp_path / "BOTH")
    assert code == 0, errors
    assert "SECOND/50 stamp250" in output
    assert "SECOND/50 stamp250" in (tmp_path / "BOTH" / "report.txt").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{0}", "{1}"], "--out"),
        (["{0}", "--out", "{new}"], "several runs"),
        (["{0}", "{0}", "--out", "{new}"], "named twice"),
        (["{0}", "{link}", "--out", "{new}"], "named twice"),
        (["{0}", "{copy}", "--out", "{new}"], "200 of its 200 records"),
        (["{0}", "{new}", "--out", "{new}X"], "no run"),
        (["{0}", "{1}", "--out", "{0}", "--force"], "one of the runs"),
        (["{0}", "{1}", "--out", "{copy}"], "exists"),
        (["{0}", "{1}", "--out", "{copy}", "--force"], "no combination"),
        (["{0}", "{1}", "--out", "{new}/deeper"], "make it first"),
        (["{0}", "{mini}", "--out", "{new}"], "telescope.name is FACT"),
        (["{0}", "{few}", "--out", "{new}"], "facet ids 16"),
        (["{0}", "{odd}", "--out", "{new}"], "facet 12: focal_length_m is 4.884, in ODD 4.5"),
        (["{0}", "{1}", "--out", "{new}", "--estimator", "best"], "--estimator"),
    ],
)
def test_what_makes_no_sense_is_refused(
    halves: tuple[Path, Path], tmp_path: Path, namod_ctl: Call, arguments: list[str], words: str
) -> None:
    link, copy, new = tmp_path / "LINK", tmp_path / "COPY", tmp_path / "NEW"
    link.symlink_to(halves[0])
    shutil.copytree(halves[0], copy)
    mini = store_run(tmp_path / "MINI", [], 3, load_config("mini_fact"), (0, 1))
    few = store_run(tmp_path / "FEW", [], 3, ids=FACET_IDS[:-1])
    raw = load_config("fact").model_dump(exclude_none=True)
    next(facet for facet in raw["reflector"]["facets"] if facet["id"] == 12)["focal_length_m"] = 4.5
    odd = store_run(tmp_path / "ODD", [], 3, InstrumentConfig.model_validate(raw))
    before = sorted(path.name for path in tmp_path.iterdir())
    names = {"link": link, "copy": copy, "new": new, "mini": mini, "few": few, "odd": odd}
    code, _, errors = namod_ctl("reconstruct", *[argument.format(*halves, **names) for argument in arguments])
    assert code == 2
    assert words in errors
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_an_older_combination_is_replaced_and_never_combined(
    halves: tuple[Path, Path], tmp_path: Path, namod_ctl: Call
) -> None:
    both = tmp_path / "BOTH"
    assert namod_ctl("reconstruct", *halves, "--out", both)[0] == 0
    assert namod_ctl("instruct", both)[0] == 0
    assert namod_ctl("reconstruct", *halves, "--out", both, "--force")[0] == 0
    assert not (both / "instructions.csv").exists()
    code, _, errors = namod_ctl("reconstruct", both, halves[0], "--out", tmp_path / "MORE")
    assert code == 2
    assert "itself a combination" in errors
    assert "FAINT: records 200 to 399" in errors


def test_a_mirror_that_was_aligned_in_between_is_refused(tmp_path: Path, namod_ctl: Call) -> None:
    records = made_records()
    aligned = [replace(r, theta_rad=r.theta_rad + arcmin_to_rad(5.0), label="later") for r in records[200:]]
    first, second = store_run(tmp_path / "FIRST", records[:200], 1), store_run(tmp_path / "SECOND", aligned, 2)
    code, _, errors = namod_ctl("reconstruct", first, second, "--out", tmp_path / "BOTH")
    assert code == 2
    assert "were bolts turned" in errors
    assert not (tmp_path / "BOTH").exists()


def test_two_nights_of_the_twin(tmp_path: Path, namod_ctl: Call) -> None:
    """One telescope, two stars, and a reflector camera that was calibrated anew for the second night."""
    raw = load_config("mini_fact").model_dump(exclude_none=True)
    raw["star_camera"] |= {"columns": 400, "rows": 320}
    raw["reflector_camera"] |= {"columns": 256, "rows": 192, "plate_scale_mdeg_per_px": 240.0}
    config = InstrumentConfig.model_validate(raw)
    raw["reflector_camera"]["radiometric_law"]["r_const"] += math.log10(2.0)
    telescope = replace(TwinSettings().telescope, radius_rad=deg_to_rad(0.2))
    nights = []
    for star, used in (("Vega", config), ("Arcturus", InstrumentConfig.model_validate(raw))):
        twin = build_twin(config, TwinSettings(sky=SkySettings(reference_star=star), telescope=telescope), 21)
        path = tmp_path / star
        ids = [facet.id for facet in used.facets]
        equipment = Equipment(twin.star_camera, twin.reflector_camera, twin.clock, twin.wall_clock)
        instrument = with_facet_map(build_instrument(used))
        with RunStore.create(path, ids, used.to_json(), f"twin on {star}", twin.wall_clock) as store:
            pace = RecordSettings(pace_s=twin.telescope.pass_s / 60)
            Recorder(equipment, instrument, store, pace).record(StopRule(n_records=60))
        nights.append(path)
    code, output, errors = namod_ctl("reconstruct", *nights, "--out", tmp_path / "BOTH")
    assert code == 0, errors
    line = next(line for line in output.splitlines() if line.strip().startswith("Arcturus: "))
    factor, uncertainty = (float(line.split()[line.split().index("+-") + step]) for step in (-1, 1))
    assert abs(factor - 2.0) < 4.0 * uncertainty
    assert "divided by that" in line
    with RunStore.open(tmp_path / "BOTH") as store:
        times_s = [record.star_mid_exposure_s for record in store.records()]
    assert len(times_s) >= 120
    assert np.all(np.diff(times_s) > 0.0)
    assert namod_ctl("instruct", tmp_path / "BOTH")[0] == 0
    assert (tmp_path / "BOTH" / "instructions.csv").is_file()


@pytest.mark.parametrize("what", ["seed", "reflector"])
def test_twins_of_two_mirrors_are_refused(tmp_path: Path, namod_ctl: Call, what: str) -> None:
    """Whatever their records say: the runs know which twin they are of."""
    records = made_records()
    paths = [store_run(tmp_path / "FIRST", records[:200], 1), store_run(tmp_path / "SECOND", records[200:], 2)]
    other = TwinSettings() if what == "seed" else TwinSettings(reflector=PERFECT)
    for path, settings, seed in zip(paths, (TwinSettings(), other), (9, 10 if what == "seed" else 9), strict=True):
        with RunStore.open(path, read_only=False) as store:
            note_twin(store, settings, seed)
    code, _, errors = namod_ctl("reconstruct", *paths, "--out", tmp_path / "BOTH")
    assert code == 2
    assert ("seed 10" if what == "seed" else "misalignment_rad = 0.0") in errors
    assert not (tmp_path / "BOTH").exists()
    with RunStore.open(paths[1], read_only=False) as store:
        note_twin(store, TwinSettings(), 9)
    assert namod_ctl("reconstruct", *paths, "--out", tmp_path / "BOTH")[0] == 0
