"""The result of a reconstruction as files: alignment.json for programs, facets.ecsv for tables."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import FACET_FLAG_MEANING, FacetFlag
from namod_ctl.core.units import (
    arcmin2_to_rad2,
    deg2_to_rad2,
    deg_to_rad,
    rad2_to_arcmin2,
    rad2_to_deg2,
    rad_to_deg,
)
from namod_ctl.reconstruction.alignment import Alignment, AreaOfPsf, BadRecord, FacetAlignment
from namod_ctl.store.frames import write_file_durably

ALIGNMENT_FILE = "alignment.json"
FACET_TABLE_FILE = "facets.ecsv"

_Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]


class _Section(BaseModel):
    """A part of the file: every key is known, none is missing, no number is written as text."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=True)


class _Areas(_Section):
    now: _Number
    now_uncertainty: _Number
    predicted_after_correction: _Number
    predicted_after_correction_uncertainty: _Number


class _Area(_Section):
    now: _Number
    now_uncertainty: _Number


class _BadRecord(_Section):
    index: int
    kind: str
    detail: str
    facet_ids: list[int]


class _Facet(_Section):
    id: int
    theta_x_deg: _Number
    theta_y_deg: _Number
    theta_cov_deg2: Annotated[
        list[Annotated[list[_Number], Field(min_length=2, max_length=2)]], Field(min_length=2, max_length=2)
    ]
    tilt_correction_x_rad: _Number
    tilt_correction_y_rad: _Number
    width_major_deg: _Number
    width_minor_deg: _Number
    flux_deg2: _Number
    background: _Number
    n_records_in_psf: int
    flags: list[str]
    leg_travel_m: list[_Number]
    bolt_turn_deg: list[_Number]
    remarks: list[str]


class _AlignmentFile(_Section):
    schema_name: Literal["namod-alignment/1"] = Field(alias="schema")
    telescope: str
    n_records: int
    n_used: int
    estimator: str
    a_sigma_arcmin2: _Areas
    a_sigma_all_records_arcmin2: _Area
    axis_deg: Annotated[list[_Number], Field(min_length=2, max_length=2)]
    facets: list[_Facet]
    bad_records: list[_BadRecord]
    facets_not_in_run: list[int]
    remarks: list[str]


def _facet_section(facet: FacetAlignment) -> _Facet:
    theta_deg = rad_to_deg(facet.theta_rad)
    return _Facet(
        id=facet.facet_id,
        theta_x_deg=float(theta_deg[0]),
        theta_y_deg=float(theta_deg[1]),
        theta_cov_deg2=rad2_to_deg2(facet.theta_cov_rad2).tolist(),
        tilt_correction_x_rad=float(facet.tilt_correction_rad[0]),
        tilt_correction_y_rad=float(facet.tilt_correction_rad[1]),
        width_major_deg=float(rad_to_deg(facet.width_major_rad)),
        width_minor_deg=float(rad_to_deg(facet.width_minor_rad)),
        flux_deg2=float(rad2_to_deg2(facet.flux)),
        background=float(facet.background),
        n_records_in_psf=int(facet.n_records_in_psf),
        flags=list(facet.flags.names),
        leg_travel_m=[float(travel_m) for travel_m in facet.leg_travel_m],
        bolt_turn_deg=[float(turn_deg) for turn_deg in facet.bolt_turn_deg],
        remarks=list(facet.remarks),
    )


