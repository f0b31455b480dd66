"""`instruct` and `export` on a run on disk: what they write, and what they refuse."""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from astropy.table import QTable
from output_samples import alignment_of, facet_alignment, tripod, unknown_facet

from namod_ctl.app.alignment_files import write_alignment
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.cli import main
from namod_ctl.app.commands.export import estimated_normals
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.records import Record
from namod_ctl.core.units import arcmin_to_rad
from namod_ctl.optics.raytrace import a_sigma_rad2, combine_moments, facet_moments, trace
from namod_ctl.store.facet_lists import read_mars
from namod_ctl.store.frames import REFLECTOR_CAMERA
from namod_ctl.store.run import RunStore
from namod_ctl.twin.reflector import TwinReflector
from namod_ctl.twin.settings import PERFECT
from namod_ctl.twin.surface_map import outline_m


@dataclass(frozen=True)
class Done:
    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def namod_ctl(monkeypatch, capsys):
    """The program, called as from the command line."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["namod-ctl", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        return Done(int(caught.value.code or 0), *capsys.readouterr())

    return call


@pytest.fixture(scope="module")
def fact():
    return load_config("fact")


@pytest.fixture
def run(tmp_path, fact):
    """A run of FACT with its estimates: mostly good ones, one without signal, one unreliable."""
    instrument = build_instrument(fact)
    ids = instrument.reflector.ids
    RunStore.create(tmp_path / "RUN", ids, fact.to_json(), "test", SystemClock()).close()
    rng = np.random.default_rng(8)
    facets = [facet_alignment(i, rng.normal(0, 0.1, 2), mount=instrument.mounts[i]) for i in ids]
    facets[2] = unknown_facet(ids[2])
    facets[5] = facet_alignment(ids[5], flags=FacetFlag.UNRELIABLE)
    write_alignment(tmp_path / "RUN", alignment_of(facets, facets_not_in_run=()))
    return tmp_path / "RUN"


def test_mars_file_gives_the_tilts_back(run, fact, tmp_path, namod_ctl):
    out = tmp_path / "as_found.txt"
    done = namod_ctl("export", run, "--format", "mars", "--out", out)
    assert done.returncode == 0, done.stderr
    reflector = build_instrument(fact).reflector
    assert f"facets {reflector.ids[2]}" in done.stderr
    table = QTable.read(run / "facets.ecsv", format="ascii.ecsv")
    theta_rad = np.column_stack([table["theta_x"].to_value("rad"), table["theta_y"].to_value("rad")])
    axis_rad = np.deg2rad([0.01, -0.02])
    found = read_mars(out)
    assert [facet.id for facet in found.facets] == list(reflector.ids)
    normals = found.normals / found.normals[:, 2:]
    aligned = reflector.aligned_normals()
    # a unit normal n + (t_x, t_y, 0), up to its length, shows its tilt relative to n_z
    tilt_rad = normals[:, :2] * aligned[:, 2:] - aligned[:, :2]
    expected_rad = (theta_rad - axis_rad) / 2
    expected_rad[2] = 0.0
    # half of theta, but for coma and obliquity of the outer facets
    np.testing.assert_allclose(tilt_rad, expected_rad, atol=np.deg2rad(0.5 / 60))
    np.testing.assert_allclose(tilt_rad[2], 0.0, atol=1e-9)
    for j in np.delete(np.arange(30), 2):  # the light of a star at theta gathers about the focal point
        alone = reflector.subset([reflector.ids[j]])
        rays = trace(alone, 300, theta_rad[j] - axis_rad, tilt_rad[j][None, :])
        np.testing.assert_allclose(facet_moments(rays).mean_m[0], 0.0, atol=1e-8)


def test_the_image_traced_from_the_found_normals_is_the_telescopes_own(fact):
    """A twin of known tilts; its facets' light was found where it truly is. Half of theta would be 20 % off."""
    instrument = build_instrument(fact)
    reflector = instrument.reflector
    outlines = [outline_m(facet) for facet in reflector.facets]
    settings = replace(PERFECT, misalignment_rad=arcmin_to_rad(0.3))
    twin = TwinReflector(reflector, instrument.mounts, outlines, settings, seed=3)
    twin.update(0.0, lambda _: 0.0)
    theta_deg = np.rad2deg(twin.true_theta_rad) + np.array([0.01, -0.02])  # from the samples' axis
    facets = [facet_alignment(i, theta) for i, theta in zip(reflector.ids, theta_deg, strict=True)]
    normals, unknown = estimated_normals(reflector, alignment_of(facets))
    assert unknown == ()
    tilt_rad = normals[:, :2] / normals[:, 2:] * reflector.aligned_normals()[:, 2:] - reflector.aligned_normals()[:, :2]
    np.testing.assert_allclose(tilt_rad, twin.true_tilt_rad, atol=arcmin_to_rad(0.01))
    moments = [combine_moments(facet_moments(trace(reflector, 400, None, t))) for t in (tilt_rad, twin.true_tilt_rad)]
    areas = [a_sigma_rad2(moment.cov_m2, reflector.focal_length_m) for moment in moments]
    assert areas[0] == pytest.approx(areas[1], rel=0.005)


