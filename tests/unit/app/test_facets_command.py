"""`namod-ctl facets` as people type it."""

from __future__ import annotations

import http.client
import json
import re
import signal
import socket
import subprocess
import sys

import cv2
import numpy as np
import pytest
from facet_editor_rig import truth, write_picture
from typer.testing import CliRunner

from namod_ctl.app.cli import app
from namod_ctl.app.config.instrument import builtin_folder, load_config
from namod_ctl.core.errors import ConfigError
from namod_ctl.store.facet_tables import read_polygon_table


def run(*arguments: object):
    return CliRunner().invoke(app, ["facets", *map(str, arguments)])


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory):
    return write_picture(tmp_path_factory.mktemp("picture"))


def write_marks(folder, ids=(13, 18, 11, 33), noise_px: float = 0.0):
    rng = np.random.default_rng(1)
    centres, _ = truth(folder)
    rows = [f"{i},{x:.2f},{y:.2f}" for i in ids for x, y in [centres[i] + rng.normal(0.0, noise_px, 2)]]
    path = folder / "marks.csv"
    path.write_text("\n".join(["facet_id,x_px,y_px", *rows]) + "\n")
    return path


def test_marks_in_a_file_become_a_map(tmp_path, picture):
    out = tmp_path / "map.csv"
    done = run("propose", "--image", picture, "--marks", write_marks(tmp_path, noise_px=1.0), "--out", out)
    assert done.exit_code == 0, done.output
    assert "Edges of 100% of the facets found" in done.output
    found, (_, outlines) = read_polygon_table(out), truth(tmp_path)
    assert max(np.abs(found[i] - outlines[i]).max() for i in outlines) < 0.5
    assert run("check", out, "--config", "fact").exit_code == 0


def test_a_config_of_ones_own_keeps_its_map(tmp_path, picture):
    """The file that the config names is written, and the config can then be loaded with it."""
    for name in ("fact.toml", "fact_facets.csv", "fact_polygons.csv"):
        (tmp_path / name).write_text((builtin_folder() / name).read_text())
    config = tmp_path / "fact.toml"
    done = run("propose", "--image", picture, "--config", config, "--marks", write_marks(tmp_path), "--no-edges")
    assert done.exit_code == 0, done.output
    polygons = {polygon.facet_id: np.array(polygon.corners_px) for polygon in load_config(config).polygons}
    _, outlines = truth(tmp_path)
    assert max(np.abs(polygons[i] - outlines[i]).max() for i in outlines) < 0.6
    assert "fact_polygons.csv.bak" in done.output  # what was there before is kept, and never replaced
    assert (tmp_path / "fact_polygons.csv.bak").read_text() == (builtin_folder() / "fact_polygons.csv").read_text()
    first = (tmp_path / "fact_polygons.csv").read_bytes()
    again = run("propose", "--image", picture, "--config", config, "--marks", write_marks(tmp_path), "--no-edges")
    assert again.exit_code == 0, again.output
    assert (tmp_path / "fact_polygons.csv.bak2").read_bytes() == first


def test_a_config_whose_map_is_still_to_be_made(tmp_path, picture):
    """Who begins with a telescope of their own names the file in the config, and then makes it."""
    for name in ("fact.toml", "fact_facets.csv"):
        (tmp_path / name).write_text((builtin_folder() / name).read_text())
    config = tmp_path / "fact.toml"
    with pytest.raises(ConfigError, match=r"fact_polygons\.csv: there is no such file.*facets edit"):
        load_config(config)
    done = run("propose", "--image", picture, "--config", config, "--marks", write_marks(tmp_path), "--no-edges")
    assert done.exit_code == 0, done.output
    assert "The config uses it from now on." in done.output
    assert len(load_config(config).polygons) == 30


