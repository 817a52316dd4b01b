"""The redact job: hide regions of images for good, from lists of boxes or annotations; and such lists.

Detectors of faces and licence plates write lists as CSV with a header, or as JSON.
"""

import csv
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.editing.references import with_warnings, without, without_fields
from sceneloom.errors import DataError, OptionError, check_choice
from sceneloom.formats.base.files import open_file, read_bytes
from sceneloom.formats.base.images import PNG_START, encode_png
from sceneloom.formats.base.losses import Loss, LossReport, Support
from sceneloom.formats.base.registry import check_scene_output
from sceneloom.formats.video.writer import VideoWriter
from sceneloom.pipeline.editing import EditReport, edit_files
from sceneloom.scene.annotations import Box2DAnnotation, ShapeAnnotation
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, Key, Progress, key_of
from sceneloom.warnings import DataWarning, assumed, skipped


@dataclass(frozen=True, slots=True)
class ImageBox:
    """A box in one image of a list.

    Attributes:
        box_xyxy: left, top, right, bottom [px], in the corner convention: the image's corner is (0, 0).
        camera: the camera's id as a text; None for the only one.
        number: of the image among the camera's, from 0; None where it is given by time.
        timestamp_ns: of the image on the scene's clock [ns]; None where it is given by number.
        track: boxes of one camera and one track are one object, which is hidden in the images between them, too.
        label: what it is, or None.
    """

    box_xyxy: tuple[float, float, float, float]
    camera: str | None = None
    number: int | None = None
    timestamp_ns: int | None = None
    track: str | None = None
    label: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Hiding:
    """What is to be hidden in the images of one camera.

    Attributes:
        camera_id: whose images.
        boxes: (K, 4) float64 [px] left, top, right, bottom.
        images: (K,) int64, the number of the image of each.
        given: how many boxes were given, before those between them were interpolated.
        unmatched: how many of them name an image that does not exist.
    """

    camera_id: Identifier
    boxes: Float64Array
    images: Int64Array
    given: int
    unmatched: int


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """An object in the images of one camera."""

    times_ns: Int64Array  # (N,) [ns], ascending
    boxes: Float64Array  # (N, 4) [px] left, top, right, bottom
    always: bool = False  # whether it is there in all images

    def seen(self, times_ns: Int64Array, margin_ns: int) -> tuple[Int64Array, Float64Array]:
        """The images in which it is seen, (M,), and its boxes in them, (M, 4)."""
        first_ns, last_ns = int(self.times_ns[0]), int(self.times_ns[-1])
        near = (times_ns >= first_ns - margin_ns) & (times_ns <= last_ns + margin_ns)
        images = np.flatnonzero(near | self.always)
        # both counted from the track's first time, since float64 holds no nanoseconds of today
        at, known = (times_ns[images] - first_ns).astype(np.float64), (self.times_ns - first_ns).astype(np.float64)
        return images, np.stack([np.interp(at, known, self.boxes[:, side]) for side in range(4)], axis=1)


def find_hidings(
    scene: Scene, *, boxes: Sequence[ImageBox] = (), labels: Iterable[str] = (), hold: float = 0.0
) -> tuple[Hiding, ...]:
    """Find for each camera what is to be hidden in which of its images.

    Args:
        scene: whose images.
        boxes: a list; boxes of one track are interpolated in time.
        labels: those of the scene's own boxes and outlines in images that are to be hidden, too.
        hold: how much longer a track or an annotation is hidden before its first and after its last image [s].

    Raises:
        OptionError: a camera does not exist, or is not named where there are several; no annotation has a label.
    """
    if not 0.0 <= hold < float("inf"):
        raise OptionError(f"hold {hold} s; expected 0 or more")
    by_camera: dict[Key, list[ImageBox]] = {key_of(camera.id): [] for camera in scene.cameras}
    for box in boxes:
        by_camera[key_of(_camera_id(scene, box.camera))].append(box)
    drawn = _drawn(scene, tuple(labels))
    return tuple(
        _hiding(camera, by_camera[key_of(camera.id)], drawn.get(key_of(camera.id), []), round(hold * 1e9))
        for camera in scene.cameras
    )


def _camera_id(scene: Scene, stated: str | None) -> Identifier:
    ids = [camera.id for camera in scene.cameras]
    if stated is None and len(ids) == 1:
        return ids[0]
    match = next((one for one in ids if one == stated), next((one for one in ids if str(one) == stated), None))
    if match is None:
        known = ", ".join(repr(one) for one in ids) or "none"
        what = "a box names no camera" if stated is None else f"a box names camera {stated!r}"
        raise OptionError(f"{scene.source}: {what}; its cameras are {known}")
    return match


