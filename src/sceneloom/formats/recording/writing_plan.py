"""What of a scene goes into a recording, found out before anything is written."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import msgspec

from sceneloom.errors import CalibrationError
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.frame_notes import FrameNotes
from sceneloom.formats.recording.kept_texts import SharedText
from sceneloom.formats.recording.trajectories import RANKS
from sceneloom.formats.recording.unreplayable import unreplayable
from sceneloom.formats.recording.unwritten import unwritten
from sceneloom.formats.recording.written_lines import origin_for
from sceneloom.formats.recording.written_mounts import each_mounted, mounting
from sceneloom.formats.recording.written_shots import shooting_sensors
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import ImuSensor, OdometrySensor
from sceneloom.scene.poses import Poses, Trajectory, same_direction
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import check_one_ego
from sceneloom.scene.shooting import ShootingSensor, shots_of
from sceneloom.scene.types import Coordinates


class RecordingNotes(msgspec.Struct):
    """What a scene that was read from a recording keeps of it under `metadata["recording"]`.

    Attributes:
        calibration: all of `calibration.json`.
        vio_config: the text of `vio_config.yaml`.
        other_lines: lines that a scene has no field for.
        other_seconds: by index in `other_lines`, the time of the line before [s], for lines without one.
        further_keys: by stream and key of a row, the text of a line that says more than its sample.
        shared_lines: lines that several streams have a part in.
        trajectory_origins: root key and name of trajectories that were renamed.
        receiver_origins: root key and name of satellite receivers that were renamed.
        sensor_barometer: whether the air pressure came in `sensor` lines.
        frame_lines: of lines of images that are not what would be written else.
    """

    calibration: dict[str, Any] = {}
    vio_config: str | None = None
    other_lines: list[str] = []
    other_seconds: dict[str, float] = {}
    further_keys: dict[str, dict[str, str]] = {}
    shared_lines: list[SharedText] = []
    trajectory_origins: dict[str, tuple[str, str]] = {}
    receiver_origins: dict[str, tuple[str, str]] = {}
    sensor_barometer: bool = False
    frame_lines: FrameNotes | None = None


@dataclass(frozen=True, slots=True, eq=False)
class WritingPlan:
    """What of a scene is written, and what is known beforehand to be lost.

    Attributes:
        cameras: in the order of `cameraInd`.
        lidars: in the order of `lidarInd`.
        mounts: `ego_from_sensor` of the cameras, then of the lidars.
        trajectories: each with the root key and name that it was read under, or None.
        imu: the inertial unit that is written, or None.
        ego_path: `world_from_ego`, or None.
    """

    scene: Scene
    notes: RecordingNotes
    cameras: Sequence[ShootingSensor]
    lidars: Sequence[LidarSensor]
    mounts: Sequence[RigidTransform]
    trajectories: Sequence[tuple[Trajectory, tuple[str, str] | None]]
    imu: ImuSensor | None
    ego_path: Poses | None
    losses: list[Loss] = field(default_factory=list)

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """Look through a scene.

        Raises:
            CalibrationError: nothing says how a camera is mounted.
        """
        notes = _notes(scene)
        trajectories = _trajectories(scene, notes)
        ego_path = _ego_path(scene)
        check_one_ego(scene, ego_path)
        scene = each_mounted(scene, ego_path)
        found = shooting_sensors(scene)
        cameras = [camera for camera in found if len(shots_of(camera))] or found
        losses: list[Loss] = []
        if ego_path is None and not trajectories:
            ego_path = _ride_along([*scene.lidars, *cameras], trajectories, losses)
        imu = _written_imu(scene)
        losses += unwritten(scene, cameras, [trajectory for trajectory, _ in trajectories], imu)
        losses += _of_unplaced(scene, trajectories)
        losses += unreplayable(cameras, scene.lidars, imu, notes.vio_config)
        mounted: list[ShootingSensor | LidarSensor] = [*cameras, *scene.lidars]
        mounts = [_mount(sensor, ego_path, losses) for sensor in mounted]
        return cls(scene, notes, cameras, scene.lidars, mounts, trajectories, imu, ego_path, losses)


def _notes(scene: Scene) -> RecordingNotes:
    try:
        return msgspec.convert(scene.metadata.get("recording", {}), RecordingNotes)
    except msgspec.ValidationError:
        return RecordingNotes()


def _trajectories(scene: Scene, notes: RecordingNotes) -> list[tuple[Trajectory, tuple[str, str] | None]]:
    """The scene's trajectories, and paths of odometry sensors that are none of them."""
    found = list(scene.trajectories.values())
    for sensor in scene.sensors:
        path = sensor.poses if isinstance(sensor, OdometrySensor) else None
        if path is not None and not path.static and not any(same_direction(path, known) for known in found):
            found.append(
                Trajectory(str(sensor.id), path.timestamps_ns, path.positions, path.quaternions_xyzw)
            )
    return [(trajectory, notes.trajectory_origins.get(trajectory.name)) for trajectory in found]


