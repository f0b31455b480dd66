"""Frames in files of other programs: FITS with its header, PNG and TIFF with a side file that tells the exposure."""

from __future__ import annotations

import io
import json
import math
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from namod_ctl.core.errors import CommunicationError

FITS_ENDINGS = frozenset({".fits", ".fit", ".fts"})
PICTURE_ENDINGS = frozenset({".png", ".tif", ".tiff"})
SIDE_ENDINGS = (".json", ".txt")

EXPOSURE_KEYWORDS = ("EXPTIME", "EXPOSURE")
START_KEYWORDS = ("DATE-BEG", "DATE-OBS")
REQUEST_KEYWORD = "NAMODREQ"

_FITS_BLOCK = 2880
_MAX_HEADER_BYTES = 400 * _FITS_BLOCK
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
_STRIP_OFFSETS, _STRIP_LENGTHS = 273, 279  # tags of TIFF 6.0, section 8
_TILE_OFFSETS, _TILE_LENGTHS = 324, 325  # section 15
_TIFF_PIXELS = frozenset({_STRIP_OFFSETS, _STRIP_LENGTHS, _TILE_OFFSETS, _TILE_LENGTHS})
_TIFF_TYPES = {3: "H", 4: "I", 5: "Q", 8: "H", 9: "I", 10: "Q", 11: "I", 12: "Q"}  # by their sizes

Image = NDArray[np.unsignedinteger[Any]]


class UnfinishedFileError(Exception):
    """The file, or what belongs to it, is not whole: somebody may still be writing it. The text says why."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameFile:
    """What a file tells of one exposure.

    Attributes
    ----------
    image
        Shape (rows, columns) or (rows, columns, 3) blue-green-red, uint8 or uint16, rows in the order of the file.
    start
        Beginning of the exposure in UTC; None where the file does not tell it, or to the second only.
    request
        Which request the frame answers; None where the file does not tell.
    """

    image: Image
    exposure_s: float
    start: datetime | None
    request: str | None


def read_frame_file(path: Path) -> FrameFile:
    """The frame in a file of `FITS_ENDINGS` or `PICTURE_ENDINGS`.

    Raises
    ------
    UnfinishedFileError
        The image or its side file is not whole.
    CommunicationError
        It is whole, but no frame that the program can use.
    OSError
        It cannot be read.
    """
    if path.suffix.lower() in FITS_ENDINGS:
        return _read_fits(path.read_bytes(), path)
    facts = _side_facts(path)
    image = _read_picture(path.read_bytes(), path)
    return _frame(image, facts.get("exposure_s"), facts.get("start_utc"), facts.get("request"), path, "exposure_s")


def _frame(image: NDArray[Any], exposure: Any, start: Any, request: Any, path: Path, wanted: str) -> FrameFile:
    try:
        exposure_s = float(exposure)
    except (TypeError, ValueError):
        raise CommunicationError(f"{path}: no exposure: {wanted} = {exposure!r}; give it in seconds") from None
    if not 0.0 < exposure_s < math.inf:
        raise CommunicationError(f"{path}: {wanted} = {exposure_s:g} is no exposure; give it in seconds")
    if image.dtype not in (np.uint8, np.uint16) or not (image.ndim == 2 or image.shape[2:] == (3,)):
        raise CommunicationError(
            f"{path}: pixels are {image.dtype}, shape {image.shape}; write grey or three colours, "
            "unsigned integers of 8 or 16 bit"
        )
    return FrameFile(image, exposure_s, _moment(start), None if request is None else str(request))


def _moment(text: Any) -> datetime | None:
    """The moment, UTC unless it says otherwise; None for what is no moment or has no fraction of a second."""
    if not isinstance(text, str) or "." not in text:
        return None
    try:
        moment = datetime.fromisoformat(text.strip())
        return moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def _read_fits(data: bytes, path: Path) -> FrameFile:
    """The image of a FITS file's primary part: BITPIX = 8, or 16 with BZERO = 0 or 32768 (FITS 4.0, section 5.2.5)."""
    from astropy.io import fits  # takes half a second: only who has such files waits for it

    n_header = _fits_header_size(data, path)
    try:
        header = fits.Header.fromstring(data[:n_header].decode("ascii"))
        kind = (int(header["BITPIX"]), float(header.get("BZERO", 0.0)), float(header.get("BSCALE", 1.0)))
        axes = [int(header[f"NAXIS{number}"]) for number in range(int(header["NAXIS"]), 0, -1)]
        exposure = next((header[key] for key in EXPOSURE_KEYWORDS if key in header), None)
        start = next((header[key] for key in START_KEYWORDS if key in header), None)
        request = header.get(REQUEST_KEYWORD)
    except (KeyError, ValueError, TypeError, OverflowError, fits.VerifyError) as error:
        raise CommunicationError(f"{path}: its FITS header is not to be understood: {error}") from None
    if not axes or min(axes) < 1:
        raise CommunicationError(f"{path}: holds no image in its first part; write it there, not compressed")
    if kind not in ((8, 0.0, 1.0), (16, 0.0, 1.0), (16, 32768.0, 1.0)):
        raise CommunicationError(
            f"{path}: BITPIX = {kind[0]}, BZERO = {kind[1]:g}, BSCALE = {kind[2]:g}; write unsigned integers of 8 or "
            "16 bit"
        )
    n_bytes = kind[0] // 8 * math.prod(axes)
    if len(data) < n_header + n_bytes:
        raise UnfinishedFileError(f"{path.name}: {len(data)} bytes of {n_header + n_bytes}")
    stored, native = (np.uint8, np.uint8) if kind[0] == 8 else (">u2", np.uint16)
    image: NDArray[Any] = np.frombuffer(data, stored, math.prod(axes), n_header).astype(native)
    if kind[1]:
        image ^= 0x8000  # which adds 32768 to the signed number that is stored
    elif kind[0] == 16 and image.max() > np.iinfo(np.int16).max:
        raise CommunicationError(f"{path}: has negative pixels; write unsigned integers (BZERO = 32768)")
    image = image.reshape(axes)
    if image.ndim == 3 and image.shape[0] == 3:  # one plane per colour: red, green, blue
        image = np.ascontiguousarray(image[::-1].transpose(1, 2, 0))
    return _frame(image, exposure, start, request, path, " or ".join(EXPOSURE_KEYWORDS))


