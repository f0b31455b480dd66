"""The look-up table over zenith distance as a file, schema "namod-lut/1"."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from namod_ctl import __version__
from namod_ctl.calibration.gravity.gravity_table import GravityTable, table_of_fit
from namod_ctl.calibration.gravity.sag_fit import TERMS
from namod_ctl.calibration.gravity.sag_of_runs import RunOfFacets, SagFit
from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg2_to_rad2, deg_to_rad, rad2_to_deg2, rad_to_deg

Array = NDArray[np.float64]

_REMEDY = "write it anew with `namod-ctl lut fit`"

_Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
_Pair = Annotated[list[_Number], Field(min_length=2, max_length=2)]
_Zenith = Annotated[float, Field(ge=0.0, le=90.0)]
_Term = Literal["sin", "cos"]


class _Section(BaseModel):
    """A part of the file: every key is known, none is missing, no number is written as text."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=True)


class LutRun(_Section):
    """A run that the table rests on; `common_deg` is the motion of the whole image against the first run."""

    name: str
    zenith_deg: _Number
    zenith_first_deg: _Number
    zenith_last_deg: _Number
    came_from: Literal["above", "below", "both", "unknown"]
    common_deg: _Pair
    common_uncertainty_deg: _Pair


class LutTest(_Section):
    """A set of terms on trial; see `gravity.TermTest`."""

    terms: list[_Term]
    bic: _Number
    chance: _Number


class LutHysteresis(_Section):
    """See `play.Play`; the difference is between both sides, at 45 deg from the zenith, rms over the facets."""

    play_deg: _Number
    play_uncertainty_deg: _Number
    is_significant: bool
    difference_at_45_deg: _Number
    difference_at_45_deg_uncertainty: _Number
    own_difference_deg: _Number
    own_chance: _Number


class LutFacet(_Section):
    """A facet: Theta relative to the mean of all facets = constant + sin * sin z + cos * (cos z - 1).

    `cov_deg2` is of constant x, y, then of each of the table's terms x, y. Where `is_moving` is false the terms are
    not worth their numbers and are left out. `light` is the facet's share of the image.
    """

    id: int
    constant_deg: _Pair
    sin_deg: _Pair | None
    cos_deg: _Pair | None
    cov_deg2: list[list[_Number]]
    is_moving: bool
    chance: _Number
    light: _Number
    width_deg: _Number
    remark: str


class _LutFile(_Section):
    schema_name: Literal["namod-lut/1"] = Field(alias="schema")
    telescope: str
    made_utc: str
    program_version: str
    verdict: Literal["good", "limited"]
    remarks: list[str]
    terms: list[_Term]
    zenith_range_deg: Annotated[list[_Zenith], Field(min_length=2, max_length=2)]
    scatter: _Number
    residual_rms_deg: _Number
    hysteresis: LutHysteresis | None
    tests: list[LutTest]
    runs: list[LutRun]
    facets: Annotated[list[LutFacet], Field(min_length=1)]

    @model_validator(mode="after")
    def _fits_together(self) -> _LutFile:
        size = 2 * (1 + len(self.terms))
        ids = [facet.id for facet in self.facets]
        if len(set(ids)) != len(ids):
            raise ValueError(f"facets are given twice: {sorted({i for i in ids if ids.count(i) > 1})}")
        if self.terms != [term for term in TERMS if term in self.terms]:
            raise ValueError(f"terms {self.terms} are not in the order of {list(TERMS)}")
        if self.zenith_range_deg[0] > self.zenith_range_deg[1]:
            raise ValueError(f"zenith_range_deg {self.zenith_range_deg}: the first must be the smaller")
        for facet in self.facets:
            given = [term for term in TERMS if getattr(facet, f"{term}_deg") is not None]
            if given != self.terms:
                raise ValueError(f"facet {facet.id} has the terms {given}, the table {self.terms}")
            if len(facet.cov_deg2) != size or any(len(row) != size for row in facet.cov_deg2):
                raise ValueError(f"facet {facet.id}: cov_deg2 must be {size} x {size}")
            if not facet.light > 0.0 or not facet.width_deg > 0.0:
                raise ValueError(f"facet {facet.id}: light and width_deg must be positive")
            numbers = [*facet.constant_deg, *(v for term in self.terms for v in getattr(facet, f"{term}_deg"))]
            numbers += [value for row in facet.cov_deg2 for value in row]
            if facet.is_moving and not all(map(math.isfinite, numbers)):
                raise ValueError(f"facet {facet.id} is moving, and some of its numbers are not given")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Lut:
    """A look-up table and what is known of how it was made."""

    table: GravityTable
    made_utc: str
    is_good: bool
    remarks: tuple[str, ...]
    scatter: float
    residual_rms_rad: float
    hysteresis: LutHysteresis | None
    tests: tuple[LutTest, ...]
    runs: tuple[LutRun, ...]
    chance: Array
    facet_remarks: tuple[str, ...]


