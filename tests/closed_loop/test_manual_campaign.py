"""Campaigns by hand: what people are told, what they turn, and what is found of their mistakes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.build.twin_campaign import open_twin_campaign
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.motion import StopSwitch
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.cycle.campaign_parts import CampaignSettings, View
from namod_ctl.cycle.control import Request, RequestKind, send
from namod_ctl.cycle.manual import TurnKind, check_turns
from namod_ctl.cycle.record import RecordSettings
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.twin.operator import GONIOMETER_ERROR_RAD, TwinOperator
from namod_ctl.twin.settings import ReflectorSettings, TelescopeSettings, TwinSettings
from namod_ctl.twin.twin import Twin

MAX_RATIO = 1.10
"""Of the limit, after the first correction; the paper's own by hand: 2.60."""
IS_LONG = bool(os.environ.get("NAMOD_LONG_TESTS"))
FACT_SEEDS = (71, 72) if IS_LONG else (71,)
WORDS = {
    "not_done": "not turned",
    "wrong_direction": "turned in the wrong direction",
    "wrong_bolt": "bolts 1 and 2 mistaken for each other",
    "wrong_facet": "not turned",
    "half_done": "half done",
}

N_TELESCOPES = 12
GONIOMETER_DEG = 5.0
SLIGHT_DEG = 10.0
"""Two turns that differ by no more than this, of 3 deg error each, may be mistaken for each other by everybody."""
DOUBT_RAD = arcmin_to_rad(0.08)

# Eighteen of FACT's facets, and cameras with fewer pixels.
CONFIG = """
extends = "mini_fact"
telescope = { name = "Eighteen facets", focal_length_m = 4.889 }
reflector.layout = { width_m = 0.605, spacing_m = 0.620, inner_radius_m = 0.30, outer_radius_m = 1.30 }
mount = { radius_m = 0.295, pitch_mm_per_turn = 1.0, travel_limit_mm = 5.0 }
star_camera = { columns = 400, rows = 320 }
reflector_camera = { columns = 256, rows = 192, plate_scale_mdeg_per_px = 240.0 }
"""
SETTINGS = TwinSettings(
    reflector=ReflectorSettings(misalignment_rad=arcmin_to_rad(3.0)),
    telescope=TelescopeSettings(radius_rad=deg_to_rad(0.25), spacing_rad=arcmin_to_rad(1.5)),
)


