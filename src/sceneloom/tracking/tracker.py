"""The tracker: association, track initiation, headings, and one step per moment.

A box z is rather of an object whose location x is foreseen than of anything else by the logarithm of

    t(z - x; S) / λ · s / (1 - s) · t(1 - o; σ) / t(1 - o₀; σ).

S is the covariance of both on the ground, t a distribution with tails like Student's, since detectors are sometimes far
off; λ is how many boxes of other things lie around; the odds of the box's own score s count where they are below 1; o
is the overlap of the box in the image with the one that is foreseen there, and o₀ the one that says nothing. So an
object that was not seen for long, whose location is vague, does not take every box around. Of all ways to pair boxes
with objects the one is taken whose logarithms add up to the most; what is below 0 is no pair.

Source: Reid 1979, "An Algorithm for Tracking Multiple Targets", eq. 16 for the ratio with the density; Bar-Shalom, Li
and Kirubarajan 2001, ch. 2.6; Lange, Little and Taylor 1989, "Robust Statistical Modeling Using the t Distribution".

Detectors know the axis of a box better than its front, and the outline in an image is the same both ways round. Each
box votes for its own heading, each moment of motion for its direction; the sum is remembered. Neighbours of the lane
whose heading is known are asked anew each time, and count only where the rest is undecided.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.detections.projection import assign_pairs
from sceneloom.kernels.tracking import add_gains_in_image, gains_in_space, without_twins
from sceneloom.scene.detections import Support, TrackedObjects
from sceneloom.tracking import states
from sceneloom.tracking import states as tracking_states
from sceneloom.tracking.observation import SUREST, Observation, Observations, visibility
from sceneloom.tracking.settings import ImageBox, TrackerSettings
from sceneloom.tracking.states import ByCamera, Population, has_area, no_boxes

_OVERLAP_SIGMA = 0.25
"""Deviation of the share by which boxes in images fail to overlap that are one object's."""

_USUAL_OVERLAP = 0.6
"""The overlap that speaks neither for nor against one object."""

_LEAST_OVERLAP = 0.3
"""An object takes a box of an image alone that overlaps with its own by so much at least."""

_LEAST_SIGMA = 0.3
"""No middle of a box is where it is expected to within less than this [m]."""

_FREEDOM = 4.0
"""Degrees of freedom of what boxes are off."""

_AGREEMENT = (
    0.5 * (_FREEDOM + 1.0) * float(np.log1p(((1.0 - _USUAL_OVERLAP) / _OVERLAP_SIGMA) ** 2 / _FREEDOM))
)
"""What an image adds at most: where boxes are the same."""


class Candidates(NamedTuple):
    """Pairs of objects and boxes: (K,) int64 of both, and (K,) float64, how much likelier they are one than not."""

    rows: Int64Array
    columns: Int64Array
    gains: Float64Array


def _candidates(
    objects: Population, foreseen: ByCamera, seen: Observations, settings: TrackerSettings
) -> Candidates:
    """Which boxes may be of which objects, and how much likelier that is than that they are of anything else.

    Args:
        objects: as they are expected at the time of the boxes.
        foreseen: by camera, (N, 4) [px], where they are expected in its image, NaN for nowhere.
        seen: the boxes.
        settings: what is taken for granted.
    """
    density = np.where(objects.vehicles, settings.vehicle_density, settings.person_density)
    found = Candidates(
        *gains_in_space(
            np.ascontiguousarray(objects.means[:, :3]),
            np.ascontiguousarray(objects.covariances[:, :3, :3]),
            objects.codes,
            np.log(density),
            np.ascontiguousarray(seen.measures[:, :3]),
            np.ascontiguousarray(seen.covariances[:, :3, :3]),
            seen.codes,
            np.minimum(seen.log_odds, 0.0),
            _LEAST_SIGMA**2,
            _FREEDOM,
            len(seen.corners_xyxy) * _AGREEMENT,
        )
    )
    for camera_id, corners in seen.corners_xyxy.items():
        if camera_id in foreseen:
            add_gains_in_image(
                *found,
                foreseen[camera_id],
                corners,
                seen.measured,
                _OVERLAP_SIGMA,
                _USUAL_OVERLAP,
                _LEAST_OVERLAP,
                _FREEDOM,
            )
    return found