def lut_of_fit(
    fit: SagFit,
    telescope: str,
    facet_ids: Sequence[int],
    runs: Sequence[RunOfFacets],
    light: Array,
    variance_rad2: Array,
    clock: Clock,
    remarks: Sequence[str] = (),
) -> Lut:
    """The table of a fit; `light` and `variance_rad2` (n_facets,) as in `GravityTable`."""
    zeniths = [run.path.mean_rad for run in runs]
    table = table_of_fit(
        fit, telescope, tuple(facet_ids), light / light.sum(), variance_rad2, (min(zeniths), max(zeniths))
    )
    play = fit.play
    hysteresis = None
    if play is not None:
        hysteresis = LutHysteresis(
            play_deg=rad_to_deg(play.play_rad),
            play_uncertainty_deg=rad_to_deg(play.sigma_rad),
            is_significant=play.is_significant,
            difference_at_45_deg=rad_to_deg(play.difference_rad),
            difference_at_45_deg_uncertainty=rad_to_deg(play.difference_sigma_rad),
            own_difference_deg=rad_to_deg(play.own_rms_rad),
            own_chance=play.own_chance,
        )
    return Lut(
        table=table,
        made_utc=clock.now().isoformat(timespec="seconds"),
        is_good=fit.is_good,
        remarks=(*remarks, *fit.remarks),
        scatter=fit.scatter,
        residual_rms_rad=fit.residual_rms_rad,
        hysteresis=hysteresis,
        tests=tuple(
            LutTest(terms=[_term(term) for term in test.terms], bic=test.bic, chance=test.chance) for test in fit.tests
        ),
        runs=tuple(
            LutRun(
                name=run.name,
                zenith_deg=rad_to_deg(run.path.mean_rad),
                zenith_first_deg=rad_to_deg(float(run.path.zenith_rad[0])),
                zenith_last_deg=rad_to_deg(float(run.path.zenith_rad[-1])),
                came_from=_side_in_words(run),
                common_deg=[float(angle) for angle in rad_to_deg(common)],
                common_uncertainty_deg=[float(angle) for angle in rad_to_deg(sigma)],
            )
            for run, common, sigma in zip(runs, fit.common_rad, fit.common_sigma_rad, strict=True)
        ),
        chance=fit.chance,
        facet_remarks=tuple(fit.odd.get(j, "") for j in range(len(facet_ids))),
    )


def _side_in_words(run: RunOfFacets) -> Literal["above", "below", "both", "unknown"]:
    if not run.path.has_side:
        return "unknown"
    side = run.path.side()
    return "above" if side > 0.5 else "below" if side < -0.5 else "both"


