"""Brings a rig and a drive together: whose each frame and camera is, where it is on the ego, and what is missing."""

import re
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.poses import default_poses
from sceneloom.formats.rig_files.reader import Rig, RigCamera, RigTransform
from sceneloom.geometry.rigid import RigidTransform, angle_between
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, shots_of, with_shots
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import poses_along
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Coordinates, Identifier
from sceneloom.warnings import WarningKind

EGO_FRAMES = ("base_link", "ego", "ego_vehicle", "base_footprint", "vehicle", "base", "body")
"""What the frame of a vehicle is called, the likeliest first. Source: REP 105 for the first."""

_EGO = "ego"  # what a person calls the ego's frame in a statement of names
_OPTICAL = re.compile(r"(.*?)_optical(_link|_frame)?$")
_BODY_FROM_OPTICAL = RigidTransform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""Source: REP 103, "Suffix Frames": x forward, y left, z up from z forward, x right, y down."""

_UPRIGHT = 0.7071  # cosine of 45 degrees
_AGREEMENT_RAD, _AGREEMENT_M = 2e-3, 0.01
"""Two chains between the same frames may differ by this much, which rounding in files comes to."""

_RATIO_ERROR = 0.01


@dataclass(frozen=True, slots=True)
class RigSensor:
    """What a drive knows of one of its sensors; frame and topic of its messages are "" where it has none."""

    id: Identifier
    is_camera: bool
    frame: str = ""
    topic: str = ""

    @property
    def own_frame(self) -> str:
        """The frame of its messages, else its id."""
        return self.frame or str(self.id)


def match_cameras(rig: Rig, sensors: Sequence[RigSensor]) -> dict[Identifier, RigCamera]:
    """Find the camera model of each camera of a drive in a rig: by what a person stated, by topic, by name.

    One camera model that is left over is taken for the only camera, with a warning.

    Raises:
        OptionError: a stated name is not in the rig, or a stated sensor not in the drive.
    """
    _check_stated(rig, sensors)
    cameras = [sensor for sensor in sensors if sensor.is_camera]
    found: dict[Identifier, RigCamera] = {}
    for sensor in cameras:
        stated = rig.stated.get(str(sensor.id))
        names = (
            {stated} if stated else {str(sensor.id), sensor.own_frame, _bare(sensor.topic), *_named_by(sensor.topic)}
        )
        by_name = [one for one in rig.cameras if names & {*one.names, *(_named_by(one.topic) if not stated else ())}]
        by_topic = [one for one in rig.cameras if not stated and one.topic and _same_topic(one.topic, sensor.topic)]
        several = by_topic or by_name
        if len(several) == 1:
            found[sensor.id] = several[0]
        elif several:
            where = ", ".join(one.location for one in several)
            message = (
                f"camera {str(sensor.id)!r} could be that of {where}; state which with `--rig-name {sensor.id}=NAME`"
            )
            rig.ledger.note(WarningKind.SKIPPED, "rig-camera-ambiguous", rig.files[0], message)
    left = [one for one in rig.cameras if one not in found.values()]
    if len(left) == 1 and len(cameras) == 1 and not found:
        found[cameras[0].id] = left.pop()
        message = f"its camera {found[cameras[0].id].names[0]!r} is taken for the only camera {str(cameras[0].id)!r}"
        rig.ledger.note(WarningKind.ASSUMED, "rig-camera-taken", found[cameras[0].id].location, message)
    for one in left:
        called = " or ".join(map(repr, one.names))
        message = f"camera {called} is none of the drive's; name it with `--rig-name SENSOR={one.names[0]}`"
        rig.ledger.note(WarningKind.SKIPPED, "rig-camera-unused", one.location, message)
    return found


def _check_stated(rig: Rig, sensors: Sequence[RigSensor]) -> None:
    ids = [_EGO, *(str(sensor.id) for sensor in sensors)]
    known = [*rig.frames, *(name for camera in rig.cameras for name in camera.names)]
    for name, value in rig.stated.items():
        if name not in ids:
            raise OptionError(f"rig name {name}={value}: no sensor {name!r}; expected one of {', '.join(ids)}")
        if value not in known:
            raise OptionError(
                f"rig name {name}={value}: no frame or camera {value!r}; expected one of {', '.join(known)}"
            )


def _bare(name: str) -> str:
    return name.strip("/")


def _named_by(topic: str) -> set[str]:
    """The sensor that a topic names: all of it but its last part, or the one before."""
    parts = _bare(topic).split("/")
    return {"/".join(parts[:-k]) for k in (1, 2) if len(parts) > k}


def _same_topic(one: str, other: str) -> bool:
    """Whether two topics are of the same messages, compressed or not."""
    a, b = _bare(one), _bare(other)
    return bool(a and b) and (a == b or a.startswith(f"{b}/") or b.startswith(f"{a}/"))


def match_frames(
    rig: Rig, sensors: Sequence[RigSensor], cameras: Mapping[Identifier, RigCamera], others: Collection[str] = ()
) -> list[RigTransform]:
    """Give the transforms of a rig, with those that make its frames the frames of a drive's sensors.

    Frames of one name are the same; else a frame is a sensor's if a person stated so, or, with a warning, if it is that
    of the camera's model, has the sensor's topic or id, or is its optical frame without the suffix.

    Args:
        rig: the rig, not without transforms.
        sensors: of the drive.
        cameras: camera models of the drive's cameras, as `match_cameras` found them.
        others: further frames that the drive knows.

    Raises:
        OptionError: none of the frames is one of the drive's, or the ego's only.
        DataError: transforms contradict one another.
    """
    frames, found = {_bare(frame): frame for frame in rig.frames}, [*rig.transforms]
    matched = {_bare(name) for name in others} & {*frames}
    tops = _from_top(rig.transforms)
    for sensor in sensors:
        wanted, source, why = sensor.own_frame, None, ""
        stated = rig.stated.get(str(sensor.id))
        camera = cameras.get(sensor.id)
        by_camera = next((name for name in camera.names if name in rig.frames), None) if camera is not None else None
        by_topic = next(
            (
                frame
                for frame, topic in rig.topics.items()
                if _same_topic(topic, sensor.topic) or str(sensor.id) in _named_by(topic)
            ),
            None,
        )
        optical = _OPTICAL.fullmatch(wanted)
        suffixes = [f"{optical[1]}{suffix}" for suffix in ("_link", "_frame", "")] if optical else []
        if stated in frames.values():
            source = stated
        elif _bare(wanted) in frames:
            source = frames[_bare(wanted)]
        elif by_topic is not None and by_topic in frames.values():
            source, why = by_topic, f"by its topic {rig.topics[by_topic]}"
        elif by_camera is not None:
            source, why = by_camera, "as its camera model is"
        elif str(sensor.id) in frames:
            source, why = str(sensor.id), "by the sensor's id"
        elif body := next((frames[_bare(name)] for name in suffixes if _bare(name) in frames), None):
            pose = _BODY_FROM_OPTICAL
            found.append(RigTransform(body, wanted, pose, f"{wanted!r} by REP 103"))
            message = (
                f"frame {wanted!r} of {str(sensor.id)!r} is taken as {body!r} with optical axes, as REP 103 has it"
            )
            rig.ledger.note(WarningKind.ASSUMED, "rig-frame-optical", rig.files[0], message)
            matched.add(_bare(body))
        if source is None:
            continue
        matched.add(_bare(source))
        rig.optical.update({wanted} if source in rig.optical else ())
        if source != wanted:
            if wanted not in {one.child for one in found}:
                upright = sensor.is_camera and sensor.frame and _is_upright(rig, source, tops.get(source))
                pose = _BODY_FROM_OPTICAL if upright else RigidTransform.identity()
                found.append(RigTransform(source, wanted, pose, f"{source!r} is {wanted!r}"))
            if why:
                message = f"frame {source!r} is taken for {wanted!r} of sensor {str(sensor.id)!r}, {why}"
                rig.ledger.note(WarningKind.ASSUMED, "rig-frame-taken", rig.files[0], message)
    if not matched or (len(matched) == 1 and matched <= {*EGO_FRAMES} and not cameras):
        known = ", ".join(dict.fromkeys(repr(sensor.own_frame) for sensor in sensors)) or "none"
        raise OptionError(
            f"{' + '.join(rig.files)}: none of its frames ({', '.join(rig.frames)}) is one of the drive's ({known}); "
            "state which is which with `--rig-name SENSOR=FRAME`"
        )
    return found


def oriented(transforms: Sequence[RigTransform], roots: Iterable[str]) -> list[RigTransform]:
    """Orient connected transforms as a forest, parents before children.

    Args:
        transforms: between frames, in any direction.
        roots: frames that come first; in what they do not reach, frames that are no child.

    Raises:
        DataError: two chains between the same frames contradict each other.
    """
    children = {one.child for one in transforms}
    frames = list(dict.fromkeys(name for one in transforms for name in (one.parent, one.child)))
    near: dict[str, list[RigTransform]] = {frame: [] for frame in frames}
    for one in transforms:
        near[one.parent].append(one)
        near[one.child].append(RigTransform(one.child, one.parent, one.parent_from_child.inverse(), one.location))
    root_from: dict[str, RigidTransform] = {}
    found: list[RigTransform] = []
    for root in [
        *(name for name in roots if name in near),
        *(name for name in frames if name not in children),
        *frames,
    ]:
        if root in root_from:
            continue
        root_from[root] = RigidTransform.identity()
        waiting = deque([root])
        while waiting:
            parent = waiting.popleft()
            for one in near[parent]:
                pose = root_from[parent] @ one.parent_from_child
                if one.child not in root_from:
                    root_from[one.child] = pose
                    found.append(one)
                    waiting.append(one.child)
                    continue
                distance, angle = _apart(pose, root_from[one.child])
                if distance > _AGREEMENT_M or angle > _AGREEMENT_RAD:
                    file, _, place = one.location.partition(": ")
                    between = f"contradicts the other transforms between {one.parent!r} and {one.child!r}"
                    raise DataError(file, place, f"{between} by {distance:.3g} m and {np.degrees(angle):.3g}°")
    return found


def _apart(a: RigidTransform, b: RigidTransform) -> tuple[float, float]:
    """How far two transforms are from one another [m, rad]."""
    distance = float(np.linalg.norm(a.translation - b.translation))
    return distance, float(angle_between(a.quaternion_xyzw, b.quaternion_xyzw))


def note_replaced(rig: Rig, what: str, stated: RigidTransform, pose: RigidTransform) -> None:
    """Report that a mounting of the rig replaces one of the drive, by how much."""
    distance, angle = _apart(stated, pose)
    if distance > 1e-6 or angle > 1e-6:
        message = (
            f"the rig replaces the mounting of {what}: moved by {distance:.3g} m, rotated by {np.degrees(angle):.3g}°"
        )
        rig.ledger.note(WarningKind.ASSUMED, "rig-replaces", rig.files[0], message)


def lacking(sensor: RigSensor, ego: str) -> str:
    """Report that a sensor's extrinsics are missing, with the lines to write."""
    frame = sensor.own_frame
    return (
        f"no extrinsics of sensor {str(sensor.id)!r} (frame {frame!r}): state them with `--rig FILE`, in a URDF as "
        f'<joint name="{frame}_joint" type="fixed"><parent link="{ego}"/><child link="{frame}"/>'
        '<origin xyz="X Y Z" rpy="R P Y"/></joint>, or in a rig.toml as transforms = '
        f'[{{ from = "{frame}", to = "{ego}", translation = [X, Y, Z], quaternion_xyzw = [X, Y, Z, W] }}]'
    )


