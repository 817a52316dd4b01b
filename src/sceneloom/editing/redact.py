"""Regions of images hidden for good: from lists of boxes or annotations, blurred, pixelated or filled."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.editing.references import assumed, skipped, with_warnings
from sceneloom.errors import OptionError
from sceneloom.scene.annotations import Box2DAnnotation, ShapeAnnotation
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import DataWarning


@dataclass(frozen=True, slots=True)
class ImageBox:
    """A box in one image of a list.

    Attributes:
        box_xyxy: left, top, right, bottom [px], in the corner convention: the image's corner is (0, 0).
        camera: the camera's id as a text; None for the only one.
        number: of the image among the camera's, from 0; None where the time says it.
        timestamp_ns: of the image on the scene's clock [ns]; None where the number says it.
        track: boxes of one camera and one track are one thing, which is hidden in the images between them too.
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
        given: how many boxes were stated, before those between them were found.
        unmatched: how many of them name an image that is not there.
    """

    camera_id: Identifier
    boxes: Float64Array
    images: Int64Array
    given: int
    unmatched: int


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """A thing that is seen in one camera's images for some time.

    Attributes:
        times_ns: (N,) int64 [ns], ascending.
        boxes: (N, 4) float64 [px] left, top, right, bottom.
        always: whether it is there in all images.
    """

    times_ns: Int64Array
    boxes: Float64Array
    always: bool = False


def find_hidings(
    scene: Scene, *, boxes: Sequence[ImageBox] = (), labels: Iterable[str] = (), hold: float = 0.0
) -> tuple[Hiding, ...]:
    """Find for each camera what is to be hidden in which of its images.

    Args:
        scene: whose images.
        boxes: a list; boxes of one track are joined by straight lines in time.
        labels: those of the scene's own boxes and outlines in images that are to be hidden, too.
        hold: how much longer a track or an annotation is hidden before its first and after its last image [s].

    Raises:
        OptionError: a camera is not there, or not stated where there are several; no annotation bears a label.
    """
    if not 0.0 <= hold < float("inf"):
        raise OptionError(f"hold {hold} s; expected 0 or more")
    by_camera: dict[Key, list[ImageBox]] = {key_of(camera.id): [] for camera in scene.cameras}
    for box in boxes:
        by_camera[key_of(_camera_id(scene, box.camera))].append(box)
    drawn = _drawn(scene, tuple(labels))
    found = []
    for camera in scene.cameras:
        key = key_of(camera.id)
        found.append(_hiding(camera, by_camera[key], drawn.get(key, []), round(hold * 1e9)))
    return tuple(found)


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
    """The ways of all annotations in images that bear one of some labels, by camera."""
    trajectories: dict[Key, list[_Track]] = {}
    known = [one for one in scene.annotations if isinstance(one, Box2DAnnotation | ShapeAnnotation)]
    flat = [one for one in known if isinstance(one, Box2DAnnotation) or one.dimensions == 2]
    there = {one.label for one in flat}
    for annotation in flat:
        if annotation.label in labels and annotation.sensor_id is not None:
            trajectories.setdefault(key_of(annotation.sensor_id), []).append(_drawn_track(annotation))
    missing = [label for label in labels if label not in there]
    if missing:
        raise OptionError(
            f"{scene.source}: no box or outline in an image with label {missing[0]!r}; "
            f"there are {', '.join(sorted(map(str, there))) or 'none'}"
        )
    return trajectories


def _drawn_track(annotation: Box2DAnnotation | ShapeAnnotation) -> _Track:
    if isinstance(annotation, Box2DAnnotation):
        values = annotation.path.values
        corners = np.concatenate([values[:, :2], values[:, :2] + values[:, 2:]], axis=1)
        return _in_order(annotation.path.timestamps_ns, corners, bool(annotation.stationary))
    outlines = annotation.path.vertices
    rows = [k for k, outline in enumerate(outlines) if len(outline)]
    bounds = [np.concatenate([outlines[k].min(axis=0), outlines[k].max(axis=0)]) for k in rows]
    times = annotation.path.timestamps_ns[rows]
    return _in_order(times, np.array(bounds, np.float64).reshape(-1, 4), bool(annotation.stationary))


def _in_order(times_ns: Int64Array, boxes: Float64Array, always: bool) -> _Track:  # noqa: FBT001 - as of `_Track`
    """The trajectory by rising times: annotations may be stored in any order."""
    order = np.argsort(times_ns, kind="stable")
    return _Track(times_ns[order], boxes[order], always)


def _hiding(camera: CameraSensor, listed: list[ImageBox], drawn: list[_Track], hold_ns: int) -> Hiding:
    times_ns = camera.images.timestamps_ns
    reach_ns = _half_period_ns(times_ns)
    parts: list[tuple[Int64Array, Float64Array]] = []
    unmatched, tracks = 0, dict[str, list[tuple[int, tuple[float, ...]]]]()
    for box in listed:
        image = _image_of(box, times_ns, reach_ns)
        if image is None:
            unmatched += 1
            continue
        time_ns = int(times_ns[image])
        track = [] if box.track is None else tracks.setdefault(box.track, [])
        if box.track is None or any(time_ns == known for known, _ in track):
            # a track that is in an image twice has no way through both locations
            parts.append((np.array([image]), np.array([box.box_xyxy], np.float64)))
        else:
            track.append((time_ns, box.box_xyxy))
    all_tracks = [*drawn, *(_listed_track(rows) for rows in tracks.values())]
    parts += [_along(track, times_ns, reach_ns, hold_ns) for track in all_tracks if len(track.times_ns)]
    images = np.concatenate([rows for rows, _ in parts] or [np.zeros(0, np.int64)]).astype(np.int64)
    boxes = np.concatenate([corners for _, corners in parts] or [np.zeros((0, 4))])
    given = len(listed) + sum(len(trajectory.times_ns) for trajectory in drawn)
    return Hiding(camera.id, boxes, images, given, unmatched)


def _half_period_ns(times_ns: Int64Array) -> int:
    """How far a time may be from that of its image [ns]."""
    return int(np.median(np.diff(times_ns))) // 2 if len(times_ns) > 1 else 50_000_000


def _image_of(box: ImageBox, times_ns: Int64Array, reach_ns: int) -> int | None:
    if box.number is not None:
        return box.number if 0 <= box.number < len(times_ns) else None
    if box.timestamp_ns is None or not len(times_ns):
        return None
    nearest = int(np.abs(times_ns - box.timestamp_ns).argmin())
    return nearest if abs(int(times_ns[nearest]) - box.timestamp_ns) <= reach_ns else None


def _listed_track(rows: list[tuple[int, tuple[float, ...]]]) -> _Track:
    ordered = sorted(rows, key=lambda row: row[0])
    return _Track(np.array([time for time, _ in ordered], np.int64), np.array([box for _, box in ordered], np.float64))


def _along(trajectory: _Track, times_ns: Int64Array, reach_ns: int, hold_ns: int) -> tuple[Int64Array, Float64Array]:
    """The images in which a trajectory is seen, (M,), and its boxes in them, (M, 4)."""
    first_ns = int(trajectory.times_ns[0]) - hold_ns - reach_ns
    last_ns = int(trajectory.times_ns[-1]) + hold_ns + reach_ns
    seen = np.arange(len(times_ns))
    if not trajectory.always:
        seen = np.flatnonzero((times_ns >= first_ns) & (times_ns <= last_ns))
    # both counted from the trajectory's first time, since float64 holds no nanoseconds of today
    at = (times_ns[seen] - trajectory.times_ns[0]).astype(np.float64)
    known = (trajectory.times_ns - trajectory.times_ns[0]).astype(np.float64)
    sides = [np.interp(at, known, trajectory.boxes[:, side]) for side in range(4)]
    return seen, np.stack(sides, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class HiddenRegions:
    """What is hidden in each image of a camera.

    Attributes:
        pixels: by the number of the image, (K, 4) int64 left, top, right, bottom [px], right and bottom exclusive.
        outside: how many boxes lie outside of their images or have no size.
        cut: how many reach beyond an edge of theirs.
    """

    pixels: dict[int, Int64Array]
    outside: int
    cut: int


def hidden_regions(hiding: Hiding, width: int, height: int, *, margin: float = 0.1) -> HiddenRegions:
    """Widen boxes, and find the pixels that they touch.

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
    corners = _whole(low - wider, high + wider, size)
    pixels = {int(image): corners[there & (hiding.images == image)] for image in np.unique(hiding.images[there])}
    return HiddenRegions(pixels, int((~there).sum()), int(cut.sum()))


