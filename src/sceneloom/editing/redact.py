"""Regions of images hidden for good: from lists of boxes or annotations, blurred, pixelated or filled."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.editing.references import assumed, skipped, with_warnings, without, without_fields
from sceneloom.errors import OptionError
from sceneloom.scene.annotations import Box2DAnnotation, ShapeAnnotation
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import DataWarning


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
    paint = _FILLS.get(fill)
    if paint is None:
        raise OptionError(f"fill {fill!r}; expected one of {', '.join(_FILLS)}")
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
    if fill not in _FILLS:
        raise OptionError(f"fill {fill!r}; expected one of {', '.join(_FILLS)}")
    regions = regions_of(scene, hidings, margin=margin)
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


def regions_of(scene: Scene, hidings: tuple[Hiding, ...], *, margin: float) -> dict[Key, HiddenRegions]:
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
