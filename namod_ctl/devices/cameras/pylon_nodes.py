"""Settings of a Basler camera by their GenICam names, each read back after it was set; and its clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.interfaces import MonotonicClock

FLOAT_TOLERANCE_SHARE = 0.01
"""Of a setting's range: cameras round gains to steps of some tenths of a dB."""
SFNC2_TICK_S = 1e-9
"""Of cameras with `TimestampLatch`: GenICam SFNC 2, section "Device Control", gives times in ns."""

_LATCHES = (("TimestampLatch", "TimestampLatchValue"), ("GevTimestampControlLatch", "GevTimestampValue"))


class PylonNodes:
    """The settings of one open camera.

    Parameters
    ----------
    node_map
        Of pypylon.
    genicam
        The module `pypylon.genicam`.
    camera_name
        For messages.
    """

    def __init__(self, node_map: Any, genicam: Any, camera_name: str) -> None:
        self._map, self._genicam, self._camera_name = node_map, genicam, camera_name

    def find(self, *names: str) -> Any | None:
        """The first of these that the camera has and lets us read or execute; None when it has none of them."""
        for name in names:
            node = self._map.GetNode(name)
            if self._genicam.IsReadable(node) or self._genicam.IsWritable(node):
                return node
        return None

    def need(self, *names: str) -> Any:
        """The same. Raises ConfigError when it has none of them."""
        node = self.find(*names)
        if node is None:
            raise ConfigError(f"{self._camera_name}: has no setting {' or '.join(names)}; this driver cannot use it")
        return node

    def execute_if_there(self, name: str) -> None:
        """Give a command that not all cameras have."""
        node = self._map.GetNode(name)
        if self._genicam.IsWritable(node):
            node.Execute()

    def set_if_there(self, name: str, value: str | float) -> None:
        """Set what not all cameras have, or lock when something else is off. Raises ConfigError if it is refused."""
        node = self._map.GetNode(name)
        if self._genicam.IsWritable(node):
            self._set(node, name, value, "")

    def set(self, name: str, value: str | float, config_key: str = "") -> None:
        """Set what every camera must have.

        Raises
        ------
        ConfigError
            The camera does not have it, or has another value afterwards; names `config_key` as the remedy.
        """
        self._set(self.need(name), name, value, config_key)

    def _set(self, node: Any, name: str, value: str | float, config_key: str) -> None:
        with self._refusal(node, name, value, config_key):
            if node.GetValue() != value:
                node.SetValue(value)
        present = node.GetValue()
        if isinstance(present, float):
            tolerance = FLOAT_TOLERANCE_SHARE * (node.GetMax() - node.GetMin())
            is_taken = math.isclose(present, float(value), rel_tol=0.0, abs_tol=tolerance)
        else:
            is_taken = present == value
        if not is_taken:
            raise ConfigError(
                f"{self._camera_name}: {name} = {value} was asked for, the camera keeps {present}{_remedy(config_key)}"
            )

    @contextmanager
    def _refusal(self, node: Any, name: str, value: str | float, config_key: str) -> Iterator[None]:
        refused = (
            self._genicam.OutOfRangeException,
            self._genicam.InvalidArgumentException,
            self._genicam.AccessException,
        )
        try:
            yield
        except refused:
            present = f"it is {node.ToString()}"
            raise ConfigError(
                f"{self._camera_name}: {name} = {value} is refused; {present}{_choice(node)}{_remedy(config_key)}"
            ) from None


def _choice(node: Any) -> str:
    """What the camera would take, for a person."""
    if hasattr(node, "GetSymbolics"):
        return f", and can be {', '.join(node.GetSymbolics())}"
    if hasattr(node, "GetMin"):
        step = f" in steps of {node.GetInc()}" if hasattr(node, "GetInc") and isinstance(node.GetValue(), int) else ""
        return f", and can be {node.GetMin():g} to {node.GetMax():g}{step}"
    return ""


def _remedy(config_key: str) -> str:
    return f"; change {config_key} in the config" if config_key else "; set it with the maker's viewer, or report this"


class DeviceTimes:
    """Ticks of a camera's own clock on ours.

    Cameras whose clock cannot be read (`is_there` false) have frames without useful times.

    Parameters
    ----------
    nodes
        Of the open camera.
    clock
        Ours.
    """

    def __init__(self, nodes: PylonNodes, clock: MonotonicClock) -> None:
        self._clock = clock
        self._latch: Callable[[], object] | None = None
        for command_name, value_name in _LATCHES:
            command, value = nodes.find(command_name), nodes.find(value_name)
            if command is not None and value is not None:
                self._latch, self._value = command.Execute, value.GetValue
                break
        frequency = nodes.find("GevTimestampTickFrequency")
        self._tick_s = SFNC2_TICK_S if frequency is None else 1.0 / float(frequency.GetValue())
        self._host_s, self._ticks = math.nan, 0

    @property
    def is_there(self) -> bool:
        """The camera has a clock that can be read."""
        return self._latch is not None

    def compare(self) -> None:
        """Look at both clocks at once; as good as the camera's answer is quick, some 0.1 ms."""
        if self._latch is not None:
            before_s = self._clock.monotonic_s()
            self._latch()
            self._host_s = (before_s + self._clock.monotonic_s()) / 2.0
            self._ticks = int(self._value())

    def host_s(self, ticks: int) -> float:
        """That tick on our clock, from the last comparison; NaN where there is no clock or no tick (0)."""
        if not self.is_there or ticks == 0:
            return math.nan
        return self._host_s + (ticks - self._ticks) * self._tick_s
