"""Images as Alpaca orders them, [x][y], and as the program does, [row, column]."""

from __future__ import annotations

from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.devices.cameras.alpaca_http import AlpacaImageError
from namod_ctl.devices.cameras.pixel_formats import image_of

Image: TypeAlias = NDArray[np.unsignedinteger[Any]]

_BYTE = 255.0


def image_of_alpaca(planes: NDArray[Any], full_scale_adu: float, tile: str | None) -> Image:
    """Shape (rows, columns), or (rows, columns, 3) blue-green-red; uint8 up to 255 ADU, else uint16.

    Parameters
    ----------
    planes
        Shape (columns, rows) or (columns, rows, 3) red-green-blue, of any numbers.
    tile
        The Bayer pattern of the frame from its first pixel on, "RG", "GR", "GB" or "BG"; None: there is none.

    Raises
    ------
    AlpacaImageError
        A pixel is negative or beyond `full_scale_adu`: the device is deeper than the config says.
    """
    dtype = np.dtype(np.uint8) if full_scale_adu <= _BYTE else np.dtype(np.uint16)
    if planes.dtype != dtype or full_scale_adu < np.iinfo(dtype).max:
        lowest, highest = planes.min(), planes.max()
        if not 0 <= lowest <= highest <= full_scale_adu:
            raise AlpacaImageError(
                f"pixels of {lowest:g} to {highest:g} ADU came where full_scale_adu = {full_scale_adu:g} is set"
            )
    if planes.ndim == 3:
        return np.ascontiguousarray(planes.transpose(1, 0, 2)[..., ::-1], dtype)
    is_plain = planes.dtype == dtype
    image: Image = np.asarray(cv2.transpose(planes)) if is_plain else np.ascontiguousarray(planes.T, dtype)
    if tile is None:
        return image
    rows, columns = image.shape
    return image_of(image, f"Bayer{tile}{8 * dtype.itemsize}", columns, rows)
