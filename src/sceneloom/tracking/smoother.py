"""Offline tracks: smoothed with later observations, over a whole drive.

Source: Rauch, Tung and Striebel 1965, "Maximum Likelihood Estimates of Linear Dynamic Systems".

Of each object that the tracker followed, reported or not:

- it is kept if it was likely enough at one moment, and then from its first box to its last one;
- its states are smoothed, so that they know what came later (`smoothing`);
- moments between its boxes are filled if they are few;
- its boxes in images are smoothed as they differ from its outlines.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.detections.projection import differences
from sceneloom.scene.detections import Support, Track, TrackedObjects, Tracks
from sceneloom.scene.types import Identifier
from sceneloom.tracking import tracker as states
from sceneloom.tracking.settings import ImageBox, TrackerSettings
from sceneloom.tracking.tracker import DEFAULTS, Observation, Tracker


def smoothed(
    means: Float64Array,
    covariances: Float64Array,
    predicted_means: Float64Array,
    predicted_covariances: Float64Array,
    slopes: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Smooth the states of one object: means (K, 11) and covariances (K, 11, 11), with the boxes up to each moment.

    The predicted ones are those before the boxes of each moment were read, the first of which are not looked at;
    slopes (K, 11, 11) are of each moment's prediction with respect to the moment before. A heading that was reversed on
    the way is taken as the last one says, all along.
    """
    later, spread = means.copy(), covariances.copy()
    for k in range(len(means) - 2, -1, -1):
        gain = np.linalg.solve(predicted_covariances[k + 1], slopes[k + 1] @ covariances[k]).T
        apart = later[k + 1] - predicted_means[k + 1]
        rotations = round(float(apart[states.YAW]) / np.pi)
        apart[states.YAW] -= rotations * np.pi
        later[k] = means[k] + gain @ apart
        later[k, states.YAW] = states.wrapped(later[k, states.YAW] + (rotations % 2) * np.pi)
        spread[k] = covariances[k] + gain @ (spread[k + 1] - predicted_covariances[k + 1]) @ gain.T
        spread[k] = (spread[k] + spread[k].T) / 2.0
    return later, spread


def smoothed_returns(
    measures: Float64Array, noises: Float64Array, known: BoolArray, usual: Float64Array, spreads: Float64Array,
    kept: Float64Array,
) -> Float64Array:  # fmt: skip
    """Smooth (K, 4) numbers that return to what is usual, each on its own.

    Measures and noises (variances) are looked at where `known` (K,). `usual` and `spreads` (variances), (K, 4), are
    what they are like where nothing else is known; `kept` (K,), how much of a difference is left of the moment before.
    """
    count = len(measures)
    means, variances, foreseen, doubts = (np.zeros_like(measures) for _ in range(4))
    mean, variance = usual[0], spreads[0]
    for k in range(count):
        mean, variance = usual[k] + kept[k] * (mean - usual[k]), spreads[k] + kept[k] ** 2 * (variance - spreads[k])
        foreseen[k], doubts[k] = mean, variance
        if known[k]:
            gain = variance / (variance + noises[k])
            mean, variance = mean + gain * (measures[k] - mean), variance * (1.0 - gain)
        means[k], variances[k] = mean, variance
    for k in range(count - 2, -1, -1):
        means[k] += kept[k + 1] * variances[k] / doubts[k + 1] * (means[k + 1] - foreseen[k + 1])
    return means


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """One object through the moments of a drive, from its first box to its last.

    Attributes:
        moments, timestamps_ns: (K,) int64, which moments of the drive, and their times [ns].
        means, covariances: (K, 11) and (K, 11, 11), smoothed.
        boxes: (K, 6, 6), covariances of middles and sizes of the last boxes.
        supports: (K,) uint8 of `Support`.
        likely: (K,), probability that it exists, by what came before.
        score: probability that its boxes are right.
        seen: by camera, (K, 4) float64 [px], boxes of its images.
    """

    id: int
    label: str
    vehicle: bool
    moments: Int64Array
    timestamps_ns: Int64Array
    means: Float64Array
    covariances: Float64Array
    boxes: Float64Array
    supports: UInt8Array
    likely: Float64Array
    score: float
    seen: dict[Identifier, Float64Array]

    def __len__(self) -> int:
        return len(self.moments)


