"""Frames and their side files as any program writes them: read as they are, or refused, never half."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from frame_program import bytes_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from namod_ctl.core.errors import CommunicationError
from namod_ctl.devices.cameras.frame_files import UnfinishedFileError, read_frame_file

COLUMNS, ROWS = 40, 30
GREY = np.random.default_rng(3).integers(0, 256, (ROWS, COLUMNS), dtype=np.uint8)
COLOUR = np.random.default_rng(4).integers(0, 256, (ROWS, COLUMNS, 3), dtype=np.uint8)
DEEP = np.random.default_rng(5).integers(0, 4096, (ROWS, COLUMNS), dtype=np.uint16)


@pytest.mark.parametrize("ending", [".fits", ".png", ".tif"])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=40)
@given(data=st.data())
def test_no_beginning_of_a_file_is_a_frame(tmp_path: Path, ending: str, data: st.DataObject) -> None:
    whole = bytes_of(GREY, ending)
    n_data = len(whole) if ending != ".fits" else 2880 + GREY.size  # what follows is only there to fill the block
    path = tmp_path / f"frame{ending}"
    path.write_bytes(whole[: data.draw(st.integers(0, n_data - 1))])
    (tmp_path / "frame.json").write_text('{"exposure_s": 0.01}')
    with pytest.raises(UnfinishedFileError):
        read_frame_file(path)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)
@given(text=st.binary(max_size=40), ending=st.sampled_from([".json", ".txt"]))
def test_any_side_file_is_understood_or_refused(tmp_path: Path, text: bytes, ending: str) -> None:
    for other in (".json", ".txt"):
        (tmp_path / "frame").with_suffix(other).unlink(missing_ok=True)
    (tmp_path / "frame.png").write_bytes(bytes_of(GREY, ".png"))
    (tmp_path / "frame").with_suffix(ending).write_bytes(text)
    try:
        frame = read_frame_file(tmp_path / "frame.png")
    except (UnfinishedFileError, CommunicationError):
        return
    assert 0.0 < frame.exposure_s < math.inf


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)
@given(head=st.binary(max_size=3000), ending=st.sampled_from([".fits", ".png", ".tif"]), keeps=st.booleans())
def test_any_bytes_are_a_frame_or_refused(tmp_path: Path, head: bytes, ending: str, keeps: bool) -> None:
    path = tmp_path / f"frame{ending}"
    path.write_bytes(bytes_of(GREY, ending)[:80] + head if keeps else head)
    (tmp_path / "frame.json").write_text('{"exposure_s": 0.01}')
    with pytest.raises((UnfinishedFileError, CommunicationError)):
        read_frame_file(path)


def test_signed_and_coloured_fits(tmp_path: Path) -> None:
    path = tmp_path / "frame.fits"
    fits.PrimaryHDU(DEEP.astype(np.int16), fits.Header({"EXPTIME": 1.0})).writeto(path)
    assert np.array_equal(read_frame_file(path).image, DEEP)
    planes = np.stack([COLOUR[..., 2], COLOUR[..., 1], COLOUR[..., 0]])  # red, green, blue, as FITS has them
    fits.PrimaryHDU(planes, fits.Header({"EXPTIME": 1.0})).writeto(path, overwrite=True)
    assert np.array_equal(read_frame_file(path).image, COLOUR)
    fits.PrimaryHDU(DEEP.astype(np.float32), fits.Header({"EXPTIME": 1.0})).writeto(path, overwrite=True)
    with pytest.raises(CommunicationError, match=r"BITPIX = -32.*unsigned"):
        read_frame_file(path)
    fits.PrimaryHDU(DEEP).writeto(path, overwrite=True)
    with pytest.raises(CommunicationError, match="EXPTIME or EXPOSURE"):
        read_frame_file(path)
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(DEEP)]).writeto(path, overwrite=True)
    with pytest.raises(CommunicationError, match="no image in its first part"):
        read_frame_file(path)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=150)
@given(place=st.integers(0, 2879), byte=st.integers(0, 255), more=st.binary(max_size=8))
@pytest.mark.filterwarnings("ignore")  # astropy's, about cards
def test_a_damaged_fits_header_is_a_frame_or_refused(tmp_path: Path, place: int, byte: int, more: bytes) -> None:
    data = bytearray(bytes_of(GREY, ".fits"))
    data[place] = byte
    data[place : place + len(more)] = more
    path = tmp_path / "frame.fits"
    path.write_bytes(data)
    try:
        frame = read_frame_file(path)
    except (UnfinishedFileError, CommunicationError):
        return
    assert frame.image.dtype in (np.uint8, np.uint16)
    assert 0.0 < frame.exposure_s < math.inf


def test_negative_pixels_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "frame.fits"
    fits.PrimaryHDU(np.full((ROWS, COLUMNS), -1, dtype=np.int16), fits.Header({"EXPTIME": 1.0})).writeto(path)
    with pytest.raises(CommunicationError, match="negative pixels"):
        read_frame_file(path)


def test_sixteen_bits_in_colour_survive(tmp_path: Path) -> None:
    deep = np.random.default_rng(6).integers(0, 65536, (ROWS, COLUMNS, 3), dtype=np.uint16)
    assert cv2.imwrite(str(tmp_path / "frame.png"), deep)
    (tmp_path / "frame.json").write_text('{"exposure_s": 0.25}')
    frame = read_frame_file(tmp_path / "frame.png")
    assert frame.exposure_s == 0.25
    assert np.array_equal(frame.image, deep)