def _whole(low: Float64Array, high: Float64Array, size: tuple[int, int]) -> Int64Array:
    """The even pixels around boxes: colours of most videos stand for two by two."""
    least = np.clip(2 * np.floor(low / 2), 0, size)
    most = np.clip(2 * np.ceil(high / 2), 0, size)
    return np.concatenate([least, most], axis=1).astype(np.int64)


_CELLS = 4
"""A hidden box keeps at most so many mean values along its longer side, each way of a colour."""

_LEAST_CELL = 4
"""No mean is of fewer pixels along a side, but at the box's last row and column [px]."""


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
    rows, columns = _cells(region)
    means = _means(region, rows, columns)
    down, across = _weights(rows, region.shape[0]), _weights(columns, region.shape[1])
    smooth = np.einsum("ra,ab...,cb->rc...", down, means, across, optimize=True)
    return np.asarray(np.clip(np.rint(smooth), 0, 255), np.uint8)


def _pixelated(region: UInt8Array) -> UInt8Array:
    rows, columns = _cells(region)
    means = np.asarray(np.rint(_means(region, rows, columns)), np.uint8)
    height, width = region.shape[:2]
    spread = np.repeat(means, np.diff([*rows, height]), axis=0)
    return np.asarray(np.repeat(spread, np.diff([*columns, width]), axis=1), np.uint8)


