"""What labelling tools draw, shape by shape in frames: taken into a scene, and out of one; masks, ids, images."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import pairwise
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any
from urllib.parse import unquote

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, check_choice
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.images import IMAGE_SUFFIXES, ImageFile, encode_jpeg, encode_png, images_image_size, is_jpeg
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.losses import Losses, LossReport
from sceneloom.formats.base.masks import MASKS, Mask
from sceneloom.formats.base.output import FolderKind, file_stem, replacing
from sceneloom.formats.base.spec import as_positive
from sceneloom.formats.base.text_tables import FARTHEST_NS
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    ObjectAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
from sceneloom.scene.annotations_at import CuboidAngles, attribute_at, box_2d_at, cuboid_poses, shape_at
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.contents import KINDS
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import WarningKind

TRACK = "track_id"
"""Attribute by which tools that have no tracks of their own state which shapes are one object."""

KEYFRAME = "keyframe"
"""Attribute that is false where a shape lies between two that somebody drew."""

RBBOX = "rbbox"
"""Extra field of a path: the rotated boxes that its polygons were made of, rows x y w h angle, as OpenLABEL's."""

IMAGES = "labelled_images"
"""Extra field of a camera: its labelled images, rows `timestamp_ns number width height name`; unknown sizes are 0."""

LABELLING = "labelling"
"""Entry of the metadata: what the tool states of its labels."""

IMAGE_CHOICES = ("copy", "none")
"""What becomes of images on writing."""

DEFAULT_RATE_HZ = 10.0


class Kind(StrEnum):
    """What a shape is; the words are parts of ids."""

    BOX = "box"
    ROTATED = "rotated"
    POLYGON = "polygon"
    POLYLINE = "polyline"
    POINTS = "points"
    MASK = "mask"
    CUBOID = "cuboid"
    TAG = "tag"


@dataclass(frozen=True, slots=True)
class Frame:
    """An image, or a cloud.

    Attributes:
        number: in the file's count.
        name: of its file; "" where that is not stated.
        width, height: of the image [px]; 0 where that is not stated.
        timestamp_ns: where the file states it, else None.
        camera: the id of its camera, where that is not to be taken from the name.
        cloud: whether it is a point cloud.
    """

    number: int
    name: str = ""
    width: int = 0
    height: int = 0
    timestamp_ns: int | None = None
    camera: Identifier | None = None
    cloud: bool = False


@dataclass(slots=True, eq=False)
class Drawn:
    """One shape in one frame.

    Attributes:
        kind: what it is.
        frame: the frame, by its location in the list of frames.
        values: box: left, top, width, height; rotated box: centre x and y, width, height, angle [rad] from x to y;
            polygon and polyline: (V, 2); points: (V, 3), x, y and visibility (0 not there, 1 hidden, 2 visible);
            cuboid: centre, size along its axes [m], quaternion x y z w; tag: None. [px], from the image's corner.
        label: its class.
        track: id of the object, the same in all frames; None where none is stated.
        attributes: by name.
        names: of the points.
        keyframe: whether somebody drew it, or else it lies on the line between two that somebody drew.
        part: number of the shape among those of its kind, object and frame.
        segment: number of the unbroken stretch of frames that it belongs to; None where frames without it end one.
    """

    kind: Kind
    frame: int
    values: Any
    label: str | None = None
    track: Identifier | None = None
    attributes: dict[str, Any] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    keyframe: bool = True
    part: int = 1
    segment: int | None = None


# JSON

_GREATEST = 1e9


@dataclass(frozen=True, slots=True)
class Json:
    """A part of a JSON document, with its location.

    Attributes:
        path: the file.
        location: as `annotations[3].bbox`.
        value: what is there.
    """

    path: Path
    location: str
    value: Any

    @classmethod
    def read(cls, path: Path) -> "Json":
        """Read a file.

        Raises:
            DataError: it cannot be read, or is no JSON.
        """
        return cls(path, "", read_json(path, Any))

    def fault(self, expected: str) -> DataError:
        """The error of a part that is not what was expected."""
        text = repr(self.value)
        return DataError(self.path, self.location, f"{text[:60]}{'…' * (len(text) > 60)}; expected {expected}")

    def __contains__(self, name: str) -> bool:
        return isinstance(self.value, dict) and self.value.get(name) is not None

    def __getitem__(self, name: str) -> "Json":
        if not isinstance(self.value, dict):
            raise self.fault("a JSON object")
        return Json(self.path, f"{self.location}.{name}".lstrip("."), self.value.get(name))

    def each(self) -> Iterator["Json"]:
        """The elements of a list; of null none."""
        if self.value is not None and not isinstance(self.value, list):
            raise self.fault("a list")
        for k, value in enumerate(self.value or ()):
            yield Json(self.path, f"{self.location}[{k}]", value)

    def members(self) -> Mapping[str, Any]:
        """The members of an object; of null none."""
        if self.value is not None and not isinstance(self.value, dict):
            raise self.fault("a JSON object")
        return self.value or {}

    def numbers(self, *counts: int) -> Float64Array:
        """A list of numbers, of one of the lengths, if there are any."""
        values = self.value
        sound = isinstance(values, list) and {*map(type, values)} <= {int, float}
        if not sound or not all(abs(one) <= _GREATEST for one in values) or (counts and len(values) not in counts):
            raise self.fault(f"a list of {' or '.join(map(str, counts))}{' ' * bool(counts)}numbers")
        return np.array(values, np.float64)

    def number(self) -> float:
        """A number."""
        if type(self.value) not in (int, float) or not abs(self.value) <= _GREATEST:
            raise self.fault(f"a number within {_GREATEST:g}")
        return float(self.value)

    def whole(self, default: int | None = None) -> int:
        """A whole number; null is the default, if there is one."""
        if self.value is None and default is not None:
            return default
        if type(self.value) is not int or abs(self.value) >= 2**63:
            raise self.fault("a whole number")
        return self.value

    def text(self, default: str | None = None) -> str:
        """A text; null is the default, if there is one."""
        if self.value is None and default is not None:
            return default
        if not isinstance(self.value, str):
            raise self.fault("a text")
        return self.value

    def identifier(self) -> Identifier:
        """A text or a whole number."""
        return self.value if isinstance(self.value, str) else self.whole()

    def mask(self) -> "Mask":
        """A mask in COCO's runs."""
        try:
            return Mask.of_record(self.value)
        except ValueError as error:
            raise DataError(self.path, self.location, str(error)) from error


