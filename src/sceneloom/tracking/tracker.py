"""The tracker: objects from moment to moment, as the boxes come in."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.detections.assignment import assign_pairs
from sceneloom.scene.tracks import Support, TrackedObjects
from sceneloom.tracking import existence, image_boxes, motion, track_initiations
from sceneloom.tracking.association import candidates
from sceneloom.tracking.headings import rotation_round
from sceneloom.tracking.image_boxes import has_area
from sceneloom.tracking.observation import Observation
from sceneloom.tracking.observations import SUREST, Observations, visibility
from sceneloom.tracking.population import ByCamera, Population, no_boxes
from sceneloom.tracking.settings import ImageBox, TrackerSettings

DEFAULTS = TrackerSettings()


class Moment(NamedTuple):
    """What a tracker knows at one moment, of objects that it reports and of others.

    Attributes:
        observation: what was seen.
        objects: all that may be there.
        predicted: those of the moment before, before the boxes of this one were read.
        slopes: (N, 11, 11), of their states with respect to those of the moment before.
        outlined: by camera, (N, 4) float64 [px], outlines of the boxes of `objects` in its image, zeros where none.
        words: the labels that the columns of `objects.votes` stand for.
    """

    observation: Observation
    objects: Population
    predicted: Population
    slopes: Float64Array
    outlined: ByCamera
    words: Sequence[str]


class Tracker:
    """Follows objects online.

    Each step takes the next moment. If time goes back, or leaps by more than the longest gap, all objects are
    forgotten; none gets a number that was given before.
    """

    def __init__(self, settings: TrackerSettings = DEFAULTS) -> None:
        self.settings = settings
        self._objects = Population.empty()
        self._time_ns: int | None = None
        self._next_id = 1
        self._words: list[str] = []

    def step(self, observation: Observation) -> TrackedObjects:
        """Take the boxes of the next moment, and report the objects that are there."""
        return reported(self.advance(observation), self.settings)

    def advance(self, observation: Observation) -> Moment:
        """Take the boxes of the next moment, and give all that is known then."""
        seconds = self._elapsed(observation.timestamp_ns)
        seen = visibility(observation)
        self._learn_words(seen)
        predicted, slopes = _predicted(self._objects, seconds, self.settings)
        foreseen, missed = _foreseen(predicted, observation, self.settings)
        found = candidates(predicted, foreseen, seen, self.settings)
        rows, columns = assign_pairs(*found)
        objects = predicted.copied()
        unseen = predicted.hidden + (1.0 - predicted.hidden) * np.exp(missed)
        objects.log_odds += self.settings.trust * np.log(unseen)
        objects.hidden = predicted.hidden / unseen
        objects.hidden[rows] = 0.0
        self._read(objects, rows, seen, columns, predicted)
        objects.seen_ns[rows] = observation.timestamp_ns
        objects = self._with_newborn(objects, rows, seen, columns, observation.timestamp_ns)
        objects = self._still_there(objects, observation.timestamp_ns)
        outlined = _compare_with_outlines(objects, observation)
        self._objects = objects
        return Moment(observation, objects, predicted, slopes, outlined, self._words)

    def _elapsed(self, timestamp_ns: int) -> float:
        before, self._time_ns = self._time_ns, timestamp_ns
        seconds = 0.0 if before is None else (timestamp_ns - before) / 1e9
        if 0.0 <= seconds <= self.settings.longest_gap:
            return seconds
        self._objects = Population.empty()
        return 0.0

    def _learn_words(self, seen: Observations) -> None:
        self._words += [word for word in dict.fromkeys(seen.labels) if word not in self._words]
        missing = len(self._words) - self._objects.votes.shape[1]
        if missing:
            self._objects.votes = np.pad(self._objects.votes, ((0, 0), (0, missing)))

    def _read(
        self,
        objects: Population,
        rows: Int64Array,
        seen: Observations,
        columns: Int64Array,
        predicted: Population,
    ) -> None:
        """Read of some objects the boxes that are theirs."""
        settings = self.settings
        motion.read(objects.means, objects.covariances, rows, seen.measures, seen.covariances, columns)
        motion.read_no_slip(objects.means, objects.covariances, objects.vehicles, settings.side_slip)
        gained = seen.log_odds[columns] - existence.log_odds(settings.prior)
        objects.log_odds[rows] = predicted.log_odds[rows] + settings.trust * gained
        objects.votes[rows] += self._votes(seen, columns)
        objects.supports[:] = Support.PREDICTED
        objects.supports[rows] = _supports(seen, columns)
        for camera_id, corners in seen.corners_xyxy.items():
            objects.corners_xyxy[camera_id] = no_boxes(len(objects))
            objects.corners_xyxy[camera_id][rows] = corners[columns]
        rotation_round(objects, rows, seen, columns)

    def _votes(self, seen: Observations, rows: Int64Array) -> Float64Array:
        """How much boxes speak for each of the words, (K, words)."""
        votes = np.zeros((len(rows), len(self._words)))
        numbers = [self._words.index(seen.labels[k]) for k in rows.tolist()]
        votes[np.arange(len(rows)), numbers] = existence.probabilities(seen.log_odds[rows])
        return votes

    def _with_newborn(
        self,
        objects: Population,
        rows: Int64Array,
        seen: Observations,
        columns: Int64Array,
        timestamp_ns: int,
    ) -> Population:
        free = seen.log_odds > existence.log_odds(self.settings.drop)
        free[columns] = False
        new = track_initiations.unclaimed(seen, free, objects.select(rows))
        if not len(new):
            return objects
        means, covariances = track_initiations.states(seen, new)
        newborn = Population(
            ids=np.arange(self._next_id, self._next_id + len(new)),
            means=means,
            covariances=covariances,
            log_odds=seen.log_odds[new],
            hidden=np.zeros(len(new)),
            codes=seen.codes[new],
            vehicles=seen.vehicles[new],
            seen_ns=np.full(len(new), timestamp_ns),
            heading_votes=np.where(seen.measured[new], 1.0, 0.0),
            votes=self._votes(seen, new),
            supports=_supports(seen, new),
            corners_xyxy={camera_id: boxes[new] for camera_id, boxes in seen.corners_xyxy.items()},
        )
        self._next_id += len(new)
        return objects.joined(newborn)

    def _still_there(self, objects: Population, timestamp_ns: int) -> Population:
        settings = self.settings
        there = objects.log_odds > existence.log_odds(settings.drop)
        there &= timestamp_ns - objects.seen_ns <= settings.longest_gap * 1e9
        return objects if there.all() else objects.select(there)


def _predicted(
    objects: Population, seconds: float, settings: TrackerSettings
) -> tuple[Population, Float64Array]:
    """The objects so much later, and the slopes of their states."""
    moved = objects.copied()
    moved.means, moved.covariances, slopes = motion.predicted(
        objects.means, objects.covariances, objects.vehicles, seconds, settings
    )
    moved.log_odds = existence.aged(objects.log_odds, seconds, settings.lifetime)
    leaving, coming = np.exp(-seconds / settings.hidden_time), np.exp(-seconds / settings.open_time)
    moved.hidden = objects.hidden * leaving + (1.0 - objects.hidden) * (1.0 - coming)
    drifts = np.where(objects.vehicles, *image_boxes.DRIFTS)[:, None] ** 2 * seconds
    moved.differing_variances = {
        camera_id: variances + drifts for camera_id, variances in moved.differing_variances.items()
    }
    moved.corners_xyxy = {}
    return moved, slopes


def _foreseen(
    objects: Population, observation: Observation, settings: TrackerSettings
) -> tuple[ByCamera, Float64Array]:
    """The boxes that are expected in images, and how little it says if an object is not found, (N,) logarithms."""
    likely = existence.probabilities(objects.log_odds)
    apart = np.linalg.norm(objects.means[:, :3] - observation.world_from_lidar.translation, axis=1)
    foreseen: ByCamera = {}
    missed = np.zeros((len(objects), 2))
    for camera_id, view in observation.views.items():
        lines = image_boxes.outlines(objects.means[:, :7], likely, observation.world_from_lidar, view)
        differing = objects.differing.get(camera_id, no_boxes(len(objects)))
        foreseen[camera_id] = image_boxes.applied(
            differing, lines.corners_xyxy, view.camera.width, view.camera.height
        )
        # every camera looks for itself, the lidar once
        of_camera = existence.missed(lines, apart, settings)
        missed[:, 0] += of_camera[:, 0]
        missed[:, 1] = np.minimum(missed[:, 1], of_camera[:, 1])
    return foreseen, missed.sum(axis=1)


def _supports(seen: Observations, rows: Int64Array) -> UInt8Array:
    """What boxes are, as `Support`."""
    shown = np.zeros(len(rows), np.bool_)
    for corners in seen.corners_xyxy.values():
        shown |= has_area(corners[rows])
    supports = np.where(shown, Support.BOTH, Support.SWEEP)
    return np.where(seen.measured[rows], supports, Support.IMAGE).astype(np.uint8)


def _compare_with_outlines(objects: Population, observation: Observation) -> ByCamera:
    """Learn how boxes in images differ from the outlines of the objects, and give these."""
    likely = existence.probabilities(objects.log_odds)
    outlined: ByCamera = {}
    for camera_id, view in observation.views.items():
        lines = image_boxes.outlines(objects.means[:, :7], likely, observation.world_from_lidar, view)
        outlined[camera_id] = lines.corners_xyxy
        unknown = no_boxes(len(objects))
        objects.differing[camera_id], objects.differing_variances[camera_id] = image_boxes.filtered(
            objects.differing.get(camera_id, unknown),
            objects.differing_variances.get(camera_id, unknown),
            objects.corners_xyxy.get(camera_id, unknown),
            lines.corners_xyxy,
        )
    return outlined


def reported(moment: Moment, settings: TrackerSettings) -> TrackedObjects:
    """The objects that are likely enough to be reported."""
    likely = existence.probabilities(moment.objects.log_odds) * (1.0 - moment.objects.hidden)
    rows = np.flatnonzero(likely >= np.minimum(settings.report, 1.0 - SUREST))
    objects = moment.objects.select(rows)
    corners = {}
    for camera_id, view in moment.observation.views.items():
        outlined = moment.outlined[camera_id][rows]
        differing = objects.differing[camera_id]
        if settings.image_box is ImageBox.PROJECTED:
            differing = np.zeros_like(differing)
        corners[camera_id] = image_boxes.applied(differing, outlined, view.camera.width, view.camera.height)
    return TrackedObjects(
        timestamp_ns=moment.observation.timestamp_ns,
        ids=objects.ids,
        labels=tuple(moment.words[k] for k in _most_votes(objects).tolist()),
        centers=objects.means[:, :3],
        sizes_lwh=objects.means[:, 3:6],
        yaws=objects.means[:, motion.YAW],
        velocities=objects.means[:, 7:10],
        yaw_rates=objects.means[:, motion.ROTATION],
        covariances=objects.covariances[:, :10, :10],
        scores=likely[rows],
        supports=objects.supports,
        corners_xyxy=corners,
    )


def _most_votes(objects: Population) -> Int64Array:
    return objects.votes.argmax(axis=1) if len(objects) else np.zeros(0, np.int64)
