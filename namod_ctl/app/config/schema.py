"""What an instrument's config may say: sections, keys with their units, and what is physically plausible.

The ranges are wide for telescopes and narrow for units: a value in the wrong unit or with the wrong sign falls out.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from namod_ctl.app.config.actuator_schema import ActuatorsSection
from namod_ctl.app.config.camera_schema import DeviceCameraSection, RadiometricLawSection
from namod_ctl.app.config.psf_camera_schema import PsfCameraSection
from namod_ctl.app.config.section import FacetId, FileName, Name, Section, within

AngleDeg = Annotated[float, within(-360.0, 360.0)]
FacetWidthM = Annotated[float, within(0.01, 5.0)]
FacetFocalLengthM = Annotated[float, within(0.1, 150.0)]
DishRadiusM = Annotated[float, within(0.1, 200.0)]
FacetShapeName = Literal["hexagon", "square", "round"]
PointM = Annotated[
    tuple[
        Annotated[float, within(-50.0, 50.0)],
        Annotated[float, within(-50.0, 50.0)],
        Annotated[float, within(-5.0, 50.0)],
    ],
    Field(strict=False),
]
LegM = Annotated[tuple[Annotated[float, within(-2.0, 2.0)], Annotated[float, within(-2.0, 2.0)]], Field(strict=False)]
JointM = Annotated[
    tuple[
        Annotated[float, within(-5.0, 5.0)], Annotated[float, within(-5.0, 5.0)], Annotated[float, within(-5.0, 0.0)]
    ],
    Field(strict=False),
]
PixelXY = Annotated[
    tuple[Annotated[float, within(-1.0, 20_000.0)], Annotated[float, within(-1.0, 20_000.0)]], Field(strict=False)
]


class TelescopeSection(Section):
    """The telescope as a whole."""

    name: Name
    focal_length_m: Annotated[float, within(0.1, 100.0)]


class FacetSection(Section):
    """One facet, written out."""

    id: FacetId
    position_m: PointM
    focal_length_m: FacetFocalLengthM
    shape: FacetShapeName
    width_m: FacetWidthM
    rotation_deg: AngleDeg = 0.0


class DishSection(Section):
    """The surface for facets of a sim_telarray list that comes without z."""

    parabola_share: Annotated[float, within(0.0, 1.0)]
    sphere_radius_m: DishRadiusM | None = None


class LayoutSection(Section):
    """A generated reflector."""

    shape: FacetShapeName
    width_m: FacetWidthM
    spacing_m: Annotated[float, within(0.01, 10.0)]
    inner_radius_m: Annotated[float, within(0.0, 50.0)]
    outer_radius_m: Annotated[float, within(0.01, 50.0)]
    parabola_share: Annotated[float, within(0.0, 1.0)]
    sphere_radius_m: DishRadiusM | None = None
    lattice_centre: Literal["facet", "edge", "corner"] = "facet"
    facet_focal_length_m: FacetFocalLengthM | None = None


class ReflectorSection(Section):
    """The facets: written out, in a file, or generated; exactly one of the three."""

    facets: Annotated[tuple[FacetSection, ...] | None, Field(strict=False, min_length=1, max_length=1000)] = None
    facets_file: FileName | None = None
    format: Literal["namod", "mars", "sim_telarray"] | None = None
    facet_ids: Annotated[tuple[FacetId, ...] | None, Field(strict=False, min_length=1)] = None
    dish: DishSection | None = None
    layout: LayoutSection | None = None

    @model_validator(mode="after")
    def _has_one_source(self) -> ReflectorSection:
        sources = [key for key in ("facets", "facets_file", "layout") if getattr(self, key) is not None]
        if len(sources) != 1:
            found = " and ".join(sources) or "none"
            raise ValueError(f"must hold exactly one of facets, facets_file, layout; found {found}")
        if (self.facets_file is None) != (self.format is None):
            raise ValueError('facets_file and format = "namod" | "mars" | "sim_telarray" go together')
        if self.facet_ids is not None and self.format not in ("mars", "sim_telarray"):
            raise ValueError('facet_ids is for facet lists without ids: format = "mars" or "sim_telarray"')
        if self.dish is not None and self.format != "sim_telarray":
            raise ValueError('dish is for facet lists without z: format = "sim_telarray"')
        return self


class _MountSection(Section):
    """What all mounts have."""

    orientation_deg: AngleDeg
    travel_limit_mm: Annotated[float, within(0.05, 200.0)]
    goniometer_resolution_deg: Annotated[float, within(0.05, 90.0)]
    backlash_um: Annotated[float, within(0.0, 2000.0)]
    facet_orientation_deg: dict[str, AngleDeg] = Field(default_factory=dict)
    bolts_seen_from: Literal["front", "back"] = "back"  # changes drawings only: no number depends on it


class TripodMountSection(_MountSection):
    """Three bolts 120 degrees apart on a circle; the first at `orientation_deg` from +x towards +y."""

    kind: Literal["tripod"]
    radius_m: Annotated[float, within(0.005, 2.0)]
    pitch_mm_per_turn: Annotated[float, within(0.05, 20.0)]
    turn_raises_leg: Literal["clockwise", "counterclockwise"]


class LegsMountSection(_MountSection):
    """Legs anywhere: two actuators and a fixed point, a hexapod; bolts only if they have a pitch.

    Legs are straight along z unless `base_joints_m` gives each its lower joint, relative to the facet's centre.
    """

    kind: Literal["legs"]
    positions_m: Annotated[tuple[LegM, ...], Field(strict=False, min_length=2, max_length=12)]
    base_joints_m: Annotated[tuple[JointM, ...] | None, Field(strict=False)] = None
    has_fixed_point: bool
    pitch_mm_per_turn: Annotated[float, within(0.05, 20.0)] | None = None
    turn_raises_leg: Literal["clockwise", "counterclockwise"] | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> LegsMountSection:
        if (self.pitch_mm_per_turn is None) != (self.turn_raises_leg is None):
            raise ValueError("pitch_mm_per_turn and turn_raises_leg go together: legs with both are bolts")
        if self.base_joints_m is not None and len(self.base_joints_m) != len(self.positions_m):
            raise ValueError(
                f"base_joints_m holds {len(self.base_joints_m)} joints for {len(self.positions_m)} positions_m; "
                "give the lower joint of each leg, in the same order"
            )
        return self


MountSection = Annotated[TripodMountSection | LegsMountSection, Field(discriminator="kind")]


class _CameraSection(DeviceCameraSection):
    """What both cameras of the method have."""

    rotation_deg: AngleDeg
    mirrored: bool
    axis_px: PixelXY | None = None
    radiometric_law: RadiometricLawSection

    @model_validator(mode="after")
    def _axis_is_in_image(self) -> _CameraSection:
        if self.axis_px is not None:
            x_px, y_px = self.axis_px
            if x_px > self.columns or y_px > self.rows:
                raise ValueError(f"axis_px = [{x_px:g}, {y_px:g}] lies outside the {self.columns} x {self.rows} image")
        return self


class StarCameraSection(_CameraSection):
    """The camera that looks at the star."""

    plate_scale_mdeg_per_px: Annotated[float, within(0.05, 50.0)]
    star_diameter_deg: Annotated[float, within(0.001, 0.5)]


class ReflectorCameraSection(_CameraSection):
    """The camera that looks at the facets."""

    plate_scale_mdeg_per_px: Annotated[float, within(1.0, 500.0)]


class PolygonSection(Section):
    """Outline of one facet in the reflector camera's image, in order along it."""

    facet_id: FacetId
    corners_px: Annotated[tuple[PixelXY, ...], Field(strict=False)]


