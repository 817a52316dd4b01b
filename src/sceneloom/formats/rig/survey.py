"""A look into a folder of unknown data: which sensors may be in it, and how their files are named."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from glob import escape
from pathlib import Path

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.clouds.layout import KITTI, NUSCENES, FieldLayout
from sceneloom.formats.clouds.table import cloud_suffix, read_cloud
from sceneloom.formats.rig.column_hints import column_hints
from sceneloom.formats.rig.csv_files import FILE_COLUMNS, TIME_COLUMNS, Table, read_lines, read_table
from sceneloom.formats.rig.images import IMAGE_SUFFIXES, image_size
from sceneloom.formats.rig.roots import natural_key
from sceneloom.formats.rig.timestamps import TimestampError, parse_timestamp

VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov", ".avi", ".ts", ".webm")
_TEXT_SUFFIXES = (".txt", ".csv", ".tum")
_DEEPEST = 4
_MOST_FILES = 500_000
_MOST_SHAPES = 12
_LARGEST_TEXT = 50_000_000
_FARTHEST = 1000.0
_DIGITS = re.compile(r"\d+")
_UNITS_BY_DIGITS = {19: "{ns}", 16: "{us}", 13: "{ms}", 10: "{s}"}
"""Units of timestamps of our years by their number of digits."""
_PARTS_BY_DIGITS = {9: "{ns}", 6: "{us}", 3: "{ms}"}
"""Units of what stands behind whole seconds."""

Times = dict[str, str | float | bool]


@dataclass(frozen=True, slots=True)
class FoundSensor:
    """What may be a sensor.

    Attributes:
        id: from its folder or name.
        type: "lidar", "camera", "imu" or "gnss".
        files: how the manifest names its files.
        about: how many there are and of which kind, for people.
        times: the `times` of the manifest; empty where the file holds them.
        size: width and height of images [px], None for other sensors.
        further: more lines of the manifest.
    """

    id: str
    type: str
    files: Mapping[str, str]
    about: str
    times: Times = field(default_factory=dict)
    size: tuple[int, int] | None = None
    further: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class FoundTrajectory:
    """What may be a trajectory: its file, how it is written, and the file of its times where it needs one."""

    name: str
    file: str
    form: str
    times: str | None = None


@dataclass(frozen=True, slots=True)
class Finding:
    """What may be in a folder."""

    sensors: tuple[FoundSensor, ...]
    trajectories: tuple[FoundTrajectory, ...]


@dataclass(frozen=True, slots=True)
class _Group:
    """Files that are named alike: their folder, a pattern that finds them, and a name for them."""

    folder: Path
    pattern: str
    name: str
    files: tuple[Path, ...]


def survey(folder: Path) -> Finding:
    """Look into a folder; heads of first files are read, and text files.

    Raises:
        DataError: an image or video that stands first in its folder cannot be read.
    """
    files = sorted(_walk(folder), key=natural_key)
    texts = [
        path
        for path in files
        if path.suffix.lower() in _TEXT_SUFFIXES and path.stat().st_size < _LARGEST_TEXT
    ]
    groups = list(_groups(folder, [path for path in files if _is_frame(path)]))
    sensors = [_lidar(folder, group, texts) for group in groups if cloud_suffix(group.files[0])]
    sensors += [_camera(folder, group, texts) for group in groups if not cloud_suffix(group.files[0])]
    sensors += [_video(folder, path) for path in files if path.suffix.lower() in VIDEO_SUFFIXES]
    trajectories = []
    for path in texts:
        motion = _motion_sensor(folder, path)
        trajectory = _trajectory(folder, path, texts)
        sensors += [motion] if motion else []
        trajectories += [trajectory] if trajectory else []
    return Finding(_with_own_ids(sensors), tuple(trajectories))


def _walk(folder: Path) -> Iterator[Path]:
    count = 0
    for location, folders, names in os.walk(folder):
        depth = len(Path(location).relative_to(folder).parts)
        folders[:] = sorted(name for name in folders if not name.startswith(".")) if depth < _DEEPEST else []
        for name in sorted(names):
            count += 1
            if count > _MOST_FILES:
                return
            if not name.startswith("."):
                yield Path(location, name)


def _is_frame(path: Path) -> bool:
    return cloud_suffix(path) is not None or path.suffix.lower() in IMAGE_SUFFIXES


def _groups(root: Path, files: Sequence[Path]) -> Iterator[_Group]:
    """Group files by folder and ending, and by the text of their names where a few texts are distinguished."""
    by_folder: dict[tuple[Path, str], dict[str, list[Path]]] = {}
    for path in files:
        shapes = by_folder.setdefault((path.parent, path.suffix), {})
        shapes.setdefault(_DIGITS.sub("*", path.name), []).append(path)
    for (folder, suffix), shapes in by_folder.items():
        location = folder.relative_to(root).as_posix()
        prefix = "" if location == "." else f"{escape(location)}/"
        if len(shapes) == 1 or len(shapes) > _MOST_SHAPES:
            alike = [path for paths in shapes.values() for path in paths]
            name = _own_name(folder, root) if prefix else _longest_word(next(iter(shapes)), suffix)
            yield _Group(folder, f"{prefix}*{suffix}", _plain(name), tuple(alike))
            continue
        for shape, paths in shapes.items():
            name = _plain(_longest_word(shape, suffix))
            pattern = "*".join(map(escape, re.sub(r"\*[*\W]*\*", "*", shape).split("*")))
            yield _Group(folder, prefix + pattern, name, tuple(paths))


def _longest_word(shape: str, suffix: str) -> str:
    """The word of a name that reports most, without the numbers around it."""
    words = [word for word in re.split(r"[*\W]+|__", shape.rpartition(".")[0]) if len(word) > 1]
    return max(words, key=len, default=suffix[1:])


def _own_name(folder: Path, root: Path) -> str:
    """The folder's name, or that of its parent where its own says only what all such folders hold."""
    generic = folder.name.lower() in {"data", "images", "image", "points", "pointcloud", "clouds", "frames"}
    return folder.parent.name if generic and folder.parent != root else folder.name


