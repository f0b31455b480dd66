"""Where the stars of a frame stand in the sky, as a model of the camera that is fitted to them.

The camera's own axes are right-handed: the first along its columns (against them for a mirrored image), the second
against its rows, the third out to the sky from the centre of the lens's image. A pixel at the offset v from that centre
stands at the angle s v (1 + k1 a^2 + k2 a^4), a = s |v|, from the third axis, on the side of v: a lens is round, so
angles are counted from its axis outwards. That is `Distortion` of the camera model. Without any distortion (gnomonic)
k1 is -1/3 and k2 is 1/5: an angle is the arctangent of the distance in the image.

What a few stars cannot tell is not left out: how strong and where lenses bend is put in beforehand (`LensPriors`), and
what that leaves open is in the covariance of the rest. The plate scale at the centre and k1 belong together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from namod_ctl.optics.camera_model import CameraModel, Distortion
from namod_ctl.optics.coordinates import angles_of_direction, direction_at_angles

Array = NDArray[np.float64]

K1_OF_TANGENT, K2_OF_TANGENT = -1.0 / 3.0, 1.0 / 5.0
"""Of a lens without distortion: arctan(x) = x - x^3/3 + x^5/5."""

DISTORTION_AT_CORNER = 0.015
"""Of the distance from the centre, standard deviation: photographic lenses have 1 to 3 % at the edge of their own full
format, of which star cameras use a part."""

SECOND_DISTORTION_AT_CORNER = 0.001
"""The same of the term in a^4."""

CENTRE_SHARE_OF_WIDTH = 0.01
"""Standard deviation of the lens's centre from the image's: a quarter of a millimetre for sensors of an inch."""

SUSPICIOUS_CHI2 = 2.0
"""Per degree of freedom: above, some star may not be where its errors say."""

DROPPED_BY_CHANCE = 0.01
"""How often a star is left out of a fit in which nothing is wrong."""

LEAST_ERROR_PX = 0.01
"""No centre of a star is trusted further: pixels are not all alike."""

_MAX_STEPS = 20
_TOLERANCE = 1e-8
"""Of the last step: its square in standard deviations."""
_SMALL_TURN_RAD = 1e-6
_LARGEST_STEP = 0.05
"""Of the turns, rad, and of ln s: wrong suggestions may lead anywhere, but not at once."""

_N_ATTITUDE = 3
SCALE, K1, K2, CENTRE_X, CENTRE_Y = range(_N_ATTITUDE, 8)
"""Places of the parameters in the covariance, after three small turns about the camera's axes, rad: ln s, k1, k2, and
the centre in pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class Plate:
    """A camera that looks at the sky.

    Attributes
    ----------
    plate_scale_rad
        Angle of one pixel at the centre.
    centre_pixel
        Shape (2,), (x, y): where the lens's axis meets the image.
    attitude
        Shape (3, 3): its columns are the camera's axes in the frame of the sky.
    """

    plate_scale_rad: float
    is_mirrored: bool
    centre_pixel: Array
    k1_per_rad2: float
    k2_per_rad4: float
    attitude: Array

    @property
    def distortion(self) -> Distortion:
        """As the camera model wants it."""
        return Distortion(self.centre_pixel, self.k1_per_rad2, self.k2_per_rad4)

    def angles_of(self, pixel: Array) -> Array:
        """Angles from the lens's axis along the camera's first two axes, rad, (..., 2), of positions (..., 2)."""
        straight = self.distortion.straightened(pixel, self.plate_scale_rad) - self.centre_pixel
        angles: Array = self.plate_scale_rad * straight * self.signs
        return angles

    def directions_of(self, pixel: Array) -> Array:
        """Unit vectors (..., 3) in the frame of the sky, of positions (..., 2)."""
        directions: Array = direction_at_angles(self.angles_of(pixel)) @ self.attitude.T
        return directions

    def pixels_of(self, directions: Array) -> Array:
        """Positions (..., 2) of unit vectors (..., 3) of the sky; without meaning far outside of the image."""
        straight = angles_of_direction(directions @ self.attitude) / self.plate_scale_rad * self.signs
        return self.distortion.distorted(straight + self.centre_pixel, self.plate_scale_rad)

    @property
    def signs(self) -> Array:
        """Of columns and rows along the camera's first two axes, shape (2,)."""
        return np.array([-1.0 if self.is_mirrored else 1.0, -1.0])


@dataclass(frozen=True, slots=True, eq=False)
class LensPriors:
    """What is known of a camera before it has seen a star: mean and standard deviation of what bends its image."""

    centre_pixel: Array
    centre_error_px: float
    k1_error_per_rad2: float
    k2_error_per_rad4: float


