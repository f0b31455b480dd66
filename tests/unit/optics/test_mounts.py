"""Mounts: against hand-worked legs, an independent pose by scipy, and round trips."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.mounts import Mount


def on_circle(radius_m: float, *azimuth_deg: float) -> np.ndarray:
    azimuth = np.radians(azimuth_deg)
    return radius_m * np.column_stack([np.cos(azimuth), np.sin(azimuth)])


TRIPOD = Mount(on_circle(0.295, 0, 120, 240), False, 0.01, pitch_m_per_turn=0.001)
UNEVEN = Mount(np.array([[0.3, 0.0], [0.0, 0.2], [0.1, -0.4]]), False, 0.01)
FOUR = Mount(on_circle(0.3, 10, 100, 190, 280), False, 0.01)
TWO_ACTUATORS = Mount(np.array([[0.3, 0.05], [-0.02, 0.4]]), True, 0.02)
HEXAPOD = Mount(
    on_circle(0.3, -10, 10, 110, 130, 230, 250),
    False,
    0.03,
    base_joints_m=np.column_stack([on_circle(0.4, -50, 50, 70, 170, 190, 290), np.full(6, -0.3)]),
)
PINNED_ACTUATORS = Mount(
    TWO_ACTUATORS.legs_m, True, 0.02, base_joints_m=np.array([[0.35, 0.05, -0.4], [-0.02, 0.5, -0.3]])
)
ALL = {
    "tripod": TRIPOD,
    "uneven tripod": UNEVEN,
    "four legs": FOUR,
    "two actuators": TWO_ACTUATORS,
    "hexapod": HEXAPOD,
    "two inclined actuators": PINNED_ACTUATORS,
}
TILTS = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)).map(np.array)


def pose_lengths(mount: Mount, tilt: np.ndarray, shift: np.ndarray, turn_rad: float) -> np.ndarray:
    """Change of the leg lengths of a pose, built by scipy from rotation vectors."""
    normal = np.append(tilt, 1.0) / np.linalg.norm(np.append(tilt, 1.0))
    axis = np.cross([0.0, 0.0, 1.0], normal)
    sine = np.linalg.norm(axis)
    lean = Rotation.from_rotvec(axis / sine * np.arcsin(sine) if sine > 0 else axis)
    upper = np.column_stack([mount.legs_m, np.zeros(len(mount.legs_m))])
    assert mount.base_joints_m is not None
    moved = (lean * Rotation.from_rotvec([0.0, 0.0, turn_rad])).apply(upper) + shift
    return np.linalg.norm(moved - mount.base_joints_m, axis=1) - np.linalg.norm(upper - mount.base_joints_m, axis=1)


@pytest.mark.parametrize("name", ALL)
def test_sound_mounts_are_accepted(name: str) -> None:
    ALL[name].check_geometry(name)


@pytest.mark.parametrize("name", ALL)
@given(tilt=TILTS)
def test_what_the_legs_do_is_the_tilt_that_was_asked(name: str, tilt: np.ndarray) -> None:
    """To 1 nrad: a millionth of what matters."""
    mount = ALL[name]
    np.testing.assert_allclose(mount.tilt_of_travel(mount.travel_of_tilt(tilt)), tilt, atol=1e-9)


def test_a_leg_at_plus_x_goes_down_when_the_normal_leans_to_plus_x() -> None:
    """Design section 2: delta = -(Phi_x p_x + Phi_y p_y). 1 mrad on 0.295 m: 0.295 mm, a turn of 106.2 deg at 1 mm."""
    travel = TRIPOD.travel_of_tilt(np.array([0.001, 0.0]))
    np.testing.assert_allclose(travel, [-0.295e-3, 0.1475e-3, 0.1475e-3], atol=1e-15)
    np.testing.assert_allclose(TRIPOD.turn_deg_of_travel(travel), [-106.2, 53.1, 53.1], atol=1e-9)


@given(tilt=TILTS)
def test_turns_of_a_symmetric_tripod_add_up_to_zero(tilt: np.ndarray) -> None:
    """As the three published turns of every FACT facet do."""
    assert TRIPOD.turn_deg_of_travel(TRIPOD.travel_of_tilt(tilt)).sum() == pytest.approx(0.0, abs=1e-9)


@given(tilt=TILTS)
def test_straight_legs_end_on_the_tilted_plane(tilt: np.ndarray) -> None:
    """The legs' ends span a plane; its normal by the cross product is that of the tilt, at any angle."""
    ends = np.column_stack([UNEVEN.legs_m, UNEVEN.travel_of_tilt(tilt)])
    normal = np.cross(ends[1] - ends[0], ends[2] - ends[0])
    np.testing.assert_allclose(normal[:2] / normal[2], tilt, atol=1e-12)


def test_the_free_height_is_chosen_for_least_travel() -> None:
    travel = UNEVEN.travel_of_tilt(np.array([0.002, -0.003]))
    least = np.sum(travel**2)
    for piston in (-1e-5, 1e-5):
        assert np.sum((travel + piston) ** 2) > least


