"""CVAT: XML of images and of videos (CVAT 1.1), and the tracklets of 3D tasks (Kitti Raw Format), read and written.

Source: "XML annotation format" of CVAT's documentation; for tracklets the development kit of KITTI (tracklets.h) and
what CVAT makes of it through Datumaro.
"""

import re
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO
from xml.etree import ElementTree as ET
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError, OptionError, check_choice
from sceneloom.formats.base.files import check_length, file_faults, open_file, read_settings
from sceneloom.formats.base.losses import Losses, LossReport, field_losses
from sceneloom.formats.base.masks import Mask
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.labelling.drawn import (
    MOST_FOLDERS,
    TRACK,
    Drawn,
    Frame,
    Kind,
    Labels,
    Sheet,
    id_text,
    image_roots,
    text_id,
)
from sceneloom.formats.labelling.spec import CVAT, CVAT_FILES, FRAME_LIST, TRACKLETS, TRACKLETS_FILE, file_in, is_cvat
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import matrix_from_quaternion, quaternion_from_matrix
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import WarningKind

# XML, element by element

_LINE = "\0line"  # an attribute that no file has: where the element begins
_DEEPEST = 32
_CHUNK = 1 << 16


def _elements(path: Path, root: str, *, depth: int = 1) -> Iterator[ET.Element]:
    """Give the elements at a depth below the root whole, one after the other; nothing else of the file is kept.

    Raises:
        DataError: it cannot be read, is no such XML, declares entities, or has elements in elements without end.
    """
    builder, done, above = ET.TreeBuilder(), deque[ET.Element](), list[str]()
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def fault(problem: str) -> DataError:
        return DataError(path, f"line {parser.CurrentLineNumber}", problem)

    def start(tag: str, attributes: dict[str, str]) -> None:
        if not above and tag != root:
            raise fault(f"root element {tag[:40]!r}; expected <{root}>")
        if len(above) >= _DEEPEST:
            raise fault(f"elements in {_DEEPEST} others; expected labels")
        if len(above) >= depth:
            builder.start(tag, {**attributes, _LINE: str(parser.CurrentLineNumber)})
        above.append(tag)

    def end(tag: str) -> None:
        nonlocal builder
        above.pop()
        if len(above) >= depth:
            builder.end(tag)
        if len(above) == depth:
            done.append(builder.close())
            builder = ET.TreeBuilder()

    def data(text: str) -> None:
        if len(above) > depth:
            builder.data(text)

    def entity(*_: Any) -> int:
        raise fault("declares entities; expected plain XML")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, data
    parser.EntityDeclHandler = parser.ExternalEntityRefHandler = entity
    with file_faults(path), open_file(path) as file:
        check_length(path)
        while True:
            content = file.read(_CHUNK)
            try:
                parser.Parse(content, not content)
            except (expat.ExpatError, ValueError, LookupError) as error:
                raise fault(f"is no XML: {error}") from error
            while done:
                yield done.popleft()
            if not content:
                return


def _fault(path: Path, element: ET.Element, problem: str) -> DataError:
    name = element.tag if element.tag.isprintable() else repr(element.tag)
    return DataError(path, f"line {element.get(_LINE)}, <{name}>", problem)


_GREATEST = 1e9


def _number(path: Path, element: ET.Element, name: str, default: float | None = None) -> float:
    text = element.get(name)
    return default if text is None and default is not None else _checked(path, element, name, text)


def _checked(path: Path, element: ET.Element, name: str, text: str | None) -> float:
    """What an element states as a number."""
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not abs(value) <= _GREATEST:
        shown = "missing" if text is None else repr(text[:40])
        raise _fault(path, element, f"{name}: {shown}; expected a number within {_GREATEST:g}")
    return value


def _whole(path: Path, element: ET.Element, name: str, default: int | None = None) -> int:
    value = _number(path, element, name, default)
    if value != int(value):
        raise _fault(path, element, f"{name}: {value:g}; expected a whole number")
    return int(value)


def _pairs(path: Path, element: ET.Element) -> Float64Array:
    """The vertices of `points`, (V, 2) [px]."""
    text = element.get("points", "")
    try:
        found = np.array([[float(word) for word in pair.split(",")] for pair in text.split(";")], np.float64)
    except ValueError:
        found = np.zeros((0, 0))
    if found.ndim != 2 or found.shape[1] != 2 or not (np.abs(found) <= _GREATEST).all():
        raise _fault(path, element, f"points: {text[:40]!r}; expected pairs of numbers, x,y;x,y;…")
    return found


# reading CVAT 1.1


