"""Write the lidar frames of a scene as files of points."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.move_world import points_change, to_ego, to_sensor, to_world
from sceneloom.errors import OptionError, PoseError
from sceneloom.formats.base.losses import Loss, LossReport, Support, field_losses
from sceneloom.formats.base.output import FolderKind, file_stems, replacing
from sceneloom.formats.base.poses import ego_in_world
from sceneloom.formats.points.files import FRAME_WRITERS, LossTaker, frame_columns, left_out
from sceneloom.formats.points.reader import name_of_time
from sceneloom.formats.points.spec import (
    DEFAULT_ID,
    EGO_POSES,
    ENCODINGS,
    SENSOR_POSES,
    CloudKind,
    supports_of,
)
from sceneloom.motion.ego_trajectory import IDENTITY, is_computed, with_trajectory_estimated
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.ego import EgoMotion, is_on_ego, named_odometry, sensor_source
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Coordinates, PointsFrame

_MOVES: Mapping[PointsFrame, Callable[..., Scene]] = MappingProxyType(
    {PointsFrame.SENSOR: to_sensor, PointsFrame.EGO: to_ego, PointsFrame.WORLD: to_world}
)

_WRITTEN = {"file", "dropped_points", "clipped_intensities"}
"""Further fields of frames that only state from which file they were read, and how."""


@dataclass(frozen=True, slots=True)
class CloudSaving:
    """How clouds are to be written.

    Attributes:
        frame: "sensor", "ego" or "world", the frame of the points; None: the one that they are in.
        encoding: of PCD files: "binary", "ascii" or "binary_compressed".
        lidar: id of the only lidar to be written, as text; None for all.
        trajectory: name of the ego's, as of `ego_in_world`, where another frame of the points needs it.
    """

    frame: str | None = None
    encoding: str = ENCODINGS[0]
    lidar: str | None = None
    trajectory: str | None = None

    def __post_init__(self) -> None:
        if self.frame is not None and self.frame not in tuple(PointsFrame):
            raise OptionError(f"frame {self.frame!r}; expected one of {', '.join(PointsFrame)}")
        if self.encoding not in ENCODINGS:
            raise OptionError(f"encoding {self.encoding!r}; expected one of {', '.join(ENCODINGS)}")


def write_clouds(scene: Scene, path: Path, *, kind: CloudKind, overwrite: bool = False, **options: str) -> LossReport:
    """Write each frame of each lidar to a file; a path with the kind's ending takes a scene of one frame.

    Raises:
        OptionError: there is no lidar of that id, no frame at all, or there are several for one file.
        PoseError: the poses that another frame of the points needs are not known.
        OutputError: the output exists, or cannot be written.
    """
    saving = CloudSaving(**options)
    losses = list(_of_fields(scene, kind))
    asked = _chosen(scene, saving.lidar)
    if saving.frame is not None and any(lidar.points_frame != saving.frame for lidar in asked):
        scene, reported = _in_frame(scene, asked, PointsFrame(saving.frame), saving.trajectory)
        losses += reported
    elif saving.trajectory is not None:
        raise OptionError(
            f"trajectory {saving.trajectory!r}: the points stay in the frame that they are in, which needs none; "
            "expected another frame, such as `frame=world`"
        )
    lidars = _chosen(scene, saving.lidar)
    losses += [
        Loss(field=f"sensors[{lidar.id}]", what="left out: another lidar was asked for")
        for lidar in scene.lidars
        if lidar not in lidars
    ]
    write = partial(_write_frame, kind=kind, saving=saving, notify=losses.append)
    if path.name.lower().endswith(kind.endings[1:]):
        raise OptionError(f"{path}: written as {kind.endings[0]} only; {path.suffix} has one array and no names")
    if kind.has_name(path.name):
        _write_file(lidars, path, write, overwrite=overwrite, losses=losses)
    else:
        _write_folder(scene, lidars, path, kind, write, overwrite=overwrite, losses=losses)
    return LossReport.of(losses)


def _in_frame(
    scene: Scene, lidars: list[LidarSensor], frame: PointsFrame, trajectory: str | None
) -> tuple[Scene, list[Loss]]:
    """Bring the points of lidars into a frame, along a trajectory where that needs one.

    Raises:
        PoseError: the poses that this needs are not known.
    """
    odometries = [sensor for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
    others = [lidar for lidar in scene.lidars if lidar not in lidars]
    part = replace(scene, sensors=(*lidars, *odometries), annotations=())
    move, losses = _MOVES[frame], list[Loss]()
    known = any(trajectory.quaternions_xyzw is not None for trajectory in scene.trajectories.values())
    if trajectory is not None or known or any(_needs_trajectory(part, lidar, frame) for lidar in lidars):
        ego, losses = ego_in_world(scene, name=trajectory)
        part = with_trajectory_estimated(part, ego) if is_computed(scene, ego.name) else part
        by_default = trajectory is None and next(iter(part.trajectories), None) == ego.name
        part = move(part, trajectory=None if by_default else ego.name)
    else:
        # nothing says where the ego was, nor need it be known: no poses of it are made up
        placed = (_by_own_poses(lidar, frame) for lidar in lidars)
        moved = move(replace(part, sensors=(*placed, *odometries)), trajectory=IDENTITY)
        part = replace(part, sensors=(*moved.lidars, *odometries))
    return replace(part, sensors=(*part.sensors, *others)), losses


def _needs_trajectory(scene: Scene, lidar: LidarSensor, frame: PointsFrame) -> bool:
    try:
        points_change(scene, lidar, None, frame, reach_ns=0)
    except PoseError:
        return True
    return False


def _by_own_poses(lidar: LidarSensor, frame: PointsFrame) -> LidarSensor:
    """A lidar without the mounting, where its own poses in the world state more."""
    in_world = PointsFrame.WORLD in {frame, lidar.points_frame}
    return replace(lidar, mount=None) if in_world and lidar.poses is not None else lidar


def _of_fields(scene: Scene, kind: CloudKind) -> Iterator[Loss]:
    """What becomes of the scene, but for what depends on the frames, and for what this scene does not have."""
    table = dict(supports_of(kind.name))
    for name in ("id", "coordinates", "points_frame", "poses", "mount", "extras"):
        table.pop(f"sensors.lidar.{name}", None)
    yield from field_losses(scene, table)
    for lidar in scene.lidars:
        if lidar.mount is not None and not np.array_equal(lidar.mount.matrix, np.eye(4)):
            what = "left out: the poses beside the clouds state where they are in the world"
            yield Loss(field=f"sensors[{lidar.id}].mount", what=what)
        further = [name for name in lidar.extras if name != "intensity_max"]
        if further:
            what = f"left out: files of points state nothing of the device: {', '.join(further)}"
            yield Loss(field=f"sensors[{lidar.id}].extras", what=what)


def _chosen(scene: Scene, lidar: str | None) -> list[LidarSensor]:
    found = [one for one in scene.lidars if lidar is None or str(one.id) == lidar]
    if not found or not any(len(one.frames) for one in found):
        known = ", ".join(repr(str(one.id)) for one in scene.lidars) or "none"
        asked = "no frames of a lidar" if lidar is None else f"no frames of a lidar {lidar!r}"
        raise OptionError(f"{scene.source}: {asked} to be written as points; its lidars: {known}")
    return found


_FrameWriter = Callable[[LidarSensor, int, Path], None]


def _write_file(
    lidars: list[LidarSensor], path: Path, write: _FrameWriter, *, overwrite: bool, losses: list[Loss]
) -> None:
    count = sum(len(lidar.frames) for lidar in lidars)
    if count != 1:
        raise OptionError(
            f"{path}: one file for {count} frames; write a folder: a name without `{path.suffix}`, and the format"
        )
    lidar = next(one for one in lidars if len(one.frames))
    with replacing(path, overwrite=overwrite) as draft:
        write(lidar, 0, draft)
    timestamp_ns, location = int(lidar.frames.timestamps_ns[0]), f"sensors[{lidar.id}]"
    if timestamp_ns:
        losses.append(
            Loss(field=f"{location}.frames.timestamp_ns", what="left out: a single file has a name of its own")
        )
    if lidar.poses is not None:
        losses.append(Loss(field=f"{location}.poses", what="left out: a single file has no file of poses beside it"))
    losses += _of_names([lidar], alone=True)


def _write_folder(
    scene: Scene,
    lidars: list[LidarSensor],
    path: Path,
    kind: CloudKind,
    write: _FrameWriter,
    *,
    overwrite: bool,
    losses: list[Loss],
) -> None:
    written = [lidar for lidar in lidars if len(lidar.frames)]
    losses += [
        Loss(field=f"sensors[{one.id}]", what="left out: it has no frames") for one in lidars if one not in written
    ]
    losses += _of_names(written, alone=len(written) == 1)
    with replacing(path, overwrite=overwrite, folder=_folder_kind(kind)) as draft:
        for lidar, stem in zip(written, file_stems(one.id for one in written), strict=True):
            folder = draft if len(written) == 1 else draft / stem
            folder.mkdir(exist_ok=True)
            times = _distinct_times(lidar, losses)
            for k, time_ns in enumerate(times.tolist()):
                write(lidar, k, folder / f"{name_of_time(time_ns)}{kind.endings[0]}")
            losses += _write_poses(scene, lidar, times, folder)


def _folder_kind(kind: CloudKind) -> FolderKind:
    """What a folder of such files holds that was written here: one for each time, and where their frame was."""
    names = (rf"-?\d{{19}}{re.escape(kind.endings[0])}", *map(re.escape, (EGO_POSES, SENSOR_POSES)))
    return FolderKind(
        f"folder of {kind.endings[0]} files named by their times",
        (*names, *(rf".+/{name}" for name in names)),
    )


def _of_names(lidars: list[LidarSensor], *, alone: bool) -> list[Loss]:
    """The ids that reading gives differ from the scene's."""
    return [
        Loss(field=f"sensors[{one.id}].id", what=f"read back as {found!r}", support=Support.CONVERTED)
        for one in lidars
        if one.id != (found := DEFAULT_ID if alone else str(one.id))
    ]