_TWIN_OVERLAP = 0.5
"""Boxes in an image that overlap by more than this stand for one object."""

_TWIN_SHARE = 0.5
"""So do boxes whose middles are nearer to each other than this share of a width."""

_LOCATION = [0, 1, 4]
"""What says where a box is on the ground, and how wide."""

_SPEEDS = ((10.0, 2.0), (1.5, 1.5))
"""Deviation of the speed of what is seen for the first time, along and across its heading: vehicles, people [m/s]."""

_CLIMB, _ROTATION = 0.3, 0.2
"""The same of climbing [m/s] and rotating [rad/s]."""


def _unclaimed(seen: Observations, free: BoolArray, objects: Population) -> Int64Array:
    """Give the rows of free boxes that are no second box of an object of this moment, nor of one another.

    Args:
        seen: the boxes of the moment.
        free: (M,), which of them are no object's, and likely enough.
        objects: those with a box at this moment.
    """
    rows = np.flatnonzero(free)
    rows = rows[np.argsort(-seen.log_odds[rows], kind="stable")]
    known = {name: objects.corners_xyxy.get(name, no_boxes(len(objects))) for name in seen.corners_xyxy}
    kept: Int64Array = without_twins(
        rows,
        np.ascontiguousarray(seen.measures[:, _LOCATION]),
        seen.measured,
        _stacked(seen.corners_xyxy, len(seen)),
        np.ascontiguousarray(objects.means[:, _LOCATION]),
        objects.supports != Support.IMAGE,
        _stacked(known, len(objects)),
        _TWIN_SHARE,
        _TWIN_OVERLAP,
    )
    return kept


def _stacked(corners: ByCamera, count: int) -> Float64Array:
    """Boxes of all images, (C, N, 4)."""
    return np.array(list(corners.values())).reshape(len(corners), count, 4)


def _states(seen: Observations, rows: Int64Array) -> tuple[Float64Array, Float64Array]:
    """States of objects that are seen for the first time, (K, 11) and (K, 11, 11) of `tracking_states`."""
    means = np.zeros((len(rows), tracking_states.SIZE))
    covariances = np.zeros((len(rows), tracking_states.SIZE, tracking_states.SIZE))
    means[:, :7], covariances[:, :7, :7] = seen.measures[rows], seen.covariances[rows]
    covariances[:, 6, 6] = np.minimum(covariances[:, 6, 6], np.pi**2)
    reported = np.isfinite(seen.velocities[rows]).all(axis=1)
    means[reported, 7:10] = seen.velocities[rows[reported]]
    along, across = np.where(seen.vehicles[rows], *(np.array(_SPEEDS)[..., None] ** 2))
    across = np.where(seen.measured[rows], across, along)
    cosines, sines = np.cos(means[:, 6]), np.sin(means[:, 6])
    covariances[:, 7, 7] = along * cosines**2 + across * sines**2
    covariances[:, 8, 8] = along * sines**2 + across * cosines**2
    covariances[:, 7, 8] = covariances[:, 8, 7] = (along - across) * cosines * sines
    covariances[:, 9, 9], covariances[:, 10, 10] = _CLIMB**2, _ROTATION**2
    return means, covariances


_MOST_VOTES = 5.0
"""So many looks at a heading are remembered."""

_MOVING = 1.5
"""What is faster than this shows by its motion where it heads [m/s]."""

_SURE_HEADING = 1.0
"""A heading with a larger variance than this says nothing [rad²]."""

_OUTVOTED = -1.0
"""With fewer votes than this a heading is reversed."""

_NEIGHBOURS = 2.0
"""So many votes have the neighbours together."""

_KNOWN = 3.0
"""So many votes make a neighbour's heading known."""

_HALF_LANE, _AHEAD = 1.75, 50.0
"""How far across and along its heading a neighbour of the same lane is [m]."""

_PARALLEL = 0.95
"""Least cosine between the axes of neighbours."""


