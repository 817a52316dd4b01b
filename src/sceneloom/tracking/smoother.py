"""Objects of a drive that is over: what later moments report earlier ones.

Of each object that the tracker followed, reported or not:

- it is kept if it was likely enough at one moment, and then from its first box to its last one;
- its states are smoothed, so that they know what came later (`smoothing`);
- moments between its boxes are filled if they are few;
- its boxes in images are smoothed as they differ from its outlines.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.scene.tracks import Support, Track, Tracks
from sceneloom.scene.types import Identifier
from sceneloom.tracking import existence, image_boxes, motion
from sceneloom.tracking.observation import Observation
from sceneloom.tracking.population import no_boxes
from sceneloom.tracking.settings import ImageBox, TrackerSettings
from sceneloom.tracking.smoothing import smoothed, smoothed_walk
from sceneloom.tracking.tracker import Moment


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """One object through the moments of a drive, from its first box to its last.

    Attributes:
        id: its number.
        label: what most boxes state.
        vehicle: whether it moves as vehicles do.
        moments: (K,) int64, which moments of the drive.
        timestamps_ns: (K,) int64.
        means, covariances: (K, 11) and (K, 11, 11), smoothed.
        supports: (K,) uint8 of `Support`.
        likely: (K,), probability that it exists, by what came before.
        seen: by camera, (K, 4) float64 [px], boxes of its images.
    """

    id: int
    label: str
    vehicle: bool
    moments: Int64Array
    timestamps_ns: Int64Array
    means: Float64Array
    covariances: Float64Array
    supports: UInt8Array
    likely: Float64Array
    seen: dict[Identifier, Float64Array]

    def __len__(self) -> int:
        return len(self.moments)


def look_back(moments: Sequence[Moment], settings: TrackerSettings) -> Tracks:
    """Give the objects of a drive by all its moments."""
    kept = [course for course in courses(moments) if course.likely.max() >= settings.accept]
    return Tracks(tuple(_track(course, moments, settings) for course in kept))


def courses(moments: Sequence[Moment]) -> list[Course]:
    """Give each object's trajectory through the drive, smoothed."""
    locations: dict[int, list[tuple[int, int]]] = {}
    for k, moment in enumerate(moments):
        for row, number in enumerate(moment.objects.ids.tolist()):
            locations.setdefault(number, []).append((k, row))
    return [_course(number, moments, locations[number]) for number in sorted(locations)]


def _course(number: int, moments: Sequence[Moment], locations: list[tuple[int, int]]) -> Course:
    while moments[locations[-1][0]].objects.supports[locations[-1][1]] == Support.PREDICTED:
        locations = locations[:-1]
    rows = [(moments[k].objects, row) for k, row in locations]
    means, covariances = _smoothed(number, moments, locations)
    objects, row = rows[-1]
    cameras = dict.fromkeys(camera_id for objects, _ in rows for camera_id in objects.corners_xyxy)
    return Course(
        id=number,
        label=moments[locations[-1][0]].words[int(objects.votes[row].argmax())],
        vehicle=bool(objects.vehicles[row]),
        moments=np.array([k for k, _ in locations]),
        timestamps_ns=np.array([moments[k].observation.timestamp_ns for k, _ in locations]),
        means=means,
        covariances=covariances,
        supports=np.array([objects.supports[row] for objects, row in rows]),
        likely=existence.probabilities(np.array([objects.log_odds[row] for objects, row in rows])),
        seen={
            camera_id: np.array([_row(objects.corners_xyxy.get(camera_id), row) for objects, row in rows])
            for camera_id in cameras
        },
    )


def _row(corners: Float64Array | None, row: int) -> Float64Array:
    boxes: Float64Array = no_boxes(1)[0] if corners is None else corners[row]
    return boxes


