"""Label Studio: tasks of images and of videos with their regions, read and written.

Source: "Label Studio JSON format" and "Units of image annotations" of the documentation of Label Studio; the packing of
brushes is that of thi.ng/rle-pack.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.files import MOST_PIXELS
from sceneloom.formats.base.losses import Losses, LossReport, field_losses
from sceneloom.formats.base.output import FolderKind
from sceneloom.formats.labelling.drawn import (
    DEFAULT_RATE_HZ,
    MOST_FOLDERS,
    Drawn,
    Frame,
    Json,
    Kind,
    Labels,
    Mask,
    Sheet,
    corners_of,
    id_text,
    image_roots,
    text_id,
)
from sceneloom.formats.labelling.spec import LABEL_STUDIO, LABEL_STUDIO_FILES, file_in, is_label_studio
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of

_REGIONS = {
    "rectanglelabels": "rectanglelabels", "rectangle": "", "polygonlabels": "polygonlabels", "polygon": "",
    "keypointlabels": "keypointlabels", "keypoint": "", "brushlabels": "brushlabels", "brush": "",
    "videorectangle": "labels",
}  # fmt: skip
"""Types of regions, and where each has its classes."""

_STATED = ("choices", "textarea", "number", "rating", "labels")
"""Types of results that state something about the region of their id, or about the whole image."""

_POINT = re.compile(r"(.*):points:([0-9]{1,4})")
"""Ids that we write for the points of an object."""


def read_label_studio(path: Path, *, lenient: bool = False, rate_hz: float | str | None = None) -> Scene:
    """Read a file of tasks, or the tasks.json in a folder.

    Args:
        rate_hz: frames per second where nothing states times.

    Raises:
        OptionError: the rate is no number above 0.
        DataError: it is no such file.
    """
    files = [one for one in file_in(path, LABEL_STUDIO_FILES[0]) if is_label_studio(one)]
    if not files:
        raise DataError(path, "", "no list of tasks of Label Studio")
    labels = Labels.of(files[0], "label-studio", lenient=lenient, rate_hz=rate_hz)
    labels.roots = image_roots(files[0], "upload")
    with labels.ledger.telling():
        for k, task in enumerate(Json.read(files[0]).each()):
            try:
                _Task(task, k, labels).read()
            except DataError as error:
                labels.ledger.fault("tasks", error)
        return labels.scene()


def _image_name(stated: str) -> str:
    """The name of an image: what local storage has after `?d=`, a relative path, or the last part of an address."""
    if "?d=" in stated:
        return unquote(stated.partition("?d=")[2])
    if "://" in stated or stated.startswith("/"):
        return PurePosixPath(unquote(stated.partition("?")[0])).name
    return stated


class _Task:
    """One task: an image, or a video whose frames are images without files."""

    def __init__(self, task: Json, number: int, labels: Labels) -> None:
        self.task, self.number, self.labels = task, number, labels
        data = task["data"].members()
        texts = {name: value for name, value in data.items() if isinstance(value, str) and name != "sceneloom_camera"}
        chosen = texts.get("image") or texts.get("img") or texts.get("video") or next(iter(texts.values()), "")
        self.name = _image_name(chosen)
        stated = data.get("timestamp_ns")
        self.time_ns = stated if type(stated) is int else None
        times = data.get("timestamps_ns")
        self.times_ns = times if isinstance(times, list) and all(type(one) is int for one in times) else []
        camera = data.get("sceneloom_camera")
        self.camera = text_id(camera) if isinstance(camera, str) else None
        self.frame = -1
        self.video: dict[int, int] = {}  # locations of frames of a video, by their numbers from 0 on
        self.size = (0, 0)

    def read(self) -> None:
        annotations = [*self.task["annotations"].each(), *self.task["completions"].each()]
        if not annotations and self.task["predictions"].value:
            annotations = [*self.task["predictions"].each()]
        elif self.task["predictions"].value:
            where = self.task["predictions"].location
            self.labels.skipped("predictions", where, "predictions beside annotations are not read")
        kept = [one for one in annotations if one["was_cancelled"].value is not True]
        if len(kept) < len(annotations):
            count = len(annotations) - len(kept)
            self.labels.skipped("cancelled", self.task.location, "cancelled annotations are not read", count=count)
        for annotation in kept:
            for region in annotation["result"].each():
                if type(region["original_width"].value) is int and type(region["original_height"].value) is int:
                    self.size = region["original_width"].value, region["original_height"].value
        has_video = any(region["type"].value == "videorectangle" for one in kept for region in one["result"].each())
        if not has_video and not self.times_ns:
            number = self.task["data"].members().get("frame")
            frame = Frame(number if type(number) is int else self.number, self.name, *self.size, self.time_ns)
            self.frame = self.labels.add_frame(frame)
        for annotation in kept:
            self._of_annotation(annotation, several=len(kept) > 1)

    def _of_annotation(self, annotation: Json, *, several: bool) -> None:
        results = [*annotation["result"].each()]
        stated: dict[str, list[Json]] = {}
        for result in results:
            if result["type"].value in _STATED:
                stated.setdefault(result["id"].text(""), []).append(result)
        regions: dict[str, Json] = {}
        for result in results:
            if isinstance(result["type"].value, str) and result["type"].value in _REGIONS:
                regions[result["id"].text("")] = result
        points: dict[str, list[tuple[int, Json]]] = {}
        for result in results:
            kind = result["type"].text("")
            if kind in _STATED:
                if result["id"].value not in regions:
                    self._whole(result)
                continue
            if kind not in _REGIONS:
                message = f"results of the type {kind[:40]!r} are not read"
                self.labels.skipped("types-unknown", result.location, message)
                continue
            try:
                name = result["id"].text("")
                found = _POINT.fullmatch(name) if kind.startswith("keypoint") else None
                parent = result["parentID"].value
                if kind.startswith("keypoint") and (found or (isinstance(parent, str) and parent in regions)):
                    whole = found[1] if found else str(parent)
                    points.setdefault(whole, []).append(
                        (int(found[2]) if found else len(points.get(whole, [])), result)
                    )
                    continue
                self.labels.drawn += self._of_region(
                    result, kind, stated.get(name, []), annotation if several else None
                )
            except DataError as error:
                self.labels.ledger.fault("regions", error)
        for whole, listed in points.items():
            self._points(whole, listed, regions.get(whole), stated.get(whole, []))

    def _label(self, region: Json, kind: str, stated: list[Json]) -> str | None:
        listed = region["value"].members().get(_REGIONS[kind] or "labels")
        for other in stated:
            if other["type"].value == "labels" and not listed:
                listed = other["value"].members().get("labels")
        if isinstance(listed, list) and len(listed) > 1:
            self.labels.skipped("labels", region.location, "of several classes of a region the first is read")
        return str(listed[0]) if isinstance(listed, list) and listed else None

    def _attributes(self, one: Drawn, region: Json | None, stated: list[Json], annotation: Json | None) -> None:
        if region is not None:
            score = region["score"].value
            if isinstance(score, int | float) and not isinstance(score, bool):
                one.attributes["score"] = score
        if annotation is not None and isinstance(annotation["id"].value, int | str):
            one.attributes["annotation"] = annotation["id"].value
        for result in stated:
            if result["type"].value == "labels":
                continue
            value = _stated_value(result)
            if value is not None:
                one.attributes[result["from_name"].text("")] = value

    def _whole(self, result: Json) -> None:
        """What is stated about the whole image: its class, or a text."""
        if self.frame < 0:
            return
        value = _stated_value(result)
        if value is None:
            self.labels.skipped("types-unknown", result.location, "results that are no text or choice are not read")
            return
        name, one = result["from_name"].text(""), Drawn(Kind.TAG, self.frame, None)
        if result["type"].value == "choices" and isinstance(value, str):
            one.label = value
        else:
            one.attributes[name] = value
        if identifier := result["id"].text(""):
            one.track = text_id(identifier)
        self.labels.drawn.append(one)

    def _of_region(self, region: Json, kind: str, stated: list[Json], annotation: Json | None) -> list[Drawn]:
        label, value = self._label(region, kind, stated), region["value"]
        if kind == "videorectangle":
            found = [*self._sequence(value, label)]
        elif self.frame < 0:
            raise region.fault("a region of a video")
        else:
            found = [Drawn(*self._shape(value, kind), label)]
        identifier = region["id"].text("")
        for one in found:
            one.track = text_id(identifier) if identifier else None
            self._attributes(one, region, stated, annotation)
        return found

    def _shape(self, value: Json, kind: str) -> tuple[Kind, int, Any]:
        size = self._pixels()
        if kind.startswith("rectangle"):
            box = np.array([value[name].number() for name in ("x", "y", "width", "height")]) / 100 * np.tile(size, 2)
            return (*_turned(box, value["rotation"].number() if "rotation" in value else 0.0, self.frame),)
        if kind.startswith("polygon"):
            ring = np.array([one.numbers(2) for one in value["points"].each()]).reshape(-1, 2) / 100 * size
            if not len(ring):
                raise value["points"].fault("pairs of numbers")
            return (Kind.POLYLINE if value["closed"].value is False else Kind.POLYGON), self.frame, ring
        if kind.startswith("keypoint"):
            pixel = np.array([value["x"].number(), value["y"].number()]) / 100 * size
            return Kind.POINTS, self.frame, np.array([[*pixel, 2.0]])
        listed = value["rle"].value
        if not isinstance(listed, list) or not all(type(one) is int and 0 <= one < 256 for one in listed):
            raise value["rle"].fault("a list of bytes")
        width, height = self.size
        try:
            return Kind.MASK, self.frame, unpacked_brush(bytes(listed), height, width)
        except ValueError as error:
            raise DataError(value.path, value["rle"].location, str(error)) from error

    def _pixels(self) -> Float64Array:
        if not all(one > 0 for one in self.size):
            raise DataError(self.task.path, self.task.location, "no original_width and original_height of its regions")
        return np.array(self.size, np.float64)

    def _points(self, whole: str, listed: list[tuple[int, Json]], region: Json | None, stated: list[Json]) -> None:
        """Keypoints of an object."""
        rows, names, label = [], list[str](), None
        for _, point in sorted(listed, key=lambda pair: pair[0]):
            try:
                rows.append(self._shape(point["value"], "keypoint")[2][0])
            except DataError as error:
                self.labels.ledger.fault("regions", error)
                continue
            names.append(self._label(point, "keypointlabels", []) or str(len(names)))
            notes = point["meta"].members().get("text")
            if isinstance(notes, list) and notes and isinstance(notes[0], str):
                label = notes[0]
        if region is not None:
            label = self._label(region, region["type"].text(), stated)
        if rows:
            one = Drawn(Kind.POINTS, self.frame, np.array(rows), label, text_id(whole), names=tuple(names))
            self._attributes(one, None, stated, None)
            self.labels.drawn.append(one)

    def _sequence(self, value: Json, label: str | None) -> Iterator[Drawn]:
        """The key frames of a video's box: one that is not enabled ends a stretch; else the last one lasts."""
        count = int(value["framesCount"].number()) if "framesCount" in value else 0
        duration = value["duration"].number() if "duration" in value else 0.0
        rate = count / duration if count > 0 and duration > 0 else self.labels.rate_hz or DEFAULT_RATE_HZ
        rows = sorted(value["sequence"].each(), key=lambda row: row["frame"].whole())
        last = max([count - 1, *(row["frame"].whole() - 1 for row in rows)])
        segment = 0
        for k, row in enumerate(rows):
            number = row["frame"].whole() - 1
            if number < 0:
                raise row["frame"].fault("a number of 1 or more")
            box = np.array([row[name].number() for name in ("x", "y", "width", "height")]) / 100
            box *= np.tile(self._pixels(), 2)
            kind, frame, values = _turned(box, row["rotation"].number() if "rotation" in row else 0.0, number)
            one = Drawn(kind, self._video_frame(frame, last, rate), values, label, segment=segment)
            yield one
            enabled = row["enabled"].value is not False
            if enabled and k + 1 == len(rows) and last > number:
                yield Drawn(kind, self._video_frame(last, last, rate), values, label, segment=segment, keyframe=False)
            segment += not enabled

    def _video_frame(self, number: int, last: int, rate: float) -> int:
        """The location of a frame; with the first all are listed, so that what follows has its frames between."""
        if not self.video:
            if last > 1_000_000:
                raise DataError(self.task.path, self.task.location, f"{last + 1} frames; expected at most 1000001")
            camera = self.camera or (PurePosixPath(self.name).stem or "camera")
            for k in range(last + 1):
                time_ns = self.times_ns[k] if k < len(self.times_ns) else round(k * 1e9 / rate)
                self.video[k] = self.labels.add_frame(Frame(k, f"frame_{k:06d}.PNG", *self.size, time_ns, camera))
        if number not in self.video:
            raise DataError(self.task.path, self.task.location, f"frame {number + 1}; the video has {len(self.video)}")
        return self.video[number]