# ids as text

_WHOLE = re.compile(r"0|-?[1-9][0-9]{0,17}")


def id_text(identifier: Identifier) -> str:
    """Write an id so that whole numbers and texts stay apart: a text that looks like a number goes into quotes."""
    if isinstance(identifier, str) and (_WHOLE.fullmatch(identifier) or identifier.startswith('"')):
        return msgspec.json.encode(identifier).decode()
    return str(identifier)


def text_id(text: str) -> Identifier:
    """Read `id_text`."""
    if _WHOLE.fullmatch(text):
        return int(text)
    if text.startswith('"'):
        try:
            return msgspec.json.decode(text, type=str)
        except (msgspec.DecodeError, UnicodeEncodeError):
            return text
    return text


def is_scalar(value: Any) -> bool:
    """Whether tools hold a value as an attribute: text, a finite number, true or false."""
    return isinstance(value, str | bool | int) or (isinstance(value, float) and bool(np.isfinite(value)))


def corners_of(rotated: Float64Array) -> Float64Array:
    """The corners (4, 2) of a rotated box: top left, top right, bottom right and bottom left before the rotation."""
    x, y, width, height, angle = rotated
    halves = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * (width / 2, height / 2)
    cosine, sine = np.cos(angle), np.sin(angle)
    found: Float64Array = halves @ np.array([[cosine, sine], [-sine, cosine]]) + (x, y)
    return found


def bounds_of(vertices: Float64Array) -> Float64Array:
    """Left, top, width and height of what points (V, 2 or more) cover."""
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    return np.concatenate([low, high - low])


def rotated_of(corners: Float64Array) -> Float64Array | None:
    """The rotated box of four corners (4, 2) in a circle; None where they are of none, within a hundredth."""
    if corners.shape != (4, 2):
        return None
    across, down = corners[1] - corners[0], corners[2] - corners[1]
    width, height = float(np.hypot(*across)), float(np.hypot(*down))
    angle = float(np.arctan2(across[1], across[0])) if width else float(np.arctan2(-down[0], down[1]))
    found = np.array([*corners.mean(axis=0), width, height, angle])
    off = float(np.abs(corners_of(found) - corners).max())
    return found if off <= 0.01 * max(width, height, 1e-9) else None


# reading

_CLOCK = re.compile(r"-?[0-9]{18,19}")
_PLAIN_FOLDERS = {"", ".", "..", "images", "data", "frames", "jpegimages", "train", "val", "valid", "test", "default"}
_MOST_FRAMES = 10_000_000


def camera_of(name: str) -> Identifier:
    """The camera that an image is of: the folder in its name, else "camera"."""
    folders = [one for one in PurePosixPath(name.replace("\\", "/")).parts[:-1] if one.lower() not in _PLAIN_FOLDERS]
    return text_id(unquote(folders[-1])) if folders and folders[-1] != "/" else "camera"


def _frame_times(path: Path, frames: Sequence[Frame], rate_hz: float | None, ledger: Ledger) -> list[int]:
    """Times of the frames [ns]: stated, or by names that are nanoseconds, else by their numbers."""
    names = [PurePosixPath(frame.name).stem for frame in frames]
    by_name = all(map(_CLOCK.fullmatch, names)) and all(abs(int(name)) <= FARTHEST_NS for name in names)
    rate = rate_hz or DEFAULT_RATE_HZ
    times, guessed = [], 0
    for frame, name in zip(frames, names, strict=True):
        if frame.timestamp_ns is not None:
            times.append(frame.timestamp_ns)
        elif by_name:
            times.append(int(name))
        else:
            times.append(round(frame.number * 1e9 / rate))
            guessed += 1
        if abs(times[-1]) > FARTHEST_NS:
            raise DataError(path, f"frame {frame.number}", f"a time of {times[-1]} ns; expected at most {FARTHEST_NS}")
    if guessed and len(frames) > 1:
        message = f"frames have no timestamp; taken at {rate:g} Hz by number, `--input-option rate_hz=HZ` sets the rate"
        ledger.note(WarningKind.ASSUMED, "frame-times-assumed", str(path), message, count=guessed)
    return times


@dataclass(frozen=True, slots=True, eq=False)
class _Pictures:
    """Makes the images of one camera from files, each with a camera model of its own size."""

    files: tuple[Path, ...]
    names: tuple[str, ...]
    timestamps_ns: Int64Array
    cameras: tuple[Camera, ...]

    def __call__(self, k: int) -> CameraImage:
        camera = self.cameras[k]
        file = ImageFile(self.files[k], camera.width, camera.height)
        encoded = file.encoded if is_jpeg(file.path) else None
        extras = MappingProxyType({"file": self.names[k]})
        return CameraImage(int(self.timestamps_ns[k]), camera, file, extras=extras, encoded=encoded)


class _Finder:
    """Finds the files of images by their names, which may lie in several folders."""

    def __init__(self, roots: Iterable[Path]) -> None:
        self.roots = [root for root in dict.fromkeys(roots) if root.is_dir()]

    def find(self, name: str) -> Path | None:
        """The file of a name, from one of the folders on; names that lead out of these are cut to their last part."""
        pure = PurePosixPath(name.replace("\\", "/"))
        if not pure.name or "\0" in name:
            return None
        inner = not pure.is_absolute() and ".." not in pure.parts
        names = [pure, PurePosixPath(pure.name)] if inner and len(pure.parts) > 1 else [PurePosixPath(pure.name)]
        suffixes = [one for one in (*IMAGE_SUFFIXES, ".JPG", ".PNG") if one != pure.suffix]
        own = pure.suffix.lower() in IMAGE_SUFFIXES
        for root in self.roots:
            for one in names:
                for file in [root / one] * own + [root / one.with_suffix(suffix) for suffix in suffixes]:
                    if _is_file(file):
                        self.roots.remove(root)
                        self.roots.insert(0, root)
                        return file
        return None


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def image_roots(file: Path, *subsets: str) -> list[Path]:
    """Folders in which images of a file of labels usually are: beside it, in `images`, and in folders of its subset."""
    folders = [file.parent, file.parent.parent]
    names = ["", "images", "data", *(f"{one}{subset}" for subset in subsets for one in ("images/", ""))]
    return [folder / name for folder in folders for name in names]