def lens_priors(camera: CameraModel) -> LensPriors:
    """Those of an ordinary lens on this camera."""
    corner_rad = 0.5 * camera.plate_scale_rad * math.hypot(camera.n_columns, camera.n_rows)
    return LensPriors(
        centre_pixel=np.array([(camera.n_columns - 1) / 2.0, (camera.n_rows - 1) / 2.0]),
        centre_error_px=CENTRE_SHARE_OF_WIDTH * camera.n_columns,
        k1_error_per_rad2=DISTORTION_AT_CORNER / corner_rad**2,
        k2_error_per_rad4=SECOND_DISTORTION_AT_CORNER / corner_rad**4,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PlateFit:
    """A plate, how well it is known, and what stars said.

    Attributes
    ----------
    covariance
        Shape (8, 8), in the order three turns, `SCALE` (ln s), `K1`, `K2`, `CENTRE_X`, `CENTRE_Y`.
    residual_px
        Shape (n_stars, 2): image less model, of all stars.
    is_used
        Shape (n_stars,): False for stars that stand out and count no more.
    chi2_per_degree
        Of the stars that are used; the covariance has been multiplied with it where it is more than 1.
    """

    plate: Plate
    covariance: Array
    residual_px: Array
    is_used: NDArray[np.bool_]
    chi2_per_degree: float

    @property
    def rms_px(self) -> float:
        """Root mean square of the distances of the used stars from the model."""
        return float(np.sqrt(np.mean(np.sum(self.residual_px[self.is_used] ** 2, axis=1))))

    @property
    def plate_scale_uncertainty_rad(self) -> float:
        """One standard deviation."""
        return float(self.plate.plate_scale_rad * math.sqrt(self.covariance[SCALE, SCALE]))


def fit_plate(
    pixel: Array, error_px: Array, directions: Array, start: Plate, priors: LensPriors, *, max_dropped: int
) -> PlateFit:
    """The plate that brings stars at `pixel` (n, 2), known to `error_px` (n,), to `directions` (n, 3).

    Least squares. When the stars scatter by more than their errors, at most `max_dropped` of them are left out: each
    time the one without which the others agree best, as long as they then agree so much better as chance would not make
    it. `start` must be right within a tenth of a radian, and in `is_mirrored`.
    """
    sigma_px = np.hypot(error_px, LEAST_ERROR_PX)
    is_used = np.ones(len(pixel), dtype=np.bool_)

    def fitted(some: NDArray[np.bool_], begin: Plate) -> tuple[Plate, Array, float]:
        return _fit(pixel[some], sigma_px[some], directions[some], begin, priors)

    plate, covariance, chi2 = fitted(is_used, start)
    for _ in range(max_dropped):
        if chi2 <= SUSPICIOUS_CHI2 * _degrees(is_used):
            break
        without = [is_used & (np.arange(len(pixel)) != number) for number in np.flatnonzero(is_used)]
        tries = [fitted(some, plate) for some in without]
        best = int(np.argmin([one[2] for one in tries]))
        degrees = _degrees(without[best])
        gain = (chi2 - tries[best][2]) / 2.0 / (tries[best][2] / degrees)
        if float(f_distribution.sf(gain, 2, degrees)) * len(tries) > DROPPED_BY_CHANCE:
            break
        is_used, (plate, covariance, chi2) = without[best], tries[best]
    per_degree = chi2 / _degrees(is_used)
    residual = _residual_px(plate, pixel, directions)
    return PlateFit(plate, covariance * max(1.0, per_degree), residual, is_used, per_degree)


def _degrees(is_used: NDArray[np.bool_]) -> int:
    """Of freedom: what is known of the lens beforehand counts as four measurements of its four parameters."""
    return max(1, 2 * int(is_used.sum()) - _N_ATTITUDE - 1)


def _fit(
    pixel: Array, sigma_px: Array, directions: Array, start: Plate, priors: LensPriors
) -> tuple[Plate, Array, float]:
    """Gauss and Newton's way: all is nearly linear. A library's routine takes twenty times as long for it."""
    expected = np.array([K1_OF_TANGENT, K2_OF_TANGENT, *priors.centre_pixel])
    error = np.array(
        [priors.k1_error_per_rad2, priors.k2_error_per_rad4, priors.centre_error_px, priors.centre_error_px]
    )
    belief = np.zeros((error.size, CENTRE_Y + 1))
    belief[:, K1:] = np.diag(1.0 / error)
    weight = 1.0 / np.repeat(sigma_px, 2)
    plate = start
    for _ in range(_MAX_STEPS):
        residual, slope = _linearized(plate, pixel, directions)
        lens = np.array([plate.k1_per_rad2, plate.k2_per_rad4, *plate.centre_pixel])
        rows = np.concatenate([slope * weight[:, None], belief])
        values = np.concatenate([residual * weight, (lens - expected) / error])
        information = rows.T @ rows
        step = -np.linalg.solve(information, rows.T @ values)
        step *= min(1.0, _LARGEST_STEP / float(np.abs(step[:K1]).max(initial=_LARGEST_STEP)))
        plate = _stepped(plate, step)
        if step @ information @ step < _TOLERANCE:
            break
    return plate, np.linalg.inv(information), float(np.sum((values + rows @ step) ** 2))


def _linearized(plate: Plate, pixel: Array, directions: Array) -> tuple[Array, Array]:
    """Residuals, pixel, as one array (2 n,), and their derivatives by the parameters, (2 n, 8)."""
    scale, signs = plate.plate_scale_rad, plate.signs
    offset = pixel - plate.centre_pixel
    a2 = scale**2 * np.sum(offset**2, axis=1, keepdims=True)
    k1, k2 = plate.k1_per_rad2, plate.k2_per_rad4
    stretch = 1.0 + k1 * a2 + k2 * a2**2
    sky = angles_of_direction(directions @ plate.attitude) / scale
    slope = np.empty((*pixel.shape, CENTRE_Y + 1))
    for axis, turn in enumerate(_SMALL_TURN_RAD * np.eye(_N_ATTITUDE)):
        turned_sky = angles_of_direction(directions @ plate.attitude @ turned(turn)) / scale
        slope[:, :, axis] = (sky - turned_sky) / _SMALL_TURN_RAD
    slope[:, :, SCALE] = signs * offset * (2.0 * k1 * a2 + 4.0 * k2 * a2**2) + sky
    slope[:, :, K1], slope[:, :, K2] = signs * offset * a2, signs * offset * a2**2
    along = scale**2 * (2.0 * k1 + 4.0 * k2 * a2) * offset
    for axis in range(2):
        slope[:, :, CENTRE_X + axis] = -signs * offset * along[:, axis : axis + 1]
        slope[:, axis, CENTRE_X + axis] -= signs[axis] * stretch[:, 0]
    return (signs * offset * stretch - sky).ravel(), slope.reshape(2 * len(pixel), CENTRE_Y + 1)


def _stepped(plate: Plate, step: Array) -> Plate:
    return Plate(
        plate_scale_rad=plate.plate_scale_rad * math.exp(step[SCALE]),
        is_mirrored=plate.is_mirrored,
        centre_pixel=plate.centre_pixel + step[CENTRE_X:],
        k1_per_rad2=plate.k1_per_rad2 + float(step[K1]),
        k2_per_rad4=plate.k2_per_rad4 + float(step[K2]),
        attitude=plate.attitude @ turned(step[:_N_ATTITUDE]),
    )


def turned(turn_rad: Array) -> Array:
    """Matrix (3, 3) of the turn about the vector `turn_rad` by its length (Rodrigues)."""
    x, y, z = turn_rad
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.linalg.norm(turn_rad))
    first, second = np.sinc(angle / math.pi), 0.5 * np.sinc(angle / (2.0 * math.pi)) ** 2
    matrix: Array = np.eye(3) + first * cross + second * cross @ cross
    return matrix