class _Spec:
    """What the head of a file states: classes with their attributes, frames and the size of a video."""

    def __init__(self, path: Path, meta: ET.Element | None) -> None:
        self.path, self.meta = path, meta
        self.input_types: dict[tuple[str, str], str] = {}
        self.labels: list[dict[str, Any]] = []
        for label in [] if meta is None else meta.iter("label"):
            name = label.findtext("name") or ""
            for attribute in label.iter("attribute"):
                self.input_types[name, attribute.findtext("name") or ""] = attribute.findtext("input_type") or ""
            if label.find("parent") is None:
                self.labels.append(
                    {"name": name, **{key: text for key in ("color", "type", "svg") if (text := label.findtext(key))}}
                )
        self.step = int(found[1]) if (found := re.search(r"step=([0-9]{1,9})", self._text("frame_filter"))) else 1

    def _text(self, name: str) -> str:
        found = None if self.meta is None else next(self.meta.iter(name), None)
        return "" if found is None else found.text or ""

    def whole(self, name: str) -> int | None:
        text = self._text(name).strip()
        return int(text) if re.fullmatch(r"[0-9]{1,9}", text) else None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a video; 0 where they are not stated."""
        return self.whole("width") or 0, self.whole("height") or 0

    def numbers(self) -> Sequence[int]:
        """The numbers of the frames of a video."""
        first, last, count = self.whole("start_frame") or 0, self.whole("stop_frame"), self.whole("size")
        if last is None:
            return range(first, first + (count or 0))
        return range(first, last + 1, max(self.step, 1))

    def ours(self, name: str) -> str | None:
        """What we wrote besides."""
        found = None if self.meta is None else self.meta.find(f"sceneloom/{name}")
        return None if found is None else found.text

    def timestamps_ns(self) -> list[int]:
        """Times of the frames that we wrote [ns]."""
        words = (self.ours("timestamps_ns") or "").split()
        return [int(word) for word in words] if all(re.fullmatch(r"-?[0-9]{1,19}", word) for word in words) else []

    def value(self, label: str, name: str, text: str) -> Any:
        """An attribute's value by its type of input; of unknown ones only true and false are no texts."""
        kind = self.input_types.get((label, name))
        if kind in ("checkbox", None) and text in ("true", "false"):
            return text == "true"
        if kind == "number" and re.fullmatch(r"[+-]?([0-9]{1,18}|[0-9]*\.[0-9]*([eE][+-]?[0-9]{1,3})?)", text):
            try:
                return int(text) if text.lstrip("+-").isdigit() else float(text)
            except ValueError:
                return text
        return text


_LARGEST_MASK = 1 << 25  # pixels of the rectangle that a mask is in

_SHAPES = ("box", "polygon", "polyline", "points", "mask", "skeleton", "tag")