def plain_camera(width: int, height: int) -> Camera:
    """A pinhole for a camera of which nothing but the size of its images is known: 53 degrees across."""
    focal = float(max(width, height))
    return Camera("pinhole", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


_UNKNOWN_SIZE = (1920, 1080)


@dataclass(slots=True, eq=False)
class Labels:
    """What was read from a file of labels.

    Attributes:
        path: the file.
        format: name of its format.
        ledger: of warnings.
        frames: in the order of the file.
        drawn: all shapes.
        spec: what the tool states of its labels, for the metadata.
        roots: folders that images may be in.
        rate_hz: frames per second where they have no timestamps.
    """

    path: Path
    format: str
    ledger: Ledger
    frames: list[Frame] = field(default_factory=list)
    drawn: list[Drawn] = field(default_factory=list)
    spec: Mapping[str, Any] = field(default_factory=dict)
    roots: list[Path] = field(default_factory=list)
    rate_hz: float | None = None

    @classmethod
    def of(cls, path: Path, name: str, *, lenient: bool, rate_hz: float | str | None) -> "Labels":
        """Begin with nothing.

        Raises:
            OptionError: the rate is no number above 0.
        """
        rate = None if rate_hz is None else as_positive("rate_hz", rate_hz)
        return cls(path, name, Ledger(lenient=lenient), rate_hz=rate)

    def add_frame(self, frame: Frame) -> int:
        """Add a frame; gives its location in the list.

        Raises:
            DataError: there are too many, or its number or size is none.
        """
        if len(self.frames) >= _MOST_FRAMES:
            raise DataError(self.path, "", f"more than {_MOST_FRAMES} frames")
        if not -(2**53) < frame.number < 2**53 or not (0 <= frame.width < 1 << 20 and 0 <= frame.height < 1 << 20):
            found = f"number {frame.number}, {frame.width}x{frame.height}"
            raise DataError(self.path, f"frame {frame.name or frame.number}", f"{found}; expected those of an image")
        self.frames.append(frame)
        return len(self.frames) - 1

    def skipped(self, code: str, location: str, message: str, *, count: int = 1) -> None:
        """Note something that is not read."""
        where = f"{self.path}: {location}" if location else str(self.path)
        self.ledger.note(WarningKind.SKIPPED, code, where, message, count=count)

    def scene(self) -> Scene:
        """The scene of all that was read."""
        times = np.array(_frame_times(self.path, self.frames, self.rate_hz, self.ledger), np.int64)
        owners = [
            "lidar" if frame.cloud else camera_of(frame.name) if frame.camera is None else frame.camera
            for frame in self.frames
        ]
        annotations = _Annotator(self, times, owners).annotations()
        ours = {"euler_unit": str(_ANGLES.unit), "euler_order": _ANGLES.order}
        metadata: dict[str, Any] = {"sceneloom": ours, **({LABELLING: dict(self.spec)} if self.spec else {})}
        return Scene(
            tuple(self._sensors(times, owners)),
            annotations=tuple(annotations),
            metadata=MappingProxyType(metadata),
            source=str(self.path),
            format=self.format,
            warnings=self.ledger.warnings,
        )

    def _sensors(self, times: Int64Array, owners: Sequence[Identifier]) -> Iterator[Sensor]:
        rows: dict[Key, list[int]] = {}
        for k, owner in enumerate(owners):
            rows.setdefault(key_of(owner), []).append(k)
        finder, missing, assumed = _Finder(self.roots), 0, 0
        for found in rows.values():
            owner = owners[found[0]]
            if self.frames[found[0]].cloud:
                yield LidarSensor(owner, LazyFrames[Any].of([], []), extras=_table(self.frames, times, found))
                message = "names of point clouds are kept, their points are not read from here"
                self.skipped("clouds-elsewhere", "", message, count=len(found))
                continue
            ordered = sorted(found, key=lambda k: int(times[k]))
            files = [finder.find(self.frames[k].name) for k in ordered]
            sizes = [self._size(self.frames[k], file) for k, file in zip(ordered, files, strict=True)]
            known = [size for size in sizes if size is not None]
            assumed += not known
            usual = Counter(known).most_common(1)[0][0] if known else _UNKNOWN_SIZE
            cameras = {size: plain_camera(*size) for size in {*known, usual}}
            there = [k for k, file in enumerate(files) if file is not None and sizes[k] is not None]
            missing += len(files) - len(there)
            reader = _Pictures(
                tuple(file for k in there if (file := files[k]) is not None),
                tuple(self.frames[ordered[k]].name for k in there),
                times[[ordered[k] for k in there]],
                tuple(cameras[size] for k in there if (size := sizes[k]) is not None),
            )
            images = LazyFrames(reader.timestamps_ns, reader, stage=None)
            yield CameraSensor(owner, cameras[usual], images, extras=_table(self.frames, times, ordered))
        if rows and any(not frame.cloud for frame in self.frames):
            message = "the file states no camera model; a pinhole of 53 degrees is assumed, which only drawing needs"
            self.ledger.note(WarningKind.ASSUMED, "camera-model-assumed", str(self.path), message)
        if assumed:
            message = f"the size of the images is not known; {_UNKNOWN_SIZE[0]}x{_UNKNOWN_SIZE[1]} is assumed"
            self.ledger.note(WarningKind.ASSUMED, "image-size-assumed", str(self.path), message, count=assumed)
        if missing:
            message = "images are not beside the file as PNG or JPEG; their names are kept, the frames have no images"
            self.skipped("images-missing", "", message, count=missing)

    def _size(self, frame: Frame, file: Path | None) -> tuple[int, int] | None:
        if frame.width and frame.height:
            return frame.width, frame.height
        if file is None:
            return None
        try:
            return images_image_size(file)
        except DataError as error:
            self.ledger.fault("images", error)
            return None


def _table(frames: Sequence[Frame], times: Int64Array, rows: Iterable[int]) -> Mapping[str, Any]:
    """The labelled images of a sensor as an extra field."""
    listed = [[int(times[k]), frames[k].number, frames[k].width, frames[k].height, frames[k].name] for k in rows]
    return MappingProxyType({IMAGES: listed})


_ANGLES = CuboidAngles()
_USUAL: Mapping[str, Any] = MappingProxyType({"occluded": False, "z_order": 0, "group_id": 0})
"""Attributes that tools leave out where they have these values."""

_SAME_PX = 0.005
"""Shapes between key frames that lie this near to the straight line between these are left to interpolation [px]."""


class _Annotator:
    """Makes annotations of shapes."""

    def __init__(self, labels: Labels, times: Int64Array, owners: Sequence[Identifier]) -> None:
        self.labels, self.times, self.owners = labels, times, owners
        # locations of frames among those of their sensor, in the order of time
        self.ranks = [0] * len(times)
        counts: Counter[Key] = Counter()
        for k in sorted(range(len(times)), key=lambda k: int(times[k])):
            self.ranks[k] = counts[key_of(owners[k])]
            counts[key_of(owners[k])] += 1

    def annotations(self) -> Iterator[Annotation]:
        """All annotations, in the order in which their objects first come up."""
        objects: dict[Key, list[Drawn]] = {}
        counts: Counter[int] = Counter()
        taken = {key_of(one.track) for one in self.labels.drawn if one.track is not None}
        for one in self.labels.drawn:
            track = one.track
            if track is None:
                track = f"{self.labels.frames[one.frame].number}-{counts[one.frame]}"
                counts[one.frame] += 1
                while key_of(track) in taken:
                    track += "#"
                taken.add(key_of(track))
                one.track = track
            objects.setdefault(key_of(track), []).append(one)
        for parts in objects.values():
            yield from self._of_object(parts)

    def _of_object(self, drawn: list[Drawn]) -> Iterator[Annotation]:
        label, track = drawn[0].label, drawn[0].track
        others = [one for one in drawn if one.label != label]
        if others:
            message = f"an id with several classes; each class of it becomes an object of its own, {track}:CLASS"
            self.labels.ledger.note(WarningKind.ASSUMED, "track-classes", str(self.labels.path), message)
            yield from self._of_object([one for one in drawn if one.label == label])
            for other in dict.fromkeys(one.label for one in others):
                yield from self._of_object(
                    [replace(one, track=f"{track}:{other}") for one in others if one.label == other]
                )
            return
        groups: dict[tuple[Key, Kind, int], list[Drawn]] = {}
        seen: set[tuple[int, Kind, int]] = set()
        for one in drawn:
            while (one.frame, one.kind, one.part) in seen:  # two of a kind in one frame
                one.part += 1
            seen.add((one.frame, one.kind, one.part))
            groups.setdefault((key_of(self.owners[one.frame]), one.kind, one.part), []).append(one)
        stretches = [(key, stretch) for key, group in groups.items() for stretch in self._stretches(group)]
        assert track is not None  # noqa: S101 - given above
        several = len({key[0] for key in groups}) > 1
        if len(stretches) == 1 and (stretches[0][1][0].kind is not Kind.POINTS or _are_single(stretches[0][1])):
            yield self._annotation(track, stretches[0][1], None)
            return
        yield ObjectAnnotation(track, label)
        counts: Counter[str] = Counter()
        for (_, kind, part), stretch in stretches:
            owner = self.owners[stretch[0].frame]
            name = f"{track}:{kind}{part if part > 1 else ''}{f'@{owner}' if several else ''}"
            counts[name] += 1
            name += f":{counts[name]}" if counts[name] > 1 else ""
            yield self._annotation(name, stretch, track)

    def _stretches(self, group: list[Drawn]) -> Iterator[list[Drawn]]:
        """Cut the shapes of one kind at frames that have none."""
        ordered = sorted(group, key=lambda one: (one.segment or 0, self.ranks[one.frame]))
        begun: list[Drawn] = []
        for one in ordered:
            if (begun and one.kind is Kind.TAG) or (
                begun
                and (
                    one.segment != begun[-1].segment
                    or (one.segment is None and self.ranks[one.frame] != self.ranks[begun[-1].frame] + 1)
                )
            ):
                yield begun
                begun = []
            begun.append(one)
        yield begun

    def _annotation(  # noqa: PLR0911 - one for each kind
        self, name: Identifier, drawn: list[Drawn], parent: Identifier | None
    ) -> Annotation:
        attributes = self._attributes(drawn)
        rows = _drawn_rows(drawn, self.times)
        first = rows[0]
        times = self.times[[one.frame for one in rows]]
        owner = self.owners[first.frame]
        stated: dict[str, Any] = {"label": first.label, "parent_id": parent, "attributes": attributes}
        values = [one.values for one in rows]
        match first.kind:
            case Kind.BOX:
                return Box2DAnnotation(name, owner, BoxPath(times, np.stack(values)), **stated)
            case Kind.MASK:
                extras = MappingProxyType({MASKS: [mask.record() for mask in values]})
                boxes = np.stack([mask.box() for mask in values])
                return Box2DAnnotation(name, owner, BoxPath(times, boxes, extras=extras), **stated)
            case Kind.ROTATED:
                path = VertexPath(
                    times,
                    tuple(map(corners_of, values)),
                    extras=MappingProxyType({RBBOX: [[float(number) for number in row] for row in values]}),
                )
                return ShapeAnnotation(name, ShapeType.POLYGON_2D, path, owner, **stated)
            case Kind.POLYGON | Kind.POLYLINE:
                kind = ShapeType.POLYGON_2D if first.kind is Kind.POLYGON else ShapeType.POLYLINE_2D
                return ShapeAnnotation(name, kind, VertexPath(times, tuple(values)), owner, **stated)
            case Kind.CUBOID:
                table = np.stack(values)
                angles = _ANGLES.from_quaternions(table[:, 6:])
                path_ = CuboidPath(times, np.hstack([table[:, 3:6], table[:, :3], angles]))
                return CuboidAnnotation(name, path_, **stated)
            case Kind.POINTS if _are_single(rows):
                path = VertexPath(times, tuple(np.array(one[:, :2]) for one in values))
                return ShapeAnnotation(name, ShapeType.POINT_2D, path, owner, **stated)
            case Kind.POINTS:
                return _points(name, times, rows, owner, stated)
            case _:
                return EventAnnotation(name, int(times[0]), 0, sensor_id=owner, **stated)

    def _attributes(self, drawn: list[Drawn]) -> tuple[AttributePath, ...]:
        """What is stated about shapes: once where it does not change, else whenever it does."""
        names = dict.fromkeys(name for one in drawn for name in one.attributes)
        found = []
        for name in names:
            values = [one.attributes.get(name, _USUAL.get(name)) for one in drawn]
            if all(value == values[0] and type(value) is type(values[0]) for value in values):
                found.append(AttributePath(name, (values[0],), static=True))
                continue
            changes = [
                k
                for k, value in enumerate(values)
                if k == 0 or value != values[k - 1] or type(value) is not type(values[k - 1])
            ]
            times = self.times[[drawn[k].frame for k in changes]]
            found.append(AttributePath(name, tuple(values[k] for k in changes), times))
        return tuple(found)


def _are_single(drawn: list[Drawn]) -> bool:
    """Whether shapes are one point without a name each, which can be seen."""
    return all(len(one.values) == 1 and not one.names and one.values[0, 2] == 2 for one in drawn)


def _points(
    name: Identifier, times: Int64Array, rows: list[Drawn], owner: Identifier, stated: Mapping[str, Any]
) -> PointsAnnotation:
    """Keypoints in images: points without locations in space, of which cameras state where they see them."""
    labels = tuple(dict.fromkeys(one for row in rows for one in _names_of(row)))
    tables = [ordered_points(one, labels) for one in rows]
    projections = []
    for k in range(len(labels)):
        table = np.array([one[k] for one in tables])
        pixels = np.where(table[:, 2:] > 0, table[:, :2], np.nan)
        extras = MappingProxyType({"visibility": [int(row) for row in table[:, 2]]})
        projections.append((PointProjection(owner, times, pixels, extras=extras),))
    nowhere, count = (np.zeros(0, np.int64), np.zeros((0, 3))), len(labels)
    paths = tuple(PointPath(*nowhere, id=k) for k in range(count))
    stated = {key: value for key, value in stated.items() if key != "label"}
    return PointsAnnotation(name, paths, labels, tuple(projections), **stated)


def _drawn_rows(drawn: list[Drawn], times: Int64Array) -> list[Drawn]:
    """Leave out shapes that the tool interpolated, where interpolation between the others gives them again."""
    kept = [k for k, one in enumerate(drawn) if one.keyframe or k in (0, len(drawn) - 1)]
    if len(kept) == len(drawn) or drawn[0].kind not in (Kind.BOX, Kind.POLYGON, Kind.POLYLINE, Kind.CUBOID):
        return drawn
    if drawn[0].kind is Kind.CUBOID:
        return drawn
    found = []
    for before, after in pairwise(kept):
        found.append(before)
        start, stop = drawn[before].values, drawn[after].values
        span = int(times[drawn[after].frame] - times[drawn[before].frame])
        for k in range(before + 1, after):
            values = drawn[k].values
            share = int(times[drawn[k].frame] - times[drawn[before].frame]) / max(span, 1)
            same = np.shape(values) == np.shape(start) == np.shape(stop)
            if not same or np.abs(start + share * (stop - start) - values).max() > _SAME_PX:
                found.append(k)
    return [drawn[k] for k in [*found, kept[-1]]]


# writing


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """What is written: frames of one or several cameras, and what is drawn in each.

    Attributes:
        scene: what it was taken from.
        frames: of all cameras, those of one after the other in the order of time; all have times and sizes.
        drawn: the shapes of each frame; `track` is the id of their object.
        losses: what cannot be written.
    """

    scene: Scene
    frames: list[Frame]
    drawn: list[list[Drawn]]
    losses: Losses
    _images: list[tuple[LazyFrames[CameraImage], int] | None]

    @classmethod
    def of(
        cls, scene: Scene, losses: Losses, *, cameras: Sequence[Identifier] | None = None, cuboids: bool = False
    ) -> "Sheet":
        """Take the frames and shapes of cameras out of a scene; of its lidars, too, where the target has `cuboids`.

        Raises:
            OptionError: there is no such camera.
        """
        return _Taking(scene, losses, cuboids=cuboids).sheet(cameras)

    def labels(self) -> list[str]:
        """The classes, in the order in which they come up; those that the metadata name first."""
        named = [str(name) for name in self.spec().get("labels", ())]
        found = [one.label for drawn in self.drawn for one in drawn if one.label is not None]
        return list(dict.fromkeys([*named, *found]))

    def point_names(self) -> dict[str, list[str]]:
        """The names of the keypoints of each class."""
        found: dict[str, list[str]] = {}
        for drawn in self.drawn:
            for one in drawn:
                if one.kind is Kind.POINTS:
                    names = found.setdefault(one.label or "", [])
                    names += [name for name in _names_of(one) if name not in names]
        return found

    def identified(self) -> set[Key]:
        """The whole numbers above 0 that are ids of one shape only: ids of their own in tools without tracks."""
        counts = Counter(key_of(one.track) for drawn in self.drawn for one in drawn if one.track is not None)
        return {key for key, count in counts.items() if count == 1 and key[0] is int and int(key[1]) > 0}

    def report_kinds(self, *kinds: Kind, what: str) -> None:
        """Report shapes of kinds that the tool has not."""
        counts = Counter(
            key_of(one.track) for drawn in self.drawn for one in drawn if one.kind in kinds and one.track is not None
        )
        for (_, identifier), count in counts.items():
            self.losses.dropped(f"annotations[{identifier}]", what, count=count)

    def spec(self) -> Mapping[str, Any]:
        """What the tool that the scene was read from stated of its labels."""
        named = self.scene.metadata.get(LABELLING)
        return named if isinstance(named, Mapping) else {}

    def renamed(self, name_of: Callable[[int], str]) -> "Sheet":
        """The same with names of images made of their numbers; JPEG files stay such."""
        frames = []
        for frame in self.frames:
            suffix = PurePosixPath(frame.name).suffix
            name = PurePosixPath(name_of(frame.number))
            frames.append(replace(frame, name=str(name.with_suffix(suffix if is_jpeg(Path(frame.name)) else ".png"))))
        return replace(self, frames=frames)

    def write(
        self,
        path: Path,
        suffix: str,
        name: str,
        kind: FolderKind,
        write: Callable[[Path], None],
        *,
        images: str,
        overwrite: bool,
        folder: str = "images",
    ) -> LossReport:
        """Write a file where the path has the suffix, else a folder with it and the images in `images`.

        Args:
            suffix: of a file by itself.
            name: of the file in a folder, which may be in a folder of it.
            kind: of the folder.
            write: writes the file.
            images: "copy", or "none" for their names only.
            overwrite: whether an output of that kind is replaced.
            folder: where images are written to.

        Raises:
            OptionError: `images` is neither.
            OutputError: the output exists, or cannot be written.
            DataError: an image cannot be read.
        """
        check_choice("images", images, IMAGE_CHOICES)
        count = sum(where is not None for where in self._images)
        if path.name.lower().endswith(suffix):
            with replacing(path, overwrite=overwrite) as draft:
                write(draft)
            what = f"left out: a {suffix} file has their names; a folder, a name without suffix, has images, too"
            self.losses.dropped("sensors.camera.images.rgb", what, count=count)
            return LossReport.of(self.losses)
        with replacing(path, overwrite=overwrite, folder=kind) as draft:
            (draft / name).parent.mkdir(parents=True, exist_ok=True)
            write(draft / name)
            if images == "copy":
                self.write_images(draft / folder)
            else:
                self.losses.dropped("sensors.camera.images.rgb", "left out as asked for", count=count)
        return LossReport.of(self.losses)

    def write_images(self, folder: Path) -> None:
        """Write the images of all frames that have one by their names into a folder.

        Raises:
            DataError: one cannot be read.
        """
        for k, (frame, where) in enumerate(zip(self.frames, self._images, strict=True)):
            if where is None:
                continue
            image, file = where[0][where[1]], folder / frame.name
            file.parent.mkdir(parents=True, exist_ok=True)
            encoded = image.encoded() if image.encoded is not None and is_jpeg(file) else b""
            if encoded.startswith(b"\xff\xd8"):
                file.write_bytes(encoded)
            elif is_jpeg(file):
                file.write_bytes(encode_jpeg(image.rgb))
                field_name = f"sensors[{self.frames[k].camera}].images.rgb"
                self.losses.approximated(field_name, "encoded as JPEG, which the name asks for")
            else:
                file.write_bytes(encode_png(image.rgb))


def _names_of(one: Drawn) -> list[str]:
    """Names of keypoints, all different: those without one are counted."""
    names: list[str] = []
    for k in range(len(one.values)):
        name = one.names[k] if k < len(one.names) else str(k)
        while name in names:
            name += "#"
        names.append(name)
    return names


def ordered_points(one: Drawn, names: Sequence[str]) -> Float64Array:
    """Keypoints (V, 3) in the order of the names of their class; those that are missing are 0 0 0."""
    found = np.zeros((len(names), 3))
    for name, row in zip(_names_of(one), one.values, strict=True):
        found[names.index(name)] = row if row[2] > 0 else 0.0
    return found


def json_attributes(one: Drawn) -> dict[str, Any]:
    """Attributes as a JSON object, with the mark of what was interpolated."""
    return {**one.attributes, **({} if one.keyframe else {KEYFRAME: False})}


def take_attributes(one: Drawn, members: Mapping[str, Any], labels: "Labels") -> None:
    """Take attributes out of a JSON object: the id of the object and the mark of what was interpolated apart."""
    for name, value in members.items():
        if name == TRACK and isinstance(value, str | int) and not isinstance(value, bool):
            one.track = value
        elif name == KEYFRAME and isinstance(value, bool):
            one.keyframe = value
        elif is_scalar(value):
            one.attributes[name] = value
        elif value is not None:
            labels.skipped("attributes", name, "attributes that are no text, number, true or false are not read")


_PARTS = re.compile(rf"({'|'.join(Kind)})([0-9]*)(@.*)?(:[0-9]+)?")
_DRAWN_IN_IMAGES = (ShapeType.POLYGON_2D, ShapeType.POLYLINE_2D, ShapeType.POINT_2D)
MOST_FOLDERS = 4
"""How many parts the name of an image has at the most."""

_UNWRITTEN_NAME = re.compile(r"[\x00-\x1f:*?\"<>|]")


class _Taking:
    """Takes shapes out of a scene."""

    def __init__(self, scene: Scene, losses: Losses, *, cuboids: bool) -> None:
        self.scene, self.losses, self.cuboids = scene, losses, cuboids
        self.frames: list[Frame] = []
        self.images: list[tuple[LazyFrames[CameraImage], int] | None] = []
        self.drawn: list[list[Drawn]] = []
        self.angles = CuboidAngles.of(scene)
        self.parents = {key_of(one.id): one for one in scene.annotations if isinstance(one, ObjectAnnotation)}
        self.used_parents: set[Key] = set()
        self.shown: set[Key] = set()

    def sheet(self, cameras: Sequence[Identifier] | None) -> Sheet:
        known = {key_of(camera.id): camera for camera in self.scene.sensors if isinstance(camera, CameraSensor)}
        stated: dict[Key, Identifier] = {key: camera.id for key, camera in known.items()}
        for identifier in _cameras_of(self.scene.annotations):
            stated.setdefault(key_of(identifier), identifier)
        if cameras is not None:
            missing = [one for one in cameras if key_of(one) not in stated]
            if missing:
                names = ", ".join(map(repr, stated.values()))
                raise OptionError(f"{self.scene.source}: no camera {missing[0]!r}; it has {names}")
            left = [identifier for key, identifier in stated.items() if key not in set(map(key_of, cameras))]
            stated = {key_of(one): one for one in cameras}
            for one in left:
                self.losses.dropped(f"sensors[{one}]", "left out: the file holds one camera, `camera=ID` chooses it")
        for key, identifier in stated.items():
            self._camera(identifier, known.get(key))
        if self.cuboids:
            self._cuboids()
        self._report()
        if len({frame.number for frame in self.frames}) < len(self.frames):
            self.frames = [replace(frame, number=k) for k, frame in enumerate(self.frames)]
        return Sheet(self.scene, self.frames, self.drawn, self.losses, self.images)

    def _camera(self, identifier: Identifier, camera: CameraSensor | None) -> None:
        own = [one for one in self.scene.annotations if key_of(identifier) in _seen_by(one)]
        images = LazyFrames[CameraImage].of([], []) if camera is None else camera.images
        table = {} if camera is None else _read_table(camera)
        times: Int64Array = np.unique(np.concatenate([images.timestamps_ns, np.array([*table], np.int64)]))
        if not len(times):
            times = np.unique(np.concatenate([np.zeros(0, np.int64), *(_own_times(one, identifier) for one in own)]))
        numbers = {int(time_ns): k for k, time_ns in enumerate(images.timestamps_ns)}
        first, stem = len(self.frames), file_stem(id_text(identifier))
        for time_ns in times.tolist():
            k = numbers.get(time_ns)
            image = None if k is None else images[k]
            number, width, height, name = table.get(time_ns, (len(self.frames), 0, 0, ""))
            if not _is_sound(name):
                ending = ".png" if image is not None and image.encoded is None else ".jpg"
                name = f"{stem}/{time_ns:0{20 if time_ns < 0 else 19}d}{ending}"
            model = image.camera if image is not None else None if camera is None else camera.camera
            if model is not None and not (width and height):
                width, height = model.width, model.height
            self.frames.append(Frame(number, name, width, height, time_ns, identifier))
            self.images.append(None if k is None else (images, k))
            self.drawn.append([])
        for annotation in own:
            self._take(annotation, identifier, times, first)

    def _take(self, annotation: Any, camera: Identifier, times: Int64Array, first: int) -> None:
        track, label, part = self._object(annotation)
        keys = _own_times(annotation, camera)
        is_key = np.isin(times, keys)
        off = len(np.setdiff1d(keys, times))
        if off:
            what = "its keyframes lie between images; written as interpolated at the images"
            self.losses.approximated(f"annotations[{annotation.id}].path.timestamps_ns", what, count=off)
        attributes = self._attributes(annotation, camera, times)
        for k, kind, values, names in _shapes_of(annotation, camera, times, is_key):
            self.shown.add(key_of(annotation.id))
            one = Drawn(kind, first + k, values, label, track, attributes[k], names, bool(is_key[k]), part)
            self.drawn[first + k].append(one)
        if isinstance(annotation, Box2DAnnotation | ShapeAnnotation) and off and MASKS in annotation.path.extras:
            self.losses.dropped(f"annotations[{annotation.id}].path.extras", "masks between images are left out")

    def _object(self, annotation: Any) -> tuple[Identifier, str | None, int]:
        """The object of a shape, its class, and which of the object's shapes of its kind it is."""
        label = getattr(annotation, "label", None)
        parent = None if annotation.parent_id is None else self.parents.get(key_of(annotation.parent_id))
        if parent is None:
            return annotation.id, label, 1
        head, found = f"{parent.id}:", None
        if isinstance(annotation.id, str) and annotation.id.startswith(head):
            found = _PARTS.fullmatch(annotation.id[len(head) :])
        if found is None:
            return annotation.id, label or parent.label, 1
        self.used_parents.add(key_of(parent.id))
        return parent.id, label or parent.label, int(found[2] or 1)

    def _attributes(self, annotation: Any, camera: Identifier, times: Int64Array) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = [{} for _ in times]
        for attribute in annotation.attributes:
            where = f"annotations[{annotation.id}].attributes.{attribute.name}"
            if attribute.sensor_id is not None and key_of(attribute.sensor_id) != key_of(camera):
                self.losses.dropped(where, "left out: it holds for another sensor")
                continue
            values = attribute_at(attribute, times)
            for k, value in enumerate(values):
                if is_scalar(value):
                    found[k][attribute.name] = value
            odd = sum(value is not None and not is_scalar(value) for value in attribute.values)
            if odd:
                self.losses.dropped(where, "values left out: expected text, numbers, true or false", count=odd)
        return found

    def _cuboids(self) -> None:
        own = [one for one in self.scene.annotations if isinstance(one, CuboidAnnotation)]
        lidars = [one for one in self.scene.sensors if isinstance(one, LidarSensor)]
        table = _read_table(lidars[0]) if lidars else {}
        stated = [frame_times(lidars[0]), np.array([*table], np.int64)] if lidars else []
        times: Int64Array = np.unique(np.concatenate([np.zeros(0, np.int64), *stated]))
        if not len(times):
            times = np.unique(np.concatenate([np.zeros(0, np.int64), *(one.path.timestamps_ns for one in own)]))
        if not own:
            return
        first, stem = len(self.frames), file_stem(id_text(lidars[0].id)) if lidars else "lidar"
        for time_ns in times.tolist():
            number, _, _, name = table.get(time_ns, (len(self.frames) - first, 0, 0, ""))
            name = name if _is_sound(name) else f"{stem}/{time_ns:0{20 if time_ns < 0 else 19}d}.pcd"
            self.frames.append(Frame(number, name, 0, 0, time_ns, cloud=True))
            self.images.append(None)
            self.drawn.append([])
        for one in own:
            track, label, part = self._object(one)
            poses = cuboid_poses(one, times, angles=self.angles)
            attributes = self._attributes(one, "lidar", times)
            is_key = np.isin(times, one.path.timestamps_ns)
            off = len(np.setdiff1d(one.path.timestamps_ns, times))
            if off:
                what = "its keyframes lie between sweeps; written as interpolated at the sweeps"
                self.losses.approximated(f"annotations[{one.id}].path.timestamps_ns", what, count=off)
            for k in np.flatnonzero(poses.there).tolist():
                row = np.concatenate([poses.centers_world[k], poses.sizes_lwh[k], poses.quaternions_xyzw[k]])
                self.shown.add(key_of(one.id))
                shape = Drawn(Kind.CUBOID, first + k, row, label, track, attributes[k], (), bool(is_key[k]), part)
                self.drawn[first + k].append(shape)

    def _report(self) -> None:
        """Report what annotations hold besides."""
        whole = {loss.field for loss in self.losses}
        shown = self.shown | self.used_parents
        for one in self.scene.annotations:
            where, kind = f"annotations[{one.id}]", KINDS[type(one)]
            if key_of(one.id) not in shown and kind not in whole:
                self.losses.dropped(kind, "left out: only what is drawn in images, or as the tool draws, is written")
            elif isinstance(one, CuboidAnnotation) and not self.cuboids:
                self.losses.converted(f"{where}.path.values", "written as the boxes in the images of cameras")
            elif isinstance(one, PointsAnnotation) and any(len(path.timestamps_ns) for path in one.paths):
                self.losses.dropped(f"{where}.paths.values", "left out: only points in images are written")
            parent = getattr(one, "parent_id", None)
            if parent is not None and key_of(parent) not in self.used_parents:
                self.losses.dropped(f"{where}.parent_id", "left out: the tool has no field for it")
            extras = getattr(one, "extras", {})
            if extras:
                self.losses.dropped(f"{where}.extras", "left out: the tool has no field for it", count=len(extras))


def _is_sound(name: str) -> bool:
    """Whether a file of a folder may have that name."""
    pure = PurePosixPath(name)
    return (
        bool(name)
        and len(pure.parts) <= MOST_FOLDERS
        and not pure.is_absolute()
        and ".." not in pure.parts
        and not _UNWRITTEN_NAME.search(name)
    )


def _read_table(sensor: Any) -> dict[int, tuple[int, int, int, str]]:
    """The labelled images of a sensor by their times: number, width, height and name."""
    rows = sensor.extras.get(IMAGES)
    found = {}
    for row in rows if isinstance(rows, list | tuple) else ():
        if isinstance(row, list | tuple) and [*map(type, row)] == [int, int, int, int, str]:
            found[row[0]] = (row[1], row[2], row[3], row[4])
    return found


def _cameras_of(annotations: Iterable[Any]) -> Iterator[Identifier]:
    for one in annotations:
        if isinstance(one, Box2DAnnotation) or (isinstance(one, ShapeAnnotation) and one.type in _DRAWN_IN_IMAGES):
            if one.sensor_id is not None:
                yield one.sensor_id
        elif isinstance(one, CuboidAnnotation):
            yield from (seen.sensor_id for seen in one.projections if seen.boxes is not None)
        elif isinstance(one, PointsAnnotation):
            yield from (seen.sensor_id for point in one.projections for seen in point if seen.points is not None)


def _seen_by(one: Any) -> set[Key]:
    """The cameras whose images an annotation is drawn in."""
    found = set(map(key_of, _cameras_of([one])))
    if isinstance(one, EventAnnotation) and one.sensor_id is not None:
        found.add(key_of(one.sensor_id))
    return found


def _own_times(one: Any, camera: Identifier) -> Int64Array:
    """Times at which an annotation states where it is in the images of a camera."""
    if isinstance(one, Box2DAnnotation | ShapeAnnotation):
        return one.path.timestamps_ns
    if isinstance(one, EventAnnotation):
        return np.array([one.start_ns], np.int64)
    parts = [one.projections] if isinstance(one, CuboidAnnotation) else one.projections
    seen = [part.timestamps_ns for row in parts for part in row if key_of(part.sensor_id) == key_of(camera)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *seen]))


