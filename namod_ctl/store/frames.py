"""Frames on disk: one losslessly compressed file per image, written so that it is whole or absent.

A file appears under its name only after all its bytes are on the disk (temporary file, fsync, rename, fsync of
the folder). Its SHA-256 is kept in the run's database and verified at every reading.

PNG at level 1: of the lossless formats the only one that every image viewer opens, and a 2560 x 1920 frame is
written in 0.16 s; stronger levels cost time and save nothing on noise.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import StoreError

STAR_CAMERA, REFLECTOR_CAMERA = "star_camera", "reflector_camera"  # names under which frames are kept
Frame = NDArray[np.uint8] | NDArray[np.uint16]

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_LEVEL = 1


def encode_png(frame: Frame) -> bytes:
    """The frame, uint8 or uint16 of shape (rows, columns) or (rows, columns, 3) in OpenCV's order, as a PNG file."""
    if frame.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"frames are uint8 or uint16, not {frame.dtype}")
    is_encoded, data = cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    if not is_encoded:
        raise ValueError(f"a frame of shape {frame.shape} cannot be written as PNG")
    return data.tobytes()


def decode_png(data: bytes) -> Frame:
    """The frame in a PNG file's bytes: uint8 or uint16, shape (rows, columns) or (rows, columns, 3), OpenCV's order.

    An alpha channel is dropped: no camera of ours writes one.

    Raises
    ------
    ValueError
        It is no PNG, it is cut or damaged (its check sums are verified here: what image libraries make of a cut
        file differs from version to version).
    """
    _check_png(data)
    try:
        frame = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"the PNG cannot be decoded ({error.err})") from error
    if frame is None:
        raise ValueError("the PNG cannot be decoded")
    if frame.ndim == 3 and frame.shape[2] == 4:
        frame = frame[:, :, :3]
    if frame.dtype == np.uint16:
        return np.ascontiguousarray(frame, dtype=np.uint16)
    return np.ascontiguousarray(frame, dtype=np.uint8)


def png_size(path: Path) -> tuple[int, int] | None:
    """(columns, rows) as the head of a PNG file says, None when it is missing or no PNG; its image is not decoded."""
    try:
        with path.open("rb") as file:
            head = file.read(24)
    except OSError:
        return None
    if len(head) < 24 or not head.startswith(_PNG_SIGNATURE) or head[12:16] != b"IHDR":
        return None
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


def write_file_durably(path: Path, data: bytes) -> str:
    """SHA-256 (hex) of `data`, which is at `path`, whole and on the disk, when this returns. Raises OSError."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)
    return hashlib.sha256(data).hexdigest()


def read_verified(path: Path, sha256: str) -> bytes:
    """The bytes of a file whose SHA-256 is known. Raises StoreError when it is missing or has changed."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise StoreError(f"{path}: the frame cannot be read ({error.strerror}); restore it from a copy") from error
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise StoreError(f"{path}: the frame has changed since it was recorded (SHA-256 {found}, recorded {sha256})")
    return data


def sync_folder(folder: Path) -> None:
    """Put the names in `folder` on the disk: without it a rename can be lost with the power. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _check_png(data: bytes) -> None:
    if not data.startswith(_PNG_SIGNATURE):
        raise ValueError("the file is no PNG" if data else "the file is empty")
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):  # a chunk is length (4), type (4), data, CRC (4): PNG specification, section 5.3
        end = position + 12 + int.from_bytes(data[position : position + 4], "big")
        kind = data[position + 4 : position + 8]
        if end > len(data):
            break
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise ValueError(f"the PNG is damaged: wrong check sum at byte {position}")
        if kind == b"IEND":
            return
        position = end
    raise ValueError(f"the PNG is cut off after {len(data)} bytes")