@pytest.mark.parametrize(("form", "name"), [("ecsv", "ascii.ecsv"), ("fits", "fits")])
def test_tables(run, fact, tmp_path, form, name, namod_ctl):
    out = tmp_path / f"table.{form}"
    done = namod_ctl("export", run, "--format", form, "--out", out)
    assert done.returncode == 0, done.stderr
    table = QTable.read(out, format=name)
    expected = QTable.read(run / "facets.ecsv", format="ascii.ecsv")
    np.testing.assert_allclose(table["theta_x"].to_value("deg"), expected["theta_x"].to_value("deg"))
    assert list(table["facet_id"]) == list(expected["facet_id"])
    reflector = build_instrument(fact).reflector
    places_m = np.column_stack([table[f"position_{axis}"].to_value("m") for axis in "xyz"])
    np.testing.assert_allclose(places_m, reflector.positions_m)
    np.testing.assert_allclose(
        table["focal_length"].to_value("m"), [facet.focal_length_m for facet in reflector.facets]
    )
    normals = np.column_stack([np.asarray(table[f"normal_{axis}"]) for axis in "xyz"])
    assert np.isnan(normals[2]).all()  # no estimate, and none made up
    known = np.arange(30) != 2
    np.testing.assert_allclose(np.linalg.norm(normals[known], axis=1), 1.0)
    # a facet brightest at Theta, from the axis that is aimed at, leans by half of it
    tilts = (normals / normals[:, 2:] * reflector.aligned_normals()[:, 2:] - reflector.aligned_normals())[known, 0]
    theta_x = table["theta_x"].to_value("rad")[known] - np.deg2rad(0.01)
    np.testing.assert_allclose(tilts, theta_x / 2, atol=np.deg2rad(0.5 / 60))


@pytest.mark.parametrize("form", ["merlict", "robast"])
def test_forms_with_orientations_say_which_facets_are_made_up(run, tmp_path, form, namod_ctl):
    out = tmp_path / "out"
    done = namod_ctl("export", run, "--format", form, "--out", out)
    assert done.returncode == 0, done.stderr
    missing = build_instrument(load_config("fact")).reflector.ids[2]
    assert f"No estimate, so written as perfectly aligned: facets {missing}." in done.stderr
    assert f"no estimate, normal of the perfectly aligned facet: {missing}".encode() in out.read_bytes()


