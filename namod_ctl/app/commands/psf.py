"""`namod-ctl psf`: the reflector's point spread function from images of a star in the focal plane."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console

from namod_ctl.app.build.frame_series import FrameSeries
from namod_ctl.app.build.psf_camera import TWIN_PSF_CAMERA, psf_section_of, sky_psf_equipment, twin_equipment_of
from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.config.parts import psf_camera_of
from namod_ctl.app.config.psf_camera_schema import PsfCameraSection
from namod_ctl.app.pictures.figure_style import figure_to_png
from namod_ctl.app.pictures.psf_image_plot import draw_psf
from namod_ctl.app.psf_files import JSON_FILE, PNG_FILE, PsfSource, psf_table, psf_to_json, rest_of_psf
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.units import mdeg_to_rad, rad2_to_arcmin2
from namod_ctl.cycle.psf_check import OpenPsfEquipment, expose_psf
from namod_ctl.imaging.psf_combine import Exposed, combine_images
from namod_ctl.imaging.psf_image import measure_psf
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.store.results import write_results
from namod_ctl.twin.settings import TwinSettings

DEFAULT_SEED = 1
SATURATION_SHARE = 0.98
SHALLOW_FULL_SCALES = (1023, 4095, 16383)
MAX_TOLD = 5


@dataclass(frozen=True, slots=True)
class _Measured:
    """Images, their names, and where they came from; the twin's truth in words."""

    exposed: Sequence[Exposed]
    names: Sequence[str]
    source: PsfSource
    truth: str = ""


def psf(
    frames: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FRAMES]...", help="Files (.fits, .png, .tif) or folders of them, all of one star."),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option("--config", help="Instrument with [psf_camera]: a TOML file, or the name of a built-in one."),
    ] = None,
    plate_scale_mdeg: Annotated[
        float | None,
        typer.Option(min=0.005, max=100.0, help="Of a pixel on the screen, such as 1.05; instead of the config's."),
    ] = None,
    full_scale: Annotated[
        float | None,
        typer.Option(
            "--full-scale", min=1.0, max=65_535.0, help="Brightest value of a pixel, without a config.  [of the files]"
        ),
    ] = None,
    live: Annotated[bool, typer.Option("--live", help="Take the frames with the PSF camera of the config.")] = False,
    twin: Annotated[bool, typer.Option("--twin", help="Rehearse it on the digital twin of the config.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the twin.")] = DEFAULT_SEED,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Write psf.json and psf.png into this folder.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace older results there.")] = False,
) -> None:
    """Measure the point spread function: A_sigma, radii of containment, ellipse, with uncertainties.

    From images of a star on a screen, or a sensor, in the focal plane. Several frames are taken together; the star may
    drift between them. The spot must stand alone, whole, and not saturated; the sky around it may be uneven.

    Example: namod-ctl psf NIGHT/screen --plate-scale-mdeg 1.05 --out NIGHT/psf
    """
    console = Console(highlight=False, soft_wrap=True)
    if sum([bool(frames), live, twin]) != 1:
        raise ConfigError("say where the images come from: FRAMES, or --live, or --twin; one of them")
    if out is not None:
        _check_out(out, force=force)
    if live or twin:
        if plate_scale_mdeg is not None or full_scale is not None:
            raise ConfigError("--plate-scale-mdeg and --full-scale are for stored frames; write them into [psf_camera]")
        measured = _of_twin(config, seed, console) if twin else _live(config, console)
    else:
        measured = _stored(frames or [], config, plate_scale_mdeg, full_scale, console)
    result = combine_images(measured.exposed, measured.source.plate_scale_rad)
    console.print(psf_table(result, measured.source))
    for line in rest_of_psf(result):
        console.print(line, markup=False)
    if measured.truth:
        console.print(measured.truth, markup=False)
    if out is not None:
        title = f"{measured.source.words}: point spread function"
        figure = draw_psf(result, measured.exposed, measured.source.plate_scale_rad, title)
        text = psf_to_json(result, measured.exposed, measured.names, measured.source)
        out.mkdir(parents=True, exist_ok=True)
        write_results(out, {JSON_FILE: text.encode(), PNG_FILE: figure_to_png(figure)})
        console.print(f"written: {out / JSON_FILE} and {out / PNG_FILE}; look at the picture before you trust it")
    else:
        console.print("nothing was written; --out FOLDER keeps the numbers and a picture")


