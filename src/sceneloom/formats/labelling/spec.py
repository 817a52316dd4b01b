"""Files of labelling tools: how they are recognised, their options, and what becomes of a scene in them."""

import re
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.losses import KEPT, Holding, Supports, approximated, converted, dropped
from sceneloom.formats.base.spec import FormatSpec, first_bytes

_BEGINNING = 4096
_HERE = "sceneloom.formats.labelling"
_READING = ("lenient", "rate_hz")

_NO_FIELD = dropped("left out: the tool has no field for it")
_DRAWN_ONLY = dropped("left out: the tool holds what is drawn in images")
_AS_ATTRIBUTES = converted("an attribute of the shape in each frame; text, numbers, true and false")


def _annotation(kind: str, *kept: str, **other: Holding) -> dict[str, Holding]:
    """What becomes of the annotations of a kind: some fields are kept, and some are stated in another way."""
    rows = dict.fromkeys(("id", "label", *kept), KEPT)
    rows |= {"attributes": _AS_ATTRIBUTES, **other}
    if kind != "event":
        rows["stationary"] = converted("drawn in every frame")
    return {f"annotations.{kind}.{name.replace('__', '.')}": holding for name, holding in rows.items()}


_TIMES = converted("in the names of images, or in frames counted from the first")
_PARENT = converted("shapes of one object have its id; other parents are left out")
_CAMERA = {
    "sensors.camera.id": converted("the folder in the names of its images"),
    "sensors.camera.images.timestamp_ns": _TIMES,
    "sensors.camera.images.rgb": KEPT,
    "sensors.camera.images.encoded": converted("as they are, or as PNG where they are no JPEG or PNG"),
    "sensors.camera.extras": dropped("left out but for the names of labelled images"),
}
_AMONG = converted("boxes of cuboids are among them")
_BOXES = _annotation(
    "box_2d", "path.timestamps_ns", "path.values", sensor_id=converted("by the image"), parent_id=_PARENT,
    path__extras=dropped("left out but for masks"), id=_AMONG, label=_AMONG,
)  # fmt: skip
_SHAPES = _annotation(
    "shape", "type", "path.timestamps_ns", "path.vertices", sensor_id=converted("by the image"), parent_id=_PARENT,
    path__extras=dropped("left out but for rotated boxes"),
)  # fmt: skip
_POINTS = {
    "annotations.points.paths.id": converted("counted"),
    "annotations.points.projections.extras": converted("whether each point is visible"),
    "annotations.points.id": converted("where the object has other shapes, too, with the kind behind it"),
    "annotations.points.labels": KEPT,
    "annotations.points.parent_id": _PARENT,
    "annotations.points.attributes": _AS_ATTRIBUTES,
    "annotations.points.projections.sensor_id": converted("by the image"),
    "annotations.points.projections.timestamps_ns": KEPT,
    "annotations.points.projections.points": KEPT,
}
_TAGS = _annotation(
    "event", sensor_id=converted("by the image"), start_ns=converted("the images that it lasts over"),
    duration_ns=converted("the images that it lasts over"),
)  # fmt: skip
_PROJECTED = {
    "annotations.cuboid.id": converted("of its boxes in images"),
    "annotations.cuboid.label": converted("of its boxes in images"),
    "annotations.cuboid.attributes": _AS_ATTRIBUTES,
    "annotations.cuboid.path.values": dropped("left out: only boxes in images are written"),
    "annotations.cuboid.projections.sensor_id": converted("by the image"),
    "annotations.cuboid.projections.timestamps_ns": converted("boxes in images"),
    "annotations.cuboid.projections.boxes": converted("boxes in images"),
}
_CUBOIDS = _annotation(
    "cuboid", "path.timestamps_ns", path__values=converted("centre, sizes and angles [rad] at each sweep"),
)  # fmt: skip
_OBJECTS = {
    "annotations.order": converted("by frames and tracks"),
    "annotations.object.id": converted("the id of its shapes"),
    "annotations.object.label": converted("the class of its shapes"),
}
_NAMED = {"sensors.lidar.frames.timestamp_ns": _TIMES}

_IN_IMAGES: dict[str, Holding] = {"": _DRAWN_ONLY, **_CAMERA, **_BOXES, **_SHAPES, **_POINTS, **_PROJECTED, **_OBJECTS}


def _supports(*further: dict[str, Holding]) -> Supports:
    return MappingProxyType({**_IN_IMAGES, **{name: row for rows in further for name, row in rows.items()}})


