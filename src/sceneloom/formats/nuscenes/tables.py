"""Tables of the nuScenes schema: rows, tokens, and which times are samples."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.files import open_file, read_bytes
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.scene import Scene

_Microseconds = Annotated[int, msgspec.Meta(ge=-9_000_000_000_000_000, le=9_000_000_000_000_000)]
"""A time; as nanoseconds it has to be within 64 bits."""

_Vector = tuple[float, float, float]

Quaternion = tuple[float, float, float, float]
"""w, x, y, z."""


class SceneRow(msgspec.Struct, kw_only=True):
    """A stretch of a log, which is what is opened as a scene."""

    token: str
    name: str
    description: str = ""
    log_token: str = ""
    nbr_samples: int = 0
    first_sample_token: str = ""
    last_sample_token: str = ""


class SampleRow(msgspec.Struct, kw_only=True):
    """A moment at which objects are labelled; times are microseconds."""

    token: str
    timestamp: _Microseconds
    scene_token: str
    next: str = ""
    prev: str = ""


class SampleDataRow(msgspec.Struct, kw_only=True):
    """One image, sweep or radar cycle."""

    token: str
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    filename: str
    timestamp: _Microseconds
    is_key_frame: bool
    fileformat: str = ""
    width: int | None = None
    height: int | None = None
    next: str = ""
    prev: str = ""


class EgoPoseRow(msgspec.Struct, kw_only=True):
    """Where the ego was: world from ego."""

    token: str
    translation: _Vector
    rotation: Quaternion
    timestamp: _Microseconds


class CalibratedSensorRow(msgspec.Struct, kw_only=True):
    """How a sensor is mounted, ego from sensor, and what it sees through."""

    token: str
    sensor_token: str
    translation: _Vector
    rotation: Quaternion
    camera_intrinsic: list[_Vector] = []


class SensorRow(msgspec.Struct, kw_only=True):
    """A sensor by its name; `sensor_id` is ours, beside channels that are not the sensor's own id."""

    token: str
    channel: str
    modality: str
    sensor_id: str | int | None = None

    @property
    def id(self) -> str | int:
        """What the sensor is called in a scene."""
        return self.channel if self.sensor_id is None else self.sensor_id


class LogRow(msgspec.Struct, kw_only=True):
    """A recording out of which scenes were cut."""

    token: str
    logfile: str = ""
    vehicle: str = ""
    date_captured: str = ""
    location: str = ""


class CategoryRow(msgspec.Struct, kw_only=True):
    """A class of objects; `index` is its number in the files of nuScenes-lidarseg."""

    token: str
    name: str
    description: str = ""
    index: int | None = None


class NamedRow(msgspec.Struct, kw_only=True):
    """What an object does."""

    token: str
    name: str
    description: str = ""


class VisibilityRow(msgspec.Struct, kw_only=True):
    """How much of an object the cameras see."""

    token: str
    level: str
    description: str = ""


class InstanceRow(msgspec.Struct, kw_only=True):
    """An object."""

    token: str
    category_token: str
    nbr_annotations: int = 0
    first_annotation_token: str = ""
    last_annotation_token: str = ""


class AnnotationRow(msgspec.Struct, kw_only=True):
    """A box of an object at a sample, in the world; its size is width, length, height."""

    token: str
    sample_token: str
    instance_token: str
    translation: _Vector
    size: _Vector
    rotation: Quaternion
    attribute_tokens: list[str] = []
    visibility_token: str = ""
    num_lidar_pts: int = 0
    num_radar_pts: int = 0
    next: str = ""
    prev: str = ""


class LidarsegRow(msgspec.Struct, kw_only=True):
    """The file with the classes of the points of a sweep."""

    token: str
    sample_data_token: str
    filename: str


TABLES: dict[str, type[Any]] = {
    "scene": SceneRow,
    "sample": SampleRow,
    "sample_data": SampleDataRow,
    "ego_pose": EgoPoseRow,
    "calibrated_sensor": CalibratedSensorRow,
    "sensor": SensorRow,
    "log": LogRow,
    "category": CategoryRow,
    "attribute": NamedRow,
    "visibility": VisibilityRow,
    "instance": InstanceRow,
    "sample_annotation": AnnotationRow,
    "lidarseg": LidarsegRow,
}
"""What is read, by the name of the file; `map` is left out."""

