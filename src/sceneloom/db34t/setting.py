"""The configuration in force: properties and calibrations of one moment, read once until they change."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.db34t.calibration import (
    CAMERA_MODELS,
    SLOPPIEST,
    CalibrationTable,
    DeclaredAxes,
    MatrixLayout,
    SensorKind,
    camera_of,
    matrix_of,
    possible_layouts,
    read_by_sensor,
)
from sceneloom.db34t.properties import DeclaredSensor, Snapshot, parse_sensors
from sceneloom.db34t.records import CalibrationData
from sceneloom.errors import CalibrationError, DataError
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.geometry.rigid import RigidTransform

_SUSPECT_DEG = 45.0


_CAMERA_FROM_LIDAR_FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Of a camera that looks forward: optical axes from x forward, y left, z up."""


@dataclass(frozen=True, eq=False)
class CalibratedPair:
    """A camera and a lidar in the frames used inside.

    Attributes:
        camera: the camera model.
        camera_from_lidar: takes points of the lidar (x forward, y left, z up) into the optical frame.
        notes: what looks wrong, for people.
    """

    camera: Camera
    camera_from_lidar: RigidTransform
    notes: tuple[str, ...] = ()

    @cached_property
    def lidar_from_camera(self) -> RigidTransform:
        """The mounting seen from the lidar; always the same object."""
        return self.camera_from_lidar.inverse()


_MILLISECOND = 1_000_000


_SECOND = 1_000_000_000


_SHORTEST_WAIT_S = 0.01


@dataclass(frozen=True, slots=True)
class DeclaredFrames:
    """The axes of the frames that sensors give their data in.

    Attributes:
        camera, lidar: axes of forward, right and up.
    """

    camera: DeclaredAxes
    lidar: DeclaredAxes