def _drawn(scene: Scene, labels: tuple[str, ...]) -> dict[Key, list[_Track]]:
    """The tracks of all annotations in images that have one of some labels, by camera."""
    known = [one for one in scene.annotations if isinstance(one, Box2DAnnotation | ShapeAnnotation)]
    flat = [one for one in known if isinstance(one, Box2DAnnotation) or one.dimensions == 2]
    there = {one.label for one in flat}
    if missing := [label for label in labels if label not in there]:
        raise OptionError(
            f"{scene.source}: no box or outline in an image with label {missing[0]!r}; "
            f"there are {', '.join(sorted(map(str, there))) or 'none'}"
        )
    tracks: dict[Key, list[_Track]] = {}
    for annotation in flat:
        if annotation.label in labels and annotation.sensor_id is not None:
            tracks.setdefault(key_of(annotation.sensor_id), []).append(_drawn_track(annotation))
    return tracks


def _drawn_track(annotation: Box2DAnnotation | ShapeAnnotation) -> _Track:
    times = annotation.path.timestamps_ns
    if isinstance(annotation, Box2DAnnotation):
        values = annotation.path.values
        boxes = np.concatenate([values[:, :2], values[:, :2] + values[:, 2:]], axis=1)
    else:
        outlines = annotation.path.vertices
        rows = [k for k, outline in enumerate(outlines) if len(outline)]
        bounds = [np.concatenate([outlines[k].min(axis=0), outlines[k].max(axis=0)]) for k in rows]
        times, boxes = times[rows], np.array(bounds, np.float64).reshape(-1, 4)
    # annotations may be stored in any order
    order = np.argsort(times, kind="stable")
    return _Track(times[order], boxes[order], bool(annotation.stationary))


def _hiding(camera: CameraSensor, listed: list[ImageBox], drawn: list[_Track], hold_ns: int) -> Hiding:
    times_ns = camera.images.timestamps_ns
    half_period_ns = int(np.median(np.diff(times_ns))) // 2 if len(times_ns) > 1 else 50_000_000
    parts: list[tuple[Int64Array, Float64Array]] = [(np.zeros(0, np.int64), np.zeros((0, 4)))]
    unmatched, tracks = 0, dict[str, dict[int, tuple[float, ...]]]()
    for box in listed:
        image = _image_of(box, times_ns, half_period_ns)
        if image is None:
            unmatched += 1
            continue
        track = None if box.track is None else tracks.setdefault(box.track, {})
        if track is None or int(times_ns[image]) in track:
            # a track that is in an image twice cannot be interpolated through both boxes
            parts.append((np.array([image]), np.array([box.box_xyxy], np.float64)))
        else:
            track[int(times_ns[image])] = box.box_xyxy
    listed_tracks = [
        _Track(np.array(sorted(track), np.int64), np.array([track[time] for time in sorted(track)], np.float64))
        for track in tracks.values()
    ]
    all_tracks = [track for track in (*drawn, *listed_tracks) if len(track.times_ns)]
    parts += [track.seen(times_ns, half_period_ns + hold_ns) for track in all_tracks]
    images, boxes = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    given = len(listed) + sum(len(track.times_ns) for track in drawn)
    return Hiding(camera.id, boxes, images.astype(np.int64), given, unmatched)


def _image_of(box: ImageBox, times_ns: Int64Array, tolerance_ns: int) -> int | None:
    if box.number is not None:
        return box.number if 0 <= box.number < len(times_ns) else None
    if box.timestamp_ns is None or not len(times_ns):
        return None
    nearest = int(np.abs(times_ns - box.timestamp_ns).argmin())
    return nearest if abs(int(times_ns[nearest]) - box.timestamp_ns) <= tolerance_ns else None


@dataclass(frozen=True, slots=True, eq=False)
class HiddenRegions:
    """What is hidden in each image of a camera.

    Attributes:
        pixels: by the number of the image, (K, 4) int64 left, top, right, bottom [px], right and bottom exclusive.
        outside: how many boxes lie outside of their images or have no size.
        cut: how many extend beyond an edge of their image.
    """

    pixels: dict[int, Int64Array]
    outside: int
    cut: int


def hidden_regions(hiding: Hiding, width: int, height: int, *, margin: float = 0.1) -> HiddenRegions:
    """Enlarge boxes, and find the pixels that they touch.

    Args:
        hiding: the boxes.
        width, height: of the images [px].
        margin: by what share of its width and height a box grows on each side.

    Raises:
        OptionError: the margin is negative or no number.
    """
    if not 0.0 <= margin < float("inf"):
        raise OptionError(f"margin {margin}; expected 0 or more")
    low, high = hiding.boxes[:, :2], hiding.boxes[:, 2:]
    size = (width, height)
    there = np.all((high > low) & (high > 0.0) & (low < size), axis=1)
    cut = there & np.any((low < 0.0) | (high > size), axis=1)
    wider = (high - low) * margin
    # even pixels, since colours of most videos are of two by two
    least = np.clip(2 * np.floor((low - wider) / 2), 0, size)
    most = np.clip(2 * np.ceil((high + wider) / 2), 0, size)
    corners = np.concatenate([least, most], axis=1).astype(np.int64)
    pixels = {int(image): corners[there & (hiding.images == image)] for image in np.unique(hiding.images[there])}
    return HiddenRegions(pixels, int((~there).sum()), int(cut.sum()))


