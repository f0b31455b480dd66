"""A run put on newer calibrations of its cameras: which ones it then has, and what that changes."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from namod_ctl.app.config.calibration_schema import Calibration
from namod_ctl.app.config.calibrations import calibration_problems, calibrations_of, read_calibration
from namod_ctl.app.config.instrument import CAMERA_SECTIONS, InstrumentConfig
from namod_ctl.app.reconstruction_report import area_text
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.records import Record
from namod_ctl.core.units import rad_to_arcmin
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.drift import drift_between

NOTE_REREDUCED = "rereduced"
"""Key of the note with which run and which calibrations a run was re-reduced from."""


def recalibrated_config(
    config: InstrumentConfig, files: Sequence[Path], accepted: tuple[str, ...], recorded: datetime
) -> InstrumentConfig:
    """The config with these calibrations in place of those of the same kind and camera that it has.

    A calibration made later than `recorded` is welcome; one that had expired by then is not.

    Raises
    ------
    ConfigError
        A file is no calibration, two are of one kind, or one may not be used for this camera: all problems together.
    """
    new: dict[str, list[Calibration]] = {}
    for path in files:
        calibration = read_calibration(path)
        if calibration.camera not in CAMERA_SECTIONS:
            raise ConfigError(
                f"{path}: is of the {calibration.camera}, which no record depends on; name calibrations of "
                f"{' or '.join(CAMERA_SECTIONS)}"
            )
        of_camera = new.setdefault(calibration.camera, [])
        if any(other.kind == calibration.kind for other in of_camera):
            raise ConfigError(f"{path}: a second {calibration.kind} calibration of the {calibration.camera}; name one")
        of_camera.append(calibration)
    update: dict[str, object] = {}
    problems: list[str] = []
    for role in CAMERA_SECTIONS:
        if role not in new:
            continue
        section = getattr(config, role)
        kinds = {calibration.kind for calibration in new[role]}
        kept = [calibration for calibration in calibrations_of(section) if calibration.kind not in kinds]
        changed = section.model_copy(
            update={
                "calibrations": (*kept, *new[role]),
                "accept_calibrations": tuple(sorted({*accepted, *(section.accept_calibrations or ())})) or None,
            }
        )
        update[role] = changed
        problems += [f"{role}: {problem}" for problem in calibration_problems(changed, role, recorded)]
    if problems:
        text = "\n".join(problems)
        raise ConfigError(text.replace("accept_calibrations = [", "--accept [").replace('["', "").replace('"]', ""))
    return config.model_copy(update=update)


def count_text(records: Sequence[Record]) -> str:
    """How many of the records count."""
    n_counting = sum(record.reject_reason is None for record in records)
    return f"{n_counting} of {len(records)} records count"


def comparison_text(
    old: Alignment, new: Alignment, old_records: Sequence[Record], new_records: Sequence[Record]
) -> str:
    """What the newer calibrations changed, as plain text. Both alignments are of the same light: no facet moved."""
    lines = [
        "                            before                      with the new calibrations",
        f"records                     {count_text(old_records):27s} {count_text(new_records)}",
        f"used                        {old.n_used:<27d} {new.n_used}",
        f"A_sigma now                 {area_text(old.now):27s} {area_text(new.now)}",
        f"predicted after correction  {area_text(old.predicted):27s} {area_text(new.predicted)}",
    ]
    try:
        drift = drift_between(old, new)
    except DataQualityError as problem:
        return "\n".join([*lines, f"The facets cannot be compared: {problem}"]) + "\n"
    distance = rad_to_arcmin(np.array([np.hypot(*facet.drift_rad) for facet in drift.facets]))
    known = np.isfinite(distance)
    shift = rad_to_arcmin(drift.shift_rad)
    lines += [
        f"All facets together moved in the star camera by ({shift[0]:+.3f}, {shift[1]:+.3f}) arcmin.",
    ]
    if known.any():
        worst = drift.facets[int(np.nanargmax(distance))]
        doubt = rad_to_arcmin(np.sqrt(np.trace(worst.second.theta_cov_rad2) / 2.0))
        lines.append(
            f"Apart from that a facet's direction changed by {np.median(distance[known]):.3f} arcmin (median), at most "
            f"{np.max(distance[known]):.3f} (facet {worst.facet_id}, known to {doubt:.2f})."
        )
    changed = [
        str(facet.facet_id)
        for facet in drift.facets
        if _may_be_turned(facet.first.flags) != _may_be_turned(facet.second.flags)
    ]
    if changed:
        lines.append(f"Facets that may be turned now and not before, or the other way: {', '.join(changed)}.")
    return "\n".join(lines) + "\n"


def _may_be_turned(flags: FacetFlag) -> bool:
    return not flags.forbids_turning
