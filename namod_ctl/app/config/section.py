"""What all sections of an instrument's config have in common."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field


class Section(BaseModel):
    """A section of the config: nothing unknown, no silent conversion of types, no infinite number."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def within(low: float, high: float) -> Any:
    """Limits of a number, both included."""
    return Field(ge=low, le=high)


Name = Annotated[str, Field(min_length=1, max_length=80)]
FileName = Annotated[str, Field(min_length=1, max_length=1000)]
FacetId = Annotated[int, within(0, 999_999)]
