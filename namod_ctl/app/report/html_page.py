"""A report as one HTML file: no script, nothing from elsewhere; black on white by day and on paper, red by night.

Night comes by itself where the browser is set to dark, and by a tick elsewhere, which needs no script either.
"""

from __future__ import annotations

import base64
from html import escape
from itertools import count

from namod_ctl.app.report.document import Block, Document, Listing, Picture, Table, Text

_NIGHT = """
  ROOT { --ink: #ff5040; --paper: #000; --line: #7a1a10; --soft: #1c0502; --strong: #ff8070; color-scheme: dark }
  ROOT .picture { background: var(--ink); isolation: isolate }  /* white of the inverted picture shines through */
  ROOT .picture img { filter: grayscale(1) invert(1) brightness(.65); mix-blend-mode: multiply }
"""
_STYLE = """
:root { color-scheme: light dark; --ink: #111; --paper: #fff; --line: #999; --soft: #eee; --strong: #9c3000 }
* { box-sizing: border-box }
body { margin: 0 auto; padding: 1rem; max-width: 76rem; font: 1rem/1.5 system-ui, sans-serif;
  color: var(--ink); background: var(--paper) }
h1 { line-height: 1.2; margin: 0 }
h2 { border-bottom: 2px solid var(--line); margin: 2rem 0 .7rem }
nav ul { columns: 16rem; padding-left: 1.2rem }
a { color: inherit }
.wide { overflow-x: auto }
.wide:focus-visible { outline: 2px solid var(--ink) }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .7rem 0 }
th, td { border-bottom: 1px solid var(--line); padding: .2rem .6rem; text-align: right; vertical-align: top;
  white-space: nowrap }
thead th { border-bottom: 2px solid var(--ink); vertical-align: bottom; white-space: normal }
.words { text-align: left; white-space: normal; overflow-wrap: anywhere; min-width: 13rem }
tbody th, thead th:first-child { text-align: left }
tbody th { font-weight: 600; white-space: normal; overflow-wrap: break-word; min-width: 3.5rem }
figure { margin: 1rem 0 }
.picture { display: inline-block; max-width: 100% }
img { max-width: 100%; height: auto; display: block }
pre { background: var(--soft); padding: .8rem; overflow-x: auto; white-space: pre-wrap; overflow-wrap: anywhere }
.warning { border-left: .4rem solid var(--strong); padding-left: .8rem; font-weight: 700; color: var(--strong) }
#night { accent-color: #ff5040 }  /* its tick is black then */
@media screen and (prefers-color-scheme: dark) {
  .night { display: none }  /* it is night already, from the first moment on */NIGHT_WHERE_DARK}
@media screen {NIGHT_WHERE_CHECKED}
@media print {
  body { max-width: none; padding: 0; font-size: 9pt }
  nav, .night { display: none }
  .wide { overflow: visible }
  tr, figure { break-inside: avoid }
  h2 { break-after: avoid }
  thead { display: table-header-group }
}
"""
_STYLE = _STYLE.replace("NIGHT_WHERE_DARK", _NIGHT.replace("ROOT", ":root"))
_STYLE = _STYLE.replace("NIGHT_WHERE_CHECKED", _NIGHT.replace("ROOT", ":root:has(#night:checked)"))


def to_html(document: Document) -> bytes:
    """The report as UTF-8 text of one HTML file. Every word of it is escaped."""
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        # even a browser that was fooled into something may load nothing and run nothing
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">",
        f"<title>{escape(document.title)}</title><style>{_STYLE}</style></head><body>",
        f"<header><h1>{escape(document.title)}</h1><p>{escape(document.subtitle)}</p>",
        '<p class="night"><label><input type="checkbox" id="night"> Night: red on black</label></p></header>',
        '<nav aria-label="Contents"><ul>',
        *(f'<li><a href="#c{n}">{escape(chapter.title)}</a></li>' for n, chapter in enumerate(document.chapters)),
        "</ul></nav><main>",
    ]
    numbers = count(1)
    for n, chapter in enumerate(document.chapters):
        parts.append(f'<section aria-labelledby="c{n}"><h2 id="c{n}">{escape(chapter.title)}</h2>')
        parts += [_block(block, f"{chapter.title}, part {next(numbers)}") for block in chapter.blocks]
        parts.append("</section>")
    parts.append("</main></body></html>")
    return ("\n".join(parts) + "\n").encode()


def _block(block: Block, name: str) -> str:
    match block:
        case Text(text, is_warning):
            style = ' class="warning"' if is_warning else ""
            return f"<p{style}>{escape(text)}</p>"
        case Listing(lines):
            return f"<pre>{escape(chr(10).join(lines))}</pre>"
        case Picture(png, words):
            data = base64.b64encode(png).decode()
            picture = f'<span class="picture"><img alt="{escape(words)}" src="data:image/png;base64,{data}"></span>'
            return f"<figure>{picture}<figcaption>{escape(words)}</figcaption></figure>"
        case Table():
            # a region that can be reached with the keyboard, as it may have to be scrolled sideways
            return f'<div class="wide" tabindex="0" role="region" aria-label="{escape(name)}">{_table(block)}</div>'


def _table(table: Table) -> str:
    def cell(tag: str, column: int, text: str, scope: str = "") -> str:
        style = ' class="words"' if column in table.words else ""
        return f"<{tag}{scope}{style}>{escape(text)}</{tag}>"

    parts = ["<table>"]
    if table.head:
        cells = "".join(cell("th", column, text, ' scope="col"') for column, text in enumerate(table.head))
        parts.append(f"<thead><tr>{cells}</tr></thead>")
    parts.append("<tbody>")
    for first, *others in table.rows:
        name = cell("th", 0, first, ' scope="row"')
        cells = "".join(cell("td", column, text) for column, text in enumerate(others, start=1))
        parts.append(f"<tr>{name}{cells}</tr>")
    parts.append("</tbody></table>")
    return "\n".join(parts)
