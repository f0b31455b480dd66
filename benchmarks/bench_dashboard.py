"""The page: how much is loaded, how late a record is seen, what 100 pages cost the recording, and whether memory stays.

Run: python benchmarks/bench_dashboard.py [--listeners 100] [--records 300] [--hour 18000]

Everything is real: the server in a process of its own, listeners on real connections, the recording by `namod-ctl
record` on the twin as fast as the computer can. Limits (issue 5): below 500 kB, below 100 ms, record rate within 5 %,
memory flat.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import selectors
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.dashboard.server import page_files
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.records import Record
from namod_ctl.store.run import RunStore

_MAIN = "from namod_ctl.app.commands.dashboard import dashboard; import typer; typer.run(dashboard)"
_RECORD = "from namod_ctl.app.cli import main; main()"
N_ROUNDS = 7  # alternating: the machine is not quiet
_ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}
_NICENESS = 19  # pages are on other computers: these here must not take the recording's time


@contextmanager
def served(path: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The dashboard's process and its port."""
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", _MAIN, str(path), "--port", "0"],
        stdout=subprocess.PIPE,
        text=True,
        env=_ENVIRONMENT,
    )
    assert process.stdout is not None
    try:
        yield process, int(process.stdout.readline().split(":")[-1].strip().rstrip("/"))
    finally:
        process.terminate()
        process.wait()