def fitted_camera(rig: Rig, camera_id: Identifier, found: RigCamera, size: tuple[int, int]) -> Camera:
    """Give a camera model of a rig for the images as they are, with a warning where it is for another size.

    Raises:
        OptionError: the images have another shape.
    """
    camera = found.camera
    if (camera.width, camera.height) == size:
        return camera
    sizes = f"{camera.width}x{camera.height}, the images of {str(camera_id)!r} are {size[0]}x{size[1]}"
    if abs((size[0] / camera.width) / (size[1] / camera.height) - 1.0) > _RATIO_ERROR:
        raise OptionError(
            f"{found.location}: for {sizes}, another shape; expected a calibration of the images as they are"
        )
    message = f"the calibration is for {sizes}; the camera model was scaled"
    rig.ledger.note(WarningKind.REPAIRED, "camera-model-scaled", found.location, message)
    return camera.resized(*size)


# Drives whose readers know no frames


def ego_frame(rig: Rig, transforms: Sequence[RigTransform]) -> str | None:
    """The frame of a rig that is the ego's: the stated one, one of the usual names, else None."""
    frames = {name for one in transforms for name in (one.parent, one.child)}
    stated = rig.stated.get(_EGO)
    return stated or next((name for name in EGO_FRAMES if name in frames), None)


