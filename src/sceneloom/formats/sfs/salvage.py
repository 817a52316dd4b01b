"""Salvage: what is whole in a scene file that was cut off or damaged, written as a new file."""

import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from json.decoder import scanstring  # type: ignore[attr-defined]
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.files import is_url
from sceneloom.formats.base.output import check_output
from sceneloom.formats.sfs.annotations import encode_annotation
from sceneloom.formats.sfs.container import ITEMS, Container, ItemFault, format_keys
from sceneloom.formats.sfs.reader import read_container
from sceneloom.formats.sfs.records import Location
from sceneloom.formats.sfs.sensors import UNKNOWN_CODEC
from sceneloom.formats.sfs.spec import ReadingOptions
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import key_of
from sceneloom.warnings import DataWarning, WarningKind

_BLANK = " \t\r\n"
_OURS = ("metadata", "sceneloom")

_TAKEN_APART = frozenset(
    {
        ("sensors",),
        ("annotations",),
        ("attributes",),
        ("metadata",),
        _OURS,
        *((*_OURS, name) for name in ("sensors", "annotations", "attributes", "trajectories", "sensor_notes")),
    }
)
"""Objects and lists of which a part is worth something; everything below them is whole or lost."""


def recover_header(text: memoryview, file: str) -> tuple[Any, list[tuple[str, str, int]]]:
    """Decode a header as far as it is whole.

    Returns:
        The header, and what is lost of it: location, problem, bytes.

    Raises:
        DataError: nothing of it can be read.
    """
    content = bytes(text)
    if not content.strip():
        raise DataError(
            file,
            "header",
            "the space for it is empty: this is the draft of a writer that was stopped before it could write the "
            "header, and nothing else says what the arrays are; record or convert the drive again",
        )
    try:
        return msgspec.json.decode(content), []
    except (ValueError, RecursionError):
        return _Recovery(content.decode("utf-8", "replace"), file).run()


class _Recovery:
    """Reads JSON up to the first damage."""

    def __init__(self, text: str, file: str) -> None:
        self._text, self._file = text, file
        self._decoder = json.JSONDecoder()
        self._broken = -1
        self._lost: list[tuple[str, str, int]] = []

    def run(self) -> tuple[Any, list[tuple[str, str, int]]]:
        start = self._skip(0)
        if not self._text.startswith("{", start):
            raise DataError(self._file, "header", "does not begin as the header of a scene; nothing can be reported")
        header = self._parts(start, ())[0]
        if self._broken >= 0 and ITEMS not in header:
            self._find_items(header)
        return header, self._lost

    def _parts(self, location: int, keys: tuple[Any, ...]) -> tuple[Any, int]:
        """Read the members of an object, or the entries of a list, until one is damaged."""
        is_object = self._text.startswith("{", location)
        closing, found = "}" if is_object else "]", dict[Any, Any]()
        location = self._skip(location + 1)
        while self._text[location : location + 1] not in {closing, ""} and self._broken < 0:
            key: str | int = len(found)
            try:
                if is_object:
                    key, location = self._name(location)
                found[key], location = self._value(location, (*keys, key))
            except _DamageError:
                location = self._note(location, (*keys, "…" if is_object else len(found)))
            if self._broken < 0:
                location = self._after(location, keys)
        if self._broken < 0:
            closed = self._text.startswith(closing, location)
            location = location + 1 if closed else self._note(location, keys)
        return found if is_object else list(found.values()), location

    def _name(self, location: int) -> tuple[str, int]:
        if not self._text.startswith('"', location):
            raise _DamageError
        try:
            name, location = scanstring(self._text, location + 1)
        except ValueError:
            raise _DamageError from None
        location = self._skip(location)
        if not self._text.startswith(":", location):
            raise _DamageError
        return name, self._skip(location + 1)

    def _value(self, location: int, keys: tuple[Any, ...]) -> tuple[Any, int]:
        try:
            value, stop = self._decoder.raw_decode(self._text, location)
        except (ValueError, RecursionError):
            if keys not in _TAKEN_APART or not self._text.startswith(("{", "["), location):
                raise _DamageError from None
            return self._parts(location, keys)
        if isinstance(value, int | float) and stop == len(self._text):
            raise _DamageError  # further digits may have stood behind the cut
        return value, stop

    def _after(self, location: int, keys: tuple[Any, ...]) -> int:
        """Go over the comma behind a value; what stands there else is damage."""
        location = self._skip(location)
        if self._text.startswith(",", location):
            return self._skip(location + 1)
        if self._text[location : location + 1] not in {"}", "]", ""}:
            return self._note(location, keys)
        return location

    def _note(self, location: int, keys: tuple[Any, ...]) -> int:
        """Remember where the damage is; what comes after it is lost."""
        if self._broken < 0:
            self._broken = location
            size = len(self._text[location:].encode("utf-8", "replace"))
            problem = "the header is cut off or damaged here; what follows is lost"
            self._lost.append((format_keys(keys) or "header", problem, size))
        return len(self._text)

    def _find_items(self, header: dict[str, Any]) -> None:
        """Find the list of arrays behind the damage; it stands last, and each of its entries says where it belongs."""
        location = self._text.rfind(f'"{ITEMS}"', self._broken)
        if location < 0:
            return
        self._broken = -1
        try:
            _, location = self._name(location)
            items, _ = self._decoder.raw_decode(self._text, location)
        except (_DamageError, ValueError, RecursionError):
            return
        if isinstance(items, list):
            header[ITEMS] = items

    def _skip(self, location: int) -> int:
        """Go over blanks."""
        while location < len(self._text) and self._text[location] in _BLANK:
            location += 1
        return location


