"""All calibrations of a fusion system: set one by one, by the property, or by a file; replaced while it runs."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError
from sceneloom.fusion.calibration.axes import DeclaredAxes
from sceneloom.fusion.calibration.declared import CalibratedPair, calibrated_pair
from sceneloom.fusion.calibration.entries import CalibrationEntry


@dataclass(frozen=True, slots=True)
class CalibrationTable:
    """Calibrations by camera and lidar; never edited, so that a frame keeps those in force when it came.

    Attributes:
        entries: by (camera_id, lidar_id).
    """

    entries: Mapping[tuple[int, int], CalibrationEntry] = field(default_factory=lambda: MappingProxyType({}))

    def having(self, entries: Iterable[CalibrationEntry]) -> "CalibrationTable":
        """The table with further entries, which replace those of the same sensors."""
        added = {(entry.camera_id, entry.lidar_id): entry for entry in entries}
        return replace(self, entries=MappingProxyType({**self.entries, **added}))

    @property
    def camera_ids(self) -> tuple[int, ...]:
        """All cameras, ascending."""
        return tuple(sorted({camera_id for camera_id, _ in self.entries}))

    @property
    def lidar_ids(self) -> tuple[int, ...]:
        """All lidars, ascending."""
        return tuple(sorted({lidar_id for _, lidar_id in self.entries}))


@dataclass(frozen=True, slots=True)
class DeclaredFrames:
    """The axes of the frames that sensors give their data in.

    Attributes:
        camera, lidar: axes of forward, right and up.
    """

    camera: DeclaredAxes
    lidar: DeclaredAxes


def resolve_pair(
    table: CalibrationTable,
    camera_id: int,
    lidar_id: int,
    frames: DeclaredFrames,
    camera_models: Mapping[int, Camera],
) -> CalibratedPair:
    """Give the camera model and mounting of a camera and a lidar.

    Raises:
        CalibrationError: none is known, or it contradicts the declared axes.
    """
    entry = table.entries.get((camera_id, lidar_id))
    if entry is None:
        known = ", ".join(f"({camera}, {lidar})" for camera, lidar in table.entries) or "none"
        raise CalibrationError(
            f"no calibration of camera {camera_id} and lidar {lidar_id}; known pairs (camera, lidar): {known}"
        )
    return calibrated_pair(entry.data, frames.camera, frames.lidar, camera_model=camera_models.get(camera_id))
