"""Configs: what a good one becomes, and that every wrong one is refused with key, value and remedy."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import InstrumentConfig, builtin_folder, builtin_names, load_config
from namod_ctl.core.errors import ConfigError

FACT_TOML = (builtin_folder() / "fact.toml").read_text()
REQUIRED_KEY = r"^(?!axis_px)(\w+) = "  # without axis_px the facets' common centre is aimed at
FACT_KEYS = re.findall(REQUIRED_KEY, FACT_TOML, flags=re.MULTILINE)
Refuse = Callable[[str], str]


@pytest.fixture
def refuse(tmp_path: Path) -> Refuse:
    """Loads a text as a config beside FACT's tables and returns what it is refused with."""
    for table in builtin_folder().glob("*.csv"):
        shutil.copy(table, tmp_path)

    def load(text: str) -> str:
        path = tmp_path / "it.toml"
        path.write_text(text)
        with pytest.raises(ConfigError) as caught:
            load_config(path)
        message = str(caught.value)
        assert "it.toml" in message or ".csv" in message
        return message

    return load


def _replaced(line: str, new: str) -> str:
    text, count = re.subn(rf"^{line}.*$", lambda _: new, FACT_TOML, count=1, flags=re.MULTILINE)
    assert count == 1
    return text


def test_every_builtin_config_builds_an_instrument() -> None:
    assert {"fact", "mini_fact", "mst_like", "lst_like"} <= set(builtin_names())
    counts = {name: len(build_instrument(load_config(name)).reflector.facets) for name in builtin_names()}
    assert counts["fact"] == counts["mini_fact"] == 30
    assert counts["mst_like"] == 86
    assert counts["lst_like"] == 198


@pytest.mark.parametrize("n_line", range(len(FACT_KEYS)), ids=FACT_KEYS)
def test_a_missing_key_is_refused(n_line: int, refuse: Refuse) -> None:
    lines = FACT_TOML.split("\n")
    where = [i for i, line in enumerate(lines) if re.match(REQUIRED_KEY, line)][n_line]
    key = FACT_KEYS[n_line]
    message = refuse("\n".join(lines[:where] + lines[where + 1 :]))
    assert key in message
    assert len(message.splitlines()) == 1


@pytest.mark.parametrize(
    "section", ["telescope", "reflector", "mount", "star_camera.radiometric_law", "reflector_camera"]
)
def test_a_missing_section_is_refused(section: str, refuse: Refuse) -> None:
    text = re.sub(rf"^\[{re.escape(section)}\]\n(.|\n)*?(?=^\[|\Z)", "", FACT_TOML, flags=re.MULTILINE)
    assert f"{section.split('.')[0]}" in refuse(text)