def settings_of(path):
    """Lines of a sim_telarray configuration that are no remarks."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("%")]
    return dict(line.split(" = ") for line in lines)


def test_one_run_for_sim_telarray_has_no_zenith_terms(run, tmp_path, namod_ctl):
    done = namod_ctl("export", run, "--format", "sim_telarray", "--out", tmp_path / "fact.dat")
    assert done.returncode == 0, done.stderr
    assert "One run" in done.stderr
    assert len(np.genfromtxt(tmp_path / "fact.dat")) == 30
    settings = settings_of(tmp_path / "fact.cfg")
    assert settings["mirror_list"] == "fact.dat"
    table = QTable.read(run / "facets.ecsv", format="ascii.ecsv")
    reliable = ~np.isin(np.arange(30), (2, 5))
    for name, axis in (("horizontal", "x"), ("vertical", "y")):
        sigma, _, cosine, sine = map(float, settings[f"mirror_align_random_{name}"].split(","))
        assert cosine == sine == 0.0
        seen = table[f"theta_{axis}"].to_value("deg")[reliable] / 2
        noise = table[f"theta_{axis}_uncertainty"].to_value("deg")[reliable] / 2
        assert sigma == pytest.approx(np.sqrt(np.var(seen, ddof=1) - np.mean(noise**2)), rel=1e-3)
    left_out = [build_instrument(load_config("fact")).reflector.ids[k] for k in (2, 5)]
    assert f"facets {left_out[0]} {left_out[1]}." in (tmp_path / "fact.cfg").read_text()


@pytest.fixture
def four_runs(tmp_path, fact):
    """Runs at 10 to 55 deg: facets scatter at rest, and each nods by a number of its own times sin z - sin 20 deg."""
    instrument = build_instrument(fact)
    ids = instrument.reflector.ids
    rng = np.random.default_rng(3)
    rest, sag, noise = 0.02 * rng.standard_normal((30, 2)), 0.2 * rng.standard_normal(30), 0.004
    paths, truth = [], []
    for zenith in np.radians([10.0, 25.0, 40.0, 55.0]):
        theta = rest.copy()
        theta[:, 1] += sag * (np.sin(zenith) - np.sin(np.radians(20.0)))
        truth.append(theta.std(axis=0, ddof=1) / 2)
        path = tmp_path / f"z{np.degrees(zenith):.0f}"
        RunStore.create(path, ids, fact.to_json(), "test", SystemClock()).close()
        seen = theta + noise * np.array([1.0, 0.7**0.5]) * rng.standard_normal((30, 2))
        facets = [facet_alignment(i, seen[k], mount=instrument.mounts[i]) for k, i in enumerate(ids)]
        write_alignment(path, alignment_of(facets, facets_not_in_run=()))
        paths.append(path)
    return paths, np.array(truth)


def test_four_runs_for_sim_telarray_give_the_scatter_of_each(four_runs, tmp_path, namod_ctl):
    runs, truth = four_runs
    out = tmp_path / "fact.dat"
    done = namod_ctl("export", *runs, "--format", "sim_telarray", "--zenith-deg", "10, 25,40,55", "--out", out)
    assert done.returncode == 0, done.stderr
    settings = settings_of(tmp_path / "fact.cfg")
    zenith = np.radians([10.0, 25.0, 40.0, 55.0])
    for axis, name in enumerate(("horizontal", "vertical")):
        constant, z0_deg, cosine, sine = map(float, settings[f"mirror_align_random_{name}"].split(","))
        z0 = np.radians(z0_deg)
        # sim_telarray's own sum of squares
        terms = (
            constant**2 + (cosine * (np.cos(zenith) - np.cos(z0))) ** 2 + (sine * (np.sin(zenith) - np.sin(z0))) ** 2
        )
        np.testing.assert_allclose(np.sqrt(terms), truth[:, axis], rtol=0.1)
    vertical = [float(value) for value in settings["mirror_align_random_vertical"].split(",")]
    assert vertical[3] == pytest.approx(0.1, rel=0.35)  # 30 facets tell a standard deviation to 13 %
    assert "One run" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--zenith-deg", "10,25"], "2 zenith distances for 4 runs"),
        (["--zenith-deg", "10,25,40,x"], "'x' is no zenith distance"),
        (["--zenith-deg", "10,25,40,91"], "'91' is no zenith distance"),
        (["--zenith-deg", "10,25,40,"], "'' is no zenith distance"),
        (["--zenith-deg", "40,41,42,43"], "span of 3 deg"),
        ([], "--zenith-deg 10,25,40,60"),
        (["--format", "mars"], "4 are given; only sim_telarray takes several"),
    ],
)
def test_runs_that_do_not_go_together_are_refused(four_runs, tmp_path, arguments, words, namod_ctl):
    runs, _ = four_runs
    out = tmp_path / "fact.dat"
    done = namod_ctl("export", *runs, "--format", "sim_telarray", "--out", out, *arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert not out.exists()
    assert not out.with_suffix(".cfg").exists()


@pytest.mark.parametrize(
    ("form", "out", "more", "words"),
    [
        ("sim_telarray", "fact.cfg", [], "give a .dat"),
        ("sim_telarray", "taken.dat", [], "taken.cfg: the file exists"),
        ("merlict", "", [], "is a folder"),
        ("merlict", "nowhere/x.tar", [], "does not exist"),
        ("robast", "x.csv", ["--zenith-deg", "10"], "has no zenith distance"),
        ("sim_telarray", "x.dat", ["--zenith-deg", "10,20"], "2 zenith distances for 1 runs"),
    ],
)
def test_what_cannot_be_written_is_refused(run, tmp_path, form, out, more, words, namod_ctl):
    (tmp_path / "taken.cfg").write_text("precious")
    before = sorted(path.name for path in tmp_path.iterdir())
    done = namod_ctl("export", run, "--format", form, "--out", tmp_path / out, *more)
    assert done.returncode == 2
    assert words in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert (tmp_path / "taken.cfg").read_text() == "precious"


def test_a_run_named_twice_and_runs_of_two_telescopes_are_refused(four_runs, tmp_path, namod_ctl):
    runs, _ = four_runs
    common = ["--format", "sim_telarray", "--zenith-deg", "10,25,40,55", "--out", tmp_path / "x.dat"]
    twice = namod_ctl("export", *runs[:3], runs[0], *common)
    assert (twice.returncode, "twice" in twice.stderr) == (2, True)
    other = load_config("mini_fact")
    ids = build_instrument(other).reflector.ids
    RunStore.create(tmp_path / "mini", ids, other.to_json(), "test", SystemClock()).close()
    write_alignment(tmp_path / "mini", alignment_of([facet_alignment(i) for i in ids], facets_not_in_run=()))
    mixed = namod_ctl("export", *runs[:3], tmp_path / "mini", *common)
    assert (mixed.returncode, "one telescope" in mixed.stderr) == (2, True)


def test_an_alignment_with_facets_that_the_telescope_lacks_is_refused(run, tmp_path, namod_ctl):
    write_alignment(run, alignment_of([facet_alignment(999)]))
    done = namod_ctl("export", run, "--format", "ecsv", "--out", tmp_path / "x.ecsv")
    assert done.returncode == 2
    assert "999" in done.stderr


def test_a_file_is_replaced_only_when_forced(run, tmp_path, namod_ctl):
    out = tmp_path / "out.txt"
    out.write_text("precious")
    refused = namod_ctl("export", run, "--format", "mars", "--out", out)
    assert refused.returncode == 2
    assert "--force" in refused.stderr
    assert out.read_text() == "precious"
    assert namod_ctl("export", run, "--format", "mars", "--out", out, "--force").returncode == 0
    assert "nx ny nz" in out.read_text()


def test_instruct_writes_list_picture_and_sheets(run, tmp_path, namod_ctl):
    image = tmp_path / "reflector.png"
    cv2.imwrite(str(image), np.full((911, 1215, 3), 90, np.uint8))  # same shape, another size than the camera's
    out = tmp_path / "out"
    out.mkdir()
    done = namod_ctl("instruct", run, "--image", image, "--out", out)
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((out / "instructions.csv").read_text().splitlines()))
    assert len(rows) == 30
    assert [row["bolt_1_deg"] == "" for row in rows] == [n in (2, 5) for n in range(30)]
    table = QTable.read(run / "facets.ecsv", format="ascii.ecsv")
    assert int(rows[0]["bolt_2_deg"]) == round(table["bolt_2_turn"][0].value)
    picture = cv2.imread(str(out / "instructions.png"))
    assert picture.shape[1] % 1215 == 0
    assert (out / "instructions.pdf").read_bytes().startswith(b"%PDF")
    assert "Do not turn facet" in done.stdout
    assert not (run / "instructions.csv").exists()


def test_instruct_without_a_picture(run, namod_ctl):
    assert namod_ctl("instruct", run).returncode == 0
    assert (run / "instructions.png").exists()


def test_instruct_lays_the_runs_own_frames_over_each_other(run, fact, namod_ctl):
    camera = build_instrument(fact).reflector_camera
    with RunStore.open(run, read_only=False) as store:
        frame = np.zeros((camera.n_rows, camera.n_columns, 3), np.uint8)
        frame[:20, :20] = (0, 0, 200)  # OpenCV's order: red
        store.add_frame(0, REFLECTOR_CAMERA, frame)
        store.append([record(0, len(store.facet_ids))])
    assert namod_ctl("instruct", run).returncode == 0
    corner = cv2.imread(str(run / "instructions.png"))[10, 10]
    np.testing.assert_allclose(corner, (0, 0, 200), atol=3)


def record(index, n_facets):
    nan = np.full(n_facets, np.nan)
    return Record(index, "", np.zeros(2), np.nan, 1.0, nan, nan, np.nan, np.nan)


def no_picture(tmp_path):
    (tmp_path / "bad.png").write_bytes(b"this is no PNG")
    return ["--image", tmp_path / "bad.png"], "no picture"


def missing_picture(tmp_path):
    return ["--image", tmp_path / "none.png"], "cannot be read"


def cropped_picture(tmp_path):
    cv2.imwrite(str(tmp_path / "wide.png"), np.zeros((720, 1280, 3), np.uint8))
    return ["--image", tmp_path / "wide.png"], "1280 x 720"


def missing_folder(tmp_path):
    return ["--out", tmp_path / "nowhere"], "does not exist"


@pytest.mark.parametrize("fault", [no_picture, missing_picture, cropped_picture, missing_folder])
def test_bad_input_is_named_and_nothing_is_written(run, tmp_path, fault, namod_ctl):
    arguments, words = fault(tmp_path)
    done = namod_ctl("instruct", run, *arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("**/instructions.*"))


@pytest.mark.parametrize("command", [["instruct"], ["export", "--format", "ecsv", "--out", "table.ecsv"]])
def test_a_run_that_was_not_reconstructed(run, command, namod_ctl):
    (run / "alignment.json").unlink()
    done = namod_ctl(command[0], run, *command[1:])
    assert done.returncode == 2
    assert "namod-ctl reconstruct" in done.stderr


def test_an_alignment_of_another_telescope(run, namod_ctl):
    write_alignment(run, alignment_of([facet_alignment(999)]))
    done = namod_ctl("instruct", run)
    assert done.returncode == 2
    assert "999" in done.stderr


def test_the_turns_are_those_of_the_mount(fact):
    """The samples' tripod is FACT's, so the tests above speak of the real mount."""
    mount = build_instrument(fact).mounts[13]
    np.testing.assert_allclose(mount.legs_m, tripod().legs_m, atol=1e-12)
    assert mount.pitch_m_per_turn == pytest.approx(1e-3)


def test_a_facet_far_off_is_named_beside_the_scatter_it_dominates(run, tmp_path, fact, namod_ctl):
    ids = build_instrument(fact).reflector.ids
    rng = np.random.default_rng(8)
    thetas = rng.normal(0, 0.02, (30, 2))
    thetas[7] = (0.0, 0.5)
    write_alignment(run, alignment_of([facet_alignment(i, theta) for i, theta in zip(ids, thetas, strict=True)]))
    assert namod_ctl("export", run, "--format", "sim_telarray", "--out", tmp_path / "x.dat").returncode == 0
    assert f"far beyond all others: facets {ids[7]}." in (tmp_path / "x.cfg").read_text()
