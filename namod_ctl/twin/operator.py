"""People at the twin's bolts: they turn what the sheets ask for, nearly, and make the mistakes they are told to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, rad_to_deg
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.twin import Twin

Array = NDArray[np.float64]

GONIOMETER_ERROR_RAD = deg_to_rad(3.0)
"""Standard deviation of a turn that a careful person makes with a goniometer."""

MISTAKES = ("not_done", "wrong_direction", "wrong_bolt", "wrong_facet", "half_done")


class TwinOperator:
    """Turns bolts of the twin by hand.

    Parameters
    ----------
    mistakes
        By facet, one of `MISTAKES`: nothing turned; all bolts turned the other way; bolts 1 and 2 mistaken for each
        other; the turns of this facet made at the next one in the order of ids as well, and none here; half of each
        turn.
    """

    def __init__(
        self, twin: Twin, seed: int, error_rad: float = GONIOMETER_ERROR_RAD, mistakes: Mapping[int, str] | None = None
    ) -> None:
        self._twin, self._error_rad = twin, error_rad
        self._mistakes = dict(mistakes or {})
        self._rng = generator(seed, "operator")
        for facet_id, mistake in self._mistakes.items():
            if mistake not in MISTAKES or facet_id not in twin.instrument.mounts:
                raise ConfigError(
                    f"facet {facet_id}: mistake {mistake!r}; there are: {', '.join(MISTAKES)}, and the config's facets"
                )

    def turn(self, facet_id: int, turns_deg: Sequence[float]) -> None:
        """Turn the bolts of a facet, or what a mistaken person takes for them. Each mistake is made once."""
        turns = np.asarray(turns_deg, dtype=np.float64)
        match self._mistakes.pop(facet_id, None):
            case None:
                self._turn(facet_id, turns)
            case "not_done":
                pass
            case "wrong_direction":
                self._turn(facet_id, -turns)
            case "wrong_bolt":
                self._turn(facet_id, turns[[1, 0, *range(2, len(turns))]])
            case "half_done":
                self._turn(facet_id, turns / 2.0)
            case "wrong_facet":
                ids = sorted(self._twin.instrument.mounts)
                self._turn(ids[(ids.index(facet_id) + 1) % len(ids)], turns)

    def _turn(self, facet_id: int, turns_deg: Array) -> None:
        mount = self._twin.instrument.mounts[facet_id]
        assert mount.pitch_m_per_turn is not None  # only facets with bolts are asked for
        errors = rad_to_deg(self._error_rad * self._rng.standard_normal(len(turns_deg)))
        made_deg = turns_deg + np.where(turns_deg != 0.0, errors, 0.0)
        raised = 1.0 if mount.turn_raises_leg == "clockwise" else -1.0
        self._twin.move_legs(facet_id, raised * made_deg / 360.0 * mount.pitch_m_per_turn)
