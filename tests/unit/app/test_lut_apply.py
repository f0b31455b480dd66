"""A look-up table turns facets by their motors: once, in order, and only where everything is known."""

from __future__ import annotations

import itertools
import json
import signal
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from lut_samples import (
    REFLECTOR,
    SEED,
    config,
    true_lut,
    twin_reflector,
    write_lut,
)
from rich.console import Console
from typer.testing import CliRunner

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.lut_motion import open_table_rig
from namod_ctl.app.commands.lut import app
from namod_ctl.app.end_signals import ended_in_order
from namod_ctl.app.lut.application import apply_table
from namod_ctl.app.lut.files import read_lut
from namod_ctl.calibration.gravity.gravity_table import GravityTable
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.drives import DriveState
from namod_ctl.core.errors import ConfigError, NamodError
from namod_ctl.core.motion import MoveOrder
from namod_ctl.core.units import deg_to_rad
from namod_ctl.cycle.control import ControlBox, Request, RequestKind, send
from namod_ctl.cycle.table_move import halted_legs, moved_legs, noted_baseline, noted_zenith_deg
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.twin.reflector import TwinReflector
from namod_ctl.twin.settings import TwinSettings

TWIN = TwinSettings(reflector=REFLECTOR), SEED


@pytest.fixture(scope="module")
def reflector() -> TwinReflector:
    return twin_reflector()


@pytest.fixture
def lut(reflector: TwinReflector, tmp_path: Path) -> Path:
    return write_lut(tmp_path / "LUT.json", true_lut(reflector))