def with_rig(scene: Scene, rig: Rig) -> Scene:
    """Give the scene with the mountings and camera models of a rig, whose frames are the sensors' ids or are named so.

    Raises:
        OptionError: nothing of the rig is the drive's, or it is not known which frame is the ego's.
        DataError: transforms contradict one another.
    """
    sensors = [RigSensor(one.id, isinstance(one, CameraSensor | DepthCameraSensor)) for one in scene.sensors]
    cameras = match_cameras(rig, sensors)
    ego, ego_from = _ego_from(scene, rig, sensors, cameras) if rig.transforms else ("base_link", {})
    if not (cameras or ego_from):
        raise OptionError(f"{' + '.join(rig.files)}: nothing of it is of a sensor of the drive")
    path = default_poses(scene.trajectories, scene.source, rig.ledger) if ego_from else None
    changed = []
    for sensor, known in zip(scene.sensors, sensors, strict=True):
        one: Any = sensor
        if sensor.id in cameras and isinstance(sensor, CameraSensor | DepthCameraSensor):
            size = sensor.camera.width, sensor.camera.height
            one = _with_camera(one, fitted_camera(rig, sensor.id, cameras[sensor.id], size))
        if isinstance(sensor, _MOUNTED):
            pose = ego_from.get(known.own_frame)
            if pose is not None:
                name = rig.stated.get(str(sensor.id), known.own_frame)
                if known.is_camera and _is_upright(rig, name, pose):
                    pose = pose @ _BODY_FROM_OPTICAL
                one = _mounted(rig, known, one, pose, path)
            elif sensor.mount is None and not isinstance(sensor, GnssSensor) and sensor.poses is None:
                rig.ledger.note(WarningKind.SKIPPED, "frames-missing", scene.source, lacking(known, ego))
        changed.append(one)
    return replace(scene, sensors=tuple(changed), warnings=(*rig.ledger.warnings, *scene.warnings))