def _turned(box: Float64Array, degrees: float, frame: int) -> tuple[Kind, int, Float64Array]:
    """A box that was rotated about its top left corner, clockwise."""
    if not degrees % 360:
        return Kind.BOX, frame, box
    angle = np.radians(degrees)
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = box[2:] / 2
    centre = box[:2] + np.array([x * cosine - y * sine, x * sine + y * cosine])
    return Kind.ROTATED, frame, np.array([*centre, *box[2:], angle])


def _stated_value(result: Json) -> Any:
    value = result["value"].members()
    for name in ("choices", "text"):
        listed = value.get(name)
        if isinstance(listed, str):
            return listed
        if isinstance(listed, list) and listed and all(isinstance(one, str) for one in listed):
            if name == "choices" and listed in (["true"], ["false"]):
                return listed == ["true"]
            return ", ".join(listed) if name == "choices" else "\n".join(listed)
    number = value.get("number", value.get("rating"))
    return number if type(number) in (int, float) else None


# brushes


class _Bits:
    """Bits of bytes, the highest first."""

    def __init__(self, content: bytes) -> None:
        self.bits, self.location = np.unpackbits(np.frombuffer(content, np.uint8)), 0

    def take(self, count: int) -> int:
        stop = self.location + count
        if stop > len(self.bits):
            raise ValueError("the bytes of a brush end within a run")
        value = int("".join("1" if bit else "0" for bit in self.bits[self.location : stop].tolist()) or "0", 2)
        self.location = stop
        return value


