"""The one registry of quality flags: of a facet's estimate, and of a record.

A flag is a bit with a stable name; other programs rely on the names. The comment string of each member
is what a person reads beside it.
"""

from __future__ import annotations

from enum import Flag, StrEnum, auto


class FacetFlag(Flag):
    """What stands against a facet's estimate or its correction."""

    NONE = 0
    NO_SIGNAL = auto()
    PSF_CUT_BY_SCAN_EDGE = auto()
    UNRELIABLE = auto()
    PSF_OUTSIDE_SCAN = auto()
    FEW_RECORDS = auto()
    LARGE_UNCERTAINTY = auto()
    BEYOND_TRAVEL_LIMIT = auto()
    RESTS_ON_BAD_RECORD = auto()
    NO_GAIN = auto()

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the set bits, in the order of the registry."""
        return tuple(member.name for member in FacetFlag if member in self and member.name is not None)

    @property
    def forbids_turning(self) -> bool:
        """True when nobody should turn a bolt or drive a leg on this estimate."""
        return bool(self & _FORBIDS_TURNING)


_FORBIDS_TURNING = FacetFlag.NO_SIGNAL | FacetFlag.UNRELIABLE | FacetFlag.BEYOND_TRAVEL_LIMIT | FacetFlag.NO_GAIN

FACET_FLAG_MEANING: dict[FacetFlag, str] = {
    FacetFlag.NO_SIGNAL: "the facet never lit up: no estimate",
    FacetFlag.PSF_CUT_BY_SCAN_EDGE: "the facet's point spread function reaches beyond the recorded directions",
    FacetFlag.UNRELIABLE: "an estimate is given, but nobody should turn a bolt on it",
    FacetFlag.PSF_OUTSIDE_SCAN: "the brightest direction lies outside the recorded directions",
    FacetFlag.FEW_RECORDS: "too few records hit the facet's point spread function",
    FacetFlag.LARGE_UNCERTAINTY: "the estimate's uncertainty is too large to correct on",
    FacetFlag.BEYOND_TRAVEL_LIMIT: "the correction would move a leg beyond its limit: refused",
    FacetFlag.RESTS_ON_BAD_RECORD: "the estimate rests on a record that disagrees with all others",
    FacetFlag.NO_GAIN: "the correction as a whole is not expected to make the mirror better: record more first",
}


class RejectReason(StrEnum):
    """Why a record does not count; the value is what is stored, the text below what a person reads."""

    NO_STAR = "no_star"
    SEVERAL_STARS = "several_stars"
    STAR_TOO_SMALL = "star_too_small"
    STAR_TOO_LARGE = "star_too_large"
    STAR_SATURATED = "star_saturated"
    STAR_UNDEREXPOSED = "star_underexposed"
    STAR_STREAK = "star_streak"
    STAR_AT_EDGE = "star_at_edge"
    REFLECTOR_SATURATED = "reflector_saturated"
    TELESCOPE_MOVED = "telescope_moved"
    FILE_MISSING = "file_missing"
    FILE_CORRUPT = "file_corrupt"


REJECT_REASON_MEANING: dict[RejectReason, str] = {
    RejectReason.NO_STAR: "nothing stands 5 sigma above the noise",
    RejectReason.SEVERAL_STARS: "more than one star could be meant",
    RejectReason.STAR_TOO_SMALL: "smaller than the optics can make a star: a hot pixel or a cosmic ray",
    RejectReason.STAR_TOO_LARGE: "larger than a star: cloud, moonlight or out of focus",
    RejectReason.STAR_SATURATED: "the star's pixels are saturated",
    RejectReason.STAR_UNDEREXPOSED: "the star's pixels are too faint for the radiometric law",
    RejectReason.STAR_STREAK: "the star is drawn out: satellite, aircraft or moving telescope",
    RejectReason.STAR_AT_EDGE: "the star touches the edge of the image",
    RejectReason.REFLECTOR_SATURATED: "a facet is saturated",
    RejectReason.TELESCOPE_MOVED: "the telescope moved too far during the longer exposure",
    RejectReason.FILE_MISSING: "a file of the record is missing",
    RejectReason.FILE_CORRUPT: "a file of the record cannot be read",
}
