"""A manifest to begin with: the commented template, or one filled in from a survey of a folder of unknown data."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from glob import escape
from pathlib import Path

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.images import IMAGE_SUFFIXES, images_image_size
from sceneloom.formats.base.output import replacing
from sceneloom.formats.base.text_tables import (
    FILE_COLUMNS,
    TIME_COLUMNS,
    Table,
    TimestampError,
    line_timestamps,
    read_table,
)
from sceneloom.formats.points.cloud import KITTI, NUSCENES, FieldLayout, find_roles
from sceneloom.formats.points.files import cloud_suffix, read_cloud
from sceneloom.formats.rig.spec import natural_key

_VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov", ".avi", ".ts", ".webm")
_TEXT_SUFFIXES = (".txt", ".csv", ".tum")
_DEEPEST = 4
_MOST_FILES = 500_000
_MOST_SHAPES = 12
_LARGEST_TEXT = 50_000_000
_FARTHEST = 1000.0
_DIGITS = re.compile(r"\d+")

_UNITS_BY_DIGITS = {19: "{ns}", 16: "{us}", 13: "{ms}", 10: "{s}"}
"""Units of timestamps of our years by their number of digits."""

_PARTS_BY_DIGITS = {9: "{ns}", 6: "{us}", 3: "{ms}"}  # units of what stands behind whole seconds

TEMPLATE = """\
# rig.toml describes a folder of clouds and images, so that sceneloom opens it as one drive:
#     sceneloom info FOLDER
#     sceneloom fuse FOLDER -o drive.sfs
# Lengths are metres, times seconds unless a unit is named, `nan` is what has to be filled in. Sensors that you do not
# have are taken out. Everything that can stand here: docs/formats/rig.md.

name = "my drive"
ego = "base"                       # the frame that moves through the world: x forward, y left, z up
# root = "../raw"                  # where the files are, if not beside this file

[[sensors]]
id = "lidar_top"
type = "lidar"
files = "lidar_top/*.pcd"          # .pcd .ply .bin .npz .npy
times = { pattern = "{ns}" }       # the name is the time: 1532402927647951000.pcd; also {us} {ms} {s} {s}_{ns}
timestamp = "start"                    # of the sweep; or "middle", "end" together with sweep_s
# sweep_s = 0.1
# intensity_max = 255              # the brightness that becomes 255
# point_times = { field = "t", unit = "nanoseconds", relative_to = "timestamp" }
# fields = ["x", "y", "z", "intensity", "ring:uint16"]   # of .bin files; float32 where no type is named

# p_base = R · p_lidar_top + translation: `translation` is where the lidar is, seen from base.
[sensors.extrinsic]
to = "base"
translation = [nan, nan, nan]
quaternion_xyzw = [nan, nan, nan, nan]   # or quaternion_wxyz, rotation_matrix, euler_deg with euler_order, or matrix

[[sensors]]
id = "cam_front"
type = "camera"
files = "cam_front/*.jpg"          # .jpg .png; or video = "front.mp4"
times = { pattern = "{ns}" }
# times = { csv = "cam_front.csv", column = "timestamp", unit = "nanoseconds", file_column = "file" }
# times = { lines = "cam_front/timestamps.txt" }
# times = { rate_hz = 10, start_s = 0.0 }
axes = "optical"                   # of frame cam_front: x right, y down, z forward; "flu": x forward, y left, z up

[sensors.camera_model]
model = "brown_conrady"            # pinhole, brown_conrady (OpenCV's), fisheye (OpenCV's)
fx = nan
fy = nan
cx = nan
cy = nan
coefficients = [nan, nan, nan, nan, nan]   # k1 k2 p1 p2 k3; [] where the images are rectified
# width = 1920                     # where the numbers hold for another image size
# height = 1080

[sensors.extrinsic]
to = "lidar_top"                   # any frame that is known
matrix = [
    [nan, nan, nan, nan],
    [nan, nan, nan, nan],
    [nan, nan, nan, nan],
    [0.0, 0.0, 0.0, 1.0],
]