def file_in(path: Path, *patterns: str) -> list[Path]:
    """The file that a path is, or those in a folder that fit one of some patterns, the first pattern first."""
    if not path.is_dir():
        return [path]
    try:
        return [file for pattern in patterns for file in sorted(path.glob(pattern)) if file.is_file()]
    except OSError:
        return []


def _any_file(*patterns: str, is_one: Callable[[Path], bool]) -> Callable[[Path], bool]:
    return lambda path: any(map(is_one, file_in(path, *patterns)))


# CVAT

_XML = rb"(?:\xef\xbb\xbf)?\s*<(?s:.*<)?"
_CVAT = re.compile(_XML + rb"annotations[\s>]")
_TRACKLETS = re.compile(_XML + rb"boost_serialization[\s>]")


def is_cvat(path: Path) -> bool:
    """Whether a file is XML of CVAT 1.1."""
    return _CVAT.match(first_bytes(path, _BEGINNING)) is not None


TRACKLETS_FILE, FRAME_LIST = "tracklet_labels.xml", "frame_list.txt"


def _is_tracklets(path: Path) -> bool:
    if path.is_dir():
        return (path / FRAME_LIST).is_file() and _is_tracklets(path / TRACKLETS_FILE)
    return path.is_file() and _TRACKLETS.match(first_bytes(path, _BEGINNING)) is not None


CVAT_FILES = ("annotations.xml", "*.xml")

CVAT = FormatSpec(
    name="cvat",
    title="CVAT",
    looks_like="an .xml file with `<annotations>` of CVAT 1.1 (images or video), or a folder with an annotations.xml",
    suffixes=(".xml", ".cvat"),
    sniff=_any_file(*CVAT_FILES, is_one=is_cvat),
    reader=f"{_HERE}.cvat:read_cvat",
    read_options=_READING,
    writer=f"{_HERE}.cvat:write_cvat",
    write_options=("images", "task", "camera"),
    supports=_supports(
        _TAGS, {"annotations.points.labels": dropped("left out: points have no names, and skeletons are not written")}
    ),
)
TRACKLETS = FormatSpec(
    name="tracklets",
    title="tracklets of CVAT 3D tasks",
    looks_like="a tracklet_labels.xml by itself, or a folder with it and frame_list.txt (CVAT's Kitti Raw Format)",
    suffixes=("tracklet_labels.xml",),
    sniff=_is_tracklets,
    reader=f"{_HERE}.cvat:read_tracklets",
    read_options=(*_READING, "dialect"),
    writer=f"{_HERE}.cvat:write_tracklets",
    write_options=("dialect",),
    supports=MappingProxyType(
        {
            "": _NO_FIELD,
            **_NAMED,
            **_CUBOIDS,
            "annotations.cuboid.id": converted("the attribute track_id"),
            "sensors.lidar.frames.timestamp_ns": converted("the number of the sweep"),
            "annotations.cuboid.path.timestamps_ns": converted("the number of the sweep"),
        }
    ),
)


# JSON of several tools, told apart by the members of its root


class _Members(msgspec.Struct):
    """The members by which the root shows whose it is, not looked into."""

    images: msgspec.Raw = msgspec.Raw(b"")
    annotations: msgspec.Raw = msgspec.Raw(b"")
    categories: msgspec.Raw = msgspec.Raw(b"")
    items: msgspec.Raw = msgspec.Raw(b"")


_FIRST_KEY = re.compile(
    rb'(?:\xef\xbb\xbf)?\s*\{\s*"(?:info|infos|licenses|images|annotations|categories|videos|items|media_type|'
    rb'dm_format_version|type)"\s*:'
)


