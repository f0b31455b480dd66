"""A report as PDF: A4, black on white, with the same words and pictures as the HTML."""

from __future__ import annotations

import io
from collections.abc import Sequence
from html import escape
from pathlib import Path

import matplotlib as mpl
from reportlab.lib import colors  # type: ignore[import-untyped]
from reportlab.lib.pagesizes import A4  # type: ignore[import-untyped]
from reportlab.lib.styles import ParagraphStyle  # type: ignore[import-untyped]
from reportlab.lib.units import mm  # type: ignore[import-untyped]
from reportlab.pdfbase import pdfmetrics  # type: ignore[import-untyped]
from reportlab.pdfbase.ttfonts import TTFont  # type: ignore[import-untyped]
from reportlab.platypus import (  # type: ignore[import-untyped]
    CondPageBreak,
    Flowable,
    Image,
    KeepTogether,
    LongTable,
    Paragraph,
    SimpleDocTemplate,
    Spacer,
)

from namod_ctl.app.report.document import Block, Document, Listing, Picture, Table, Text

_MARGIN = 15 * mm
_WIDTH, _HEIGHT = A4[0] - 2 * _MARGIN, A4[1] - 2 * _MARGIN - 8 * mm
_FONT, _BOLD, _MONO = "DejaVuSans", "DejaVuSans-Bold", "DejaVuSansMono"  # ship with matplotlib: the same everywhere
_CELL_PT, _SMALLEST_CELL_PT = 7.5, 5.5
_PADDING = 3.0
_ROOM_BELOW_HEADING = 35 * mm  # a heading with less room goes to the next page
_FEWEST_EM_OF_WORDS = 9.0  # a column of words is not made narrower than this
_LEADING = 1.3  # from line to line, of the letters' size


def to_pdf(document: Document) -> bytes:
    """The report as PDF."""
    _register_fonts()
    data = io.BytesIO()
    template = SimpleDocTemplate(
        data, pagesize=A4, leftMargin=_MARGIN, rightMargin=_MARGIN, topMargin=_MARGIN, bottomMargin=_MARGIN + 8 * mm,
        title=document.title, author="namod-ctl", creator="namod-ctl",
    )  # fmt: skip
    story: list[Flowable] = [
        Paragraph(escape(document.title), _style(16, _BOLD)),
        Paragraph(escape(document.subtitle), _style(9)),
    ]
    for chapter in document.chapters:
        heading = Paragraph(escape(chapter.title), _style(12, _BOLD, space_before=12))
        for number, block in enumerate(chapter.blocks):
            flowables = _flowables(block)
            if isinstance(block, Picture):
                flowables = [KeepTogether([heading, *flowables] if number == 0 else flowables)]
            elif number == 0:
                flowables = [CondPageBreak(_ROOM_BELOW_HEADING), heading, *flowables]
            story += flowables

    def foot(canvas: object, page: object) -> None:
        _write_foot(canvas, page, document.title)

    template.build(story, onFirstPage=foot, onLaterPages=foot)
    return data.getvalue()


def _register_fonts() -> None:
    folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    for name, file in ((_FONT, "DejaVuSans"), (_BOLD, "DejaVuSans-Bold"), (_MONO, "DejaVuSansMono")):
        if name not in pdfmetrics.getRegisteredFontNames():
            pdfmetrics.registerFont(TTFont(name, folder / f"{file}.ttf"))


def _style(size_pt: float, font: str = _FONT, *, space_before: float = 0, is_right: bool = False) -> ParagraphStyle:
    return ParagraphStyle(
        font, fontName=font, fontSize=size_pt, leading=_LEADING * size_pt, spaceBefore=space_before, spaceAfter=3,
        alignment=2 if is_right else 0, splitLongWords=1,
    )  # fmt: skip


def _write_foot(canvas, page, title: str) -> None:  # type: ignore[no-untyped-def]  # reportlab has no types
    canvas.setFont(_FONT, 7)
    canvas.drawString(_MARGIN, _MARGIN, title)
    canvas.drawRightString(A4[0] - _MARGIN, _MARGIN, f"page {page.page}")


def _flowables(block: Block) -> list[Flowable]:
    gap = Spacer(1, 2 * mm)
    match block:
        case Text(text, is_warning):
            words = ("⚠ " if is_warning else "") + escape(text)
            paragraph = Paragraph(words, _style(9, _BOLD if is_warning else _FONT))
            # what ends with a colon belongs to what stands below it
            return [CondPageBreak(_ROOM_BELOW_HEADING), paragraph] if text.endswith(":") else [paragraph]
        case Listing(lines):
            style = _style(7.5, _MONO)
            style.backColor, style.borderPadding = colors.HexColor("#eeeeee"), 3
            return [gap, Paragraph("<br/>".join(map(escape, lines)), style), gap]
        case Picture(png, words):
            return [_picture(png), Paragraph(escape(words), _style(8)), gap]
        case Table():
            return _tables(block)