def _null_for_nan(value: object) -> object:
    """JSON knows no NaN and no infinity: where there is no number, the file says null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _null_for_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_null_for_nan(item) for item in value]
    return value


def alignment_to_json(alignment: Alignment) -> str:
    """Text of alignment.json, schema "namod-alignment/1"; null where the alignment has NaN."""
    file = _AlignmentFile(
        schema="namod-alignment/1",
        telescope=alignment.telescope,
        n_records=int(alignment.n_records),
        n_used=int(alignment.n_used),
        estimator=alignment.estimator,
        a_sigma_arcmin2=_Areas(
            now=float(rad2_to_arcmin2(alignment.now.a_sigma_rad2)),
            now_uncertainty=float(rad2_to_arcmin2(alignment.now.uncertainty_rad2)),
            predicted_after_correction=float(rad2_to_arcmin2(alignment.predicted.a_sigma_rad2)),
            predicted_after_correction_uncertainty=float(rad2_to_arcmin2(alignment.predicted.uncertainty_rad2)),
        ),
        a_sigma_all_records_arcmin2=_Area(
            now=float(rad2_to_arcmin2(alignment.now_all_records.a_sigma_rad2)),
            now_uncertainty=float(rad2_to_arcmin2(alignment.now_all_records.uncertainty_rad2)),
        ),
        axis_deg=[float(angle_deg) for angle_deg in rad_to_deg(alignment.axis_rad)],
        facets=[_facet_section(facet) for facet in alignment.facets],
        bad_records=[
            _BadRecord(
                index=int(record.index),
                kind=record.kind,
                detail=record.detail,
                facet_ids=[int(facet_id) for facet_id in record.facet_ids],
            )
            for record in alignment.bad_records
        ],
        facets_not_in_run=[int(facet_id) for facet_id in alignment.facets_not_in_run],
        remarks=list(alignment.remarks),
    )
    return json.dumps(_null_for_nan(file.model_dump(by_alias=True)), indent=1, allow_nan=False) + "\n"


def _flags_of_names(names: Sequence[str], facet_id: int, source: str) -> FacetFlag:
    flags = FacetFlag.NONE
    for name in names:
        try:
            flags |= FacetFlag[name]
        except KeyError:
            known = ", ".join(flag.name or "" for flag in FacetFlag)
            raise ConfigError(
                f"{source}: facet {facet_id}: flags: {name!r} is no flag of this program (known: {known}); "
                "write the file anew with `namod-ctl reconstruct`"
            ) from None
    return flags


def _facet_of_section(section: _Facet, source: str) -> FacetAlignment:
    return FacetAlignment(
        facet_id=section.id,
        theta_rad=deg_to_rad(np.array([section.theta_x_deg, section.theta_y_deg])),
        theta_cov_rad2=deg2_to_rad2(np.array(section.theta_cov_deg2)),
        width_major_rad=deg_to_rad(section.width_major_deg),
        width_minor_rad=deg_to_rad(section.width_minor_deg),
        flux=deg2_to_rad2(section.flux_deg2),
        background=section.background,
        n_records_in_psf=section.n_records_in_psf,
        flags=_flags_of_names(section.flags, section.id, source),
        tilt_correction_rad=np.array([section.tilt_correction_x_rad, section.tilt_correction_y_rad]),
        leg_travel_m=np.array(section.leg_travel_m),
        bolt_turn_deg=np.array(section.bolt_turn_deg),
        remarks=tuple(section.remarks),
    )


def _area_of_section(area_arcmin2: float, uncertainty_arcmin2: float) -> AreaOfPsf:
    return AreaOfPsf(arcmin2_to_rad2(area_arcmin2), arcmin2_to_rad2(uncertainty_arcmin2))


def alignment_from_json(text: str, source: str) -> Alignment:
    """The alignment that was written as `text`; null becomes NaN.

    Raises
    ------
    ConfigError
        Not JSON, another schema, or a key that is missing, unknown or of another type; names `source` and the key.
    """
    try:
        file = _AlignmentFile.model_validate(json.loads(text))
    except (json.JSONDecodeError, RecursionError) as error:
        raise ConfigError(
            f"{source}: not readable as JSON ({error}); write it anew with `namod-ctl reconstruct`"
        ) from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "(whole file)"
        raise ConfigError(
            f"{source}: key {key}: {first['msg']} (value: {str(first['input'])[:80]}); "
            "write it anew with `namod-ctl reconstruct`"
        ) from None
    areas, all_records = file.a_sigma_arcmin2, file.a_sigma_all_records_arcmin2
    return Alignment(
        telescope=file.telescope,
        estimator=file.estimator,
        n_records=file.n_records,
        n_used=file.n_used,
        axis_rad=deg_to_rad(np.array(file.axis_deg)),
        now=_area_of_section(areas.now, areas.now_uncertainty),
        now_all_records=_area_of_section(all_records.now, all_records.now_uncertainty),
        predicted=_area_of_section(areas.predicted_after_correction, areas.predicted_after_correction_uncertainty),
        facets=tuple(_facet_of_section(section, source) for section in file.facets),
        bad_records=tuple(
            BadRecord(record.index, record.kind, record.detail, tuple(record.facet_ids)) for record in file.bad_records
        ),
        facets_not_in_run=tuple(file.facets_not_in_run),
        remarks=tuple(file.remarks),
    )


def _per_leg(arrays: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Shape (n_facets, most legs); NaN where a facet has fewer legs than another."""
    columns = np.full((len(arrays), max((len(array) for array in arrays), default=0)), np.nan)
    for row, array in zip(columns, arrays, strict=True):
        row[: len(array)] = array
    return columns