class _DamageError(Exception):
    """Something is not whole here."""


class LostPart(msgspec.Struct, frozen=True):
    """Something of a damaged file that is not in the salvaged scene.

    Attributes:
        location: where it was (`sensors[0].frames[12]`).
        problem: what is wrong there.
        bytes: how many bytes of arrays go with it; of the header where that is damaged.
    """

    location: str
    problem: str
    bytes: int = 0


class KeptSensor(msgspec.Struct, frozen=True):
    """A sensor of the salvaged scene; `kept` of the `count` frames or images that the damaged file lists are there."""

    id: str | int
    type: str
    kept: int
    count: int


class SalvageReport(msgspec.Struct, frozen=True):
    """What was taken out of a damaged file.

    Attributes:
        source: the damaged file.
        output: the scene that was written.
        size_bytes: length of the damaged file.
        sensors: those of the scene.
        annotations: how many annotations it has.
        lost: what it has not; empty if the file was whole.
    """

    source: str
    output: str
    size_bytes: int
    sensors: tuple[KeptSensor, ...]
    annotations: int
    lost: tuple[LostPart, ...]

    @property
    def lost_bytes(self) -> int:
        """Bytes of all that is lost."""
        return sum(part.bytes for part in self.lost)


def salvage(path: str | Path, output: str | Path, *, overwrite: bool = False) -> SalvageReport:
    """Write a scene of what is whole in a file that was cut off or damaged.

    Frames whose points are lost are left out; of others, only the arrays that are lost. A video that was cut keeps the
    images that are whole if its tables stand before them. A header that was cut keeps the sensors and annotations
    that are complete. Nothing is guessed: an array is taken only where the header says that it is.
    What names a lost sensor or annotation keeps the name, for a rule to report.

    Args:
        path: the damaged file.
        output: the scene file to be made.
        overwrite: whether a file there may be replaced.

    Raises:
        DataError: nothing of the file can be read.
        OutputError: the output exists, or cannot be written.
    """
    if is_url(path):
        raise DataError(path, "", "is behind a URL; download it first: salvaging looks at all of a file")
    source, target = Path(path), Path(output)
    check_output(target, overwrite=overwrite)
    if target.exists() and source.exists() and target.samefile(source):
        raise DataError(source, "", "is the output, too; choose another name: the damaged file stays as it is")
    items: list[ItemFault] = []
    lost: list[LostPart] = []

    def decode(text: memoryview, file: str) -> Any:
        header, of_header = recover_header(text, file)
        lost.extend(LostPart(*part) for part in of_header)
        return header

    container = Container(source, faults=items, decode=decode)
    try:
        counts = _frame_counts(container.header)
        scene = _sound_scene(container, items, lost)
        write_scene(scene, target, overwrite=overwrite)
        sensors = []
        for sensor in scene.sensors:
            frames = sensor.images if isinstance(sensor, CameraSensor) else ()
            kept = len(sensor.frames if isinstance(sensor, LidarSensor | RadarSensor) else frames)
            count = max(kept, counts.get(key_of(sensor.id), kept))
            sensors.append(KeptSensor(sensor.id, str(sensor.type), kept, count))
        annotations = len(scene.annotations)
        return SalvageReport(str(source), str(target), container.size, tuple(sensors), annotations, tuple(lost))
    finally:
        container.close()


