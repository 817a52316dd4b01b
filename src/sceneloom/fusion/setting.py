"""The configuration in force when a record came: properties and calibrations, read once."""

from collections.abc import Mapping
from dataclasses import dataclass

from sceneloom.cameras.camera import Camera
from sceneloom.fusion.calibration.declared import CalibratedPair, axes_of
from sceneloom.fusion.calibration.lenses import LENSES, parse_lenses
from sceneloom.fusion.calibration.table import CalibrationTable, DeclaredFrames, resolve_pair
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.properties.sensors import DeclaredSensor, parse_sensors
from sceneloom.fusion.properties.store import Snapshot

_MILLISECOND = 1_000_000
_SECOND = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """What a record is received and fused by.

    Attributes:
        properties: as they were.
        table: the calibrations as they were.
        frames: the declared axes.
        lenses: lenses that table 3 cannot say, by camera_id.
        sensors: what the property `sensors` declares, by sensor_id.
        pairs: lens and mounting of each camera and lidar that are calibrated, by (camera_id, lidar_id).
    """

    properties: Snapshot
    table: CalibrationTable
    frames: DeclaredFrames
    lenses: Mapping[int, Camera]
    sensors: Mapping[int, DeclaredSensor]
    pairs: Mapping[tuple[int, int], CalibratedPair]

    @classmethod
    def of(cls, properties: Snapshot, table: CalibrationTable) -> "Setting":
        """Read properties and calibrations.

        Raises:
            CalibrationError: a calibration contradicts the declared axes.
            DataError: the added property `lenses` cannot be read.
        """
        frames, lenses = declared_frames(properties), lenses_of(properties)
        pairs = {pair: resolve_pair(table, *pair, frames, lenses) for pair in table.entries}
        return cls(properties, table, frames, lenses, parse_sensors(properties["sensors"]), pairs)

    @property
    def sweep_period_ns(self) -> int:
        """By `lidar_frequency` [ns]."""
        return int(_SECOND // self.properties["lidar_frequency"])

    @property
    def timeout_ns(self) -> int:
        """By `pairing_timeout_ms` [ns]."""
        return int(self.properties["pairing_timeout_ms"]) * _MILLISECOND

    @property
    def configuration(self) -> FusionConfiguration:
        """What the fusion system itself goes by.

        A picture may be as far from a sweep as both lie apart at the worst where both sensors keep their frequencies:
        half of each period.
        """
        tolerance_ns = round(self.properties["pairing_tolerance_ms"] * _MILLISECOND)
        picture_period_ns = int(_SECOND // self.properties["camera_frequency"])
        sensor_data, detections = self.properties.algorithms
        return FusionConfiguration(
            fusion_algorithm=sensor_data,
            detection_algorithm=detections,
            pairing_tolerance_ns=tolerance_ns or (self.sweep_period_ns + picture_period_ns) // 2,
            lateness_ns=self.timeout_ns,
            most_waiting=self.properties["queue_length"],
            stand_beyond_way=True,
        )

    def camera(self, camera_id: int) -> Camera:
        """The lens of a camera that is calibrated."""
        return next(pair.camera for (camera, _), pair in self.pairs.items() if camera == camera_id)


def declared_frames(properties: Snapshot) -> DeclaredFrames:
    """Read the axes that the properties declare."""
    left_handed = properties["chirality"] == 1
    camera = axes_of(properties["camera_axes"], properties["camera_coordinate"], left_handed=left_handed)
    lidar = axes_of(properties["lidar_axes"], properties["lidar_coordinate"], left_handed=left_handed)
    return DeclaredFrames(camera, lidar)


def lenses_of(properties: Snapshot) -> Mapping[int, Camera]:
    """Read the added property `lenses`; none where it is not there or not set.

    Raises:
        DataError: its text cannot be read.
        CalibrationError: a lens cannot be.
    """
    found = properties.properties.get(LENSES)
    return parse_lenses(found.value) if found is not None and isinstance(found.value, str) else {}