NEEDED = ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor")
"""Tables without which no scene can be opened."""

_PIECE = 1 << 23
_LONGEST_ROW = 1 << 16
_ROW_END = re.compile(rb"\}\s*,")
_FIELD = re.compile(r"\$\[(?P<row>\d+)\](?:\.(?P<field>\S+?))?`?$")


def iter_rows(folder: Path, table: str) -> Iterator[Any]:
    """Give the rows of a table one by one; a piece of the file is in memory at a time.

    Args:
        folder: with the tables.
        table: one of `TABLES`.

    Raises:
        DataError: the file is missing, no JSON, or a row lacks a field or has one of another type.
    """
    path = folder / f"{table}.json"
    rows_of_table: Any = list.__class_getitem__(TABLES[table])
    decoder: msgspec.json.Decoder[list[Any]] = msgspec.json.Decoder(rows_of_table)
    given = 0
    try:
        for piece in _chunks(path):
            rows = _rows_of_piece(decoder, piece)
            if rows is None:
                # the piece ends inside a text, or is wrong: the whole file reports
                yield from _decoded(path, decoder, read_bytes(path))[given:]
                return
            given += len(rows)
            yield from rows
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}; expected a table of the nuScenes schema"
        raise DataError(path, "", problem) from error


def _chunks(path: Path) -> Iterator[bytes]:
    """Cut a JSON list of objects into shorter lists of whole objects."""
    with open_file(path) as file:
        content = file.read(_PIECE)
        if len(content) < _PIECE:
            yield content
            return
        rest = content.lstrip().removeprefix(b"\xef\xbb\xbf").removeprefix(b"[")
        while content:
            for cut in [*_ROW_END.finditer(rest, max(0, len(rest) - _LONGEST_ROW))][-1:]:
                yield b"[" + rest[: cut.start() + 1] + b"]"
                rest = rest[cut.end() :]
            content = file.read(_PIECE)
            rest += content
        yield b"[" + rest


def _rows_of_piece(decoder: "msgspec.json.Decoder[list[Any]]", piece: bytes) -> list[Any] | None:
    try:
        return decoder.decode(piece)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


def _decoded(path: Path, decoder: "msgspec.json.Decoder[list[Any]]", content: bytes) -> list[Any]:
    try:
        return decoder.decode(content)
    except msgspec.ValidationError as error:
        problem, _, location = str(error).partition(" - at `")
        found = _FIELD.search(location)
        where = "" if found is None else ".".join(filter(None, (f"row {found['row']}", found["field"])))
        raise DataError(path, where, problem) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(path, "", f"is no JSON: {error}") from error


def token_of(*parts: object) -> str:
    """A token of 32 hexadecimal digits, as nuScenes has them."""
    return blake2b("\0".join(map(str, parts)).encode(), digest_size=16).hexdigest()


_RATE_HZ = 2.0
"""Samples a second in nuScenes."""

KEY_FRAMES = "key_frames_us"
"""Under this name a sensor that was read from nuScenes keeps the times of its key frames."""

Written = LidarSensor | RadarSensor | CameraSensor
_SECOND = 1_000_000_000
_MICROSECOND = 1000


def timestamps_of(sensor: Written) -> Int64Array:
    """The times of a sensor's frames [ns]."""
    return (sensor.images if isinstance(sensor, CameraSensor) else sensor.frames).timestamps_ns