def _stored(
    frames: Sequence[Path],
    config: str | None,
    plate_scale_mdeg: float | None,
    full_scale: float | None,
    console: Console,
) -> _Measured:
    """Of files. Raises ConfigError, and DataQualityError when none of them can be used."""
    if config is None and plate_scale_mdeg is None:
        raise ConfigError("give the plate scale: --plate-scale-mdeg 1.05, or a --config with [psf_camera]")
    loaded = None if config is None else load_config(config)
    section = None
    if loaded is not None and (loaded.psf_camera is not None or plate_scale_mdeg is None):
        section = psf_section_of(loaded, str(config))
    series = FrameSeries(frames, "psf_camera", needs_exposure=False)
    model: CameraModel | None = None
    exposed: list[Exposed] = []
    names: list[str] = []
    problems: list[str] = []
    for frame in series.frames():
        if model is None:
            model = _model_of(frame.image.shape, frame.image.dtype, section, plate_scale_mdeg, full_scale)
        if frame.image.shape[:2] != (model.n_rows, model.n_columns):
            raise ConfigError(
                f"{frame.name}: is {frame.image.shape[1]} x {frame.image.shape[0]} pixels, "
                f"{'the config says' if section is not None else 'the first frame is'} {model.n_columns} x "
                f"{model.n_rows}; give the frames of one camera"
            )
        try:
            if section is None and full_scale is None:
                _refuse_shallow(frame.image)
            exposed.append(Exposed(measure_psf(frame.image, model, frame.exposure_s), frame.exposure_s, frame.time_s))
            names.append(frame.name)
        except DataQualityError as error:
            problems.append(f"{frame.name}: {error}")
    problems = [*series.problems, *problems]
    if not exposed or model is None:
        raise DataQualityError("no frame can be used:\n" + "\n".join(problems[:MAX_TOLD]))
    for problem in problems[:MAX_TOLD]:
        console.print(f"left out: {problem}", markup=False)
    if len(problems) > MAX_TOLD:
        console.print(f"and {len(problems) - MAX_TOLD} more are left out")
    source = PsfSource(
        words=", ".join(str(path) for path in frames),
        camera=model.name,
        serial_number=None if section is None else section.serial_number,
        plate_scale_rad=model.plate_scale_rad,
        focal_length_m=None if loaded is None else loaded.telescope.focal_length_m,
    )
    return _Measured(exposed, names, source)


def _model_of(
    shape: tuple[int, ...],
    dtype: np.dtype[np.unsignedinteger],
    section: PsfCameraSection | None,
    plate_scale_mdeg: float | None,
    full_scale: float | None,
) -> CameraModel:
    """The camera of the config, or one that is as linear as its frames are large."""
    if section is not None:
        if full_scale is not None:
            raise ConfigError("--full-scale is for frames without a config; the config has full_scale_adu")
        if plate_scale_mdeg is not None:
            section = section.model_copy(update={"plate_scale_mdeg_per_px": plate_scale_mdeg})
        return psf_camera_of(section)
    if plate_scale_mdeg is None:
        raise ConfigError("give the plate scale: --plate-scale-mdeg 1.05")
    rows, columns = shape[:2]
    return CameraModel(
        name="not told",
        n_columns=columns,
        n_rows=rows,
        plate_scale_rad=mdeg_to_rad(plate_scale_mdeg),
        axis_pixel=np.array([columns / 2.0, rows / 2.0]),
        axis_is_calibrated=False,
        orientation=CameraOrientation(),
        law=RadiometricLaw(1.0, -1.0, 0.0),
        full_scale_adu=float(np.iinfo(dtype).max) if full_scale is None else full_scale,
        saturation_share=SATURATION_SHARE,
    )


def _refuse_shallow(image: NDArray[np.unsignedinteger[Any]]) -> None:
    """Raise DataQualityError for an image in 16 bit that ends exactly where a camera of fewer bits saturates."""
    brightest = int(image.max())
    if image.dtype == np.uint16 and brightest in SHALLOW_FULL_SCALES:
        raise DataQualityError(
            f"its brightest pixel is {brightest}, where cameras of {brightest.bit_length()} bit saturate; if this one "
            "has more, say so with --full-scale 65535"
        )


def _live(config: str | None, console: Console) -> _Measured:
    """With the PSF camera of the config. Raises ConfigError, DeviceFaultError, DataQualityError."""
    if config is None:
        raise ConfigError("--live needs --config with [psf_camera] and [psf_camera.device]")
    loaded = load_config(config)
    section = psf_section_of(loaded, config)
    equipment = sky_psf_equipment(loaded)
    if equipment is None:
        raise ConfigError(f'{config}: names no device for the PSF camera; add [psf_camera.device] driver = "..."')
    return _taken(equipment, section, f"{loaded.telescope.name}, live", loaded.telescope.focal_length_m, console)


def _of_twin(config: str | None, seed: int, console: Console) -> _Measured:
    """On the twin. Raises ConfigError, DataQualityError."""
    loaded = load_config(config or "fact")
    section = loaded.psf_camera or TWIN_PSF_CAMERA
    twin = build_twin(loaded, TwinSettings(), seed)
    words = f"digital twin of {loaded.telescope.name}, seed {seed}"
    console.print(f"A rehearsal on the {words}; nothing real is measured.", markup=False)
    measured = _taken(twin_equipment_of(section, twin, seed), section, words, loaded.telescope.focal_length_m, console)
    area = rad2_to_arcmin2(twin.reflector.a_sigma_now_rad2())
    truth = f"the twin's truth: A_sigma is {area:.3f} arcmin2 for a star on the axis"
    return _Measured(measured.exposed, measured.names, measured.source, truth)


def _taken(
    open_equipment: OpenPsfEquipment, section: PsfCameraSection, words: str, focal_length_m: float, console: Console
) -> _Measured:
    equipment = open_equipment()
    with closing(equipment.camera):
        exposed = expose_psf(equipment, lambda text: console.print(text, markup=False))
    source = PsfSource(words, section.model, section.serial_number, equipment.model.plate_scale_rad, focal_length_m)
    return _Measured(exposed, [f"image {number}" for number in range(1, len(exposed) + 1)], source)


def _check_out(out: Path, *, force: bool) -> None:
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; name a folder for psf.json and psf.png")
    older = [name for name in (JSON_FILE, PNG_FILE) if (out / name).exists()]
    if older and not force:
        raise ConfigError(f"{out}: holds {' and '.join(older)} already; choose another folder, or replace with --force")
