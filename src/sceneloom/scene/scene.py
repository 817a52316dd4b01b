"""The scene: all sensors of a drive on one clock and in one frame tree; its time span and its assumed camera models."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from html import escape
from importlib import import_module
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sceneloom.arrays import Int64Array, hold_timestamp
from sceneloom.cameras.camera import MODELS
from sceneloom.errors import CalibrationError, OptionError, SceneloomError
from sceneloom.scene.annotations import Annotation, AttributePath, CameraCalibration, LocalizationAdjustment
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.types import NO_FIELDS, Identifier, key_of
from sceneloom.warnings import DataWarning, assumed, skipped

if TYPE_CHECKING:
    from sceneloom.scene.ego import EgoMotion
    from sceneloom.scene.samples import Samples

Sensor = (
    LidarSensor
    | RadarSensor
    | PointsSensor
    | CameraSensor
    | DepthCameraSensor
    | OdometrySensor
    | ImuSensor
    | GnssSensor
    | PlainSensor
)

Posed = LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor
"""Sensors with frames, and with poses."""


def _nothing() -> None:
    pass


class Corrections(StrEnum):
    """What everything that computes with a scene does with its corrections."""

    APPLY = "apply"
    """Apply them first: the default."""
    IGNORE = "ignore"
    """Leave them off, and keep the annotations."""


_APPLYING = "sceneloom.editing.apply"
"""The module that applies corrections; it is built upon this one, and imported when a scene has any."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A drive. Usable bare and in `with`; it owns the files behind it.

    Attributes:
        sensors: all sensors, ids unique.
        annotations: what is stated about the scene.
        trajectories: the known trajectories of the ego in the world, by name, the default one first.
        attributes: what is stated about the scene and its sensors.
        metadata: free fields.
        time_offset_ns: what a file's clock leaves out of its timestamps [ns]; all our times include it.
        source: where the scene comes from, for messages.
        format: name of the format that it was read from, or "simulated", ….
        warnings: what was assumed, repaired or left out.
        extras: further root fields of the file, by name.
        corrections: what everything that computes with the scene does with its camera calibrations and localization
            adjustments; see `corrected`.

    Raises:
        OptionError: two sensors or two annotations share an id.
    """

    sensors: tuple[Sensor, ...]
    annotations: tuple[Annotation, ...] = ()
    trajectories: Mapping[str, Trajectory] = field(default_factory=lambda: NO_FIELDS)
    attributes: tuple[AttributePath, ...] = ()
    metadata: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    time_offset_ns: int = 0
    source: str = "scene"
    format: str = "memory"
    warnings: tuple[DataWarning, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    on_close: Callable[[], None] = _nothing
    corrections: Corrections = Corrections.APPLY

    def __post_init__(self) -> None:
        hold_timestamp(self, "time_offset_ns")
        for kind, ids in (("sensors", [s.id for s in self.sensors]), ("annotations", [a.id for a in self.annotations])):
            seen: set[tuple[type, Identifier]] = set()
            for index, identifier in enumerate(ids):
                if (type(identifier), identifier) in seen:
                    raise OptionError(f"{self.source}: {kind}[{index}].id: {identifier!r} is used twice")
                seen.add((type(identifier), identifier))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, SceneloomError):
            error.remember(self.warnings)
            error.raised_with(self.source)
        self.close()

    def close(self) -> None:
        """Release the files behind the scene; its frames cannot be read afterwards."""
        self.on_close()

    def sensor(self, sensor_id: Identifier) -> Sensor:
        """Find a sensor by its id.

        Raises:
            OptionError: the scene has no such sensor.
        """
        for sensor in self.sensors:
            if key_of(sensor.id) == key_of(sensor_id):
                return sensor
        known = ", ".join(repr(sensor.id) for sensor in self.sensors)
        raise OptionError(f"{self.source}: no sensor {sensor_id!r}; it has {known}")

    def samples(
        self,
        *,
        reference: Identifier = "lidar",
        cameras: Identifier | Iterable[Identifier] = "all",
        depth_cameras: Identifier | Iterable[Identifier] = "all",
        lidars: Identifier | Iterable[Identifier] | None = None,
        radars: Identifier | Iterable[Identifier] = (),
        trajectory: "str | EgoMotion | None" = None,
        tolerance_ns: int | None = None,
    ) -> "Samples":
        """Give synchronised sets of frames with poses and calibrations: one for each frame of a sensor, by number.

        Frames belong to the moment of a sweep (its reference time) or of an image: the nearest one in time of each
        sensor, the earlier one of two equally near.

        Corrections are applied first, see `corrected`.

        Args:
            reference: the lidar or camera whose frames are counted, by its id; "lidar" and "camera" are the first ones.
            cameras: whose images a sample holds: "all", an id, or several; () for none.
            depth_cameras: the same for depth images.
            lidars: the same for further lidars. None: the reference; the first lidar where that is a camera.
            radars: the same for radars.
            trajectory: name of the ego trajectory, "identity" for an ego that is stationary, the trajectory itself, or
                None for the default. Without any, poses in the world are not known, mountings are.
            tolerance_ns: how far from the moment a frame may be [ns]; None for one sweep period.

        Raises:
            OptionError: there is no such sensor or trajectory, or the tolerance is negative.
            PoseError: the named trajectory has no orientations.
        """
        from sceneloom.scene.samples import Samples

        return Samples.of(
            self.corrected(),
            reference=reference,
            cameras=cameras,
            depth_cameras=depth_cameras,
            lidars=lidars,
            radars=radars,
            trajectory=trajectory,
            tolerance_ns=tolerance_ns,
        )

    def __repr__(self) -> str:
        """Five lines: where it comes from, its lidars, its cameras, its other sensors, what is known and stated."""
        span, rows = time_span(self), [_row(sensor) for sensor in self.sensors]
        seconds = "no time" if span is None else f"{(span[1] - span[0]) / 1e9:.2f} s"

        def listed(wanted: str) -> str:
            return _some(f"{name} ({text})" for type_, name, text in rows if type_ == wanted)

        others = [f"{type_} {name} ({text})" for type_, name, text in rows if type_ not in {"lidar", "camera"}]
        counts = Counter(annotation.type for annotation in self.annotations)
        known = f"trajectories: {_some(self.trajectories)}"
        stated = f"annotations: {_some(f'{count} {name}' for name, count in counts.most_common())}"
        lines = (
            f"<Scene {self.source!r}: {self.format}, {seconds}",
            f"lidars: {listed('lidar')}",
            f"cameras: {listed('camera')}",
            f"other sensors: {_some(others)}",
            f"{known}; {stated}>",
        )
        return "\n  ".join(lines)

    def _repr_html_(self) -> str:
        """The sensors as a table: what a notebook shows of a scene."""
        first, *_, last = repr(self).strip("<>").split("\n")
        cells = "".join(
            f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in _row(sensor))}</tr>" for sensor in self.sensors
        )
        head = "<tr><th>type</th><th>sensor</th><th>what it has</th></tr>"
        return f"<p><b>{escape(first)}</b><br>{escape(last)}</p><table>{head}{cells}</table>"

    @property
    def pending_corrections(self) -> tuple[CameraCalibration | LocalizationAdjustment, ...]:
        """The camera calibrations of its cameras and the localization adjustments, which are not applied yet."""
        cameras = {key_of(sensor.id) for sensor in self.sensors if isinstance(sensor, CameraSensor)}
        return tuple(
            annotation
            for annotation in self.annotations
            if isinstance(annotation, LocalizationAdjustment)
            or (isinstance(annotation, CameraCalibration) and key_of(annotation.sensor_id) in cameras)
        )

    def corrected(self) -> Self:
        """Give the scene that is computed with: corrections applied, each with a warning, and their annotations gone.

        Frames are still read when they are asked for. Everything that computes calls this; a scene without corrections
        is given as it is. Of one whose `corrections` are to be ignored, warnings report it, and the annotations stay.

        Raises:
            OptionError: some sensors are in the world and some on the ego, so that it is not clear what is adjusted.
            DataError: a frame that this needs cannot be read.

        Source: READINGS of "camera_calibration" and "localization_adjustment" in docs/CONVENTIONS.md.
        """
        pending = self.pending_corrections
        if not pending:
            return self
        if self.corrections is Corrections.APPLY:
            corrected: Self = import_module(_APPLYING).corrected_scene(self)
            return corrected
        known = {(warning.code, warning.location) for warning in self.warnings}
        reported = [
            skipped("correction-not-applied", f"annotations[{a.id}]", f"{a.type} left off, as was asked for")
            for a in pending
        ]
        new = [warning for warning in reported if (warning.code, warning.location) not in known]
        return replace(self, warnings=(*self.warnings, *new)) if new else self

    @property
    def correction_warnings(self) -> tuple[DataWarning, ...]:
        """Of the warnings those about corrections that were applied or left off."""
        return tuple(warning for warning in self.warnings if warning.code.startswith("correction-"))

    @property
    def lidars(self) -> tuple[LidarSensor, ...]:
        """The lidars, in the order of `sensors`."""
        return tuple(sensor for sensor in self.sensors if isinstance(sensor, LidarSensor))

    @property
    def cameras(self) -> tuple[CameraSensor, ...]:
        """The cameras, in the order of `sensors`; `camera_index` of a point counts these."""
        return tuple(sensor for sensor in self.sensors if isinstance(sensor, CameraSensor))


_MOST_LISTED = 6


def _some(names: Iterable[str]) -> str:
    """The first few names, or "none"."""
    found = list(names)
    return ", ".join(found[:_MOST_LISTED]) + (", …" if len(found) > _MOST_LISTED else "") if found else "none"


_UNITS = {"lidar": "sweeps", "camera": "images", "depth_camera": "depth images", "radar": "cycles", "odometry": "poses"}


def _row(sensor: Sensor) -> tuple[str, str, str]:
    """Type and id of a sensor, and what it has, without reading it: "12 images at 10 Hz, 1242x375 pinhole"."""
    if isinstance(sensor, PointsSensor):
        return sensor.type, str(sensor.id), f"{len(sensor.positions)} points"
    times = frame_times(sensor)
    parts = [f"{len(times)} {_UNITS.get(sensor.type, 'samples')}"]
    if len(times) > 1 and times[-1] > times[0]:
        parts[0] += f" at {1e9 / usual_period_ns(times):.3g} Hz"
    if isinstance(sensor, CameraSensor | DepthCameraSensor):
        parts.append(f"{sensor.camera.width}x{sensor.camera.height} {sensor.camera.model}")
    elif isinstance(sensor, LidarSensor) and sensor.model is not None:
        parts.append(sensor.model)
    return str(sensor.type), str(sensor.id), ", ".join(parts)


NOMINAL_PERIOD_NS = 100_000_000
"""The sweep period of a lidar with a single frame, or all of one time: 10 Hz, the commonest."""


def usual_period_ns(timestamps_ns: Int64Array) -> int:
    """The median time from one timestamp to the next later one [ns]; the nominal period where there is none.

    Args:
        timestamps_ns: (N,) int64 [ns], in any order.
    """
    steps = np.diff(np.unique(timestamps_ns))
    return int(np.median(steps)) if len(steps) else NOMINAL_PERIOD_NS


def sweep_period_ns(lidar: LidarSensor) -> int:
    """The median time from sweep to sweep [ns]; the nominal one where the timestamps report none."""
    return usual_period_ns(lidar.frames.timestamps_ns)


def scene_period_ns(scene: Scene) -> int:
    """The longest sweep period of the scene's lidars [ns]: how far poses may be extrapolated."""
    return max((sweep_period_ns(lidar) for lidar in scene.lidars), default=NOMINAL_PERIOD_NS)