@pytest.mark.parametrize(
    ("line", "new", "says"),
    [
        # wrong unit
        ("focal_length_m", "focal_length_m = 4889.0", r"telescope\.focal_length_m = 4889\.0 .* at most 100 m; .*unit"),
        ("focal_length_m", "focal_length_m = 488.9", "focal_length_m = 488.9"),
        ("radius_m", "radius_m = 295.0", "mount.radius_m = 295.0"),
        ("pitch_mm", "pitch_mm_per_turn = 0.001", "at least 0.05 mm per turn"),
        ("travel_limit_mm", "travel_limit_mm = 0.005", "mount.travel_limit_mm"),
        (
            "plate_scale_mdeg_per_px = 2.437",
            "plate_scale_mdeg_per_px = 0.002437",
            "star_camera.plate_scale_mdeg_per_px",
        ),
        ("plate_scale_mdeg_per_px = 61.07", "plate_scale_mdeg_per_px = 0.06107", "reflector_camera.plate_scale"),
        ("goniometer", "goniometer_resolution_deg = 300", "goniometer_resolution_deg"),
        ("star_diameter_deg", "star_diameter_deg = 25.0", "star_diameter_deg"),
        ("saturation_share", "saturation_share = 98", "saturation_share"),
        # wrong sign
        ("focal_length_m", "focal_length_m = -4.889", "at least 0.1 m; check sign and unit"),
        ("r_expo = -1.23", "r_expo = 1.23", "radiometric_law.r_expo = 1.23"),
        ("backlash_um", "backlash_um = -1.0", "at least 0 um"),
        ("columns = 2560", "columns = -2560", "star_camera.columns"),
        # wrong type
        ("focal_length_m", 'focal_length_m = "4.889"', "'4.889' does not fit"),
        ("mirrored", "mirrored = 0", "star_camera.mirrored"),
        ("columns = 2560", "columns = 2560.5", "star_camera.columns"),
        ("radius_m", "radius_m = nan", "no finite number"),
        ("radius_m", "radius_m = inf", "mount.radius_m"),
        ("radius_m", f"radius_m = {10**400}", r"mount\.radius_m = 10{56}\.\.\."),
        ("radius_m", f"radius_m = 1{'0' * 5000}", "not valid TOML"),
        ("radius_m", f"radius_m = {'[' * 5000}", "not valid TOML"),
        ("turn_raises_leg", 'turn_raises_leg = "left"', "'clockwise' or 'counterclockwise'"),
        ("kind", 'kind = "quadpod"', '"tripod" and "legs"'),
        # unknown keys
        ("focal_length_m", "focal_length_mm = 4889", "is in mm .*expected in m: .*write focal_length_m$"),
        ("focal_length_m", "focal_length = 4.889", "says no unit .*expected in m: .*write focal_length_m$"),
        (
            "plate_scale_mdeg_per_px = 2.437",
            "plate_scale_deg_per_px = 0.0024",
            "in deg per px .*expected in mdeg per px",
        ),
        ("rotation_deg", "rotation_rad = 0.0", "is in rad .* write rotation_deg"),
        ("focal_length_m", "focal_lenght_m = 4.889", "unknown key .*did you mean focal_length_m"),
        ("turn_raises_leg", 'turn_rises_leg = "clockwise"', r"mount\.turn_rises_leg: .* did you mean turn_raises_leg"),
        ("r_resp", "r_response = 1.2", "did you mean r_resp"),
        ("radius_m", "radius_m = 0.295\nqwzx = 1", "unknown key .* known here are orientation_deg"),
        # values that contradict each other
        ("axis_px", "axis_px = [2561.0, 10.0]", "outside the 2560 x 1920 image"),
        ("format", 'format = "namod"\nfacet_ids = [1, 2]', "facet_ids is for facet lists without ids"),
        ("format", 'format = "namod"\n[reflector.dish]\nparabola_share = 0.5', "dish is for facet lists without z"),
        (
            "backlash_um",
            "backlash_um = 0.0\nfacet_orientation_deg = {14 = 30.0}",
            "facet_orientation_deg.14: .*no facet",
        ),
        ("facets_file", 'facets_file = "none.csv"', r"none\.csv: there is no such file"),
        ("polygons_file", 'polygons_file = "fact_facets.csv"', "fact_facets.csv: the header must be"),
    ],
)
def test_a_wrong_value_or_key_is_refused_with_its_remedy(line: str, new: str, says: str, refuse: Refuse) -> None:
    message = refuse(_replaced(line, new))
    assert re.search(says, message), message
    assert len(message.splitlines()) == 1, message


def test_all_problems_of_a_file_are_told_together(refuse: Refuse) -> None:
    text = _replaced("focal_length_m", "focal_length_m = -4.889").replace("radius_m = 0.295", "radius_mm = 295")
    message = refuse(text.replace("r_const = 0.99\n", "").replace('facets_file = "fact_facets.csv"', ""))
    for key in ("telescope.focal_length_m", "mount.radius_mm", "star_camera.radiometric_law.r_const", "reflector"):
        assert key in message
    assert len(message.splitlines()) == 4


def test_broken_toml_names_line_and_column(refuse: Refuse) -> None:
    assert re.search(r"not valid TOML: .*line 2, column \d+", refuse('[telescope]\nname = "FACT\n'))


def test_a_missing_config_lists_the_builtin_names(tmp_path: Path) -> None:
    for wrong in (tmp_path / "no.toml", tmp_path, "nosuch"):
        with pytest.raises(ConfigError, match=r"built-in name: .*fact, .*mst_like"):
            load_config(wrong)


def _with_facets(body: str) -> str:
    return FACT_TOML.replace('facets_file = "fact_facets.csv"\nformat = "namod"\n', body)


