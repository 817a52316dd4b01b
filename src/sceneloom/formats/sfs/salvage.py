"""Salvage: what is whole in a scene file that was cut off or damaged, written as a new file."""

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
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
from sceneloom.formats.sfs.images import as_keys, video_problem
from sceneloom.formats.sfs.reader import read_container
from sceneloom.formats.sfs.records import Location
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
        header = self._object(start, ())[0]
        if self._broken >= 0 and ITEMS not in header:
            self._find_items(header)
        return header, self._lost

    def _object(self, location: int, keys: tuple[Any, ...]) -> tuple[dict[str, Any], int]:
        """Read members until one is damaged."""
        found: dict[str, Any] = {}
        location = self._skip(location + 1)
        while self._text[location : location + 1] not in {"}", ""}:
            try:
                name, location = self._name(location)
                found[name], location = self._value(location, (*keys, name))
            except _DamageError:
                return found, self._note(location, (*keys, "…"))
            if self._broken >= 0:
                return found, location
            location = self._after(location, keys)
        return found, self._closed(location, "}", keys)

    def _list(self, location: int, keys: tuple[Any, ...]) -> tuple[list[Any], int]:
        """Read entries until one is damaged."""
        found: list[Any] = []
        location = self._skip(location + 1)
        while self._text[location : location + 1] not in {"]", ""}:
            try:
                value, location = self._value(location, (*keys, len(found)))
            except _DamageError:
                return found, self._note(location, (*keys, len(found)))
            found.append(value)
            if self._broken >= 0:
                return found, location
            location = self._after(location, keys)
        return found, self._closed(location, "]", keys)

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
            readers = {"{": self._object, "[": self._list} if keys in _TAKEN_APART else {}
            reader = readers.get(self._text[location : location + 1])
            if reader is None:
                raise _DamageError from None
            return reader(location, keys)
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

    def _closed(self, location: int, bracket: str, keys: tuple[Any, ...]) -> int:
        if self._broken < 0 and self._text.startswith(bracket, location):
            return location + 1
        return location if self._broken >= 0 else self._note(location, keys)

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


_COUNTED = ("frames", "images")


class LostPart(msgspec.Struct, frozen=True):
    """Something of a damaged file that is not in the salvaged scene.

    Attributes:
        location: where it was (`sensors[0].frames[12]`).
        problem: what is wrong there.
        bytes: how many bytes of arrays go with it; of the header where that is damaged.
    """

    location: str
    problem: str
    bytes: int


class KeptSensor(msgspec.Struct, frozen=True):
    """A sensor of the salvaged scene.

    Attributes:
        id: as in the file.
        type: "lidar", "camera", …
        kept: how many of its frames or images are there.
        count: how many the damaged file lists.
    """

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
    rescue = _Rescue(source)
    try:
        scene = rescue.scene()
        write_scene(scene, target, overwrite=overwrite)
        return SalvageReport(
            str(source),
            str(target),
            rescue.container.size,
            rescue.kept_sensors(scene),
            len(scene.annotations),
            tuple(rescue.lost),
        )
    finally:
        rescue.container.close()