# [[trajectories]]
# file = "poses.txt"
# form = "tum"                     # lines of: time x y z qx qy qz qw; or "kitti", "csv"
# frame = "base"                   # the frame whose trajectory it is
"""


def template_text(*, folder: Path | None = None, root: str | None = None) -> str:
    """Give a manifest to fill in.

    Args:
        folder: survey it and state what is there; None: the general template.
        root: how the manifest names the folder, None where it stands in it.

    Raises:
        DataError: the folder does not exist or holds nothing that a rig is made of, or a file in it cannot be read.
    """
    if folder is None:
        return TEMPLATE
    if not folder.is_dir():
        problem = "is a file" if folder.exists() else "no such folder"
        raise DataError(folder, "", f"{problem}; expected a folder with clouds, images or videos")
    found = survey(folder)
    if not found.sensors:
        raise DataError(folder, "", "no clouds, images or videos in it; expected pcd ply bin npz, png jpg, mp4 …")
    ego = next((sensor.id for sensor in found.sensors if sensor.type == "lidar"), "base")
    head = [
        "# Written from a survey of the folder: check every line. `nan` has to be filled in; lengths are metres.",
        "# Everything that can stand here: docs/formats/rig.md.",
        "",
        f"ego = {quoted(ego)}   # the frame that moves through the world: x forward, y left, z up",
        *([f"root = {quoted(root)}"] if root else []),
    ]
    parts = ["\n".join(head), *(sensor.text(ego) for sensor in found.sensors)]
    parts += [trajectory.text(ego) for trajectory in found.trajectories]
    return "\n\n".join(parts) + "\n"


def write_template(path: Path, *, folder: Path | None = None, overwrite: bool = False) -> None:
    """Write a manifest to fill in.

    Args:
        path: the file to write, usually `rig.toml`.
        folder: survey it and state what is there; None: the general template.
        overwrite: replace a file that is there.

    Raises:
        OptionError: the path is no `.toml`.
        OutputError: the file exists, or cannot be written.
        DataError: the folder holds nothing that a rig is made of, or a file in it cannot be read.
    """
    if path.suffix.lower() != ".toml":
        raise OptionError(f"{path}: there are templates of rig.toml only; expected a name that ends with .toml")
    text = template_text(folder=folder, root=None if folder is None else _root(path, folder))
    with replacing(path, overwrite=overwrite) as draft:
        # names may be no Unicode, TOML always is
        draft.write_bytes(text.encode("utf-8", "replace"))


def _root(path: Path, folder: Path) -> str | None:
    """How a manifest names the folder of its files: relative, if it is near; None where it stands in it."""
    here, there = path.resolve().parent, folder.resolve()
    if here == there:
        return None
    if there.is_relative_to(here):
        return there.relative_to(here).as_posix()
    return f"../{there.relative_to(here.parent).as_posix()}" if there.is_relative_to(here.parent) else str(there)


def quoted(text: str) -> str:
    """Write a text as TOML does."""
    if "'" in text or any(map(_is_control, text)):
        escaped = text.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(f"\\u{ord(sign):04x}" if _is_control(sign) else sign for sign in escaped) + '"'
    return f'"{text}"' if '"' not in text and "\\" not in text else f"'{text}'"


def _is_control(sign: str) -> bool:
    """Whether TOML cannot hold a character, not even in a comment."""
    return ord(sign) < 32 or ord(sign) == 127


@dataclass(frozen=True, slots=True)
class _FoundSensor:
    """What may be a sensor."""

    id: str  # from its folder or name
    type: str
    files: Mapping[str, str]  # how the manifest names its files
    about: str  # how many there are and of which kind, for people
    times: Mapping[str, str | float | bool] = field(default_factory=dict)  # empty where the file holds them
    size: tuple[int, int] | None = None  # width and height of images [px]
    further: Sequence[str] = ()  # more lines of the manifest

    def text(self, ego: str) -> str:
        """Its table in the manifest."""
        lines = ["[[sensors]]", f"id = {quoted(self.id)}", f"type = {quoted(self.type)}"]
        lines += [f"{name} = {quoted(value)}" for name, value in self.files.items()]
        # columns may be called anything in a damaged file
        lines[-1] += "   # " + "".join("?" if _is_control(sign) else sign for sign in self.about)
        if self.times:
            values = ((name, quoted(v) if isinstance(v, str) else str(v).lower()) for name, v in self.times.items())
            lines.append(f"times = {{ {', '.join(f'{name} = {value}' for name, value in values)} }}")
        lines += self.further
        if self.size is not None:
            lines.append(
                'axes = "optical"   # of its frame: x right, y down, z forward; "flu": x forward, y left, z up'
            )
            camera_model = "fx = nan, fy = nan, cx = nan, cy = nan, coefficients = []"
            lines.append(f"camera_model = {{ {camera_model}, width = {self.size[0]}, height = {self.size[1]} }}")
        if self.id != ego and self.type != "gnss":
            pose = "translation = [nan, nan, nan], quaternion_xyzw = [nan, nan, nan, nan]"
            lines.append(f"extrinsic = {{ to = {quoted(ego)}, {pose} }}")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class _FoundTrajectory:
    """What may be a trajectory: its file, how it is written, and the file of its times where it needs one."""

    name: str
    file: str
    form: str
    times: str | None = None

    def text(self, ego: str) -> str:
        """Its table in the manifest."""
        fields = {"name": self.name, "file": self.file, "form": self.form, "times": self.times}
        lines = ["[[trajectories]]", *(f"{name} = {quoted(value)}" for name, value in fields.items() if value)]
        return "\n".join([*lines, f"frame = {quoted(ego)}   # the frame whose trajectory it is"])


@dataclass(frozen=True, slots=True)
class Finding:
    """What may be in a folder."""

    sensors: tuple[_FoundSensor, ...]
    trajectories: tuple[_FoundTrajectory, ...]


@dataclass(frozen=True, slots=True)
class _Group:
    """Files that are named alike: their folder, a pattern that finds them, and a name for them."""

    folder: Path
    pattern: str
    name: str
    files: tuple[Path, ...]


def survey(folder: Path) -> Finding:
    """Survey a folder; heads of first files are read, and text files.

    Raises:
        DataError: an image or video that stands first in its folder cannot be read.
    """
    files = sorted(_walk(folder), key=natural_key)
    texts = [path for path in files if path.suffix.lower() in _TEXT_SUFFIXES and path.stat().st_size < _LARGEST_TEXT]
    frames = [path for path in files if cloud_suffix(path) or path.suffix.lower() in IMAGE_SUFFIXES]
    groups = list(_groups(folder, frames))
    sensors = [_lidar(folder, group, texts) for group in groups if cloud_suffix(group.files[0])]
    for group in groups:
        if not cloud_suffix(group.files[0]):
            size, times = images_image_size(group.files[0]), _times(folder, group, texts)
            sensors.append(_FoundSensor(group.name, "camera", {"files": group.pattern}, _several(group), times, size))
    sensors += [_video(folder, path) for path in files if path.suffix.lower() in _VIDEO_SUFFIXES]
    trajectories = []
    for path in texts:
        for found in (_motion_sensor(folder, path), _trajectory(folder, path, texts)):
            if isinstance(found, _FoundSensor):
                sensors.append(found)
            elif found is not None:
                trajectories.append(found)
    seen: dict[str, int] = {}
    for k, sensor in enumerate(sensors):
        number = seen[sensor.id] = seen.get(sensor.id, 0) + 1
        sensors[k] = sensor if number == 1 else replace(sensor, id=f"{sensor.id}_{number}")
    return Finding(tuple(sensors), tuple(trajectories))


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


def _groups(root: Path, files: Sequence[Path]) -> Iterator[_Group]:
    """Group files by folder and ending, and by the text of their names where these are a few different texts."""
    by_folder: dict[tuple[Path, str], dict[str, list[Path]]] = {}
    for path in files:
        shapes = by_folder.setdefault((path.parent, path.suffix), {})
        shapes.setdefault(_DIGITS.sub("*", path.name), []).append(path)
    for (folder, suffix), shapes in by_folder.items():
        location = folder.relative_to(root).as_posix()
        prefix = "" if location == "." else f"{escape(location)}/"
        if len(shapes) == 1 or len(shapes) > _MOST_SHAPES:
            alike = [path for paths in shapes.values() for path in paths]
            # the folder's name, or that of its parent where its own says only what all such folders hold
            generic = folder.name.lower() in {"data", "images", "image", "points", "pointcloud", "clouds", "frames"}
            own = folder.parent.name if generic and folder.parent != root else folder.name
            name = own if prefix else _longest_word(next(iter(shapes)), suffix)
            yield _Group(folder, f"{prefix}*{suffix}", _plain(name), tuple(alike))
            continue
        for shape, paths in shapes.items():
            pattern = "*".join(map(escape, re.sub(r"\*[*\W]*\*", "*", shape).split("*")))
            yield _Group(folder, prefix + pattern, _plain(_longest_word(shape, suffix)), tuple(paths))


def _longest_word(shape: str, suffix: str) -> str:
    """The longest word of a name, without the numbers around it."""
    words = [word for word in re.split(r"[*\W]+|__", shape.rpartition(".")[0]) if len(word) > 1]
    return max(words, key=len, default=suffix[1:])


def _plain(name: str) -> str:
    return re.sub(r"\W+", "_", name).strip("_") or "sensor"


def _several(group: _Group) -> str:
    return f"{len(group.files)} {'file' if len(group.files) == 1 else 'files'}"


def _lidar(root: Path, group: _Group, texts: Sequence[Path]) -> _FoundSensor:
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
        further += _column_hints(cloud.columns)
    except DataError as error:
        about = f"{_several(group)}; the first cannot be read: {error.problem}"
    further.append('timestamp = "start"   # of the sweep; or "middle", "end" together with sweep_s')
    times = _times(root, group, texts)
    return _FoundSensor(group.name, "lidar", {"files": group.pattern}, " ".join(about.split()), times, further=further)


def _guess_layout(path: Path) -> FieldLayout | None:
    """The known layout whose numbers look like positions and intensities; None where neither does."""
    for layout in (NUSCENES, KITTI) if path.name.lower().endswith(".pcd.bin") else (KITTI, NUSCENES):
        try:
            columns = read_cloud(path, layout=layout).columns
        except DataError:
            continue
        positions = np.stack([columns[name] for name in "xyz"])
        finite = np.isfinite(positions) & (np.abs(positions) < _FARTHEST)
        if finite.size and finite.mean() > 0.99 and (columns["intensity"] >= 0).mean() > 0.99:
            return layout
    return None


_LIKE_TIMES = re.compile(r"time|timestamp|offset|(^|_)dt($|_)|delta", re.IGNORECASE)

_SPEAKABLE = re.compile(r"[\w.:/ -]+")  # names that can stand in a text as they are; others are not worth a hint

_UNITS_BY_ENDING = {"ns": "nanoseconds", "us": "microseconds", "ms": "milliseconds"}


def _column_hints(columns: Mapping[str, AnyArray]) -> list[str]:
    """How the columns that are not known by name can be named: as comments, since each would be a guess."""
    roles = find_roles(columns, {})
    unknown = [name for name in columns if name not in roles.values() and _SPEAKABLE.fullmatch(name)]
    axes = [] if "positions" in roles else [axis for axis in "xyz" if axis not in roles]
    times = [name for name in unknown if _LIKE_TIMES.search(name)] if "time" not in roles else []
    others = [name for name in unknown if name not in times]
    hints = []
    if axes:
        listed = ", ".join(f'{axis} = "?"' for axis in axes)
        hints.append(f"# use = {{ {listed} }}   # needed: which of {' '.join(unknown)} are these?")
    elif others and "intensity" not in roles:
        hints.append(f'# use = {{ intensity = "{others[0]}" }}   # if it is that; not used by name: {" ".join(others)}')
    if times:
        unit = _UNITS_BY_ENDING.get(times[0].rpartition("_")[2].lower(), "seconds")
        hints.append(f'# point_times = {{ field = "{times[0]}", unit = "{unit}" }}   # if it is when each was measured')
    return hints


def _video(root: Path, path: Path) -> _FoundSensor:
    from sceneloom.formats.video.reader import open_video

    with open_video(path) as video:
        size, about = (video.width, video.height), f"{video.count} images, {video.codec}"
    name = path.relative_to(root).as_posix()
    return _FoundSensor(_plain(path.stem), "camera", {"video": name}, about, {"container": True, "start_s": 0.0}, size)


def _times(root: Path, group: _Group, texts: Sequence[Path]) -> Mapping[str, str | float | bool]:
    """How the files' times may be found: a list beside them, else their names, else an even rate."""
    listed = _listed_times(root, group, texts)
    if listed:
        return listed
    stem = group.files[0].name.removesuffix(group.files[0].suffix).removesuffix(".pcd")
    pattern = _timestamp_pattern(stem)
    if pattern is not None:
        return {"pattern": pattern}
    runs = list(_DIGITS.finditer(stem))
    if runs and len(group.files) > 1:
        before, after = stem[: runs[-1].start()], stem[runs[-1].end() :]
        return {"pattern": f"{'*' if before else ''}{{index}}{after}", "rate_hz": float("nan")}
    return {"rate_hz": float("nan"), "start_s": 0.0}