def _rotation_round(objects: Population, rows: Int64Array, seen: Observations, columns: Int64Array) -> None:
    """Let boxes, motion and neighbours vote on headings, in place, and rotate those round that are outvoted.

    Args:
        objects: all of them.
        rows: (K,), those of which a box was seen.
        seen: boxes.
        columns: (K,), the box of each.
    """
    sure = seen.covariances[columns, 6, 6] < _SURE_HEADING
    rows, columns = rows[sure], columns[sure]
    objects.heading_votes[rows] += np.cos(seen.measures[columns, 6] - objects.means[rows, states.YAW])
    headings = objects.means[:, states.YAW]
    forward = np.cos(headings) * objects.means[:, 7] + np.sin(headings) * objects.means[:, 8]
    objects.heading_votes += np.sign(forward) * (np.abs(forward) > _MOVING)
    objects.heading_votes = np.clip(objects.heading_votes, -_MOST_VOTES, _MOST_VOTES)
    doubtful = np.flatnonzero(objects.vehicles & (objects.heading_votes < _OUTVOTED + _NEIGHBOURS))
    votes = objects.heading_votes[doubtful]
    wrong = np.union1d(
        doubtful[votes + _NEIGHBOURS * _of_neighbours(objects, doubtful) < _OUTVOTED],
        np.flatnonzero(~objects.vehicles & (objects.heading_votes < _OUTVOTED)),
    )
    objects.means[wrong, states.YAW] = states.wrapped(objects.means[wrong, states.YAW] + np.pi)
    objects.heading_votes[wrong] *= -1.0


def _of_neighbours(objects: Population, rows: Int64Array) -> Float64Array:
    """How much vehicles of the same lane speak for the headings of some, (K,), from -1 to 1."""
    known = np.flatnonzero(objects.vehicles & (objects.heading_votes >= _KNOWN))
    apart = objects.means[known, :2] - objects.means[rows, None, :2]
    headings = objects.means[rows, states.YAW, None]
    cosines, sines = np.cos(headings), np.sin(headings)
    along = cosines * apart[..., 0] + sines * apart[..., 1]
    across = cosines * apart[..., 1] - sines * apart[..., 0]
    rotations = np.cos(objects.means[known, states.YAW] - headings)
    of_lane = (np.abs(across) < _HALF_LANE) & (np.abs(along) < _AHEAD) & (np.abs(rotations) > _PARALLEL)
    reported: Float64Array = np.clip(np.sum(rotations, axis=1, where=of_lane), -1.0, 1.0)
    return reported


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
        return _reported(self.advance(observation), self.settings)

    def advance(self, observation: Observation) -> Moment:
        """Take the boxes of the next moment, and give all that is known then."""
        seconds = self._elapsed(observation.timestamp_ns)
        seen = visibility(observation)
        self._learn_words(seen)
        predicted, slopes = _predicted(self._objects, seconds, self.settings)
        foreseen, missed = _foreseen(predicted, observation, self.settings)
        found = _candidates(predicted, foreseen, seen, self.settings)
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
        states.read(objects.means, objects.covariances, rows, seen.measures, seen.covariances, columns)
        states.read_no_slip(objects.means, objects.covariances, objects.vehicles, settings.side_slip)
        gained = seen.log_odds[columns] - states.log_odds(settings.prior)
        objects.log_odds[rows] = predicted.log_odds[rows] + settings.trust * gained
        objects.votes[rows] += self._votes(seen, columns)
        objects.supports[:] = Support.PREDICTED
        objects.supports[rows] = _supports(seen, columns)
        for camera_id, corners in seen.corners_xyxy.items():
            objects.corners_xyxy[camera_id] = no_boxes(len(objects))
            objects.corners_xyxy[camera_id][rows] = corners[columns]
        _rotation_round(objects, rows, seen, columns)

    def _votes(self, seen: Observations, rows: Int64Array) -> Float64Array:
        """How much boxes speak for each of the words, (K, words)."""
        votes = np.zeros((len(rows), len(self._words)))
        numbers = [self._words.index(seen.labels[k]) for k in rows.tolist()]
        votes[np.arange(len(rows)), numbers] = states.probabilities(seen.log_odds[rows])
        return votes

    def _with_newborn(
        self,
        objects: Population,
        rows: Int64Array,
        seen: Observations,
        columns: Int64Array,
        timestamp_ns: int,
    ) -> Population:
        free = seen.log_odds > states.log_odds(self.settings.drop)
        free[columns] = False
        new = _unclaimed(seen, free, objects.select(rows))
        if not len(new):
            return objects
        means, covariances = _states(seen, new)
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
        there = objects.log_odds > states.log_odds(settings.drop)
        there &= timestamp_ns - objects.seen_ns <= settings.longest_gap * 1e9
        return objects if there.all() else objects.select(there)


