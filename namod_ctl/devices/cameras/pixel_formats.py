"""Pixels as cameras send them, by their GenICam names, and the images they make.

Source: EMVA, GenICam Pixel Format Naming Convention 2.4 (names; `p`: packed from the lowest bit on); GigE Vision 1.2
(`...Packed`: two pixels in three bytes, the lowest bits of both in the middle; YUV with its full range 0 to 255).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import CommunicationError, ConfigError

Image = NDArray[np.unsignedinteger[Any]]
Bytes = NDArray[np.uint8]
Decode = Callable[[Bytes, int, int], Image]
"""From the bytes of one image, its columns and its rows."""

KNOWN = (
    "Mono8/10/12/16, Mono10p/12p, Mono10Packed/12Packed, the same with BayerRG, BayerGR, BayerGB or BayerBG for Mono, "
    "RGB8, BGR8, YUV422_8, YUV422_8_UYVY"
)
_RAW = re.compile(r"(?P<kind>Mono|Bayer(?P<tile>RG|GR|GB|BG))(?P<depth>8|10|12|16)(?P<packing>p|Packed)?")
_DEMOSAIC = {
    "RG": cv2.COLOR_BayerRGGB2BGR,
    "GR": cv2.COLOR_BayerGRBG2BGR,
    "GB": cv2.COLOR_BayerGBRG2BGR,
    "BG": cv2.COLOR_BayerBGGR2BGR,
}
_RGB = ("RGB8", "RGB8Packed")
_BGR = ("BGR8", "BGR8Packed")
_YUYV = ("YUV422_8", "YUV422_YUYV_Packed", "YCbCr422_8")
_UYVY = ("YUV422_8_UYVY", "YUV422Packed", "YCbCr422_8_CbYCrY")


@dataclass(frozen=True, slots=True)
class _Format:
    """How one format is laid out.

    Attributes
    ----------
    bits_per_pixel
        In the buffer.
    preference
        Of formats with the same depth the lowest is taken: grey before colour, unpacked before packed.
    """

    name: str
    depth_bits: int
    bits_per_pixel: int
    preference: int
    decode: Decode


def full_scale_of(pixel_format: str) -> float:
    """The brightest value a pixel of that format can have. Raises ConfigError for an unknown format."""
    return float(2 ** _format_of(pixel_format).depth_bits - 1)


def is_colour(pixel_format: str) -> bool:
    """True when images of that format have three channels. Raises ConfigError for an unknown format."""
    return not _format_of(pixel_format).name.startswith("Mono")


def choose_format(offered: Iterable[str], full_scale_adu: float) -> str:
    """Of the formats a camera offers, the one whose depth `full_scale_adu` says: grey if there is, else colour.

    Raises
    ------
    ConfigError
        None does; the text lists what is offered.
    """
    names = list(offered)
    depth_bits = int(full_scale_adu).bit_length()
    formats = [known for known in map(_find, names) if known is not None and known.depth_bits == depth_bits]
    if not formats:
        raise ConfigError(
            f"no pixel format of {depth_bits} bit, as full_scale_adu = {full_scale_adu:g} says: the camera offers "
            f"{', '.join(names) or 'none'}; the program reads {KNOWN}; change full_scale_adu, or give pixel_format"
        )
    return min(formats, key=lambda known: known.preference).name


def image_of(buffer: NDArray[Any], pixel_format: str, columns: int, rows: int) -> Image:
    """The image in a camera's buffer: shape (rows, columns) grey or (rows, columns, 3) blue-green-red.

    uint8 up to 8 bit, else uint16, right-aligned. Bayer patterns are interpolated bilinearly, so that the result stays
    proportional to the light. Unpacked grey shares the memory of `buffer`: copy it when the camera uses that again.

    Parameters
    ----------
    buffer
        Any shape and type, its bytes in the order in which they came, without padding between rows; what follows the
        image (chunk data) is left out.

    Raises
    ------
    CommunicationError
        The buffer holds less than an image.
    ConfigError
        Unknown format.
    """
    known = _format_of(pixel_format)
    data = np.ascontiguousarray(buffer).reshape(-1).view(np.uint8)
    n_needed = -(-known.bits_per_pixel * columns * rows // 8)
    if data.size < n_needed:
        raise CommunicationError(
            f"the frame arrived incomplete: {data.size} bytes of {n_needed} "
            f"({columns} x {rows} pixels of {pixel_format})"
        )
    return known.decode(data[:n_needed], columns, rows)


def _format_of(name: str) -> _Format:
    known = _find(name)
    if known is None:
        raise ConfigError(f'pixel format "{name}" is not known; known are {KNOWN}')
    return known


def _find(name: str) -> _Format | None:
    """The format of that name; None for one the program cannot read."""
    if name in _RGB:
        return _Format(name, 8, 24, 21, _colour_of_rgb)
    if name in _BGR:
        return _Format(name, 8, 24, 20, _colour)
    if name in (*_YUYV, *_UYVY):
        return _Format(name, 8, 16, 30, _yuv_decoder(first_y=0 if name in _YUYV else 1))
    match = _RAW.fullmatch(name)
    if match is None:
        return None
    depth_bits, packing, tile = int(match["depth"]), match["packing"], match["tile"]
    unpack: Decode
    if packing is None:
        bits, unpack = (8, _bytes) if depth_bits == 8 else (16, _words)
    elif depth_bits not in (10, 12):
        return None
    elif packing == "p":
        bits, unpack = depth_bits, _unpacker_from_lowest_bit(depth_bits)
    else:
        bits, unpack = 12, _unpacker_of_pairs(depth_bits)
    decode = unpack if tile is None else _with_demosaic(unpack, _DEMOSAIC[tile])
    return _Format(name, depth_bits, bits, (10 if tile else 0) + (packing is not None), decode)


def _bytes(data: Bytes, columns: int, rows: int) -> Image:
    return data.reshape(rows, columns)


def _words(data: Bytes, columns: int, rows: int) -> Image:
    return data.view("<u2").reshape(rows, columns)


def _colour(data: Bytes, columns: int, rows: int) -> Image:
    return data.reshape(rows, columns, 3)


def _colour_of_rgb(data: Bytes, columns: int, rows: int) -> Image:
    return cv2.cvtColor(_colour(data, columns, rows), cv2.COLOR_RGB2BGR).astype(np.uint8, copy=False)


def _unpacker_from_lowest_bit(depth_bits: int) -> Decode:
    """For a stream of bits, pixel after pixel, the lowest bit of each first; the depth is 10 or 12."""
    n_pixels_per_group = 4 if depth_bits == 10 else 2
    n_bytes_per_group = n_pixels_per_group * depth_bits // 8

    def unpack(data: Bytes, columns: int, rows: int) -> Image:
        groups = _groups(data, n_bytes_per_group)
        pixels = np.empty((len(groups), n_pixels_per_group), dtype=np.uint16)
        for number in range(n_pixels_per_group):
            byte, shift = divmod(number * depth_bits, 8)
            pair = groups[:, byte] | groups[:, byte + 1].astype(np.uint16) << 8
            pixels[:, number] = pair >> shift & (1 << depth_bits) - 1
        return pixels.reshape(-1)[: columns * rows].reshape(rows, columns)

    return unpack


def _unpacker_of_pairs(depth_bits: int) -> Decode:
    """For two pixels in three bytes: the upper eight bits of one, the lowest bits of both, the upper of the other."""
    n_low_bits = depth_bits - 8
    low_mask = (1 << n_low_bits) - 1

    def unpack(data: Bytes, columns: int, rows: int) -> Image:
        groups = _groups(data, 3)
        pixels = np.empty((len(groups), 2), dtype=np.uint16)
        low = groups[:, 1]
        pixels[:, 0] = groups[:, 0].astype(np.uint16) << n_low_bits | low & low_mask
        pixels[:, 1] = groups[:, 2].astype(np.uint16) << n_low_bits | low >> 4 & low_mask
        return pixels.reshape(-1)[: columns * rows].reshape(rows, columns)

    return unpack


def _groups(data: Bytes, n_bytes: int) -> Bytes:
    """The data as rows of `n_bytes`, the last one filled up with zeros."""
    n_missing = -data.size % n_bytes
    if n_missing:
        data = np.append(data, np.zeros(n_missing, dtype=np.uint8))
    return data.reshape(-1, n_bytes)


def _with_demosaic(unpack: Decode, code: int) -> Decode:
    def decode(data: Bytes, columns: int, rows: int) -> Image:
        mosaic = unpack(data, columns, rows)
        return cv2.cvtColor(mosaic, code).astype(mosaic.dtype, copy=False)

    return decode


def _yuv_decoder(first_y: int) -> Decode:
    """For a pair of pixels in four bytes: Y U Y V (`first_y` = 0) or U Y V Y (1).

    cv2 has conversions of 4:2:2 for video only, whose Y goes from 16 to 235: bright pixels would saturate too early.
    """

    def decode(data: Bytes, columns: int, rows: int) -> Image:
        if columns % 2:
            raise ConfigError(f"YUV422 comes in pairs of pixels: {columns} columns are odd; choose an even number")
        quads = data.reshape(rows, columns // 2, 2, 2)
        full = np.empty((rows, columns // 2, 2, 3), dtype=np.uint8)
        full[..., 0] = quads[..., first_y]
        full[..., 1] = quads[:, :, 1, None, 1 - first_y]  # V, or Cr, of both pixels
        full[..., 2] = quads[:, :, 0, None, 1 - first_y]  # U, or Cb
        return cv2.cvtColor(full.reshape(rows, columns, 3), cv2.COLOR_YCrCb2BGR).astype(np.uint8, copy=False)

    return decode