def _picture(png: bytes) -> Flowable:
    image = Image(io.BytesIO(png))
    share = min(_WIDTH / image.imageWidth, (_HEIGHT - 25 * mm) / image.imageHeight)
    image.drawWidth, image.drawHeight = share * image.imageWidth, share * image.imageHeight
    image.hAlign = "LEFT"
    return image


def _tables(table: Table) -> list[Flowable]:
    """The table in letters as large as fit; one too wide for the page in parts, each with the first column."""
    lines = [table.head, *table.rows] if table.head else list(table.rows)
    if not lines or not lines[0]:
        return []
    size_pt, widths = _fitting_widths(lines, table.words, has_head=bool(table.head))
    n_columns = len(widths)
    if sum(widths) > _WIDTH + 1.0 and n_columns > 2:
        middle = 1 + n_columns // 2
        parts = [range(1, middle), range(middle, n_columns)]
        return [flowable for part in parts for flowable in _tables(_columns_of(table, [0, *part]))]
    cells = []
    for row, line in enumerate(lines):
        is_head = bool(table.head) and row == 0
        cells.append(
            [
                _paragraph(text, size_pt, is_left=column == 0 or column in table.words, is_bold=is_head)
                if is_head or column == 0 or column in table.words
                else text  # numbers never break: as they are they take a fifth of the time of a paragraph
                for column, text in enumerate(line)
            ]
        )
    drawn = LongTable(cells, colWidths=widths, repeatRows=1 if table.head else 0, hAlign="LEFT", splitInRow=1)
    style = [
        ("VALIGN", (0, 0), (-1, -1), "TOP"), ("ALIGN", (0, 0), (-1, -1), "RIGHT"),
        ("FONT", (0, 0), (-1, -1), _FONT, size_pt, _LEADING * size_pt),
        ("LINEBELOW", (0, 0), (-1, -1), 0.3, colors.grey),
        ("LEFTPADDING", (0, 0), (-1, -1), _PADDING), ("RIGHTPADDING", (0, 0), (-1, -1), _PADDING),
        ("TOPPADDING", (0, 0), (-1, -1), 1.0), ("BOTTOMPADDING", (0, 0), (-1, -1), 1.5),
    ]  # fmt: skip
    if table.head:
        style.append(("LINEBELOW", (0, 0), (-1, 0), 1.0, colors.black))
    drawn.setStyle(style)
    return [drawn, Spacer(1, 2 * mm)]


def _columns_of(table: Table, columns: Sequence[int]) -> Table:
    """A table of these columns only."""
    head, *rows = (tuple(line[column] for column in columns) if line else () for line in (table.head, *table.rows))
    words = frozenset(new for new, old in enumerate(columns) if old in table.words)
    return Table(head, tuple(rows), words)


def _paragraph(text: str, size_pt: float, *, is_left: bool, is_bold: bool) -> Flowable:
    return Paragraph(escape(text), _style(size_pt, _BOLD if is_bold else _FONT, is_right=not is_left))


def _fitting_widths(
    lines: Sequence[Sequence[str]], words: frozenset[int], *, has_head: bool
) -> tuple[float, list[float]]:
    """Size of the letters and widths of the columns, in points; narrower heads are tried before smaller letters."""
    columns = list(zip(*lines, strict=True))
    ems = [[pdfmetrics.stringWidth(text, _BOLD, 1.0) for text in column] for column in columns]
    body = [max(column[has_head:], default=0.0) for column in ems]
    heads = [(0.0, 0.0)] * len(columns)
    if has_head:  # a head may take two lines or, if need be, one per word; cells of numbers never break
        longest = [max(pdfmetrics.stringWidth(word, _BOLD, 1.0) for word in c[0].split() or [""]) for c in columns]
        heads = [(max(word, 0.6 * column[0]), word) for word, column in zip(longest, ems, strict=True)]
    size_pt = _CELL_PT
    while True:
        for line_count in (0, 1):
            wanted = [
                size_pt * max(em, head[line_count]) + 2 * _PADDING + 1.0 for em, head in zip(body, heads, strict=True)
            ]
            widths = _shared(wanted, words, _FEWEST_EM_OF_WORDS * size_pt)
            if sum(widths) <= _WIDTH + 1.0:
                return size_pt, widths
        if size_pt <= _SMALLEST_CELL_PT:
            return size_pt, widths
        size_pt -= 0.5


def _shared(wanted: Sequence[float], words: frozenset[int], least: float) -> list[float]:
    """Widths where columns of words share what those of numbers leave of the page, none below `least`."""
    left = _WIDTH - sum(width for column, width in enumerate(wanted) if column not in words)
    of_words = sum(wanted[column] for column in words)
    if of_words <= left:
        return list(wanted)
    return [max(least, width * left / of_words) if column in words else width for column, width in enumerate(wanted)]
