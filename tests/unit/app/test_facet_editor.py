"""The editor's addresses: what they answer to its page, and what they refuse to everybody else."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from facet_editor_rig import TOKEN, Editor, running_editor
from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.app.facet_editor.messages import Drawing, Marks, read_message
from namod_ctl.core.errors import ConfigError
from namod_ctl.store.facet_tables import read_polygon_table

MARKED = (13, 18, 11, 33)


@pytest.fixture(scope="module")
def editor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Editor]:
    with running_editor(tmp_path_factory.mktemp("editor")) as running:
        yield running


def request(editor: Editor, method: str, path: str, body: bytes | None = None, **headers: str | None):
    """Status, headers and body; a header of None is left out."""
    usual = {"Host": editor.host}
    if method == "POST":
        usual |= {
            "Origin": f"http://{editor.host}",
            "X-Namod-Token": TOKEN,
            "Content-Type": "application/json",
            "Content-Length": str(len(body or b"")),
        }
    usual |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection(editor.host, timeout=30)
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    for name, value in usual.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders(body)
    answer = connection.getresponse()
    found = answer.status, answer.headers, answer.read()
    connection.close()
    return found


def ask(editor: Editor, what: str, message: object) -> tuple[int, dict]:
    status, _, body = request(editor, "POST", f"/{what}", json.dumps(message).encode())
    return status, json.loads(body)


def marked(editor: Editor, ids=MARKED) -> dict:
    return {"facets": [{"id": i, "points": [editor.centres_px[i].tolist()]} for i in ids]}


def worst_px(editor: Editor, facets: list[dict]) -> float:
    worst = 0.0
    for facet in facets:
        points, true = np.array(facet["points"]), editor.outlines_px[facet["id"]]
        worst = max(worst, float(np.linalg.norm(points[:, None] - true[None], axis=2).min(axis=1).max()))
    return worst


def test_the_page_and_all_it_needs_come_from_here(editor):
    status, headers, body = request(editor, "GET", "/")
    assert status == 200
    assert b"http" not in body.replace(b"http-equiv", b"")  # no address of another host
    assert "default-src 'none'" in headers["content-security-policy"]
    for name in (
        "editor.js",
        "board.js",
        "model.js",
        "server.js",
        "theme.js",
        "editor.css",
        "icon.svg",
        "picture.png",
        "map",
    ):
        assert request(editor, "GET", f"/{name}")[0] == 200


def test_4_marks_and_all_outlines_follow(editor):
    status, found = ask(editor, "solve", marked(editor))
    assert status == 200
    assert found["rms_px"] < 0.1
    assert len(found["facets"]) == 30
    assert worst_px(editor, found["facets"]) < 0.5


def test_exchanged_ids_come_back_with_the_ids_to_look_at(editor):
    message = marked(editor, (13, 18, 11, 33, 10))
    message["facets"][0]["id"], message["facets"][2]["id"] = 11, 13
    status, found = ask(editor, "solve", message)
    assert status == 422
    assert found["ids"] == [11, 13]
    assert "exchanged" in found["error"]


def test_edges_make_a_proposal(editor):
    status, found = ask(editor, "propose", marked(editor))
    assert (status, found["doubts"]) == (200, [])
    assert worst_px(editor, found["facets"]) < 0.5


def test_a_sound_map_is_saved_and_read_back(editor):
    facets = ask(editor, "solve", marked(editor))[1]["facets"]
    status, found = ask(editor, "save", {"facets": facets, "basis": "marks"})
    assert (status, found["n_facets"]) == (200, 30)
    assert Path(found["written"]) == editor.out
    read = read_polygon_table(editor.out)
    assert sorted(read) == sorted(editor.outlines_px)
    assert "camera pose from" in editor.out.read_text().split("facet_id,x_px")[0]
    assert list(editor.out.parent.glob(".map.csv*")) == []  # no half-written file is left


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda facets: [*facets[:-1]], "have no outline"),
        (lambda facets: [*facets, facets[0]], "occur more than once"),
        (lambda facets: [*facets[:-1], facets[-1] | {"id": 777}], "is no facet of this reflector"),
        (lambda facets: [*facets[:-1], facets[-1] | {"points": facets[0]["points"]}], "overlaps with facet"),
        (lambda facets: [*facets[:-1], facets[-1] | {"points": [[1, 1], [9, 9], [9, 1], [1, 9]]}], "crosses itself"),
        (lambda facets: [*facets[:-1], facets[-1] | {"points": [[1, 1], [-9, 9], [9, 1]]}], "outside the image"),
        (lambda facets: [], "empty"),
        (lambda facets: "facets", "something else than facets"),
        (lambda facets: [facets[0] | {"id": "<script>"}], "something else than facets"),
    ],
)
def test_a_faulty_map_is_refused_and_the_old_one_stays(editor, change, text):
    facets = ask(editor, "solve", marked(editor))[1]["facets"]
    editor.out.write_text("as it was")
    status, found = ask(editor, "save", {"facets": change(facets)})
    assert status == 422
    assert text in found["error"]
    assert editor.out.read_text() == "as it was"


def test_a_missing_facet_can_be_confirmed(editor):
    facets = ask(editor, "solve", marked(editor))[1]["facets"][1:]
    assert ask(editor, "check", {"facets": facets})[1] == {"faults": [], "missing": [0]}
    assert ask(editor, "save", {"facets": facets, "is_missing_confirmed": True})[0] == 200
    assert 0 not in read_polygon_table(editor.out)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"X_Namod_Token": None}, 401),
        ({"X_Namod_Token": "wrong"}, 401),
        ({"X_Namod_Token": "\xff\xfe"}, 401),
        ({"Origin": None}, 403),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Host": "evil.example"}, 421),
        ({"Content_Length": "5000000"}, 413),
        ({"Content_Type": "text/plain"}, 415),  # what a form of another site could send without asking
    ],
)
def test_strangers_write_nothing(editor, headers, status):
    editor.out.write_text("as it was")
    assert request(editor, "POST", "/save", b'{"facets": []}', **headers)[0] == status
    assert editor.out.read_text() == "as it was"


def test_a_body_without_a_length_is_not_read_for_ever(editor):
    editor.out.write_text("as it was")
    chunk = b"x" * 100_000
    connection = http.client.HTTPConnection(editor.host, timeout=30)
    headers = {"Origin": f"http://{editor.host}", "X-Namod-Token": TOKEN, "Content-Type": "application/json"}
    connection.request("POST", "/save", iter([chunk] * 41), headers, encode_chunked=True)
    answer = connection.getresponse()
    assert answer.status == 422
    assert b"at most 4000000 bytes" in answer.read()
    connection.close()
    assert editor.out.read_text() == "as it was"


@given(
    body=st.binary(max_size=80)
    | st.recursive(
        st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8) | st.just("facets"),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["facets", "id", "points"]), inner),
        max_leaves=12,
    ).map(lambda value: json.dumps(value).encode())
)
def test_any_message_is_understood_or_refused_in_words(body):
    for kind in (Marks, Drawing):
        with suppress(ConfigError):
            assert all(np.isfinite(facet.points).all() for facet in read_message(kind, body).facets)


def test_strangers_read_nothing(editor):
    assert request(editor, "GET", "/picture.png", Host="evil.example")[0] == 421
    for path in ("/../../../pyproject.toml", "/%2e%2e%2fserver.py", "/server.py", "/workbench.py"):
        assert request(editor, "GET", path)[0] == 404