class _CvatReader:
    """Takes the elements of a file one by one."""

    def __init__(self, path: Path, labels: Labels) -> None:
        self.path, self.labels = path, labels
        self.spec = _Spec(path, None)
        self.by_number: dict[int, int] = {}  # locations of the frames of a video
        self.ours: list[int] = []
        self.taken = 0  # images so far

    def read(self) -> Scene:
        for element in _elements(self.path, "annotations"):
            try:
                match element.tag:
                    case "meta":
                        self._head(element)
                    case "image":
                        self._image(element)
                    case "track":
                        self._track(element)
            except ValueError as error:
                self.labels.ledger.fault("shapes", _fault(self.path, element, str(error)))
            except DataError as error:
                self.labels.ledger.fault("shapes", error)
        return self.labels.scene()

    def _head(self, meta: ET.Element) -> None:
        self.spec = _Spec(self.path, meta)
        self.ours = self.spec.timestamps_ns()
        named = [label["name"] for label in self.spec.labels]
        self.labels.spec = {"tool": "cvat", "labels": named, "cvat": self.spec.labels} if named else {}

    def _image(self, image: ET.Element) -> None:
        number = _whole(self.path, image, "id", self.taken)
        time_ns = self.ours[self.taken] if self.taken < len(self.ours) else None
        self.taken += 1
        size = _whole(self.path, image, "width", 0), _whole(self.path, image, "height", 0)
        frame = self.labels.add_frame(Frame(number, image.get("name", ""), *size, time_ns))
        for element in image:
            if element.tag not in _SHAPES:
                self._not_read(element)
                continue
            one = self._shape(element, element.get("label", ""), frame, size)
            if one is not None:
                self.labels.drawn.append(one)

    def _not_read(self, element: ET.Element) -> None:
        message = f"shapes <{element.tag[:40]}> are not read; read are {', '.join(_SHAPES)}"
        self.labels.skipped("shapes-unknown", f"line {element.get(_LINE)}", message)

    def _shape(self, element: ET.Element, label: str, frame: int, size: tuple[int, int]) -> Drawn | None:
        kind, values, names = self._values(element, size)
        one = Drawn(kind, frame, values, label or None, names=names)
        for name, default in (("z_order", 0), ("group_id", 0)):
            if found := _whole(self.path, element, name, default):
                one.attributes[name] = found
        if element.get("occluded") == "1":
            one.attributes["occluded"] = True
        self._attributes(element, label, one)
        return one

    def _attributes(self, element: ET.Element, label: str, one: Drawn) -> None:
        for attribute in element.findall("attribute"):
            name, text = attribute.get("name", ""), attribute.text or ""
            if name == TRACK:
                one.track = text_id(text)
            else:
                one.attributes[name] = self.spec.value(label, name, text)

    def _values(  # noqa: PLR0911 - one for each kind
        self, element: ET.Element, size: tuple[int, int]
    ) -> tuple[Kind, Any, tuple[str, ...]]:
        path = self.path
        match element.tag:
            case "box":
                left, top, right, bottom = (_number(path, element, name) for name in ("xtl", "ytl", "xbr", "ybr"))
                box = (left, top, right - left, bottom - top)
                rotation = _number(path, element, "rotation", 0.0)
                if rotation:
                    centre = ((left + right) / 2, (top + bottom) / 2)
                    return Kind.ROTATED, np.array([*centre, *box[2:], np.radians(rotation)]), ()
                return Kind.BOX, np.array(box), ()
            case "polygon" | "polyline":
                return Kind(element.tag), _pairs(path, element), ()
            case "points":
                pairs = _pairs(path, element)
                return Kind.POINTS, np.column_stack([pairs, np.full(len(pairs), 2.0)]), ()
            case "mask":
                return Kind.MASK, self._mask(element, size), ()
            case "skeleton":
                return Kind.POINTS, *self._skeleton(element)
            case _:
                return Kind.TAG, None, ()

    def _mask(self, element: ET.Element, size: tuple[int, int]) -> Mask:
        left, top, width, height = (_whole(self.path, element, name) for name in ("left", "top", "width", "height"))
        text = element.get("rle", "")
        words = [word.strip() for word in text.split(",")]
        if not all(re.fullmatch(r"[0-9]{1,9}", word) for word in words):
            raise _fault(self.path, element, f"rle: {text[:40]!r}; expected whole numbers")
        if not all(size):
            raise _fault(self.path, element, "the image has no width and height, which a mask needs")
        if width * height > _LARGEST_MASK:
            raise _fault(self.path, element, f"{width}x{height} pixels; expected {_LARGEST_MASK} at most")
        # row by row within the rectangle: as if its columns were rows
        columns, rows = Mask(width, height, tuple(map(int, words))).pixels()
        return Mask.of_pixels(size[1], size[0], rows + left, columns + top)

    def _skeleton(self, element: ET.Element) -> tuple[Float64Array, tuple[str, ...]]:
        rows, names = [], []
        for point in element.findall("points"):
            visible = 0.0 if point.get("outside") == "1" else 1.0 if point.get("occluded") == "1" else 2.0
            rows.append([*_pairs(self.path, point)[0], visible])
            names.append(point.get("label", ""))
        if not rows:
            raise _fault(self.path, element, "no points")
        return np.array(rows, np.float64), tuple(names)

    def _frame(self, element: ET.Element) -> int:
        """The location of the frame of a shape of a video; all of the head's frames are listed with the first."""
        if not self.by_number:
            numbers = self.spec.numbers()
            camera = text_id(text) if (text := self.spec.ours("camera")) else None
            for k, number in enumerate(numbers if len(numbers) <= 1_000_000 else ()):
                time_ns = self.ours[k] if len(self.ours) == len(numbers) else None
                self._add_frame(number, time_ns, camera)
        number = _whole(self.path, element, "frame")
        if number not in self.by_number:
            self._add_frame(number, None, None)
        return self.by_number[number]

    def _add_frame(self, number: int, time_ns: int | None, camera: Identifier | None) -> None:
        frame = Frame(number, _frame_name(number), *self.spec.size, time_ns, camera)
        self.by_number[number] = self.labels.add_frame(frame)

    def _track(self, track: ET.Element) -> None:
        """The shapes of a track: a frame where it is outside ends a stretch, which it holds until just before."""
        label, found, segment = track.get("label", ""), list[Drawn](), 0
        nested = track.findall("track")
        rows = self._skeleton_rows(track, nested) if nested else [one for one in track if one.tag in _SHAPES]
        for other in track:
            if other.tag not in (*_SHAPES, "track"):
                self._not_read(other)
        rows.sort(key=lambda element: _whole(self.path, element, "frame"))
        for element in rows:
            frame = self._frame(element)
            if element.get("outside") == "1":
                if found and found[-1].segment == segment:
                    self._extend(found, self.labels.frames[frame].number)
                    segment += 1
                continue
            one = self._shape(element, label, frame, self.spec.size)
            if one is not None:
                one.keyframe, one.segment = element.get("keyframe", "1") == "1", segment
                found.append(one)
        stated = text_id(track.get("id", ""))
        identifier = next((one.track for one in found if one.track is not None), stated)
        for one in found:
            one.track = identifier
        self.labels.drawn += found

    def _extend(self, found: list[Drawn], outside: int) -> None:
        """Hold the last shape until just before it is outside."""
        last = found[-1]
        before = outside - max(self.spec.step, 1)
        if before in self.by_number and before > self.labels.frames[last.frame].number:
            frame = self.by_number[before]
            held = Drawn(last.kind, frame, last.values, last.label, last.track, dict(last.attributes), last.names)
            held.segment = last.segment
            found.append(held)

    def _skeleton_rows(self, track: ET.Element, nested: list[ET.Element]) -> list[ET.Element]:
        """Skeletons with the points of the tracks inside; each point holds until it is stated anew."""
        states = [{_whole(self.path, one, "frame"): one for one in inner.findall("points")} for inner in nested]
        rows = []
        for skeleton in track.findall("skeleton"):
            number, row = _whole(self.path, skeleton, "frame"), ET.Element("skeleton", dict(skeleton.attrib))
            row.extend(skeleton.findall("attribute"))
            for inner, by_frame in zip(nested, states, strict=True):
                known = [frame for frame in by_frame if frame <= number]
                if known:
                    point = by_frame[max(known)]
                    row.append(ET.Element("points", {**point.attrib, "label": inner.get("label", "")}))
            rows.append(row)
        return rows