_CELLS = 4  # a hidden box keeps at most so many mean values along its longer side, each way of a colour

_LEAST_CELL = 4  # no mean is of fewer pixels along a side, but at the box's last row and column [px]


def filled(image: UInt8Array, boxes: Int64Array, *, fill: str = "blur") -> UInt8Array:
    """Give a copy of an image whose boxes are hidden, one after the other.

    Args:
        image: (H, W) or (H, W, C) uint8.
        boxes: (K, 4) int64 [px], rows left, top, right, bottom of pixels, right and bottom exclusive, in the image.
        fill: "blur": the means of at most 4 x 4 cells, with smooth changes between them; "pixelate": the same with
            the cells' edges; "black": nothing at all.

    Raises:
        OptionError: there is no such fill.
    """
    check_choice("fill", fill, _FILLS)
    paint = _FILLS[fill]
    hidden = np.array(image, np.uint8)
    for left, top, right, bottom in boxes.tolist():
        region = hidden[top:bottom, left:right]
        if region.size:
            region[...] = paint(region)
    return hidden


def _blurred(region: UInt8Array) -> UInt8Array:
    means, rows, columns = _cell_means(region)
    weights = []
    for starts, length in ((rows, region.shape[0]), (columns, region.shape[1])):
        # how much of each cell's mean each pixel shows: linear between the middles of the cells
        middles = (starts + np.array([*starts[1:], length]) - 1) / 2.0
        weights.append(np.stack([np.interp(np.arange(length), middles, row) for row in np.eye(len(starts))], axis=1))
    smooth = np.einsum("ra,ab...,cb->rc...", weights[0], means, weights[1], optimize=True)
    return np.asarray(np.clip(np.rint(smooth), 0, 255), np.uint8)


def _pixelated(region: UInt8Array) -> UInt8Array:
    means, rows, columns = _cell_means(region)
    spread = np.repeat(np.rint(means).astype(np.uint8), np.diff([*rows, region.shape[0]]), axis=0)
    return np.repeat(spread, np.diff([*columns, region.shape[1]]), axis=1)