def _ride_along(
    sensors: Sequence[ShootingSensor | LidarSensor],
    trajectories: list[tuple[Trajectory, tuple[str, str] | None]],
    losses: list[Loss],
) -> Poses | None:
    """Take the trajectory of the first sensor that has one for the ego's.

    So that it and the others' locations are not lost.
    """
    for sensor in sensors:
        path = sensor.poses
        if (
            path is None
            or path.static
            or sensor.coordinates is not Coordinates.WORLD
            or sensor.mount is not None
        ):
            continue
        name = str(sensor.id)
        trajectory = Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)
        trajectories.append((trajectory, ("pose", name)))
        what = f"written as trajectory {name!r}, which the ego is taken to follow: the scene has no ego trajectory"
        losses.append(Loss(field=f"sensors[{sensor.id}].poses", what=what, support=Support.CONVERTED))
        return path
    return None


def _of_unplaced(
    scene: Scene, trajectories: Sequence[tuple[Trajectory, tuple[str, str] | None]]
) -> list[Loss]:
    """Report that sensors lose their poses.

    The trajectory that reading takes for the ego trajectory has no orientations.
    """
    posed = sum(getattr(sensor, "poses", None) is not None for sensor in scene.sensors)
    ranked = sorted(
        trajectories, key=lambda pair: RANKS.get((pair[1] or origin_for(pair[0].name))[0], len(RANKS))
    )
    if not posed or (ranked and ranked[0][0].quaternions_xyzw is not None):
        return []
    what = "left out: there is no trajectory of the ego with orientations that recordings location sensors by"
    return [Loss(field="sensors[].poses", what=what, count=posed)]


def _written_imu(scene: Scene) -> ImuSensor | None:
    """The inertial unit that is written: the first that measures what the vendor's software needs, else the first."""
    units = [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor)]
    whole = [unit for unit in units if {"accelerometer", "gyroscope"} <= set(unit.streams)]
    return next(iter([*whole, *units]), None)


def _ego_path(scene: Scene) -> Poses | None:
    oriented = (known.poses for known in scene.trajectories.values() if known.quaternions_xyzw is not None)
    odometry = (sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor))
    return next(oriented, None) or next(odometry, None)


def _mount(
    sensor: ShootingSensor | LidarSensor, ego_path: Poses | None, losses: list[Loss]
) -> RigidTransform:
    mount, lost = mounting(sensor, ego_path, each=True)
    losses.extend(lost)
    if mount is not None:
        return mount
    if not isinstance(sensor, LidarSensor):
        raise CalibrationError(
            f"camera {sensor.id!r}: nothing says how it is mounted on the vehicle (neither a mounting, nor poses of "
            "both it and the ego), and a recording cannot be without imuToCamera"
        )
    what = "taken to be where the IMU is, with the same axes: nothing says how it is mounted"
    losses.append(Loss(field=f"sensors[{sensor.id}].mount", what=what))
    return RigidTransform.identity()