def _plain(name: str) -> str:
    return re.sub(r"\W+", "_", name).strip("_") or "sensor"


def _with_own_ids(sensors: Sequence[FoundSensor]) -> tuple[FoundSensor, ...]:
    """Number ids that occur more than once."""
    seen: dict[str, int] = {}
    named = []
    for sensor in sensors:
        seen[sensor.id] = seen.get(sensor.id, 0) + 1
        number = seen[sensor.id]
        name = sensor.id if number == 1 else f"{sensor.id}_{number}"
        named.append(
            FoundSensor(
                name, sensor.type, sensor.files, sensor.about, sensor.times, sensor.size, sensor.further
            )
        )
    return tuple(named)


def _lidar(root: Path, group: _Group, texts: Sequence[Path]) -> FoundSensor:
    first, further = group.files[0], []
    layout = None
    if cloud_suffix(first) == ".bin":
        layout = _guess_layout(first)
        names = layout.names if layout else ("x", "y", "z", "intensity")
        listed = ", ".join(f'"{name}"' for name in names)
        further.append(f"fields = [{listed}]   # a guess; float32 where no type is named, as ring:uint16")
    try:
        cloud = read_cloud(first, layout=layout)
        columns = ", ".join(f"{name} {column.dtype.name}" for name, column in cloud.columns.items())
        about = f"{_several(group)}; the first has {cloud.count} points: {columns}"
        further += column_hints(cloud.columns)
    except DataError as error:
        about = f"{_several(group)}; the first cannot be read: {error.problem}"
    further.append('timestamp = "start"   # of the sweep; or "middle", "end" together with sweep_s')
    times = _times(root, group, texts)
    return FoundSensor(
        group.name, "lidar", {"files": group.pattern}, " ".join(about.split()), times, further=further
    )


def _guess_layout(path: Path) -> FieldLayout | None:
    """The known layout whose numbers look like locations and brightness; None where neither does."""
    for layout in (NUSCENES, KITTI) if path.name.lower().endswith(".pcd.bin") else (KITTI, NUSCENES):
        try:
            columns = read_cloud(path, layout=layout).columns
        except DataError:
            continue
        locations = np.stack([columns[name] for name in "xyz"])
        finite = np.isfinite(locations) & (np.abs(locations) < _FARTHEST)
        if finite.size and finite.mean() > 0.99 and (columns["intensity"] >= 0).mean() > 0.99:
            return layout
    return None


def _camera(root: Path, group: _Group, texts: Sequence[Path]) -> FoundSensor:
    size = image_size(group.files[0])
    times = _times(root, group, texts)
    return FoundSensor(group.name, "camera", {"files": group.pattern}, _several(group), times, size)


def _several(group: _Group) -> str:
    return f"{len(group.files)} {'file' if len(group.files) == 1 else 'files'}"


def _video(root: Path, path: Path) -> FoundSensor:
    from sceneloom.formats.video.reader import open_video

    with open_video(path) as video:
        size, about = (video.width, video.height), f"{video.count} images, {video.codec}"
    name = path.relative_to(root).as_posix()
    return FoundSensor(
        _plain(path.stem), "camera", {"video": name}, about, {"container": True, "start_s": 0.0}, size
    )


