"""The run: one recording on disk, with its records, frames and estimates.

A run is a folder with `run.sqlite` and `frames/`. A record exists when its transaction is committed; a kill at
any moment loses at most the record in flight, and a frame without a committed record is never looked at.

Cost, one row per record and facet (`database` says why), measured on a virtual machine's SSD: a record of 30
facets is on the disk after 0.3 ms, one of 1000 facets after 2 ms; 1300 x 30 responses are read in 0.04 s,
1000 x 1000 in 0.75 s (29 MB).
"""

from __future__ import annotations

import json
import os
import re
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from namod_ctl import __version__
from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import StoreError
from namod_ctl.core.records import Record
from namod_ctl.store.database import DATABASE_NAME, connect_existing, connect_new, store_errors, transaction, unsynced
from namod_ctl.store.folders import check_output, discard, free_sibling, put_in_place, require_run
from namod_ctl.store.frames import Frame, decode_png, encode_png, read_verified, sync_folder, write_file_durably
from namod_ctl.store.run_rows import INSERT_RECORD, record_columns, record_of, record_row

FRAMES_FOLDER = "frames"
_ROWS_PER_READ = 65536
NOTE_PREFIX = "note."  # of keys of notes in the table meta, apart from the run's own
_CAMERA_NAME = re.compile(r"[a-z0-9_]+")


