"""Pixel formats against bytes worked out by hand from the standards, against a camera maker's own converter, and
against mosaics made here."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.core.errors import CommunicationError, ConfigError
from namod_ctl.devices.cameras.pixel_formats import choose_format, full_scale_of, image_of, is_colour

BY_HAND = [
    # (format, bytes, pixels of one row)
    ("Mono8", "00 7f ff", [0, 127, 255]),
    ("Mono10", "ff 03 01 00 00 02", [1023, 1, 512]),
    ("Mono12", "ff 0f 34 02", [4095, 0x234]),
    ("Mono16", "34 12 ff ff", [0x1234, 65535]),
    # from the lowest bit on: 0x123 and 0xABC make the stream 23 C1 AB
    ("Mono12p", "23 c1 ab", [0x123, 0xABC]),
    ("Mono12p", "23 c1 ab ff 0f", [0x123, 0xABC, 0xFFF]),  # an odd count ends in the middle of a byte
    # 1, 2, 3 and 1023 of ten bits: 1 | 2 << 10 | 3 << 20 | 1023 << 30, the lowest byte first
    ("Mono10p", "01 08 30 c0 ff", [1, 2, 3, 1023]),
    # upper eight bits of the first, lower four of both (the second's above), upper eight of the second
    ("Mono12Packed", "12 c3 ab", [0x123, 0xABC]),
    # 0b1010101001 and 0b0101010110: upper eight AA and 55, lower two 01 and 10
    ("Mono10Packed", "aa 21 55", [0b1010101001, 0b0101010110]),
]


@pytest.mark.parametrize(("pixel_format", "data", "pixels"), BY_HAND)
def test_bytes_worked_out_by_hand(pixel_format: str, data: str, pixels: list[int]) -> None:
    buffer = np.frombuffer(bytes.fromhex(data), dtype=np.uint8)
    image = image_of(buffer, pixel_format, len(pixels), 1)
    assert image.tolist() == [pixels]
    assert image.dtype == (np.uint8 if pixel_format == "Mono8" else np.uint16)


@pytest.mark.parametrize("depth_bits", [10, 12])
@given(data=st.data())
def test_a_stream_of_bits_is_cut_into_pixels(depth_bits: int, data: st.DataObject) -> None:
    columns, rows = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 5))
    n_pixels = columns * rows
    pixels = data.draw(st.lists(st.integers(0, 2**depth_bits - 1), min_size=n_pixels, max_size=n_pixels))
    stream = sum(pixel << depth_bits * number for number, pixel in enumerate(pixels))
    sent = stream.to_bytes(-(-depth_bits * n_pixels // 8), "little")
    image = image_of(np.frombuffer(sent, dtype=np.uint8), f"Mono{depth_bits}p", columns, rows)
    assert image.reshape(-1).tolist() == pixels


@given(data=st.binary(max_size=64), columns=st.integers(1, 8), rows=st.integers(1, 8))
@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono16", "Mono12p", "Mono10Packed", "RGB8", "YUV422_8_UYVY"])
def test_any_bytes_are_an_image_or_incomplete(pixel_format: str, data: bytes, columns: int, rows: int) -> None:
    bits = {"Mono8": 8, "Mono16": 16, "Mono12p": 12, "Mono10Packed": 12, "RGB8": 24, "YUV422_8_UYVY": 16}[pixel_format]
    buffer = np.frombuffer(data, dtype=np.uint8)
    if 8 * len(data) < bits * columns * rows:
        with pytest.raises(CommunicationError, match="incomplete"):
            image_of(buffer, pixel_format, columns, rows)
    elif pixel_format.startswith("YUV") and columns % 2:
        with pytest.raises(ConfigError, match="odd"):
            image_of(buffer, pixel_format, columns, rows)
    else:
        image = image_of(buffer, pixel_format, columns, rows)
        assert image.shape[:2] == (rows, columns)
        assert image.max() <= full_scale_of(pixel_format)


@pytest.mark.parametrize(
    ("pixel_format", "baslers", "bits", "tolerance"),
    [
        ("Mono10p", "Mono10p", 10, 0),
        ("Mono12p", "Mono12p", 12, 0),
        ("Mono10Packed", "Mono10packed", 12, 0),
        ("Mono12Packed", "Mono12packed", 12, 0),
        ("YUV422_8", "YUV422_YUYV_Packed", 16, 1),  # the rounding of two integer arithmetics
        ("YUV422_8_UYVY", "YUV422packed", 16, 1),
        ("RGB8", "RGB8packed", 24, 0),
    ],
)
def test_a_camera_makers_converter_reads_the_same(
    pixel_format: str, baslers: str, bits: int, tolerance: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYLON_CAMEMU", "2")  # read at the first import, and tests of the driver may come after
    pylon = pytest.importorskip("pypylon.pylon", reason="pypylon is not installed: pip install 'namod-ctl[pylon]'")
    columns, rows = 48, 20
    data = np.random.default_rng(11).integers(0, 256, columns * rows * bits // 8, dtype=np.uint8)
    source = pylon.PylonImage()
    source.AttachMemoryView(memoryview(data.tobytes()), getattr(pylon, f"PixelType_{baslers}"), columns, rows, 0)
    converter = pylon.ImageFormatConverter()
    is_grey = pixel_format.startswith("Mono")
    converter.OutputPixelFormat = pylon.PixelType_Mono16 if is_grey else pylon.PixelType_BGR8packed
    converter.OutputBitAlignment.Value = "LsbAligned"
    theirs = converter.Convert(source).GetArray().astype(int)
    ours = image_of(data, pixel_format, columns, rows).astype(int)
    assert np.abs(ours - theirs).max() <= tolerance


TILES = {"RG": ((2, 1), (1, 0)), "GR": ((1, 2), (0, 1)), "GB": ((1, 0), (2, 1)), "BG": ((0, 1), (1, 2))}
"""Channel (blue 0, green 1, red 2) of the four pixels at the upper left, as the standard's names say."""


