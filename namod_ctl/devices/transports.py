"""Lines with bytes on them, by the URL in the config: serial ports, TCP, RFC 2217, and memory."""

from __future__ import annotations

import errno
import select
from collections.abc import Callable, Mapping
from contextlib import suppress
from types import MappingProxyType
from urllib.parse import urlsplit

import serial  # type: ignore[import-untyped]

from namod_ctl.core.drives import ByteTransport
from namod_ctl.core.errors import CommunicationError, ConfigError

LOOPBACK_SCHEME = "loopback://"
NO_LOOPBACKS: Mapping[str, Callable[[bytes], bytes]] = MappingProxyType({})
_RFC2217_SCHEME = "rfc2217://"
_NETWORK_SCHEMES = ("socket://", _RFC2217_SCHEME)
_WRITE_TIMEOUT_S = 2.0  # a line that takes no bytes for so long is gone
_N_DISCARDS = 64  # a line that babbles without end must not hold whoever clears it
_READ_SIZE = 4096

_REMEDIES = {
    errno.ENOENT: "there is no such port: plug the adapter in, or correct the URL in the config",
    errno.EACCES: "no permission: add the user to the group of the port (often dialout) and log in again",
    errno.EPERM: "no permission: add the user to the group of the port (often dialout) and log in again",
    errno.EBUSY: "the port is in use: end the other program",
    errno.EAGAIN: "the port is in use: end the other program",
    errno.ENOTTY: "that is no serial port",
}


class LoopbackTransport:
    """A line in memory.

    Parameters
    ----------
    name
        URL for a person.
    peer
        Takes the bytes that were written and gives the bytes that it answers at once; they queue up for `read`. It may
        raise `CommunicationError`: the line is gone.
    """

    def __init__(self, name: str, peer: Callable[[bytes], bytes]) -> None:
        self._name = name
        self._peer = peer
        self._queue = bytearray()
        self._is_open = True

    @property
    def name(self) -> str:
        """Its URL."""
        return self._name

    def write(self, data: bytes) -> None:
        """Hand `data` to the peer and queue its answer."""
        if not self._is_open:
            raise CommunicationError(f"{self._name} is closed")
        self._queue += self._peer(data)

    def read(self, n_max: int, timeout_s: float) -> bytes:
        """What the peer has answered; nothing more can come while nobody writes, so `timeout_s` is not waited for."""
        del timeout_s
        if not self._is_open:
            raise CommunicationError(f"{self._name} is closed")
        data = bytes(self._queue[:n_max])
        del self._queue[:n_max]
        return data

    def discard_input(self) -> None:
        """Throw away what was answered and not read."""
        self._queue.clear()

    def reopen(self) -> None:
        """Begin anew with nothing queued."""
        self._queue.clear()
        self._is_open = True

    def close(self) -> None:
        """Let go of the peer's answers."""
        self._queue.clear()
        self._is_open = False


