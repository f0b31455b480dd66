"""`namod-ctl report`: everything about a run or a campaign in one file to read, to print and to keep."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from namod_ctl.app.report.html_page import to_html
from namod_ctl.app.report.of_campaign import campaign_report
from namod_ctl.app.report.of_run import run_report
from namod_ctl.app.report.pdf_pages import to_pdf
from namod_ctl.core.errors import ConfigError
from namod_ctl.store.campaign_database import is_campaign
from namod_ctl.store.folders import is_run, named_near
from namod_ctl.store.results import write_results

HTML_FILE, PDF_FILE = "report.html", "report.pdf"
DEFAULT_FOLDER = "report"


def report(
    source: Annotated[Path, typer.Argument(metavar="RUN|CAMPAIGN", help="Folder of a run or of a campaign.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the files.  [default: `report` in the run or campaign]")
    ] = None,
) -> None:
    """Write report.html and report.pdf: what was done with what, what came of it, and how to get it again.

    The HTML needs no other file, no network and no script; it is red on black where the browser is set to dark, or
    after a tick in it. The PDF is for paper: black on white; beside the telescope read the HTML. Beside them lie the
    config as it was used and, for a twin of its own settings, these.

    Example: namod-ctl report CAMPAIGN
    """
    if not is_campaign(source) and not is_run(source):
        near = named_near(source, lambda folder: is_campaign(folder) or is_run(folder))
        raise ConfigError(f"{source}: there is neither a run nor a campaign here{near}")
    console = Console(highlight=False)
    if out is not None and not out.is_dir():
        raise ConfigError(f"{out}: this folder does not exist; make it, or leave --out out to write into {source}")
    with console.status("gathering and drawing"):
        document, files = campaign_report(source) if is_campaign(source) else run_report(source)
        files = {HTML_FILE: to_html(document), PDF_FILE: to_pdf(document), **files}
    folder = out if out is not None else source / DEFAULT_FOLDER
    folder.mkdir(exist_ok=True)
    write_results(folder, files)
    console.print(f"Written to {folder}: {', '.join(files)}", soft_wrap=True, markup=False)
