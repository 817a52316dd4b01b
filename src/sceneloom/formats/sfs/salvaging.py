"""Taking what is whole out of a scene file that was cut off or damaged, and saying what is not."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.output import check_output
from sceneloom.formats.sfs.container import Container, ItemFault, format_keys
from sceneloom.formats.sfs.faults import Examination
from sceneloom.formats.sfs.header_recovery import recover_header
from sceneloom.formats.sfs.items import step
from sceneloom.formats.sfs.reading import read_container
from sceneloom.formats.sfs.removal import Keys, keep_in_step, parse_path, take_out, what_goes
from sceneloom.formats.sfs.source import ReadingOptions
from sceneloom.formats.sfs.video_rescue import rescue_video, video_problem
from sceneloom.formats.sfs.write_annotations import annotation_record
from sceneloom.formats.sfs.writing import write_scene
from sceneloom.formats.urls import is_url
from sceneloom.scene import (
    CameraSensor,
    LazyFrames,
    LidarSensor,
    Notice,
    NoticeKind,
    RadarSensor,
    Scene,
    Sensor,
)
from sceneloom.scene.types import key_of

_COUNTED = ("frames", "images")
_ROUNDS = 4


class LostPart(msgspec.Struct, frozen=True):
    """Something of a damaged file that is not in the salvaged scene.

    Attributes:
        place: where it was (`sensors[0].frames[12]`).
        problem: what is wrong there.
        bytes: how many bytes of arrays go with it; of the header where that is damaged.
    """

    place: str
    problem: str
    bytes: int


class KeptSensor(msgspec.Struct, frozen=True):
    """A sensor of the salvaged scene.

    Attributes:
        id: as in the file.
        type: "lidar", "camera", …
        kept: how many of its frames or pictures are there.
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
    pictures that are whole if its tables stand before them. A header that was cut keeps the sensors and annotations
    that are complete. Nothing is guessed: an array is taken only where the header says that it is.
    What names a lost sensor or annotation keeps the name, for a rule to tell.

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
        raise DataError(
            source, "", "is the output, too; choose another name: the damaged file stays as it is"
        )
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
        """Take out what is at fault until the rest is sound, and read it."""
        self._rescue_videos()
        items, options = self._items, ReadingOptions()
        for _ in range(_ROUNDS):
            examined = read_container(self.container, items, options)
            if not self._take_out_faults(examined):
                break
            items = []
        examined = read_container(self.container, [], replace(options, lenient=True))
        if examined.scene is None:
            raise DataError(self.container.file, "", "nothing of it can be read")
        scene = self._without_unwritable(self._without_unreadable(examined.scene))
        if self.lost:
            message = f"taken out of {self.container.file}, which was damaged"
            notice = Notice(
                kind=NoticeKind.SKIPPED, code="salvaged", place="", message=message, count=len(self.lost)
            )
            scene = replace(scene, notices=(*scene.notices, notice))
        return scene

    def kept_sensors(self, scene: Scene) -> tuple[KeptSensor, ...]:
        """Say of each sensor how much of it is there."""
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

    def _item_sizes(self) -> list[tuple[Keys, int]]:
        sizes = []
        for number in range(self.container.item_count):
            item = self.container.item(number)
            keys = item.get("keys") if isinstance(item, dict) else None
            length = item.get("length") if isinstance(item, dict) else None
            if isinstance(keys, list):
                sizes.append((_as_keys(self.container.header, keys), length if type(length) is int else 0))
        return sizes

    def _take_out_faults(self, examined: Examination) -> bool:
        """Remove all that is at fault from the header; say whether there was anything."""
        problems: dict[Keys, str] = {}
        header = self.container.header
        for fault in examined.faults:
            if fault.mended:
                continue
            keys = parse_path(fault.path)
            victim = what_goes(header, keys)
            if victim is not None:
                inner = format_keys(keys[len(victim) :])
                problems.setdefault(victim, f"{inner}: {fault.problem}" if inner else fault.problem)
            elif LostPart(fault.path, fault.problem, 0) not in self.lost:
                self.lost.append(LostPart(fault.path, fault.problem, self._bytes_at(keys)))
        victims = _outermost(problems)
        bytes_of = self._bytes_below(victims)
        self.lost += [LostPart(format_keys(keys), problems[keys], bytes_of[keys]) for keys in victims]
        take_out(header, victims)
        if victims:
            self._sizes = []  # the places of what stays have moved
        return bool(victims)

    def _bytes_at(self, keys: Keys) -> int:
        return next((size for place, size in self._sizes if place == keys), 0)

    def _bytes_below(self, victims: Iterable[Keys]) -> Mapping[Keys, int]:
        found: dict[Keys, int] = defaultdict(int)
        wanted = set(victims)
        for keys, size in self._sizes:
            for depth in range(1, len(keys) + 1):
                if keys[:depth] in wanted:
                    found[keys[:depth]] += size
                    break
        return found

    def _rescue_videos(self) -> None:
        """Put the beginnings of videos that were cut into their places."""
        for fault in list(self._items):
            keys = _as_keys(self.container.header, list(fault.keys or ()))
            if keys[-2:] == ("video", "content") and self._rescue_video(fault, keys):
                self._items.remove(fault)

    def _rescue_video(self, fault: ItemFault, keys: Keys) -> bool:
        item, header = self.container.item(fault.number), self.container.header
        offset, length = item.get("offset"), item.get("length")
        if type(offset) is not int or type(length) is not int or offset < 0:
            return False
        there = self.container.bytes_between(offset, offset + length)
        video: Any = header
        for key in keys[:-1]:
            video = video[key]
        stamps = video.get("timestamps")
        if not isinstance(stamps, list) or not 0 < len(there) < length:
            return False
        try:
            content, kept, count = rescue_video(there, length)
        except DataError:
            return False
        if count != len(stamps):
            return False
        video["content"] = np.frombuffer(content, np.uint8)
        video["timestamps"] = [stamps[k] for k in kept]
        sensor: Any = header
        for key in keys[:-2]:
            sensor = sensor[key]
        keep_in_step(header, sensor.get("id"), "images", kept, count)
        problem = f"the video was cut: {len(kept)} of its {count} pictures are whole"
        self.lost.append(LostPart(format_keys(keys), problem, length - len(there)))
        return True

    def _without_unreadable(self, scene: Scene) -> Scene:
        """Leave out frames that the header lists soundly and that cannot be made all the same."""
        return replace(scene, sensors=tuple(self._readable(sensor) for sensor in scene.sensors))

    def _without_unwritable(self, scene: Scene) -> Scene:
        """Leave out annotations with numbers that are none, which a reader passes on and a writer refuses."""
        kept = []
        for annotation in scene.annotations:
            try:
                annotation_record(annotation)
            except OptionError as error:
                place, _, problem = str(error).partition(": ")
                self.lost.append(LostPart(place, problem, 0))
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
                self.lost.append(LostPart(error.place, error.problem, 0))
                continue
            kept.append(index)
        if len(kept) == len(sensor.frames):
            return sensor
        frames: LazyFrames[Any] = sensor.frames
        times_ns = frames.timestamps_ns[np.array(kept, np.int64)]
        readable: Any = LazyFrames(times_ns, lambda k: frames[kept[k]])
        return replace(sensor, frames=readable)

    def _with_readable_video(self, camera: CameraSensor) -> CameraSensor:
        """Leave out a video that is none, or that has not as many pictures as time stamps; the camera stays."""
        problem = video_problem(camera)
        if problem is None:
            return camera
        self.lost.append(LostPart(f"sensors[{camera.id}].video", problem, 0))
        return replace(camera, pictures=LazyFrames.of([], []), video=None, fps=None)


def _as_keys(header: dict[str, Any], keys: list[Any]) -> Keys:
    """The path that an item names, with numbers where a list is: writers may say them as text."""
    node: Any = header
    found: list[str | int] = []
    for key in keys:
        is_index = isinstance(node, list) and str(key).isdigit()
        found.append(int(key) if is_index else str(key))
        node = step(node, key)
    return tuple(found)


def _outermost(places: Iterable[Keys]) -> list[Keys]:
    """Those that do not stand inside another, in the order of the file."""
    wanted = set(places)
    inside = {keys for keys in wanted if any(keys[:depth] in wanted for depth in range(1, len(keys)))}
    return [keys for keys in places if keys not in inside]


def _frame_counts(header: Mapping[str, Any]) -> dict[tuple[type, Any], int]:
    """How many frames or pictures the header lists, by the id of their sensor."""
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
        return sensor.pictures
    return sensor.frames if isinstance(sensor, LidarSensor | RadarSensor) else ()