async def listen(port: int, seen_s: dict[int, float] | None = None) -> None:
    """A page that listens; notes when each number of accepted records was seen first."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=2**22)
    writer.write(f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
    while line := await reader.readline():
        if seen_s is not None and line.startswith(b'data: {"run"'):
            seen_s.setdefault(json.loads(line[6:])["n_accepted"], time.monotonic())


def record(index: int, n_facets: int, rng: np.random.Generator) -> Record:
    """Any record that counts."""
    theta_rad = rng.uniform(-4e-3, 4e-3, 2)
    light = rng.random(n_facets)
    return Record(index, "", theta_rad, 1e-6, 1.0, light, 0.0 * light, 0.1, 0.1, None, "", 0.1 * index, 0.1 * index)


def latencies_s(folder: Path, config_name: str, n_records: int, n_listeners: int) -> list[float]:
    """From the commit of a record to its arrival at one page, while others listen as well; 10 records per second."""
    config = load_config(config_name)
    ids = [facet.id for facet in config.facets]
    rng = np.random.default_rng(0)
    with (
        RunStore.create(folder / config_name, ids, config.to_json(), "", SystemClock()) as run,
        served(run.path) as (_, port),
    ):

        async def story() -> list[float]:
            seen_s: dict[int, float] = {}
            pages = [asyncio.create_task(listen(port, seen_s if i == 0 else None)) for i in range(n_listeners)]
            while 0 not in seen_s:
                await asyncio.sleep(0.01)
            committed_s = {}
            for index in range(n_records):
                await asyncio.to_thread(_append_from_elsewhere, run.path, record(index, len(ids), rng))
                committed_s[index + 1] = time.monotonic()
                await asyncio.sleep(0.1)
            await asyncio.sleep(1.0)
            for page in pages:
                page.cancel()
            # sections are sent newest first: a number that was skipped was overtaken within one look
            return [seen_s[n] - at_s for n, at_s in committed_s.items() if n in seen_s]

        return asyncio.run(story())


def _append_from_elsewhere(path: Path, one: Record) -> None:
    with RunStore.open(path, read_only=False) as run:
        run.append([one])


def rate_per_s(folder: Path, n_records: int, n_listeners: int | None) -> float:
    """Records per second of `namod-ctl record` on the twin; with so many pages that listen, or without a dashboard."""
    path = folder / f"recorded_{n_listeners}_{time.monotonic_ns()}"
    arguments = ["record", "--twin", "--config", "mini_fact", "--seed", "1", "--records", str(n_records)]
    with (folder / "record.txt").open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-c", _RECORD, *arguments, "--out", str(path)],
            stdout=output,
            stderr=output,
            env=_ENVIRONMENT,
        )

    def n_stored() -> int:
        with RunStore.open(path) as run:
            return len(run.labels())

    async def wait_for_end() -> float:
        while not (path / "run.sqlite").exists() or n_stored() < 5:
            assert process.poll() is None, (folder / "record.txt").read_text()
            await asyncio.sleep(0.05)
        began_s, n_before = time.monotonic(), n_stored()
        while process.poll() is None:
            await asyncio.sleep(0.02)
        return (n_stored() - n_before) / (time.monotonic() - began_s)

    if n_listeners is None:
        return asyncio.run(wait_for_end())
    while not (path / "run.sqlite").exists():
        time.sleep(0.05)
    with served(path) as (_, port):
        pages = get_context("spawn").Process(target=_many_pages, args=(port, n_listeners))
        pages.start()
        try:
            return asyncio.run(wait_for_end())
        finally:
            pages.kill()
            pages.join()


def _many_pages(port: int, n_listeners: int) -> None:
    """Pages that listen until they are killed, at as little cost to this computer as can be: they are others' work."""
    os.nice(_NICENESS)
    with selectors.DefaultSelector() as selector:
        for _ in range(n_listeners):
            page = socket.create_connection(("127.0.0.1", port))
            page.sendall(f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
            selector.register(page, selectors.EVENT_READ, page)
        while True:
            for key, _ in selector.select():
                key.data.recv(2**20)
            time.sleep(0.05)


def memory_mb(folder: Path, n_records: int, n_listeners: int) -> list[float]:
    """Memory of the server after each tenth of a long run, written as fast as the disk takes it in steps of 20."""
    config = load_config("mini_fact")
    ids = [facet.id for facet in config.facets]
    rng = np.random.default_rng(0)
    measured = []
    with (
        RunStore.create(folder / "long", ids, config.to_json(), "", SystemClock()) as run,
        served(run.path) as (process, port),
    ):

        async def story() -> None:
            pages = [asyncio.create_task(listen(port)) for _ in range(n_listeners)]
            for step in range(n_records // 20):
                run.append([record(20 * step + i, len(ids), rng) for i in range(20)])
                await asyncio.sleep(0.005)
                if (step + 1) % (n_records // 200) == 0:
                    status = Path(f"/proc/{process.pid}/status").read_text()
                    measured.append(int(status.split("VmRSS:")[1].split()[0]) / 1024.0)
            for page in pages:
                page.cancel()

        asyncio.run(story())
    return measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--listeners", type=int, default=100)
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--hour", type=int, default=18_000, help="records of the long run: an hour of 5 per second")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        size_kb = sum(len(content) for content, _ in page_files().values()) / 1000.0
        print(f"page, all files:                         {size_kb:7.1f} kB")
        for config_name, n_listeners in (("mini_fact", 1), ("mini_fact", options.listeners), ("lst_like", 1)):
            (folder / str(n_listeners)).mkdir(exist_ok=True)
            found_ms = [1e3 * each for each in latencies_s(folder / str(n_listeners), config_name, 50, n_listeners)]
            title = f"commit to page, {config_name}, {n_listeners} pages:"
            worst = f"{max(found_ms):.1f} ms worst of {len(found_ms)}"
            print(f"{title:40} {statistics.median(found_ms):7.1f} ms median, {worst}")
        rates: dict[int | None, list[float]] = {None: [], options.listeners: []}
        for _ in range(N_ROUNDS):
            for n_listeners, found in rates.items():
                found.append(rate_per_s(folder, options.records, n_listeners))
        alone, beside = (statistics.median(found) for found in rates.values())
        print(f"record rate without a dashboard:         {alone:7.2f} per s")
        title = f"record rate with {options.listeners} pages:"
        print(f"{title:40} {beside:7.2f} per s ({beside / alone - 1:+.1%})")
        measured = memory_mb(folder, options.hour, 10)
        print(f"server's memory over {options.hour} records:  {' '.join(f'{each:.0f}' for each in measured)} MB")


if __name__ == "__main__":
    main()