def _members(path: Path) -> _Members:
    """The members of the root; none of a file that begins otherwise."""
    if path.suffix.lower() == ".sfs" or not _FIRST_KEY.match(first_bytes(path, _BEGINNING)):
        return _Members()
    try:
        return msgspec.json.decode(read_bytes(path), type=_Members)
    except (DataError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return _Members()


def _opens(raw: msgspec.Raw, mark: bytes) -> bool:
    return bytes(raw).lstrip().startswith(mark)


def is_coco(path: Path) -> bool:
    """Whether a file is JSON of COCO: lists of images and annotations."""
    found = _members(path)
    return _opens(found.images, b"[") and _opens(found.annotations, b"[")


def is_datumaro(path: Path) -> bool:
    """Whether a file is JSON of Datumaro: a list of items, and categories by their kinds."""
    found = _members(path)
    return _opens(found.items, b"[") and _opens(found.categories, b"{")


COCO_FILES = DATUMARO_FILES = ("annotations/*.json", "*.json")

COCO = FormatSpec(
    name="coco",
    title="COCO",
    looks_like="a .json file with lists of images, annotations and categories, or a folder with annotations/NAME.json",
    suffixes=(".coco.json", ".coco"),
    sniff=_any_file(*COCO_FILES, is_one=is_coco),
    reader=f"{_HERE}.coco:read_coco",
    read_options=_READING,
    writer=f"{_HERE}.coco:write_coco",
    write_options=("images",),
    supports=_supports(),
)
DATUMARO = FormatSpec(
    name="datumaro",
    title="Datumaro",
    looks_like="a .json file with a list of items and categories by kind, or a folder with annotations/NAME.json",
    suffixes=(".datumaro.json", ".datumaro"),
    sniff=_any_file(*DATUMARO_FILES, is_one=is_datumaro),
    reader=f"{_HERE}.datumaro:read_datumaro",
    read_options=_READING,
    writer=f"{_HERE}.datumaro:write_datumaro",
    write_options=("images",),
    supports=_supports(_TAGS, _CUBOIDS, _NAMED),
)

# YOLO

YOLO_FILES = ("data.yaml", "data.yml", "dataset.yaml", "obj.names", "obj.data")
_NAMES = re.compile(rb"(?m)^\s*(?:\"?names\"?\s*:|nc\s*:)")


def is_yolo(path: Path) -> bool:
    """Whether a file states the classes of a data set of YOLO."""
    if path.name.lower() in ("obj.names", "obj.data"):
        return path.is_file()
    return path.suffix.lower() in (".yaml", ".yml") and _NAMES.search(first_bytes(path, 1 << 16)) is not None


YOLO = FormatSpec(
    name="yolo",
    title="YOLO",
    looks_like="a data.yaml with names beside images/ and labels/ (Ultralytics), a folder with it, or with obj.names",
    suffixes=(".yolo",),
    sniff=_any_file(*YOLO_FILES, is_one=is_yolo),
    reader=f"{_HERE}.yolo:read_yolo",
    read_options=(*_READING, "task"),
    writer=f"{_HERE}.yolo:write_yolo",
    write_options=("images", "task"),
    supports=_supports(
        {
            name: dropped("left out: a line is a class and where it is")
            for kind in ("box_2d", "shape", "points", "cuboid")
            for name in (f"annotations.{kind}.id", f"annotations.{kind}.attributes")
        },
        {
            name: approximated("each image by itself, in shares of it")
            for name in (
                *(
                    "annotations.box_2d.path.timestamps_ns",
                    "annotations.box_2d.path.values",
                    "annotations.points.labels",
                ),
                *("annotations.points.projections.timestamps_ns", "annotations.points.projections.points"),
                *("annotations.shape.path.timestamps_ns", "annotations.shape.path.vertices"),
            )
        },
        {"annotations.object.id": dropped("left out: a line is a class and where it is")},
    ),
)

# Label Studio

_TASKS = re.compile(rb"(?:\xef\xbb\xbf)?\s*\[\s*\{")
_TASK_KEY = re.compile(rb'"(?:annotations|predictions|completions|data)"\s*:')


def is_label_studio(path: Path) -> bool:
    """Whether a file is a list of tasks of Label Studio."""
    beginning = first_bytes(path, 1 << 16)
    return _TASKS.match(beginning) is not None and _TASK_KEY.search(beginning) is not None


LABEL_STUDIO_FILES = ("tasks.json", "*.json")

LABEL_STUDIO = FormatSpec(
    name="label-studio",
    title="Label Studio",
    looks_like="a .json file that is a list of tasks with annotations and data, or a folder with a tasks.json",
    suffixes=(".label-studio.json", ".label-studio"),
    sniff=_any_file(LABEL_STUDIO_FILES[0], is_one=is_label_studio),
    reader=f"{_HERE}.label_studio:read_label_studio",
    read_options=_READING,
    writer=f"{_HERE}.label_studio:write_label_studio",
    write_options=("images", "task", "camera", "prefix"),
    supports=_supports(
        _TAGS, {"annotations.points.projections.points": converted("percent of the image's width and height")}
    ),
)