class SerialTransport:
    """Whatever pyserial can open: a serial port, `socket://host:port`, `rfc2217://host:port`."""

    def __init__(self, url: str, baud: int) -> None:
        self._url = url
        self._baud = baud
        self._port = self._opened()

    @property
    def name(self) -> str:
        """Its URL or port."""
        return self._url

    def _opened(self) -> serial.SerialBase:
        port = serial.serial_for_url(self._url, do_not_open=True, baudrate=self._baud, exclusive=True)
        if not self._url.startswith(_RFC2217_SCHEME):  # which cannot limit that
            port.write_timeout = _WRITE_TIMEOUT_S
        # where the system can wait on the port itself, reads take what is there; else pyserial waits
        port.timeout = 0.0
        port.open()
        try:
            port.fileno()
            self._can_select = True
        except (AttributeError, OSError):  # io.UnsupportedOperation is an OSError
            self._can_select = False
        return port

    def write(self, data: bytes) -> None:
        """Send all of `data`; `CommunicationError` when the line is gone."""
        try:
            self._port.write(data)
        except OSError as error:
            raise self._gone(error) from error

    def read(self, n_max: int, timeout_s: float) -> bytes:
        """What is there as soon as there is any, empty after `timeout_s`; `CommunicationError` on a lost line."""
        try:
            if not self._can_select:
                return self._read_waiting(n_max, timeout_s)
            if not self._port.is_open or not select.select([self._port], [], [], timeout_s)[0]:
                return b"" if self._port.is_open else self._closed()
            return bytes(self._port.read(n_max))
        except OSError as error:
            raise self._gone(error) from error

    def _read_waiting(self, n_max: int, timeout_s: float) -> bytes:
        if self._port.timeout != timeout_s:
            self._port.timeout = timeout_s
        first = bytes(self._port.read(1))
        n_more = min(n_max - 1, self._port.in_waiting) if first else 0
        return first + (bytes(self._port.read(n_more)) if n_more else b"")

    def _closed(self) -> bytes:
        raise CommunicationError(f"{self._url} is closed")

    def _gone(self, error: OSError) -> CommunicationError:
        return CommunicationError(
            f"{self._url}: the line is gone ({error}). Check the plug, the adapter and its power."
        )

    def discard_input(self) -> None:
        """Throw away what has arrived. Reads rather than flushes: a flush is a round trip of its own on RFC 2217."""
        for _ in range(_N_DISCARDS):
            if not self.read(_READ_SIZE, 0.0):
                return

    def reopen(self) -> None:
        """Close and open again; `CommunicationError` when that fails."""
        self.close()
        try:
            self._port = self._opened()
        except OSError as error:
            raise CommunicationError(f"{self._url} can not be opened again: {_remedy(error)}") from error

    def close(self) -> None:
        """Let go of the line."""
        with suppress(OSError):  # a port that vanished can fail to close; it is gone either way
            self._port.close()


def open_transport(
    url: str, baud: int, loopbacks: Mapping[str, Callable[[bytes], bytes]] = NO_LOOPBACKS
) -> ByteTransport:
    """The open line behind a URL.

    Parameters
    ----------
    url
        "/dev/ttyUSB0", "COM3", "socket://host:port", "rfc2217://host:port" or "loopback://name".
    baud
        Bits per second; without meaning for TCP and memory.
    loopbacks
        What answers behind "loopback://name", by name.

    Raises
    ------
    ConfigError
        The URL is not understood, no loopback has this name, or the port does not exist, is in use or not permitted.
    CommunicationError
        The host does not answer.
    """
    if url.startswith(LOOPBACK_SCHEME):
        name = url.removeprefix(LOOPBACK_SCHEME)
        if name not in loopbacks:
            known = ", ".join(sorted(loopbacks)) or "none"
            raise ConfigError(f"{url}: nothing in this program answers there (known: {known}); give a port or host")
        return LoopbackTransport(url, loopbacks[name])
    try:
        if url.startswith(_NETWORK_SCHEMES):
            _check_host_and_port(url)
        return SerialTransport(url, baud)
    except ValueError as error:
        raise ConfigError(
            f"{url} at {baud} baud: {error}. Expected a port such as /dev/ttyUSB0 or COM3, socket://host:port, "
            "rfc2217://host:port, and a baud rate the port knows"
        ) from error
    except OSError as error:
        text = f"{url} can not be opened: {_remedy(error)}"
        if url.startswith(_NETWORK_SCHEMES):
            raise CommunicationError(f"{text}. Is the serial server on, and is its port right?") from error
        raise ConfigError(text) from error


def _check_host_and_port(url: str) -> None:
    parts = urlsplit(url)
    if not parts.hostname or parts.port is None:
        raise ValueError("host or port is missing")


def _remedy(error: OSError) -> str:
    # pyserial wraps some of the system's errors and drops their number
    context = error.__context__
    number = error.errno or (context.args[0] if context is not None and context.args else None)
    return _REMEDIES.get(number, str(error)) if isinstance(number, int) else str(error)
