"""One ASCOM Alpaca camera on its server: properties, methods and images over HTTP.

Written on `http.client` because of what alpyca 3.1.3 does: all its devices share one lock, held while a server is
waited for, so that one camera's download holds up the other's start; it fetches images without a timeout; and nothing
can end a request that hangs. Here every camera has a connection and every request a timeout, and `interrupt` ends them.

Source: ASCOM Alpaca API Reference v3 (ErrorNumber, case of names); AlpacaImageBytes v1 (binary images).
"""

from __future__ import annotations

import http.client
import json
import math
import random
import socket
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, TypeVar
from urllib.parse import urlencode

import numpy as np
from numpy.typing import NDArray

NOT_IMPLEMENTED: Final = 0x400
NOT_CONNECTED: Final = 0x407

REQUEST_TIMEOUT_S: Final = 5.0  # without a byte
NETWORK_ERRORS: Final = (OSError, http.client.HTTPException)
"""What a request raises whose answer does not come."""

_MEDIA_TYPE = "application/imagebytes"
_HEADER = struct.Struct("<11i")  # ImageBytes version 1
_ELEMENT_TYPES = {1: "<i2", 2: "<i4", 3: "<f8", 4: "<f4", 5: "<u8", 6: "<u1", 7: "<i8", 8: "<u2", 9: "<u4"}
_N_IDS = 65536
_MAX_BYTES = 1 << 30  # no camera sends more; a header that says so is damaged
_GONE = (http.client.RemoteDisconnected, ConnectionResetError, BrokenPipeError)

Result = TypeVar("Result")


class AlpacaRefusalError(Exception):
    """The server or its device says no.

    Attributes
    ----------
    number
        Alpaca's ErrorNumber; -1 where the server refused the request itself.
    """

    def __init__(self, number: int, message: str) -> None:
        super().__init__(message.strip() or f"error {number:#x} without a text")
        self.number = number


class AlpacaImageError(Exception):
    """An image came that is damaged, incomplete, or of no known kind."""


class AlpacaDevice:
    """Requests to one device, by one thread at a time; `interrupt` may come from any.

    What goes wrong on the way raises OSError or http.client.HTTPException. A server may close a connection that rests,
    or be another one by now: the request is then sent once more, and `n_reconnects` counts it.

    Parameters
    ----------
    kind
        "camera".
    number
        Of the device among those of its kind.

    Attributes
    ----------
    n_reconnects
        So often a request had to be sent once more, on a new connection.
    """

    def __init__(self, host: str, port: int, kind: str, number: int) -> None:
        self.n_reconnects = 0
        self.number = number
        self._kind = kind
        self._address = (host, port)
        self._client_id = random.randrange(1, _N_IDS)
        self._n_transactions = 0
        self._connection: http.client.HTTPConnection | None = None
        self._lock = threading.Lock()
        self._is_interrupted = False

    def get(self, name: str) -> Any:
        """The property's value as JSON has it. Raises AlpacaRefusalError."""
        return self._request("GET", f"/api/v1/{self._kind}/{self.number}/{name}", _value_of)

    def quantity(self, name: str) -> float:
        """A property that is a number. Raises AlpacaRefusalError, HTTPException for another value."""
        value = self.get(name)
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise http.client.HTTPException(f"{name} = {value!r} is no number")
        return value

    def flag(self, name: str) -> bool:
        """A property that is true or false. Raises AlpacaRefusalError, HTTPException for another value."""
        value = self.get(name)
        if not isinstance(value, bool):
            raise http.client.HTTPException(f"{name} = {value!r} is neither true nor false")
        return value

    def put(self, name: str, timeout_s: float = REQUEST_TIMEOUT_S, **values: str | float | bool) -> None:
        """Set a property or call a method. Raises AlpacaRefusalError."""
        self._request(
            "PUT",
            f"/api/v1/{self._kind}/{self.number}/{name}",
            _value_of,
            timeout_s,
            {key: str(value) for key, value in values.items()},
        )

    def configured_devices(self) -> list[dict[str, Any]]:
        """The devices of the server; DeviceName, DeviceType, DeviceNumber and UniqueID of each."""
        value = self._request("GET", "/management/v1/configureddevices", _value_of)
        devices = value if isinstance(value, list) else []
        return [each for each in devices if isinstance(each, dict) and isinstance(each.get("DeviceNumber"), int)]

    def image(self) -> NDArray[Any]:
        """The last image as the device sends it: shape (columns, rows) or (columns, rows, 3) red-green-blue.

        Raises
        ------
        AlpacaRefusalError
            There is none.
        AlpacaImageError
            It is incomplete, or its header makes no sense.
        """
        return self._request("GET", f"/api/v1/{self._kind}/{self.number}/imagearray", _image_in)

    def interrupt(self) -> None:
        """End a running request, and refuse those to come."""
        with self._lock:
            self._is_interrupted = True
            if self._connection is not None and self._connection.sock is not None:
                with suppress(OSError):
                    self._connection.sock.shutdown(socket.SHUT_RDWR)
        self.close()

    def close(self) -> None:
        """Let go of the connection."""
        with self._lock:
            connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _request(
        self,
        method: str,
        path: str,
        read: Callable[[http.client.HTTPResponse], Result],
        timeout_s: float = REQUEST_TIMEOUT_S,
        values: dict[str, str] | None = None,
    ) -> Result:
        self._n_transactions += 1
        ids = {"ClientID": str(self._client_id), "ClientTransactionID": str(self._n_transactions)}
        query = urlencode({**(values or {}), **ids})
        headers = {"Accept": f"{_MEDIA_TYPE}, application/json"}
        if method == "PUT":
            headers["Content-Type"] = "application/x-www-form-urlencoded"
        else:
            path, query = f"{path}?{query}", ""
        is_old = self._connection is not None and self._connection.sock is not None
        try:
            try:
                response = self._exchange(method, path, query, headers, timeout_s)
            except _GONE:
                self.close()
                if not is_old or self._is_interrupted:
                    raise
                self.n_reconnects += 1
                response = self._exchange(method, path, query, headers, timeout_s)
            result = read(response)
            response.read()  # the end of a chunked answer, so that the connection can be used again
        except (OSError, http.client.HTTPException, AlpacaImageError):
            self.close()  # what is left of an answer must not be taken for the next
            raise
        return result

    def _exchange(
        self, method: str, path: str, body: str, headers: dict[str, str], timeout_s: float
    ) -> http.client.HTTPResponse:
        connection = self._connection
        if connection is None or connection.sock is None:  # the first time, or closed by the answer before
            connection = http.client.HTTPConnection(*self._address, timeout=timeout_s)
            connection.connect()
        with self._lock:
            self._connection = connection
            if self._is_interrupted:
                raise ConnectionAbortedError("it was closed here")
            if connection.sock is not None:
                connection.sock.settimeout(timeout_s)
        connection.request(method, path, body=body, headers=headers)
        return connection.getresponse()


