"""Write the lidar frames of a scene as files of points."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.editing.move_world import points_change, to_ego, to_sensor, to_world
from sceneloom.errors import OptionError, PoseError, check_choice
from sceneloom.formats.base.losses import Losses, LossReport, field_losses
from sceneloom.formats.base.output import FolderKind, file_stems, replacing
from sceneloom.formats.base.poses import ego_in_world
from sceneloom.formats.points.files import FRAME_WRITERS, FrameColumns
from sceneloom.formats.points.spec import DEFAULT_ID, EGO_POSES, ENCODINGS, SENSOR_POSES, SUPPORTS, CloudKind
from sceneloom.motion.ego_trajectory import IDENTITY, is_computed, with_trajectory_estimated
from sceneloom.scene.clouds import LidarFrame, LidarSensor, grey_where_unseen
from sceneloom.scene.ego import EgoMotion, is_on_ego, named_odometry, sensor_source
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Coordinates, PointsFrame

_OFFSET = "offset_ns"  # times of points from the frame's time on [ns]: 32 bits hold two seconds either way


_SPACES = re.compile(r"\s+")


def _frame_columns(frame: LidarFrame, intensity_max: float | None) -> FrameColumns:
    """Lay out a frame; intensities as its source had them, full at `intensity_max`, are preferred to 0 to 255."""
    points = frame.points
    extras = {name: values for name, values in points.extras.items() if _is_column(values, len(points))}
    intensities, brightest = points.intensities, 255.0
    if intensities is not None and intensity_max and extras.get("intensity", np.zeros((0, 0))).ndim == 1:
        intensities, brightest = extras.pop("intensity"), intensity_max
    further: dict[str, AnyArray] = {}
    if points.timestamps_ns is not None:
        offsets = points.timestamps_ns - frame.timestamp_ns
        small = not len(offsets) or bool(np.abs(offsets).max() < 2**31)
        further[_OFFSET] = offsets.astype(np.int32) if small else offsets
    known = {"ring": points.rings, "camera_index": points.camera_index}
    further |= {name: values for name, values in known.items() if values is not None}
    taken = {"x", "y", "z", "red", "green", "blue", "intensity", "rgb", *further}
    for name, values in extras.items():
        plain = _SPACES.sub("_", name) or "_"
        while plain in taken:
            plain += "_further"
        taken.add(plain)
        further[plain] = values
    colors = None if points.colors is None else grey_where_unseen(points.colors, points.camera_index)
    return FrameColumns(points.positions, colors, intensities, brightest, further)


def _is_column(values: AnyArray, count: int) -> bool:
    return values.ndim in {1, 2} and len(values) == count and values.dtype.kind in "iufb" and values.size > 0


def _left_out(frame: LidarFrame, sensor: str, losses: Losses) -> None:
    """Report what of a frame no file of points has a field for."""
    count = len(frame.points)
    for name, values in frame.points.extras.items():
        field = f"sensors[{sensor}].frames.points.extras.{name}"
        if count and not _is_column(values, count):
            losses.dropped(field, "left out: no column of numbers with a row per point")
        elif _SPACES.search(name):
            losses.converted(field, "spaces in its name written as `_`")
    what = "left out: a file of points has no other fields"
    losses.dropped(f"sensors[{sensor}].frames.extras", what, count=len(frame.extras))


_MOVES: Mapping[PointsFrame, Callable[..., Scene]] = MappingProxyType(
    {PointsFrame.SENSOR: to_sensor, PointsFrame.EGO: to_ego, PointsFrame.WORLD: to_world}
)

_WRITTEN = {"file", "dropped_points", "clipped_intensities"}
"""Extra fields of frames that only state from which file they were read, and how."""


@dataclass(frozen=True, slots=True)
class _Saving:
    """How clouds are to be written."""

    frame: str | None = None  # "sensor", "ego" or "world"; None: the one that the points are in
    encoding: str = ENCODINGS[0]  # of PCD files
    lidar: str | None = None  # id of the only one to be written, as text; None for all
    trajectory: str | None = None  # the ego's, as of `ego_in_world`, where `frame` needs it

    def __post_init__(self) -> None:
        if self.frame is not None and self.frame not in tuple(PointsFrame):
            raise OptionError(f"frame {self.frame!r}; expected one of {', '.join(PointsFrame)}")
        check_choice("encoding", self.encoding, ENCODINGS)


def write_clouds(scene: Scene, path: Path, *, kind: CloudKind, overwrite: bool = False, **options: str) -> LossReport:
    """Write each frame of each lidar to a file; a path with the kind's ending takes a scene of one frame.

    Raises:
        OptionError: there is no lidar of that id, no frame at all, or there are several for one file.
        PoseError: the poses that another frame of the points needs are not known.
        OutputError: the output exists, or cannot be written.
    """
    saving, losses = _Saving(**options), Losses()
    _note_fields(scene, kind, losses)
    asked = _chosen(scene, saving.lidar)
    if saving.frame is not None and any(lidar.points_frame != saving.frame for lidar in asked):
        scene = _in_frame(scene, asked, PointsFrame(saving.frame), saving.trajectory, losses)
    elif saving.trajectory is not None:
        raise OptionError(
            f"trajectory {saving.trajectory!r}: the points stay in the frame that they are in, which needs none; "
            "expected another frame, such as `frame=world`"
        )
    lidars = _chosen(scene, saving.lidar)
    for lidar in scene.lidars:
        if lidar not in lidars:
            losses.dropped(f"sensors[{lidar.id}]", "left out: another lidar was asked for")
    if path.name.lower().endswith(kind.endings[1:]):
        raise OptionError(f"{path}: written as {kind.endings[0]} only; {path.suffix} has one array and no names")
    files = FrameFiles(kind, saving.encoding, losses)
    if kind.has_name(path.name):
        _write_file(lidars, path, files, overwrite=overwrite)
    else:
        _write_folder(scene, lidars, path, files, overwrite=overwrite)
    return LossReport.of(losses)


def _in_frame(
    scene: Scene, lidars: list[LidarSensor], frame: PointsFrame, trajectory: str | None, losses: Losses
) -> Scene:
    """Bring the points of lidars into a frame, along a trajectory where that needs one."""
    odometries = [sensor for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
    others = [lidar for lidar in scene.lidars if lidar not in lidars]
    part, move = replace(scene, sensors=(*lidars, *odometries), annotations=()), _MOVES[frame]
    known = any(trajectory.quaternions_xyzw is not None for trajectory in scene.trajectories.values())
    if trajectory is not None or known or any(_needs_trajectory(part, lidar, frame) for lidar in lidars):
        ego, found = ego_in_world(scene, name=trajectory)
        losses.extend(found)
        part = with_trajectory_estimated(part, ego) if is_computed(scene, ego.name) else part
        by_default = trajectory is None and next(iter(part.trajectories), None) == ego.name
        part = move(part, trajectory=None if by_default else ego.name)
    else:
        # nothing says where the ego was, nor need it be known: no poses of it are made up
        # the mounting does not count where the lidar's own poses in the world state more
        posed = [PointsFrame.WORLD in {frame, lidar.points_frame} and lidar.poses is not None for lidar in lidars]
        placed = [replace(lidar, mount=None) if own else lidar for lidar, own in zip(lidars, posed, strict=True)]
        moved = move(replace(part, sensors=(*placed, *odometries)), trajectory=IDENTITY)
        part = replace(part, sensors=(*moved.lidars, *odometries))
    return replace(part, sensors=(*part.sensors, *others))


def _needs_trajectory(scene: Scene, lidar: LidarSensor, frame: PointsFrame) -> bool:
    try:
        points_change(scene, lidar, None, frame, reach_ns=0)
    except PoseError:
        return True
    return False


def _note_fields(scene: Scene, kind: CloudKind, losses: Losses) -> None:
    """Report what becomes of the scene, but for what depends on the frames, and for what this scene does not have."""
    table = dict(SUPPORTS[kind.name])
    for name in ("id", "coordinates", "points_frame", "poses", "mount", "extras"):
        table.pop(f"sensors.lidar.{name}", None)
    losses.extend(field_losses(scene, table))
    for lidar in scene.lidars:
        if lidar.mount is not None and not np.array_equal(lidar.mount.matrix, np.eye(4)):
            what = "left out: the poses beside the clouds state where they are in the world"
            losses.dropped(f"sensors[{lidar.id}].mount", what)
        further = [name for name in lidar.extras if name != "intensity_max"]
        if further:
            what = f"left out: files of points state nothing of the device: {', '.join(further)}"
            losses.dropped(f"sensors[{lidar.id}].extras", what)


def _chosen(scene: Scene, lidar: str | None) -> list[LidarSensor]:
    found = [one for one in scene.lidars if lidar is None or str(one.id) == lidar]
    if not found or not any(len(one.frames) for one in found):
        known = ", ".join(repr(str(one.id)) for one in scene.lidars) or "none"
        asked = "no frames of a lidar" if lidar is None else f"no frames of a lidar {lidar!r}"
        raise OptionError(f"{scene.source}: {asked} to be written as points; its lidars: {known}")
    return found


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """Writes frames to files of a kind.

    Attributes:
        kind: of the files.
        encoding: of PCD files.
        losses: takes what a file cannot hold.
        float_intensities: write intensities of 0 to 255 as float32 of 0 to 1, which programs expect that know no other
            type.
    """

    kind: CloudKind
    encoding: str
    losses: Losses
    float_intensities: bool = False

    def write(self, lidar: LidarSensor, k: int, path: Path) -> None:
        """Write frame `k` of a lidar."""
        self.write_frame(lidar, lidar.frames[k], path)

    def write_frame(self, lidar: LidarSensor, frame: LidarFrame, path: Path) -> None:
        """Write a frame of a lidar."""
        reported = {name: value for name, value in frame.extras.items() if name not in _WRITTEN}
        _left_out(replace(frame, extras=reported), str(lidar.id), self.losses)
        columns = _frame_columns(frame, lidar.extras.get("intensity_max"))
        if self.float_intensities and columns.intensities is not None and columns.intensities.dtype.kind != "f":
            scaled = (columns.intensities / np.float64(columns.brightest)).astype(np.float32)
            columns = replace(columns, intensities=scaled, brightest=1.0)
        options = {"encoding": self.encoding} if self.kind.name == "pcd" else {}
        FRAME_WRITERS[self.kind.name](path, columns, f"sensors[{lidar.id}].frames.points", self.losses, **options)

    def note_ids(self, lidars: list[LidarSensor]) -> None:
        """Report ids that reading gives another value."""
        for lidar in lidars:
            found = DEFAULT_ID if len(lidars) == 1 else str(lidar.id)
            if lidar.id != found:
                self.losses.converted(f"sensors[{lidar.id}].id", f"read back as {found!r}")


def _write_file(lidars: list[LidarSensor], path: Path, files: FrameFiles, *, overwrite: bool) -> None:
    count = sum(len(lidar.frames) for lidar in lidars)
    if count != 1:
        raise OptionError(
            f"{path}: one file for {count} frames; write a folder: a name without `{path.suffix}`, and the format"
        )
    lidar = next(one for one in lidars if len(one.frames))
    with replacing(path, overwrite=overwrite) as draft:
        files.write(lidar, 0, draft)
    if lidar.frames.timestamps_ns[0]:
        what = "left out: a single file has a name of its own"
        files.losses.dropped(f"sensors[{lidar.id}].frames.timestamp_ns", what)
    if lidar.poses is not None:
        what = "left out: a single file has no file of poses beside it"
        files.losses.dropped(f"sensors[{lidar.id}].poses", what)
    files.note_ids([lidar])


def _write_folder(scene: Scene, lidars: list[LidarSensor], path: Path, files: FrameFiles, *, overwrite: bool) -> None:
    written = [lidar for lidar in lidars if len(lidar.frames)]
    for lidar in lidars:
        if lidar not in written:
            files.losses.dropped(f"sensors[{lidar.id}]", "left out: it has no frames")
    files.note_ids(written)
    ending = files.kind.endings[0]
    names = (rf"-?\d{{19}}{re.escape(ending)}", *map(re.escape, (EGO_POSES, SENSOR_POSES)))
    kind = FolderKind(f"folder of {ending} files named by their times", (*names, *(rf".+/{name}" for name in names)))
    with replacing(path, overwrite=overwrite, folder=kind) as draft:
        for lidar, stem in zip(written, file_stems(one.id for one in written), strict=True):
            folder = draft if len(written) == 1 else draft / stem
            folder.mkdir(exist_ok=True)
            times = _distinct_times(lidar, files.losses)
            for k, time_ns in enumerate(times.tolist()):
                files.write(lidar, k, folder / f"{time_ns:0{20 if time_ns < 0 else 19}d}{ending}")
            _write_poses(scene, lidar, times, folder, files.losses)


def _distinct_times(lidar: LidarSensor, losses: Losses) -> Int64Array:
    """The times of the frames, which names can be made of: equal ones are put a nanosecond apart."""
    times = lidar.frames.timestamps_ns
    later = np.arange(len(times))
    distinct = np.maximum.accumulate(times - later) + later
    error, count = float((distinct - times).max(initial=0)), int((distinct != times).sum())
    what = "frames of one time put 1 ns apart, which their names need"
    losses.approximated(f"sensors[{lidar.id}].frames.timestamp_ns", what, count=count, error=error)
    return np.asarray(distinct, np.int64)


def _write_poses(scene: Scene, lidar: LidarSensor, times: Int64Array, folder: Path, losses: Losses) -> None:
    """Write the poses of the frame of the points at the times of the frames, where they are known."""
    field = f"sensors[{lidar.id}].poses"
    if lidar.points_frame is PointsFrame.WORLD:
        if lidar.poses is not None:
            losses.dropped(field, "left out: the points are in the world")
        return
    path = _path(scene, lidar)
    if path is None:
        return
    samples = path.interpolate(times, reach_ns=scene_period_ns(scene))
    known = np.isfinite(samples.positions).all(axis=1)
    name = EGO_POSES if lidar.points_frame is PointsFrame.EGO else SENSOR_POSES
    if known.any():
        from sceneloom.formats.trajectories.text_formats import TUM
        from sceneloom.formats.trajectories.trajectory_file import TrajectoryFile

        trajectory = Trajectory("poses", times[known], samples.positions[known], samples.quaternions_xyzw[known])
        list(TUM.write(TrajectoryFile(trajectory), folder / name, folder / name))
    if path.static or not np.array_equal(path.timestamps_ns, times[known]) or not known.all():
        what, lost = f"written in {name} at the times of the frames", int((~known).sum())
        what = f"{what}; {lost} frames lie beyond them" if lost else what
        losses.converted(field, what, count=len(path.timestamps_ns))


def _path(scene: Scene, lidar: LidarSensor) -> Poses | None:
    """Where the frame of the points was over time; None where nothing says it."""
    oriented = (trajectory for trajectory in scene.trajectories.values() if trajectory.quaternions_xyzw is not None)
    trajectory = next(oriented, None)
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
