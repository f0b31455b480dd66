"""A small folder of the original program, written from DESIGN's description of the format; its truth is known.

Frames are 320 x 240. The star is a gaussian on a dark sky, every facet's polygon is filled with one level, so all
measured numbers follow from the radiometric law by hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

N_COLUMNS, N_ROWS = 320, 240
STAR_DEG_PER_PX = 0.005
STAR_SIGMA_PX = 0.025 / STAR_DEG_PER_PX / 2.3548  # FACT's config expects stars of 0.025 deg full width
STAR_PEAK_ADU = 180.0
STAR_LAW = (1.20, -1.23, 0.99)
REFLECTOR_LAW = (1.03, -1.15, -0.19)
FACET_IDS_AS_WRITTEN = (10, 3, 5, 2)
STAMP = "20140520_2301"


@dataclass(frozen=True)
class TrueRecord:
    prefix: str
    theta_deg: tuple[float, float]
    star_exposure_ms: float
    reflector_exposure_ms: float
    facet_level_adu: dict[int, int]

    def star_intensity(self) -> float:
        """The gaussian through I = C^1.2 T^-1.23 10^0.99, summed: C^1.2 is a gaussian too, narrower by sqrt(1.2)."""
        r, e, c = STAR_LAW
        area_px2 = 2.0 * np.pi * STAR_SIGMA_PX**2 / r
        return float((STAR_PEAK_ADU / 255.0) ** r * area_px2 * (self.star_exposure_ms / 1e3) ** e * 10.0**c)

    def facet_intensity(self, facet_id: int) -> float:
        r, e, c = REFLECTOR_LAW
        return float((self.facet_level_adu[facet_id] / 255.0) ** r * (self.reflector_exposure_ms / 1e3) ** e * 10.0**c)


def polygon(facet_id: int) -> list[tuple[int, int]]:
    """A kite in its own corner of the image."""
    x, y = {10: (60, 60), 3: (240, 60), 5: (60, 180), 2: (240, 180)}[facet_id]
    return [(x - 30, y), (x, y - 20), (x + 30, y), (x, y + 40)]


def write_folder(folder: Path, n_records: int, seed: int = 1, first: int = 0, stamp: str = STAMP) -> list[TrueRecord]:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "reflector.cfg").write_text(reflector_cfg())
    rng = np.random.default_rng(seed)
    return [write_record(folder, f"{stamp}_sccan_{first + i}", rng) for i in range(n_records)]


def write_record(folder: Path, prefix: str, rng: np.random.Generator) -> TrueRecord:
    x, y = rng.uniform(60, N_COLUMNS - 60), rng.uniform(60, N_ROWS - 60)
    star_ms, reflector_ms = float(rng.uniform(5, 50)), float(rng.uniform(100, 900))
    levels = {facet_id: int(rng.integers(20, 200)) for facet_id in FACET_IDS_AS_WRITTEN}
    rows, columns = np.mgrid[:N_ROWS, :N_COLUMNS]
    spot = STAR_PEAK_ADU * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * STAR_SIGMA_PX**2))
    star = np.clip(np.round(spot + rng.normal(0, 0.5, spot.shape)), 0, 255).astype(np.uint8)
    reflector = np.full((N_ROWS, N_COLUMNS), 3, dtype=np.uint8)
    for facet_id, level in levels.items():
        cv2.fillPoly(reflector, [np.array(polygon(facet_id))], level)
    cv2.imwrite(str(folder / f"{prefix}_star.png"), cv2.merge([star] * 3))
    cv2.imwrite(str(folder / f"{prefix}_reflector.png"), reflector)
    (folder / f"{prefix}.cfg").write_text(
        'sccan : \n{\n  sccan_point_name = "test"; run_startup_time = "20140520"; sccan_run_number = 1;\n'
        f'  star_image_filename = "{prefix}_star.png"; reflector_image_filename = "{prefix}_reflector.png";\n'
        "  single_star_has_been_found = true; star_X_px = 3; star_Y_px = 4; absolute_light_flux = 0.5;\n};\n"
    )
    for camera, ms, scale, law in (
        ("star", star_ms, STAR_DEG_PER_PX, STAR_LAW),
        ("reflector", reflector_ms, 0.2, REFLECTOR_LAW),
    ):
        (folder / f"{prefix}_{camera}.info").write_text(
            f'sccan_image : \n{{\n  image_name = "x"; exposure_time_in_ms = {ms!r};\n'
            "  ueye_camera_ID = 2; time_since_startup_in_seconds = 12.5;\n};\n"
        )
        (folder / f"{prefix}_{camera}.int").write_text(int_file(scale, law))
    theta_deg = ((x - N_COLUMNS / 2) * STAR_DEG_PER_PX, (N_ROWS / 2 - y) * STAR_DEG_PER_PX)
    return TrueRecord(prefix, theta_deg, star_ms, reflector_ms, levels)


def int_file(deg_per_px: float, law: tuple[float, float, float]) -> str:
    return (
        'intrinsic_parameter = { sccan_point = "test"; camera = "c"; optics = "o";\n'
        f"  camera_sensor_width = {N_COLUMNS}; camera_sensor_height = {N_ROWS}; pixel2angle = {deg_per_px};\n"
        f"  polynom_coeff_2 = {law[1]}; polynom_coeff_1 = {law[0]}; polynom_coeff_0 = {law[2]}; }};\n"
    )


def reflector_cfg(ids: tuple[int, ...] = FACET_IDS_AS_WRITTEN, **polygons: str) -> str:
    """The map; `p3="{ x = 1; y = 2; }"` replaces the corners of facet 3."""
    mirrors = []
    for facet_id in ids:
        known_id = facet_id if facet_id in FACET_IDS_AS_WRITTEN else 2
        corners = ", ".join(f"{{ x = {x}; y = {y}; }}" for x, y in polygon(known_id))
        corners = polygons.get(f"p{facet_id}", corners)
        mirrors.append(
            f"  {{ ID = {facet_id}; tripod_orientation_z_in_deg = {30.0 if facet_id == 3 else 0.0};\n"
            f"    polygon = ( {corners} ); }}"
        )
    return (
        '# the map of the facets\nreflector : \n{\n  reflector_name = "FACT"; calibration_image = "calib.png";\n'
        "  tripod_radius_in_m = 0.25; pitch_of_bolt_in_m_per_revolution = 0.00125;\n"
        "  mirrors = (\n" + ",\n".join(mirrors) + "\n  );\n};\n"
    )