def microseconds(timestamps_ns: Int64Array) -> Int64Array:
    """Times [ns] as the tables have them [µs]; halves go to the even one."""
    whole: Int64Array = np.rint(timestamps_ns % _SECOND / _MICROSECOND).astype(np.int64)
    return timestamps_ns // _SECOND * 1_000_000 + whole


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """The samples of a scene.

    Attributes:
        tokens: of each.
        timestamps_ns: (S,) int64 [ns], ascending.
        reach_ns: how far from a sample its frames may be.
    """

    tokens: tuple[str, ...]
    timestamps_ns: Int64Array
    reach_ns: int

    def key_rows(self, sensor: Written) -> BoolArray:
        """(N,) bool: which frames of a sensor are key frames: the nearest one of each sample, at most one each."""
        timestamps = timestamps_of(sensor)
        known = sensor.extras.get(KEY_FRAMES)
        if isinstance(known, list | tuple):
            return np.isin(microseconds(timestamps), np.array(known, np.int64))
        chosen = np.zeros(len(timestamps), np.bool_)
        for time in self.timestamps_ns.tolist():
            after = int(np.searchsorted(timestamps, time))
            near = [row for row in (after - 1, after) if 0 <= row < len(timestamps) and not chosen[row]]
            best = min(near, key=lambda row: abs(int(timestamps[row]) - time), default=None)
            if best is not None and abs(int(timestamps[best]) - time) <= self.reach_ns:
                chosen[best] = True
        return chosen

    def numbers(self, sensor: Written, is_key: BoolArray) -> Int64Array:
        """(N,) int64: the sample that each frame belongs to: of key frames the nearest, else the next one."""
        timestamps = timestamps_of(sensor)
        after = np.minimum(np.searchsorted(self.timestamps_ns, timestamps), len(self.timestamps_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.abs(timestamps - self.timestamps_ns[before]) < np.abs(timestamps - self.timestamps_ns[after])
        return np.where(is_key & nearer, before, after).astype(np.int64)


def choose_samples(scene: Scene, sensors: list[Written], *, rate_hz: float | None, name: str) -> Samples:
    """Choose the samples: those that the scene was read with, else so many a second of the first lidar's frames.

    Args:
        scene: what is written.
        sensors: those that are written; without a lidar the first of them counts.
        rate_hz: samples a second; None: as read, else two.
        name: of the scene, for the tokens.

    Raises:
        DataError: no sensor has a frame.
    """
    framed = [sensor for sensor in sensors if len(timestamps_of(sensor))]
    if not framed:
        raise DataError(scene.source, "", "holds no sweep, radar cycle or image that nuScenes could hold")
    reference = next((sensor for sensor in framed if isinstance(sensor, LidarSensor)), framed[0])
    timestamps = np.sort(timestamps_of(reference))
    if rate_hz is None:
        read = _samples_read(scene.metadata.get("nuscenes"), timestamps)
        if read is not None:
            return read
    chosen = _spread(timestamps, _SECOND / (rate_hz or _RATE_HZ))
    tokens = tuple(token_of("sample", name, time) for time in chosen.tolist())
    return Samples(tokens, chosen, round(_SECOND / (rate_hz or _RATE_HZ) / 2))


def _samples_read(about: Any, timestamps_ns: Int64Array) -> Samples | None:
    """The samples that the scene was read with, as far as the reference still has their frames."""
    rows = about.get("samples") if isinstance(about, Mapping) else None
    if not isinstance(rows, list | tuple):
        return None
    there = set(microseconds(timestamps_ns).tolist())
    kept = [(str(token), int(time)) for token, time in rows if int(time) in there]
    if not kept:
        return None
    times = np.array([time for _, time in kept], np.int64) * _MICROSECOND
    return Samples(tuple(token for token, _ in kept), times, round(_SECOND / _RATE_HZ / 2))


def _spread(timestamps_ns: Int64Array, period_ns: float) -> Int64Array:
    """Timestamps that are a period apart, as nearly as there are."""
    slack = float(np.median(np.diff(timestamps_ns))) / 2 if len(timestamps_ns) > 1 else 0.0
    chosen: list[int] = []
    due = float(timestamps_ns[0])
    for time in timestamps_ns.tolist():
        if time >= due - slack and (not chosen or time > chosen[-1]):
            chosen.append(time)
            due = max(due + period_ns, time + period_ns / 2)
    return np.array(chosen, np.int64)