def _frame_name(number: int) -> str:
    """The name of an image of a video, as CVAT exports it."""
    return f"frame_{number:06d}.PNG"


def read_cvat(path: Path, *, lenient: bool = False, rate_hz: float | str | None = None) -> Scene:
    """Read a file, or the one in a folder.

    Args:
        rate_hz: frames per second where nothing states times.

    Raises:
        OptionError: the rate is no number above 0.
        DataError: it is no XML of CVAT.
    """
    files = [one for one in file_in(path, *CVAT_FILES) if is_cvat(one)]
    files = files if len(files) == 1 else [one for one in files if one.name == CVAT_FILES[0]]
    if not files:
        raise DataError(
            path, "", "no annotations.xml of CVAT, or several; expected a file that begins with <annotations>"
        )
    labels = Labels.of(files[0], "cvat", lenient=lenient, rate_hz=rate_hz)
    labels.roots = image_roots(files[0], files[0].stem)
    with labels.ledger.telling():
        return _CvatReader(files[0], labels).read()


# writing CVAT 1.1

_CONTROLS = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
_FOLDER = FolderKind(
    "folder of CVAT",
    ("annotations\\.xml", *("/".join(["images", *[".*"] * depth]) for depth in range(1, MOST_FOLDERS + 1))),
    marker="annotations\\.xml",
)


def _text(value: Any) -> str:
    """Text that XML can hold."""
    return _CONTROLS.sub("\ufffd", str(value))


def _plain(number: float) -> str:
    return f"{number:.6f}"


def _stated(value: Any) -> str:
    return ("true" if value else "false") if isinstance(value, bool) else _text(value)


def _open_tag(name: str, attributes: Mapping[str, Any]) -> str:
    return f"<{name}{''.join(f' {key}={quoteattr(_text(value))}' for key, value in attributes.items())}>"


_BUILT_IN = ("occluded", "z_order", "group_id")


def _input_type(values: Iterable[Any]) -> str:
    kinds = {type(value) for value in values}
    return "checkbox" if kinds == {bool} else "number" if kinds and kinds <= {int, float} else "text"