def _inline_facet(**changes: str) -> str:
    values = {
        "id": "7",
        "position_m": "[0.5, 0.0, 0.02]",
        "focal_length_m": "4.9",
        "shape": '"hexagon"',
        "width_m": "0.606",
        **changes,
    }
    return "[[reflector.facets]]\n" + "".join(f"{key} = {value}\n" for key, value in values.items())


@pytest.mark.parametrize(
    ("facets", "says"),
    [
        (_inline_facet(position_m="[-30.8, -16.9, 0.26]"), "facet 7 stands 35.* m from the axis"),
        (_inline_facet(position_m="[0.5, 0.0, -0.26]"), "z = -0.26 m.* check sign"),
        (_inline_facet(position_m="[0.5, 0.0]"), r"reflector\.facets\[1\]\.position_m"),
        (_inline_facet(position_m="[0.5, 0.0, 9e9]"), r"reflector\.facets\[1\]\.position_m\[3\]"),
        (_inline_facet(focal_length_m="16.0"), "facet 7 has focal_length_m = 16.* no radius of curvature"),
        (_inline_facet(width_m="60.6"), r"reflector\.facets\[1\]\.width_m = 60.6"),
        (_inline_facet(width_cm="60.6"), r"reflector\.facets\[1\]\.width_cm: is in cm"),
        (_inline_facet(shape='"octagon"'), "'hexagon', 'square' or 'round'"),
        (_inline_facet() + _inline_facet(), "facet id 7 occurs 2 times"),
        (_inline_facet() + _inline_facet(id="8", position_m="[0.9, 0.0, 0.04]"), "facets 7 and 8 overlap by 26%"),
        ('facets_file = "fact_facets.csv"\n' + _inline_facet(), "exactly one of .* found facets and facets_file"),
        ("facets = []\n", "reflector.facets"),
    ],
)
def test_misplaced_facets_are_refused(facets: str, says: str, refuse: Refuse) -> None:
    text = _with_facets("").replace("[reflector]", "").replace("[reflector_map]", "")
    text = text.replace('polygons_file = "fact_polygons.csv"', "")
    body = facets if facets.startswith("[[") else f"[reflector]\n{facets}"
    assert re.search(says, refuse(f"{text}\n{body}"))


MARS_ROWS = """-30.80 -161.97 25.88 0.0322080  0.1669300 0.9854400 490.2 Hex 60.6
62.85 -107.66 14.61 -0.0658870 .1098400 0.9917600 488.8 Hex 60.6
"""


def _load_with_list(folder: Path, keys: str, facet_list: str) -> InstrumentConfig:
    (folder / "list.txt").write_text(facet_list)
    text = _with_facets(f'facets_file = "list.txt"\n{keys}\n')
    (folder / "it.toml").write_text(text[: text.index("[reflector_map]")])
    return load_config(folder / "it.toml")


def test_facets_come_from_a_mars_list_with_or_without_ids(tmp_path: Path) -> None:
    config = _load_with_list(tmp_path, 'format = "mars"\nfacet_ids = [33, 6]', MARS_ROWS)
    assert [facet.id for facet in config.facets] == [33, 6]
    assert config.facets[1].position_m == pytest.approx((0.6285, -1.0766, 0.1461))
    assert [f.id for f in _load_with_list(tmp_path, 'format = "mars"', MARS_ROWS).facets] == [1, 2]
    assert InstrumentConfig.from_json(config.to_json(), "run") == config


def test_facets_come_from_a_sim_telarray_list_and_stand_on_the_dish(tmp_path: Path) -> None:
    rows = "60.0 0.0 60.6 488.9 3 #% id=8\n-80.0 60.0 60.6 0 1 12.5 #% id=9\n"
    first, second = _load_with_list(tmp_path, 'format = "sim_telarray"', rows).facets
    assert (first.id, second.id) == (8, 9)
    assert first.rotation_deg == 0.0  # its frame is turned by 90 deg against ours
    assert first.position_m[2] == pytest.approx(4.889 - np.sqrt(4.889**2 - 0.6**2))  # Davies-Cotton unless told
    assert second.position_m[2] == 0.125
    dish = 'format = "sim_telarray"\n[reflector.dish]\nparabola_share = 1.0'
    assert _load_with_list(tmp_path, dish, rows).facets[0].position_m[2] == pytest.approx(0.36 / (4 * 4.889))


