"""What a recording has no field for, found in a scene before it is written."""

from collections.abc import Iterator, Sequence

from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.written_shots import shooting_sensors
from sceneloom.scene.clouds import PointsSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.shooting import ShootingSensor

_NO_POSITION = "left out: the format has none"
_RECORDING_EXTRAS = {"calibration", "lidarInd"}


def unwritten(
    scene: Scene,
    cameras: Sequence[ShootingSensor],
    trajectories: Sequence[Trajectory],
    imu: ImuSensor | None,
) -> list[Loss]:
    """Name everything of a scene that its recording will not hold.

    Args:
        scene: what is written.
        cameras: those of its cameras that are written.
        trajectories: what is written as trajectories.
        imu: the inertial unit that is written.
    """
    return [
        *_of_root(scene),
        *(loss for sensor in scene.sensors for loss in _of_sensor(sensor)),
        *_of_odometry(scene, trajectories),
        *_of_cameras(scene, cameras),
        *_of_repeated(scene, imu),
        *_of_ids(scene, cameras, imu),
        *_of_order(scene, cameras, imu),
        *_of_antennas(scene),
        *_of_default(scene, trajectories),
    ]


def _of_root(scene: Scene) -> Iterator[Loss]:
    counts = {
        "annotations": len(scene.annotations),
        "attributes": len(scene.attributes),
        **{f"metadata.{name}": 1 for name in scene.metadata if name != "recording"},
        **{f"extras.{name}": 1 for name in scene.extras},
    }
    yield from (Loss(field=name, what=_NO_POSITION, count=count) for name, count in counts.items() if count)


def _of_sensor(sensor: Sensor) -> Iterator[Loss]:
    if isinstance(sensor, RadarSensor | PointsSensor | PlainSensor):
        yield Loss(field=f"sensors[{sensor.id}]", what=_NO_POSITION)
        return
    for name in sensor.extras:
        if name not in _RECORDING_EXTRAS:
            yield Loss(field=f"sensors[{sensor.id}].{name}", what=_NO_POSITION)
    if sensor.parent_id is not None:
        yield Loss(field=f"sensors[{sensor.id}].parent_id", what=_NO_POSITION)


def _of_odometry(scene: Scene, trajectories: Sequence[Trajectory]) -> Iterator[Loss]:
    """The format knows no sensors of the ego's own motion, but trajectories."""
    names = {trajectory.name for trajectory in trajectories} - set(scene.trajectories)
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor):
            written = f"written as trajectory {str(sensor.id)!r}"
            if sensor.poses.static:
                written = "left out: the format has no path without end"
            elif str(sensor.id) not in names:
                written = "left out: a trajectory says the same"
            left_out = written.startswith("left out")
            yield Loss(
                field=f"sensors[{sensor.id}]",
                what=written,
                support=Support.DROPPED if left_out else Support.CONVERTED,
            )


def _of_cameras(scene: Scene, cameras: Sequence[ShootingSensor]) -> Iterator[Loss]:
    for camera in shooting_sensors(scene):
        if camera not in cameras:
            yield Loss(
                field=f"sensors[{camera.id}]", what="left out: it has no images, while other cameras have"
            )


def _of_repeated(scene: Scene, imu: ImuSensor | None) -> Iterator[Loss]:
    for sensor in [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor) and sensor is not imu]:
        yield Loss(field=f"sensors[{sensor.id}]", what=f"left out: the format has one {sensor.type} only")


def _of_ids(scene: Scene, cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    """The ids that reading gives differ from the scene's: the format knows sensors by number only."""
    lidars = scene.lidars
    names: dict[str, Sequence[Sensor]] = {
        "camera": cameras,
        "lidar": lidars,
        "imu": [] if imu is None else [imu],
        "gnss": main_receiver([sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]),
    }
    for name, sensors in names.items():
        for index, sensor in enumerate(sensors):
            numbered = name == "camera" or (name == "lidar" and len(lidars) > 1)
            found = f"{name}{index}" if numbered else name
            if sensor.id != found:
                yield Loss(field=f"sensors[{sensor.id}].id", what=f"read back as {found!r}")


def _of_order(scene: Scene, cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    receivers = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    found = [sensor.id for sensor in (*scene.lidars, *cameras, *([] if imu is None else [imu]), *receivers)]
    if found != [sensor.id for sensor in scene.sensors if sensor.id in found]:
        what = "read back in another order: lidars, cameras, those of depth last, IMU, satellite receivers"
        yield Loss(field="sensors", what=what)


def _of_antennas(scene: Scene) -> Iterator[Loss]:
    """The locations of antennas but that of the one receiver for which the format has a field."""
    found = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    for sensor in found:
        if sensor.mount is not None and sensor not in main_receiver(found):
            yield Loss(field=f"sensors[{sensor.id}].mount", what=_NO_POSITION)


def main_receiver(receivers: Sequence[GnssSensor]) -> list[GnssSensor]:
    """Give the one whose lines are `gps` lines: the one that is called so, else the first that has no other name."""
    others = [sensor for sensor in receivers if sensor.id != "rtkgps"]
    return [sensor for sensor in others if sensor.id == "gnss"][:1] or others[:1]


def _of_default(scene: Scene, trajectories: Sequence[Trajectory]) -> Iterator[Loss]:
    default = next(iter(scene.trajectories), None)
    names = [trajectory.name for trajectory in trajectories]
    if default != "groundTruth" and "groundTruth" in names:
        yield Loss(field="trajectories.order", what=f"read back with 'groundTruth' first, not {default!r}")
    for trajectory in trajectories:
        if trajectory.covariances is not None:
            yield Loss(field=f"trajectories.{trajectory.name}.covariances", what=_NO_POSITION)
