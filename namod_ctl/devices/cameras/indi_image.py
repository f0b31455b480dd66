"""A frame as INDI cameras send it, a FITS file, and as the program takes it.

Source: FITS Standard 4.0; INDI's keywords EXPTIME, DATE-OBS (begin of the exposure, UTC), BAYERPAT, XBAYROFF, YBAYROFF.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, TypeAlias

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from namod_ctl.core.errors import CommunicationError
from namod_ctl.devices.cameras.pixel_formats import image_of

Image: TypeAlias = NDArray[np.unsignedinteger[Any]]

_BYTE = 255.0
_BLOCK = 2880  # bytes
_MOSAICS = {"RGGB": (0, 0), "GRBG": (1, 0), "GBRG": (0, 1), "BGGR": (1, 1)}  # place of the first pixel in RGGB
_TILES = {(0, 0): "RG", (1, 0): "GR", (0, 1): "GB", (1, 1): "BG"}


@dataclass(frozen=True, slots=True, eq=False)
class IndiFrame:
    """One frame out of its FITS file.

    Attributes
    ----------
    image
        Shape (rows, columns), or (rows, columns, 3) blue-green-red; uint8 up to 255 ADU, else uint16.
    exposure_s
        As the camera says; None where it does not.
    begin
        When the exposure began by the server's clock; None where it does not say.
    """

    image: Image
    exposure_s: float | None
    begin: datetime | None


def frame_of_fits(data: bytes, full_scale_adu: float, corner: tuple[int, int], binning: int) -> IndiFrame:
    """The frame in a FITS file.

    Parameters
    ----------
    corner
        The frame's upper left corner (x, y) on the sensor: which colour of a mosaic comes first.

    Raises
    ------
    CommunicationError
        That is no sound FITS file with one image, or a pixel is beyond `full_scale_adu`.
    """
    try:
        return _frame_of(data, full_scale_adu, corner, binning)
    except (OSError, EOFError, LookupError, ValueError, TypeError, fits.VerifyError) as error:  # what astropy raises
        raise CommunicationError(f"the frame is no sound FITS file: {error or type(error).__name__}") from error


def _frame_of(data: bytes, full_scale_adu: float, corner: tuple[int, int], binning: int) -> IndiFrame:
    header, pixels = _read(data)
    lowest, highest = pixels.min(), pixels.max()
    if not 0 <= lowest <= highest <= full_scale_adu:
        raise CommunicationError(
            f"pixels of {lowest:g} to {highest:g} ADU came where full_scale_adu = {full_scale_adu:g} is set"
        )
    dtype = np.dtype(np.uint8) if full_scale_adu <= _BYTE else np.dtype(np.uint16)
    if pixels.ndim == 3:  # planes of red, green and blue
        image: Image = np.ascontiguousarray(pixels[::-1].transpose(1, 2, 0), dtype)
    else:
        image = np.ascontiguousarray(pixels, dtype)
        place = _MOSAICS.get(str(header.get("BAYERPAT", "")).strip().upper())
        if place is not None and binning == 1:
            image = _demosaic(image, header, place, corner)
    return IndiFrame(image, _exposure_in(header), _begin_in(header))


def _read(data: bytes) -> tuple[fits.Header, NDArray[Any]]:
    """Header and pixels of the first image: shape (rows, columns) or (3, rows, columns)."""
    stream = io.BytesIO(data)
    header = fits.Header.fromfile(stream)
    axes = [int(header[f"NAXIS{number}"]) for number in range(1, int(header["NAXIS"]) + 1)]
    n_bytes = abs(int(header["BITPIX"])) // 8 * math.prod(axes)
    if not (len(axes) == 2 or (len(axes) == 3 and axes[2] == 3)) or min(axes) < 1 or n_bytes < 1:
        raise CommunicationError(f"the frame has axes {axes}: that is no image")
    n_expected = stream.tell() + n_bytes
    if len(data) < n_expected:
        raise CommunicationError(f"the frame arrived incomplete: {len(data)} bytes of {n_expected}")
    with fits.open(io.BytesIO(data + bytes(-len(data) % _BLOCK)), memmap=False) as file:
        if not isinstance(file[0], fits.PrimaryHDU):
            raise CommunicationError("the frame is no sound FITS file: its first part is damaged")
        return header, np.asarray(file[0].data)


def _demosaic(image: Image, header: fits.Header, place: tuple[int, int], corner: tuple[int, int]) -> Image:
    rows, columns = image.shape
    x = (place[0] + corner[0] + int(header.get("XBAYROFF", 0))) % 2
    y = (place[1] + corner[1] + int(header.get("YBAYROFF", 0))) % 2
    return image_of(image, f"Bayer{_TILES[x, y]}{8 * image.dtype.itemsize}", columns, rows)


def _exposure_in(header: fits.Header) -> float | None:
    value = header.get("EXPTIME", header.get("EXPOSURE"))
    return float(value) if isinstance(value, int | float) else None


def _begin_in(header: fits.Header) -> datetime | None:
    try:
        begin = datetime.fromisoformat(str(header.get("DATE-OBS", "")))
    except ValueError:
        return None
    return begin.replace(tzinfo=UTC) if begin.tzinfo is None else begin
