"""Which locations of which images are to be hidden, out of lists of boxes and out of annotations."""

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
class _SmoothedTrajectory:
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
        hold: what a track or an annotation is hidden longer before its first and after its last image [s].

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
    match = next(
        (one for one in ids if one == stated), next((one for one in ids if str(one) == stated), None)
    )
    if match is None:
        known = ", ".join(repr(one) for one in ids) or "none"
        what = "a box names no camera" if stated is None else f"a box names camera {stated!r}"
        raise OptionError(f"{scene.source}: {what}; its cameras are {known}")
    return match


def _drawn(scene: Scene, labels: tuple[str, ...]) -> dict[Key, list[_SmoothedTrajectory]]:
    """The ways of all annotations in images that bear one of some labels, by camera."""
    trajectories: dict[Key, list[_SmoothedTrajectory]] = {}
    known = [one for one in scene.annotations if isinstance(one, Box2DAnnotation | ShapeAnnotation)]
    flat = [one for one in known if isinstance(one, Box2DAnnotation) or one.dimensions == 2]
    there = {one.label for one in flat}
    for annotation in flat:
        if annotation.label in labels and annotation.sensor_id is not None:
            trajectories.setdefault(key_of(annotation.sensor_id), []).append(_trajectory_of(annotation))
    missing = [label for label in labels if label not in there]
    if missing:
        raise OptionError(
            f"{scene.source}: no box or outline in an image with label {missing[0]!r}; "
            f"there are {', '.join(sorted(map(str, there))) or 'none'}"
        )
    return trajectories


def _trajectory_of(annotation: Box2DAnnotation | ShapeAnnotation) -> _SmoothedTrajectory:
    if isinstance(annotation, Box2DAnnotation):
        values = annotation.path.values
        corners = np.concatenate([values[:, :2], values[:, :2] + values[:, 2:]], axis=1)
        return _in_order(annotation.path.timestamps_ns, corners, bool(annotation.stationary))
    outlines = annotation.path.vertices
    rows = [k for k, outline in enumerate(outlines) if len(outline)]
    bounds = [np.concatenate([outlines[k].min(axis=0), outlines[k].max(axis=0)]) for k in rows]
    times = annotation.path.timestamps_ns[rows]
    return _in_order(times, np.array(bounds, np.float64).reshape(-1, 4), bool(annotation.stationary))


def _in_order(times_ns: Int64Array, boxes: Float64Array, always: bool) -> _SmoothedTrajectory:  # noqa: FBT001 - as of `_SmoothedTrajectory`
    """The trajectory by rising times: annotations may be stored in any order."""
    order = np.argsort(times_ns, kind="stable")
    return _SmoothedTrajectory(times_ns[order], boxes[order], always)


def _hiding(
    camera: CameraSensor, listed: list[ImageBox], drawn: list[_SmoothedTrajectory], hold_ns: int
) -> Hiding:
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
    trajectories = [*drawn, *(_track(rows) for rows in tracks.values())]
    parts += [
        _along(trajectory, times_ns, reach_ns, hold_ns)
        for trajectory in trajectories
        if len(trajectory.times_ns)
    ]
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


def _track(rows: list[tuple[int, tuple[float, ...]]]) -> _SmoothedTrajectory:
    ordered = sorted(rows, key=lambda row: row[0])
    return _SmoothedTrajectory(
        np.array([time for time, _ in ordered], np.int64), np.array([box for _, box in ordered], np.float64)
    )


def _along(
    trajectory: _SmoothedTrajectory, times_ns: Int64Array, reach_ns: int, hold_ns: int
) -> tuple[Int64Array, Float64Array]:
    """The images in which a trajectory is seen, (M,), and its boxes in them, (M, 4)."""
    first_ns, last_ns = (
        int(trajectory.times_ns[0]) - hold_ns - reach_ns,
        int(trajectory.times_ns[-1]) + hold_ns + reach_ns,
    )
    seen = np.arange(len(times_ns))
    if not trajectory.always:
        seen = np.flatnonzero((times_ns >= first_ns) & (times_ns <= last_ns))
    # both counted from the trajectory's first time, since float64 holds no nanoseconds of today
    at = (times_ns[seen] - trajectory.times_ns[0]).astype(np.float64)
    known = (trajectory.times_ns - trajectory.times_ns[0]).astype(np.float64)
    sides = [np.interp(at, known, trajectory.boxes[:, side]) for side in range(4)]
    return seen, np.stack(sides, axis=1)