class _Rescue:
    """A damaged file whose header is being brought into order."""

    def __init__(self, path: Path) -> None:
        self.lost: list[LostPart] = []
        self._items: list[ItemFault] = []
        self.container = Container(path, faults=self._items, decode=self._decode)
        self._counts = _frame_counts(self.container.header)
        self._sizes = self._item_sizes()

    def scene(self) -> Scene:
        """Read what is sound, and list what is not."""
        examined = read_container(self.container, self._items, ReadingOptions(), whole=True, vital=True)
        bytes_of = self._bytes_below(loss.keys for loss in examined.losses)
        for loss in examined.losses:
            lost_bytes = bytes_of[loss.keys] if loss.lost_bytes is None else loss.lost_bytes
            self.lost.append(LostPart(format_keys(loss.keys), loss.problem, lost_bytes))
        if examined.scene is None:
            raise DataError(self.container.file, "", "nothing of it can be read")
        scene = self._without_unwritable(self._without_unreadable(examined.scene))
        if self.lost:
            message = f"taken out of {self.container.file}, which was damaged"
            warning = DataWarning(
                kind=WarningKind.SKIPPED, code="salvaged", location="", message=message, count=len(self.lost)
            )
            scene = replace(scene, warnings=(*scene.warnings, warning))
        return scene

    def kept_sensors(self, scene: Scene) -> tuple[KeptSensor, ...]:
        """Report of each sensor how much of it is there."""
        found = []
        for sensor in scene.sensors:
            kept = len(_frames_of(sensor))
            count = self._counts.get(key_of(sensor.id), kept)
            found.append(KeptSensor(sensor.id, str(sensor.type), kept, max(kept, count)))
        return tuple(found)

    def _decode(self, text: memoryview, file: str) -> Any:
        header, lost = recover_header(text, file)
        self.lost += [LostPart(*part) for part in lost]
        return header

    def _item_sizes(self) -> list[tuple[Location, int]]:
        sizes = []
        for number in range(self.container.item_count):
            item = self.container.item(number)
            keys = item.get("keys") if isinstance(item, dict) else None
            length = item.get("length") if isinstance(item, dict) else None
            if isinstance(keys, list):
                sizes.append((as_keys(self.container.header, keys), length if type(length) is int else 0))
        return sizes

    def _bytes_below(self, lost: Iterable[Location]) -> Mapping[Location, int]:
        found: dict[Location, int] = defaultdict(int)
        wanted = set(lost)
        for keys, size in self._sizes:
            for depth in range(1, len(keys) + 1):
                if keys[:depth] in wanted:
                    found[keys[:depth]] += size
                    break
        return found

    def _without_unreadable(self, scene: Scene) -> Scene:
        """Leave out frames that the header lists soundly and that cannot be made all the same."""
        return replace(scene, sensors=tuple(self._readable(sensor) for sensor in scene.sensors))

    def _without_unwritable(self, scene: Scene) -> Scene:
        """Leave out annotations with numbers that are none, which a reader passes on and a writer refuses."""
        kept = []
        for annotation in scene.annotations:
            try:
                encode_annotation(annotation)
            except OptionError as error:
                location, _, problem = str(error).partition(": ")
                self.lost.append(LostPart(location, problem, 0))
                continue
            kept.append(annotation)
        return replace(scene, annotations=tuple(kept))

    def _readable(self, sensor: Sensor) -> Sensor:
        if isinstance(sensor, CameraSensor):
            return self._with_readable_video(sensor)
        if not isinstance(sensor, LidarSensor | RadarSensor):
            return sensor
        kept = []
        for index in range(len(sensor.frames)):
            try:
                sensor.frames[index]
            except DataError as error:
                self.lost.append(LostPart(error.location, error.problem, 0))
                continue
            kept.append(index)
        if len(kept) == len(sensor.frames):
            return sensor
        frames: LazyFrames[Any] = sensor.frames
        times_ns = frames.timestamps_ns[np.array(kept, np.int64)]
        readable: Any = LazyFrames(times_ns, lambda k: frames[kept[k]])
        return replace(sensor, frames=readable)

    def _with_readable_video(self, camera: CameraSensor) -> CameraSensor:
        """Leave out a video that is none, or that has not as many images as timestamps; the camera stays."""
        problem = video_problem(camera)
        if problem is None:
            return camera
        self.lost.append(LostPart(f"sensors[{camera.id}].video", problem, 0))
        return replace(camera, images=LazyFrames.of([], []), video=None, fps=None)


def _frame_counts(header: Mapping[str, Any]) -> dict[tuple[type, Any], int]:
    """How many frames or images the header lists, by the id of their sensor."""
    counts = {}
    sensors = header.get("sensors")
    for sensor in sensors if isinstance(sensors, list) else []:
        identifier = sensor.get("id") if isinstance(sensor, dict) else None
        if not isinstance(identifier, str | int):
            continue
        lists = [sensor.get(name) for name in _COUNTED]
        video = sensor.get("video")
        lists.append(video.get("timestamps") if isinstance(video, dict) else None)
        counts[type(identifier), identifier] = next((len(v) for v in lists if isinstance(v, list)), 0)
    return counts


def _frames_of(sensor: Sensor) -> Any:
    if isinstance(sensor, CameraSensor):
        return sensor.images
    return sensor.frames if isinstance(sensor, LidarSensor | RadarSensor) else ()