def _timestamp_pattern(stem: str) -> str | None:
    """The likeliest pattern that finds a timestamp of our years in a name."""

    def around(match: re.Match[str], placeholders: str) -> str:
        # numbers behind a timestamp may be others in the next name
        return f"{'*' if match.start() else ''}{placeholders}{_DIGITS.sub('*', stem[match.end() :])}"

    split = re.search(r"(?<!\d)(\d{10})(?:\.\d+|([_-])(\d{9}|\d{6}|\d{3}))(?!\d)", stem)
    if split:
        # after a point stand decimals, of which some programs leave out the last zeros
        return around(split, "{s}" + (split[2] + _PARTS_BY_DIGITS[len(split[3])] if split[3] else ""))
    for run in reversed(list(_DIGITS.finditer(stem))):
        unit = _UNITS_BY_DIGITS.get(len(run[0]))
        # a clock that begins at 0 leaves zeros in front; only nanoseconds have more digits than counters
        if unit is not None and (run[0][0] != "0" or unit == "{ns}"):
            return around(run, unit)
    return None


def _listed_times(root: Path, group: _Group, texts: Sequence[Path]) -> Mapping[str, str | float | bool]:
    """A text file beside the files, or above them, that holds a time for each of them."""
    near = [path for path in texts if path.parent in {group.folder, group.folder.parent}]
    for path in sorted(near, key=lambda path: path.parent != group.folder):
        name = path.relative_to(root).as_posix()
        table = _read_table(path)
        if table is not None and len(table.rows) == len(group.files):
            column, files = table.find(TIME_COLUMNS), table.find(FILE_COLUMNS)
            if column is not None and (files is not None or path.parent == group.folder):
                known = {file.name for file in group.files} | {file.stem for file in group.files}
                if files is None or Path(table.rows[0][files]).name in known:
                    return {"csv": name, "column": table.names[column]}
        if path.suffix.lower() == ".txt" and _count_timestamps(path) == len(group.files):
            return {"lines": name}
    return {}