def _frame_counts(header: Mapping[str, Any]) -> dict[tuple[type, Any], int]:
    """How many frames or images the header lists, by the id of their sensor."""
    counts = {}
    sensors = header.get("sensors")
    for sensor in sensors if isinstance(sensors, list) else []:
        identifier = sensor.get("id") if isinstance(sensor, dict) else None
        if isinstance(identifier, str | int):
            video = sensor.get("video")
            times = video.get("timestamps") if isinstance(video, dict) else None
            lists = (sensor.get("frames"), sensor.get("images"), times)
            counts[type(identifier), identifier] = next((len(v) for v in lists if isinstance(v, list)), 0)
    return counts


def _sound_scene(container: Container, items: list[ItemFault], lost: list[LostPart]) -> Scene:
    """Read what is sound of a damaged file, and list what is not."""
    sizes = []
    for number in range(container.item_count):
        keys = container.item_keys(number)
        if keys is not None:
            length = container.item(number).get("length")
            sizes.append((keys, length if type(length) is int else 0))
    examined = read_container(container, items, ReadingOptions(), whole=True, vital=True)
    bytes_of: dict[Location, int] = defaultdict(int)
    wanted = {loss.keys for loss in examined.losses}
    for keys, size in sizes:
        inside = next((keys[:depth] for depth in range(1, len(keys) + 1) if keys[:depth] in wanted), None)
        if inside is not None:
            bytes_of[inside] += size
    for loss in examined.losses:
        lost_bytes = bytes_of[loss.keys] if loss.lost_bytes is None else loss.lost_bytes
        lost.append(LostPart(format_keys(loss.keys), loss.problem, lost_bytes))
    if examined.scene is None:
        raise DataError(container.file, "", "nothing of it can be read")
    scene = replace(examined.scene, sensors=tuple(_readable(sensor, lost) for sensor in examined.scene.sensors))
    annotations = []
    for annotation in scene.annotations:
        try:  # numbers that are not finite are passed on by a reader and refused by a writer
            encode_annotation(annotation)
            annotations.append(annotation)
        except OptionError as error:
            location, _, problem = str(error).partition(": ")
            lost.append(LostPart(location, problem))
    scene = replace(scene, annotations=tuple(annotations))
    if not lost:
        return scene
    message, kind = f"taken out of {container.file}, which was damaged", WarningKind.SKIPPED
    warning = DataWarning(kind=kind, code="salvaged", location="", message=message, count=len(lost))
    return replace(scene, warnings=(*scene.warnings, warning))


def _readable(sensor: Sensor, lost: list[LostPart]) -> Sensor:
    """Leave out frames that the header lists soundly and that cannot be made all the same, and broken videos."""
    if isinstance(sensor, CameraSensor):
        problem = _video_problem(sensor)
        if problem is None:
            return sensor
        lost.append(LostPart(f"sensors[{sensor.id}].video", problem))
        return replace(sensor, images=LazyFrames.of([], []), video=None, fps=None)
    if not isinstance(sensor, LidarSensor | RadarSensor):
        return sensor
    frames: LazyFrames[Any] = sensor.frames
    kept = []
    for index in range(len(frames)):
        try:
            frames[index]
            kept.append(index)
        except DataError as error:
            lost.append(LostPart(error.location, error.problem))
    if len(kept) == len(frames):
        return sensor
    readable: Any = LazyFrames(frames.timestamps_ns[np.array(kept, np.int64)], lambda k: frames[kept[k]])
    return replace(sensor, frames=readable)


def _video_problem(camera: CameraSensor) -> str | None:
    """Why a camera's video cannot be written; None where it can."""
    from sceneloom.formats.video.reader import read_index

    if camera.video is None or not len(camera.images):
        return None
    try:
        camera.images[0]  # opens the video
        if camera.video.codec != UNKNOWN_CODEC:
            return None
        count = len(read_index(camera.video.open, "video"))
    except DataError as error:
        return error.problem
    timestamps = len(camera.images)
    return None if count == timestamps else f"{count} images; expected {timestamps} as its timestamps"
