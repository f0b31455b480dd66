"""Whole campaigns on the twin: how near to its limit each telescope is brought, in how many cycles and how long.

Run: python benchmarks/bench_align.py [--seeds 1001,1002,...] [--configs fact_actuated,...] [--records 400]

Every seed is another telescope: other misalignments, mirrors, motors' zeros, paths over the sky. Real protocol bytes
on real lines (see the configs). Beside it the paper's figure for one correction of the real FACT by hand: 2.60 times
the limit (arXiv:1605.06274).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from namod_ctl.app.build.twin_campaign import open_twin_campaign
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.motion import StopSwitch
from namod_ctl.core.units import rad2_to_arcmin2
from namod_ctl.cycle.campaign_parts import CampaignSettings, View
from namod_ctl.cycle.record import RecordSettings
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.twin.settings import FaultSpec, TwinSettings

PAPER_RATIO = 2.60
CLOUDS = TwinSettings(faults=(FaultSpec("clouds"),))


def campaign(config_name: str, seed: int, settings: TwinSettings, n_records: int, folder: Path) -> tuple[str, float]:
    """One line of the table, and the final ratio."""
    config = load_config(config_name)
    with CampaignStore.create(folder, config.to_json(), "", SystemClock()) as store:
        wishes = CampaignSettings(RecordSettings(), n_records=n_records)
        began_s = time.monotonic()
        with open_twin_campaign(store, config, settings, seed, wishes, SystemClock(), StopSwitch(), View()) as opened:
            reflector = opened.twin.reflector
            before_rad2 = reflector.a_sigma_now_rad2()
            state = opened.campaign.run()
            after_rad2, limit_rad2 = reflector.a_sigma_now_rad2(), reflector.a_sigma_aligned_rad2()
        took_s = time.monotonic() - began_s
        ratio = after_rad2 / limit_rad2
        sky = "clouds" if settings.faults else "clear"
        return (
            f"{config_name:16s}{sky:8s}{seed:6d}{rad2_to_arcmin2(before_rad2):10.2f}{rad2_to_arcmin2(after_rad2):9.2f}"
            f"{rad2_to_arcmin2(limit_rad2):8.2f}{ratio:8.3f}{len(store.cycles()):8d}{took_s:8.0f}  {state}"
        ), ratio


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", default=",".join(str(seed) for seed in range(1001, 1021)))
    parser.add_argument("--configs", default="fact_actuated")
    parser.add_argument("--records", type=int, default=400)
    parser.add_argument("--clouds", action="store_true", help="clouds of factor 30 all night")
    arguments = parser.parse_args()
    print("A_sigma in arcmin2, by ray tracing the twin's true facets; limit: the same facets perfectly aligned")
    print(
        f"{'config':16s}{'sky':8s}{'seed':>6s}{'before':>10s}{'after':>9s}{'limit':>8s}{'ratio':>8s}{'cycles':>8s}{'s':>8s}"
    )
    ratios = []
    for config_name in arguments.configs.split(","):
        for seed in map(int, arguments.seeds.split(",")):
            with tempfile.TemporaryDirectory() as folder:
                settings = CLOUDS if arguments.clouds else TwinSettings()
                line, ratio = campaign(config_name, seed, settings, arguments.records, Path(folder) / "campaign")
            print(line, flush=True)
            ratios.append(ratio)
    print(f"worst ratio {max(ratios):.3f}; the paper, by hand on the real telescope: {PAPER_RATIO:.2f}")


if __name__ == "__main__":
    main()
