"""Parts that the report of a run and that of a campaign have in common."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.config.summary import summarize, warnings_of
from namod_ctl.app.pictures.figure_style import figure_to_png
from namod_ctl.app.pictures.figures import draw_exposure_map
from namod_ctl.app.pictures.psf_maps import draw_psf_maps
from namod_ctl.app.report.document import Block, Chapter, Picture, Table, Text
from namod_ctl.core.flags import FACET_FLAG_MEANING, REJECT_REASON_MEANING, FacetFlag
from namod_ctl.core.records import Record
from namod_ctl.core.units import m_to_mm, rad2_to_arcmin2, rad_to_arcmin
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment, AreaOfPsf, BadRecord, FacetAlignment
from namod_ctl.reconstruction.histograms import histogram_responses
from namod_ctl.reconstruction.reconstruct import DEFAULT_BIN_SIZE_RAD, Reconstruction


def area_text(area: AreaOfPsf) -> str:
    """An area of a point spread function in square minutes of arc, without the unit."""
    value, doubt = rad2_to_arcmin2(area.a_sigma_rad2), rad2_to_arcmin2(area.uncertainty_rad2)
    if not math.isfinite(value):
        return "not known"
    return f"{value:.2f} ± {doubt:.2f}" if doubt > 0.0 else f"{value:.2f}"


def compact_png(figure: Figure) -> bytes:
    """The figure as a PNG of 256 colours: a third of the size, and no difference that is seen."""
    data = io.BytesIO()
    with Image.open(io.BytesIO(figure_to_png(figure))) as picture:
        few = picture.convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    paper = int(np.asarray(few)[0, 0])  # the index of the paper's white, which must stay so
    palette = few.getpalette() or []
    palette[3 * paper : 3 * paper + 3] = [255] * 3
    few.putpalette(palette)
    few.save(data, format="png", optimize=True)
    return data.getvalue()


def number_text(value: float, form: str) -> str:
    """A number as it stands in a table; a dash for one that is not known."""
    text = format(value, form) if math.isfinite(value) else "–"
    return text if any(digit in text for digit in "123456789–") else text.lstrip("+-")  # no -0


def when_text(time_utc: str) -> str:
    """A moment as people write it, from ISO 8601."""
    return f"{time_utc[:19].replace('T', ' ')} UTC"


def doubt_arcmin(facet: FacetAlignment) -> float:
    """Uncertainty of a facet's direction per axis."""
    return float(rad_to_arcmin(math.sqrt(max(float(np.trace(facet.theta_cov_rad2)), 0.0) / 2.0)))


def facet_table(alignment: Alignment) -> Table:
    """Every facet of one run: direction, uncertainty, width, correction and flags."""
    has_bolts = any(len(facet.bolt_turn_deg) for facet in alignment.facets)
    head = ("facet", "θx arcmin", "θy arcmin", "± arcmin", "width arcmin", "lit records",
            "bolt turns deg, + clockwise" if has_bolts else "leg travels mm", "flags")  # fmt: skip
    rows = []
    for facet in alignment.facets:
        x, y = rad_to_arcmin(facet.theta_rad)
        widths = [rad_to_arcmin(width) for width in (facet.width_major_rad, facet.width_minor_rad)]
        turns = [number_text(turn, "+.0f") for turn in facet.bolt_turn_deg]
        travels = [number_text(float(m_to_mm(travel)), "+.3f") for travel in facet.leg_travel_m]
        rows.append(
            (
                str(facet.facet_id),
                number_text(x, "+.2f"),
                number_text(y, "+.2f"),
                number_text(doubt_arcmin(facet), ".2f"),
                " × ".join(number_text(width, ".2f") for width in widths),
                str(facet.n_records_in_psf),
                "  ".join(turns if has_bolts else travels),
                ", ".join(facet.flags.names),
            )
        )
    return Table(head, tuple(rows), frozenset({7}))


def flag_blocks(facets: Iterable[FacetAlignment]) -> list[Block]:
    """What the flags of these facets mean; nothing where there are none."""
    found = FacetFlag.NONE
    for facet in facets:
        found |= facet.flags
    rows = tuple((str(flag.name), FACET_FLAG_MEANING[flag]) for flag in FacetFlag if flag in found)
    return [Text("What the flags mean:"), Table((), rows, frozenset({1}))] if rows else []


def remark_blocks(alignment: Alignment) -> list[Block]:
    """What the reconstruction remarked, of the whole and of facets."""
    remarks = [*alignment.remarks]
    for facet in alignment.facets:
        remarks += [
            remark if remark.startswith("facet ") else f"facet {facet.facet_id}: {remark}"
            for remark in facet.remarks
            if "no turn needed" not in remark
        ]
    return [Text(remark) for remark in remarks]


def rejection_table(runs: Sequence[tuple[str, Sequence[Record]]]) -> Table:
    """How many records of each run were rejected for which reason."""
    counts = [Counter(record.reject_reason for record in records) for _, records in runs]
    rows = [("accepted", *(str(count[None]) for count in counts), "")]
    rows += [
        (reason.value.replace("_", " "), *(str(count[reason]) for count in counts), meaning)
        for reason, meaning in REJECT_REASON_MEANING.items()
        if any(count[reason] for count in counts)
    ]
    return Table(("records", *(name for name, _ in runs), "what it means"), tuple(rows), frozenset({len(runs) + 1}))


def bad_record_blocks(bad: Sequence[BadRecord]) -> list[Block]:
    """The records that were accepted and left out of the estimates later."""
    if not bad:
        return [Text("No accepted record disagrees with the others.")]
    rows = tuple(
        (str(record.index), record.kind.replace("_", " "), record.detail, ", ".join(map(str, record.facet_ids)))
        for record in bad
    )
    return [
        Text(f"{len(bad)} accepted records disagree with all others and were left out of the estimates:"),
        Table(("record", "kind", "what was seen", "facets it would change most"), rows, frozenset({1, 2, 3})),
    ]


def map_pictures(result: Reconstruction, name: str) -> list[Block]:
    """The point spread functions of all facets, and where the telescope pointed."""
    maps = draw_psf_maps(histogram_responses(result.used, DEFAULT_BIN_SIZE_RAD), result.used, result.alignment)
    pointings = draw_exposure_map(
        histogram_responses(result.table, DEFAULT_BIN_SIZE_RAD), result.table, result.alignment
    )
    return [
        Picture(compact_png(maps), f"{name}: point spread function of every facet; its centre says how it stands."),
        Picture(compact_png(pointings), f"{name}: how many records fell where, and which were left out."),
    ]


def config_chapter(config: InstrumentConfig, instrument: Instrument) -> Chapter:
    """The config as it was used: telescope, mounts, drives, cameras with their calibrations."""
    blocks: list[Block] = [Text(warning, is_warning=True) for warning in warnings_of(config, instrument)]
    for summary in summarize(config, instrument):
        if summary.rows:
            blocks += [Text(f"{summary.title.strip()}:"), Table((), summary.rows, frozenset({1}))]
    return Chapter("Config and calibration", tuple(blocks))