class ReflectorMapSection(Section):
    """Where the facets are in the reflector camera's image: written out or in a file."""

    polygons: Annotated[tuple[PolygonSection, ...] | None, Field(strict=False)] = None
    polygons_file: FileName | None = None

    @model_validator(mode="after")
    def _has_one_source(self) -> ReflectorMapSection:
        if (self.polygons is None) == (self.polygons_file is None):
            raise ValueError("must hold either polygons or polygons_file")
        return self


class RecordingSection(Section):
    """How `namod-ctl record` exposes, and what it lets pass; everything has a default.

    `frame_timeout_s`: so long after its exposure a frame is waited for; slow cameras need minutes.
    `region_radius_deg` is that of the directions around the telescope's axis that are to be covered.
    `star_zero_point_mag` is the magnitude of a star whose intensity, as records have it, is 1.
    """

    brightest_pixel_share: Annotated[float, within(0.3, 0.95)] = 0.8
    shortest_exposure_s: Annotated[float, within(1e-5, 60.0)] = 1e-3
    longest_exposure_s: Annotated[float, within(1e-3, 600.0)] = 3.0
    max_motion_share: Annotated[float, within(0.05, 5.0)] = 0.5
    frame_timeout_s: Annotated[float, within(0.1, 600.0)] = 2.0
    region_radius_deg: Annotated[float, within(0.01, 10.0)] = 0.35
    star_zero_point_mag: Annotated[float, within(-50.0, 50.0)] | None = None

    @model_validator(mode="after")
    def _has_a_range(self) -> RecordingSection:
        if self.shortest_exposure_s > self.longest_exposure_s:
            raise ValueError(
                f"shortest_exposure_s = {self.shortest_exposure_s:g} is more than longest_exposure_s = "
                f"{self.longest_exposure_s:g}; exchange them"
            )
        return self


class SiteSection(Section):
    """Where the telescope stands; longitude is positive to the east."""

    latitude_deg: Annotated[float, within(-90.0, 90.0)]
    longitude_deg: Annotated[float, within(-180.0, 360.0)]
    altitude_m: Annotated[float, within(-500.0, 9000.0)]


class InstrumentSections(Section):
    """The whole file."""

    telescope: TelescopeSection
    site: SiteSection | None = None
    reflector: ReflectorSection
    mount: MountSection
    star_camera: StarCameraSection
    reflector_camera: ReflectorCameraSection
    reflector_map: ReflectorMapSection | None = None
    recording: RecordingSection | None = None
    psf_camera: PsfCameraSection | None = None
    actuators: ActuatorsSection | None = None