def test_a_builtin_config_is_not_written_to(tmp_path, picture):
    before = (builtin_folder() / "fact_polygons.csv").read_bytes()
    done = run("propose", "--image", picture, "--marks", write_marks(tmp_path))
    assert isinstance(done.exception, ConfigError)
    assert "--out FILE" in str(done.exception)
    assert (builtin_folder() / "fact_polygons.csv").read_bytes() == before


def test_a_picture_of_another_size_gives_the_same_map(tmp_path, picture):
    large = tmp_path / "large.png"
    image = cv2.imread(str(picture))
    cv2.imwrite(str(large), cv2.resize(image, (2048, 1536), interpolation=cv2.INTER_LINEAR))
    marks = write_marks(tmp_path)
    rows = [line.split(",") for line in marks.read_text().splitlines()[1:]]
    scaled = [f"{i},{2 * float(x) + 0.5:.2f},{2 * float(y) + 0.5:.2f}" for i, x, y in rows]
    marks.write_text("\n".join(["facet_id,x_px,y_px", *scaled]) + "\n")
    done = run("propose", "--image", large, "--marks", marks, "--out", tmp_path / "map.csv")
    assert done.exit_code == 0, done.output
    found, (_, outlines) = read_polygon_table(tmp_path / "map.csv"), truth(tmp_path)
    assert max(np.abs(found[i] - outlines[i]).max() for i in outlines) < 0.5


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("facet_id,x_px,y_px\n13,1,1\n13,9,9\n13,9,1\n13,1,9\n", "crosses itself"),
        ("facet_id,x_px,y_px\n999,1,1\n999,9,9\n999,9,1\n", "no facet of this id"),
        ("facet_id,x_px,y_px\n13,1,1\n13,9,9\n13,9,1\n18,1,2\n18,9,10\n18,9,2\n", "overlaps"),
    ],
)
def test_check_names_what_is_wrong(tmp_path, text, says):
    (tmp_path / "map.csv").write_text(text)
    done = run("check", tmp_path / "map.csv")
    assert isinstance(done.exception, ConfigError)
    assert says in str(done.exception)


def test_the_editor_announces_its_address_serves_and_ends_with_ctrl_c(tmp_path, picture):
    arguments = ["facets", "edit", "--image", str(picture), "--out", str(tmp_path / "map.csv")]
    code = "from namod_ctl.app.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", code, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        host, token = re.search(r"http://(127\.0\.0\.1:\d+)/#(\S{32})\n", process.stdout.readline()).groups()
        connection = http.client.HTTPConnection(host, timeout=30)
        connection.request("GET", "/map")
        assert json.loads(connection.getresponse().read())["telescope"] == "FACT"
        headers = {"Origin": f"http://{host}", "X-Namod-Token": token, "Content-Type": "application/json"}
        connection.request("POST", "/check", b'{"facets": []}', headers)
        assert len(json.loads(connection.getresponse().read())["missing"]) == 30
        connection.close()
        process.send_signal(signal.SIGINT)
        _, complaints = process.communicate(timeout=30)
        assert (process.returncode, complaints) == (0, "")
    finally:
        process.kill()
        process.wait()


def test_a_port_in_use_is_told(tmp_path, picture):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = run("edit", "--image", picture, "--out", tmp_path / "map.csv", "--port", port)
    assert isinstance(done.exception, ConfigError)
    assert f"--port {port}" in str(done.exception)


def test_nothing_to_go_by_is_refused(tmp_path, picture):
    done = run("propose", "--image", picture, "--no-edges", "--out", tmp_path / "map.csv")
    assert "give --marks" in str(done.exception)


def test_a_picture_that_is_cut_is_named(tmp_path, picture):
    cut = tmp_path / "cut.png"
    cv2.imwrite(str(cut), cv2.imread(str(picture))[:400])
    done = run("propose", "--image", cut, "--out", tmp_path / "map.csv")
    assert isinstance(done.exception, ConfigError)
    assert str(done.exception).startswith(f"{cut}: the image has")
