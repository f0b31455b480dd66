"""What an import did, for the person who started it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record


@dataclass(frozen=True, slots=True)
class Rejection:
    """A record that does not count: its label and why."""

    label: str
    detail: str


@dataclass(frozen=True, slots=True)
class ImportSummary:
    """Counts of an import.

    Attributes
    ----------
    rejected
        Rejected records by reason, in the registry's order, each in the order of the run.
    facet_ids
        Facets of the run.
    missing_facet_ids
        Facets of the config the input says nothing about.
    remarks
        Further findings, one sentence each.
    """

    n_records: int
    rejected: dict[RejectReason, tuple[Rejection, ...]]
    facet_ids: tuple[int, ...]
    missing_facet_ids: tuple[int, ...]
    remarks: tuple[str, ...] = ()

    @property
    def n_rejected(self) -> int:
        """Number of rejected records."""
        return sum(len(rejections) for rejections in self.rejected.values())

    @property
    def n_accepted(self) -> int:
        """Number of records that count."""
        return self.n_records - self.n_rejected


def summarize_import(
    records: Iterable[Record], facet_ids: Sequence[int], config_facet_ids: Sequence[int], remarks: Sequence[str] = ()
) -> ImportSummary:
    """Summary of a run of `facet_ids`, imported with a config that has `config_facet_ids`."""
    records = list(records)
    rejected: dict[RejectReason, tuple[Rejection, ...]] = {}
    for reason in RejectReason:
        found = tuple(Rejection(record.label, record.detail) for record in records if record.reject_reason is reason)
        if found:
            rejected[reason] = found
    missing = tuple(facet_id for facet_id in config_facet_ids if facet_id not in set(facet_ids))
    return ImportSummary(len(records), rejected, tuple(facet_ids), missing, tuple(remarks))
