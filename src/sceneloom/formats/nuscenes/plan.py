"""What of a scene goes into the tables of nuScenes, decided before anything is written."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import atan2, degrees, remainder
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.cameras import undistort_scene
from sceneloom.errors import OptionError
from sceneloom.formats.base.loss_list import Losses
from sceneloom.formats.base.losses import Loss, Support, field_losses
from sceneloom.formats.base.output import file_stems
from sceneloom.formats.base.poses import each_mounted, ego_in_world, mounting
from sceneloom.formats.base.written_ego import ego_trajectory
from sceneloom.formats.nuscenes.spec import SUPPORTS
from sceneloom.formats.nuscenes.tables import (
    KEY_FRAMES,
    LogRow,
    Samples,
    SceneRow,
    Written,
    choose_samples,
    timestamps_of,
    token_of,
)
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import CuboidAnnotation, LabeledPointsAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.contents import KINDS
from sceneloom.scene.ego import EgoAxes, check_one_ego, ego_axes
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene

_OF_SENSORS = frozenset({"token", "calibrated_sensor_token", KEY_FRAMES})
OF_FRAMES = frozenset({"file", "token", "sample_token", "is_key_frame"})
_OF_BOXES = frozenset({"tokens"})
_OF_CLASSES = frozenset({"index"})
_OF_SCENES = frozenset({"nuscenes", "sceneloom"})
_WHAT = "the tables have no field for"


def _further_fields(scene: Scene) -> Iterator[Loss]:
    """Name those of sensors, annotations and of the scene itself; of frames the writer reports."""
    for sensor in scene.sensors:
        if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor):
            yield from reported(f"{KINDS[type(sensor)]}.extras", sensor.extras, _OF_SENSORS)
    for annotation in scene.annotations:
        kind = KINDS[type(annotation)]
        if isinstance(annotation, CuboidAnnotation):
            yield from reported(f"{kind}.path.extras", annotation.path.extras, _OF_BOXES)
        elif isinstance(annotation, LabeledPointsAnnotation):
            yield from reported(f"{kind}.extras", annotation.extras, _OF_CLASSES)
    yield from reported("metadata", scene.metadata, _OF_SCENES)


def reported(field: str, names: Iterable[str], known: frozenset[str]) -> Iterator[Loss]:
    """The loss of fields of other names than those that are known."""
    further = sorted(set(names) - known)
    if further:
        yield Loss(field=field, what=f"{_WHAT} {', '.join(further)}")


_VERSION = "v1.0-sceneloom"
"""The name of the folder of tables, where the scene was not read from one."""

_MODALITIES: Mapping[type[Any], str] = {LidarSensor: "lidar", RadarSensor: "radar", CameraSensor: "camera"}

_LIDAR_TOP = "LIDAR_TOP"
"""The channel of the lidar that the renderers of the development kit ask for."""

_LOOKING: Mapping[float, str] = {
    0.0: "CAM_FRONT",
    55.0: "CAM_FRONT_LEFT",
    -55.0: "CAM_FRONT_RIGHT",
    110.0: "CAM_BACK_LEFT",
    -110.0: "CAM_BACK_RIGHT",
    180.0: "CAM_BACK",
}
"""The cameras of nuScenes by the directions in which they look, counter-clockwise from ahead [deg]."""

_NEAR_DEG = 25.0
"""How far a camera may look beside such a direction and have its name."""

_STEEP = np.sin(np.pi / 4)
"""A camera pitched by more than 45 degrees has none of these directions."""


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One sensor of a data set.

    Attributes:
        name: the channel.
        folder: the name of its folders.
        sensor: what is written.
        mount: `ego_from_sensor`; identity where it is not known.
    """

    name: str
    folder: str
    sensor: Written
    mount: RigidTransform

    @property
    def modality(self) -> str:
        """`lidar`, `radar` or `camera`."""
        return _MODALITIES[type(self.sensor)]

    @property
    def token(self) -> str:
        """Of the row in sensor.json."""
        return token_of("sensor", self.name)