def test_a_bad_row_of_a_facet_list_is_named_by_its_own_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"list\.txt, line 2: column 8 \(type\) holds 'Oct'"):
        _load_with_list(tmp_path, 'format = "mars"', MARS_ROWS[::-1].replace("xeH", "tcO", 1)[::-1])
    with pytest.raises(ConfigError, match=r"list\.txt: facet 1: position_m\[3\] = -20\.0 is not plausible"):
        _load_with_list(tmp_path, 'format = "mars"', MARS_ROWS.replace("25.88", "-2000.0"))


def test_a_flood_of_problems_is_cut_short(refuse: Refuse) -> None:
    text = (builtin_folder() / "lst_like.toml").read_text().replace("focal_length_m = 28.0", "focal_length_m = 95.0")
    text = text.replace("parabola_share = 1.0", "parabola_share = 1.0\nfacet_focal_length_m = 28.0")
    lines = refuse(text).splitlines()
    assert lines[-1] == "... and 158 more"
    assert len(lines) == 41


@pytest.mark.parametrize(
    ("corners", "says"),
    [
        ("[[10, 10], [20, 20], [20, 10], [10, 20]]", "facet 13: crosses itself: the side from corner 1"),
        ("[[10, 10], [20, 20], [2000, 10]]", "facet 13: corner 3 at .* outside the image of 1024 x 768"),
        ("[[10, 10], [20, 20], [20, 768]]", "facet 13: corner 3"),
        ("[[10, 10], [20, 20]]", "facet 13: has 2 corners"),
        ("[[10, 10], [20, 20], [nan, 10]]", r"reflector_map\.polygons\[1\]\.corners_px\[3\]\[1\] = nan is no finite"),
    ],
)
def test_bad_outlines_are_refused(corners: str, says: str, refuse: Refuse) -> None:
    text = FACT_TOML.replace(
        'polygons_file = "fact_polygons.csv"', f"polygons = [{{facet_id = 13, corners_px = {corners}}}]"
    )
    assert re.search(says, refuse(text))


def test_outlines_of_unknown_or_repeated_facets_are_refused(refuse: Refuse) -> None:
    polygon = "{facet_id = %d, corners_px = [[10, 10], [20, 20], [20, 10]]}"
    start = FACT_TOML.replace('polygons_file = "fact_polygons.csv"', "polygons = [")
    message = refuse(start + polygon % 1 + ", " + polygon % 13 + ", " + polygon % 13 + "]")
    assert "the polygon of facet 1: the reflector has no facet of this id; its ids are 0, 2 to 7" in message
    assert "the polygon of facet 13 occurs twice" in message


LEGS = """kind = "legs"
positions_m = {}
has_fixed_point = {}
orientation_deg = 90.0
travel_limit_mm = 5.0
goniometer_resolution_deg = 5.0
backlash_um = 20.0
"""


def _with_mount(body: str) -> str:
    return re.sub(r"(?s)(\[mount\]\n).*?(?=\[star_camera\])", lambda match: match[1] + body, FACT_TOML)


@pytest.mark.parametrize(
    ("positions", "fixed", "more", "says"),
    [
        ("[[0.3, 0.0], [-0.3, 0.0]]", "true", "", "on one line"),
        ("[[0.3, 0.0], [0.0, 0.3]]", "false", "", "2 straight legs without a fixed point"),
        ("[[300.0, 0.0], [0.0, 300.0]]", "true", "", r"mount\.positions_m\[1\]\[1\] = 300.0 .* at most 2 m"),
        ("[[0.3, 0.0], [0.0, 0.3]]", "true", "pitch_mm_per_turn = 1.0", "go together"),
        ("[[0.3, 0.0], [0.0, 0.3]]", "true", "base_joints_m = [[0.0, 0.0, -0.2]]", "1 joints for 2 positions_m"),
    ],
)
def test_legs_that_cannot_work_are_refused(positions: str, fixed: str, more: str, says: str, refuse: Refuse) -> None:
    assert re.search(says, refuse(_with_mount(LEGS.format(positions, fixed) + more + "\n")))


