"""The tables of the nuScenes schema, and reading them row by row: those of the whole data set have gigabytes.

Source: "nuScenes schema" of the nuScenes development kit; `lidarseg` and `category.index` are those of
nuScenes-lidarseg.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.files import open_file, read_bytes

Microseconds = Annotated[int, msgspec.Meta(ge=-9_000_000_000_000_000, le=9_000_000_000_000_000)]
"""A time; as nanoseconds it has to be within 64 bits."""

Vector = tuple[float, float, float]
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
    timestamp: Microseconds
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
    timestamp: Microseconds
    is_key_frame: bool
    fileformat: str = ""
    width: int | None = None
    height: int | None = None
    next: str = ""
    prev: str = ""


class EgoPoseRow(msgspec.Struct, kw_only=True):
    """Where the ego was: world from ego."""

    token: str
    translation: Vector
    rotation: Quaternion
    timestamp: Microseconds


class CalibratedSensorRow(msgspec.Struct, kw_only=True):
    """How a sensor is mounted, ego from sensor, and what it sees through."""

    token: str
    sensor_token: str
    translation: Vector
    rotation: Quaternion
    camera_intrinsic: list[Vector] = []


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
    translation: Vector
    size: Vector
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

Row = TypeVar("Row")


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
