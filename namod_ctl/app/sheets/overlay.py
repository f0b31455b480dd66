"""instructions.png: the bolt turns drawn on the picture of the reflector.

Reads like the instruction graphic of arXiv:1605.06274: facet outlines and ids in red, the arms of the mounts and
the numbers of their bolts in green, the turns in yellow. Under red light these are all one colour: there ids stand in
frames, bolts are bright discs with black numbers, and only turns are bare numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.textpath import TextPath
from numpy.typing import NDArray

from namod_ctl.app.sheets.facet_map import FacetInPicture, FreeRoom, locate_facets, polygons_of_facet_list
from namod_ctl.app.sheets.instructions import FacetInstruction, Verdict
from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.instrument import Instrument

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PNG_FILE = "instructions.png"

_RED, _ID_RED, _GREEN, _YELLOW, _WHITE = "#ff2020", "#ff8080", "#b4ffb4", "#ffe600", "#ffffff"
_CANVAS = "#181818"  # without a picture
_BOLD = FontProperties(family="DejaVu Sans", weight="bold")  # ships with matplotlib: the same on every machine
_DPI = 72  # one point of text is one pixel

_WISHED_FACET_WIDTH_PX = 260.0
_LARGEST_EDGE_PX = 4600  # larger pictures are slow to open on a telephone at the telescope
_SMALLEST_FACET_WIDTH_PX = 110.0  # below it the numbers of three bolts are no longer legible
_SMALLEST_ID_WIDTH_PX = 36.0

_TURN_SIZE, _ID_SIZE, _BOLT_SIZE, _BOLT_RADIUS, _NOTE_SIZE = 0.13, 0.16, 0.10, 0.075, 0.12  # of a facet's width
_BESIDE_ARM_RAD, _ALONG_ARM = 0.45, 0.9  # where the number of a bolt would best be, seen from the facet's centre
_ASPECT_TOLERANCE = 0.01


def scale_polygons(
    polygons_px: Mapping[int, Array], old_size: tuple[int, int], new_size: tuple[int, int]
) -> dict[int, Array]:
    """Polygons of a picture of `old_size` (columns, rows) in the same picture resampled to `new_size`.

    Raises
    ------
    ConfigError
        The two sizes have another aspect ratio, so it cannot be the same picture.
    """
    scale = np.array(new_size) / np.array(old_size)
    if abs(scale[0] / scale[1] - 1.0) > _ASPECT_TOLERANCE:
        raise ConfigError(
            f"the image has {new_size[0]} x {new_size[1]} pixels, the reflector camera {old_size[0]} x {old_size[1]}: "
            "another aspect ratio; give an image of the whole frame, neither cropped nor stretched"
        )
    return {facet_id: (outline + 0.5) * scale - 0.5 for facet_id, outline in polygons_px.items()}


def draw_instructions(
    instrument: Instrument, instructions: Sequence[FacetInstruction], image: Image | None, headline: str
) -> Figure:
    """The picture with every facet's instruction; save it with `figure.savefig(path, dpi=figure.dpi)`.

    Parameters
    ----------
    image
        Shape (rows, columns, 3), RGB, the whole frame of the reflector camera at any size; None draws on a plain
        dark canvas of the camera's size.
    headline
        What this is, for the legend below the picture.

    Raises
    ------
    ConfigError
        The image has another aspect ratio than the camera, or the config says not where facets lie in an image.
    """
    camera = instrument.reflector_camera
    if image is None:
        n_columns, n_rows = camera.n_columns, camera.n_rows
        polygons_px = dict(instrument.facet_polygons_px) or polygons_of_facet_list(instrument, n_columns, n_rows)
    else:
        n_rows, n_columns = image.shape[:2]
        if not instrument.facet_polygons_px:
            raise ConfigError(
                f"the config of {instrument.name} does not say where the facets lie in an image (no polygons): "
                "leave --image out to draw on a plain canvas"
            )
        camera_size = (camera.n_columns, camera.n_rows)
        polygons_px = scale_polygons(instrument.facet_polygons_px, camera_size, (n_columns, n_rows))
    facets = locate_facets(instrument, polygons_px)
    zoom = _zoom(float(np.median([facet.width_px for facet in facets])), max(n_columns, n_rows))
    size = (n_columns * zoom, n_rows * zoom)
    facets = locate_facets(instrument, scale_polygons(polygons_px, (n_columns, n_rows), size))

    legend_px = max(75, size[1] // 12)
    figure, axes = _canvas(size, legend_px, image)
    is_legible = float(np.median([facet.width_px for facet in facets])) >= _SMALLEST_FACET_WIDTH_PX
    by_id = {instruction.facet_id: instruction for instruction in instructions}
    _draw_outlines(axes, facets)
    for facet in facets:
        _draw_facet(axes, facet, by_id.get(facet.facet_id), is_legible)
    _draw_legend(figure, size, legend_px, _legend_lines(instrument, by_id, headline, is_legible))
    return figure


def _zoom(facet_width_px: float, longest_edge_px: int) -> int:
    """Whole number of new pixels per old pixel that makes facets large enough for text."""
    wished = int(np.ceil(_WISHED_FACET_WIDTH_PX / facet_width_px))
    return max(1, min(wished, _LARGEST_EDGE_PX // longest_edge_px))


def _canvas(size: tuple[int, int], legend_px: int, image: Image | None) -> tuple[Figure, Axes]:
    n_columns, n_rows = size
    height = n_rows + legend_px
    figure = Figure(figsize=(n_columns / _DPI, height / _DPI), dpi=_DPI, facecolor="#000000")
    axes = figure.add_axes((0.0, legend_px / height, 1.0, n_rows / height))
    extent = (-0.5, n_columns - 0.5, n_rows - 0.5, -0.5)
    if image is None:
        axes.add_patch(Rectangle((-0.5, -0.5), n_columns, n_rows, fc=_CANVAS, ec="none"))
    else:
        axes.imshow(image, extent=extent, interpolation="bilinear", aspect="auto")
    axes.set_xlim(extent[0], extent[1])
    axes.set_ylim(extent[2], extent[3])
    axes.set_axis_off()
    return figure, axes


def _draw_outlines(axes: Axes, facets: Sequence[FacetInPicture]) -> None:
    """All outlines first, so that no facet's dark ground covers a neighbour's text."""
    outlines = [facet.outline_px for facet in facets]
    line_px = float(np.clip(0.012 * facets[0].width_px, 1.0, 4.0))
    axes.add_collection(PolyCollection(outlines, facecolors=(0, 0, 0, 0.55), edgecolors=_RED, linewidths=line_px))


@lru_cache(maxsize=4096)
def _text_size_em(text: str) -> tuple[float, float]:
    extents = TextPath((0.0, 0.0), text, size=1.0, prop=_BOLD).get_extents()
    return float(extents.width) + 0.25, 1.2  # with the outline of the letters


def _write(
    axes: Axes,
    centre: Array,
    text: str,
    size_px: float,
    colour: str,
    *,
    outline: str = "black",
    frame: dict[str, str | float] | None = None,
) -> None:
    axes.text(
        centre[0],
        centre[1],
        text,
        color=colour,
        fontsize=size_px,
        fontproperties=_BOLD,
        ha="center",
        va="center_baseline",
        path_effects=[withStroke(linewidth=max(2.0, 0.16 * size_px), foreground=outline)],
        bbox=frame,
    )


def _draw_facet(axes: Axes, facet: FacetInPicture, instruction: FacetInstruction | None, is_legible: bool) -> None:
    verdict = instruction.verdict if instruction is not None else None
    if verdict is Verdict.DO_NOT_TURN:
        _cross_out(axes, facet)
    if not is_legible:
        if facet.width_px >= _SMALLEST_ID_WIDTH_PX:
            _write(axes, facet.centre_px, str(facet.facet_id), 0.3 * facet.width_px, _ID_RED)
        return
    if instruction is not None and verdict is Verdict.TURN:
        _draw_turns(axes, facet, instruction)
        return
    notes = {
        None: ("not in", "this run"),
        Verdict.DO_NOT_TURN: ("DO NOT", "TURN"),
        Verdict.NO_TURN_NEEDED: ("ok",),
        Verdict.NO_BOLTS: (),
    }[verdict]
    step = np.array([0.0, 1.4 * _NOTE_SIZE * facet.width_px])
    top = facet.centre_px - 0.5 * len(notes) * step
    _write(axes, top, str(facet.facet_id), _ID_SIZE * facet.width_px, _ID_RED)
    colour = _YELLOW if verdict is Verdict.NO_TURN_NEEDED else _WHITE
    for line, note in enumerate(notes):
        _write(axes, top + (line + 1.1) * step, note, _NOTE_SIZE * facet.width_px, colour)


def _cross_out(axes: Axes, facet: FacetInPicture) -> None:
    """A dark ground and a thick white second outline: told apart by shape, not by colour alone."""
    inner = facet.centre_px + 0.9 * (facet.outline_px - facet.centre_px)
    axes.add_collection(
        PolyCollection(
            [inner],
            facecolors=(0, 0, 0, 0.6),
            edgecolors=_WHITE,
            linewidths=max(1.5, 0.02 * facet.width_px),
            linestyles=[(0, (2.0, 1.2))],
        )
    )


def _draw_turns(axes: Axes, facet: FacetInPicture, instruction: FacetInstruction) -> None:
    ends = [_inside(facet, leg, _BOLT_RADIUS * facet.width_px) for leg in facet.legs_px]
    arms = [np.linspace(facet.centre_px, end, 60) for end in ends]
    width_px = facet.width_px
    line_px = max(2.0, 0.014 * width_px)
    axes.add_collection(LineCollection(arms, colors="black", linewidths=2.0 * line_px))
    axes.add_collection(LineCollection(arms, colors=_GREEN, linewidths=line_px))
    for bolt, end in enumerate(ends):
        axes.add_patch(Circle((end[0], end[1]), _BOLT_RADIUS * width_px, fc=_GREEN, ec="black", lw=line_px, zorder=3))
        _write(axes, end, str(bolt + 1), 1.15 * _BOLT_SIZE * width_px, "black", outline=_GREEN)

    turns = [f"{turn_deg:+g}°".replace("-", "−") if turn_deg else "leave" for turn_deg in instruction.settable_deg]
    for shrink in (1.0, 0.9, 0.8, 0.7, 0.6, 0.5):
        placed = _place_texts(facet, ends, arms, turns, shrink)
        if placed is not None:
            turn_centres, id_centre = placed
            for text, centre in zip(turns, turn_centres, strict=True):
                _write(axes, centre, text, shrink * _TURN_SIZE * width_px, _YELLOW)
            id_px = shrink * _ID_SIZE * width_px
            frame: dict[str, str | float] = {
                "boxstyle": "round,pad=0.12",
                "fc": "black",
                "ec": _ID_RED,
                "lw": max(1.0, 0.008 * width_px),
            }
            _write(axes, id_centre, str(facet.facet_id), 0.9 * id_px, _ID_RED, frame=frame)
            return
    _write(axes, facet.centre_px, f"{facet.facet_id}: see the list", 0.09 * width_px, _ID_RED)


def _place_texts(
    facet: FacetInPicture, ends: Sequence[Array], arms: Sequence[Array], turns: Sequence[str], shrink: float
) -> tuple[list[Array], Array] | None:
    """Centres of the turns and of the id at this size of letters; None when they do not all find room."""
    radius_px = _BOLT_RADIUS * facet.width_px
    circles = [np.concatenate([end - 1.1 * radius_px, end + 1.1 * radius_px]) for end in ends]
    outline_px = facet.centre_px + 0.97 * (facet.outline_px - facet.centre_px)
    room = FreeRoom(outline_px, np.concatenate(arms), circles)
    turn_centres = []
    for bolt, text in enumerate(turns):
        size_px = np.array(_text_size_em(text)) * shrink * _TURN_SIZE * facet.width_px
        others = [
            _beside_arm(facet.centre_px, end, side)
            for other, end in enumerate(ends)
            if other != bolt
            for side in (1, -1)
        ]
        centre = room.place(size_px, _beside_arm(facet.centre_px, ends[bolt], 1), others)
        if centre is None:
            return None
        turn_centres.append(centre)
    width_em, height_em = _text_size_em(str(facet.facet_id))
    size_px = np.array([width_em + 0.6, height_em]) * shrink * _ID_SIZE * facet.width_px  # apart from the turns
    id_centre = room.place(size_px, facet.centre_px)
    return None if id_centre is None else (turn_centres, id_centre)


def _beside_arm(centre_px: Array, end_px: Array, side: int) -> Array:
    """A point beside an arm; side 1 is the counter-clockwise one, where the arm's number belongs."""
    cosine, sine = np.cos(_BESIDE_ARM_RAD), side * np.sin(_BESIDE_ARM_RAD)
    turn = np.array([[cosine, sine], [-sine, cosine]])  # counter-clockwise where y points down
    return np.asarray(centre_px + _ALONG_ARM * turn @ (end_px - centre_px))


