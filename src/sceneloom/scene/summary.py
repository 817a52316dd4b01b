"""What is in a scene, in numbers: for people who open a drive that they did not record."""

from contextlib import suppress
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.scene.annotations import effect_of
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, ShootingSensor, shots_of
from sceneloom.scene.clouds import LidarSensor, PointsSensor
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor, frame_times, time_span
from sceneloom.scene.types import Identifier
from sceneloom.warnings import DataWarning

GAP_FACTOR = 1.5
"""Two timestamps farther apart than this many median intervals make a gap."""


class Gap(msgspec.Struct, frozen=True, kw_only=True):
    """A hole in a stream, in seconds after the scene's first timestamp."""

    start: float
    stop: float

    @classmethod
    def in_stream(cls, times: Int64Array, start_ns: int) -> list["Gap"]:
        """The holes in a stream with timestamps (N,) [ns], in seconds after `start_ns`."""
        intervals = np.diff(times)
        if len(intervals) < 2:
            return []
        locations = np.flatnonzero(intervals > GAP_FACTOR * np.median(intervals))
        return [
            cls(start=(int(times[k]) - start_ns) / 1e9, stop=(int(times[k + 1]) - start_ns) / 1e9)
            for k in locations.tolist()
        ]


class Intrinsics(msgspec.Struct, frozen=True, kw_only=True):
    """The camera models of a camera's images, which can have one each: how many different ones, and from what to what.

    Attributes:
        camera_models: how many different ones.
        fx, fy: least and greatest focal lengths [px].
        cx, cy: least and greatest coordinates of the principal point [px].
    """

    camera_models: int
    fx: tuple[float, float]
    fy: tuple[float, float]
    cx: tuple[float, float]
    cy: tuple[float, float]


class SensorSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One sensor.

    Attributes:
        id: its id.
        type: the word of the format.
        count: frames, images, poses or samples.
        rate_hz: one over the median interval, or None for fewer than two; of an IMU that of its longest stream.
        start, stop: first and last timestamp, in seconds after the scene's first one.
        gaps: intervals longer than 1.5 median ones; the first 20.
        gap_count: all of them.
        first_frame_points: points of the first frame, for lidars and maps.
        camera_model: projection model and image size, for cameras and depth cameras.
        intrinsics: what its images' camera models are, for cameras and depth cameras.
        video: codec, where the images come from a video.
        poses: how many, None where there are none.
        coordinates: frame of the poses, and of the points of a lidar.
        mounted: whether the rigid mounting on the ego is known.
    """

    id: Identifier
    type: str
    count: int
    rate_hz: float | None
    start: float | None
    stop: float | None
    gaps: tuple[Gap, ...]
    gap_count: int
    first_frame_points: int | None = None
    camera_model: str | None = None
    intrinsics: Intrinsics | None = None
    video: str | None = None
    poses: int | None = None
    coordinates: str | None = None
    mounted: bool = False


class TrajectorySummary(msgspec.Struct, frozen=True, kw_only=True):
    """One ego trajectory: how many poses, over how many seconds and metres, and whether it has orientations."""

    name: str
    poses: int
    seconds: float
    metres: float
    oriented: bool


class CorrectionSummary(msgspec.Struct, frozen=True, kw_only=True):
    """A correction of the scene that is applied by everything that computes with it: which one, and what it changes."""

    id: Identifier
    type: str
    effect: str


class SceneSummary(msgspec.Struct, frozen=True, kw_only=True):
    """A scene.

    Attributes:
        source: where it comes from.
        format: name of its format.
        start_ns: first timestamp [ns], None for a scene without time.
        duration: seconds from the first to the last one.
        size_bytes: bytes on disk, where known.
        sensors: all of them.
        trajectories: all of them, the default one first.
        annotations: how many of each type.
        warnings: what was assumed, repaired or left out.
        corrections: what is not applied yet.
    """

    source: str
    format: str
    start_ns: int | None
    duration: float
    size_bytes: int | None
    sensors: tuple[SensorSummary, ...]
    trajectories: tuple[TrajectorySummary, ...]
    annotations: dict[str, int]
    warnings: tuple[DataWarning, ...]
    corrections: tuple[CorrectionSummary, ...] = ()


def summarise(scene: Scene, *, size_bytes: int | None = None) -> SceneSummary:
    """Count what a scene holds; reads the first frame of each lidar and nothing more of them.

    Raises:
        DataError: the first frame of a lidar cannot be read.
    """
    span = time_span(scene)
    times = np.concatenate([np.zeros(0, np.int64), *(one.timestamps_ns for one in scene.trajectories.values())])
    if span is None and len(times):
        span = int(times.min()), int(times.max())
    start_ns = 0 if span is None else span[0]
    # `.sfs` files have one camera model per camera, others may store them with each image
    each_camera_model = scene.format != "sfs" and "://" not in scene.source
    types = [annotation.type for annotation in scene.annotations]
    return SceneSummary(
        source=scene.source,
        format=scene.format,
        start_ns=None if span is None else span[0],
        duration=0.0 if span is None else (span[1] - span[0]) / 1e9,
        size_bytes=size_bytes,
        sensors=tuple(_summarise_sensor(one, start_ns, each_camera_model=each_camera_model) for one in scene.sensors),
        trajectories=tuple(
            TrajectorySummary(
                name=name,
                poses=len(trajectory.timestamps_ns),
                seconds=int(np.ptp(trajectory.timestamps_ns)) / 1e9 if len(trajectory.timestamps_ns) else 0.0,
                metres=_length(trajectory.positions),
                oriented=trajectory.quaternions_xyzw is not None,
            )
            for name, trajectory in scene.trajectories.items()
        ),
        annotations={kind: types.count(kind) for kind in sorted(set(types))},
        warnings=scene.warnings,
        corrections=tuple(
            CorrectionSummary(id=correction.id, type=correction.type, effect=effect_of(correction))
            for correction in scene.pending_corrections
        ),
    )


def _summarise_sensor(sensor: Sensor, start_ns: int, *, each_camera_model: bool) -> SensorSummary:
    times = frame_times(sensor)
    paced = times
    if isinstance(sensor, ImuSensor):
        # timestamps of several streams together have no rate
        streams = [stream.timestamps_ns for stream in sensor.streams.values()]
        paced = max(streams, key=len, default=np.zeros(0, np.int64))
    gaps = Gap.in_stream(paced, start_ns)
    median_ns = float(np.median(np.diff(paced))) if len(paced) > 1 else 0.0
    poses: Poses | None = getattr(sensor, "poses", None)
    further: dict[str, Any] = {}
    if isinstance(sensor, PointsSensor):
        further = {"first_frame_points": len(sensor.positions)}
    elif isinstance(sensor, LidarSensor):
        further["first_frame_points"] = len(sensor.frames[0].points) if len(sensor.frames) else None
        in_frame = "" if poses is None else f", poses {sensor.coordinates}"
        further["coordinates"] = f"points {sensor.points_frame}{in_frame}"
    elif isinstance(sensor, CameraSensor | DepthCameraSensor):
        further = {
            "camera_model": f"{sensor.camera.model} {sensor.camera.width}x{sensor.camera.height}",
            "intrinsics": _intrinsics(sensor, each_camera_model=each_camera_model),
            "video": None if sensor.video is None else sensor.video.codec,
            "coordinates": None if poses is None else f"poses {sensor.coordinates}",
        }
    return SensorSummary(
        id=sensor.id,
        type=str(sensor.type),
        count=len(sensor.positions) if isinstance(sensor, PointsSensor) else len(times),
        rate_hz=1e9 / median_ns if median_ns > 0 else None,
        start=(int(times[0]) - start_ns) / 1e9 if len(times) else None,
        stop=(int(times[-1]) - start_ns) / 1e9 if len(times) else None,
        gaps=tuple(gaps[:20]),
        gap_count=len(gaps),
        poses=None if poses is None else len(poses.timestamps_ns),
        mounted=getattr(sensor, "mount", None) is not None,
        **further,
    )


def _intrinsics(sensor: ShootingSensor, *, each_camera_model: bool) -> Intrinsics:
    """The camera models of the images, as far as they can be read: what no image can be made of has none."""
    images = shots_of(sensor)
    camera_models = set()
    for k in range(len(images) if each_camera_model else 0):
        with suppress(DataError):
            camera_models.add(images[k].camera)
    camera_models = camera_models or {sensor.camera}
    table = np.array([(model.fx, model.fy, model.cx, model.cy) for model in camera_models])
    fx, fy, cx, cy = zip(table.min(axis=0).tolist(), table.max(axis=0).tolist(), strict=True)
    return Intrinsics(camera_models=len(camera_models), fx=fx, fy=fy, cx=cx, cy=cy)


def _length(positions: Float64Array) -> float:
    """Length of a trajectory, positions (N, 3) [m]; infinite where numbers are too large."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
