"""Sensors of the ego motion (odometry, IMU, GNSS), and sensors of types that the model has no class for."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, hold_arrays
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import NO_FIELDS, Identifier, SensorType


@dataclass(frozen=True, slots=True, eq=False)
class OdometrySensor:
    """The pose of the ego itself over time (`world_from_ego`)."""

    id: Identifier
    poses: Poses
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    type: ClassVar[SensorType] = SensorType.ODOMETRY


@dataclass(frozen=True, slots=True, eq=False)
class VectorSamples:
    """A stream of vectors with a time each.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        values: (N, K) float64, in the unit of the stream.
        file_seconds: (N,) float64 [s], the file's own timestamps, or None.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    file_seconds: Float64Array | None = None

    def __post_init__(self) -> None:
        hold_arrays(
            self,
            "samples",
            {"timestamps_ns": (np.int64, "N"), "values": (np.float64, "N", None), "file_seconds?": (np.float64, "N")},
        )

    def __len__(self) -> int:
        return len(self.timestamps_ns)


@dataclass(frozen=True, slots=True, eq=False)
class ImuSensor:
    """An inertial measurement unit; its frame is the ego frame.

    Attributes:
        id: unique among the scene's sensors.
        streams: by the recording's words: "accelerometer" [m/s²], "gyroscope" [rad/s], "magnetometer" [µT],
            "imuTemperature" [K], …; of what others found of the motion, "linearVelocity" [m/s] and "angularVelocity"
            [rad/s].
        parent_id: id of the parent sensor, or None.
        extras: further fields of the file, by name.
    """

    id: Identifier
    streams: Mapping[str, VectorSamples]
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    type: ClassVar[SensorType] = SensorType.IMU


@dataclass(frozen=True, slots=True, eq=False)
class GnssSensor:
    """A satellite receiver.

    Attributes:
        id: unique among the scene's sensors.
        timestamps_ns: (N,) int64 [ns].
        positions_lla: (N, 3) float64: latitude [deg], longitude [deg], altitude above the WGS84 ellipsoid [m].
        accuracies: (N,) float64 [m], NaN where not given.
        vertical_accuracies: (N,) float64 [m], NaN where not given.
        file_seconds: (N,) float64 [s], the file's own timestamps, or None.
        mount: `ego_from_gnss`, where the antenna sits on the ego; its translation is the lever arm [m]. None where the
            source does not know it.
        parent_id: id of the parent sensor, or None.
        extras: further fields of the file, by name.
    """

    id: Identifier
    timestamps_ns: Int64Array
    positions_lla: Float64Array
    accuracies: Float64Array
    vertical_accuracies: Float64Array
    file_seconds: Float64Array | None = None
    mount: RigidTransform | None = None
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_arrays(
            self,
            "gnss",
            {
                "timestamps_ns": (np.int64, "N"),
                "positions_lla": (np.float64, "N", 3),
                "accuracies": (np.float64, "N"),
                "vertical_accuracies": (np.float64, "N"),
                "file_seconds?": (np.float64, "N"),
            },
        )

    type: ClassVar[SensorType] = SensorType.GNSS


@dataclass(frozen=True, slots=True, eq=False)
class PlainSensor:
    """A sensor of any other type, its fields as the file has them, times in nanoseconds.

    Attributes:
        id: unique among the scene's sensors.
        type: the file's own word.
        fields: all fields but `id` and `type`.
    """

    id: Identifier
    type: str
    fields: Mapping[str, Any]

    @property
    def parent_id(self) -> Identifier | None:
        """Id of the parent sensor, or None."""
        return self.fields.get("parent_id")