@dataclass(frozen=True, eq=False)
class Setting:
    """The configuration by which a record is received and fused.

    Attributes:
        properties: as they were.
        table: the calibrations as they were.
        frames: the declared axes.
        camera_models: camera models that table 3 cannot state, by camera_id.
        sensors: what the property `sensors` declares, by sensor_id.
        pairs: camera model and mounting of each camera and lidar that are calibrated, by (camera_id, lidar_id).
        faults: why a calibration cannot be used with the declared axes, by the same.
    """

    properties: Snapshot
    table: CalibrationTable
    frames: DeclaredFrames
    camera_models: Mapping[int, Camera]
    sensors: Mapping[int, DeclaredSensor]
    pairs: Mapping[tuple[int, int], CalibratedPair]
    faults: Mapping[tuple[int, int], str] = field(default_factory=dict)

    @classmethod
    def of(cls, properties: Snapshot, table: CalibrationTable, *, before: "Setting | None" = None) -> "Setting":
        """Read properties and calibrations.

        Args:
            before: the setting until now: what did not change since is taken from there.

        Raises:
            DataError: the added property `camera_models` cannot be read.
            CalibrationError: a camera model in it cannot be.
        """
        if before is not None and before.table is table and _geometry(before.properties) == _geometry(properties):
            parts = before.frames, before.camera_models, before.sensors, before.pairs, before.faults
            return cls(properties, table, *parts)
        frames, camera_models = _declared_frames(properties), _camera_models_of(properties)
        pairs: dict[tuple[int, int], CalibratedPair] = {}
        faults: dict[tuple[int, int], str] = {}
        for pair in table.entries:
            try:
                pairs[pair] = _resolve_pair(table, *pair, frames, camera_models)
            except CalibrationError as error:
                faults[pair] = str(error)
        return cls(properties, table, frames, camera_models, parse_sensors(properties["sensors"]), pairs, faults)

    @cached_property
    def sweep_period_ns(self) -> int:
        """By `lidar_frequency` [ns]."""
        return int(_SECOND // self.properties["lidar_frequency"])

    @cached_property
    def image_period_ns(self) -> int:
        """By `camera_frequency` [ns]."""
        return int(_SECOND // self.properties["camera_frequency"])

    @cached_property
    def tolerance_ns(self) -> int:
        """How far an image may be from a sweep [ns], by `pairing_tolerance_ms`.

        Where the property is 0: as far as both lie apart at the worst where both sensors keep their frequencies, half
        of each period.
        """
        stated_ns = round(self.properties["pairing_tolerance_ms"] * _MILLISECOND)
        return stated_ns or (self.sweep_period_ns + self.image_period_ns) // 2

    @cached_property
    def timeout_ns(self) -> int:
        """By `pairing_timeout_ms` [ns]."""
        return int(self.properties["pairing_timeout_ms"]) * _MILLISECOND

    @cached_property
    def lateness_ns(self) -> int:
        """How much older than the newest of its sensor a record may be [ns]: the timeout, or a period of the sensor."""
        return max(self.timeout_ns, self.sweep_period_ns, self.image_period_ns)

    @cached_property
    def timeout_s(self) -> float:
        """By `pairing_timeout_ms` [s], but no shorter than what a thread can wait for others."""
        return max(self.timeout_ns / _SECOND, _SHORTEST_WAIT_S)

    @cached_property
    def idle_s(self) -> float:
        """After how much time without any record nothing is waited for any more [s]."""
        return max((self.timeout_ns + self.tolerance_ns) / _SECOND, _SHORTEST_WAIT_S)

    @cached_property
    def configuration(self) -> FusionConfiguration:
        """What the fusion system itself goes by."""
        sensor_data, detections = self.properties.algorithms
        return FusionConfiguration(
            fusion_algorithm=sensor_data,
            detection_algorithm=detections,
            detectors=self.properties["detectors"],
            pairing_tolerance_ns=self.tolerance_ns,
            lateness_ns=self.timeout_ns,
            most_waiting=self.properties["queue_length"],
            stand_beyond_trajectory=True,
            motion_compensation=self.properties["motion_compensation"] == 1,
            image_period_ns=self.image_period_ns,
            disorder_ns=self.lateness_ns,
        )

    @cached_property
    def pixels(self) -> int:
        """Of the images of all calibrated cameras together."""
        sizes = {camera_id: pair.camera for (camera_id, _), pair in self.pairs.items()}
        return sum(camera.width * camera.height for camera in sizes.values())

    @cached_property
    def standard_from_lidar(self) -> Float64Array:
        """Takes coordinates of the declared lidar frame into x forward, y left, z up, (3, 3) float64."""
        return self.frames.lidar.standard_from_declared(SensorKind.LIDAR)

    @cached_property
    def declared_from_standard(self) -> Float64Array:
        """The other way round, (3, 3) float64."""
        return read_only(self.standard_from_lidar.T)

    @cached_property
    def calibrated(self) -> Mapping[SensorKind, tuple[int, ...]]:
        """The numbers of the sensors that a usable calibration is known of, by kind."""
        cameras, lidars = ({pair[location] for pair in self.pairs} for location in (0, 1))
        return {SensorKind.CAMERA: tuple(sorted(cameras)), SensorKind.LIDAR: tuple(sorted(lidars))}

    def pairs_of(self, kind: SensorKind, sensor_id: int) -> tuple[tuple[int, int], ...]:
        """The pairs with a usable calibration that a sensor is in."""
        location = 1 if kind is SensorKind.LIDAR else 0
        return tuple(pair for pair in self.pairs if pair[location] == sensor_id)

    def fault_of(self, kind: SensorKind, sensor_id: int) -> str | None:
        """Why a calibration of a sensor cannot be used; None where there is no such."""
        location = 1 if kind is SensorKind.LIDAR else 0
        return next((fault for pair, fault in self.faults.items() if pair[location] == sensor_id), None)

    def camera(self, camera_id: int) -> Camera:
        """The camera model of a camera that is calibrated; a camera has one size with all lidars.

        Raises:
            CalibrationError: its calibrations are of images of several sizes.
        """
        camera_models = [pair.camera for (camera, _), pair in self.pairs.items() if camera == camera_id]
        sizes = {(camera_model.width, camera_model.height) for camera_model in camera_models}
        if len(sizes) > 1:
            raise CalibrationError(f"image_size of camera {camera_id}: {sorted(sizes)}; expected one size")
        return camera_models[0]


_GEOMETRY = (
    *("chirality", "camera_coordinate", "lidar_coordinate", "camera_axes", "lidar_axes", "sensors"),
    CAMERA_MODELS,
)
"""The properties that pairs and sensors depend on."""


def _geometry(properties: Snapshot) -> tuple[object, ...]:
    known = properties.properties
    return tuple(known[name].value if name in known else None for name in _GEOMETRY)


def _declared_frames(properties: Snapshot) -> DeclaredFrames:
    """Read the axes that the properties declare."""
    left_handed = properties["chirality"] == 1
    camera = _axes_of(properties["camera_axes"], properties["camera_coordinate"], left_handed=left_handed)
    lidar = _axes_of(properties["lidar_axes"], properties["lidar_coordinate"], left_handed=left_handed)
    return DeclaredFrames(camera, lidar)


def _camera_models_of(properties: Snapshot) -> Mapping[int, Camera]:
    """Read the added property `camera_models`; none where it is not there or not set.

    Raises:
        DataError: its text cannot be read.
        CalibrationError: a camera model cannot be.
    """
    found = properties.properties.get(CAMERA_MODELS)
    return _parse_camera_models(found.value) if found is not None and isinstance(found.value, str) else {}


def _axes_of(words: str, triple: Sequence[int], *, left_handed: bool) -> DeclaredAxes:
    """Give the declared axes: those in plain words where they are stated, else those of the triple."""
    return DeclaredAxes.of_words(words) if words else DeclaredAxes.of_triple(triple, left_handed=left_handed)


_NUMBERS = ("fx", "fy", "cx", "cy")


def _parse_camera_models(text: str) -> Mapping[int, Camera]:
    """Read `{"1": {"model": "fisheye", "image_size": [w, h], "fx": …, "coefficients": […]}}`; empty: none.

    Raises:
        DataError: it is no JSON object of camera models.
        CalibrationError: a camera model cannot be.
    """
    found = read_by_sensor(text, CAMERA_MODELS, '{"1": {"model": "fisheye", …}}')
    return {camera_id: _camera_model(entry, str(camera_id)) for camera_id, entry in found.items()}


def _camera_model(entry: Any, location: str) -> Camera:
    try:
        model, (width, height) = entry["model"], entry["image_size"]
        fx, fy, cx, cy = (float(entry[name]) for name in _NUMBERS)
        coefficients = tuple(float(value) for value in entry.get("coefficients", ()))
        if model not in MODELS or not all(isinstance(size, int) for size in (width, height)):
            raise DataError(
                CAMERA_MODELS,
                location,
                f"{entry!r}; expected a model out of {', '.join(MODELS)} and whole sizes",
            )
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise DataError(
            CAMERA_MODELS, location, f"{entry!r}; expected model, image_size, fx, fy, cx, cy, coefficients"
        ) from error
    wanted = len(MODELS[model].coefficient_names)
    if len(coefficients) > wanted:
        raise CalibrationError(f"{CAMERA_MODELS}.{location}: {len(coefficients)} coefficients; {model} has {wanted}")
    padded = (*coefficients, *[0.0] * (wanted - len(coefficients)))
    return Camera(model, width, height, fx, fy, cx, cy, padded)


def _resolve_pair(
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


def calibrated_pair(
    data: CalibrationData,
    camera_axes: DeclaredAxes,
    lidar_axes: DeclaredAxes,
    *,
    camera_model: Camera | None = None,
) -> CalibratedPair:
    """Bring a record into the frames used inside.

    `extrinsic_matrix` relates the declared frames. Where its layout is open, the one counts that lets the camera look
    more nearly forward.

    Args:
        camera_model: counts instead of the record's own.

    Raises:
        CalibrationError: the matrix mirrors where the axes do not, or they do and it does not.

    Source: DB34/T 4101-2022, table 3; READINGS of extrinsic_matrix and of declared frames in docs/CONVENTIONS.md.
    """
    optical = camera_axes.standard_from_declared(SensorKind.CAMERA)
    standard = lidar_axes.standard_from_declared(SensorKind.LIDAR)
    layouts = possible_layouts(data.extrinsic_matrix)
    found = [_in_standard_frames(data, layout, optical, standard) for layout in layouts]
    camera_from_lidar, mirrored = min(found, key=lambda pair: _off_forward_deg(pair[0][:3, :3]))
    transform, error = RigidTransform.nearest(camera_from_lidar)
    if error > SLOPPIEST:
        problem = "mirrors" if mirrored else f"has a rotation off by {error:.2g}"
        raise CalibrationError(
            f"extrinsic_matrix {problem} with axes {camera_axes.words} of the camera and {lidar_axes.words} of the "
            "lidar; expected a rotation, of determinant +1, between frames that are both right- or both left-handed"
        )
    return CalibratedPair(camera_model or camera_of(data), transform, _notes(_off_forward_deg(transform.rotation)))


def _in_standard_frames(
    data: CalibrationData, layout: MatrixLayout, optical: Float64Array, standard: Float64Array
) -> tuple[Float64Array, bool]:
    """Give the 4x4 camera_from_lidar of the frames used inside, and whether its rotation mirrors."""
    given = matrix_of(data.extrinsic_matrix, layout)
    declared = np.linalg.inv(given).astype(np.float64) if data.reference_frame == 1 else given
    inside = np.eye(4)
    inside[:3, :3] = optical @ declared[:3, :3] @ standard.T
    inside[:3, 3] = optical @ declared[:3, 3]
    return inside, bool(np.linalg.det(inside[:3, :3]) < 0)


def _off_forward_deg(rotation: Float64Array) -> float:
    """Angle [deg] between a rotation and that of a camera that looks straight forward."""
    cosine = (np.trace(rotation @ _CAMERA_FROM_LIDAR_FORWARD.T) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _notes(off_deg: float) -> tuple[str, ...]:
    if off_deg <= _SUSPECT_DEG:
        return ()
    note = (
        f"by its calibration the camera looks {off_deg:.0f}° off forward; mirrored or transposed? "
        "check extrinsic_matrix, reference_frame and the declared axes, unless it is mounted so"
    )
    return (note,)