_Shape = tuple[int, Kind, Any, tuple[str, ...]]  # location of the frame, kind, values, names of points


def _shapes_of(  # noqa: PLR0912 - some for each kind
    one: Any, camera: Identifier, times: Int64Array, is_key: Any
) -> Iterator[_Shape]:
    """The shapes of an annotation at the times of frames."""
    if isinstance(one, EventAnnotation):
        stop_ns = one.start_ns + int(one.duration_ns or 0)
        for k in np.flatnonzero((times >= one.start_ns) & (times <= stop_ns)).tolist():
            yield k, Kind.TAG, None, ()
    elif isinstance(one, Box2DAnnotation):
        masks = one.path.extras.get(MASKS)
        if isinstance(masks, list | tuple) and len(masks) == len(one.path.timestamps_ns):
            for k in np.flatnonzero(is_key).tolist():
                row = int(np.searchsorted(one.path.timestamps_ns, times[k], side="right")) - 1
                yield k, Kind.MASK, Mask.of_record(masks[row]), ()
            return
        rows, there = box_2d_at(one, times)
        for k in np.flatnonzero(there & np.isfinite(rows).all(axis=1)).tolist():
            yield k, Kind.BOX, rows[k], ()
    elif isinstance(one, ShapeAnnotation):
        rotated = _rotated_at(one, times)
        for k, vertices in enumerate(shape_at(one, times)):
            if vertices is None or not np.isfinite(vertices).all() or not len(vertices):
                continue
            if one.type is ShapeType.POINT_2D:
                yield k, Kind.POINTS, np.column_stack([vertices, np.full(len(vertices), 2.0)]), ()
            elif rotated is not None:
                yield k, Kind.ROTATED, rotated[k], ()
            else:
                kind = Kind.POLYGON if one.type is ShapeType.POLYGON_2D else Kind.POLYLINE
                yield k, kind, vertices, ()
    elif isinstance(one, CuboidAnnotation):
        for seen in one.projections:
            if key_of(seen.sensor_id) == key_of(camera) and seen.boxes is not None:
                for time_ns, row in zip(seen.timestamps_ns, seen.boxes, strict=True):
                    k = int(np.searchsorted(times, time_ns))
                    if np.isfinite(row).all() and k < len(times) and times[k] == time_ns:
                        yield k, Kind.BOX, row, ()
    else:
        yield from _keypoints(one, camera, times)


