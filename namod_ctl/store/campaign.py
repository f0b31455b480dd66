"""The campaign: cycles of recording and correcting until the telescope is aligned, on disk.

A campaign is a folder with `campaign.sqlite`, the runs of its cycles (`cycle_01`, `cycle_02`, ...), and what is in
`control/`. Every method that writes has its transaction on the disk when it returns: what a campaign says after a
kill is what had happened. Orders are written before anything moves; one without a result after a crash has an
unknown outcome until the drive is read back, and since targets are absolute, carrying it out again moves nothing
twice.

One process at a time works on a campaign (`campaign_lock`); any number may read it meanwhile.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from namod_ctl import __version__
from namod_ctl.core.clock import Clock, SystemClock
from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.core.errors import ConfigError, StoreError
from namod_ctl.core.motion import MoveOrder, MoveResult
from namod_ctl.store.campaign_database import CAMPAIGN_DATABASE_NAME, connect_campaign, require_campaign
from namod_ctl.store.campaign_folder import check_campaign_output, put_campaign_in_place, write_empty_campaign
from namod_ctl.store.campaign_lock import CampaignLock
from namod_ctl.store.campaign_rows import (
    TRANSITION,
    AskedTurns,
    Cycle,
    Event,
    JournaledOrder,
    Json,
    event_of,
    order_of,
    real,
    target_of,
    without_nan,
)
from namod_ctl.store.database import store_errors, transaction, unsynced
from namod_ctl.store.folders import discard, free_sibling
from namod_ctl.store.live_legs import SeenLeg, read_legs, save_legs

_NOTE = "note."
_CYCLE_COLUMNS = (
    "run_folder, n_records, a_sigma_now_rad2, a_sigma_uncertainty_rad2, a_sigma_predicted_rad2, a_sigma_limit_rad2, "
    "alignment_json, decision"
)


class CampaignStore:
    """A campaign that is open; a context manager that closes it. Use `create` or `open`, and one thread only.

    Every method raises StoreError, with path and remedy, when the disk or the database refuses.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, clock: Clock, lock: CampaignLock | None) -> None:
        self.path = path
        self._connection = connection
        self._clock = clock
        self._lock = lock
        self._database = path / CAMPAIGN_DATABASE_NAME
        with store_errors(self._database):
            meta: dict[str, str] = dict(connection.execute("SELECT key, value FROM meta"))
        for key in ("config_json", "source", "created_utc", "program_version"):
            if key not in meta:
                raise StoreError(
                    f"{self._database}: {key} is missing from the table meta; restore the campaign from a copy"
                )
        self.config_json = meta["config_json"]
        self.source = meta["source"]
        self.created_utc = meta["created_utc"]
        self.program_version = meta["program_version"]

    @classmethod
    def create(cls, path: Path | str, config_json: str, source: str, clock: Clock, force: bool = False) -> Self:
        """A new campaign without any cycle at `path`, open for writing.

        Parameters
        ----------
        config_json
            The instrument's config as used, self-contained.
        source
            Where the records come from and what moves the facets, for people.
        force
            Replace an older campaign (or an empty folder) at `path`; anything else is never replaced.

        Raises
        ------
        ConfigError
            Something is at `path` that may not be replaced, or the folder above does not exist.
        StoreError
            The campaign that is to be replaced is being worked on.
        """
        path = Path(path).resolve()
        check_campaign_output(path, force=force)
        meta = {
            "config_json": config_json,
            "source": source,
            "created_utc": clock.now().isoformat(),
            "program_version": __version__,
        }
        built = free_sibling(path)
        try:
            write_empty_campaign(built, meta)
            put_campaign_in_place(built, path)
        except BaseException:
            discard(built)
            raise
        return cls.open(path, read_only=False, clock=clock)

    @classmethod
    def open(cls, path: Path | str, read_only: bool = True, clock: Clock | None = None) -> Self:
        """The campaign at `path`; `clock` (the computer's if None) dates what is written to it.

        Raises
        ------
        ConfigError
            There is no campaign at `path`.
        StoreError
            It was written by a newer program, is damaged, cannot be opened, or is to be opened for writing while
            another process works on it.
        """
        path = Path(path).resolve()
        require_campaign(path)
        lock = None if read_only else CampaignLock.take(path)
        try:
            connection = connect_campaign(path / CAMPAIGN_DATABASE_NAME, read_only=read_only)
            try:
                return cls(path, connection, clock or SystemClock(), lock)
            except BaseException:
                connection.close()
                raise
        except BaseException:
            if lock is not None:
                lock.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Fold SQLite's log into the one file and let others work on the campaign; harmless when closed already."""
        try:
            with store_errors(self._database):
                self._connection.close()
        finally:
            if self._lock is not None:
                self._lock.release()
                self._lock = None

    def note(self, key: str) -> str | None:
        """What was noted under `key` about this campaign, None when nothing was."""
        with store_errors(self._database):
            row = self._connection.execute("SELECT value FROM meta WHERE key = ?", (_NOTE + key,)).fetchone()
        return None if row is None else str(row[0])

    def set_note(self, key: str, text: str) -> None:
        """Note something about this campaign, in place of what stood under `key`."""
        with store_errors(self._database):
            self._connection.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (_NOTE + key, text))

    def add_event(self, kind: str, text: str, data: Mapping[str, Json] | None = None) -> int:
        """Journal something that happened; its id. NaN and infinite numbers in `data` become None."""
        data_json = json.dumps(without_nan(dict(data or {})), allow_nan=False)
        with store_errors(self._database):
            cursor = self._connection.execute(
                "INSERT INTO events (time_utc, kind, text, data_json) VALUES (?, ?, ?, ?)",
                (self._now(), kind, text, data_json),
            )
        return int(cursor.lastrowid or 0)

    def add_transition(self, from_state: str, to_state: str, trigger: str, reason: str) -> int:
        """Journal a step of the state machine; its event's id."""
        data = {"from": from_state, "to": to_state, "trigger": trigger, "reason": reason}
        return self.add_event(TRANSITION, f"{from_state} -> {to_state}: {reason}", data)

    def events(self, since_id: int = 0) -> list[Event]:
        """Events with an id above `since_id`, in the order in which they happened."""
        with store_errors(self._database):
            rows = self._connection.execute(
                "SELECT event_id, time_utc, kind, text, data_json FROM events WHERE event_id > ? ORDER BY event_id",
                (since_id,),
            ).fetchall()
        return [event_of(row) for row in rows]

    def last_state(self) -> str | None:
        """State that the last transition led to; None before the first."""
        transition = self.last_transition()
        return None if transition is None else str(transition.data.get("to"))

    def last_transition(self) -> Event | None:
        """The step that the state machine took last; None before the first."""
        with store_errors(self._database):
            row = self._connection.execute(
                "SELECT event_id, time_utc, kind, text, data_json FROM events WHERE kind = ? "
                "ORDER BY event_id DESC LIMIT 1",
                (TRANSITION,),
            ).fetchone()
        return None if row is None else event_of(row)

    def begin_cycle(self) -> int:
        """Number of a new cycle; its run goes to the folder `cycle_NN` inside the campaign's (`run_path`)."""
        with store_errors(self._database), transaction(self._connection):
            last = self._connection.execute("SELECT MAX(cycle) FROM cycles").fetchone()[0]
            number = int(last or 0) + 1
            self._connection.execute(
                f"INSERT INTO cycles (cycle, begun_utc, {_CYCLE_COLUMNS}) "
                "VALUES (?, ?, ?, 0, NULL, NULL, NULL, NULL, NULL, '')",
                (number, self._now(), f"cycle_{number:02d}"),
            )
        return number

    def run_path(self, cycle: int) -> Path:
        """Where the run of that cycle is, or is to be."""
        return self.path / f"cycle_{cycle:02d}"

    def save_cycle(self, cycle: Cycle) -> None:
        """Write what is known of a cycle that was begun, in place of what was."""
        values = (
            cycle.run_folder,
            cycle.n_records,
            float(cycle.a_sigma_now_rad2),
            float(cycle.a_sigma_uncertainty_rad2),
            float(cycle.a_sigma_predicted_rad2),
            float(cycle.a_sigma_limit_rad2),
            cycle.alignment_json,
            cycle.decision,
        )
        with store_errors(self._database):
            cursor = self._connection.execute(
                f"UPDATE cycles SET ({_CYCLE_COLUMNS}) = (?, ?, ?, ?, ?, ?, ?, ?) WHERE cycle = ?",
                (*values, cycle.number),
            )
        if cursor.rowcount != 1:
            raise ValueError(f"cycle {cycle.number} was never begun")

    def cycles(self) -> list[Cycle]:
        """All cycles that were begun, ascending."""
        with store_errors(self._database):
            rows = self._connection.execute(f"SELECT cycle, {_CYCLE_COLUMNS} FROM cycles ORDER BY cycle").fetchall()
        return [
            Cycle(
                int(number),
                str(folder),
                int(n_records),
                real(now),
                real(uncertainty),
                real(predicted),
                real(limit),
                alignment_json,
                str(decision),
            )
            for number, folder, n_records, now, uncertainty, predicted, limit, alignment_json, decision in rows
        ]

    def order(self, cycle: int, orders: Sequence[MoveOrder]) -> list[int]:
        """Ids of orders that are on the disk, all of them, when this returns; only then may anything move."""
        with store_errors(self._database), transaction(self._connection):
            ids = []
            for order in orders:
                cursor = self._connection.execute(
                    "INSERT INTO orders (time_utc, cycle, facet_id, leg_index, start_m, target_m) "
                    "VALUES (?, ?, ?, ?, ?, ?)",
                    (
                        self._now(),
                        cycle,
                        order.leg.facet_id,
                        order.leg.index,
                        float(order.start_m),
                        target_of(order),
                    ),
                )
                ids.append(int(cursor.lastrowid or 0))
        return ids

    def result(self, order_id: int, result: MoveResult) -> None:
        """Write what came of an order; it has one result only."""
        self.results({order_id: result})

    def results(self, results: Mapping[int, MoveResult]) -> None:
        """Write what came of several orders, by their ids, at the cost of one; all or none.

        Raises StoreError when an order does not exist or has a result already.
        """
        with store_errors(self._database), transaction(self._connection):
            self._connection.executemany(
                "INSERT INTO results VALUES (?, ?, ?, ?, ?)",
                (
                    (order_id, self._now(), result.outcome.value, float(result.readback_m), result.detail)
                    for order_id, result in results.items()
                ),
            )

    def orders(self, cycle: int | None = None) -> list[JournaledOrder]:
        """Orders of a cycle, or all, in the order in which they were given."""
        return self._read_orders("WHERE cycle = ?", cycle) if cycle is not None else self._read_orders("")

    def unfinished_orders(self) -> list[JournaledOrder]:
        """Orders without a result: where their legs are is unknown until somebody reads the drives back."""
        return self._read_orders("WHERE outcome IS NULL")

    def show_legs(self, heard: Mapping[Leg, DriveState | str]) -> None:
        """Leave what drives said last, or why they did not, for whoever looks; without waiting for the disk."""
        with store_errors(self._database), unsynced(self._connection), transaction(self._connection):
            save_legs(self._connection, heard, self._now())

    def seen_legs(self) -> dict[Leg, SeenLeg]:
        """What was known last of every leg whose drive was ever read, in their order."""
        with store_errors(self._database):
            return read_legs(self._connection)

    def ask_turns(self, cycle: int, turns_deg: Mapping[int, Sequence[float]]) -> None:
        """Write which turns a person is asked for in a cycle, per facet id one per bolt, in place of older ones."""
        with store_errors(self._database), transaction(self._connection):
            self._connection.execute("DELETE FROM turns WHERE cycle = ?", (cycle,))
            self._connection.executemany(
                "INSERT INTO turns VALUES (?, ?, ?, NULL)",
                (
                    (cycle, int(facet_id), json.dumps([float(turn_deg) for turn_deg in turns], allow_nan=False))
                    for facet_id, turns in turns_deg.items()
                ),
            )

    def turns(self, cycle: int | None = None) -> list[AskedTurns]:
        """Turns asked for in a cycle, ascending by facet; of the last cycle that asked for any when None."""
        with store_errors(self._database):
            rows = self._connection.execute(
                "SELECT cycle, facet_id, turns_deg_json, done_utc FROM turns "
                "WHERE cycle = COALESCE(?, (SELECT MAX(cycle) FROM turns)) ORDER BY facet_id",
                (cycle,),
            ).fetchall()
        return [
            AskedTurns(int(number), int(facet_id), tuple(json.loads(turns)), done is not None)
            for number, facet_id, turns, done in rows
        ]

    def mark_done(self, facet_ids: Collection[int] | None = None) -> list[int]:
        """Facets, of those given or all, whose turns of the last cycle that asked for any are done from now on.

        Journaled together with an event. What was done before stays as it was.

        Raises
        ------
        ConfigError
            No turn of one of these facets was asked for; nothing is written.
        """
        asked = self.turns()
        known = {turns.facet_id for turns in asked}
        wanted = known if facet_ids is None else set(facet_ids)
        if wanted - known:
            ids, of_cycle = ", ".join(map(str, sorted(known))), asked[0].cycle if asked else 0
            hint = f"in cycle {of_cycle} turns were asked for of facets {ids}" if asked else "none were asked for yet"
            strangers = ", ".join(map(str, sorted(wanted - known)))
            raise ConfigError(f"{self.path}: no turns were asked for of facet {strangers}; {hint}")
        news = [turns.facet_id for turns in asked if turns.facet_id in wanted and not turns.is_done]
        if not news:
            return []
        cycle = asked[0].cycle
        with store_errors(self._database), transaction(self._connection):
            self._connection.executemany(
                "UPDATE turns SET done_utc = ? WHERE cycle = ? AND facet_id = ?",
                [(self._now(), cycle, facet_id) for facet_id in news],
            )
            text = f"done by hand: facet {', '.join(map(str, news))}"
            self.add_event("done", text, {"cycle": cycle, "facet_ids": news})
        return news

    def _read_orders(self, condition: str, *values: int) -> list[JournaledOrder]:
        with store_errors(self._database):
            rows = self._connection.execute(
                "SELECT order_id, cycle, facet_id, leg_index, start_m, target_m, outcome, readback_m, detail "
                f"FROM orders LEFT JOIN results USING (order_id) {condition} ORDER BY order_id",
                values,
            ).fetchall()
        return [order_of(row, self._database) for row in rows]

    def _now(self) -> str:
        return self._clock.now().isoformat()