def unpacked_brush(content: bytes, height: int, width: int) -> Mask:
    """Read a brush: what is not transparent of an image of four bytes a pixel, row by row.

    Raises:
        ValueError: the bytes are none of such an image.
    """
    if min(height, width) < 1 or height * width > MOST_PIXELS:
        raise ValueError(f"a brush of {width}x{height}; expected 1 to {MOST_PIXELS} pixels")
    bits = _Bits(content)
    count, word = bits.take(32), bits.take(5) + 1
    sizes = [bits.take(4) + 1 for _ in range(4)]
    if count != height * width * 4:
        raise ValueError(f"a brush of {count} values; expected {height * width * 4} of {width}x{height}")
    values: list[int] = []
    lengths: list[int] = []
    done = 0
    while done < count:
        is_run = bits.take(1)
        length = bits.take(sizes[bits.take(2)]) + 1
        length = min(length, count - done)
        if is_run:
            values.append(bits.take(word))
            lengths.append(length)
        else:
            values += [bits.take(word) for _ in range(length)]
            lengths += [1] * length
        done += length
    # the fourth byte of each pixel, found by the ends of the runs
    stops = np.cumsum(np.array(lengths, np.int64))
    opaque = np.array(values, np.int64)[np.searchsorted(stops, np.arange(3, count, 4), side="right")] > 0
    numbers = np.flatnonzero(opaque)
    return Mask.of_pixels(height, width, numbers % width, numbers // width)


_SIZES = (3, 4, 8, 16)  # bits of the lengths of runs, as Label Studio writes them


def packed_brush(mask: Mask) -> list[int]:
    """Write a brush: pixels of a mask are white and opaque, others 0."""
    columns, rows = mask.pixels()
    numbers = np.sort(rows * mask.width + columns)
    breaks = np.flatnonzero(np.diff(numbers) > 1)
    starts = numbers[np.concatenate([[0], breaks + 1])] if len(numbers) else numbers
    stops = numbers[np.concatenate([breaks, [len(numbers) - 1]])] + 1 if len(numbers) else numbers
    total = mask.height * mask.width
    edges = np.diff(np.concatenate([[0], np.stack([starts, stops], axis=1).reshape(-1), [total]])) * 4
    bits = [f"{total * 4:032b}", f"{7:05b}", *(f"{size - 1:04b}" for size in _SIZES)]
    for k, length in enumerate(edges.tolist()):
        for start in range(0, length, 1 << _SIZES[3]):
            part = min(length - start, 1 << _SIZES[3])
            which = next(k for k, size in enumerate(_SIZES) if part <= 1 << size)
            bits.append(f"1{which:02b}{part - 1:0{_SIZES[which]}b}{255 * (k % 2):08b}")
    text = "".join(bits)
    text += "0" * (-len(text) % 8)
    return [int(text[k : k + 8], 2) for k in range(0, len(text), 8)]


# writing

_FOLDER = FolderKind(
    "folder of Label Studio",
    ("tasks\\.json", *("/".join(["images", *[".*"] * depth]) for depth in range(1, MOST_FOLDERS + 1))),
    marker="tasks\\.json",
)
_PREFIX = "/data/local-files/?d=images/"  # where local storage serves files


def write_label_studio(
    scene: Scene,
    path: Path,
    *,
    images: str = "copy",
    task: str = "images",
    camera: str | None = None,
    prefix: str = _PREFIX,
    overwrite: bool = False,
) -> LossReport:
    """Write a file of tasks, or a folder with tasks.json and images where the path is no `.json`.

    Args:
        images: "copy" writes images into the folder, "none" their names only.
        task: "images": a task for each image; "video": one task, whose boxes are sequences of key frames.
        camera: whose images a video has; None for the only one.
        prefix: what comes before the names of images in `data`.

    Raises:
        OptionError: there is no such task, choice or camera, or a video of several cameras was asked for.
        OutputError: the output exists, or cannot be written.
    """
    if task not in ("images", "video"):
        raise OptionError(f"task {task!r}; expected images or video")
    losses = Losses(field_losses(scene, LABEL_STUDIO.supports))
    sheet = Sheet.of(scene, losses, cameras=None if camera is None else [text_id(camera)])
    names = {key_of(frame.camera): frame.camera for frame in sheet.frames if frame.camera is not None}
    if task == "video" and len(names) > 1:
        listed = ", ".join(map(repr, names.values()))
        raise OptionError(f"a video has one camera; choose one with `--output-option camera=ID`: {listed}")
    if task == "video":
        sheet = sheet.renamed(lambda number: f"frame_{number:06d}.PNG")
    tasks = _image_tasks(sheet, prefix) if task == "images" else [_video_task(sheet, prefix)]
    content = msgspec.json.encode(tasks)
    return sheet.write(
        path,
        ".json",
        "tasks.json",
        _FOLDER,
        lambda draft: _write_bytes(draft, content),
        images=images,
        overwrite=overwrite,
    )


def _write_bytes(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def _annotation(number: int, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{"id": number, "result": results, "was_cancelled": False, "ground_truth": False}]


def _image_tasks(sheet: Sheet, prefix: str) -> list[dict[str, Any]]:
    tasks = []
    for k, (frame, drawn) in enumerate(zip(sheet.frames, sheet.drawn, strict=True), 1):
        results: list[dict[str, Any]] = []
        taken: set[str] = set()
        shown = drawn if frame.width and frame.height else [one for one in drawn if one.kind is Kind.TAG]
        what = "left out: the size of the image is not known"
        sheet.losses.dropped("annotations", what, count=len(drawn) - len(shown))
        for one in shown:
            name = id_text(one.track) if one.track is not None else str(len(results))
            if name in taken and one.kind is not Kind.POINTS:
                what = "written under another id: a region is one shape"
                sheet.losses.converted(f"annotations[{one.track}].id", what)
            while name in taken and one.kind is not Kind.POINTS:
                name += "#"
            taken.add(name)
            results += _results(one, name, frame, sheet)
        data = {"image": f"{prefix}{frame.name}", "frame": frame.number, "timestamp_ns": frame.timestamp_ns}
        tasks.append({"id": k, "data": data, "annotations": _annotation(k, results), "predictions": []})
    return tasks


def _results(one: Drawn, name: str, frame: Frame, sheet: Sheet) -> Iterator[dict[str, Any]]:
    """A region, and what is stated about it."""
    size = np.array([frame.width, frame.height], np.float64)
    shared = {
        "to_name": "image", "image_rotation": 0, "original_width": frame.width, "original_height": frame.height,
    }  # fmt: skip
    stated = [] if one.label is None else [one.label]
    match one.kind:
        case Kind.BOX | Kind.ROTATED:
            yield {**_region("rectanglelabels", name, _rectangle(one, size), stated), **shared}
        case Kind.POLYGON | Kind.POLYLINE:
            value = {"points": (one.values / size * 100).tolist(), "closed": one.kind is Kind.POLYGON}
            yield {**_region("polygonlabels", name, value, stated), **shared}
        case Kind.MASK:
            yield {**_region("brushlabels", name, {"format": "rle", "rle": packed_brush(one.values)}, stated), **shared}
        case Kind.POINTS:
            hidden = int((one.values[:, 2] == 1).sum())
            what = "whether a point is hidden is left out"
            sheet.losses.dropped("annotations.points.projections.extras", what, count=hidden)
            for k, (x, y, visible) in enumerate(one.values.tolist()):
                if visible:
                    value = {"x": x / frame.width * 100, "y": y / frame.height * 100, "width": 0.25}
                    single = len(one.values) == 1 and not one.names
                    label = stated if single else [one.names[k] if k < len(one.names) else str(k)]
                    region = _region("keypointlabels", name if single else f"{name}:points:{k}", value, label)
                    note = {} if single else {"parentID": name, "meta": {"text": stated}}
                    yield {**region, **note, **shared}
        case _:
            value = {"choices": stated} if stated else {"text": [str(one.attributes.get("caption", ""))]}
            kind = "choices" if stated else "textarea"
            yield {"id": name, "from_name": kind, "to_name": "image", "type": kind, "value": value}
            return
    for attribute, value in one.attributes.items():
        field: dict[str, Any]
        if isinstance(value, bool):
            kind, field = "choices", {"choices": ["true" if value else "false"]}
        elif isinstance(value, int | float):
            kind, field = "number", {"number": value}
        else:
            kind, field = "textarea", {"text": [value]}
        yield {"id": name, "from_name": attribute, "to_name": "image", "type": kind, "value": field}


def _region(kind: str, name: str, value: Mapping[str, Any], stated: list[str]) -> dict[str, Any]:
    return {
        "id": name, "type": kind, "from_name": "label", "origin": "manual",
        "value": {**value, **({kind: stated} if stated else {})},
    }  # fmt: skip


def _rectangle(one: Drawn, size: Float64Array) -> dict[str, float]:
    """Shares of the image in hundredths; a rotated box by its corner that was the top left one."""
    rotated = one.kind is Kind.ROTATED
    corner = corners_of(one.values)[0] if rotated else one.values[:2]
    extent = one.values[2:4]
    numbers = np.concatenate([corner / size, extent / size]) * 100
    found = dict(zip(("x", "y", "width", "height"), numbers.tolist(), strict=True))
    return {**found, "rotation": float(np.degrees(one.values[4]) % 360) if rotated else 0.0}


def _video_task(sheet: Sheet, prefix: str) -> dict[str, Any]:
    """One task: the boxes of each object as a sequence of key frames."""
    sheet.report_kinds(*(kind for kind in Kind if kind not in (Kind.BOX, Kind.ROTATED)), what="a video has boxes only")
    count = len(sheet.frames)
    times = [frame.timestamp_ns or 0 for frame in sheet.frames]
    step = (times[-1] - times[0]) / max(count - 1, 1) / 1e9 if count else 0.0
    objects: dict[tuple[Key, str | None, int], list[tuple[int, Drawn]]] = {}
    for k, drawn in enumerate(sheet.drawn):
        for one in drawn:
            if one.kind in (Kind.BOX, Kind.ROTATED) and one.track is not None:
                objects.setdefault((key_of(one.track), one.label, one.part), []).append((k, one))
    first = sheet.frames[0] if sheet.frames else Frame(0)
    size = np.array([first.width, first.height], np.float64)
    results = []
    for number, found in enumerate(objects.values()):
        sequence = []
        for row, (k, one) in enumerate(found):
            ends = row + 1 == len(found) or found[row + 1][0] != k + 1
            if one.keyframe or ends:
                place = _rectangle(one, size)
                time_s = (times[k] - times[0]) / 1e9
                sequence.append({"frame": k + 1, "enabled": not ends, **place, "time": time_s})
        head = found[0][1]
        identifier: Identifier = head.track if head.track is not None else number
        lost = sum(bool(one.attributes) for _, one in found)
        sheet.losses.dropped("annotations.box_2d.attributes", "left out: a video's boxes have none", count=lost)
        results.append(
            {
                "id": id_text(identifier), "type": "videorectangle", "from_name": "box", "to_name": "video",
                "origin": "manual", "original_width": first.width, "original_height": first.height,
                "value": {
                    "framesCount": count, "duration": count * step, "sequence": sequence,
                    **({} if head.label is None else {"labels": [head.label]}),
                },
            }
        )  # fmt: skip
    named = {} if first.camera is None else {"sceneloom_camera": id_text(first.camera)}
    data = {"video": f"{prefix}video.mp4", "timestamps_ns": times, **named}
    return {"id": 1, "data": data, "annotations": _annotation(1, results), "predictions": []}
