"""This program's own tables of facets and outlines."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.reflector import FacetShape
from namod_ctl.store.facet_tables import parse_facet_table, parse_polygon_table

HEADER = "facet_id,x_m,y_m,z_m,focal_length_m,shape,width_m,rotation_deg"
ROW = "13,-0.3163,1.6128,0.2580,4.901,hexagon,0.606,90.0"
MAP_HEADER = "facet_id,x_px,y_px"


def test_a_facet_table_is_read() -> None:
    (facet,) = parse_facet_table(f"# source\n{HEADER}\n# more\n{ROW}\n", "f.csv")
    assert facet.id == 13
    np.testing.assert_array_equal(facet.position_m, [-0.3163, 1.6128, 0.2580])
    assert facet.shape is FacetShape.HEXAGON
    assert facet.rotation_rad == np.pi / 2


def test_outlines_keep_order_and_may_have_any_number_of_corners() -> None:
    outlines = parse_polygon_table(f"{MAP_HEADER}\n9,1,2\n9,3,2\n9,3,4.5\n4,7,7\n", "p.csv")
    assert list(outlines) == [9, 4]
    np.testing.assert_array_equal(outlines[9], [[1, 2], [3, 2], [3, 4.5]])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (ROW, "the header must be"),
        ("", "has no rows"),
        (HEADER, "no rows below"),
        (HEADER.replace("x_m", "x_cm") + f"\n{ROW}", "the header must be 'facet_id,x_m"),
        (f"{HEADER}\n{ROW},1", "line 2: 9 columns, expected 8"),
        (f"{HEADER}\n{ROW.replace('13,', '-13,')}", r"line 2: column 1 \(facet_id\) holds '-13'"),
        (f"{HEADER}\n{ROW.replace('1.6128', '161.28')}", r"column 3 \(y_m\) holds 161\.28, allowed is -50 to 50 m"),
        (f"{HEADER}\n{ROW.replace('hexagon', 'octagon')}", r"'octagon', known are hexagon, square, round"),
        (f"{HEADER}\n{ROW.replace('0.606', '60.6')}", r"width_m\) holds 60\.6"),
        (f"{HEADER}\n{ROW}\n{ROW}", "more than once: 13"),
    ],
)
def test_bad_facet_tables_name_what_is_wrong(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        parse_facet_table(text, "f.csv")


def test_corners_of_one_facet_stand_together() -> None:
    with pytest.raises(ConfigError, match=r"p\.csv, line 4: the rows of facet 1 do not stand together"):
        parse_polygon_table(f"{MAP_HEADER}\n1,1,1\n2,1,1\n1,2,2\n", "p.csv")


_ALMOST = st.lists(st.sampled_from([HEADER, ROW, MAP_HEADER, "1,2,3", "1,nan,3", ",,", "#", "1,2"]), max_size=8)


@given(st.text() | _ALMOST.map("\n".join))
def test_any_text_parses_or_is_refused(text: str) -> None:
    with suppress(ConfigError):
        assert len(parse_facet_table(text, "any")) >= 1
    with suppress(ConfigError):
        assert len(parse_polygon_table(text, "any")) >= 1