def _read_table(path: Path) -> Table | None:
    try:
        return read_table(path)
    except DataError:
        return None


def _count_timestamps(path: Path) -> int | None:
    """How many times a text file holds, one per line; None where a line is something else."""
    try:
        return len(line_timestamps(path, None))
    except (DataError, TimestampError):
        return None


def _motion_sensor(root: Path, path: Path) -> _FoundSensor | None:
    table = _read_table(path) if path.suffix.lower() == ".csv" else None
    if table is None or table.find(TIME_COLUMNS) is None:
        return None
    kind = None
    if table.find(("ax", "acc_x", "accel_x", "gx", "wx", "gyro_x")) is not None:
        kind = "imu"
    elif table.find(("lat", "latitude")) is not None and table.find(("alt", "altitude", "height")) is not None:
        kind = "gnss"
    about = f"{len(table.rows)} {'row' if len(table.rows) == 1 else 'rows'}"
    file = {"file": path.relative_to(root).as_posix()}
    return None if kind is None else _FoundSensor(_plain(path.stem), kind, file, about)


def _trajectory(root: Path, path: Path, texts: Sequence[Path]) -> _FoundTrajectory | None:
    name, stem = path.relative_to(root).as_posix(), _plain(path.stem)
    table = _read_table(path) if path.suffix.lower() == ".csv" else None
    if table is not None:
        placed = all(table.find((axis, f"t{axis}", f"p{axis}", f"pos_{axis}")) is not None for axis in "xyz")
        timed = table.find(TIME_COLUMNS) is not None
        return _FoundTrajectory(stem, name, "csv") if placed and timed else None
    try:
        rows = read_table(path, named=False)
        rows.numbers(range(len(rows.rows[0])))
    except DataError:
        return None
    if len(rows.rows[0]) == 8:
        return _FoundTrajectory(stem, name, "tum")
    if len(rows.rows[0]) != 12:
        return None
    timestamped = [text for text in texts if text != path and _count_timestamps(text) == len(rows.rows)]
    times = timestamped[0].relative_to(root).as_posix() if timestamped else "times.txt"
    return _FoundTrajectory(stem, name, "kitti", times)