def _residual_px(plate: Plate, pixel: Array, directions: Array) -> Array:
    """Image less model, (n, 2), in units of a pixel at the centre."""
    difference = plate.angles_of(pixel) - angles_of_direction(directions @ plate.attitude)
    residual: Array = difference / plate.plate_scale_rad
    return residual


def rotation_at(plate: Plate, axis_pixel: Array) -> float:
    """`CameraOrientation.rotation_rad` of a camera whose telescope's axis is at that pixel: there +y is up in the sky.

    The frame of the sky must be the horizon's. Far from the zenith only: where altitude means little, so does this.
    """
    at = plate.angles_of(axis_pixel)
    step = 1e-6
    offsets = np.array([[step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]])
    ahead, behind, over, under = direction_at_angles(at + offsets) @ plate.attitude.T
    out = direction_at_angles(at) @ plate.attitude.T
    left = np.cross([0.0, 0.0, 1.0], out)
    left /= np.linalg.norm(left)
    up = np.cross(out, left)
    turn = np.array([[left @ (ahead - behind), left @ (over - under)], [up @ (ahead - behind), up @ (over - under)]])
    # The nearest pure turn; far from the centre of the lens angles along circles about it are a little shorter.
    return math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])


def rotation_uncertainty_rad(fit: PlateFit, axis_pixel: Array, axis_error_px: float) -> float:
    """One standard deviation of `rotation_at`, with the axis known to `axis_error_px` in each direction."""
    plate = fit.plate
    slope = np.zeros(len(fit.covariance))
    for number, error in enumerate(np.sqrt(np.diag(fit.covariance))):
        step = np.zeros(slope.size)
        step[number] = error
        change = rotation_at(_stepped(plate, step), axis_pixel) - rotation_at(_stepped(plate, -step), axis_pixel)
        slope[number] = math.remainder(change, 2.0 * math.pi) / (2.0 * error)
    variance = float(slope @ fit.covariance @ slope)
    for shift in np.eye(2):
        change = rotation_at(plate, axis_pixel + shift) - rotation_at(plate, axis_pixel - shift)
        variance += (0.5 * math.remainder(change, 2.0 * math.pi) * axis_error_px) ** 2
    return math.sqrt(variance)