class RunStore:
    """A run that is open; a context manager that closes it. Use `create` or `open`.

    Every method raises StoreError, with path and remedy, when the disk or the database refuses.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self._database = path / DATABASE_NAME
        with store_errors(self._database):
            self._stat = self._database.stat()
            self._meta: dict[str, str] = dict(connection.execute("SELECT key, value FROM meta"))
            rows = connection.execute("SELECT facet_id FROM facets ORDER BY position").fetchall()
        self._facet_ids = tuple(int(row[0]) for row in rows)

    @classmethod
    def create(
        cls,
        path: Path | str,
        facet_ids: Sequence[int],
        config_json: str,
        source: str,
        clock: Clock,
        force: bool = False,
    ) -> Self:
        """A new, empty run at `path`, open for writing.

        Parameters
        ----------
        facet_ids
            Order of the facets in every record's arrays.
        config_json
            The instrument's config as used, self-contained (a JSON object with `telescope.name`).
        source
            Where the records come from, for people.
        force
            Replace an older run (or an empty folder) at `path`; anything else is never replaced.

        Raises
        ------
        ConfigError
            Something is at `path` that may not be replaced, or the folder above does not exist.
        """
        path = Path(path).resolve()
        if len(set(facet_ids)) != len(facet_ids):
            raise ValueError(f"facet ids appear twice: {list(facet_ids)}")
        check_output(path, force=force)
        meta = {
            "telescope": _telescope_name(config_json),
            "config_json": config_json,
            "source": source,
            "created_utc": clock.now().isoformat(),
            "program_version": __version__,
        }
        built = free_sibling(path)
        try:
            _write_empty_run(built, facet_ids, meta)
            put_in_place(built, path, force=force)
        except BaseException:
            discard(built)
            raise
        return cls.open(path, read_only=False)

    @classmethod
    def open(cls, path: Path | str, read_only: bool = True) -> Self:
        """The run at `path`.

        Raises
        ------
        ConfigError
            There is no run at `path`.
        StoreError
            It was written by a newer program, is damaged, or cannot be opened.
        """
        path = Path(path).resolve()
        require_run(path)
        connection = connect_existing(path / DATABASE_NAME, read_only=read_only)
        try:
            run = cls(path, connection)
            run._check_meta()
        except BaseException:
            connection.close()
            raise
        return run

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Fold SQLite's log into the one file and let go of it."""
        with store_errors(self._database):
            self._connection.close()

    def check_in_place(self) -> None:
        """Nothing, while the run's file is still the one that was opened.

        SQLite goes on writing into a file that was deleted or moved away, and nobody would ever read that.

        Raises
        ------
        StoreError
            It is gone (its cause is then ENOENT, which waiting mends when the folder is put back), or another is there.
        """
        remedy = "put its folder back, or end this program and record anew: what it records now is lost"
        try:
            now = self._database.stat()
        except OSError as error:
            raise StoreError(
                f"{self.path}: THE RUN IS GONE ({error.strerror}): it was deleted or moved, or its disk was taken "
                f"away; {remedy}"
            ) from error
        if not os.path.samestat(now, self._stat):
            raise StoreError(f"{self.path}: THE RUN WAS REPLACED by another one; {remedy}")

    @property
    def facet_ids(self) -> tuple[int, ...]:
        """Facet ids in the order of every record's arrays."""
        return self._facet_ids

    @property
    def config_json(self) -> str:
        """The instrument's config as used."""
        return self._meta["config_json"]

    @property
    def telescope(self) -> str:
        """Name of the telescope."""
        return self._meta["telescope"]

    @property
    def source(self) -> str:
        """Where the records come from, for people."""
        return self._meta["source"]

    @property
    def created_utc(self) -> str:
        """When the run was made, ISO 8601."""
        return self._meta["created_utc"]

    @property
    def program_version(self) -> str:
        """Version of the program that made the run."""
        return self._meta["program_version"]

    def note(self, key: str) -> str | None:
        """What an importer or recorder noted under `key` about this run, None when it did not."""
        return self._meta.get(NOTE_PREFIX + key)

    def set_note(self, key: str, text: str, *, is_passing: bool = False) -> None:
        """Note something about this run, in place of what stood under `key`.

        What `is_passing` is not waited for until it is on the disk: other programs see it at once, and it may be gone
        after a power cut.
        """
        self.check_in_place()
        with store_errors(self._database), unsynced(self._connection) if is_passing else nullcontext():
            rows = self._write_notes({key: text})
        self._meta |= rows

    def append(self, records: Iterable[Record], notes: Mapping[str, str] | None = None) -> None:
        """Add records and set notes, all of them or nothing: when this returns they are on the disk.

        Raises StoreError for an index that the run already has, and when the run is not where it was opened.
        """
        records = list(records)
        n_facets = len(self._facet_ids)
        for record in records:
            if record.facet_intensity.shape != (n_facets,) or record.facet_saturated_share.shape != (n_facets,):
                raise ValueError(f"record {record.index}: its arrays do not fit the run's {n_facets} facets")
        self.check_in_place()
        with store_errors(self._database), transaction(self._connection):
            self._connection.executemany(INSERT_RECORD, map(record_row, records))
            self._connection.executemany(
                "INSERT INTO responses VALUES (?, ?, ?, ?)",
                (row for record in records for row in self._response_rows(record)),
            )
            rows = self._write_notes(notes or {})
        self._meta |= rows

    def records(self) -> list[Record]:
        """All records, ascending by index."""
        with store_errors(self._database), transaction(self._connection, reads_only=True):
            columns = record_columns(str(row[1]) for row in self._connection.execute("PRAGMA table_info(records)"))
            rows = self._connection.execute(f"SELECT {columns} FROM records ORDER BY record_index").fetchall()
            responses = self._read_responses(len(rows))
        return [
            record_of(row, intensity.copy(), share.copy(), self._database)
            for row, (intensity, share) in zip(rows, responses, strict=True)
        ]

    def labels(self) -> list[tuple[int, str]]:
        """Index and label of all records, ascending by index."""
        with store_errors(self._database):
            rows = self._connection.execute("SELECT record_index, label FROM records ORDER BY record_index").fetchall()
        return [(int(index), str(label)) for index, label in rows]

    def add_frame(self, record_index: int, camera: str, frame: Frame) -> None:
        """Keep a frame, uint8 or uint16 of shape (rows, columns) or (rows, columns, 3) in OpenCV's channel order.

        Frames go before the record they belong to: once the record is committed, its frames are there.
        """
        self.add_png(record_index, camera, encode_png(frame))

    def add_png(self, record_index: int, camera: str, data: bytes) -> None:
        """Keep a frame that is a PNG file already, byte by byte."""
        if not _CAMERA_NAME.fullmatch(camera):
            raise ValueError(f"{camera!r} is no camera's name")
        self.check_in_place()
        name = f"{record_index:06d}_{camera}.png"
        with store_errors(self.path):
            sha256 = write_file_durably(self.path / FRAMES_FOLDER / name, data)
            self._connection.execute(
                "INSERT OR REPLACE INTO frames VALUES (?, ?, ?, ?)", (record_index, camera, name, sha256)
            )

    def frame(self, record_index: int, camera: str) -> Frame:
        """The frame as it was kept. Raises StoreError when it was not kept, is missing or has changed since."""
        with store_errors(self._database):
            row = self._connection.execute(
                "SELECT file_name, sha256 FROM frames WHERE record_index = ? AND camera = ?", (record_index, camera)
            ).fetchone()
        if row is None:
            raise StoreError(f"{self.path}: the {camera} frame of record {record_index} was not kept in this run")
        file = self.path / FRAMES_FOLDER / str(row[0])
        data = read_verified(file, str(row[1]))
        try:
            return decode_png(data)
        except ValueError as error:
            raise StoreError(f"{file}: {error}") from error

    def frame_files(self, camera: str) -> dict[int, tuple[Path, str]]:
        """File and SHA-256 of every frame of that camera, by record index; for `frames.read_verified`."""
        with store_errors(self._database):
            rows = self._connection.execute(
                "SELECT record_index, file_name, sha256 FROM frames WHERE camera = ?", (camera,)
            ).fetchall()
        return {int(index): (self.path / FRAMES_FOLDER / str(name), str(sha256)) for index, name, sha256 in rows}

    def save_estimate(self, estimator: str, alignment_json: str, clock: Clock) -> None:
        """Add an estimate to the run's history."""
        with store_errors(self._database):
            self._connection.execute(
                "INSERT INTO estimates (created_utc, estimator, alignment_json, program_version) VALUES (?, ?, ?, ?)",
                (clock.now().isoformat(), estimator, alignment_json, __version__),
            )

    def latest_estimate(self) -> str | None:
        """The alignment JSON of the estimate saved last, None when there is none."""
        with store_errors(self._database):
            row = self._connection.execute(
                "SELECT alignment_json FROM estimates ORDER BY estimate_id DESC LIMIT 1"
            ).fetchone()
        return None if row is None else str(row[0])

    def _write_notes(self, notes: Mapping[str, str]) -> dict[str, str]:
        rows = {NOTE_PREFIX + key: text for key, text in notes.items()}
        self._connection.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", rows.items())
        return rows

    def _check_meta(self) -> None:
        for key in ("config_json", "telescope", "source", "created_utc", "program_version"):
            if key not in self._meta:
                raise StoreError(f"{self._database}: {key} is missing from the table meta; restore the run from a copy")

    def _response_rows(self, record: Record) -> Iterator[tuple[int, int, float | None, float | None]]:
        # Python's sqlite3 stores NaN as NULL
        shares = record.facet_saturated_share.tolist()
        for facet_id, intensity, share in zip(self._facet_ids, record.facet_intensity.tolist(), shares, strict=True):
            yield record.index, facet_id, intensity, share

    def _read_responses(self, n_records: int) -> NDArray[np.float64]:
        """Shape (n_records, 2, n_facets): intensity and saturated share, ordered as records and facet ids are."""
        n_facets = len(self._facet_ids)
        cursor = self._connection.execute(
            "SELECT intensity, saturated_share FROM responses ORDER BY record_index, facet_id"
        )
        chunks = [np.empty((0, 2))]
        while rows := cursor.fetchmany(_ROWS_PER_READ):
            chunks.append(np.array(rows, dtype=np.float64))  # None becomes NaN
        table = np.concatenate(chunks)
        if len(table) != n_records * n_facets:
            raise StoreError(
                f"{self._database}: {len(table)} responses for {n_records} records of {n_facets} facets; "
                "the run is damaged: restore it from a copy"
            )
        rank_of_id = np.argsort(np.argsort(self._facet_ids))  # rows come sorted by id, the run has its own order
        return table.reshape(n_records, n_facets, 2)[:, rank_of_id, :].transpose(0, 2, 1)


def _telescope_name(config_json: str) -> str:
    telescope = json.loads(config_json).get("telescope", {})
    return str(telescope.get("name", ""))


def _write_empty_run(folder: Path, facet_ids: Sequence[int], meta: dict[str, str]) -> None:
    database = folder / DATABASE_NAME
    with store_errors(database):
        (folder / FRAMES_FOLDER).mkdir(parents=True)
        connection = connect_new(database)
        try:
            with transaction(connection):
                connection.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
                connection.executemany("INSERT INTO facets VALUES (?, ?)", enumerate(map(int, facet_ids)))
        finally:
            connection.close()
        sync_folder(folder)