@dataclass(frozen=True, slots=True, eq=False)
class WritingPlan:
    """What is written.

    Attributes:
        scene: all of it; camera models are pinholes already.
        version: name of the folder of tables.
        about: rows of scene.json and log.json.
        channels: the sensors.
        samples: the samples.
        ego_path: `world_from_ego`, or None where it is not known.
        losses: what is known to be lost.
    """

    scene: Scene
    version: str
    about: tuple[SceneRow, LogRow]
    channels: tuple[Channel, ...]
    samples: Samples
    ego_path: Poses | None
    losses: Losses = field(default_factory=Losses)

    @classmethod
    def of(
        cls,
        scene: Scene,
        path: Path,
        version: str | None,
        rate_hz: float | None,
        names: Mapping[str, str],
        trajectory: str | None = None,
    ) -> "WritingPlan":
        """Look through a scene.

        Raises:
            CalibrationError: a camera model cannot be computed with.
            OptionError: there is no trajectory of that name.
            PoseError: the trajectory cannot be taken.
            DataError: no sensor has a frame.
        """
        losses = Losses(loss for loss in field_losses(scene, SUPPORTS) if loss.support is Support.DROPPED)
        losses.extend(_further_fields(scene))
        scene = _with_pinholes(scene, losses)
        estimated_trajectory = ego_trajectory(scene) if trajectory is None else None
        if estimated_trajectory is None:
            ego, reported = ego_in_world(scene, name=trajectory)
            estimated_trajectory = None if ego.path.static else ego.path
            losses.extend(reported)
        check_one_ego(scene, estimated_trajectory)
        scene = each_mounted(scene, estimated_trajectory)
        others = max(len(scene.trajectories) - 1, 0)
        losses.dropped("trajectories", "left out: the tables hold one ego trajectory", count=others)
        channels = _channels(scene, estimated_trajectory, losses, names)
        _report_poses(scene, estimated_trajectory, channels, losses)
        about = _about(scene, path)
        samples = choose_samples(scene, [channel.sensor for channel in channels], rate_hz=rate_hz, name=about[0].name)
        return cls(scene, version or _version(scene), about, channels, samples, estimated_trajectory, losses)

    def egos_at(self, timestamps_ns: Int64Array) -> list[RigidTransform]:
        """`world_from_ego` at each time; beyond the trajectory its end poses hold."""
        if self.ego_path is None:
            return [RigidTransform.identity()] * len(timestamps_ns)
        held = self.ego_path.held(timestamps_ns)
        return [
            RigidTransform.from_quaternion(location, rotation)
            for location, rotation in zip(held.positions, held.quaternions_xyzw, strict=True)
        ]

    def beyond(self, timestamps_ns: Int64Array) -> int:
        """How many times are beyond the ego trajectory."""
        path = self.ego_path
        if path is None or path.static:
            return 0
        return int(((timestamps_ns < path.start_ns) | (timestamps_ns > path.stop_ns)).sum())


def _report_poses(
    scene: Scene, estimated_trajectory: Poses | None, channels: Sequence[Channel], losses: Losses
) -> None:
    """Report that poses between frames are not in the tables, of a trajectory of the scene."""
    if estimated_trajectory is None or not any(
        known.timestamps_ns is estimated_trajectory.timestamps_ns for known in scene.trajectories.values()
    ):
        return
    frames = np.concatenate([[0][:0], *(timestamps_of(channel.sensor) for channel in channels)])
    field = "trajectories.positions"
    lost = int((~np.isin(estimated_trajectory.timestamps_ns, frames)).sum())
    losses.dropped(field, "poses between frames are left out", count=lost)
    new = int((~np.isin(frames, estimated_trajectory.timestamps_ns)).sum())
    losses.approximated(field, "poses at frames are found between those that are reported", count=new)


def _with_pinholes(scene: Scene, losses: Losses) -> Scene:
    """Resample the images of other camera models, since all of nuScenes' images are undistorted."""
    bent = [camera for camera in scene.cameras if camera.camera.model != "pinhole" and len(camera.images)]
    if not bent:
        return scene
    for camera in bent:
        what = (
            f"{camera.id!r}: a {camera.camera.model} camera model replaced by a pinhole, and its images "
            f"resampled for it"
        )
        for name in ("camera", "images.rgb", "images.encoded"):
            losses.approximated(f"sensors.camera.{name}", what)
    return undistort_scene(scene, cameras=[camera.id for camera in bent])


def channels_of(scene: Scene, stated: str | Iterable[str] | None) -> Mapping[str, str]:
    """Read what channels sensors are to have, as `lidar=LIDAR_TOP,camera0=CAM_FRONT`.

    Raises:
        OptionError: it is not of that form, or the scene has no such sensor.
    """
    found: dict[str, str] = {}
    known = [str(sensor.id) for sensor in scene.sensors if isinstance(sensor, tuple(_MODALITIES))]
    pairs = (stated or "").split(",") if isinstance(stated, str | None) else stated
    for pair in filter(None, pairs):
        sensor, _, name = (part.strip() for part in pair.rpartition("="))
        if not name or sensor not in known:
            raise OptionError(
                f"channel {pair!r}; expected SENSOR=CHANNEL, such as lidar=LIDAR_TOP, with a sensor out of "
                f"{', '.join(known) or 'none'}"
            )
        found[sensor] = name
    return found