class Crew(View):
    """People who mark what they have turned in two portions, and note what they see."""

    def __init__(self, campaign: Path) -> None:
        self.campaign = campaign
        self.twin: Twin | None = None
        self.ratios: list[float] = []
        self.told_texts: list[str] = []
        self.asked: list[list[int]] = []
        self._n_waits = 0

    def state(self, state: str, reason: str) -> None:
        if state == "reconstructing":
            assert self.twin is not None
            self.ratios.append(self.twin.reflector.a_sigma_now_rad2() / self.twin.reflector.a_sigma_aligned_rad2())
        elif state == "awaiting_operator":
            self._n_waits = 0

    def told(self, text: str) -> None:
        self.told_texts.append(text)

    def wait(self) -> None:
        with CampaignStore.open(self.campaign) as store:
            turns = store.turns()
        left = [turn.facet_id for turn in turns if not turn.is_done]
        if len(left) == len(turns):
            self.asked.append(left)
            self._mark(tuple(left[: len(left) // 2]))
        else:
            self._mark("all")

    def _mark(self, facet_ids: tuple[int, ...] | str) -> None:
        send(self.campaign, Request(kind=RequestKind.DONE, facet_ids=facet_ids), SystemClock())


def worked(
    folder: Path,
    config: InstrumentConfig,
    settings: TwinSettings,
    seed: int,
    n_records: int,
    mistakes: Mapping[int, str],
) -> Crew:
    """The crew of a campaign that has converged."""
    with CampaignStore.create(folder / "CAMPAIGN", config.to_json(), "a test", SystemClock()) as store:
        crew = Crew(store.path)
        wishes = CampaignSettings(RecordSettings(), n_records, max_cycles=4)
        clock, switch = SystemClock(), StopSwitch()
        with open_twin_campaign(store, config, settings, seed, wishes, clock, switch, crew, mistakes) as opened:
            crew.twin = opened.twin
            assert opened.campaign.run() == "converged", crew.told_texts
    return crew


def accused(told: Sequence[str]) -> dict[int, str]:
    """Facets that are said to be turned otherwise than asked, and how."""
    found = {}
    for text in told:
        head, _, words = text.partition(": ")
        if head.startswith("facet "):
            found[int(head.removeprefix("facet "))] = words
    return found


@pytest.mark.parametrize("seed", FACT_SEEDS)
def test_fact_is_aligned_by_hand_within_one_correction(tmp_path: Path, seed: int) -> None:
    """All 30 facets with a goniometer of 5 deg, set to 3 deg; nobody errs, and nobody is accused."""
    crew = worked(tmp_path, load_config("fact"), TwinSettings(), seed, 300, {})
    assert crew.ratios[0] > 4.0
    assert crew.ratios[1] <= MAX_RATIO
    assert not accused(crew.told_texts)
    sheets = next(text for text in crew.told_texts if "namod-ctl done" in text)
    assert (crew.campaign / "cycle_01" / "instructions.pdf").is_file()
    assert str(crew.campaign / "cycle_01" / "instructions.pdf") in sheets
    assert sum("15 to go" in text for text in crew.told_texts) == 1
    assert sum("all are done" in text for text in crew.told_texts) == 1


def one_of_each(twin: Twin) -> tuple[dict[int, str], int]:
    """Mistakes at the facets that need most turning, and the facet at which another's turns are made.

    No two are neighbours in the list of ids: a facet with another's mistakes on top of its own is another story.
    """
    off_rad = np.linalg.norm(twin.true_theta_rad - twin.true_theta_rad.mean(axis=0), axis=1)
    ids = list(twin.instrument.reflector.ids)
    mistakes: dict[int, str] = {}
    for k in np.argsort(-off_rad):
        near = {ids[k - 1], ids[k], ids[(k + 1) % len(ids)]}
        if len(mistakes) < len(WORDS) and not near & mistakes.keys():
            mistakes[ids[k]] = list(WORDS)[len(mistakes)]
    wrong = next(facet_id for facet_id, mistake in mistakes.items() if mistake == "wrong_facet")
    return mistakes, ids[(ids.index(wrong) + 1) % len(ids)]


def asked_of(twin: Twin) -> dict[int, np.ndarray]:
    """Turns that would align the facets, as a goniometer shows them; for those that need any."""
    tilts_rad = 0.5 * (twin.true_theta_rad.mean(axis=0) - twin.true_theta_rad)
    turns = {}
    for facet_id, tilt_rad in zip(twin.instrument.reflector.ids, tilts_rad, strict=True):
        mount = twin.instrument.mounts[facet_id]
        turns[facet_id] = GONIOMETER_DEG * np.round(
            mount.turn_deg_of_travel(mount.travel_of_tilt(tilt_rad)) / GONIOMETER_DEG
        )
    return {facet_id: turn for facet_id, turn in turns.items() if np.any(turn)}


def small_config(folder: Path) -> InstrumentConfig:
    path = folder / "config.toml"
    path.write_text(CONFIG)
    return load_config(str(path))


def test_no_mistake_is_taken_for_another_on_many_telescopes(tmp_path: Path) -> None:
    """Without cameras: what is seen is the truth, as well as 100 records tell it.

    A turn at one of three bolts tells little; where two stories fit, both are told, and that is right. Measured on 40
    telescopes (seeds 100 to 139): of 200 mistakes 172 named outright, 28 beside others, none missed or taken for
    another; of 480 other facets none accused.
    """
    config, n_named, n_made = small_config(tmp_path), 0, 0
    for seed in range(200, 200 + N_TELESCOPES):
        twin, rng = build_twin(config, SETTINGS, seed), np.random.default_rng(seed)
        mistakes, partner = one_of_each(twin)

        def seen(twin: Twin = twin, rng: np.random.Generator = rng) -> dict[int, tuple[np.ndarray, np.ndarray]]:
            theta_rad = twin.true_theta_rad + DOUBT_RAD * rng.standard_normal(twin.true_theta_rad.shape)
            cov = DOUBT_RAD**2 * np.eye(2)
            return {i: (theta, cov) for i, theta in zip(twin.instrument.reflector.ids, theta_rad, strict=True)}

        asked, before = asked_of(twin), seen()
        operator = TwinOperator(twin, seed, mistakes=mistakes)
        for facet_id, turns_deg in asked.items():
            operator.turn(facet_id, turns_deg)
        findings = check_turns(twin.instrument.mounts, asked, before, seen(), GONIOMETER_ERROR_RAD)
        found = {finding.facet_id: finding for finding in findings if finding.kind.is_mistake}
        slight = {
            facet_id
            for facet_id, mistake in mistakes.items()
            if mistake == "wrong_bolt" and abs(asked[facet_id][0] - asked[facet_id][1]) <= SLIGHT_DEG
        }
        assert {*mistakes, partner} - slight <= found.keys() <= {*mistakes, partner}, seed
        assert f"the turns of facet {next(i for i, m in mistakes.items() if m == 'wrong_facet')} were made here" in (
            found[partner].sentence
        )
        for facet_id, mistake in mistakes.items():
            if facet_id not in found:
                continue
            assert WORDS[mistake] in found[facet_id].sentence, (seed, mistake)
            n_made += 1
            n_named += found[facet_id].kind is not TurnKind.UNCLEAR
    assert n_named >= 0.7 * n_made


@pytest.mark.parametrize("seed", (81, 82) if IS_LONG else (81,))
def test_every_mistake_is_named_and_made_good_with_new_sheets(tmp_path: Path, seed: int) -> None:
    """One of each at the facets that need most turning; the turns of neighbours in the list of ids are not mixed up."""
    config = small_config(tmp_path)
    mistakes, partner = one_of_each(build_twin(config, SETTINGS, seed))
    crew = worked(tmp_path, config, SETTINGS, seed, 150, mistakes)
    second = crew.told_texts.index(next(text for text in crew.told_texts if "cycle_02" in text))
    found = accused(crew.told_texts[:second])
    assert found.keys() == {*mistakes, partner}
    for facet_id, mistake in mistakes.items():
        assert WORDS[mistake] in found[facet_id], (facet_id, mistake)
    assert "were made here" in found[partner]
    assert {*mistakes, partner} <= set(crew.asked[1])
    assert crew.ratios[1] > 1.5
    assert crew.ratios[-1] <= MAX_RATIO