def _smoothed(
    number: int, moments: Sequence[Moment], locations: list[tuple[int, int]]
) -> tuple[Float64Array, Float64Array]:
    """The states of an object, knowing what came later."""
    states = [(moments[k].objects.means[row], moments[k].objects.covariances[row]) for k, row in locations]
    spread = np.zeros((motion.SIZE, motion.SIZE))
    predicted = [(np.zeros(motion.SIZE), spread, spread)]
    for k, _ in locations[1:]:
        before = moments[k].predicted
        row = int(np.searchsorted(before.ids, number))
        predicted.append((before.means[row], before.covariances[row], moments[k].slopes[row]))
    return smoothed(
        *(np.array(column) for column in (*zip(*states, strict=True), *zip(*predicted, strict=True)))
    )


def _track(course: Course, moments: Sequence[Moment], settings: TrackerSettings) -> Track:
    kept = _filled(course, settings)
    corners = {
        camera_id: _corners(course, camera_id, moments, settings)[kept]
        for camera_id in dict.fromkeys(
            c for k in course.moments.tolist() for c in moments[k].observation.views
        )
    }
    supports = np.where(course.supports == Support.PREDICTED, Support.INTERPOLATED, course.supports)
    return Track(
        id=course.id,
        label=course.label,
        timestamps_ns=course.timestamps_ns[kept],
        centers=course.means[kept, :3],
        sizes_lwh=course.means[kept, 3:6],
        yaws=course.means[kept, motion.YAW],
        velocities=course.means[kept, 7:10],
        yaw_rates=course.means[kept, motion.ROTATION],
        covariances=course.covariances[kept, :10, :10],
        scores=np.full(len(kept), course.likely.max()),
        supports=supports[kept].astype(np.uint8),
        corners_xyxy=corners,
    )


def _filled(course: Course, settings: TrackerSettings) -> Int64Array:
    """Which moments are reported: those with a box, and those of short gaps between them; of one time the last."""
    boxes = np.flatnonzero(course.supports != Support.PREDICTED)
    times = course.timestamps_ns[boxes]
    gaps = np.diff(times) <= settings.longest_fill * 1e9
    kept = np.zeros(len(course), np.bool_)
    kept[boxes] = True
    for short, start, stop in zip(gaps.tolist(), boxes[:-1].tolist(), boxes[1:].tolist(), strict=True):
        kept[start:stop] |= short
    kept[:-1] &= np.diff(course.timestamps_ns) > 0
    return np.flatnonzero(kept)


def _corners(
    course: Course, camera_id: Identifier, moments: Sequence[Moment], settings: TrackerSettings
) -> Float64Array:
    """Boxes of an object in the images of a camera, (K, 4)."""
    observations = [moments[k].observation for k in course.moments.tolist()]
    outlined = np.array(
        [_outline(mean, o, camera_id) for mean, o in zip(course.means, observations, strict=True)]
    )
    differing = np.zeros((len(course), 4))
    if settings.image_box is ImageBox.IMAGE and camera_id in course.seen:
        differing = _smoothed_differences(course, course.seen[camera_id], outlined)
    corners = no_boxes(len(course))
    for i, observation in enumerate(observations):
        if camera_id in observation.views:
            camera = observation.views[camera_id].camera
            row = slice(i, i + 1)
            corners[row] = image_boxes.applied(differing[row], outlined[row], camera.width, camera.height)
    return corners


def _outline(mean: Float64Array, observation: Observation, camera_id: Identifier) -> Float64Array:
    if camera_id not in observation.views:
        return np.zeros(4)
    lines = image_boxes.outlines(
        mean[None, :7], np.ones(1), observation.world_from_lidar, observation.views[camera_id]
    )
    outline: Float64Array = lines.corners_xyxy[0]
    return outline


def _smoothed_differences(course: Course, seen: Float64Array, outlined: Float64Array) -> Float64Array:
    known = image_boxes.has_area(seen) & image_boxes.has_area(outlined)
    apart, noises = np.zeros((len(seen), 4)), np.ones((len(seen), 4))
    apart[known] = image_boxes.differences(seen[known], outlined[known])
    noises[known] = image_boxes.noises(seen[known])
    seconds = np.diff(course.timestamps_ns, prepend=course.timestamps_ns[:1]) / 1e9
    drift = image_boxes.DRIFTS[0 if course.vehicle else 1] ** 2
    return smoothed_walk(apart, noises, known, drift * seconds, image_boxes.UNKNOWN)
