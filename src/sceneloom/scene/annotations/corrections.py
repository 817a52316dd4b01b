"""What is to be applied to a scene: corrections of its locations, and of its cameras."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class LocalizationAdjustment:
    """Poses A(t) that repair a scene's localisation, or lead from ego to world: p' = A(t) p.

    Attributes:
        id: unique among the scene's annotations.
        poses: `corrected_from_given` over time; a single pose holds at all times.
        parent_id: id of the parent annotation, or None.
        extras: every other field of the file, by name.

    Source: "Localization Adjustment Annotation" of the SFS description.
    """

    id: Identifier
    poses: Poses
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        object.__setattr__(self, "poses", _held(self.poses))

    @property
    def type(self) -> str:
        """`localization_adjustment`."""
        return "localization_adjustment"


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """What repairs a camera: world_from_camera' = world_from_camera D(t), another camera model, other times.

    Attributes:
        id: unique among the scene's annotations.
        sensor_id: the camera.
        poses: D(t), `camera_from_calibrated_camera`, or None; a single pose holds at all times.
        intrinsics: the calibrated camera model, or None.
        time_offset_ns: to be added to the camera's times [ns], or None.
        parent_id: id of the parent annotation, or None.
        extras: every other field of the file, by name; those of `poses` and `intrinsics` under these names.

    Source: "Camera Calibration Annotation" of the SFS description.
    """

    id: Identifier
    sensor_id: Identifier
    poses: Poses | None = None
    intrinsics: Camera | None = None
    time_offset_ns: int | float | None = None
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        if self.poses is not None:
            object.__setattr__(self, "poses", _held(self.poses))

    @property
    def type(self) -> str:
        """`camera_calibration`."""
        return "camera_calibration"


def effect_of(correction: LocalizationAdjustment | CameraCalibration) -> str:
    """Report what a correction changes, in figures."""
    if isinstance(correction, LocalizationAdjustment):
        return f"all poses and points in the world change, {_size(correction.poses)}"
    parts = []
    if correction.poses is not None:
        parts.append(f"extrinsics change, {_size(correction.poses)}")
    if correction.intrinsics is not None:
        parts.append("intrinsics are replaced")
    if correction.time_offset_ns:
        parts.append(f"timestamps change by {correction.time_offset_ns / 1e6:+g} ms")
    return f"camera {correction.sensor_id!r}: {'; '.join(parts) or 'nothing changes'}"


def _size(poses: Poses) -> str:
    farthest = float(np.linalg.norm(poses.positions, axis=1).max())
    cosine = np.clip(np.abs(poses.quaternions_xyzw[:, 3]), 0.0, 1.0)
    return f"by at most {farthest:.3g} m and {float(np.degrees(2.0 * np.arccos(cosine)).max()):.3g} deg"


def _held(poses: Poses) -> Poses:
    """A file cannot state of a single pose that it holds at one time only.

    And nothing could be corrected by it then.
    """
    return replace(poses, static=True) if len(poses.timestamps_ns) == 1 else poses