def _distinct_times(lidar: LidarSensor, losses: list[Loss]) -> Int64Array:
    """The times of the frames, which names can be made of: equal ones are put a nanosecond apart."""
    times = lidar.frames.timestamps_ns
    later = np.arange(len(times))
    distinct = np.maximum.accumulate(times - later) + later
    moved = np.flatnonzero(distinct != times)
    if len(moved):
        losses.append(
            Loss(
                field=f"sensors[{lidar.id}].frames.timestamp_ns",
                what="frames of one time put 1 ns apart, which their names need",
                count=len(moved),
                support=Support.APPROXIMATED,
                largest_error=float((distinct - times).max()),
            )
        )
    return np.asarray(distinct, np.int64)


def _write_frame(
    lidar: LidarSensor, k: int, path: Path, *, kind: CloudKind, saving: CloudSaving, notify: LossTaker
) -> None:
    frame = lidar.frames[k]
    reported = replace(frame, extras={name: value for name, value in frame.extras.items() if name not in _WRITTEN})
    left_out(reported, str(lidar.id), notify)
    columns = frame_columns(frame, lidar.extras.get("intensity_max"))
    options = {"encoding": saving.encoding} if kind.name == "pcd" else {}
    FRAME_WRITERS[kind.name](path, columns, f"sensors[{lidar.id}].frames.points", notify, **options)