def _value_of(response: http.client.HTTPResponse) -> Any:
    """The value in an answer of JSON; raises AlpacaRefusalError."""
    body = response.read()
    if response.status != http.client.OK:
        text = body.decode("utf-8", "replace").strip()
        raise AlpacaRefusalError(-1, f"HTTP {response.status} {response.reason}: {text[:200]}")
    try:
        answer = json.loads(body)
    except ValueError as error:
        raise http.client.HTTPException(f"the answer is no JSON: {error}") from error
    if not isinstance(answer, dict):
        raise http.client.HTTPException("the answer is no JSON object")
    number = answer.get("ErrorNumber", 0)
    if number != 0:
        raise AlpacaRefusalError(number if isinstance(number, int) else -1, str(answer.get("ErrorMessage", "")))
    return answer.get("Value")


def _image_in(response: http.client.HTTPResponse) -> NDArray[Any]:
    """The image in an answer, in whichever of the two ways it came; raises AlpacaImageError, AlpacaRefusalError."""
    try:
        if response.headers.get("Content-Type", "").startswith(_MEDIA_TYPE) and response.status == http.client.OK:
            return _image_of_bytes(response)
        return _image_of_lists(_value_of(response))
    except NETWORK_ERRORS as error:  # the server did answer: if it is gone, the next request says so
        raise AlpacaImageError(f"the frame arrived incomplete: {error or type(error).__name__}") from error


def _image_of_bytes(response: http.client.HTTPResponse) -> NDArray[Any]:
    """Reads an ImageBytes answer; raises AlpacaImageError, AlpacaRefusalError."""
    raw_header = response.read(_HEADER.size)
    if len(raw_header) < _HEADER.size:
        raise AlpacaImageError(f"the frame arrived incomplete: {len(raw_header)} bytes")
    version, error, _, _, start, _, element, rank, *dimensions = _HEADER.unpack(raw_header)
    if error:
        raise AlpacaRefusalError(error, response.read().decode("utf-8", "replace"))
    shape = tuple(dimensions[:rank])
    if version != 1 or rank not in (2, 3) or element not in _ELEMENT_TYPES or min(shape) < 1 or start < _HEADER.size:
        raise AlpacaImageError(
            f"the header of the frame makes no sense: version {version}, rank {rank}, dimensions {shape}, "
            f"element type {element}, data at {start}"
        )
    response.read(start - _HEADER.size)
    dtype = np.dtype(_ELEMENT_TYPES[element])
    n_expected = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    if n_expected > _MAX_BYTES or (response.length is not None and response.length != n_expected):
        n_there = "more than can be" if response.length is None else f"{response.length} come"
        raise AlpacaImageError(f"the header of the frame announces {n_expected} bytes of image: {n_there}")
    image = np.empty(shape, dtype)
    view = image.reshape(-1).view(np.uint8).data
    n_read = 0
    while n_read < n_expected and (n_more := response.readinto(view[n_read:])):
        n_read += n_more
    if n_read < n_expected:
        raise AlpacaImageError(f"the frame arrived incomplete: {n_read} bytes of {n_expected}")
    return image


def _image_of_lists(lists: Any) -> NDArray[Any]:
    """An image that came as JSON; raises AlpacaImageError."""
    try:
        image = np.asarray(lists)
    except ValueError as error:
        raise AlpacaImageError("the frame arrived with rows of different lengths") from error
    if image.ndim not in (2, 3) or image.dtype.kind not in "iuf":
        raise AlpacaImageError(f"the frame is no image: {image.ndim} dimensions of {image.dtype}")
    return image