def lut_to_json(lut: Lut) -> str:
    """Text of the file; null where there is no number."""
    table = lut.table
    size = 2 * (1 + len(table.terms))
    facets = []
    for j, facet_id in enumerate(table.facet_ids):
        beta_deg = rad_to_deg(table.beta_rad[j])
        terms = {f"{term}_deg": [float(v) for v in beta_deg[1 + i]] for i, term in enumerate(table.terms)}
        facets.append(
            LutFacet(
                id=facet_id,
                constant_deg=[float(v) for v in beta_deg[0]],
                sin_deg=terms.get("sin_deg"),
                cos_deg=terms.get("cos_deg"),
                cov_deg2=rad2_to_deg2(table.cov_rad2[j]).reshape(size, size).tolist(),
                is_moving=bool(table.is_moving[j]),
                chance=float(lut.chance[j]),
                light=float(table.light[j]),
                width_deg=float(rad_to_deg(math.sqrt(table.variance_rad2[j]))),
                remark=lut.facet_remarks[j],
            )
        )
    low, high = table.zenith_range_rad
    file = _LutFile(
        schema="namod-lut/1",
        telescope=table.telescope,
        made_utc=lut.made_utc,
        program_version=__version__,
        verdict="good" if lut.is_good else "limited",
        remarks=list(lut.remarks),
        terms=[_term(term) for term in table.terms],
        zenith_range_deg=[rad_to_deg(low), rad_to_deg(high)],
        scatter=lut.scatter,
        residual_rms_deg=rad_to_deg(lut.residual_rms_rad),
        hysteresis=lut.hysteresis,
        tests=list(lut.tests),
        runs=list(lut.runs),
        facets=facets,
    )
    return json.dumps(_null_for_nan(file.model_dump(by_alias=True)), indent=1, allow_nan=False) + "\n"


def lut_from_json(text: str, source: str) -> Lut:
    """The table that was written as `text`; null becomes NaN.

    Raises
    ------
    ConfigError
        Not JSON, another schema, or a key that is missing, unknown or of another type; names `source` and the key.
    """
    try:
        file = _LutFile.model_validate(json.loads(text))
    except (json.JSONDecodeError, RecursionError) as error:
        raise ConfigError(f"{source}: not readable as JSON ({error}); {_REMEDY}") from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "(whole file)"
        value = "" if key == "(whole file)" else f" (value: {str(first['input'])[:80]})"
        raise ConfigError(f"{source}: key {key}: {first['msg']}{value}; {_REMEDY}") from None
    terms: tuple[str, ...] = tuple(file.terms)
    beta = np.array([[f.constant_deg, *(getattr(f, f"{term}_deg") for term in terms)] for f in file.facets])
    cov = np.array([f.cov_deg2 for f in file.facets]).reshape(-1, 1 + len(terms), 2, 1 + len(terms), 2)
    hysteresis = file.hysteresis
    low_deg, high_deg = file.zenith_range_deg
    table = GravityTable(
        telescope=file.telescope,
        facet_ids=tuple(f.id for f in file.facets),
        terms=terms,
        beta_rad=deg_to_rad(beta),
        cov_rad2=deg2_to_rad2(cov),
        is_moving=np.array([f.is_moving for f in file.facets]),
        light=np.array([f.light for f in file.facets]),
        variance_rad2=deg_to_rad(np.array([f.width_deg for f in file.facets])) ** 2,
        zenith_range_rad=(deg_to_rad(low_deg), deg_to_rad(high_deg)),
        play_rad=_play_rad(hysteresis),
    )
    return Lut(
        table=table,
        made_utc=file.made_utc,
        is_good=file.verdict == "good",
        remarks=tuple(file.remarks),
        scatter=file.scatter,
        residual_rms_rad=deg_to_rad(file.residual_rms_deg),
        hysteresis=hysteresis,
        tests=tuple(file.tests),
        runs=tuple(file.runs),
        chance=np.array([f.chance for f in file.facets]),
        facet_remarks=tuple(f.remark for f in file.facets),
    )


def read_lut(path: Path) -> Lut:
    """The table in a file. Raises ConfigError when there is none, or it is not one of this program."""
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"{path}: there is no such file; make one with `namod-ctl lut fit`") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: is a folder; name the file that `namod-ctl lut fit` wrote") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file ({error}); {_REMEDY}") from None
    return lut_from_json(text, str(path))


def _play_rad(hysteresis: LutHysteresis | None) -> float:
    """As `Play.used_rad`."""
    if hysteresis is None or not hysteresis.is_significant:
        return 0.0
    return max(deg_to_rad(hysteresis.play_deg), 0.0)


def _term(name: str) -> _Term:
    return "sin" if name == "sin" else "cos"


def _null_for_nan(value: object) -> object:
    """JSON knows no NaN and no infinity: where there is no number, the file says null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _null_for_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_null_for_nan(item) for item in value]
    return value