def test_two_actuators_and_a_fixed_point_are_turned_as_a_whole(tmp_path: Path) -> None:
    shutil.copytree(builtin_folder(), tmp_path, dirs_exist_ok=True)
    path = tmp_path / "it.toml"
    path.write_text(
        _with_mount(LEGS.format("[[0.3, 0.0], [0.0, 0.2]]", "true") + "facet_orientation_deg = {13 = 0.0}\n")
    )
    mounts = build_instrument(load_config(path)).mounts
    np.testing.assert_allclose(mounts[31].legs_m, [[0.0, 0.3], [-0.2, 0.0]], atol=1e-15)
    np.testing.assert_allclose(mounts[13].legs_m, [[0.3, 0.0], [0.0, 0.2]], atol=1e-15)
    assert mounts[31].has_fixed_point
    assert mounts[31].pitch_m_per_turn is None
    assert mounts[31].backlash_m == pytest.approx(20e-6)


def test_a_hexapod_keeps_its_lower_joints(tmp_path: Path) -> None:
    shutil.copytree(builtin_folder(), tmp_path, dirs_exist_ok=True)
    angles = np.radians([0, 10, 120, 130, 240, 250])
    upper = 0.3 * np.column_stack([np.cos(angles), np.sin(angles)])
    lower = np.column_stack([np.roll(upper, 1, axis=0) * 1.2, np.full(6, -0.2)])
    body = LEGS.format(upper.round(4).tolist(), "false") + f"base_joints_m = {lower.round(4).tolist()}\n"
    (tmp_path / "it.toml").write_text(_with_mount(body))
    mount = build_instrument(load_config(tmp_path / "it.toml")).mounts[13]
    assert mount.base_joints_m is not None
    np.testing.assert_allclose(mount.base_joints_m[1], [-lower[1, 1], lower[1, 0], -0.2], atol=1e-4)  # turned by 90 deg


@pytest.mark.parametrize("name", builtin_names())
def test_the_stored_json_restores_exactly_the_same_instrument(name: str) -> None:
    config = load_config(name)
    text = config.to_json()
    restored = InstrumentConfig.from_json(text, "run.sqlite")
    assert restored == config
    assert restored.to_json() == text
    assert "_file" not in text
    first, second = build_instrument(config), build_instrument(restored)
    np.testing.assert_array_equal(first.reflector.positions_m, second.reflector.positions_m)
    for facet_id, corners_px in first.facet_polygons_px.items():
        np.testing.assert_array_equal(corners_px, second.facet_polygons_px[facet_id])
    assert first.star_camera.plate_scale_rad == second.star_camera.plate_scale_rad


def test_a_stored_json_that_was_tampered_with_is_refused() -> None:
    raw = json.loads(load_config("fact").to_json())
    raw["telescope"]["focal_length_m"] = 4889.0
    with pytest.raises(ConfigError, match=r"run\.sqlite: telescope\.focal_length_m"):
        InstrumentConfig.from_json(json.dumps(raw), "run.sqlite")
    raw["telescope"]["focal_length_m"] = 4.889
    raw["reflector"] = {"facets_file": "fact_facets.csv", "format": "namod"}
    with pytest.raises(ConfigError, match="written out"):
        InstrumentConfig.from_json(json.dumps(raw), "run.sqlite")


@given(
    st.text()
    | st.recursive(st.none() | st.floats() | st.text(), lambda inner: st.dictionaries(st.text(), inner)).map(json.dumps)
)
def test_any_stored_text_is_read_or_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        InstrumentConfig.from_json(text, "run.sqlite")


@given(st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_change_of_one_value_is_read_or_refused(data: st.DataObject) -> None:
    raw = json.loads(load_config("mini_fact").to_json())
    raw["reflector"]["facets"] = raw["reflector"]["facets"][:2]
    section: object = raw
    while True:
        if not isinstance(section, dict | list) or not section:
            break
        key = data.draw(st.sampled_from(sorted(section) if isinstance(section, dict) else range(len(section))))
        inner = section[key]  # type: ignore[index]
        if not isinstance(inner, dict | list) or data.draw(st.booleans()):
            section[key] = data.draw(  # type: ignore[index]
                st.none()
                | st.floats()
                | st.text(max_size=5)
                | st.integers()
                | st.booleans()
                | st.just([])
                | st.just({})
            )
            break
        section = inner
    try:
        build_instrument(InstrumentConfig.from_json(json.dumps(raw), "run.sqlite"))
    except ConfigError as error:
        message = str(error)
        assert message.startswith("run.sqlite: ")