_MOUNTED = (LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor, GnssSensor)


def _ego_from(
    scene: Scene, rig: Rig, sensors: Sequence[RigSensor], cameras: Mapping[Identifier, RigCamera]
) -> tuple[str, dict[str, RigidTransform]]:
    """The ego's frame in a rig, and `ego_from_frame` of all frames that are connected with it."""
    transforms = match_frames(rig, sensors, cameras)
    ego = ego_frame(rig, transforms)
    if ego is None:
        # frames of sensors that the drive has placed lead to its ego
        frames = {name for one in transforms for name in (one.parent, one.child)}
        placed = {
            str(one.id): one.mount for one in scene.sensors if isinstance(one, _MOUNTED) and one.mount is not None
        }
        known = next((name for name in placed if name in frames), None)
        children = {one.child for one in transforms}
        tops = [name for name in rig.frames if name not in children]
        if known is not None:
            ego, mount = "base_link", placed[known]
            transforms = [*transforms, RigTransform(ego, known, mount, f"mounting of {known!r} in the drive")]
        elif len(tops) == 1:
            ego = tops[0]
            message = f"frame {ego!r} is taken as the ego's; state another with `--rig-name ego=FRAME`"
            rig.ledger.note(WarningKind.ASSUMED, "rig-ego-taken", rig.files[0], message)
        else:
            raise OptionError(
                f"{' + '.join(rig.files)}: which frame is the ego's? State it with `--rig-name ego=FRAME`; "
                f"the topmost are {', '.join(tops)}"
            )
    found = {ego: RigidTransform.identity()}
    for one in oriented(transforms, [ego]):
        if one.parent in found:
            found[one.child] = found[one.parent] @ one.parent_from_child
    return ego, found


def _is_upright(rig: Rig, name: str, pose: RigidTransform | None) -> bool:
    """Whether the frame of a camera has the axes of a body, which an upright z axis shows; it is reported."""
    if name in rig.optical or "optical" in name or pose is None or pose.rotation[2, 2] < _UPRIGHT:
        return False
    message = f"frame {name!r} of a camera is upright: its x axis is taken as the optical axis (REP 103)"
    rig.ledger.note(WarningKind.ASSUMED, "rig-frame-upright", rig.files[0], message)
    return True


def _from_top(transforms: Sequence[RigTransform]) -> dict[str, RigidTransform]:
    """`top_from_frame` of all frames below the topmost ones."""
    found: dict[str, RigidTransform] = {}
    for one in oriented(transforms, ()):
        found[one.child] = found.get(one.parent, RigidTransform.identity()) @ one.parent_from_child
    return found


def _mounted(rig: Rig, known: RigSensor, sensor: Any, mount: RigidTransform, path: Any) -> Any:
    """The sensor with another mounting, and poses along the trajectory by it."""
    if sensor.mount is not None:
        note_replaced(rig, f"sensor {str(sensor.id)!r}", sensor.mount, mount)
    if isinstance(sensor, GnssSensor):
        return replace(sensor, mount=mount)
    times = frame_times(sensor)
    if known.is_camera:
        sensor = with_shots(sensor, shots_of(sensor).mapped(_without_mount), sensor.video)
    if path is None or not len(times) or (sensor.poses is not None and sensor.mount is None):
        return replace(sensor, mount=mount)  # poses that no mounting led to stay
    poses = poses_along(path, {0: mount}, np.zeros(len(times), np.int64), times)
    return replace(sensor, mount=mount, poses=poses, coordinates=Coordinates.WORLD)


def _without_mount(shot: Any) -> Any:
    return shot if shot.mount is None else replace(shot, mount=None)


def _with_camera(sensor: Any, camera: Camera) -> Any:
    changed = with_shots(sensor, shots_of(sensor).mapped(partial(_shot_with, camera)), sensor.video)
    return replace(changed, camera=camera)


def _shot_with(camera: Camera, shot: Any) -> Any:
    size = shot.camera.width, shot.camera.height
    return replace(shot, camera=camera if size == (camera.width, camera.height) else camera.resized(*size))
