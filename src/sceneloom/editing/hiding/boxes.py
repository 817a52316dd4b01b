"""Which places of which pictures are to be hidden, out of lists of boxes and out of annotations."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of


@dataclass(frozen=True, slots=True)
class PictureBox:
    """A box in one picture of a list.

    Attributes:
        box_xyxy: left, top, right, bottom [px], in the corner convention: the picture's corner is (0, 0).
        camera: the camera's id as a text; None for the only one.
        number: of the picture among the camera's, from 0; None where the time says it.
        timestamp_ns: of the picture on the scene's clock [ns]; None where the number says it.
        track: boxes of one camera and one track are one thing, which is hidden in the pictures between them too.
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
    """What is to be hidden in the pictures of one camera.

    Attributes:
        camera_id: whose pictures.
        boxes: (K, 4) float64 [px] left, top, right, bottom.
        pictures: (K,) int64, the number of the picture of each.
        given: how many boxes were said, before those between them were found.
        unmatched: how many of them name a picture that is not there.
    """

    camera_id: Identifier
    boxes: Float64Array
    pictures: Int64Array
    given: int
    unmatched: int


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """A thing that is seen in one camera's pictures for some time.

    Attributes:
        times_ns: (N,) int64 [ns], ascending.
        boxes: (N, 4) float64 [px] left, top, right, bottom.
        always: whether it is there in all pictures.
    """

    times_ns: Int64Array
    boxes: Float64Array
    always: bool = False


def find_hidings(
    scene: Scene, *, boxes: Sequence[PictureBox] = (), labels: Iterable[str] = (), hold: float = 0.0
) -> tuple[Hiding, ...]:
    """Find for each camera what is to be hidden in which of its pictures.

    Args:
        scene: whose pictures.
        boxes: a list; boxes of one track are joined by straight lines in time.
        labels: those of the scene's own boxes and outlines in pictures that are to be hidden, too.
        hold: what a track or an annotation is hidden longer before its first and after its last picture [s].

    Raises:
        OptionError: a camera is not there, or not said where there are several; no annotation bears a label.
    """
    if not 0.0 <= hold < float("inf"):
        raise OptionError(f"hold {hold} s; expected 0 or more")
    by_camera: dict[Key, list[PictureBox]] = {key_of(camera.id): [] for camera in scene.cameras}
    for box in boxes:
        by_camera[key_of(_camera_id(scene, box.camera))].append(box)
    drawn = _drawn(scene, tuple(labels))
    found = []
    for camera in scene.cameras:
        key = key_of(camera.id)
        found.append(_hiding(camera, by_camera[key], drawn.get(key, []), round(hold * 1e9)))
    return tuple(found)


def _camera_id(scene: Scene, said: str | None) -> Identifier:
    ids = [camera.id for camera in scene.cameras]
    if said is None and len(ids) == 1:
        return ids[0]
    match = next((one for one in ids if one == said), next((one for one in ids if str(one) == said), None))
    if match is None:
        known = ", ".join(repr(one) for one in ids) or "none"
        what = "a box names no camera" if said is None else f"a box names camera {said!r}"
        raise OptionError(f"{scene.source}: {what}; its cameras are {known}")
    return match


def _drawn(scene: Scene, labels: tuple[str, ...]) -> dict[Key, list[_Way]]:
    """The ways of all annotations in pictures that bear one of some labels, by camera."""
    ways: dict[Key, list[_Way]] = {}
    known = [one for one in scene.annotations if isinstance(one, Box2DAnnotation | ShapeAnnotation)]
    flat = [one for one in known if isinstance(one, Box2DAnnotation) or one.dimensions == 2]
    there = {one.label for one in flat}
    for annotation in flat:
        if annotation.label in labels and annotation.sensor_id is not None:
            ways.setdefault(key_of(annotation.sensor_id), []).append(_way_of(annotation))
    missing = [label for label in labels if label not in there]
    if missing:
        raise OptionError(
            f"{scene.source}: no box or outline in a picture with label {missing[0]!r}; "
            f"there are {', '.join(sorted(map(str, there))) or 'none'}"
        )
    return ways


