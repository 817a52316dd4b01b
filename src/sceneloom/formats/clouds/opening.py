"""Files of points as a scene with a lidar for each folder of them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.clouds.bin import default_layout
from sceneloom.formats.clouds.folder import CloudFolder, find_folders
from sceneloom.formats.clouds.names import numbers_of_names, stem_of, times_of_names
from sceneloom.formats.clouds.points import IntensityScale, PointMapping
from sceneloom.formats.clouds.spec import EGO_POSES, SENSOR_POSES, TIME_FILES, CloudKind, CloudReading
from sceneloom.formats.clouds.sweeps import (
    CloudFrames,
    first_time_ns,
    origin_of,
    readable,
    scale_of,
    times_of,
)
from sceneloom.formats.ledger import Ledger
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import PointsFrame
from sceneloom.scene.warnings import WarningKind

DEFAULT_RATE_HZ = 10.0
"""How fast most lidars rotate: taken for files whose names are plain numbers."""

_EGO_TRAJECTORY = "pose"


def open_clouds(path: Path, *, kind: CloudKind, options: CloudReading) -> Scene:
    """Open a file, a folder of files, or a folder of folders of files; the first file of each is read.

    Raises:
        DataError: there are none, one is damaged, or their times are.
    """
    ledger = Ledger(lenient=options.lenient)
    trajectories: dict[str, Trajectory] = {}
    with ledger.telling():
        sensors = tuple(
            _lidar(folder, kind, options, ledger, trajectories) for folder in find_folders(path, kind)
        )
    return Scene(
        sensors, trajectories=trajectories, source=str(path), format=kind.name, warnings=ledger.warnings
    )


def _lidar(
    folder: CloudFolder,
    kind: CloudKind,
    reading: CloudReading,
    ledger: Ledger,
    trajectories: dict[str, Trajectory],
) -> LidarSensor:
    layout = default_layout(folder.files[0]) if kind.layout else None
    frames = _frames(folder, reading, ledger)
    frames = replace(frames, layout=layout)
    if reading.lenient:
        frames = _sound(frames, ledger)
    first = frames.cloud(0)
    if len(frames.files) == 1 and not frames.timestamps_ns[0]:
        frames = replace(frames, timestamps_ns=np.array([first_time_ns(first) or 0], np.int64))
    origin = origin_of(first)
    frames = replace(frames, origin=origin)
    frames, maximum = _with_mapping(folder, kind, frames, ledger)
    _note_first(folder, frames, ledger)
    sensor = LidarSensor(
        folder.sensor_id,
        LazyFrames(frames.timestamps_ns, frames),
        extras=MappingProxyType({} if maximum is None else {"intensity_max": maximum}),
    )
    if origin is not None:
        reported = f"points lie {np.linalg.norm(origin):.0f} m from 0: the sensor is put there, the points count from it"
        ledger.note(WarningKind.ASSUMED, "cloud-origin", str(folder.files[0]), reported)
        at_origin = Poses(
            np.zeros(1, np.int64), read_only(origin[None]), np.array([[0.0, 0.0, 0.0, 1.0]]), static=True
        )
        return replace(sensor, poses=at_origin)
    return _placed(sensor, folder, reading, ledger, trajectories)


def _placed(
    sensor: LidarSensor,
    folder: CloudFolder,
    reading: CloudReading,
    ledger: Ledger,
    trajectories: dict[str, Trajectory],
) -> LidarSensor:
    """The sensor with the poses that stand beside its files, and the frame of its points."""
    frame = None if reading.points_frame is None else PointsFrame(reading.points_frame)
    if EGO_POSES in folder.beside and frame in {None, PointsFrame.EGO}:
        trajectory = trajectories.setdefault(_EGO_TRAJECTORY, _trajectory(folder.beside[EGO_POSES], ledger))
        return replace(
            sensor, poses=trajectory.poses, points_frame=PointsFrame.EGO, mount=RigidTransform.identity()
        )
    if SENSOR_POSES in folder.beside and frame in {None, PointsFrame.SENSOR}:
        return replace(sensor, poses=_trajectory(folder.beside[SENSOR_POSES], ledger).poses)
    if frame is None:
        reported = (
            "it is not stated where the points are; taken as on the ego, `--points-frame` says another frame"
        )
        ledger.note(WarningKind.ASSUMED, "cloud-frame-assumed", str(folder.location), reported)
    if frame is PointsFrame.WORLD:
        return replace(sensor, points_frame=frame)
    return replace(sensor, points_frame=frame or PointsFrame.SENSOR, mount=RigidTransform.identity())


def _trajectory(path: Path, ledger: Ledger) -> Trajectory:
    from sceneloom.formats.trajectories.content import Reading
    from sceneloom.formats.trajectories.tum import FORM

    return FORM.read(path, Reading(name=_EGO_TRAJECTORY), ledger).trajectory


def _sound(frames: CloudFrames, ledger: Ledger) -> CloudFrames:
    """Leave out the files that cannot be read."""
    errors = readable(frames.files, frames.layout)
    for error in filter(None, errors):
        ledger.fault("unreadable-files", error)
    kept = [k for k, error in enumerate(errors) if error is None]
    if not kept:
        raise next(error for error in errors if error is not None)
    return replace(
        frames,
        files=tuple(frames.files[k] for k in kept),
        timestamps_ns=read_only(frames.timestamps_ns[kept]),
    )


def _frames(folder: CloudFolder, reading: CloudReading, ledger: Ledger) -> CloudFrames:
    """The files in the order of their times."""
    times, files = _times(folder, reading, ledger)
    order = np.argsort(times, kind="stable")
    times = times[order]
    repeated = np.flatnonzero(np.diff(times) == 0) + 1
    if len(repeated):
        k = int(repeated[0])
        names = [files[int(order[row])].name for row in (k - 1, k)]
        reported = f"{names[0]!r} and {names[1]!r} have the same time"
        problem = f"{reported}, {times[k] / 1e9:.9f} s; expected one file per time"
        ledger.fault("repeated-times", DataError(folder.location, "", problem), count=len(repeated))
        order, times = np.delete(order, repeated), np.delete(times, repeated)
    return CloudFrames(tuple(files[k] for k in order.tolist()), read_only(times))


def _times(folder: CloudFolder, reading: CloudReading, ledger: Ledger) -> tuple[Int64Array, tuple[Path, ...]]:
    stems = [stem_of(path.name) for path in folder.files]
    listed = next((folder.beside[name] for name in TIME_FILES if name in folder.beside), None)
    numbers = numbers_of_names(stems)
    files = folder.files
    if listed is not None:
        # lists count in the order of numbers, which is not that of names of different length
        rank = range(len(files)) if numbers is None else np.argsort(np.array(numbers)).tolist()
        return _listed_times(listed, tuple(files[k] for k in rank), ledger)
    times = times_of_names(stems)
    if times is not None:
        return np.array(times, np.int64), files
    if len(files) > 1:
        rate_hz = reading.rate_hz or DEFAULT_RATE_HZ
        counted = numbers if numbers is not None else list(range(len(files)))
        if reading.rate_hz is None:
            reported = (
                f"names report no times: number k is taken as {1 / rate_hz:g} k s, "
                "`--input-option rate_hz=HZ` says another rate"
            )
            ledger.note(
                WarningKind.ASSUMED, "cloud-times-assumed", str(folder.location), reported, count=len(files)
            )
        return _counted_times(folder, counted, rate_hz), files
    return np.zeros(1, np.int64), files


def _counted_times(folder: CloudFolder, numbers: list[int], rate_hz: float) -> Int64Array:
    if max(numbers) / rate_hz > 9e9:
        raise DataError(
            folder.location, "", f"number {max(numbers)} at {rate_hz:g} Hz is a time beyond the year 2255"
        )
    return np.array([round(number * 1e9 / rate_hz) for number in numbers], np.int64)


def _listed_times(
    listed: Path, files: tuple[Path, ...], ledger: Ledger
) -> tuple[Int64Array, tuple[Path, ...]]:
    from sceneloom.formats.rig.times import line_timestamps

    times = line_timestamps(listed, None)
    if len(times) != len(files):
        problem = f"{len(times)} times for {len(files)} files; expected as many"
        ledger.fault("counts-disagree", DataError(listed, "", problem), count=abs(len(times) - len(files)))
    used = min(len(times), len(files))
    if not used:
        raise DataError(listed, "", f"no times for {len(files)} files")
    return times[:used], files[:used]


def _with_mapping(
    folder: CloudFolder, kind: CloudKind, frames: CloudFrames, ledger: Ledger
) -> tuple[CloudFrames, float | None]:
    """Settle what brightness and times mean, by the first files."""
    scale, name = scale_of(frames)
    if name is not None and scale is None:
        reported = f"column {name!r} fits no scale of brightness; kept as it is among the further values"
        ledger.note(WarningKind.SKIPPED, "intensity-not-used", str(folder.location), reported)
    if kind.layout and scale is not None and kind.name == "nuscenes-bin":
        scale = IntensityScale(max(scale.maximum, 255.0))
    first = frames.cloud(0)
    times = times_of(first, int(frames.timestamps_ns[0]))
    if times is not None and times.field != "offset_ns":
        reported = f"column {times.field!r} is taken for times of points: {times.unit} relative to the {times.relative_to}"
        ledger.note(WarningKind.ASSUMED, "point-times-assumed", str(folder.location), reported)
    settled = replace(frames, mapping=PointMapping(scale=scale, times=times))
    return settled, None if scale is None else scale.maximum


def _note_first(folder: CloudFolder, frames: CloudFrames, ledger: Ledger) -> None:
    """Look at the first frame, and state what was left out of it."""
    frame = frames(0)
    notes: dict[str, tuple[str, Callable[[Any], int]]] = {
        "dropped_points": (
            "points that are not finite, or exactly at the origin, are no returns and are left out",
            int,
        ),
        "clipped_intensities": ("brightness beyond its scale is cut to it", int),
    }
    for name, (message, count) in notes.items():
        if name in frame.extras:
            location = str(frames.files[0])
            ledger.note(
                WarningKind.SKIPPED,
                name.replace("_", "-"),
                location,
                message,
                count=count(frame.extras[name]),
            )
    apart = frame.extras.get("head", {}).get("other_bounds")
    if apart:
        reported = f"the bounds in the header are not those of the points ({apart} off); the points are read as they are"
        ledger.note(WarningKind.ASSUMED, "other-bounds", str(frames.files[0]), reported)
    others = frame.extras.get("head", {}).get("elements_left_out")
    if others:
        listed = ", ".join(f"{count} {name}" for name, count in others.items())
        reported = f"only vertices are points: {listed} left out of the first file"
        ledger.note(WarningKind.SKIPPED, "elements-left-out", str(folder.location), reported)
