"""What a config may say about the camera that sees the star's image in the focal plane: `[psf_camera]`."""

from __future__ import annotations

from typing import Annotated

from namod_ctl.app.config.camera_schema import DeviceCameraSection, RadiometricLawSection
from namod_ctl.app.config.section import within


class PsfCameraSection(DeviceCameraSection):
    """The camera that looks at a screen in the focal plane, or stands there itself.

    `plate_scale_mdeg_per_px`: one pixel on the screen, over the telescope's focal length. Without `radiometric_law` the
    camera is linear. `exposure_s` is what `align` begins with; it goes on as the star's brightness wants it.
    """

    plate_scale_mdeg_per_px: Annotated[float, within(0.005, 100.0)]
    radiometric_law: RadiometricLawSection | None = None
    exposure_s: Annotated[float, within(1e-5, 600.0)] = 0.1
    n_frames: Annotated[int, within(1, 1000)] = 10