def _way_of(annotation: Box2DAnnotation | ShapeAnnotation) -> _Way:
    if isinstance(annotation, Box2DAnnotation):
        values = annotation.path.values
        corners = np.concatenate([values[:, :2], values[:, :2] + values[:, 2:]], axis=1)
        return _in_order(annotation.path.timestamps_ns, corners, bool(annotation.stationary))
    outlines = annotation.path.vertices
    rows = [k for k, outline in enumerate(outlines) if len(outline)]
    bounds = [np.concatenate([outlines[k].min(axis=0), outlines[k].max(axis=0)]) for k in rows]
    times = annotation.path.timestamps_ns[rows]
    return _in_order(times, np.array(bounds, np.float64).reshape(-1, 4), bool(annotation.stationary))


def _in_order(times_ns: Int64Array, boxes: Float64Array, always: bool) -> _Way:  # noqa: FBT001 - as of `_Way`
    """The way by rising times: annotations may be stored in any order."""
    order = np.argsort(times_ns, kind="stable")
    return _Way(times_ns[order], boxes[order], always)


def _hiding(camera: CameraSensor, listed: list[PictureBox], drawn: list[_Way], hold_ns: int) -> Hiding:
    times_ns = camera.pictures.timestamps_ns
    reach_ns = _half_period_ns(times_ns)
    parts: list[tuple[Int64Array, Float64Array]] = []
    unmatched, tracks = 0, dict[str, list[tuple[int, tuple[float, ...]]]]()
    for box in listed:
        picture = _picture_of(box, times_ns, reach_ns)
        if picture is None:
            unmatched += 1
            continue
        time_ns = int(times_ns[picture])
        track = [] if box.track is None else tracks.setdefault(box.track, [])
        if box.track is None or any(time_ns == known for known, _ in track):
            # a track that is in a picture twice has no way through both places
            parts.append((np.array([picture]), np.array([box.box_xyxy], np.float64)))
        else:
            track.append((time_ns, box.box_xyxy))
    ways = [*drawn, *(_track(rows) for rows in tracks.values())]
    parts += [_along(way, times_ns, reach_ns, hold_ns) for way in ways if len(way.times_ns)]
    pictures = np.concatenate([rows for rows, _ in parts] or [np.zeros(0, np.int64)]).astype(np.int64)
    boxes = np.concatenate([corners for _, corners in parts] or [np.zeros((0, 4))])
    given = len(listed) + sum(len(way.times_ns) for way in drawn)
    return Hiding(camera.id, boxes, pictures, given, unmatched)


def _half_period_ns(times_ns: Int64Array) -> int:
    """How far a time may be from that of its picture [ns]."""
    return int(np.median(np.diff(times_ns))) // 2 if len(times_ns) > 1 else 50_000_000


def _picture_of(box: PictureBox, times_ns: Int64Array, reach_ns: int) -> int | None:
    if box.number is not None:
        return box.number if 0 <= box.number < len(times_ns) else None
    if box.timestamp_ns is None or not len(times_ns):
        return None
    nearest = int(np.abs(times_ns - box.timestamp_ns).argmin())
    return nearest if abs(int(times_ns[nearest]) - box.timestamp_ns) <= reach_ns else None


def _track(rows: list[tuple[int, tuple[float, ...]]]) -> _Way:
    ordered = sorted(rows, key=lambda row: row[0])
    return _Way(
        np.array([time for time, _ in ordered], np.int64), np.array([box for _, box in ordered], np.float64)
    )


def _along(way: _Way, times_ns: Int64Array, reach_ns: int, hold_ns: int) -> tuple[Int64Array, Float64Array]:
    """The pictures in which a way is seen, (M,), and its boxes in them, (M, 4)."""
    first_ns, last_ns = int(way.times_ns[0]) - hold_ns - reach_ns, int(way.times_ns[-1]) + hold_ns + reach_ns
    seen = np.arange(len(times_ns))
    if not way.always:
        seen = np.flatnonzero((times_ns >= first_ns) & (times_ns <= last_ns))
    # both counted from the way's first time, since float64 holds no nanoseconds of today
    at = (times_ns[seen] - way.times_ns[0]).astype(np.float64)
    known = (way.times_ns - way.times_ns[0]).astype(np.float64)
    sides = [np.interp(at, known, way.boxes[:, side]) for side in range(4)]
    return seen, np.stack(sides, axis=1)