def write_cvat(
    scene: Scene,
    path: Path,
    *,
    images: str = "copy",
    task: str | None = None,
    camera: str | None = None,
    overwrite: bool = False,
) -> LossReport:
    """Write a file, or a folder with annotations.xml and images where the path has no suffix `.xml`.

    Args:
        images: "copy" writes images into the folder, "none" their names only.
        task: "images" or "video", which has tracks of one camera; None: a video where that holds all.
        camera: whose images a video has; None for the only one.

    Raises:
        OptionError: there is no such task, choice or camera, or a video of several cameras was asked for.
        OutputError: the output exists, or cannot be written.
    """
    if task not in (None, "images", "video"):
        raise OptionError(f"task {task!r}; expected images or video")
    losses = Losses(field_losses(scene, CVAT.supports))
    sheet = Sheet.of(scene, losses, cameras=None if camera is None else [text_id(camera)])
    cameras = list({key_of(frame.camera): frame.camera for frame in sheet.frames if frame.camera is not None}.values())
    flat = all(one.kind not in (Kind.MASK, Kind.TAG) for drawn in sheet.drawn for one in drawn)
    tracked = any(len({k for k, _ in group}) > 1 for group in _tracks(sheet).values())
    if task == "video" and len(cameras) > 1:
        names = ", ".join(map(repr, cameras))
        raise OptionError(f"a video has one camera; choose one with `--output-option camera=ID`: {names}")
    write = _write_images
    if task == "video" or (task is None and len(cameras) == 1 and flat and tracked):
        sheet, write = sheet.renamed(_frame_name), _write_video
    named = sum(bool(one.names) and not all(map(str.isdigit, one.names)) for drawn in sheet.drawn for one in drawn)
    losses.dropped("annotations.points.labels", "names of points are left out; skeletons are not written", count=named)

    def write_xml(draft: Path) -> None:
        with draft.open("w", encoding="utf-8", newline="\n") as file:
            write(sheet, file)

    return sheet.write(path, ".xml", "annotations.xml", _FOLDER, write_xml, images=images, overwrite=overwrite)


_Track = list[tuple[int, Drawn]]  # locations of frames, and shapes


def _tracks(sheet: Sheet) -> dict[tuple[Key, str | None, Kind, int], _Track]:
    """The shapes of each object, kind and part, in the order of frames."""
    found: dict[tuple[Key, str | None, Kind, int], _Track] = {}
    for k, drawn in enumerate(sheet.drawn):
        for one in drawn:
            assert one.track is not None  # noqa: S101 - written shapes have the ids of their annotations
            found.setdefault((key_of(one.track), one.label, one.kind, one.part), []).append((k, one))
    return found


def _write_head(sheet: Sheet, file: TextIO, mode: str, rows: Sequence[str]) -> None:
    """Write the head: a task with its classes and their attributes."""
    values: dict[str | None, dict[str, list[Any]]] = {}
    for drawn in sheet.drawn:
        for one in drawn:
            stated = values.setdefault(one.label, {})
            for name, value in one.attributes.items():
                if name not in _BUILT_IN:
                    stated.setdefault(name, []).append(value)
    details = sheet.spec().get("cvat")
    details = {one.get("name"): one for one in details if isinstance(one, Mapping)} if isinstance(details, list) else {}
    file.write('<?xml version="1.0" encoding="utf-8"?>\n<annotations>\n<version>1.1</version>\n<meta>\n<task>\n')
    numbers = [frame.number for frame in sheet.frames]
    file.write(f"<size>{len(numbers)}</size>\n<mode>{mode}</mode>\n")
    file.write(
        f"<start_frame>{min(numbers, default=0)}</start_frame>\n<stop_frame>{max(numbers, default=0)}</stop_frame>\n"
    )
    file.write("<z_order>True</z_order>\n<labels>\n")
    for label in sheet.labels() + ([""] if None in values else []):
        file.write(f"<label>\n<name>{escape(_text(label))}</name>\n")
        for key in ("color", "type"):
            if isinstance(text := details.get(label, {}).get(key), str) and text != "skeleton":
                file.write(f"<{key}>{escape(_text(text))}</{key}>\n")
        file.write("<attributes>\n")
        for name, found in {**values.get(label or None, {}), TRACK: [""]}.items():
            kind = _input_type(found)
            listed = (
                ("false", "true") if kind == "checkbox" else ("-1000000", "1000000", "1") if kind == "number" else ()
            )
            default = "false" if kind == "checkbox" else "0" if kind == "number" else ""
            file.write(
                f"<attribute>\n<name>{escape(_text(name))}</name>\n<mutable>{name != TRACK}</mutable>\n"
                f"<input_type>{kind}</input_type>\n<default_value>{default}</default_value>\n"
                f"<values>{escape(chr(10).join(listed))}</values>\n</attribute>\n"
            )
        file.write("</attributes>\n</label>\n")
    file.write("</labels>\n" + "".join(rows) + "</task>\n")


def _ours(sheet: Sheet, camera: Identifier | None) -> str:
    """Times of all frames, and the camera, which the format has no fields for."""
    times = " ".join(str(frame.timestamp_ns) for frame in sheet.frames)
    named = "" if camera is None else f"<camera>{escape(_text(id_text(camera)))}</camera>\n"
    return f"<sceneloom>\n{named}<timestamps_ns>{times}</timestamps_ns>\n</sceneloom>\n"