def facet_table(alignment: Alignment) -> QTable:
    """One row per facet with units and descriptions; NaN where there is no estimate."""
    facets = alignment.facets
    theta_rad = np.array([facet.theta_rad for facet in facets]).reshape(-1, 2)
    cov_rad2 = np.array([facet.theta_cov_rad2 for facet in facets]).reshape(-1, 2, 2)
    sigma_rad = np.sqrt(np.diagonal(cov_rad2, axis1=1, axis2=2))
    correction_rad = np.array([facet.tilt_correction_rad for facet in facets]).reshape(-1, 2)
    travel_m = _per_leg([facet.leg_travel_m for facet in facets])
    turn_deg = _per_leg([facet.bolt_turn_deg for facet in facets])
    table = QTable()

    def add(name: str, values: object, description: str) -> None:
        table[name] = values
        table[name].info.description = description

    add("facet_id", [facet.facet_id for facet in facets], "number of the facet")
    for axis, name in enumerate(("theta_x", "theta_y")):
        add(name, (theta_rad[:, axis] * u.rad).to(u.deg), f"{name} of the star when the facet is brightest")
        add(f"{name}_uncertainty", (sigma_rad[:, axis] * u.rad).to(u.deg), f"one standard deviation of {name}")
    add("theta_xy_cov", (cov_rad2[:, 0, 1] * u.rad**2).to(u.deg**2), "covariance of theta_x and theta_y")
    for axis, name in enumerate(("tilt_correction_x", "tilt_correction_y")):
        add(name, correction_rad[:, axis] * u.rad, "to be added to the facet's normal: Phi = -(theta - aim) / 2")
    for name, widths_rad in (
        ("width_major", [facet.width_major_rad for facet in facets]),
        ("width_minor", [facet.width_minor_rad for facet in facets]),
    ):
        add(name, (np.array(widths_rad) * u.rad).to(u.deg), "standard deviation of the facet's PSF along this axis")
    flux_rad2 = np.array([facet.flux for facet in facets])
    add("flux", (flux_rad2 * u.rad**2).to(u.deg**2), "integral of the normalized response over directions")
    add("background", np.array([facet.background for facet in facets]), "normalized response of the unlit facet")
    add("n_records_in_psf", [facet.n_records_in_psf for facet in facets], "records that lit the facet")
    for leg in range(travel_m.shape[1]):
        add(f"leg_{leg + 1}_travel", (travel_m[:, leg] * u.m).to(u.mm), "travel along +z (to the sky)")
    for leg in range(turn_deg.shape[1]):
        add(
            f"bolt_{leg + 1}_turn",
            turn_deg[:, leg] * u.deg,
            "turn, positive is clockwise as seen by who turns",
        )
    add("flags", ["|".join(facet.flags.names) for facet in facets], "what stands against the estimate; see meta")
    add("remarks", ["; ".join(facet.remarks) for facet in facets], "for people")
    table.meta = _table_meta(alignment)
    return table


def _table_meta(alignment: Alignment) -> dict[str, object]:
    """What belongs to the whole table: short keys, so that FITS headers can carry them too."""
    return {
        "TELESCOP": alignment.telescope,
        "ESTIMATE": alignment.estimator,
        "NRECORDS": int(alignment.n_records),
        "NUSED": int(alignment.n_used),
        "FRAME": "telescope: +x right, +y up, seen from the focal point down at the reflector",
        "comments": [f"{flag.name}: {meaning}" for flag, meaning in FACET_FLAG_MEANING.items()],
    }


def table_to_ecsv(table: QTable) -> bytes:
    """The table as ECSV text."""
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    return text.getvalue().encode()


def table_to_fits(table: QTable) -> bytes:
    """The table as a FITS file with one binary table."""
    data = io.BytesIO()
    table.write(data, format="fits")
    return data.getvalue()


def alignment_files(alignment: Alignment) -> dict[str, bytes]:
    """alignment.json and the facet table, by file name."""
    return {
        FACET_TABLE_FILE: table_to_ecsv(facet_table(alignment)),
        ALIGNMENT_FILE: alignment_to_json(alignment).encode(),
    }


def write_alignment(run_dir: Path, alignment: Alignment) -> None:
    """Write alignment.json and facets.ecsv into the run's folder, each of them whole or not at all.

    Raises
    ------
    OSError
        The disk is full or the folder may not be written; the file in question is as it was.
    """
    text = alignment_to_json(alignment)
    write_file_durably(run_dir / FACET_TABLE_FILE, table_to_ecsv(facet_table(alignment)))
    write_file_durably(run_dir / ALIGNMENT_FILE, text.encode())


def read_alignment(run_dir: Path) -> Alignment:
    """The alignment of a run's folder.

    Raises
    ------
    ConfigError
        There is none yet, or the file is not one of this program.
    """
    path = run_dir / ALIGNMENT_FILE
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"{path}: there is no such file; run `namod-ctl reconstruct {run_dir}` first") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file ({error}); run `namod-ctl reconstruct {run_dir}` anew") from None
    return alignment_from_json(text, str(path))
