"""`namod-ctl camera`: one camera at the bench: take a frame, watch it, focus it, check it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from namod_ctl.app.build.camera_choice import DEFAULT_SIZE, ChosenCamera, open_chosen
from namod_ctl.app.views.camera_views import (
    Look,
    Watch,
    check_file,
    dropped_text,
    focus_line,
    statistics_text,
    write_frame,
)
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import CommunicationError, ConfigError
from namod_ctl.core.units import rad_to_arcmin
from namod_ctl.cycle.exposure_check import check_exposure
from namod_ctl.cycle.exposure_growth import ExposureFinding
from namod_ctl.cycle.focus import FocusCourse, read_focus
from namod_ctl.imaging.exposure import ExposureVerdict

if TYPE_CHECKING:
    from namod_ctl.app.focus_page.beside import FocusPage

LINE_EVERY_S = 0.25
"""Lines come no faster than they can be read; the twin's frames would."""
MAX_ATTEMPTS = 8
"""Three jumps of the exposure law cross the range of 1 ms to 3 s; some frames may get lost."""
EXIT_REFUSED, EXIT_UNKNOWN = 1, 3
FOCUS_HOST, FOCUS_PORT = "127.0.0.1", 8766  # the live page may be there too

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Try one camera: a frame, numbers, focus, exposures.",
    epilog="Example: namod-ctl camera snap star --twin --out star.png",
)

_Camera = Annotated[
    str,
    typer.Argument(
        metavar="CAMERA",
        help="star or reflector, of the config; or DRIVER:SERIAL-NUMBER, DRIVER:ADDRESS or DRIVER:ADDRESS#DEVICE, such "
        "as pylon:21979447, opencv:0 or indi:localhost:7624#CCD Simulator.",
    ),
]
_Config = Annotated[
    str | None, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.  [default: fact]")
]
_IsTwin = Annotated[bool, typer.Option("--twin", help="The camera of a digital twin instead.")]
_Exposure = Annotated[
    float | None,
    typer.Option(
        "--exposure", metavar="SECONDS", min=1e-6, max=3600.0, help="[default: so that the brightest pixel is at 80 %]"
    ),
]
_Size = Annotated[str, typer.Option("--size", help="Of the frames of DRIVER:..., columns x rows.")]
_FullScale = Annotated[
    float, typer.Option("--full-scale", min=1.0, max=65_535.0, help="Brightest value of a pixel of DRIVER:...: 4095.")
]
_Frames = Annotated[
    int | None, typer.Option("--frames", min=1, help="Stop after so many frames.  [default: at Ctrl-C]")
]


@app.command()
def snap(
    camera: _Camera,
    exposure: _Exposure = None,
    out: Annotated[Path | None, typer.Option("--out", help="Write the frame to this file, .png or .fits.")] = None,
    config: _Config = None,
    twin: _IsTwin = False,
    size: _Size = DEFAULT_SIZE,
    full_scale: _FullScale = 255.0,
    force: Annotated[bool, typer.Option("--force", help="Replace an older file at --out.")] = False,
) -> None:
    """Take one frame, print how bright it is, and write it to a file.

    Example: namod-ctl camera snap star --twin --out star.png
    """
    if out is not None:
        check_file(out, force=force)
    with open_chosen(camera, config, size, full_scale, is_twin=twin) as chosen:
        look = _good_look(Watch(chosen, exposure), is_given=exposure is not None)
        if look.exposure is None or look.statistics is None:
            raise CommunicationError(f"{chosen.camera.name}: no frame came; {look.trouble}")
        image = look.exposure.image
        colour = "colour" if image.ndim == 3 else "grey"
        _say(f"{chosen.camera.name}: {image.shape[1]} x {image.shape[0]} pixel, {colour}, {8 * image.itemsize} bit")
        _say(statistics_text(look.exposure, look.statistics, chosen))
        if look.verdict is not ExposureVerdict.GOOD:
            _say(f"this frame is {look.verdict}")
        if camera != "reflector":
            _say(_star_text(look, chosen))
        if out is not None:
            write_frame(out, look.exposure, chosen.camera.name)
            _say(f"written to {out}")


@app.command()
def live(
    camera: _Camera,
    exposure: _Exposure = None,
    config: _Config = None,
    twin: _IsTwin = False,
    size: _Size = DEFAULT_SIZE,
    full_scale: _FullScale = 255.0,
    frames: _Frames = None,
) -> None:
    """Print how bright frame after frame is, and count those that get lost, until Ctrl-C.

    Example: namod-ctl camera live star --twin
    """
    with open_chosen(camera, config, size, full_scale, is_twin=twin) as chosen:
        watch = Watch(chosen, exposure)

        def line(look: Look) -> str:
            if look.exposure is None or look.statistics is None:
                return look.trouble
            lost = dropped_text(watch.dropped)
            return statistics_text(look.exposure, look.statistics, chosen) + (f"; so far {lost}" if lost else "")

        n_frames, rate = _watched(watch, frames, line)
        _say(f"{n_frames} frames, {rate:.3g} per second; {dropped_text(watch.dropped) or 'none was lost'}")


