"""The configuration in force: properties and calibrations of one moment, read once until they change."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from sceneloom.arrays import Float64Array, read_only
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.db34t.calibration import (
    CAMERA_MODELS,
    CalibratedPair,
    CalibrationTable,
    DeclaredAxes,
    SensorKind,
    calibrated_pair,
    read_by_sensor,
)
from sceneloom.db34t.properties import DeclaredSensor, Snapshot, parse_sensors
from sceneloom.errors import CalibrationError, DataError
from sceneloom.fusion.configuration import FusionConfiguration

_MILLISECOND = 1_000_000
_SECOND = 1_000_000_000
_SHORTEST_WAIT_S = 0.01

_GEOMETRY = (
    *("chirality", "camera_coordinate", "lidar_coordinate", "camera_axes", "lidar_axes", "sensors"),
    CAMERA_MODELS,
)  # the properties that pairs and sensors depend on


@dataclass(frozen=True, eq=False)
class Setting:
    """The configuration by which a record is received and fused.

    Attributes:
        properties: as they were.
        table: the calibrations as they were.
        axes: the declared axes of cameras and of lidars.
        sensors: what the property `sensors` declares, by sensor_id.
        pairs: camera model and extrinsics of each camera and lidar that are calibrated, by (camera_id, lidar_id).
        faults: why a calibration cannot be used with the declared axes, by the same.
    """

    properties: Snapshot
    table: CalibrationTable
    axes: Mapping[SensorKind, DeclaredAxes]
    sensors: Mapping[int, DeclaredSensor]
    pairs: Mapping[tuple[int, int], CalibratedPair]
    faults: Mapping[tuple[int, int], str] = field(default_factory=dict)

    @classmethod
    def of(cls, properties: Snapshot, table: CalibrationTable, *, before: "Setting | None" = None) -> "Setting":
        """Read properties and calibrations; what did not change since `before` is taken from there.

        Raises:
            DataError: the added property `camera_models` cannot be read.
            CalibrationError: a camera model in it cannot be.
        """
        if before is not None and before.table is table and _geometry(before.properties) == _geometry(properties):
            return replace(before, properties=properties)
        axes = {kind: _declared_axes(properties, kind) for kind in SensorKind}
        added = properties.properties.get(CAMERA_MODELS)
        models = _parse_camera_models(added.value) if added is not None and isinstance(added.value, str) else {}
        pairs: dict[tuple[int, int], CalibratedPair] = {}
        faults: dict[tuple[int, int], str] = {}
        for (camera_id, lidar_id), entry in table.items():
            try:
                pairs[camera_id, lidar_id] = calibrated_pair(
                    entry.data, axes[SensorKind.CAMERA], axes[SensorKind.LIDAR], camera_model=models.get(camera_id)
                )
            except CalibrationError as error:
                faults[camera_id, lidar_id] = str(error)
        return cls(properties, table, axes, parse_sensors(properties["sensors"]), pairs, faults)

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

        Where the property is 0: as far as both are apart at the worst if both sensors keep their frequencies, half of
        each period.
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
        """The configuration of the fusion system itself."""
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
        return self.axes[SensorKind.LIDAR].standard_from_declared(SensorKind.LIDAR)

    @cached_property
    def declared_from_standard(self) -> Float64Array:
        """The other way round, (3, 3) float64."""
        return read_only(self.standard_from_lidar.T)

    @cached_property
    def calibrated(self) -> Mapping[SensorKind, tuple[int, ...]]:
        """The numbers of the sensors with a usable calibration, by kind."""
        return {kind: tuple(sorted({pair[k] for pair in self.pairs})) for k, kind in enumerate(SensorKind)}

    def pairs_of(self, kind: SensorKind, sensor_id: int) -> tuple[tuple[int, int], ...]:
        """The pairs with a usable calibration that a sensor is in."""
        return tuple(pair for pair in self.pairs if pair[kind is SensorKind.LIDAR] == sensor_id)

    def fault_of(self, kind: SensorKind, sensor_id: int) -> str | None:
        """Why a calibration of a sensor cannot be used; None where there is no such."""
        return next((f for pair, f in self.faults.items() if pair[kind is SensorKind.LIDAR] == sensor_id), None)

    def camera(self, camera_id: int) -> Camera:
        """The camera model of a camera that is calibrated; a camera has one size with all lidars.

        Raises:
            CalibrationError: its calibrations are of images of several sizes.
        """
        models = [pair.camera for (camera, _), pair in self.pairs.items() if camera == camera_id]
        sizes = {(model.width, model.height) for model in models}
        if len(sizes) > 1:
            raise CalibrationError(f"image_size of camera {camera_id}: {sorted(sizes)}; expected one size")
        return models[0]


def _geometry(properties: Snapshot) -> tuple[object, ...]:
    known = properties.properties
    return tuple(known[name].value if name in known else None for name in _GEOMETRY)


def _declared_axes(properties: Snapshot, kind: SensorKind) -> DeclaredAxes:
    """The declared axes of a kind of sensor: those in plain words where they are stated, else those of the triple."""
    if properties[f"{kind}_axes"]:
        return DeclaredAxes.of_words(properties[f"{kind}_axes"])
    return DeclaredAxes.of_triple(properties[f"{kind}_coordinate"], left_handed=properties["chirality"] == 1)


def _parse_camera_models(text: str) -> Mapping[int, Camera]:
    """Read `{"1": {"model": "fisheye", "image_size": [w, h], "fx": …, "coefficients": […]}}`; an empty text: none."""
    found = read_by_sensor(text, CAMERA_MODELS, '{"1": {"model": "fisheye", …}}')
    return {camera_id: _camera_model(entry, str(camera_id)) for camera_id, entry in found.items()}


def _camera_model(entry: Any, location: str) -> Camera:
    try:
        model, (width, height) = entry["model"], entry["image_size"]
        fx, fy, cx, cy = (float(entry[name]) for name in ("fx", "fy", "cx", "cy"))
        coefficients = tuple(float(value) for value in entry.get("coefficients", ()))
        if model not in MODELS or not all(isinstance(size, int) for size in (width, height)):
            problem = f"{entry!r}; expected a model out of {', '.join(MODELS)} and whole sizes"
            raise DataError(CAMERA_MODELS, location, problem)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        problem = f"{entry!r}; expected model, image_size, fx, fy, cx, cy, coefficients"
        raise DataError(CAMERA_MODELS, location, problem) from error
    wanted = len(MODELS[model].coefficient_names)
    if len(coefficients) > wanted:
        raise CalibrationError(f"{CAMERA_MODELS}.{location}: {len(coefficients)} coefficients; {model} has {wanted}")
    padded = (*coefficients, *[0.0] * (wanted - len(coefficients)))
    return Camera(model, width, height, fx, fy, cx, cy, padded)
