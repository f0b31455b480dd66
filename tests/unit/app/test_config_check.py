"""`namod-ctl config`: what a person reads on a terminal of 80 columns."""

from __future__ import annotations

from pathlib import Path

import pytest

from namod_ctl.app import cli
from namod_ctl.app.config.instrument import builtin_folder, builtin_names


def _run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of the command line."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.argv", ["namod-ctl", *words])
    try:
        cli.main()
        code = 0
    except SystemExit as stop:
        code = int(stop.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_fact_is_explained(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = _run(monkeypatch, capsys, "config", "check", "fact")
    assert code == 0
    assert max(map(len, out.splitlines())) <= 80
    text = " ".join(out.split())
    for expected in (
        "Telescope FACT",
        "4.889 m",
        "30, hexagon 0.606 m flat to flat",
        "0, 2 to 7, 10 to 13, 15 to 19, 21 to 27, 29 to 35",
        "3180.4 cm2",
        "4.876 to 4.902 m",
        "tripod, 3 legs 120 deg apart at 0.295 m, leg 1 at +x",
        "1 mm per turn",
        "62.54 x 46.90 deg",
        "+x to the right, +y up (not mirrored)",
        "log10 I = 1.03 log10 C -1.15 log10 (T/s) -0.19",
        "at column 1280, row 960 (calibrated)",
        "30 of 30 facets",
        "fact: valid",
    ):
        assert expected in text, expected


@pytest.mark.parametrize("name", builtin_names())
def test_every_builtin_config_fits_the_terminal(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = _run(monkeypatch, capsys, "config", "check", name)
    assert code == 0
    assert max(map(len, out.splitlines())) <= 80
    assert f"{name}: valid" in out


def test_a_turned_and_mirrored_camera_is_told_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (builtin_folder() / "mini_fact.toml").read_text()
    text = text.replace("rotation_deg = 0.0\nmirrored = false", "rotation_deg = 0.0\nmirrored = true", 1)
    head, _, tail = text.partition("[reflector_camera]")
    path = tmp_path / "it.toml"
    path.write_text(head + "[reflector_camera]" + tail.replace("rotation_deg = 0.0", "rotation_deg = 90.0"))
    _, out, _ = _run(monkeypatch, capsys, "config", "check", str(path))
    text = " ".join(out.split())
    assert "+x to the left, +y up (mirrored)" in text
    # Turned counter-clockwise by 90 deg: what is right in the image is telescope up, so +y is to the right.
    assert "+x down, +y to the right (not mirrored)" in text
    assert "warning: no map of facets" in text


def test_the_devices_of_the_cameras_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _, out, _ = _run(monkeypatch, capsys, "config", "check", "fact")
    assert out.count("none: the digital twin") == 2
    assert "has no device" not in out
    _, out, _ = _run(monkeypatch, capsys, "config", "check", "bench_pylon")
    assert out.count("pylon, emulated: shown the twin's sky") == 2
    path = tmp_path / "half.toml"
    path.write_text(
        f'extends = "{builtin_folder() / "fact.toml"}"\n'
        '[star_camera]\nserial_number = "21979447"\n[star_camera.device]\ndriver = "pylon"\n'
    )
    code, out, _ = _run(monkeypatch, capsys, "config", "check", str(path))
    text = " ".join(out.split())
    assert code == 0
    assert "pylon, serial number 21979447" in text
    assert "warning: reflector_camera has no device, the other camera has one" in text


def test_all_builtin_configs_are_listed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = _run(monkeypatch, capsys, "config", "list")
    assert code == 0
    rows = [line.split() for line in out.splitlines()[1:]]
    assert [row[0] for row in rows] == builtin_names()
    assert ["mst_like", "MST-like", "86", "16", "m"] in rows


@pytest.mark.parametrize("content", [None, "[telescope", "[telescope]\nfocal_length_mm = 4889\n", "\x00"])
def test_a_bad_config_is_a_message_and_exit_code_2(
    content: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.toml"
    if content is not None:
        path.write_text(content)
    code, out, err = _run(monkeypatch, capsys, "config", "check", str(path))
    assert code == 2
    assert out == ""
    assert "bad.toml" in err
    assert "Traceback" not in err


def test_all_problems_are_told_at_once_each_in_the_same_form(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of values, of files and between sections; a section that is wrong hides none of the others."""
    (tmp_path / "facets.csv").write_text((builtin_folder() / "fact_facets.csv").read_text())
    text = (builtin_folder() / "fact.toml").read_text()
    for old, new in (
        ("radius_m = 0.295", "radius_m = 295.0"),
        ('"fact_facets.csv"', '"facets.csv"'),
        ('"fact_polygons.csv"', '"absent.csv"'),
        ("[telescope]", "[recording]\nbrightest_pixel_share = 0.93\n\n[telescope]"),
        ("saturation_share = 0.98", "saturation_share = 0.92"),
    ):
        assert old in text, old
        text = text.replace(old, new)
    path = tmp_path / "it.toml"
    path.write_text(text)
    code, _, err = _run(monkeypatch, capsys, "config", "check", str(path))
    assert code == 2
    head, *problems = err.splitlines()
    assert head == f"namod-ctl: {path}: these are its problems:"
    for beginning in (
        "mount.radius_m = 295.0 is not plausible",
        f"{tmp_path / 'absent.csv'}: there is no such file",
        "recording.brightest_pixel_share = 0.93 must be less than star_camera.saturation_share",
        "recording.brightest_pixel_share = 0.93 must be less than reflector_camera.saturation_share",
    ):
        assert [problem for problem in problems if problem.startswith(f"  {beginning}")], (beginning, err)
    assert len(problems) == 4


def test_an_entry_with_a_problem_is_not_also_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        (builtin_folder() / "fact.toml").read_text().replace('facets_file = "fact_facets.csv"\nformat = "namod"\n', "")
    )
    facet = 'id = 1\nposition_m = [0.0, 0.0, 0.0]\nfocal_length_m = 4.9\nshape = "hexagon"\nwidth_m = 60.6\n'
    path = tmp_path / "it.toml"
    path.write_text(text.split("[reflector_map]")[0] + f"\n[[reflector.facets]]\n{facet}")
    _, _, err = _run(monkeypatch, capsys, "config", "check", str(path))
    assert "reflector.facets[1].width_m = 60.6" in err
    assert len(err.splitlines()) == 1