def refusal(*words: object) -> str:
    """What a command that must be refused says."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert isinstance(result.exception, NamodError), result.output
    return str(result.exception)


def told_by(console: Console) -> str:
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def few_facets(table: GravityTable) -> GravityTable:
    """The first six facets: drives take their time."""
    first = slice(0, 6)
    return replace(
        table, facet_ids=table.facet_ids[first], beta_rad=table.beta_rad[first], cov_rad2=table.cov_rad2[first],
        is_moving=table.is_moving[first], light=table.light[first], variance_rad2=table.variance_rad2[first],
    )  # fmt: skip


def test_apply_refuses_what_it_cannot_know(lut: Path, tmp_path: Path) -> None:
    assert "lut bias" in refusal("apply", lut, "--zenith-deg", 40, "--config", "fact")
    assert "rests on runs" in refusal("apply", lut, "--zenith-deg", 80, "--twin")
    assert "say it once, --aligned-at-deg" in refusal("apply", lut, "--zenith-deg", 40, "--twin", "--yes")
    assert not (tmp_path / "LUT_moves").exists()
    assert "add --twin" in refusal("apply", lut, "--zenith-deg", 40, "--seed", 3)
    assert "above" in refusal("apply", lut, "--zenith-deg", 40, "--twin", "--from", "left")


def test_apply_turns_the_facets_once_and_keeps_the_image(lut: Path, tmp_path: Path) -> None:
    """The whole way on the twin: legs over real lines, A_sigma ray traced with its true facets."""
    journal = tmp_path / "moves"
    table, console = read_lut(lut).table, Console(file=StringIO(), soft_wrap=True)

    def go(zenith_deg: float, aligned_at_deg: float | None = None) -> bool:
        aligned = None if aligned_at_deg is None else deg_to_rad(aligned_at_deg)
        return apply_table(table, config(), deg_to_rad(zenith_deg), aligned, None, journal, TWIN, console, is_yes=True)

    assert go(65.0, 30.0)
    with CampaignStore.open(journal) as store:
        n_orders = len(store.orders())
        assert n_orders > 40
        assert not store.unfinished_orders()
        assert noted_zenith_deg(store) == pytest.approx(65.0)
    ratio = float(told_by(console).split("A_sigma is ")[-1].split(" times")[0])
    assert ratio < 1.03
    # the same words again move nothing
    assert go(65.0, 30.0)
    with CampaignStore.open(journal) as store:
        assert len(store.orders()) == n_orders
    with pytest.raises(ConfigError, match="knows that the facets were aligned at 30 deg"):
        go(65.0, 50.0)
    # somebody moves a leg by hand: what the legs stand for nobody knows
    with open_table_rig(journal, config(), SystemClock(), TWIN, is_new=False) as rig:
        known = noted_baseline(rig.store)
        assert known is not None
        states = rig.mover.read_states()
        tolerance_m = rig.settings.arrival_tolerance_m
        assert not moved_legs(rig.store, known, states, tolerance_m)
        leg, state = next(iter(states.items()))
        assert isinstance(state, DriveState)
        rig.mover.execute([MoveOrder(leg, state.position_m, state.position_m + 1e-4)], lambda _: None, lambda: None)
        (words,) = moved_legs(rig.store, known, rig.mover.read_states(), tolerance_m)
        assert words.startswith(f"{leg} stands at")
    with (
        pytest.raises(ConfigError, match="is the journal of a twin"),
        open_table_rig(journal, config(), SystemClock(), None, is_new=False),
    ):
        pass


def test_a_stop_from_another_terminal_halts_and_the_table_goes_on_later(
    lut: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = tmp_path / "moves"
    table, console = few_facets(read_lut(lut).table), Console(file=StringIO(), soft_wrap=True)
    look, looks = ControlBox.poll, itertools.count(1)

    def stop_on_the_way(box: ControlBox) -> list[Request]:
        if next(looks) == 6:
            send(journal, Request(kind=RequestKind.STOP), SystemClock())
        return look(box)

    monkeypatch.setattr(ControlBox, "poll", stop_on_the_way)

    def go(aligned_rad: float | None) -> bool:
        return apply_table(table, config(), deg_to_rad(60.0), aligned_rad, None, journal, TWIN, console, is_yes=True)

    assert not go(deg_to_rad(30.0))
    with CampaignStore.open(journal) as store:
        outcomes = [order.result.outcome.value for order in store.orders() if order.result is not None]
        assert noted_zenith_deg(store) is None
        assert not store.unfinished_orders()
    assert "stopped" in outcomes
    assert "Stopped: namod-ctl stop" in told_by(console)
    assert go(None)
    assert "in between, after a stop" in told_by(console)
    with CampaignStore.open(journal) as store:
        assert noted_zenith_deg(store) == pytest.approx(60.0)
        baseline = noted_baseline(store)
        at_m = {order.order.leg: order.result.readback_m for order in store.orders() if order.result is not None}
    assert baseline is not None
    mounts = build_instrument(config()).mounts
    tilts = table.tilt_change_rad(deg_to_rad(30.0), deg_to_rad(60.0))
    for leg, stands_m in at_m.items():
        travel_m = mounts[leg.facet_id].travel_of_tilt(tilts[table.facet_ids.index(leg.facet_id)])[leg.index]
        assert stands_m == pytest.approx(baseline.position_m[leg] + travel_m, abs=2e-6)


@pytest.mark.parametrize("end", [KeyboardInterrupt(), SystemExit(143)])
def test_an_interrupt_on_the_way_halts_and_is_journaled(
    end: BaseException, lut: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = tmp_path / "moves"
    table, console = few_facets(read_lut(lut).table), Console(file=StringIO(), soft_wrap=True)
    look, looks = ControlBox.poll, itertools.count(1)

    def interrupted(box: ControlBox) -> list[Request]:
        if next(looks) == 6:
            raise end
        return look(box)

    monkeypatch.setattr(ControlBox, "poll", interrupted)

    def go(aligned_rad: float | None) -> bool:
        return apply_table(table, config(), deg_to_rad(60.0), aligned_rad, None, journal, TWIN, console, is_yes=True)

    with pytest.raises(type(end)):
        go(deg_to_rad(30.0))
    assert "Stopped: " in told_by(console)
    with CampaignStore.open(journal) as store:
        assert store.events()[-1].kind == "lut_stopped"
        assert not store.unfinished_orders()
        assert noted_zenith_deg(store) is None
        assert halted_legs(store)
    assert go(None)
    with CampaignStore.open(journal) as store:
        assert noted_zenith_deg(store) == pytest.approx(60.0)


def test_a_closed_terminal_ends_it_in_order_and_nohup_is_heeded() -> None:
    with pytest.raises(SystemExit), ended_in_order():
        signal.raise_signal(signal.SIGHUP)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ended_in_order():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_table_of_other_facets_is_refused(reflector: TwinReflector, tmp_path: Path) -> None:
    huge = true_lut(reflector)
    path = tmp_path / "LUT.json"
    text = json.loads(write_lut(path, huge).read_text())
    left_out = text["facets"].pop()["id"]
    path.write_text(json.dumps(text))
    assert f"has other facets than the config of FACT: {left_out}" in refusal(
        "apply", path, "--zenith-deg", 40, "--aligned-at-deg", 20, "--twin", "--yes"
    )


def test_a_leg_that_would_go_too_far_leaves_its_whole_facet(reflector: TwinReflector, tmp_path: Path) -> None:
    huge = true_lut(reflector)
    beta = huge.table.beta_rad.copy()
    beta[4, 1] = deg_to_rad(3.0)
    table = few_facets(replace(huge.table, beta_rad=beta))
    console = Console(file=StringIO(), soft_wrap=True)
    journal = tmp_path / "moves"
    done = apply_table(table, config(), deg_to_rad(60.0), deg_to_rad(10.0), None, journal, TWIN, console, is_yes=True)
    assert not done
    facet_id = table.facet_ids[4]
    assert f"Facet {facet_id} stays as it is: leg" in told_by(console)
    with CampaignStore.open(journal) as store:
        turned = {order.order.leg.facet_id for order in store.orders()}
    assert facet_id not in turned
    assert turned == set(table.facet_ids) - {facet_id}