def _times(root: Path, group: _Group, texts: Sequence[Path]) -> Times:
    """How the files' times may be found: a list beside them, else their names, else an even rate."""
    listed = _listed_times(root, group, texts)
    if listed:
        return listed
    stem = group.files[0].name.removesuffix(group.files[0].suffix)
    stem = stem.removesuffix(".pcd")
    for pattern in _timestamp_patterns(stem):
        return {"pattern": pattern}
    runs = list(_DIGITS.finditer(stem))
    if runs and len(group.files) > 1:
        before, after = stem[: runs[-1].start()], stem[runs[-1].end() :]
        return {"pattern": f"{'*' if before else ''}{{index}}{after}", "rate_hz": float("nan")}
    return {"rate_hz": float("nan"), "start_s": 0.0}


def _timestamp_patterns(stem: str) -> Iterator[str]:
    """Patterns that find a timestamp of our years in a name, the likeliest first."""
    split = re.search(r"(?<!\d)(\d{10})(?:\.\d+|([_-])(\d{9}|\d{6}|\d{3}))(?!\d)", stem)
    if split:
        # after a point stand decimals, of which some programs leave out the last zeros
        part = split[2] + _PARTS_BY_DIGITS[len(split[3])] if split[3] else ""
        yield f"{'*' if split.start() else ''}{{s}}{part}{_rest(stem, split.end())}"
    for run in reversed(list(_DIGITS.finditer(stem))):
        unit = _UNITS_BY_DIGITS.get(len(run[0]))
        # a clock that begins at 0 leaves zeros in front; only nanoseconds have more digits than counters
        if unit is not None and (run[0][0] != "0" or unit == "{ns}"):
            yield f"{'*' if run.start() else ''}{unit}{_rest(stem, run.end())}"


def _rest(stem: str, start: int) -> str:
    """What follows a timestamp in a pattern; numbers in it may be others in the next name."""
    return _DIGITS.sub("*", stem[start:])


def _listed_times(root: Path, group: _Group, texts: Sequence[Path]) -> Times:
    """A text file beside the files, or above them, that holds a time for each of them."""
    near = [path for path in texts if path.parent in {group.folder, group.folder.parent}]
    for path in sorted(near, key=lambda path: path.parent != group.folder):
        name = path.relative_to(root).as_posix()
        table = _table(path)
        if table is not None and len(table.rows) == len(group.files):
            column, files = table.find(TIME_COLUMNS), table.find(FILE_COLUMNS)
            if column is not None and (files is not None or path.parent == group.folder):
                known = {file.name for file in group.files} | {file.stem for file in group.files}
                if files is None or Path(table.rows[0][files]).name in known:
                    return {"csv": name, "column": table.names[column]}
        if path.suffix.lower() == ".txt" and _count_timestamps(path) == len(group.files):
            return {"lines": name}
    return {}


def _table(path: Path) -> Table | None:
    try:
        return read_table(path)
    except DataError:
        return None


def _count_timestamps(path: Path) -> int | None:
    """How many times a text file holds, one per line; None where a line is something else."""
    try:
        lines = read_lines(path)
        for _, line in lines:
            parse_timestamp(line, None)
    except (DataError, TimestampError):
        return None
    return len(lines)


def _motion_sensor(root: Path, path: Path) -> FoundSensor | None:
    table = _table(path) if path.suffix.lower() == ".csv" else None
    if table is None or table.find(TIME_COLUMNS) is None:
        return None
    files, about = (
        {"file": path.relative_to(root).as_posix()},
        f"{len(table.rows)} {'row' if len(table.rows) == 1 else 'rows'}",
    )
    if table.find(("ax", "acc_x", "accel_x", "gx", "wx", "gyro_x")) is not None:
        return FoundSensor(_plain(path.stem), "imu", files, about)
    if table.find(("lat", "latitude")) is not None and table.find(("alt", "altitude", "height")) is not None:
        return FoundSensor(_plain(path.stem), "gnss", files, about)
    return None


def _trajectory(root: Path, path: Path, texts: Sequence[Path]) -> FoundTrajectory | None:
    name, stem = path.relative_to(root).as_posix(), _plain(path.stem)
    table = _table(path) if path.suffix.lower() == ".csv" else None
    if table is not None:
        placed = all(table.find((axis, f"t{axis}", f"p{axis}", f"pos_{axis}")) is not None for axis in "xyz")
        timed = table.find(TIME_COLUMNS) is not None
        return FoundTrajectory(stem, name, "csv") if placed and timed else None
    try:
        rows = read_table(path, named=False)
        rows.numbers(range(len(rows.rows[0])))
    except DataError:
        return None
    if len(rows.rows[0]) == 8:
        return FoundTrajectory(stem, name, "tum")
    if len(rows.rows[0]) != 12:
        return None
    timestamped = [text for text in texts if text != path and _count_timestamps(text) == len(rows.rows)]
    times = timestamped[0].relative_to(root).as_posix() if timestamped else "times.txt"
    return FoundTrajectory(stem, name, "kitti", times)
