"""The report of a run and of a campaign: everything is in it, nothing in it can run, and it can be made again."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tomllib
from html.parser import HTMLParser

import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_night import FACET_IDS, SEED, manual_campaign, small_config, small_twin
from typer.testing import CliRunner

from namod_ctl.app.build.twin import load_twin_settings
from namod_ctl.app.build.twin_note import note_twin, noted_twin
from namod_ctl.app.cli import app
from namod_ctl.app.commands.align import NOTE_WISHES
from namod_ctl.app.config.instrument import builtin_names, load_config
from namod_ctl.app.report.document import Chapter, Document, Listing, Picture, Table, Text
from namod_ctl.app.report.html_page import to_html
from namod_ctl.app.report.pdf_pages import to_pdf
from namod_ctl.app.report.toml_text import to_toml
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.run import RunStore
from namod_ctl.twin.settings import FaultSpec, TwinSettings

VOID = {"meta", "img", "br", "input"}
EVIL = "<script>alert(1)</script>\" onmouseover='x' & </td></table><img src=http://elsewhere/x onerror=y>"


class Page(HTMLParser):
    """What a browser would make of it: tags that fit, row names, text, and everything that could load or run."""

    def __init__(self, data: bytes) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.headings: list[str] = []
        self.rows: list[list[str]] = []
        self.text = ""
        self.feed(data.decode())
        self.close()
        assert self.open == [], "tags left open"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag == "h2":
            self.headings.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"{tag} is closed out of order"

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data
        if self.open and self.open[-1] == "h2":
            self.headings[-1] += data
        if not self.open or self.open[-1] != "style":
            self.text += data

    def assert_harmless(self):
        assert not {"script", "iframe", "object", "embed", "form", "link", "base", "svg"} & set(self.tags)
        for tag, name, value in self.attributes:
            assert not name.startswith("on"), (tag, name)
            if name in ("src", "href", "data", "action", "srcset", "poster"):
                assert value.startswith(("data:image/png;base64,", "#")), (tag, name, value[:60])
        assert "url(" not in self.text


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def pdf_text(path):
    if shutil.which("pdftotext") is None:
        pytest.skip("pdftotext (poppler-utils) is not installed")
    return subprocess.run(["pdftotext", "-layout", path, "-"], check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    return manual_campaign(tmp_path_factory.mktemp("night") / "CAMPAIGN")


@pytest.fixture(scope="module")
def reported(campaign):
    result = call("report", campaign)
    assert result.exit_code == 0, result.output
    return campaign / "report"


def test_a_campaign_report_holds_every_facet_turn_and_cycle(campaign, reported):
    page = Page((reported / "report.html").read_bytes())
    page.assert_harmless()
    with CampaignStore.open(campaign) as store:
        cycles, turns = store.cycles(), store.turns(1)
        events = store.events()
    assert len(cycles) == 2
    assert turns
    by_chapter = page.text
    rows_of = {facet_id: [row for row in page.rows if row[0] == str(facet_id)] for facet_id in FACET_IDS}
    assert all(rows_of.values())
    for asked in turns:
        wanted = [f"{turn:+.0f}" if turn else "0" for turn in asked.turns_deg]
        assert any(row[1:4] == wanted and row[4] == "yes" for row in rows_of[asked.facet_id]), asked
    for cycle in cycles:
        assert cycle.decision in by_chapter
    for event in events:
        assert str(event.data.get("reason", event.text)) in by_chapter
    for words in ("Star camera", "radiometric law", "plate scale", f"seed {SEED}", "limit: ray-traced"):
        assert words in by_chapter
    text = pdf_text(reported / "report.pdf")
    assert all(re.search(rf"^ *{facet_id} ", text, re.MULTILINE) for facet_id in FACET_IDS)
    assert all(heading in text for heading in page.headings), page.headings


def test_the_commands_of_a_report_name_files_that_are_there_and_make_the_same_twin(campaign, reported):
    page = Page((reported / "report.html").read_bytes())
    command = next(line for line in page.text.splitlines() if line.startswith("namod-ctl align"))
    options = dict(re.findall(r"--(\S+) (\S+)", command))
    assert load_config(reported / options["config"]) == small_config()
    assert options["seed"] == str(SEED)
    with CampaignStore.open(campaign) as store:
        assert (load_twin_settings(reported / options["twin-settings"]), SEED) == noted_twin(store)


def test_the_program_knows_every_option_of_the_command_that_a_report_names(tmp_path):
    with CampaignStore.create(tmp_path / "C", small_config().to_json(), "a test", SystemClock()) as store:
        store.set_note(NOTE_WISHES, json.dumps({"records": 90, "cycles": 3, "approve": "ask", "keep_frames": "all"}))
    assert call("report", tmp_path / "C").exit_code == 0
    page = Page((tmp_path / "C" / "report" / "report.html").read_bytes())
    command = next(line for line in page.text.splitlines() if line.startswith("namod-ctl align"))
    assert "--keep-frames all" in command
    result = call(*command.split()[1:], "--help")
    assert result.exit_code == 0, result.output


def test_a_cycle_is_a_run_and_has_a_report_of_its_own(campaign, tmp_path):
    result = call("report", campaign / "cycle_02", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    page = Page((tmp_path / "report.html").read_bytes())
    page.assert_harmless()
    assert {str(facet_id) for facet_id in FACET_IDS} <= {row[0] for row in page.rows}
    assert "Point spread functions and pointings" in page.headings
    assert "namod-ctl reconstruct cycle_02" in page.text


def test_a_run_without_enough_records_is_reported_with_what_is_known(tmp_path):
    config = small_config()
    name = EVIL[:70]
    config = config.model_copy(update={"telescope": config.telescope.model_copy(update={"name": name})})
    path = tmp_path / "RUN"
    with RunStore.create(path, FACET_IDS, config.to_json(), EVIL, small_twin(config).wall_clock) as run:
        note_twin(run, TwinSettings(faults=(FaultSpec("satellite", 3.0),)), 5)
    result = call("report", path)
    assert result.exit_code == 0, result.output
    page = Page((path / "report" / "report.html").read_bytes())
    page.assert_harmless()
    assert name in page.text  # as text, whole
    assert EVIL in page.text
    assert "There is none" in page.text
    assert "at least 10" in page.text


def test_nothing_in_a_document_becomes_markup():
    png = bytes.fromhex(
        "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c4944415408d763f8ffff3f0005fe02fe"
        "dccc59e70000000049454e44ae426082"
    )
    blocks = (
        Text(EVIL), Text(EVIL, is_warning=True), Listing((EVIL, "a  b")), Picture(png, EVIL),
        Table((EVIL, "n"), ((EVIL, EVIL), ("13</th>", "1")), frozenset({0})),
    )  # fmt: skip
    document = Document(EVIL, EVIL, (Chapter(EVIL, blocks),))
    page = Page(to_html(document))
    page.assert_harmless()
    assert page.headings == [EVIL]
    assert page.rows == [[EVIL, "n"], [EVIL, EVIL], ["13</th>", "1"]]
    assert to_pdf(document).startswith(b"%PDF")


def test_a_table_of_a_thousand_facets_and_many_columns_fits_on_pages(tmp_path):
    head = ("facet", *(f"a long heading of column {n}" for n in range(15)), "words")
    rows = tuple((str(n), *["-12.345"] * 15, "said of it " * 6) for n in range(1000))
    document = Document("t", "s", (Chapter("c", (Table(head, rows, frozenset({16})),)),))
    (tmp_path / "wide.pdf").write_bytes(to_pdf(document))
    text = pdf_text(tmp_path / "wide.pdf")
    assert len(re.findall(r"-12\.345", text)) == 15000


@pytest.mark.parametrize("name", builtin_names())
def test_a_config_written_as_toml_is_read_as_the_same_config(name, tmp_path):
    config = load_config(name)
    file = tmp_path / "used.toml"
    file.write_text(to_toml(config.model_dump(exclude_none=True, mode="json")))
    assert load_config(file) == config


_scalars = (
    st.text(st.characters(codec="utf-8")) | st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False)
)
_values = st.recursive(
    _scalars, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
)


@given(st.dictionaries(st.text(max_size=8), _values, max_size=4))
def test_whatever_is_written_as_toml_comes_back(sections):
    assert tomllib.loads(to_toml(sections)) == sections


def test_a_report_of_nothing_says_what_is_there(campaign, tmp_path):
    shutil.copytree(campaign / "cycle_01", tmp_path / "NIGHT")
    result = call("report", tmp_path / "NIGTH")
    assert result.exit_code != 0
    assert f"{tmp_path / 'NIGHT'}" in str(result.exception)


def test_faults_are_told_in_words_with_what_was_done(tmp_path):
    orders = [MoveOrder(Leg(3, k), 0.0, 1e-4) for k in range(3)]
    clock = small_twin(small_config()).wall_clock
    with CampaignStore.create(tmp_path / "C", small_config().to_json(), "made", clock) as store:
        store.add_transition("idle", "checking", "start", "asked for")
        for facet_id in (4, 10, 19):
            data = {"cycle": 1, "facet_id": facet_id, "why": "nobody saw it"}
            store.add_event("refused", f"facet {facet_id}: nobody saw it", data)
        ids = store.order(store.begin_cycle(), orders)
        store.result(ids[0], MoveResult(orders[0], MoveOutcome.ARRIVED, 1e-4))
        store.result(ids[1], MoveResult(orders[1], MoveOutcome.FAULT, 3e-5, f"stalled {EVIL}"))
        store.add_transition("correcting", "held", "hold", "a drive reports a fault")
    result = call("report", tmp_path / "C")
    assert result.exit_code == 0, result.output
    page = Page((tmp_path / "C" / "report" / "report.html").read_bytes())
    page.assert_harmless()
    rows = [" | ".join(row) for row in page.rows]
    assert sum("facets 4, 10, 19: nobody saw it" in row for row in rows) == 2  # in the journal and among the faults
    assert any("facet 3 leg 2 | +0.100 | the drive reports a fault: stalled" in row for row in rows)
    assert any("facet 3 leg 3 | +0.100 | ordered, and never read back" in row for row in rows)
    assert any("held: all motion is stopped" in row and "a drive reports a fault" in row for row in rows)
    assert any("leg 2 fault, leg 3 unknown" in row for row in rows)
    assert "1 of 3 ordered legs arrived" in page.text
    assert "no cycle has been reconstructed" in page.text