def _write_poses(scene: Scene, lidar: LidarSensor, times: Int64Array, folder: Path) -> list[Loss]:
    """Write where the frame of the points was in the world at the times of the frames, where that is known."""
    field = f"sensors[{lidar.id}].poses"
    if lidar.points_frame is PointsFrame.WORLD:
        return [Loss(field=field, what="left out: the points are in the world")] if lidar.poses is not None else []
    path = _path(scene, lidar)
    if path is None:
        return []
    samples = path.interpolate(times, reach_ns=scene_period_ns(scene))
    known = np.isfinite(samples.positions).all(axis=1)
    name = EGO_POSES if lidar.points_frame is PointsFrame.EGO else SENSOR_POSES
    if known.any():
        _write_tum(folder / name, Poses(times[known], samples.positions[known], samples.quaternions_xyzw[known]))
    if path.static or not np.array_equal(path.timestamps_ns, times[known]) or not known.all():
        what = f"written in {name} at the times of the frames"
        lost = int((~known).sum())
        what = f"{what}; {lost} frames lie beyond them" if lost else what
        return [Loss(field=field, what=what, count=len(path.timestamps_ns), support=Support.CONVERTED)]
    return []


def _path(scene: Scene, lidar: LidarSensor) -> Poses | None:
    """Where the frame of the points was over time; None where nothing says it."""
    trajectory = next(
        (trajectory for trajectory in scene.trajectories.values() if trajectory.quaternions_xyzw is not None),
        None,
    )
    if lidar.points_frame is PointsFrame.EGO:
        odometry = named_odometry(scene, lidar)
        return odometry.poses if odometry is not None else None if trajectory is None else trajectory.poses
    if lidar.poses is not None and lidar.coordinates is Coordinates.WORLD:
        return lidar.poses
    ego = None if trajectory is None else EgoMotion.of(trajectory)
    if is_on_ego(lidar):
        named_odometry(scene, lidar)
    try:
        source = sensor_source(scene, lidar, ego, reach_ns=0)
    except PoseError:
        return None
    times = source.path.timestamps_ns
    samples = source.at(times)
    return Poses(times, samples.positions, samples.quaternions_xyzw, static=source.path.static)


def _write_tum(path: Path, poses: Poses) -> None:
    from sceneloom.formats.trajectories.text_formats import TUM
    from sceneloom.formats.trajectories.trajectory_file import TrajectoryFile
    from sceneloom.scene.poses import Trajectory

    trajectory = Trajectory("poses", poses.timestamps_ns, poses.positions, poses.quaternions_xyzw)
    list(TUM.write(TrajectoryFile(trajectory), path, path))
