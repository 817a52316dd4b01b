"""Rules about cameras: intrinsics, images, videos, and boxes and shapes in images."""

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, UInt8Array
from sceneloom.cameras.camera import MODELS
from sceneloom.checks.faults import as_read, warnings_of_code
from sceneloom.checks.rule import (
    ERROR,
    HINT,
    WARNING,
    FrameInHand,
    Hit,
    PartTable,
    Rule,
    Subject,
    annotation_parts,
    camera_rows,
    timestamps_of,
)
from sceneloom.errors import DataError
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor
from sceneloom.scene.types import Identifier, key_of

_SHORTEST, _LONGEST = 0.05, 30.0
"""Focal lengths outside these parts of the image's longer side [1] belong to no camera model: 30 sees two degrees."""

_MOST_UNEQUAL = 1.5  # pixels are square, or nearly so

_OWN_FOCAL_MEANING = frozenset({"ftheta", "cylindrical", "equirectangular"})
"""Models whose two focal lengths need not be alike, or stand for something else."""


def _cameras(subject: Subject) -> Iterator[tuple[str, CameraSensor | DepthCameraSensor]]:
    for path, sensor in subject.sensors():
        if isinstance(sensor, CameraSensor | DepthCameraSensor):
            yield path, sensor


def _unknown_models(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _cameras(subject):
        if sensor.camera.model not in MODELS:
            problem = f"{sensor.camera.model!r}; expected one of {', '.join(MODELS)}"
            yield Hit(f"{path}.intrinsics.distortion.model", problem)


def _centre_outside(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _cameras(subject):
        camera = sensor.camera
        for name, centre, length in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
            if not -0.5 <= centre <= length - 0.5:
                yield Hit(f"{path}.intrinsics.{name}", f"{centre:g}; expected a pixel of the image, which has {length}")


def _odd_focal_lengths(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _cameras(subject):
        camera = sensor.camera
        if camera.model in _OWN_FOCAL_MEANING:
            continue
        larger, smaller = max(camera.fx, camera.fy), min(camera.fx, camera.fy)
        size = max(camera.width, camera.height)
        if larger > _MOST_UNEQUAL * smaller:
            problem = f"fx {camera.fx:g}, fy {camera.fy:g}; expected nearly equal ones"
            yield Hit(f"{path}.intrinsics", problem)
        elif not _SHORTEST * size <= larger <= _LONGEST * size:
            problem = f"focal length {larger:g} px for images of {camera.width}x{camera.height}"
            yield Hit(f"{path}.intrinsics", problem)


def _video_counts(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Compare the images of a video with its timestamps, once for each video."""
    del subject
    sensor = frame.sensor
    if not isinstance(sensor, CameraSensor | DepthCameraSensor) or sensor.video is None or frame.number:
        return
    named = sensor.video.frame_indices
    try:
        count = _images_in(sensor.video.open)
    except DataError as error:
        yield Hit(f"{frame.sensor_path}.video.content", error.problem)
        return
    expected = len(timestamps_of(sensor))
    fits = count == expected if named is None else max(named, default=-1) < count
    if not fits:
        yield Hit(f"{frame.sensor_path}.video.timestamps", f"{expected} timestamps; the video has {count} images")


def _images_in(open_video: Callable[[], BinaryIO]) -> int:
    """Count the images of a video by its packets, without decoding them."""
    from sceneloom.formats.video.reader import read_index

    return len(read_index(open_video, "video"))


# fmt: off
CAMERA_RULES: tuple[Rule, ...] = (
    Rule("video-or-images", WARNING, "A camera has a video or images, not both.",
         "Leave one of them out; the video is taken, the images are carried along.",
         find=warnings_of_code("video-and-images")),
    Rule("camera-model-known", WARNING, "The distortion model of a camera is a known one.",
         "Use one of the known models; `sceneloom edit camera-model` fits one to another.", find=_unknown_models),
    Rule("distortion-length", HINT, "The distortion has as many numbers as its model.",
         "Write zeros for those that are missing, which is how they are read.",
         find=warnings_of_code("short-distortion"), fix=as_read),
    Rule("principal-point", WARNING, "The principal point lies inside the image.",
         "See whether the camera model was calibrated for another size, or the image cut without moving cx and cy.",
         find=_centre_outside),
    Rule("focal-length", WARNING, "Focal lengths are nearly equal, and those of a camera model that there is.",
         "Give focal lengths in pixels of these images, not in millimetres or of another size.",
         find=_odd_focal_lengths),
    Rule("video-count", ERROR, "A video has as many images as timestamps.",
         "Find out which images were lost, and give the others their own timestamps.", look=_video_counts),
)
# fmt: on

_STEP_PX = 8  # every eighth row and column reports whether an image is of one colour
_DARK = 10
_PLAIN = 4


@dataclass(slots=True)
class _CameraFacts:
    """The images of one camera so far."""

    path: str  # of the camera
    count: int = 0  # of the images that could be decoded
    other_sizes: list[tuple[int, int, int]] = field(default_factory=list)  # numbers, sizes the camera model is not for
    digest: int | None = None  # of the latest image
    repeated: list[int] = field(default_factory=list)  # numbers of images that are equal to the one before
    plain: list[tuple[int, str]] = field(default_factory=list)  # numbers of images of one colour, with that colour

    def add(self, number: int, image: CameraImage | None, sensor: CameraSensor) -> None:
        """Take in one more image; None for one that could not be decoded."""
        if image is None:
            self.digest = None
            return
        rgb, camera = image.rgb, sensor.camera
        self.count += 1
        height, width = rgb.shape[:2]
        if (width, height) != (camera.width, camera.height) and image.camera == camera.resized(width, height):
            self.other_sizes.append((number, width, height))
        digest = zlib.crc32(np.ascontiguousarray(rgb).data)
        if digest == self.digest:
            self.repeated.append(number)
        self.digest = digest
        colour = _one_colour(rgb)
        if colour is not None:
            self.plain.append((number, colour))


def _facts(subject: Subject) -> dict[tuple[type, Identifier], _CameraFacts]:
    return subject.table("facts of cameras", lambda _: {})


def _look(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Take an image in once for all rules; what all show is stated at the end."""
    latest, sensor = subject.table("the image in hand", lambda _: {"path": ""}), frame.sensor
    if latest["path"] != frame.path and isinstance(sensor, CameraSensor):
        latest["path"] = frame.path
        facts = _facts(subject).setdefault(key_of(sensor.id), _CameraFacts(frame.sensor_path))
        facts.add(frame.number, frame.frame if isinstance(frame.frame, CameraImage) else None, sensor)
    return iter(())


def _one_colour(rgb: UInt8Array) -> str | None:
    some = rgb[::_STEP_PX, ::_STEP_PX].reshape(-1, 3)
    if len(some) == 0:
        return None
    lowest, highest = some.min(axis=0), some.max(axis=0)
    if highest.max() < _DARK:
        return "black"
    return f"of one colour, {some[0].tolist()}" if (highest - lowest).max() < _PLAIN else None


def _sizes(subject: Subject) -> Iterator[Hit]:
    for facts in _facts(subject).values():
        if facts.other_sizes:
            number, width, height = facts.other_sizes[0]
            message = f"{width} x {height} px; `intrinsics` are for another size, and were scaled to this one"
            yield Hit(f"{facts.path}.images[{number}]", message, count=len(facts.other_sizes))


def _repeated(subject: Subject) -> Iterator[Hit]:
    for facts in _facts(subject).values():
        if facts.repeated:
            message = f"{len(facts.repeated)} of {facts.count} images are equal to the one before"
            yield Hit(f"{facts.path}.images[{facts.repeated[0]}]", message, count=len(facts.repeated))


def _plain(subject: Subject) -> Iterator[Hit]:
    for facts in _facts(subject).values():
        if facts.plain:
            number, colour = facts.plain[0]
            more = f", as are {len(facts.plain) - 1} more" if len(facts.plain) > 1 else ""
            yield Hit(f"{facts.path}.images[{number}]", f"{colour}{more}", count=len(facts.plain))


# fmt: off
IMAGE_RULES: tuple[Rule, ...] = (
    Rule("image-size", WARNING, "Images have the width and height that the camera's intrinsics are for.",
         "Write the intrinsics for the images as they are stored.", look=_look, conclude=_sizes),
    Rule("image-repeated", HINT, "No image is equal to the one before it.",
         "Look whether the camera hung, or images were filled in.", look=_look, conclude=_repeated),
    Rule("image-plain", HINT, "Images show more than one colour.",
         "Look whether the camera was covered or not exposed.", look=_look, conclude=_plain),
)
# fmt: on

_SLACK_PX = 1.0  # a box may end this far outside the image: some count pixels from 1, or to the last one's centre


def _boxes(subject: Subject) -> Iterator[tuple[PartTable, Float64Array, str]]:
    """All boxes in images, (R, 4) `left top width height` [px], each with its table and its name there."""

    def made(_: Subject) -> list[tuple[PartTable, Float64Array, str]]:
        paths = annotation_parts(subject, "boxes")
        return [
            (paths, paths.rows(lambda path: path.values, 4), ".values"),
            _projected(subject, "projections", "boxes", 4),
        ]

    yield from subject.table("boxes in images", made)


def _projected(subject: Subject, kind: str, name: str, columns: int) -> tuple[PartTable, Float64Array, str]:
    """What projections of a kind hold, (R, columns), with NaN where there is nothing."""

    def values(part: Any) -> Float64Array:
        stated: Float64Array | None = getattr(part, name)
        return np.full((len(part.timestamps_ns), columns), np.nan) if stated is None else stated

    parts = annotation_parts(subject, kind)
    return parts, parts.rows(values, columns), f".{name}"


def _box_hits(subject: Subject, judge: Callable[[Float64Array], BoolArray], expected: str) -> Iterator[Hit]:
    for table, boxes, name in _boxes(subject):
        bad = judge(boxes)

        def state(row: int, boxes: Float64Array = boxes) -> str:
            left, top, width, height = boxes[row].tolist()
            return f"{width:g} x {height:g} px at ({left:g}, {top:g}); expected {expected}"

        yield from table.hits(subject, bad, state, within=name)


def _null(boxes: Float64Array) -> BoolArray:
    return np.asarray(np.isnan(boxes).all(axis=1))


def _negative(subject: Subject) -> Iterator[Hit]:
    return _box_hits(subject, lambda boxes: np.asarray((boxes[:, 2:] < 0).any(axis=1)), "no negative width or height")


def _without_area(subject: Subject) -> Iterator[Hit]:
    def judge(boxes: Float64Array) -> BoolArray:
        return np.asarray((boxes[:, 2:] == 0).any(axis=1) & (boxes[:, 2:] >= 0).all(axis=1))

    return _box_hits(subject, judge, "a width and a height")


def _partly_finite(subject: Subject) -> Iterator[Hit]:
    for table, values, name in (*_boxes(subject), _projected(subject, "point_projections", "points", 2)):
        bad = ~np.isfinite(values).all(axis=1)
        if name != ".values":
            bad &= ~_null(values)

        def state(row: int, values: Float64Array = values) -> str:
            return f"{values[row].tolist()}; expected finite numbers"

        yield from table.hits(subject, np.asarray(bad), state, within=name)


def _null_confirmed(subject: Subject) -> Iterator[Hit]:
    for kind, name in (("projections", "boxes"), ("point_projections", "points")):
        table = annotation_parts(subject, kind)
        for number, part in enumerate(table.parts):
            values = getattr(part, name)
            if part.confirmed is None or values is None:
                continue
            rows = np.flatnonzero(_null(values) & np.array([flag is True for flag in part.confirmed], bool))
            if len(rows):
                location = f"{table.location(subject, number)}.confirmed[{rows[0]}]"
                yield Hit(location, f"true, yet {name}[{rows[0]}] is null", count=len(rows))


def _extents(subject: Subject) -> Iterator[tuple[PartTable, Float64Array, str]]:
    """What is drawn into images, as (R, 4) `left top right bottom` [px]; NaN where there is nothing to judge."""
    for table, boxes, name in _boxes(subject):
        corners = boxes.copy()
        corners[:, 2:] += boxes[:, :2]
        yield table, corners, name
    shapes = annotation_parts(subject, "shapes")
    if len(shapes.timestamps_ns):
        yield shapes, np.array([_around(v) for path in shapes.parts for v in path.vertices]), ".values"
    points, spots, name = _projected(subject, "point_projections", "points", 2)
    yield points, np.hstack([spots, spots]), name


def _around(vertices: Float64Array) -> list[float]:
    if vertices.shape[1] != 2 or len(vertices) == 0:
        return [np.nan] * 4
    return [*vertices.min(axis=0).tolist(), *vertices.max(axis=0).tolist()]


def _outside(subject: Subject, *, wholly: bool) -> Iterator[Hit]:
    for table, extents, name in _extents(subject):
        bad = np.zeros(len(extents), bool)
        sizes = np.zeros((len(extents), 2))
        for camera, rows in camera_rows(subject, table):
            sizes[rows] = camera.camera.width, camera.camera.height
            bad[rows] = True
        gone = ((extents[:, 2:] < -_SLACK_PX) | (extents[:, :2] > sizes + _SLACK_PX)).any(axis=1)
        beyond = ((extents[:, :2] < -_SLACK_PX) | (extents[:, 2:] > sizes + _SLACK_PX)).any(axis=1)
        bad &= gone if wholly else beyond & ~gone

        def state(row: int, extents: Float64Array = extents, sizes: Float64Array = sizes) -> str:
            left, top, right, bottom = extents[row].tolist()
            width, height = sizes[row].tolist()
            reach = f"from ({left:g}, {top:g}) to ({right:g}, {bottom:g})"
            return f"{reach}, of an image of {width:g} x {height:g} px"

        yield from table.hits(subject, bad, state, within=name)


# fmt: off
BOX_RULES: tuple[Rule, ...] = (
    Rule("box-not-finite", ERROR,
         "All numbers of a box in an image are finite; a projection that is not there is null as a whole.",
         "Write null for a box that is not there.", find=_partly_finite),
    Rule("box-negative-size", ERROR, "Width and height of a box in an image are not negative.",
         "Look whether the numbers are left, top, width, height, or two corners.", find=_negative),
    Rule("box-without-area", WARNING, "Boxes in images have a width and a height.",
         "Write null for a projection that is not there, and leave keyframes without a box out.", find=_without_area),
    Rule("box-outside-image", WARNING, "What is drawn into an image overlaps it.",
         "Look whether it counts pixels of an image of another size, or belongs to another camera.",
         find=partial(_outside, wholly=True)),
    Rule("box-beyond-image", HINT, f"What is drawn into an image ends at its edges, give or take {_SLACK_PX:g} px.",
         "Clip it to the image if it means what is seen, and keep it if it means the whole object.",
         find=partial(_outside, wholly=False)),
    Rule("null-box-confirmed", WARNING, "A projection that a person confirmed is there.",
         "Take the confirmation out, or draw what is missing.", find=_null_confirmed),
)
# fmt: on