def mosaic(image: np.ndarray, tile: str) -> np.ndarray:
    """What a sensor with that filter sees of a colour image."""
    seen = np.empty(image.shape[:2], dtype=image.dtype)
    for row, channels in enumerate(TILES[tile]):
        for column, channel in enumerate(channels):
            seen[row::2, column::2] = image[row::2, column::2, channel]
    return seen


@pytest.mark.parametrize("tile", TILES)
@pytest.mark.parametrize("depth_bits", [8, 12, 16])
def test_a_bayer_mosaic_gives_back_smooth_light_exactly(tile: str, depth_bits: int) -> None:
    top = 2**depth_bits - 1
    rows, columns = 12, 16
    down, right = np.mgrid[0:rows, 0:columns]
    light = np.stack([10 + 2 * right, 20 + 4 * down, top - 4 * right - 2 * down], axis=2)  # even steps: whole means
    image = light.astype(np.uint8 if depth_bits == 8 else "<u2")
    sent = mosaic(image, tile).reshape(-1).view(np.uint8)
    seen = image_of(sent, f"Bayer{tile}{depth_bits}", columns, rows)
    assert seen.shape == (rows, columns, 3)
    inside = (slice(2, -2), slice(2, -2))  # at the edges neighbours are missing
    assert np.array_equal(seen[inside], image[inside])


def test_a_packed_bayer_mosaic_is_unpacked_first() -> None:
    colour = np.broadcast_to(np.array([0x123, 0x456, 0xABC], dtype=np.uint16), (4, 4, 3))
    pixels = mosaic(colour, "GB").reshape(-1).tolist()
    stream = sum(pixel << 12 * number for number, pixel in enumerate(pixels))
    seen = image_of(np.frombuffer(stream.to_bytes(24, "little"), dtype=np.uint8), "BayerGB12p", 4, 4)
    assert np.array_equal(seen[1:-1, 1:-1], colour[1:-1, 1:-1])