def _cell_means(region: UInt8Array) -> tuple[Float64Array, Int64Array, Int64Array]:
    """The mean of each square cell of a region, (rows, columns, ...), and where they begin in rows and columns [px]."""
    height, width = region.shape[:2]
    side = max(-(-max(height, width) // _CELLS), _LEAST_CELL)
    rows, columns = np.arange(0, height, side), np.arange(0, width, side)
    sums = np.add.reduceat(np.add.reduceat(region.astype(np.float64), rows, axis=0), columns, axis=1)
    counts = np.outer(np.diff([*rows, height]), np.diff([*columns, width]))
    return sums / counts.reshape(counts.shape + (1,) * (region.ndim - 2)), rows, columns


_FILLS: Mapping[str, Callable[[UInt8Array], UInt8Array]] = MappingProxyType(
    {"blur": _blurred, "pixelate": _pixelated, "black": np.zeros_like}
)  # the ways to hide, by name

_STARTS = (b"\xff\xd8\xff", b"\x89PNG\r\n", b"GIF8", b"II*\x00", b"MM\x00*", b"\x1a\x45\xdf\xa3")
"""How JPEG, PNG, GIF, TIFF and Matroska files begin."""

_LEAST_BYTES = 64  # no image of anything is shorter

_AS_TEXT = re.compile(r"^(data:(image|video)/|/9j/|iVBORw0KGgo|R0lGOD|UklGR)")
"""How such files begin in base64, or as a link that holds them."""


def _is_image(_name: str, value: Any, _location: str) -> bool:
    """Whether a field holds the bytes of an image or a video, plain or as text."""
    if isinstance(value, str):
        return len(value) >= _LEAST_BYTES and _AS_TEXT.match(value) is not None
    if isinstance(value, np.ndarray):
        if value.dtype != np.uint8 or value.ndim != 1:
            return value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] in {1, 3, 4}
        value = value[:_LEAST_BYTES].tobytes()
    if not isinstance(value, bytes | bytearray | memoryview):
        return False
    start = bytes(value[:_LEAST_BYTES])
    others = start[4:8] == b"ftyp" or (start[:4] == b"RIFF" and start[8:12] in {b"WEBP", b"AVI "})
    return len(start) >= _LEAST_BYTES and (start.startswith(_STARTS) or others)


def hide_in_images(
    scene: Scene, hidings: tuple[Hiding, ...], *, fill: str = "blur", margin: float = 0.1, drop_colours: bool = False
) -> Scene:
    """Give the scene with regions of its images hidden for good.

    Videos are left out where regions are hidden in their images, and so are the files that such images were decoded
    from: the scene's images hold what is to be written. Copies of images in extra fields are removed.

    Args:
        scene: the scene.
        hidings: what to hide, out of `find_hidings`.
        fill: "blur", "pixelate" or "black", see `filled`.
        margin: by what share of its width and height a box grows on each side.
        drop_colours: whether points lose the colours that cameras gave them.

    Raises:
        OptionError: there is no such fill, or nothing is hidden anywhere.
    """
    check_choice("fill", fill, _FILLS)
    regions = _regions_of(scene, hidings, margin=margin)
    if not any(one.pixels for one in regions.values()):
        given = sum(hiding.given for hiding in hidings)
        raise OptionError(
            f"{scene.source}: none of the {given} boxes lies in any image, so nothing would be hidden; expected "
            "numbers of images from 0 or times on the scene's clock, and pixels of the images"
        )
    embedded: list[str] = []

    def drop(name: str, value: Any, location: str) -> bool:
        found = _is_image(name, value, location)
        embedded.extend([location] * found)
        return found

    def hidden(sensor: Sensor) -> Sensor:
        if isinstance(sensor, CameraSensor):
            images, pixels = sensor.images.mapped(_without_embedded), regions[key_of(sensor.id)].pixels
            if not pixels:
                return replace(sensor, images=images)
            read = partial(_hidden_image, images, pixels, fill)
            return replace(sensor, images=LazyFrames(images.timestamps_ns, read), video=None)
        if drop_colours and isinstance(sensor, PointsSensor):
            return replace(sensor, colors=None)
        if drop_colours and isinstance(sensor, LidarSensor):
            return replace(sensor, frames=sensor.frames.mapped(_without_colours))
        return sensor

    cleaned = without_fields(scene, drop)
    out = [
        skipped("embedded-image", location, "a copy of an image in an extra field: left out") for location in embedded
    ]
    return with_warnings(
        replace(cleaned, sensors=tuple(map(hidden, cleaned.sensors))),
        [*out, *_reported(hidings, regions), *_coloured(scene, dropped=drop_colours)],
    )


def _regions_of(scene: Scene, hidings: tuple[Hiding, ...], *, margin: float) -> dict[Key, HiddenRegions]:
    """The pixels to hide in each camera's images, by the camera's id and its type."""
    cameras = {key_of(camera.id): camera.camera for camera in scene.cameras}
    keyed = ((key_of(hiding.camera_id), hiding) for hiding in hidings)
    return {
        key: hidden_regions(hiding, cameras[key].width, cameras[key].height, margin=margin) for key, hiding in keyed
    }


def _without_embedded(image: CameraImage) -> CameraImage:
    kept = without(image.extras, "", _is_image)
    return image if kept is image.extras else replace(image, extras=kept)


def _hidden_image(images: LazyFrames[CameraImage], pixels: Mapping[int, Int64Array], fill: str, k: int) -> CameraImage:
    image = images[k]
    if k not in pixels:
        return image
    return replace(image, decode=partial(_decoded, image, pixels[k], fill), encoded=None)


def _decoded(image: CameraImage, boxes: Int64Array, fill: str) -> UInt8Array:
    return filled(image.rgb, boxes, fill=fill)


def _without_colours(frame: LidarFrame) -> LidarFrame:
    return replace(frame, points=replace(frame.points, colors=None))


def _reported(hidings: tuple[Hiding, ...], regions: Mapping[Key, HiddenRegions]) -> list[DataWarning]:
    no_image = "boxes of images that do not exist: nothing hidden"
    outside = "boxes that lie outside of their images or have no size: nothing hidden"
    none = "a camera without boxes: its images stay as they are"
    reported: list[DataWarning] = []
    for hiding in hidings:
        location, found = f"sensors[{hiding.camera_id}].images", regions[key_of(hiding.camera_id)]
        reported.append(skipped("box-without-image", location, no_image, count=hiding.unmatched))
        reported.append(skipped("box-outside", location, outside, count=found.outside))
        reported.append(assumed("camera-without-boxes", location, none, count=int(not found.pixels)))
    return reported


def _coloured(scene: Scene, *, dropped: bool) -> list[DataWarning]:
    """Warn about lidars whose first sweep, and maps, that have colours."""
    what = "colours of points were left out"
    if not dropped:
        what = "colours of points came from images before anything was hidden, and stay; `--drop-colours` drops them"
    found = [lidar.id for lidar in scene.lidars if len(lidar.frames) and lidar.frames[0].points.colors is not None]
    maps = [s.id for s in scene.sensors if isinstance(s, PointsSensor) and s.colors is not None]
    return [assumed("colours-of-points", f"sensors[{one}].points.colors", what) for one in (*found, *maps)]


_PixelsByImage = Mapping[int, Int64Array]  # what is hidden in each image: (K, 4) left, top, right, bottom [px]


def _with_hidden_files(scene: Scene, hidden: Scene, pixels: Mapping[Key, _PixelsByImage]) -> Scene:
    """Give a scene with hidden locations the files of its images again."""
    before = {key_of(camera.id): camera.images for camera in scene.cameras}
    sensors: list[Any] = []
    for sensor in hidden.sensors:
        if isinstance(sensor, CameraSensor):
            key = key_of(sensor.id)
            read = partial(_with_file, before[key], sensor.images, pixels[key])
            sensor = replace(sensor, images=LazyFrames(sensor.images.timestamps_ns, read))  # noqa: PLW2901
        sensors.append(sensor)
    return replace(hidden, sensors=tuple(sensors))


def _with_file(
    before: LazyFrames[CameraImage], after: LazyFrames[CameraImage], pixels: _PixelsByImage, k: int
) -> CameraImage:
    """An image with hidden locations, and its file where that is not left to the writer."""
    old, image = before[k], after[k]
    if old.encoded is None:
        return image
    if k not in pixels:
        return replace(image, encoded=partial(_without_metadata, old))
    # a JPEG is made by the writer, which says so; PNG files stay what they are
    is_png = old.encoded().startswith(PNG_START)
    return replace(image, encoded=partial(_png_of, image)) if is_png else image


def _png_of(image: CameraImage) -> bytes:
    return encode_png(image.rgb)


def _without_metadata(image: CameraImage) -> bytes:
    """The image's file without what it says besides the image."""
    content = b"" if image.encoded is None else image.encoded()
    try:
        return _stripped(content)[0]
    except DataError:
        return _png_of(image)  # a file that cannot be taken apart is made anew from its pixels


_DEFAULT_FPS = 25.0


class _CameraBlur(msgspec.Struct, frozen=True, kw_only=True):
    """What was hidden in the images of one camera."""

    camera: Identifier
    boxes: int
    hidden: int
    images: int
    of_images: int
    without_image: int
    outside: int
    cut: int
    encoded: int | None = None  # images of its video, all of which are encoded again


class BlurReport(msgspec.Struct, frozen=True, kw_only=True):
    """What was done.

    Attributes:
        fill: what took the position of what was there.
        margin: by what share of its size each box grew on each side.
    """

    edit: EditReport
    fill: str
    margin: float
    cameras: tuple[_CameraBlur, ...]


def blur_files(
    source: str | Path, output: str | Path, *, boxes: Sequence[ImageBox] = (), labels: Iterable[str] = (),
    fill: str = "blur", margin: float = 0.1, hold: float = 0.0, drop_colours: bool = False,
    reading: Mapping[str, Any] | None = None, progress: Progress | None = None, overwrite: bool = False,
    **writing: Any,
) -> BlurReport:  # fmt: skip
    """Hide boxes in the images of a drive, and write it.

    Videos are encoded again, FFV1 as FFV1 and others as H.264, which the loss report lists; the images keep their
    times, and nothing else of the videos goes over. Of images in files of their own only touched ones are encoded
    anew; all lose what their files state besides the image.

    Args:
        source: a file or folder of any format.
        output: a file or a folder, by its suffix in any format that can be written.
        boxes: what to hide, from `read_image_boxes` or a detector.
        labels: those of the drive's own boxes and outlines in images that are to be hidden.
        fill, margin: see `hide_in_images`.
        hold: what a track or an annotation is hidden longer before its first and after its last image [s].
        drop_colours: whether points lose the colours that cameras gave them.
        progress: reported after each sweep and radar cycle that is written.
        writing: further options of the output's format.

    Raises:
        OptionError: a camera or label is not there, there is nothing to hide, or a value cannot be followed.
        OutputError: the output exists, or cannot be written.
        SceneloomError: the source is wrong.
    """
    chosen = tuple(labels)
    if not boxes and not chosen:
        raise OptionError(
            "nothing to hide; expected boxes in a CSV or JSON file (`--boxes FILE`) "
            "or labels of annotations (`--label NAME`)"
        )
    check_scene_output(Path(output), overwrite=overwrite)
    reported: list[_CameraBlur] = []
    losses: list[Loss] = []
    with TemporaryDirectory(dir=Path(output).parent, prefix=".sceneloom-blur-") as folder:

        def change(scenes: Sequence[Scene], _: Any) -> Scene:
            scene = scenes[0]
            hidings = find_hidings(scene, boxes=tuple(boxes), labels=chosen, hold=hold)
            regions = _regions_of(scene, hidings, margin=margin)
            bare = hide_in_images(scene, hidings, fill=fill, margin=margin, drop_colours=drop_colours)
            hidden = _with_hidden_files(scene, bare, {key: found.pixels for key, found in regions.items()})
            changed, encoded = _with_videos(scene, hidden, Path(folder), losses)
            counts = {key_of(camera.id): len(camera.images) for camera in scene.cameras}
            for hiding in hidings:
                key = key_of(hiding.camera_id)
                found = regions[key]
                reported.append(
                    _CameraBlur(
                        camera=hiding.camera_id,
                        boxes=hiding.given,
                        hidden=sum(map(len, found.pixels.values())),
                        images=len(found.pixels),
                        of_images=counts[key],
                        without_image=hiding.unmatched,
                        outside=found.outside,
                        cut=found.cut,
                        encoded=counts[key] if key in encoded else None,
                    )
                )
            return changed

        report = edit_files(
            "blur", [source], output, change, reading=reading, progress=progress, overwrite=overwrite, **writing
        )
    report = msgspec.structs.replace(report, losses=LossReport.of([*report.losses, *losses]))
    return BlurReport(edit=report, fill=fill, margin=margin, cameras=tuple(reported))


def _with_videos(scene: Scene, hidden: Scene, folder: Path, losses: list[Loss]) -> tuple[Scene, frozenset[Key]]:
    """Encode the images of videos again; of odd sizes, which H.264 cannot hold, they stay single images."""
    codecs = {key_of(camera.id): camera.video.codec for camera in scene.cameras if camera.video is not None}
    sensors: list[Sensor] = []
    encoded = set[Key]()
    for sensor in hidden.sensors:
        key = key_of(sensor.id)
        if not isinstance(sensor, CameraSensor) or key not in codecs or not len(sensor.images):
            sensors.append(sensor)
            continue
        codec = "ffv1" if codecs[key] == "ffv1" else "h264"
        size = sensor.images[0].camera
        if codec == "h264" and (size.width % 2 or size.height % 2):
            what = "its odd size is not that of an H.264 video: the images go one by one"
            losses.append(Loss(field=f"sensors[{sensor.id}].video", what=what, support=Support.CONVERTED))
            sensors.append(sensor)
            continue
        target, count = folder / f"video{len(encoded)}{'.mkv' if codec == 'ffv1' else '.mp4'}", len(sensor.images)
        seconds = (sensor.images.timestamps_ns - sensor.images.timestamps_ns[0]) * 1e-9
        fps = (count - 1) / seconds[-1] if seconds[-1] > 0 else _DEFAULT_FPS
        with VideoWriter(target, size.width, size.height, fps, codec=codec, images=count) as writer:
            for image, time in zip(sensor.images, seconds.tolist(), strict=True):
                writer.add(image.rgb, time)
        if codec == "h264":
            what, support = "the video is encoded again, as H.264 of quality 18", Support.APPROXIMATED
            losses.append(Loss(field=f"sensors[{sensor.id}].video", what=what, count=count, support=support))
        sensors.append(replace(sensor, video=VideoContent(partial(open_file, target), codec)))
        encoded.add(key)
    return replace(hidden, sensors=tuple(sensors)), frozenset(encoded)


_ALIASES: Mapping[str, str] = MappingProxyType(
    {
        alias: name
        for name, aliases in {
            "camera": "camera_id sensor sensor_id",
            "number": "frame picture image",
            "x1": "xmin left",
            "y1": "ymin top",
            "x2": "xmax right",
            "y2": "ymax bottom",
            "track": "id track_id",
            "label": "class type",
            "width": "w",
            "height": "h",
        }.items()
        for alias in aliases.split()
    }
)  # other words for the columns
_COLUMNS = "camera, number or time or timestamp_ns, x1, y1, x2, y2 (or left, top, width, height), track, label"
_MOST_SECONDS = 9_000_000_000
_MOST_DIGITS = 40  # what has more is no number or time of an image, and 1e99999999 would take hours to write out


def read_image_boxes(path: str | Path) -> tuple[ImageBox, ...]:
    """Read a list of boxes.

    A row names the camera's id (not needed where there is one camera), the image by its `number` from 0, its `time`
    [s] or its `timestamp_ns` on the scene's clock, and two corners [px], the image's own corner being (0, 0). Rows
    of one `track` are one object. JSON holds such rows as objects in a list, or in a list named `boxes`.

    Raises:
        DataError: the file is neither, or a row of it cannot be followed.
    """
    location = Path(path)
    if not location.is_file():
        raise DataError(location, "", "no such file; expected a list of boxes as CSV or JSON")
    try:
        text = read_bytes(location).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(location, f"byte {error.start}", "is no UTF-8; expected CSV or JSON") from error
    is_json = text.lstrip()[:1] in {"[", "{"}
    rows = _json_rows(location, text) if is_json else _csv_rows(location, text)
    return tuple(_Row(location, where, row).box() for where, row in rows)


def _json_rows(path: Path, text: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(path, "", f"is no JSON: {error}") from error
    rows = found.get("boxes") if isinstance(found, dict) else found
    if not isinstance(rows, list):
        raise DataError(path, "", "expected a list of boxes, or an object with such a list as `boxes`")
    for k, row in enumerate(rows):
        if not isinstance(row, dict):
            raise DataError(path, f"boxes[{k}]", f"{row!r:.40}; expected an object with {_COLUMNS}")
        yield f"boxes[{k}]", _named(row)


def _csv_rows(path: Path, text: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    try:
        columns = _named(dict.fromkeys(reader.fieldnames or ()))
        if not _says_corners(columns):
            raise DataError(path, "line 1", f"columns {', '.join(columns) or 'none'}; expected {_COLUMNS}")
        for row in reader:
            if None in row or None in row.values():
                raise DataError(path, f"line {reader.line_num}", "has more or fewer values than there are columns")
            yield f"line {reader.line_num}", _named(row)
    except csv.Error as error:
        raise DataError(path, f"line {reader.line_num}", f"is no CSV: {error}") from error


def _named(row: Mapping[str, Any]) -> dict[str, Any]:
    words = {str(name).strip().lower(): value for name, value in row.items()}
    return {_ALIASES.get(name, name): value for name, value in words.items()}


def _says_corners(row: Mapping[str, Any]) -> bool:
    return {"x1", "y1"} <= row.keys() and ({"x2", "y2"} <= row.keys() or {"width", "height"} <= row.keys())


@dataclass(frozen=True, slots=True)
class _Row:
    """A row of a list of boxes, and where it stands."""

    path: Path
    where: str
    values: Mapping[str, Any]

    def box(self) -> ImageBox:
        """The box."""
        values = self.values
        corners = values.get("box")
        if isinstance(corners, Sequence) and len(corners) == 4 and not isinstance(corners, str):
            named = dict(zip(("x1", "y1", "x2", "y2"), corners, strict=True))
            return replace(self, values={**{k: v for k, v in values.items() if k != "box"}, **named}).box()
        if not _says_corners(values):
            raise self._fault(f"has {', '.join(values)}; expected {_COLUMNS}")
        left, top = self._pixels("x1"), self._pixels("y1")
        if self._has("x2"):
            right, bottom = self._pixels("x2"), self._pixels("y2")
        else:
            right, bottom = left + self._pixels("width"), top + self._pixels("height")
        if not (left <= right and top <= bottom):
            raise self._fault(f"corners {left}, {top} and {right}, {bottom}; expected x1 <= x2 and y1 <= y2")
        number, timestamp_ns = self._moment()
        return ImageBox(
            (left, top, right, bottom),
            camera=self._text("camera"),
            number=number,
            timestamp_ns=timestamp_ns,
            track=self._text("track"),
            label=self._text("label"),
        )

    def _fault(self, problem: str) -> DataError:
        return DataError(self.path, self.where, problem)

    def _has(self, name: str) -> bool:
        return self.values.get(name) not in (None, "")  # a cell of JSON may be a list, which no set can have

    def _text(self, name: str) -> str | None:
        return str(self.values[name]).strip() if self._has(name) else None

    def _decimal(self, name: str) -> Decimal:
        stated = self.values.get(name)
        try:
            value = Decimal(str(stated).strip())
        except InvalidOperation as error:
            raise self._fault(f"{name}: {stated!r}; expected a number") from error
        if isinstance(stated, bool) or not value.is_finite() or value.adjusted() > _MOST_DIGITS:
            raise self._fault(f"{name}: {stated!r}; expected a finite number")
        return value

    def _pixels(self, name: str) -> float:
        value = self._decimal(name)
        if abs(value) > _MOST_SECONDS:
            raise self._fault(f"{name}: {self.values[name]!r}; expected pixels")
        return float(value)

    def _moment(self) -> tuple[int | None, int | None]:
        """The image's number, or else its time [ns]."""
        name = next((name for name in ("number", "time", "timestamp_ns") if self._has(name)), None)
        if name is None:
            raise self._fault("does not state which image; expected number, time or timestamp_ns")
        value, stated = self._decimal(name), self.values[name]
        if name == "time":
            if abs(value) > _MOST_SECONDS:
                raise self._fault(f"time: {stated!r}; expected seconds on the scene's clock")
            return None, int((value * 1_000_000_000).to_integral_value())
        if value != int(value):
            raise self._fault(f"{name}: {stated!r}; expected a whole number")
        if abs(value) > _MOST_SECONDS * 1_000_000_000:
            raise self._fault(f"{name}: {stated!r}; expected one that an image of the scene can have")
        return (int(value), None) if name == "number" else (None, int(value))


_JPEG_START = b"\xff\xd8\xff"
_KEPT_CHUNKS = frozenset(
    {b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"gAMA", b"cHRM", b"sRGB", b"iCCP", b"sBIT", b"bKGD", b"cICP"}
)
"""What a PNG file needs to show its image in its colours. Source: PNG, 3rd edition, 11.2 and 11.3."""

_APPLICATIONS, _COMMENT = range(0xE0, 0xF0), 0xFE
_SCAN, _STOP, _RESTARTS = 0xDA, 0xD9, range(0xD0, 0xD8)
_ADOBE, _PROFILE = 0xEE, 0xE2


def _stripped(content: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Give a JPEG or PNG file without anything that its pixels do not need, and what was left out ("APP1", "eXIf", …).

    Source: ITU-T T.81, annex B; PNG, 3rd edition, 5.3.
    """
    if content.startswith(PNG_START):
        parts = _png_parts(content)
    elif content.startswith(_JPEG_START):
        parts = _jpeg_parts(content)
    else:
        raise DataError("image", "", "is neither JPEG nor PNG, so what it says of itself cannot be left out")
    kept, left_out = [], []
    for part, called in parts:
        if called:
            left_out.append(called)
        else:
            kept.append(part)
    return b"".join(kept), tuple(left_out)


def _png_parts(content: bytes) -> Iterator[tuple[bytes, str]]:
    """The parts of a file, each with its name if it is to be left out."""
    yield PNG_START, ""
    position = len(PNG_START)
    while position < len(content):
        length = int.from_bytes(content[position : position + 4])
        kind = content[position + 4 : position + 8]
        stop = position + 12 + length
        if stop > len(content) or len(kind) < 4:
            raise DataError("image", f"byte {position}", "the file ends within a part of it")
        yield content[position:stop], "" if kind in _KEPT_CHUNKS else kind.decode("latin-1")
        position = stop
        if kind == b"IEND":
            break
    else:
        raise DataError("image", "", "the file has no end")
    if position < len(content):
        yield content[position:], "after the end"


def _jpeg_parts(content: bytes) -> Iterator[tuple[bytes, str]]:
    """The segments of a file, each with its name if it is to be left out."""
    yield content[:2], ""
    position = 2
    while True:
        while content[position : position + 2] == b"\xff\xff":
            position += 1
        if position + 2 > len(content):
            # broken off after the image's data: decoders show it
            return
        if content[position] != 0xFF:
            raise DataError("image", f"byte {position}", f"{content[position]:#04x}; expected a marker")
        marker = content[position + 1]
        if marker == _STOP:
            yield content[position : position + 2], ""
            break
        stop = position + 2 + int.from_bytes(content[position + 2 : position + 4])
        if stop > len(content) or stop < position + 4:
            raise DataError("image", f"byte {position}", "the file ends within a segment")
        yield content[position:stop], _segment_name(marker, content[position + 4 : stop])
        position = stop
        if marker == _SCAN:
            stop = _scan_end(content, position)
            yield content[position:stop], ""
            position = stop
    if position + 2 < len(content):
        yield content[position + 2 :], "after the end"


def _segment_name(marker: int, payload: bytes) -> str:
    """What a segment is called that an image's colours do not need; nothing for one that they do."""
    if marker == _COMMENT:
        return "COM"
    if marker not in _APPLICATIONS:
        return ""
    needed = (marker == _ADOBE and payload.startswith(b"Adobe")) or (
        marker == _PROFILE and payload.startswith(b"ICC_PROFILE")
    )
    # the plain head says the shape of pixels; with a small image in it, it is left out
    plain = marker == _APPLICATIONS[0] and payload.startswith(b"JFIF") and len(payload) == 14
    return "" if needed or plain else f"APP{marker - _APPLICATIONS[0]}"


def _scan_end(content: bytes, position: int) -> int:
    """Where the data of a scan end: at the next marker that is none of its own."""
    while True:
        position = content.find(b"\xff", position)
        if position < 0 or position + 1 >= len(content):
            return len(content)
        marker = content[position + 1]
        if marker != 0 and marker not in _RESTARTS and marker != 0xFF:
            return position
        position += 1 if marker == 0xFF else 2