def _inside(facet: FacetInPicture, leg_px: Array, radius_px: float) -> Array:
    """The leg's place, drawn in towards the centre until a circle of that radius lies within the outline."""
    edges = np.roll(facet.outline_px, -1, axis=0) - facet.outline_px
    normals = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
    to_edge = np.sum(normals * (facet.outline_px - facet.centre_px), axis=1)
    outward, to_edge = normals * np.sign(to_edge)[:, None], np.abs(to_edge)
    towards = outward @ (leg_px - facet.centre_px)
    with np.errstate(divide="ignore"):
        shares = np.where(towards > 0, (to_edge - 1.2 * radius_px) / towards, np.inf)
    share = min(1.0, float(shares.min()))
    return np.asarray(facet.centre_px + share * (leg_px - facet.centre_px))


def _legend_lines(
    instrument: Instrument, by_id: Mapping[int, FacetInstruction], headline: str, is_legible: bool
) -> list[str]:
    has_bolts = any(instruction.verdict is not Verdict.NO_BOLTS for instruction in by_id.values())
    if not has_bolts:
        explanation = "This telescope has no bolts: its legs are driven, see leg_travel_m in alignment.json."
    elif is_legible:
        explanation = (
            "Turn the bolt (number in a disc) by the degrees beside it.   Framed: facet.   "
            "ok, leave: no turn needed.   White broken frame: do not turn."
        )
    else:
        explanation = (
            "Facets are too small in this picture for numbers: read them in instructions.pdf or instructions.csv.   "
            "White broken frame: do not turn."
        )
    side = "The picture is seen from the FRONT of the mirror, from its focal point. "
    if has_bolts:
        behind = "BEHIND it: there left and right are exchanged, and"
        place = behind if instrument.bolts_seen_from == "back" else "the FRONT, too:"
        side += f"Bolts are turned from {place} + is clockwise as you see the bolt."
    return [headline, explanation, side]


def _draw_legend(figure: Figure, size: tuple[int, int], legend_px: int, lines: Sequence[str]) -> None:
    longest_em = max(_text_size_em(line)[0] for line in lines)
    size_px = min(0.75 * legend_px / len(lines), 0.97 * size[0] / longest_em)
    for line, text in enumerate(lines):
        y = (1.0 - (line + 0.5) / len(lines)) * legend_px / (size[1] + legend_px)
        figure.text(0.01, y, text, color=_WHITE, fontsize=size_px, fontproperties=_BOLD, va="center")
