"""Facet lists of the simulations: FACT's own table, rows as the simulations' manuals write them, and any garbage."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.layouts import Dish
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector
from namod_ctl.store.facet_lists import (
    format_mars,
    format_sim_telarray,
    parse_mars,
    parse_sim_telarray,
    read_mars,
    read_sim_telarray,
    write_mars,
    write_sim_telarray,
)

FACT_FACETS = Path(__file__).parents[3] / ".." / "shared" / "data" / "fact_2014" / "fact_facets_measured.txt"
MARS_ROW = "62.85 -107.66 14.61 -0.0658870 .1098400 0.9917600 488.8 Hex 60.6"
DISH = Dish(28.0, parabola_share=1.0)


def test_facts_own_table_is_read() -> None:
    if not FACT_FACETS.is_file():
        pytest.skip("the measured FACT facets are not in ../shared/data")
    facet_list = read_mars(FACT_FACETS)
    assert len(facet_list.facets) == 30
    assert facet_list.normals is not None
    # FACT's facets are aligned to a degree's fraction: file normals and geometry tell the same direction.
    aligned = Reflector(4.889, facet_list.facets).aligned_normals()
    angle_deg = np.degrees(np.linalg.norm(np.cross(aligned, facet_list.normals), axis=1))
    assert angle_deg.max() < 0.5
    assert {facet.width_m for facet in facet_list.facets} == {0.606}


def test_a_mars_row_is_in_cm_and_may_leave_out_the_zero_before_the_point() -> None:
    facet_list = parse_mars(f"# a comment\n\n{MARS_ROW}  # and another\r\n", "m.txt")
    facet = facet_list.facets[0]
    assert facet.id == 1
    np.testing.assert_allclose(facet.position_m, [0.6285, -1.0766, 0.1461], rtol=1e-15)
    assert facet.focal_length_m == pytest.approx(4.888)
    assert facet.shape is FacetShape.HEXAGON
    np.testing.assert_array_equal(facet_list.normals, [[-0.065887, 0.10984, 0.99176]])


def test_ids_of_a_mars_list_come_from_the_caller_or_the_comment() -> None:
    text = f"{MARS_ROW}\n{MARS_ROW}"
    assert [f.id for f in parse_mars(text, "m.txt").facets] == [1, 2]
    assert [f.id for f in parse_mars(text, "m.txt", [13, 31]).facets] == [13, 31]
    assert [f.id for f in parse_mars(f"# facet ids, row by row: 7 5\n{text}", "m.txt").facets] == [7, 5]


@pytest.mark.parametrize(
    ("text", "ids", "says"),
    [
        (MARS_ROW.replace("60.6", "60.6x"), None, r"m\.txt, line 1: column 9 \(fD\) holds '60\.6x'"),
        (f"\n{MARS_ROW.replace('62.85', 'nan')}", None, r"line 2: column 1 \(x\) holds 'nan'"),
        (MARS_ROW.replace("62.85", "1e999"), None, r"column 1 \(x\) holds '1e999'"),
        (MARS_ROW.replace("488.8", "4.888"), None, r"column 7 \(f\) holds 4\.888, allowed is 10 to 15000 cm"),
        (MARS_ROW.replace("488.8", "-488.8"), None, r"column 7 \(f\)"),
        (MARS_ROW.replace(".1098400", ".9"), None, r"\(nx ny nz\).*unit vector"),
        (MARS_ROW.replace("0.9917600", "-0.9917600"), None, r"nz > 0"),
        (MARS_ROW.replace("Hex", "Oct"), None, r"column 8 \(type\) holds 'Oct', known are Hex, Square, Disk"),
        (MARS_ROW + " 1", None, "10 columns, expected 9"),
        ("# nothing", None, "no facet"),
        (MARS_ROW, [1, 2], "1 facets but 2 facet ids"),
        (f"{MARS_ROW}\n{MARS_ROW}", [4, 4], "more than once: 4"),
    ],
)
def test_bad_mars_lists_name_line_column_and_value(text: str, ids: list[int] | None, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        parse_mars(text, "m.txt", ids)


def test_all_bad_rows_are_reported_together() -> None:
    with pytest.raises(ConfigError) as caught:
        parse_mars(f"{MARS_ROW} 1\n{MARS_ROW}\n{MARS_ROW.replace('Hex', 'Oct')}", "m.txt")
    assert "line 1" in str(caught.value)
    assert "line 2" not in str(caught.value)
    assert "line 3" in str(caught.value)


def test_sim_telarray_rows_with_and_without_z_and_id() -> None:
    facets = parse_sim_telarray(
        "# x y diameter focal_length shape z\n 154.0 0. 151 2802.1 1 #% id=5\n -77 .5 151 0 3 11.9 #% id=6\n",
        "s.dat",
        DISH,
    ).facets
    assert [facet.id for facet in facets] == [5, 6]
    assert facets[0].position_m[2] == pytest.approx(1.54**2 / 112.0)  # on the paraboloid z = r^2 / (4 f)
    np.testing.assert_allclose(facets[0].position_m[:2], [0.0, -1.54])  # their +x points down
    assert facets[0].rotation_rad == pytest.approx(np.pi / 6)  # code 1: flats face their +-x, which is up and down
    assert facets[1].position_m[2] == pytest.approx(0.119)
    np.testing.assert_allclose(facets[1].position_m[:2], [0.005, 0.77])
    assert facets[1].rotation_rad == 0.0
    assert facets[1].focal_length_m == pytest.approx(np.hypot(np.hypot(0.77, 0.005), 28.0 - 0.119))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 2 151 2800", "4 columns, expected 5 or 6"),
        ("1 2 151 2800 1 3 4", "7 columns"),
        ("1 2 151 28 1", None),
        ("1 2 1.51 2800 1", None),
        ("1 2 151 5 1", "check the unit, cm"),
        ("1 2 0.5 2800 1", r"column 3 \(diameter\) holds 0\.5, allowed is 1 to 500 cm"),
        ("1 2 151 2800 7", r"column 5 \(shape\) holds '7'"),
        ("1 2 151 2800 1 #% id=3\n5 6 151 2800 1", "1 of 2 rows have an id"),
        ("1 2 151 2800 1 #% id=3\n5 6 151 2800 1 #% id=3", "more than once: 3"),
        ("1 2_0 151 2800 1", r"column 2 \(y\) holds '2_0'"),
    ],
)
def test_bad_sim_telarray_lists_name_what_is_wrong(text: str, says: str | None) -> None:
    if says is None:  # plausible one by one; the config compares them with the telescope
        parse_sim_telarray(text, "s.dat", DISH)
        return
    with pytest.raises(ConfigError, match=says):
        parse_sim_telarray(text, "s.dat", DISH)


def test_a_row_beyond_the_dish_needs_a_z() -> None:
    with pytest.raises(ConfigError, match="beyond the dish"):
        parse_sim_telarray("600 0 60 490 1", "s.dat", Dish(4.889))


def test_a_written_sim_telarray_row_has_z_before_the_id() -> None:
    facet = Facet(42, np.array([1.0, -2.0, 0.25]), 16.0, FacetShape.SQUARE, 1.2)
    row = format_sim_telarray(Reflector(16.0, (facet,))).splitlines()[-1]
    values, _, identity = row.partition("#%")
    assert [float(value) for value in values.split()] == [200.0, 100.0, 120.0, 1600.0, 2.0, 25.0]
    assert identity.strip() == "id=42"


def test_a_turn_without_a_code_is_refused() -> None:
    facet = Facet(42, np.array([1.0, -2.0, 0.25]), 16.0, FacetShape.HEXAGON, 1.2, rotation_rad=0.2)
    with pytest.raises(ConfigError, match=r"facet 42.*no code"):
        format_sim_telarray(Reflector(16.0, (facet,)))


def test_a_facet_below_the_vertex_is_refused_and_one_at_its_height_keeps_a_z() -> None:
    def facet(z_m: float) -> Facet:
        return Facet(42, np.array([1.0, -2.0, z_m]), 16.0, FacetShape.ROUND, 1.2)

    with pytest.raises(ConfigError, match=r"facet 42.*2\.000 cm below"):
        format_sim_telarray(Reflector(16.0, (facet(-0.02),)))
    row = format_sim_telarray(Reflector(16.0, (facet(0.0),))).splitlines()[-1]
    assert float(row.split()[5]) > 0.0  # a 0 would ask sim_telarray to put it on the dish


def test_missing_and_binary_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.txt: there is no such file"):
        read_mars(tmp_path / "absent.txt")
    (tmp_path / "b.txt").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ConfigError, match=r"b\.txt: not a text file"):
        read_sim_telarray(tmp_path / "b.txt", DISH)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_mars(tmp_path)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "r.txt"
    path.write_text("old")

    def full_disk(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    facets = parse_mars(MARS_ROW, "m.txt").facets
    with pytest.raises(OSError, match="No space"):
        write_mars(path, Reflector(4.889, facets), np.array([[0.0, 0.0, 1.0]]))
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("r.txt", "old")]


def test_normals_of_the_wrong_shape_are_a_bug() -> None:
    reflector = Reflector(4.889, parse_mars(MARS_ROW, "m.txt").facets)
    with pytest.raises(ValueError, match="shape"):
        format_mars(reflector, np.zeros((2, 3)))


_FACETS = st.builds(
    Facet,
    id=st.integers(0, 999_999),
    position_m=st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0), st.floats(0.0, 5.0)).map(np.array),
    focal_length_m=st.floats(0.2, 100.0),
    shape=st.sampled_from(list(FacetShape)),
    width_m=st.floats(0.02, 4.0),
)
_REFLECTORS = st.lists(_FACETS, min_size=1, max_size=6, unique_by=lambda facet: facet.id).map(
    lambda facets: Reflector(16.0, tuple(facets))
)


def _assert_same(facets: tuple[Facet, ...], reflector: Reflector) -> None:
    assert [f.id for f in facets] == list(reflector.ids)
    for found, written in zip(facets, reflector.facets, strict=True):
        assert found.shape is written.shape
        np.testing.assert_allclose(found.position_m, written.position_m, atol=1e-8)  # 6 decimals of a cm
        assert found.focal_length_m == pytest.approx(written.focal_length_m, abs=1e-8)
        assert found.width_m == pytest.approx(written.width_m, abs=1e-8)


@given(_REFLECTORS, st.data())
def test_mars_round_trip(reflector: Reflector, data: st.DataObject) -> None:
    tilt = np.array([data.draw(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))) for _ in reflector.facets])
    normals = np.column_stack([tilt, np.ones(len(tilt))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    text = format_mars(reflector, normals)
    facet_list = parse_mars(text, "m.txt")
    _assert_same(facet_list.facets, reflector)
    assert facet_list.normals is not None
    np.testing.assert_allclose(facet_list.normals, normals, atol=0.51e-10)
    assert format_mars(Reflector(16.0, facet_list.facets), facet_list.normals) == text


@given(_REFLECTORS)
def test_sim_telarray_round_trip(reflector: Reflector) -> None:
    text = format_sim_telarray(reflector)
    facets = parse_sim_telarray(text, "s.dat", DISH).facets
    _assert_same(facets, reflector)
    assert format_sim_telarray(Reflector(16.0, facets)) == text


def test_both_writers_make_files_the_readers_take(tmp_path: Path) -> None:
    reflector = Reflector(4.889, parse_mars(MARS_ROW, "m.txt", [13]).facets)
    write_mars(tmp_path / "r.txt", reflector, reflector.aligned_normals())
    write_sim_telarray(tmp_path / "s.dat", reflector)
    _assert_same(read_mars(tmp_path / "r.txt").facets, reflector)
    _assert_same(read_sim_telarray(tmp_path / "s.dat", DISH).facets, reflector)


_ALMOST = st.lists(
    st.sampled_from(
        ["1", "-.5", "1e400", "nan", "60.6", "488.8", "Hex", "0.99", "#", "#% id=3", "\n", "\r", "٣", "0", " "]
    ),
    max_size=40,
).map(" ".join)


@given(st.text() | _ALMOST)
def test_any_text_parses_or_is_refused(text: str) -> None:
    for parse in (lambda: parse_mars(text, "m"), lambda: parse_sim_telarray(text, "s", DISH)):
        with suppress(ConfigError):
            assert len(parse().facets) >= 1