def _write_images(sheet: Sheet, file: TextIO) -> None:
    """Write CVAT for images: shapes image by image; what they belong to is an attribute."""
    _write_head(sheet, file, "annotation", ())
    file.write(_ours(sheet, None) + "</meta>\n")
    for frame, drawn in zip(sheet.frames, sheet.drawn, strict=True):
        size = {"width": frame.width, "height": frame.height} if frame.width and frame.height else {}
        file.write(_open_tag("image", {"id": frame.number, "name": frame.name, **size}) + "\n")
        unnamed = 0
        for one in drawn:
            is_unnamed = one.track == f"{frame.number}-{unnamed}"
            unnamed += is_unnamed
            file.write(_shape_text(one, {"label": one.label or "", "source": "manual"}, stated=not is_unnamed))
        file.write("</image>\n")
    file.write("</annotations>\n")


def _write_video(sheet: Sheet, file: TextIO) -> None:
    """Write CVAT for videos: tracks of shapes; a shape that is outside ends each stretch of frames."""
    first = sheet.frames[0] if sheet.frames else Frame(0)
    size = f"<original_size>\n<width>{first.width}</width>\n<height>{first.height}</height>\n</original_size>\n"
    numbers = [frame.number for frame in sheet.frames]
    steps = np.unique(np.diff(numbers))
    step = [f"<frame_filter>step={steps[0]}</frame_filter>\n"] if len(steps) == 1 and steps[0] > 1 else []
    _write_head(sheet, file, "interpolation", [*step, size])
    file.write(_ours(sheet, first.camera) + "</meta>\n")
    tracks = _tracks(sheet)
    stated = [group[0][1].track for group in tracks.values()]
    usable = (
        [one for one in stated if type(one) is int and one >= 0 and stated.count(one) == 1]
        if len(stated) < 5000
        else []
    )
    taken, free = set(usable), 0
    for group in tracks.values():
        kind = group[0][1].kind
        if kind in (Kind.MASK, Kind.TAG):
            what = f"a {kind} has no track in CVAT for videos; `--output-option task=images` keeps it"
            sheet.losses.dropped(f"annotations[{group[0][1].track}]", what, count=len(group))
            continue
        track, named = group[0][1].track, False
        if track not in taken:
            while free in taken:
                free += 1
            taken.add(free)
            track, named = free, True
        label = group[0][1].label
        file.write(_open_tag("track", {"id": track, "label": label or "", "source": "manual"}) + "\n")
        for number, (k, one) in enumerate(group):
            head = {"frame": numbers[k], "outside": 0, "keyframe": int(one.keyframe)}
            file.write(_shape_text(one, head, stated=named))
            ends = number + 1 == len(group) or group[number + 1][0] != k + 1
            if ends and k + 1 < len(numbers):
                head = {"frame": numbers[k + 1], "outside": 1, "keyframe": 1}
                file.write(_shape_text(one, head, stated=named))
        file.write("</track>\n")
    file.write("</annotations>\n")


def _shape_text(one: Drawn, head: Mapping[str, Any], *, stated: bool) -> str:
    """A shape as an element; `stated`: with the id of its object as an attribute."""
    flags = {"occluded": int(one.attributes.get("occluded") is True)}
    flags |= {
        name: one.attributes[name] for name in ("group_id", "z_order") if isinstance(one.attributes.get(name), int)
    }
    tag, values = {Kind.ROTATED: "box"}.get(one.kind, str(one.kind)), one.values
    if one.kind in (Kind.BOX, Kind.ROTATED):
        if one.kind is Kind.ROTATED:
            x, y, width, height = values[:4]
            values = np.array([x - width / 2, y - height / 2, width, height])
        edges = (values[0], values[1], values[0] + values[2], values[1] + values[3])
        where = {name: _plain(edge) for name, edge in zip(("xtl", "ytl", "xbr", "ybr"), edges, strict=True)}
        if one.kind is Kind.ROTATED:
            where["rotation"] = _plain(float(np.degrees(one.values[4]) % 360.0))
    elif one.kind is Kind.MASK:
        where = _mask_fields(values)
    elif one.kind is Kind.TAG:
        where, flags = {}, {name: flags[name] for name in ("group_id",) if name in flags}
    else:
        rows = values[values[:, 2] > 0] if one.kind is Kind.POINTS else values
        where = {"points": ";".join(f"{_plain(x)},{_plain(y)}" for x, y in rows[:, :2])}
    texts = {name: _stated(value) for name, value in one.attributes.items() if name not in _BUILT_IN}
    if stated and one.track is not None:
        texts[TRACK] = id_text(one.track)
    inner = "".join(
        f"<attribute name={quoteattr(_text(name))}>{escape(_text(text))}</attribute>\n" for name, text in texts.items()
    )
    return f"{_open_tag(tag, {**head, **flags, **where})}\n{inner}</{tag}>\n"