def _course(number: int, moments: Sequence[states.Moment], locations: list[tuple[int, int]]) -> Course:
    while moments[locations[-1][0]].objects.supports[locations[-1][1]] == Support.PREDICTED:
        locations = locations[:-1]
    rows = [(moments[k].objects, row) for k, row in locations]
    means, covariances = _smoothed(number, moments, locations)
    objects, row = rows[-1]
    stated = [own.box_log_odds[k] for own, k in rows if own.supports[k] != Support.PREDICTED]
    cameras = dict.fromkeys(camera_id for objects, _ in rows for camera_id in objects.corners_xyxy)
    return Course(
        id=number,
        label=moments[locations[-1][0]].words[int(objects.votes[row].argmax())],
        vehicle=bool(objects.vehicles[row]),
        moments=np.array([k for k, _ in locations]),
        timestamps_ns=np.array([moments[k].observation.timestamp_ns for k, _ in locations]),
        means=means,
        covariances=covariances,
        boxes=np.array([objects.box_covariances[row] for objects, row in rows]),
        supports=np.array([objects.supports[row] for objects, row in rows]),
        likely=states.probabilities(np.array([objects.log_odds[row] for objects, row in rows])),
        score=float(states.probabilities(np.mean(stated))),
        seen={
            camera_id: np.array(
                [objects.corners_xyxy.get(camera_id, states.no_boxes(len(objects)))[row] for objects, row in rows]
            )
            for camera_id in cameras
        },
    )


def _smoothed(
    number: int, moments: Sequence[states.Moment], locations: list[tuple[int, int]]
) -> tuple[Float64Array, Float64Array]:
    """The states of an object, knowing what came later."""
    found = [(moments[k].objects.means[row], moments[k].objects.covariances[row]) for k, row in locations]
    spread = np.zeros((states.SIZE, states.SIZE))
    predicted = [(np.zeros(states.SIZE), spread, spread)]
    for k, _ in locations[1:]:
        before = moments[k].predicted
        row = int(np.searchsorted(before.ids, number))
        predicted.append((before.means[row], before.covariances[row], moments[k].slopes[row]))
    return smoothed(*(np.array(column) for column in (*zip(*found, strict=True), *zip(*predicted, strict=True))))


