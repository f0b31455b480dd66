"""`namod-ctl calibrate chessboard`: plate scale and distortion of a camera from pictures of a chessboard."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from namod_ctl.app.build.frame_series import FrameSeries, Image
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.calibration_files import (
    DEFAULT_VALID_DAYS,
    check_calibration_output,
    how_to_use,
    new_header,
    write_calibration,
)
from namod_ctl.app.config.calibration_schema import CameraRole, DistortionSection, GeometryCalibration
from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.pictures.chessboard_picture import draw_chessboard
from namod_ctl.app.pictures.figure_style import figure_to_png, picture_beside
from namod_ctl.app.views.calibration_rows import values_in_words
from namod_ctl.calibration.geometry.chessboard import BoardView, ChessboardFit, calibrate_with_boards, find_board
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.units import mm_to_m, rad_to_deg, rad_to_mdeg
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.store.frames import write_file_durably
from namod_ctl.twin.chessboard import Board, draw_poses, lens_of, render_board, wrong_by
from namod_ctl.twin.randomness import generator

GOOD_SHARE = 2e-3
"""Of the plate scale: up to that its uncertainty is good."""
GOOD_COVER = 0.5
GOOD_CONVERSION_PX = 0.5
TWIN_VIEWS = 12
DEFAULT_SEED = 1
_CORNERS = re.compile(r"([0-9]{1,2})x([0-9]{1,2})")
_ROLES: dict[str, CameraRole] = {"star": "star_camera", "reflector": "reflector_camera"}


def chessboard(
    frames: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FRAMES]...", help="PNG, TIFF or FITS files of one camera, or folders of them."),
    ] = None,
    camera: Annotated[str, typer.Option(help="Whose frames they are: star or reflector.")] = "star",
    square_mm: Annotated[float, typer.Option(min=0.5, max=1000.0, help="Side of a square of the board.")] = 30.0,
    corners: Annotated[
        str, typer.Option(metavar="CxR", help="Inner corners, columns x rows: 9x6 of a board of 10 x 7 squares.")
    ] = "9x6",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write the calibration, and a .png.")
    ] = None,
    config: Annotated[str, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.")] = "fact",
    twin: Annotated[bool, typer.Option("--twin", help="Rehearse it on pictures of a digital twin.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the twin.")] = DEFAULT_SEED,
    valid_days: Annotated[float, typer.Option(help="How long the calibration holds.")] = DEFAULT_VALID_DAYS,
    force: Annotated[bool, typer.Option("--force", help="Replace an older file.")] = False,
) -> None:
    """Find a camera's plate scale and its lens' distortion from pictures of a chessboard.

    Take about 15 sharp pictures of a flat board, tilted by 30 to 45 degrees to all sides, some in every corner of the
    image. Do not turn the focus for them: that changes the plate scale.

    Example: namod-ctl calibrate chessboard BOARDS --camera reflector --square-mm 30 --corners 9x6 --out geometry.json
    """
    if camera not in _ROLES:
        raise ConfigError(f"--camera {camera}: choose star or reflector")
    role = _ROLES[camera]
    board = Board(_inner_corners(corners), mm_to_m(square_mm))
    if twin == bool(frames):
        raise ConfigError("give FRAMES of the board, or --twin for a rehearsal (one of both)")
    if out is not None:
        check_calibration_output(out, force=force)
        check_calibration_output(picture_beside(out), force=force)
    loaded = load_config(config)
    instrument = build_instrument(loaded)
    model = instrument.star_camera if camera == "star" else instrument.reflector_camera
    console = Console(soft_wrap=True, highlight=False, markup=False)
    truth: CameraModel | None = None
    if twin:
        truth = wrong_by(model, seed)
        console.print("Rehearsal: these are pictures of a digital twin, not of your camera.", style="bold")
        views = _twin_views(truth, board, seed, console)
        source = f"digital twin, seed {seed}"
    else:
        views = _views(frames or [], role, model, board.corners, console)
        source = ", ".join(str(path) for path in frames or [])
    with console.status("fitting the lens"):
        fit = calibrate_with_boards(views, board.corners, board.square_m, model)
    remarks, is_good = _remarks(fit, camera)
    section = loaded.star_camera if camera == "star" else loaded.reflector_camera
    bend = fit.camera.distortion
    assert bend is not None
    calibration = GeometryCalibration(
        **new_header(
            section,
            role,
            SystemClock(),
            source=f"{len(fit.views)} views of a chessboard of {corners} inner corners; {source}",
            verdict="good" if is_good else "limited",
            remarks=tuple(remarks),
            valid_days=valid_days,
            twin_seed=seed if twin else None,
        ),
        kind="geometry",
        plate_scale_mdeg_per_px=rad_to_mdeg(fit.camera.plate_scale_rad),
        plate_scale_uncertainty_mdeg_per_px=rad_to_mdeg(fit.plate_scale_uncertainty_rad),
        distortion=DistortionSection(
            centre_px=(float(bend.centre_pixel[0]), float(bend.centre_pixel[1])),
            k1_per_rad2=bend.k1_per_rad2,
            k2_per_rad4=bend.k2_per_rad4,
        ),
        residual_rms_px=fit.residual_rms_px,
        method="chessboard",
        n_points=sum(len(view.corners_px) for view in fit.views),
    )
    for name, words in values_in_words(calibration):
        console.print(f"  {name:16s} {words}")
    tilts = rad_to_deg(fit.tilt_rad)
    console.print(
        f"  {'boards':16s} {len(fit.views)} count, {fit.distance_m.min():.2g} to {fit.distance_m.max():.2g} m away, "
        f"tilted by {tilts.min():.0f} to {tilts.max():.0f} deg"
    )
    console.print(f"  {'k1 is known to':16s} {fit.k1_uncertainty_per_rad2:.2g} per rad2")
    console.print(f"  {'verdict':16s} {calibration.verdict}")
    for remark in remarks:
        console.print(f"  {'':16s} {remark}")
    if truth is not None:
        assert truth.distortion is not None
        console.print(
            f"The twin's truth: {rad_to_mdeg(truth.plate_scale_rad):.5f} mdeg per px, k1 = "
            f"{truth.distortion.k1_per_rad2:.4f} per rad2."
        )
    if out is None:
        console.print("Nothing was written. To keep it, say where with --out FILE.")
        return
    picture, png = picture_beside(out), figure_to_png(draw_chessboard(fit, model))
    write_calibration(out, calibration, force=force)
    write_file_durably(picture, png)
    console.print(f"Written: {out}; look at {picture}: the corners must fill the image.")
    console.print(how_to_use(out, calibration))


def _views(
    frames: list[Path], role: CameraRole, model: CameraModel, corners: tuple[int, int], console: Console
) -> list[BoardView]:
    series = FrameSeries(frames, role, needs_exposure=False)
    views, n_frames = [], 0
    for frame in series.frames():
        n_frames += 1
        _check_size(frame.name, frame.image, model)
        view = find_board(frame.image, corners)
        if view is None:
            series.problems.append(f"{frame.name}: shows no board with {corners[0]}x{corners[1]} inner corners")
        else:
            views.append(view)
    for problem in series.problems:
        console.print(f"left out: {problem}")
    if not n_frames:
        raise DataQualityError("no frame can be read: give PNG, TIFF or FITS files of unsigned integers")
    if not views:
        raise DataQualityError(
            f"no board with {corners[0]}x{corners[1]} inner corners in {n_frames} frames: count the corners between "
            "the squares (not the squares) for --corners, keep the whole board in the image, light it evenly"
        )
    return views


def _check_size(name: str, image: Image, model: CameraModel) -> None:
    n_rows, n_columns = image.shape[:2]
    if (n_columns, n_rows) != (model.n_columns, model.n_rows):
        raise ConfigError(
            f"{name}: the frame has {n_columns} x {n_rows} pixel, the camera of the config {model.n_columns} x "
            f"{model.n_rows}: choose the right --camera, and frames of its full size"
        )


def _twin_views(truth: CameraModel, board: Board, seed: int, console: Console) -> list[BoardView]:
    def found() -> Iterator[BoardView]:
        rays = lens_of(truth)
        for number, pose in enumerate(draw_poses(board, truth, TWIN_VIEWS, seed)):
            rng = generator(seed, "pictures of a chessboard", number)
            size = (truth.n_columns, truth.n_rows)
            view = find_board(render_board(board, pose, rays, size, rng), board.corners)
            if view is not None:
                yield view

    with console.status("the twin shows a board"):
        return list(found())


def _remarks(fit: ChessboardFit, camera: str) -> tuple[list[str], bool]:
    """What a person should know, and whether the calibration is good for everything."""
    relative = fit.plate_scale_uncertainty_rad / fit.camera.plate_scale_rad
    limits = []
    if relative > GOOD_SHARE:
        limits.append(
            f"the plate scale is known to {relative:.2%} only: a star's trail or a star field tells it better"
        )
    if fit.covered_share < GOOD_COVER:
        limits.append(f"corners in {fit.covered_share:.0%} of the image only: outside of them distortion is a guess")
    if fit.conversion_rms_px > GOOD_CONVERSION_PX:
        limits.append(
            f"two coefficients leave {fit.conversion_rms_px:.1f} px (rms over the image) of this wide lens' distortion"
        )
    if not fit.is_centre_fitted:
        limits.append("the centre of distortion cannot be told and is taken to be the image's centre")
    notes = ["rotation and mirroring are not told by a board: the config's stay"]
    if camera == "star":
        notes.append(
            f"had the focus been turned for a board {float(np.median(fit.distance_m)):.2g} m away, the plate scale "
            "would be too small for stars by focal length over distance"
        )
    return [*limits, *notes], not limits


def _inner_corners(text: str) -> tuple[int, int]:
    match = _CORNERS.fullmatch(text.strip().lower())
    columns, rows = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 3 <= min(columns, rows) <= max(columns, rows) <= 40:
        raise ConfigError(f"--corners {text}: write inner corners as columns x rows, 3 to 40 of each, such as 9x6")
    return columns, rows