_NO_FRAMES: LazyFrames[Any] = LazyFrames(np.zeros(0, np.int64), ().__getitem__)


def frames_of(sensor: Sensor) -> LazyFrames[Any]:
    """The sweeps, cycles, images or depth images of a sensor; none of one without."""
    if isinstance(sensor, CameraSensor):
        return sensor.images
    return sensor.frames if isinstance(sensor, Posed) else _NO_FRAMES


def frame_times(sensor: Sensor) -> Int64Array:
    """The timestamps (N,) int64 [ns] of whatever the sensor gives over time; empty where it has no time."""
    if isinstance(sensor, Posed):
        return frames_of(sensor).timestamps_ns
    if isinstance(sensor, OdometrySensor):
        return np.zeros(0, np.int64) if sensor.poses.static else sensor.poses.timestamps_ns
    if isinstance(sensor, ImuSensor):
        streams = [stream.timestamps_ns for stream in sensor.streams.values()]
        return np.sort(np.concatenate(streams)) if streams else np.zeros(0, np.int64)
    return getattr(sensor, "timestamps_ns", np.zeros(0, np.int64))


def time_span(scene: Scene) -> tuple[int, int] | None:
    """First and last timestamp of what is measured [ns]; None for a scene without time.

    Poses of odometry count only where there is nothing else: they reach beyond what a part of a drive was cut to.
    """
    measuring = [sensor for sensor in scene.sensors if not isinstance(sensor, OdometrySensor)]
    return _span(measuring) or _span(scene.sensors)