def _fits_header_size(data: bytes, path: Path) -> int:
    """Bytes of the header, a whole number of blocks."""
    if data and not b"SIMPLE  =".startswith(data[:9]) and not data.startswith(b"SIMPLE  ="):
        raise CommunicationError(f"{path}: is no FITS file")
    for begin in range(0, min(len(data), _MAX_HEADER_BYTES), 80):
        if data[begin : begin + 80].rstrip() == b"END":
            end = -(-(begin + 80) // _FITS_BLOCK) * _FITS_BLOCK
            if len(data) >= end:
                return end
    if len(data) >= _MAX_HEADER_BYTES:
        raise CommunicationError(f"{path}: is no FITS file: its header has no end")
    raise UnfinishedFileError(f"{path.name}: its header is not whole")


def _side_facts(path: Path) -> dict[str, Any]:
    """What the side file of a picture says, by key."""
    for ending in SIDE_ENDINGS:
        side = path.with_suffix(ending)
        try:
            text = side.read_text(encoding="utf-8")
        except FileNotFoundError:
            continue
        except UnicodeDecodeError:
            raise CommunicationError(f"{side}: is no text") from None
        return _facts_of_json(text, side) if ending == ".json" else _facts_of_lines(text, side)
    wanted = " or ".join(path.with_suffix(ending).name for ending in SIDE_ENDINGS)
    raise UnfinishedFileError(f"{path.name}: its side file {wanted}, which tells the exposure, is missing")


def _facts_of_json(text: str, side: Path) -> dict[str, Any]:
    try:
        facts = json.loads(text)
    except (ValueError, RecursionError):
        raise UnfinishedFileError(f"{side.name}: is no JSON, or not whole") from None
    if not isinstance(facts, dict):
        raise CommunicationError(f'{side}: must be a JSON object such as {{"exposure_s": 0.02}}')
    return facts


def _facts_of_lines(text: str, side: Path) -> dict[str, Any]:
    if not text.endswith("\n"):
        raise UnfinishedFileError(f"{side.name}: its last line has no end")
    pairs = [line.partition("=") for line in text.splitlines() if line.strip()]
    if not all(sign for _, sign, _ in pairs):
        raise CommunicationError(f"{side}: every line must be like exposure_s = 0.02")
    return {key.strip(): value.strip() for key, _, value in pairs}


def _read_picture(data: bytes, path: Path) -> NDArray[Any]:
    """The pixels of a PNG or TIFF file, its channels in OpenCV's order."""
    try:
        if path.suffix.lower() == ".png":
            if _PNG_END not in data:
                raise UnfinishedFileError(f"{path.name}: {len(data)} bytes, and its end is missing")
            with PillowImage.open(io.BytesIO(data), formats=["PNG"]) as picture:
                picture.verify()  # the check sums; OpenCV is content with less
        elif _tiff_size(data) > len(data):
            raise UnfinishedFileError(f"{path.name}: {len(data)} bytes of {_tiff_size(data)}")
    except PillowImage.DecompressionBombError as error:
        raise CommunicationError(f"{path}: {error}") from None
    except (OSError, SyntaxError, ValueError, EOFError, struct.error) as error:
        raise UnfinishedFileError(f"{path.name}: is no picture, or not whole ({error})") from None
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise CommunicationError(f"{path}: cannot be decoded ({error.err})") from None
    if image is None:
        raise CommunicationError(f"{path}: cannot be decoded")
    if image.ndim == 3 and image.shape[2] == 4:  # transparency, which no camera sees
        image = np.ascontiguousarray(image[:, :, :3])
    return image


def _tiff_size(data: bytes) -> int:
    """So many bytes the first image of a TIFF file and what describes it reach into the file (TIFF 6.0, section 2).

    Raises ValueError, struct.error when even the description is not whole. Libraries fill up what is missing.
    """
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        raise ValueError("it does not begin like TIFF")
    (directory,) = struct.unpack_from(f"{order}I", data, 4)
    (n_entries,) = struct.unpack_from(f"{order}H", data, directory)
    ends: list[int] = [directory + 2 + 12 * n_entries]
    values: dict[int, tuple[int, ...]] = {}
    for entry in range(directory + 2, ends[0], 12):
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, entry)
        code = _TIFF_TYPES.get(kind, "B")
        n_bytes = struct.calcsize(f"{order}{code}") * count
        place = entry + 8 if n_bytes <= 4 else struct.unpack_from(f"{order}I", data, entry + 8)[0]
        ends.append(place + n_bytes)
        if tag in _TIFF_PIXELS:
            values[tag] = struct.unpack_from(f"{order}{count}{code}", data, place)
    for offsets, lengths in ((_STRIP_OFFSETS, _STRIP_LENGTHS), (_TILE_OFFSETS, _TILE_LENGTHS)):
        pairs = zip(values.get(offsets, ()), values.get(lengths, ()), strict=False)
        ends += [begin + length for begin, length in pairs]
    if not values:
        raise ValueError("its description names no pixels")
    return max(ends)