def _mask_fields(mask: Mask) -> dict[str, Any]:
    left, top, width, height = (int(one) for one in mask.box())
    columns, rows = mask.pixels()
    width, height = max(width, 1), max(height, 1)
    inner = Mask.of_pixels(width, height, rows - top, columns - left)  # row by row within the rectangle
    return {"rle": ", ".join(map(str, inner.runs)), "left": left, "top": top, "width": width, "height": height}


# tracklets of 3D tasks

_DIALECTS = ("cvat", "kitti")
_STATES = ("state", "occlusion", "occlusion_kf", "truncation", "amt_occlusion", "amt_border_l", "amt_border_r",
    "amt_occlusion_kf", "amt_border_kf")  # fmt: skip
_POSE = ("tx", "ty", "tz", "rx", "ry", "rz")
_AXES = {"cvat": ("h", "w", "l"), "kitti": ("l", "w", "h")}
"""Which member is the size along the box's x, y and z. Source: KITTI's readme for one; for the other what Datumaro, by
which CVAT writes the format, makes of a cuboid's `scale`."""

_ORDER = "xyz"  # of the three angles: Rx Ry Rz, that of three.js, with which CVAT draws; KITTI's files have rz only


def _dialect(name: str) -> str:
    check_choice("dialect", name, _DIALECTS)
    return name


def read_tracklets(
    path: Path, *, lenient: bool = False, rate_hz: float | str | None = None, dialect: str | None = None
) -> Scene:
    """Read a file of tracklets that is not in a drive of KITTI, or a folder with it and frame_list.txt.

    Args:
        rate_hz: sweeps per second.
        dialect: "cvat": the location is the middle of the box, and h, w and l are its sizes along x, y and z; "kitti":
            the location is the middle of its bottom, and l, w and h are these sizes; None for "cvat", with a warning.

    Raises:
        OptionError: there is no such dialect, or the rate is no number above 0.
        DataError: a part is missing or no number.
    """
    chosen, names = _dialect(dialect or "cvat"), list[str]()
    if path.is_dir():
        lines = read_settings(path / FRAME_LIST).decode("utf-8", "replace").splitlines()
        names = [line.partition(" ")[2].strip() for line in lines if line.strip()]
        path = path / TRACKLETS_FILE
    labels = Labels.of(path, "tracklets", lenient=lenient, rate_hz=rate_hz)
    if dialect is None:
        message = (
            "locations are taken as middles of boxes, h, w and l as sizes along x, y and z, as CVAT writes them; "
            "`--input-option dialect=kitti` for bottoms and l, w, h"
        )
        labels.ledger.note(WarningKind.ASSUMED, "tracklet-dialect", str(path), message)
    ours, items = list[int](), list[ET.Element]()
    with labels.ledger.telling():
        for element in _elements(path, "boost_serialization", depth=2):
            if element.tag == "timestamps_ns":
                words = (element.text or "").split()
                ours = (
                    [int(word) for word in words] if all(re.fullmatch(r"-?[0-9]{1,19}", one) for one in words) else []
                )
            elif element.tag == "item":
                items.append(element)
        found = []
        for k, item in enumerate(items):
            try:
                found += _of_tracklet(path, item, k, chosen)
            except DataError as error:
                labels.ledger.fault("tracklets", error)
        last = max([one.frame for one in found], default=-1)
        if last > 10_000_000:
            raise DataError(path, "", f"frame {last}; expected at most 10000000")
        for number in range(max(last + 1, len(ours), len(names))):
            time_ns = ours[number] if number < len(ours) else None
            name = names[number] if number < len(names) else ""
            labels.add_frame(Frame(number, name, 0, 0, time_ns, cloud=True))
        labels.drawn = found
        return labels.scene()


def _member(path: Path, item: ET.Element, name: str) -> float:
    return _checked(path, item, name, item.findtext(name))


def _of_tracklet(path: Path, item: ET.Element, k: int, dialect: str) -> list[Drawn]:
    label = (item.findtext("objectType") or "").strip()
    size = np.array([_member(path, item, name) for name in _AXES[dialect]])
    first = _member(path, item, "first_frame")
    if first != int(first) or first < 0:
        raise _fault(path, item, f"first_frame: {first:g}; expected a whole number of 0 or more")
    found = []
    for number, pose in enumerate(item.findall("poses/item")):
        values = np.array([_member(path, pose, name) for name in _POSE])
        rotation = rotation_from_cuboid_angles(values[3:], unit=AngleUnit.RADIANS, order=_ORDER)
        centre = values[:3] + (rotation @ (0.0, 0.0, size[2] / 2) if dialect == "kitti" else 0.0)
        row = np.concatenate([centre, size, quaternion_from_matrix(rotation)])
        one = Drawn(Kind.CUBOID, int(first) + number, row, label or None, k)
        for name in _STATES:
            if pose.find(name) is not None:
                state = _member(path, pose, name)
                one.attributes[name] = int(state) if state == int(state) else state
        for attribute in pose.findall("attributes/attribute"):
            name, text = attribute.findtext("name") or "", attribute.findtext("value") or ""
            if name == TRACK:
                one.track = text_id(text)
            else:
                one.attributes[name] = text == "true" if text in ("true", "false") else _number_or_text(text)
        found.append(one)
    stated = next((one.track for one in found if one.track != k), k)
    for one in found:
        one.track = stated
    return found