def _predicted(
    objects: Population, seconds: float, settings: TrackerSettings
) -> tuple[Population, Float64Array]:
    """The objects so much later, and the slopes of their states."""
    moved = objects.copied()
    moved.means, moved.covariances, slopes = states.predicted(
        objects.means, objects.covariances, objects.vehicles, seconds, settings
    )
    moved.log_odds = states.aged(objects.log_odds, seconds, settings.lifetime)
    leaving, coming = np.exp(-seconds / settings.hidden_time), np.exp(-seconds / settings.open_time)
    moved.hidden = objects.hidden * leaving + (1.0 - objects.hidden) * (1.0 - coming)
    drifts = np.where(objects.vehicles, *states.DRIFTS)[:, None] ** 2 * seconds
    moved.differing_variances = {
        camera_id: variances + drifts for camera_id, variances in moved.differing_variances.items()
    }
    moved.corners_xyxy = {}
    return moved, slopes


def _foreseen(
    objects: Population, observation: Observation, settings: TrackerSettings
) -> tuple[ByCamera, Float64Array]:
    """The boxes that are expected in images, and how little it says if an object is not found, (N,) logarithms."""
    likely = states.probabilities(objects.log_odds)
    apart = np.linalg.norm(objects.means[:, :3] - observation.world_from_lidar.translation, axis=1)
    foreseen: ByCamera = {}
    missed = np.zeros((len(objects), 2))
    for camera_id, view in observation.views.items():
        lines = states.outlines(objects.means[:, :7], likely, observation.world_from_lidar, view)
        differing = objects.differing.get(camera_id, no_boxes(len(objects)))
        foreseen[camera_id] = states.applied(
            differing, lines.corners_xyxy, view.camera.width, view.camera.height
        )
        # every camera looks for itself, the lidar once
        of_camera = states.missed(lines, apart, settings)
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
    likely = states.probabilities(objects.log_odds)
    outlined: ByCamera = {}
    for camera_id, view in observation.views.items():
        lines = states.outlines(objects.means[:, :7], likely, observation.world_from_lidar, view)
        outlined[camera_id] = lines.corners_xyxy
        unknown = no_boxes(len(objects))
        objects.differing[camera_id], objects.differing_variances[camera_id] = states.filtered(
            objects.differing.get(camera_id, unknown),
            objects.differing_variances.get(camera_id, unknown),
            objects.corners_xyxy.get(camera_id, unknown),
            lines.corners_xyxy,
        )
    return outlined


def _reported(moment: Moment, settings: TrackerSettings) -> TrackedObjects:
    """The objects that are likely enough to be reported."""
    likely = states.probabilities(moment.objects.log_odds) * (1.0 - moment.objects.hidden)
    rows = np.flatnonzero(likely >= np.minimum(settings.report, 1.0 - SUREST))
    objects = moment.objects.select(rows)
    corners = {}
    for camera_id, view in moment.observation.views.items():
        outlined = moment.outlined[camera_id][rows]
        differing = objects.differing[camera_id]
        if settings.image_box is ImageBox.PROJECTED:
            differing = np.zeros_like(differing)
        corners[camera_id] = states.applied(differing, outlined, view.camera.width, view.camera.height)
    return TrackedObjects(
        timestamp_ns=moment.observation.timestamp_ns,
        ids=objects.ids,
        labels=tuple(moment.words[k] for k in _most_votes(objects).tolist()),
        centers=objects.means[:, :3],
        sizes_lwh=objects.means[:, 3:6],
        yaws=objects.means[:, states.YAW],
        velocities=objects.means[:, 7:10],
        yaw_rates=objects.means[:, states.ROTATION],
        covariances=objects.covariances[:, :10, :10],
        scores=likely[rows],
        supports=objects.supports,
        corners_xyxy=corners,
    )


def _most_votes(objects: Population) -> Int64Array:
    return objects.votes.argmax(axis=1) if len(objects) else np.zeros(0, np.int64)