def _span(sensors: Iterable[Sensor]) -> tuple[int, int] | None:
    timestamps = [times for times in map(frame_times, sensors) if len(times)]
    if not timestamps:
        return None
    return min(int(times.min()) for times in timestamps), max(int(times.max()) for times in timestamps)


_OURS, _ENTRY = "sceneloom", "assumed_models"
"""Where a scene's metadata state with which of these models it may be computed."""


def check_camera_models(scene: Scene, cameras: Iterable[CameraSensor | DepthCameraSensor] | None = None) -> None:
    """Refuse to compute with camera models of models that no source confirms, unless that was asked for on opening.

    Args:
        scene: whose metadata state what was asked for.
        cameras: those that are computed with; None for all.

    Raises:
        CalibrationError: naming the camera, the model and the option.
    """
    allowed = assumed_models(scene)
    for camera in scene.cameras if cameras is None else cameras:
        model = camera.camera.model
        if model in MODELS and MODELS[model].on_request and model not in allowed:
            raise CalibrationError(
                f"{scene.source}: sensors[{camera.id}].camera: {model!r} is named by the format, but nothing says "
                "its formula; use `--assume-model` (assume_model=True on opening) to compute with the one that "
                "docs/CONVENTIONS.md gives"
            )


def assumed_models(scene: Scene) -> tuple[str, ...]:
    """The models that were asked for."""
    reported = _ours(scene).get(_ENTRY)
    return tuple(name for name in reported if isinstance(name, str)) if isinstance(reported, list | tuple) else ()


def _ours(scene: Scene) -> Mapping[str, Any]:
    ours = scene.metadata.get(_OURS)
    return ours if isinstance(ours, Mapping) else {}


def with_assumed_models(scene: Scene) -> Scene:
    """Give the scene that may be computed with; its metadata and a warning for each such model report it."""
    models = {
        camera.camera.model: camera.id
        for camera in scene.cameras
        if camera.camera.model in MODELS and MODELS[camera.camera.model].on_request
    }
    if not models:
        return scene
    reported = sorted({*assumed_models(scene), *models})
    metadata = {**scene.metadata, _OURS: {**_ours(scene), _ENTRY: reported}}
    why = "computed with by a formula that nothing confirms, as asked for"
    warnings = (assumed("assumed-model", f"sensors[{id_}].camera", f"{model}: {why}") for model, id_ in models.items())
    return replace(scene, metadata=MappingProxyType(metadata), warnings=(*scene.warnings, *warnings))