def _number_or_text(text: str) -> Any:
    if re.fullmatch(r"0|-?[1-9][0-9]{0,17}", text):
        return int(text)
    return float(text) if re.fullmatch(r"-?[0-9]+\.[0-9]+(e[+-]?[0-9]{1,3})?", text) else text


def write_tracklets(scene: Scene, path: Path, *, dialect: str = "cvat", overwrite: bool = False) -> LossReport:
    """Write cuboids as tracklets: one for each stretch of sweeps, in the frame that the scene's annotations are in.

    Args:
        dialect: as of `read_tracklets`.

    Raises:
        OptionError: there is no such dialect.
        OutputError: the file exists, or cannot be written.
    """
    axes = _AXES[_dialect(dialect)]
    losses = Losses(field_losses(scene, TRACKLETS.supports))
    sheet = Sheet.of(scene, losses, cameras=(), cuboids=True)
    items = []
    for group in _tracks(sheet).values():
        stretch: _Track = []
        for k, one in group:
            # a tracklet has one size
            if stretch and (
                k != stretch[-1][0] + 1 or np.abs(one.values[3:6] - stretch[-1][1].values[3:6]).max() > 1e-9
            ):
                items.append(_tracklet_text(stretch, axes))
                stretch = []
            stretch.append((k, one))
        items.append(_tracklet_text(stretch, axes))
    times = " ".join(str(frame.timestamp_ns) for frame in sheet.frames)
    with replacing(path, overwrite=overwrite) as draft:
        draft.write_text(
            '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
            '<boost_serialization signature="serialization::archive" version="9">\n'
            '<tracklets class_id="0" tracking_level="0" version="0">\n'
            f"<count>{len(items)}</count>\n<item_version>1</item_version>\n{''.join(items)}</tracklets>\n"
            f"<sceneloom>\n<timestamps_ns>{times}</timestamps_ns>\n</sceneloom>\n</boost_serialization>\n",
            encoding="utf-8", newline="\n",
        )  # fmt: skip
    return LossReport.of(losses)


def _tracklet_text(stretch: _Track, axes: Sequence[str]) -> str:
    first, one = stretch[0]
    sizes = "".join(f"<{name}>{float(one.values[3 + axes.index(name)])!r}</{name}>\n" for name in "hwl")
    poses = []
    for _, shape in stretch:
        rotation = matrix_from_quaternion(shape.values[6:])
        angles = cuboid_angles_from_rotation(rotation, unit=AngleUnit.RADIANS, order=_ORDER)
        centre = shape.values[:3] - (rotation @ (0.0, 0.0, shape.values[5] / 2) if axes[2] == "h" else 0.0)
        numbers = zip(_POSE, [*centre.tolist(), *angles.tolist()], strict=True)
        states = {"state": 2, "occlusion": -1, "occlusion_kf": 0, "truncation": -1, **dict.fromkeys(_STATES[4:], -1)}
        states |= {name: value for name, value in shape.attributes.items() if name in _STATES}
        texts = {name: _stated(value) for name, value in shape.attributes.items() if name not in _STATES}
        texts[TRACK] = id_text(shape.track) if shape.track is not None else ""
        inner = "".join(
            f"<attribute><name>{escape(_text(name))}</name><value>{escape(text)}</value></attribute>\n"
            for name, text in texts.items()
        )
        poses.append(
            "<item>\n" + "".join(f"<{name}>{value!r}</{name}>\n" for name, value in numbers)
            + "".join(f"<{name}>{value}</{name}>\n" for name, value in states.items())
            + f"<attributes>\n{inner}</attributes>\n</item>\n"
        )  # fmt: skip
    return (
        f"<item>\n<objectType>{escape(_text(one.label or ''))}</objectType>\n{sizes}"
        f"<first_frame>{first}</first_frame>\n<poses>\n<count>{len(poses)}</count>\n<item_version>2</item_version>\n"
        f"{''.join(poses)}</poses>\n<finished>1</finished>\n</item>\n"
    )