def _track(course: Course, moments: Sequence[states.Moment], settings: TrackerSettings) -> Track:
    kept = _filled(course, settings)
    corners = {
        camera_id: _corners(course, camera_id, moments, settings)[kept]
        for camera_id in dict.fromkeys(c for k in course.moments.tolist() for c in moments[k].observation.views)
    }
    supports = np.where(course.supports == Support.PREDICTED, Support.INTERPOLATED, course.supports)
    return Track(
        id=course.id,
        label=course.label,
        timestamps_ns=course.timestamps_ns[kept],
        centers=course.means[kept, :3] + np.array([moments[k].leap for k in course.moments[kept].tolist()]),
        sizes_lwh=course.means[kept, 3:6],
        yaws=course.means[kept, states.YAW],
        velocities=course.means[kept, 7:10],
        yaw_rates=course.means[kept, states.ROTATION],
        covariances=states.stated_covariances(
            course.covariances[kept], course.boxes[kept], np.full(len(kept), course.vehicle), settings
        ),
        scores=np.full(len(kept), course.score),
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
    course: Course, camera_id: Identifier, moments: Sequence[states.Moment], settings: TrackerSettings
) -> Float64Array:
    """Boxes of an object in the images of a camera, (K, 4)."""
    observations = [moments[k].observation for k in course.moments.tolist()]
    outlined, shown, vehicles = np.zeros((len(course), 4)), np.zeros(len(course)), np.full(len(course), course.vehicle)
    looked = np.array([camera_id in observation.views for observation in observations])
    for i in np.flatnonzero(looked).tolist():
        numbers, seen_by = course.means[i : i + 1, :7], observations[i]
        lines = states.outlines(numbers, np.ones(1), seen_by.world_from_lidar, seen_by.views[camera_id])
        outlined[i], shown[i] = lines.corners_xyxy[0], lines.shown_shares[0]
    differing = np.zeros((len(course), 4))
    if settings.image_box is ImageBox.IMAGE and camera_id in course.seen:
        seen = course.seen[camera_id]
        known = states.has_area(seen) & states.has_area(outlined)
        apart, noises = np.zeros((len(seen), 4)), np.ones((len(seen), 4))
        apart[known] = differences(seen[known], outlined[known])
        noises[known] = states.noises(seen[known], vehicles[known], settings)
        eyes = np.array([observation.world_from_lidar.translation for observation in observations])
        usual, spreads, _ = states.usual_differences(course.means, course.covariances, vehicles, eyes, settings)
        seconds = np.diff(course.timestamps_ns, prepend=course.timestamps_ns[:1]) / 1e9
        differing = smoothed_returns(apart, noises, known, usual, spreads, np.exp(-seconds / states.RETURN_TIME))
    corners = states.no_boxes(len(course))
    for i in np.flatnonzero(looked).tolist():
        camera, row = observations[i].views[camera_id].camera, slice(i, i + 1)
        corners[row] = states.applied(differing[row], outlined[row], camera.width, camera.height)
    corners[states.left_view(course.supports, shown)] = np.nan
    return corners


_COLUMNS = (*("centers", "sizes_lwh", "yaws", "velocities", "yaw_rates", "covariances", "scores", "supports"),)


def track_drive(
    observations: Iterable[Observation], *, settings: TrackerSettings = DEFAULTS, offline: bool = False
) -> Tracks:
    """Follow the objects of a drive.

    Args:
        observations: moment by moment, in the order of their times.
        offline: whether later moments may report earlier ones.
    """
    tracker = Tracker(settings)
    if offline:
        moments = [tracker.advance(observation) for observation in observations]
        locations: dict[int, list[tuple[int, int]]] = {}
        for k, moment in enumerate(moments):
            for row, number in enumerate(moment.objects.ids.tolist()):
                locations.setdefault(number, []).append((k, row))
        courses = [_course(number, moments, locations[number]) for number in sorted(locations)]
        kept = [course for course in courses if course.likely.max() >= settings.accept]
        return Tracks(tuple(_track(course, moments, settings) for course in kept))
    return gathered([tracker.step(observation) for observation in observations])


def gathered(moments: list[TrackedObjects]) -> Tracks:
    """Objects reported moment by moment as one track each; of several reports of one time the last counts."""
    latest = list({moment.timestamp_ns: moment for moment in moments}.values())
    latest.sort(key=lambda moment: moment.timestamp_ns)
    rows: dict[int, list[tuple[TrackedObjects, int]]] = {}
    for moment in latest:
        for row, number in enumerate(moment.ids.tolist()):
            rows.setdefault(number, []).append((moment, row))
    return Tracks(tuple(_drive_track(number, rows[number]) for number in sorted(rows)))


def _drive_track(number: int, reported: list[tuple[TrackedObjects, int]]) -> Track:
    columns: dict[str, Any] = {
        name: np.array([getattr(moment, name)[row] for moment, row in reported]) for name in _COLUMNS
    }
    cameras = dict.fromkeys(camera_id for moment, _ in reported for camera_id in moment.corners_xyxy)
    corners = {
        camera_id: np.array(
            [moment.corners_xyxy.get(camera_id, states.no_boxes(len(moment)))[row] for moment, row in reported]
        )
        for camera_id in cameras
    }
    return Track(
        id=number,
        label=reported[-1][0].labels[reported[-1][1]],
        timestamps_ns=np.array([moment.timestamp_ns for moment, _ in reported], np.int64),
        corners_xyxy=corners,
        **columns,
    )