def _channels(
    scene: Scene, estimated_trajectory: Poses | None, losses: Losses, asked: Mapping[str, str]
) -> tuple[Channel, ...]:
    kinds: tuple[type[Any], ...] = tuple(_MODALITIES)
    found: list[Any] = [sensor for kind in kinds for sensor in scene.sensors if isinstance(sensor, kind)]
    losses.extend(
        [
            Loss(field=KINDS[type(sensor)], what=f"{sensor.id!r} has no frame, and is left out")
            for sensor in found
            if not len(timestamps_of(sensor))
        ]
    )
    framed = [sensor for sensor in found if len(timestamps_of(sensor))]
    mounts = [_mount(sensor, estimated_trajectory, losses) for sensor in framed]
    usual = _usual_names(framed, mounts, ego_axes(scene), asked)
    names = _unique([usual.get(k, str(sensor.id)) for k, sensor in enumerate(framed)])
    losses.extend(
        [
            Loss(
                field=f"{KINDS[type(one)]}.id",
                what=f"{one.id!r} becomes channel {name!r}",
                support=Support.CONVERTED,
            )
            for one, name in zip(framed, names, strict=True)
            if str(one.id) != name
        ]
    )
    folders = file_stems(names)
    return tuple(
        Channel(name, folder, sensor, RigidTransform.identity() if mount is None else mount)
        for name, folder, sensor, mount in zip(names, folders, framed, mounts, strict=True)
    )


def _usual_names(
    sensors: Sequence[Any], mounts: Sequence[RigidTransform | None], axes: EgoAxes, asked: Mapping[str, str]
) -> dict[int, str]:
    """Channels other than the ids, by the number of the sensor: those asked for, else those that nuScenes has.

    A lidar becomes LIDAR_TOP, as all renderers of the development kit ask for it; a camera has the name of the
    direction that it alone looks in. Names that a sensor has already are given to no other.
    """
    names = {k: asked[str(one.id)] for k, one in enumerate(sensors) if str(one.id) in asked}
    taken = {*names.values(), *(str(one.id) for one in sensors)}
    free = [k for k in range(len(sensors)) if k not in names and not _has_usual_name(sensors[k])]
    lidars = [k for k in free if isinstance(sensors[k], LidarSensor)]
    lidars.sort(key=lambda k: "top" not in str(sensors[k].id).lower())
    wanted = dict.fromkeys(lidars[:1], _LIDAR_TOP)
    for k in free:
        mount = mounts[k]
        if isinstance(sensors[k], CameraSensor) and mount is not None and axes.known:
            name = _looking(axes.body_from_ego @ mount.rotation[:, 2])
            wanted |= {} if name is None else {k: name}
    counts = Counter(wanted.values())
    return names | {k: name for k, name in wanted.items() if counts[name] == 1 and name not in taken}


def _has_usual_name(sensor: Any) -> bool:
    name = str(sensor.id)
    return name == _LIDAR_TOP if isinstance(sensor, LidarSensor) else name in _LOOKING.values()


def _looking(axis: Float64Array) -> str | None:
    """The channel of a camera by its optical axis on the vehicle (forward, left, up)."""
    if abs(axis[2]) > _STEEP:
        return None
    angle = degrees(atan2(axis[1], axis[0]))
    return next((name for at, name in _LOOKING.items() if abs(remainder(angle - at, 360)) <= _NEAR_DEG), None)


def _unique(names: Sequence[str]) -> list[str]:
    return [name if names.index(name) == k else f"{name}~{k}" for k, name in enumerate(names)]


def _mount(sensor: Any, estimated_trajectory: Poses | None, losses: Losses) -> RigidTransform | None:
    """`ego_from_sensor`; None where it is not known, with a line."""
    mount, lost = mounting(sensor, estimated_trajectory, each=True)
    losses.extend(lost)
    if mount is not None:
        return mount
    what = f"{sensor.id!r}: not known; written as if it were where the ego is"
    losses.approximated(f"{KINDS[type(sensor)]}.mount", what)
    return None


def _kept(scene: Scene, name: str) -> Mapping[str, Any]:
    """What a scene that was read from nuScenes keeps of it."""
    about: Any = scene.metadata.get("nuscenes")
    rows = about.get(name) if isinstance(about, Mapping) else None
    return rows if isinstance(rows, Mapping) else {}


def _version(scene: Scene) -> str:
    about: Any = scene.metadata.get("nuscenes")
    reported = about.get("version") if isinstance(about, Mapping) else None
    return reported if isinstance(reported, str) and is_version(reported) else _VERSION


def is_version(name: str) -> bool:
    """Whether a name may be that of a folder of tables."""
    plain = name.replace(".", "").replace("-", "").replace("_", "")
    return name.startswith("v") and name[1:2].isdigit() and plain.isascii() and plain.isalnum()


def _about(scene: Scene, path: Path) -> tuple[SceneRow, LogRow]:
    reported, log = _kept(scene, "scene"), _kept(scene, "log")
    name = str(reported.get("name") or path.stem)
    row = SceneRow(
        token=str(reported.get("token") or token_of("scene", name)),
        name=name,
        description=str(reported.get("description") or ""),
        log_token=str(log.get("token") or token_of("log", name)),
    )
    fields = {key: str(log.get(key) or "") for key in ("vehicle", "date_captured", "location")}
    return row, LogRow(token=row.log_token, logfile=str(log.get("logfile") or name), **fields)