def test_a_fixed_point_leaves_no_height_to_choose() -> None:
    tilt = np.array([0.01, -0.02])
    np.testing.assert_allclose(TWO_ACTUATORS.travel_of_tilt(tilt), [-0.003 + 0.001, 0.0002 + 0.008], atol=1e-15)


@pytest.mark.parametrize("tilt", [(0.01, 0.0), (-0.02, 0.03), (0.0, -0.05)])
def test_hexapod_legs_have_the_lengths_of_a_pose_of_least_travel(tilt: tuple[float, float]) -> None:
    """An independent search over shifts and turn, on poses built by scipy, ends at the same lengths."""
    wanted = np.array(tilt)
    travel = HEXAPOD.travel_of_tilt(wanted)

    def cost(free: np.ndarray) -> float:
        return 1e6 * float(np.sum(pose_lengths(HEXAPOD, wanted, 0.1 * free[:3], free[3]) ** 2))

    best = minimize(cost, np.zeros(4), method="BFGS", options={"gtol": 1e-6})
    assert 1e6 * np.sum(travel**2) == pytest.approx(best.fun, rel=1e-6)
    np.testing.assert_allclose(
        travel, pose_lengths(HEXAPOD, wanted, 0.1 * best.x[:3], best.x[3]), atol=1e-6
    )  # flat minimum of the search: 1 um


@given(tilt=TILTS, turn=st.floats(-0.03, 0.03), shift=st.tuples(*[st.floats(-0.01, 0.01)] * 3))
def test_a_hexapod_tells_its_tilt_from_any_pose(
    tilt: np.ndarray, turn: float, shift: tuple[float, float, float]
) -> None:
    travel = pose_lengths(HEXAPOD, tilt, np.array(shift), turn)
    np.testing.assert_allclose(HEXAPOD.tilt_of_travel(travel), tilt, atol=1e-9)


def test_bolts_that_rise_counter_clockwise_turn_the_other_way() -> None:
    other = Mount(TRIPOD.legs_m, False, 0.01, pitch_m_per_turn=0.001, turn_raises_leg="counterclockwise")
    np.testing.assert_allclose(other.turn_deg_of_travel(np.array([0.0005])), [-180.0])
    np.testing.assert_allclose(TRIPOD.turn_deg_of_travel(np.array([0.0005])), [180.0])
    assert HEXAPOD.turn_deg_of_travel(np.ones(6)).shape == (0,)


def test_a_travel_beyond_the_limit_is_named_not_clipped() -> None:
    travel = TRIPOD.travel_of_tilt(np.array([0.05, 0.0]))
    assert travel[0] == pytest.approx(-0.05 * 0.295)
    assert TRIPOD.limit_violations(travel) == ("leg 1 would travel -14.750 mm, beyond its limit of 10.000 mm",)
    assert TRIPOD.limit_violations(np.array([0.01, -0.01, 0.0])) == ()


def test_no_estimate_gives_no_travel() -> None:
    for mount in (TRIPOD, HEXAPOD):
        assert np.isnan(mount.travel_of_tilt(np.full(2, np.nan))).all()
        assert np.isnan(mount.tilt_of_travel(np.full(len(mount.legs_m), np.nan))).all()


@pytest.mark.parametrize(
    ("mount", "reason"),
    [
        (Mount(np.array([[0.1, 0.1], [0.0, 0.0], [-0.2, -0.2]]), False, 0.01), "on one line"),
        (Mount(np.array([[0.3, 0.0], [0.3, 0.0], [0.0, 0.3]]), False, 0.01), "at one place"),
        (Mount(np.array([[0.3, 0.0], [0.0, 0.3]]), False, 0.01), "2 straight legs without a fixed point"),
        (Mount(np.array([[0.3, 0.0], [-0.3, 0.0]]), True, 0.01), "on one line"),
        (Mount(np.zeros((3, 2)), False, 0.01), "at one place"),
        (Mount(np.empty((0, 2)), True, 0.01), "shapes"),
        (Mount(HEXAPOD.legs_m[:3], False, 0.01, base_joints_m=np.full((3, 3), -0.2)), "3 inclined legs"),
        (
            Mount(HEXAPOD.legs_m, False, 0.01, base_joints_m=np.column_stack([HEXAPOD.legs_m, np.full(6, -0.3)])),
            "singular hexapod",
        ),
        (  # every leg in a plane with the normal: nothing holds the facet against turning about it
            Mount(
                HEXAPOD.legs_m,
                False,
                0.01,
                base_joints_m=np.column_stack(
                    [HEXAPOD.legs_m * np.array([[2.0, 0.4, 1.7, 0.3, 1.9, 0.5]]).T, np.full(6, -0.3)]
                ),
            ),
            "singular hexapod",
        ),
        (Mount(HEXAPOD.legs_m, False, 0.01, base_joints_m=np.zeros((5, 3))), "shapes"),
        (
            Mount(np.array([[0.3, 0.0], [0.0, 0.3]]), True, 0.01, base_joints_m=np.array([[0.3, 0, 0], [0, 0, -1]])),
            "no length",
        ),
    ],
)
def test_legs_that_cannot_hold_a_facet_are_refused(mount: Mount, reason: str) -> None:
    with pytest.raises(ConfigError, match=f"lower ring: .*{reason}"):
        mount.check_geometry("lower ring")