def _keypoints(one: PointsAnnotation, camera: Identifier, times: Int64Array) -> Iterator[_Shape]:
    names = one.labels or tuple(str(k) for k in range(len(one.projections)))
    table = np.zeros((len(times), len(one.projections), 3))
    stated = np.zeros(len(times), np.bool_)
    for k, point in enumerate(one.projections):
        for seen in point:
            if key_of(seen.sensor_id) != key_of(camera) or seen.points is None:
                continue
            flags = seen.extras.get("visibility")
            flags = flags if isinstance(flags, list | tuple) and len(flags) == len(seen.points) else None
            for row, (time_ns, pixel) in enumerate(zip(seen.timestamps_ns, seen.points, strict=True)):
                place = int(np.searchsorted(times, time_ns))
                if place < len(times) and times[place] == time_ns:
                    stated[place] = True
                    if np.isfinite(pixel).all():
                        table[place, k] = (*pixel, 2.0 if flags is None else flags[row])
    for place in np.flatnonzero(stated).tolist():
        yield place, Kind.POINTS, table[place], tuple(names[: len(one.projections)])


def _rotated_at(one: ShapeAnnotation, times: Int64Array) -> Float64Array | None:
    """The rotated boxes that polygons were made of, at times; None where they are of none."""
    rows = one.path.extras.get(RBBOX)
    own = one.path.timestamps_ns
    if not isinstance(rows, list | tuple) or not rows or len(rows) != len(own):
        return None
    try:
        table = np.array(rows, np.float64)
    except (TypeError, ValueError):
        return None
    if table.shape != (len(own), 5) or not np.isfinite(table).all():
        return None
    angles = np.unwrap(table[:, 4])
    columns = [*table[:, :4].T, angles]
    span = own - own[0]
    found = np.column_stack([np.interp((times - own[0]).astype(float), span.astype(float), one) for one in columns])
    return read_only(found)