def _blackened(region: UInt8Array) -> UInt8Array:
    return np.zeros_like(region)


_FILLS: Mapping[str, Callable[[UInt8Array], UInt8Array]] = MappingProxyType(
    {"blur": _blurred, "pixelate": _pixelated, "black": _blackened}
)
"""The ways to hide, by name."""


def _cells(region: UInt8Array) -> tuple[Int64Array, Int64Array]:
    """Where the square cells of a region begin, in rows and in columns [px]."""
    height, width = region.shape[:2]
    side = max(-(-max(height, width) // _CELLS), _LEAST_CELL)
    return np.arange(0, height, side), np.arange(0, width, side)


def _means(region: UInt8Array, rows: Int64Array, columns: Int64Array) -> Float64Array:
    """The mean of each cell, (rows, columns, ...)."""
    height, width = region.shape[:2]
    sums = np.add.reduceat(np.add.reduceat(region.astype(np.float64), rows, axis=0), columns, axis=1)
    counts = np.outer(np.diff([*rows, height]), np.diff([*columns, width]))
    means: Float64Array = sums / counts.reshape(counts.shape + (1,) * (region.ndim - 2))
    return means


def _weights(starts: Int64Array, length: int) -> Float64Array:
    """How much of each cell's mean each pixel shows, (length, cells): linear between the middles of the cells."""
    middles = (starts + np.array([*starts[1:], length]) - 1) / 2.0
    pixels = np.arange(length)
    return np.stack([np.interp(pixels, middles, row) for row in np.eye(len(starts))], axis=1)


_STARTS = (b"\xff\xd8\xff", b"\x89PNG\r\n", b"GIF8", b"II*\x00", b"MM\x00*", b"\x1a\x45\xdf\xa3")
"""How JPEG, PNG, GIF, TIFF and Matroska files begin."""

_LEAST_BYTES = 64
"""No image of anything is shorter."""

_AS_TEXT = re.compile(r"^(data:(image|video)/|/9j/|iVBORw0KGgo|R0lGOD|UklGR)")
"""How such files begin in base64, or as a link that holds them."""


@dataclass(slots=True)
class _EmbeddedImages:
    """Takes copies of images out of free fields, and keeps where they were.

    Attributes:
        locations: where.
    """

    locations: list[str] = field(default_factory=list)

    def scene(self, scene: Scene) -> Scene:
        """Give the scene without copies in the fields of itself, its sensors and its annotations."""
        sensors = [self._bare(sensor, f"sensors[{sensor.id}]") for sensor in scene.sensors]
        annotations = [self._bare(one, f"annotations[{one.id}]") for one in scene.annotations]
        return replace(
            scene,
            sensors=tuple(sensors),
            annotations=tuple(annotations),
            metadata=self.fields(scene.metadata, "metadata"),
            extras=self.fields(scene.extras, "extras"),
        )

    def _bare(self, part: Any, location: str) -> Any:
        """A sensor or an annotation without copies in its free fields."""
        extras = getattr(part, "extras", None)
        return replace(part, extras=self.fields(extras, location)) if extras else part

    def fields(self, fields: Mapping[str, Any], location: str) -> Mapping[str, Any]:
        """Give free fields without copies."""
        kept = self._without(fields, location)
        return fields if kept is fields else MappingProxyType(kept)

    def _without(self, value: Any, location: str) -> Any:
        """The value without what is an image in it; itself where nothing is."""
        if isinstance(value, Mapping):
            pairs = {key: self._without(one, f"{location}.{key}") for key, one in value.items()}
            changed = any(pairs[key] is not value[key] for key in value)
            return {key: one for key, one in pairs.items() if one is not _GONE} if changed else value
        if isinstance(value, list | tuple):
            items = [self._without(one, f"{location}[{k}]") for k, one in enumerate(value)]
            changed = any(new is not old for new, old in zip(items, value, strict=True))
            return [one for one in items if one is not _GONE] if changed else value
        if _looks_like_image(value):
            self.locations.append(location)
            return _GONE
        return value


_GONE = object()


def _looks_like_image(value: Any) -> bool:
    """Whether a value holds the bytes of an image or a video, plain or as text."""
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


def _images_without_embedded(camera: CameraSensor) -> CameraSensor:
    """Give a camera whose images have no copies in their free fields, read when they are."""
    images = camera.images
    return replace(camera, images=LazyFrames(images.timestamps_ns, partial(_image_without_embedded, images)))


def _image_without_embedded(images: LazyFrames[CameraImage], k: int) -> CameraImage:
    image = images[k]
    kept = _EmbeddedImages().fields(image.extras, "images[]")
    return image if kept is image.extras else replace(image, extras=kept)


_NO_BOXES = np.zeros((0, 4), np.int64)


def hide_in_images(
    scene: Scene,
    hidings: tuple[Hiding, ...],
    *,
    fill: str = "blur",
    margin: float = 0.1,
    drop_colours: bool = False,
) -> Scene:
    """Give the scene with locations in its images hidden for good.

    Videos are left out where locations are hidden in their images, and so are the files that such images were decoded
    from: the scene's images hold what is to be written. Copies of images in free fields are taken out.

    Args:
        scene: as it is.
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
    embedded = _EmbeddedImages()
    cleaned = embedded.scene(scene)
    sensors = tuple(
        _hidden_camera(_images_without_embedded(sensor), regions[key_of(sensor.id)], fill)
        if isinstance(sensor, CameraSensor)
        else _without_colours(sensor)
        if drop_colours and isinstance(sensor, LidarSensor | PointsSensor)
        else sensor
        for sensor in cleaned.sensors
    )
    out = [
        skipped("embedded-image", location, "a copy of an image in a free field: left out")
        for location in embedded.locations
    ]
    changed = replace(cleaned, sensors=sensors)
    return with_warnings(changed, [*out, *_reported(hidings, regions), *_coloured(scene, dropped=drop_colours)])


def regions_of(scene: Scene, hidings: tuple[Hiding, ...], *, margin: float) -> dict[Key, HiddenRegions]:
    """The pixels to hide in each camera's images, by the camera's id and its type."""
    cameras = {key_of(camera.id): camera.camera for camera in scene.cameras}
    keyed = ((key_of(hiding.camera_id), hiding) for hiding in hidings)
    return {
        key: hidden_regions(hiding, cameras[key].width, cameras[key].height, margin=margin) for key, hiding in keyed
    }


def _hidden_camera(camera: CameraSensor, regions: HiddenRegions, fill: str) -> CameraSensor:
    if not regions.pixels:
        return camera
    read = partial(_hidden_image, camera.images, regions.pixels, fill)
    return replace(camera, images=LazyFrames(camera.images.timestamps_ns, read), video=None)


def _hidden_image(images: LazyFrames[CameraImage], pixels: Mapping[int, Int64Array], fill: str, k: int) -> CameraImage:
    image, boxes = images[k], pixels.get(k, _NO_BOXES)
    if not len(boxes):
        return image
    return replace(image, decode=partial(_decoded, image, boxes, fill), encoded=None)


def _decoded(image: CameraImage, boxes: Int64Array, fill: str) -> UInt8Array:
    return filled(image.rgb, boxes, fill=fill)


def _without_colours(sensor: LidarSensor | PointsSensor) -> LidarSensor | PointsSensor:
    if isinstance(sensor, PointsSensor):
        return replace(sensor, colors=None)
    frames = sensor.frames
    return replace(sensor, frames=LazyFrames(frames.timestamps_ns, partial(_colourless_frame, frames)))


def _colourless_frame(frames: LazyFrames[LidarFrame], k: int) -> LidarFrame:
    frame = frames[k]
    return replace(frame, points=replace(frame.points, colors=None))


def _reported(hidings: tuple[Hiding, ...], regions: Mapping[Key, HiddenRegions]) -> list[DataWarning]:
    reported: list[DataWarning] = []
    for hiding in hidings:
        location, found = f"sensors[{hiding.camera_id}].images", regions[key_of(hiding.camera_id)]
        no_image = "boxes of images that are not there: nothing hidden"
        outside = "boxes that lie outside of their images or have no size: nothing hidden"
        reported.append(skipped("box-without-image", location, no_image, count=hiding.unmatched))
        reported.append(skipped("box-outside", location, outside, count=found.outside))
        none = "a camera without boxes: its images stay as they are"
        reported.append(assumed("camera-without-boxes", location, none, count=int(not found.pixels)))
    return reported


def _coloured_sensors(scene: Scene) -> tuple[Identifier, ...]:
    """The ids of lidars whose first sweep, and of maps, that have colours."""
    found = [lidar.id for lidar in scene.lidars if len(lidar.frames) and lidar.frames[0].points.colors is not None]
    maps = [s.id for s in scene.sensors if isinstance(s, PointsSensor) and s.colors is not None]
    return (*found, *maps)


def _coloured(scene: Scene, *, dropped: bool) -> list[DataWarning]:
    what = (
        "colours of points were left out"
        if dropped
        else "colours of points came from images before anything was hidden, and stay; `--drop-colours` drops them"
    )
    return [assumed("colours-of-points", f"sensors[{one}].points.colors", what) for one in _coloured_sensors(scene)]