def test_colour_comes_as_blue_green_red() -> None:
    sent = np.array([1, 2, 3, 4, 5, 6], dtype=np.uint8)
    assert image_of(sent, "RGB8", 2, 1).tolist() == [[[3, 2, 1], [6, 5, 4]]]
    assert image_of(sent, "BGR8", 2, 1).tolist() == [[[1, 2, 3], [4, 5, 6]]]


def test_grey_light_in_yuv_keeps_its_whole_range() -> None:
    ramp = np.arange(256, dtype=np.uint8)
    sent = np.stack([ramp, np.full(256, 128, dtype=np.uint8)], axis=1)
    image = image_of(sent, "YUV422_8", 256, 1)
    assert np.array_equal(image[0], np.repeat(ramp[:, None], 3, axis=1))
    image = image_of(sent[:, ::-1], "YUV422_8_UYVY", 256, 1)
    assert np.array_equal(image[0, :, 1], ramp)


@pytest.mark.parametrize(
    ("yuv", "bgr"),
    [((76, 85, 255), (0, 0, 254)), ((150, 44, 21), (1, 255, 0)), ((29, 255, 107), (254, 0, 0))],
    ids=["red", "green", "blue"],
)
def test_pure_colours_in_yuv(yuv: tuple[int, int, int], bgr: tuple[int, int, int]) -> None:
    """JFIF 1.02: R = Y + 1.402 (V - 128), G = Y - 0.34414 (U - 128) - 0.71414 (V - 128), B = Y + 1.772 (U - 128)."""
    y, u, v = yuv
    image = image_of(np.array([y, u, y, v], dtype=np.uint8), "YUV422_8", 2, 1)
    assert np.abs(image[0].astype(int) - bgr).max() <= 2


def test_chunk_data_behind_the_image_is_left_out_and_grey_is_not_copied() -> None:
    buffer = np.arange(20, dtype=np.uint8)
    image = image_of(buffer, "Mono8", 4, 3)
    assert image.tolist() == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]
    assert np.shares_memory(image, buffer)


@pytest.mark.parametrize("name", ["Mono9", "Mono8p", "Mono16Packed", "BayerXX8", "mono8", "Coord3D_C16", "", "RGB10"])
def test_an_unknown_format_is_refused_with_the_known_ones(name: str) -> None:
    for ask in (lambda: full_scale_of(name), lambda: is_colour(name), lambda: image_of(np.zeros(9), name, 1, 1)):
        with pytest.raises(ConfigError, match=r"Mono8/10/12/16.*Bayer"):
            ask()


@pytest.mark.parametrize(
    ("offered", "full_scale_adu", "chosen"),
    [
        (["BayerRG8", "Mono12p", "Mono8", "Mono12"], 255, "Mono8"),
        (["BayerRG8", "Mono12p", "Mono8", "Mono12"], 4095, "Mono12"),
        (["Mono12p", "BayerRG12"], 4000, "Mono12p"),  # grey in packed form rather than colour
        (["Coord3D_C16", "RGB8", "BayerGB8", "YUV422Packed"], 255, "BayerGB8"),
        (["RGB8Packed", "YUV422Packed"], 255, "RGB8Packed"),
        (["Mono10", "Mono16"], 65535, "Mono16"),
    ],
)
def test_the_depth_is_the_one_of_full_scale(offered: list[str], full_scale_adu: float, chosen: str) -> None:
    assert choose_format(offered, full_scale_adu) == chosen
    assert full_scale_of(chosen) >= full_scale_adu
    assert is_colour(chosen) is not chosen.startswith("Mono")


def test_a_camera_without_that_depth_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"10 bit.*Mono8, Mono12;"):
        choose_format(["Mono8", "Mono12"], 1023.0)