@app.command()
def focus(
    camera: _Camera,
    exposure: _Exposure = None,
    config: _Config = None,
    twin: _IsTwin = False,
    size: _Size = DEFAULT_SIZE,
    full_scale: _FullScale = 255.0,
    frames: _Frames = None,
    page: Annotated[bool, typer.Option("--page", help="Show it on a page too, for a phone at the lens.")] = False,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help=f"Of --page; 0 takes one that is free.  [default: {FOCUS_PORT}]"),
    ] = None,
    host: Annotated[
        str | None,
        typer.Option(
            help="Address to serve --page on; any but this computer's own shows it to the network.  "
            f"[default: {FOCUS_HOST}]"
        ),
    ] = None,
) -> None:
    """Print how wide the star is, frame after frame, until Ctrl-C: turn the lens until the bar is shortest.

    With --page a phone at the lens shows the same, with the course of the last two minutes and a picture of the star.

    Example: namod-ctl camera focus star --twin --page
    """
    with (
        _focus_page(camera, host, port, is_wanted=page) as shown,
        open_chosen(camera, config, size, full_scale, is_twin=twin) as chosen,
    ):
        course = FocusCourse()

        def line(look: Look) -> str:
            reading, text = None, f"  {look.trouble}"
            if look.exposure is not None:
                reading = read_focus(look.exposure.image, chosen.model, chosen.star_size_rad)
                remark = course.add(reading)
                text = focus_line(reading, course.best_px, remark, has_plate_scale=chosen.has_plate_scale)
            if shown is not None:
                now_s, is_given = time.monotonic(), exposure is not None
                shown.show(now_s, look, reading, course.best_px, chosen, is_exposure_given=is_given)
            return text

        _watched(Watch(chosen, exposure), frames, line)
        if not math.isfinite(course.best_px):
            raise ConfigError(
                f"{chosen.camera.name}: saw no star; point it at a bright one that stands alone, or try --exposure"
            )
        angle = rad_to_arcmin(course.best_px * chosen.model.plate_scale_rad)
        _say(f"sharpest: {course.best_px:.2f} px" + (f", {angle:.2f} arcmin" if chosen.has_plate_scale else ""))


@contextmanager
def _focus_page(camera: str, host: str | None, port: int | None, *, is_wanted: bool) -> Iterator[FocusPage | None]:
    """The page of the focus aid, announced; None when nobody wants it."""
    if not is_wanted:
        if host is not None or port is not None:
            raise ConfigError("--host and --port are those of the page: add --page, or leave them out")
        yield None
        return
    from namod_ctl.app.focus_page.beside import focus_page_beside  # a web server: only who wants the page waits for it

    with focus_page_beside(camera, host or FOCUS_HOST, FOCUS_PORT if port is None else port) as shown:
        if not shown.is_loopback:
            typer.echo(
                f"WARNING: --host {host} shows this page to everybody in the network, unencrypted; they can look, "
                "but command nothing. For a phone on the dish use a network of your own.",
                err=True,
            )
        _say(f"Look:     {shown.address}")
        yield shown


@app.command()
def check(
    camera: _Camera,
    config: _Config = None,
    twin: _IsTwin = False,
    size: _Size = DEFAULT_SIZE,
    full_scale: _FullScale = 255.0,
) -> None:
    """Find out whether the camera makes the exposures that it is asked for: brightness against exposure.

    It must see a star or a lamp. Exit code 1: it does not; 3: cannot be told here and now.

    Example: namod-ctl camera check star --twin
    """
    with open_chosen(camera, config, size, full_scale, is_twin=twin) as chosen:
        found = check_exposure(chosen.camera, chosen.model, chosen.clock)
    _say(found.text)
    for level in found.levels:
        _say(f"  {level.asked_s:.4g} s: {level.light_share:.1%} of full scale, {level.n_frames} frames")
    if found.verdict is not ExposureFinding.FOLLOWS:
        raise typer.Exit(EXIT_REFUSED if found.verdict is ExposureFinding.REFUSED else EXIT_UNKNOWN)


def _good_look(watch: Watch, *, is_given: bool) -> Look:
    """The first frame that came, and whose exposure is good unless it was given; else the last one."""
    last: Look | None = None
    for look in islice(watch.looks(), MAX_ATTEMPTS):
        last = look if last is None or look.exposure is not None else last
        if look.exposure is not None and (is_given or look.verdict is ExposureVerdict.GOOD):
            return look
    assert last is not None
    return last


def _star_text(look: Look, chosen: ChosenCamera) -> str:
    assert look.exposure is not None
    reading = read_focus(look.exposure.image, chosen.model, chosen.star_size_rad)
    if not math.isfinite(reading.diameter_px):
        return f"no star: {reading.trouble}"
    angle = f", {rad_to_arcmin(reading.diameter_rad):.2f} arcmin" if chosen.has_plate_scale else ""
    return f"a star, {reading.diameter_px:.2f} px{angle} wide (full width at half maximum)"


def _watched(watch: Watch, n_frames: int | None, line: Callable[[Look], str]) -> tuple[int, float]:
    """Print a line for every frame that can be read in time; how many frames came, and how many per second."""
    started_s, shown_s, n_good = time.monotonic(), -math.inf, 0
    wall = SystemMonotonicClock()
    with _until_ctrl_c():
        for look in islice(watch.looks(), n_frames):
            n_good += look.exposure is not None
            text = line(look)
            wall.wait_s(shown_s + LINE_EVERY_S - wall.monotonic_s())
            shown_s = wall.monotonic_s()
            _say(text)
    return n_good, n_good / max(time.monotonic() - started_s, 1e-3)


@contextmanager
def _until_ctrl_c() -> Iterator[None]:
    with suppress(KeyboardInterrupt):
        yield


def _say(text: str) -> None:
    Console(highlight=False, soft_wrap=True, markup=False).print(text)
