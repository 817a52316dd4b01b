"""Check of a camera-lidar calibration: from images and points, from boxes, and from motion.

Source: response surfaces, Box and Wilson 1951, "On the Experimental Attainment of Optimum Conditions".

Ego motion and detected boxes add.

The limits are lengths and angles that matter, and what the measures got wrong by themselves on simulated drives of
other seeds than those of the tests: see docs/calibration.md.

At the angle θ off the axis, a pinhole has u = f·tan θ + c. A rotation by a small angle a moves u by f·a·(1 + tan² θ),
and a principal point off by d moves it by d: to first order they are the same, d = f·a, whatever is seen and however
    far it
is. What reports them apart is of second order, d·tan² θ, and tangential distortion is of the same form: of a camera
model whose coefficients are not exact, nearly nothing is left.

From image to image the camera rotates by the vector c, and the lidar by l. With the true rotation X of
camera_from_lidar, C = X L X⁻¹, so c = X l. If X is the stated R after a small rotation w,

    c - R l = w × R l,

which reports w about the axes across the vehicle's own axis of rotating, and nothing along it. Steps of the same size
report by how much they rotate: a straight drive gives no information.

Source: Shiu and Ahmad 1989, "Calibration of Wrist-Mounted Robotic Sensors by Solving Homogeneous Transform Equations of
the Form AX = XB"; rotation vectors: Park and Martin 1994; sandwich by clusters: Liang and Zeger 1986.

Boxes of images and sweeps come together about a rotation. It is as exact as edges where there are many boxes, and known
from farther away. A camera that is shifted looks rotated to boxes, by the shift over their distance.
"""

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.calibrate.frames import MOST, CalibrationFrame, calibration_frames
from sceneloom.calibrate.measures import (
    COUNT,
    EDGES,
    INFORMATION,
    MEASURES,
    ROTATION,
    TRANSLATION,
    UNITS,
    Agreement,
    Change,
    FrameFeatures,
    Parameter,
    Score,
)
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.detections.residuals import BoxRotation
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.warnings import DataWarning

_FINE = (EDGES, INFORMATION)
_WIDE = MEASURES
_FAR_LOOKS = 48

_FAR_DEG = (2.5, 6.0)
"""Rotates so far away that nothing but chance makes images and clouds agree."""

_REPLICATES = 100
_SEED = 0


@dataclass(frozen=True, slots=True, eq=False)
class Chance:
    """What the measures come to where nothing fits.

    Attributes:
        means, deviations: (M,) by measure; the deviation of one without a value is infinite, so that it counts nothing.
        sum_deviation: deviation of the sum over the fine measures, in units of theirs.
    """

    means: Float64Array
    deviations: Float64Array
    sum_deviation: float


class _Objective:
    """The measures of an agreement, each as deviations above chance, added up.

    Attributes:
        agreement: what is scored.
        chance: what the measures come to far away from the stated calibration.
        replicates: (B, C), weights of the cells for bootstrap replicates.

    Source: bootstrap over blocks: Künsch 1989, "The Jackknife and the Bootstrap for General Stationary Observations".
    """

    def __init__(self, agreement: Agreement, *, seed: int = _SEED) -> None:
        """Measure chance around the stated calibration."""
        self.agreement = agreement
        self.generator = np.random.default_rng(seed)
        self.chance = self._measured_chance()
        self.replicates = self._drawn_cells()

    def stationary(self, score: Score, measures: Collection[str] = _FINE, *, replicated: bool = False) -> Float64Array:
        """Deviations above chance, summed over measures: (1,), or (B,) for the replicates."""
        values = score.values(self.replicates) if replicated else score.values()[None]
        return np.asarray(self.deviations_of(values)[:, _rows(measures)].sum(axis=1))

    def deviations_of(self, values: Float64Array) -> Float64Array:
        """How far values (B, M) stand above chance; one that is missing stands nowhere."""
        return np.nan_to_num((values - self.chance.means) / self.chance.deviations, nan=0.0)

    def distinctness(self, score: Score) -> float:
        """How many deviations the fine measures together stand above chance."""
        return float(self.stationary(score)[0] / self.chance.sum_deviation)

    def _measured_chance(self) -> Chance:
        looks = []
        for _ in range(_FAR_LOOKS):
            direction = self.generator.normal(size=3)
            rotation = direction / np.linalg.norm(direction) * np.radians(self.generator.uniform(*_FAR_DEG))
            looks.append(self.agreement.score(Change.rotation(rotation)).values())
        values = np.array(looks)
        known = np.isfinite(values).sum(axis=0) >= _FAR_LOOKS // 2
        means, deviations = np.zeros(len(MEASURES)), np.full(len(MEASURES), np.inf)
        means[known], deviations[known] = (
            np.nanmean(values[:, known], axis=0),
            np.nanstd(values[:, known], axis=0),
        )
        deviations[deviations < _NOTHING] = np.inf
        fine = np.nan_to_num((values - means) / deviations)[:, _rows(_FINE)].sum(axis=1)
        return Chance(means, deviations, max(float(fine.std()), 1.0))

    def _drawn_cells(self) -> Float64Array:
        """Draw cells with replacement, of those that hold anything."""
        occupied = np.flatnonzero(self.agreement.score(Change(), by_cells=True).totals.sum(axis=0) > 0)
        weights = np.zeros((_REPLICATES, self.agreement.cells))
        if len(occupied):
            draws = self.generator.multinomial(len(occupied), np.full(len(occupied), 1 / len(occupied)), _REPLICATES)
            weights[:, occupied] = draws
        return weights


_NOTHING = 1e-6


def _rows(measures: Collection[str]) -> list[int]:
    return [row for row, name in enumerate(MEASURES) if name in measures]


_PROBES = 3000


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Fits quadratics to values at fixed locations of a ball, and finds their tops in it.

    Attributes:
        locations: (N, P) float64, within the unit ball, the first one its middle.
        solve: (Q, N) float64, values to coefficients by least squares.
        probes: (K, P) float64, where tops are looked for.
        probe_terms: (K, Q) float64, their terms.
    """

    locations: Float64Array
    solve: Float64Array
    probes: Float64Array
    probe_terms: Float64Array

    @classmethod
    def of(cls, count: int, dimensions: int, generator: np.random.Generator) -> "Surface":
        """Choose locations."""
        locations = _in_ball(count, dimensions, generator)
        locations[0] = 0.0
        probes = _in_ball(_PROBES, dimensions, generator)
        return cls(locations, np.asarray(np.linalg.pinv(_terms(locations)), np.float64), probes, _terms(probes))

    def tops(self, values: Float64Array) -> Float64Array:
        """Give the tops, (B, P), of the quadratics through values (B, N)."""
        heights = values @ self.solve.T @ self.probe_terms.T
        tops: Float64Array = self.probes[np.argmax(heights, axis=1)]
        return tops


def coefficients(dimensions: int) -> int:
    """How many a quadratic has."""
    return (dimensions + 1) * (dimensions + 2) // 2


def _terms(locations: Float64Array) -> Float64Array:
    rows, columns = np.triu_indices(locations.shape[1])
    return np.hstack([np.ones((len(locations), 1)), locations, locations[:, rows] * locations[:, columns]])


def _in_ball(count: int, dimensions: int, generator: np.random.Generator) -> Float64Array:
    """Draw locations evenly from the unit ball, (count, dimensions)."""
    directions = generator.normal(size=(count, dimensions))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = generator.random((count, 1)) ** (1.0 / dimensions)
    return np.asarray(directions * radii)


_WIDE_RADII = (20.0, 11.0, 6.0, 3.5)

_FINE_RADII = (2.4, 1.6)
"""Balls of rotations that are looked at, one after another [units of a quarter degree]."""

_NEAR_RADII, _FAR_RADII = (4.0, 2.0), (10.0, 5.0, 2.0)

_MANY, _MANY_RADIUS, _PROMISING = 150, 7.0, 3
"""So many rotates up to so far are looked at, and so many followed up: hills are narrower than wide balls report."""

_FINE_FROM = 4.0

_ROUGH_FROM = 3.0
"""In wider balls some of the features report where to look next."""

_LOOKS_PER_COEFFICIENT = (4.0, 2.5)
_FARTHEST_DEG = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class _Top:
    """The best location that was found, by some parameters of a change.

    Attributes:
        parameters: which of the eight numbers were looked for.
        change: the location.
        replicates: (B, P) float64, the locations that bootstrap replicates found, in the parameters' own units.
        radius: (P,) float64, of the ball that was looked at last: what comes near to it was not found.
        height: deviations above chance.
        distinctness: the same by chance's own deviation.
        gain, gain_deviation: how much higher it is than where the search began, and the deviation of that among
            replicates.
    """

    parameters: tuple[Parameter, ...]
    change: Float64Array
    replicates: Float64Array
    radius: Float64Array
    height: float
    distinctness: float
    gain: float
    gain_deviation: float

    @property
    def covariance(self) -> Float64Array:
        """(P, P), of the parameters among the replicates."""
        return np.atleast_2d(np.cov(self.replicates.T))

    def number(self, parameter: Parameter) -> tuple[float, float]:
        """Value and standard deviation of a parameter."""
        column = self.parameters.index(parameter)
        return float(self.change[parameter]), float(np.sqrt(self.covariance[column, column]))


def _find_rotation(objective: _Objective) -> _Top:
    """Find the best rotation: from far to near, near the stated one, and near some that agree; the highest counts."""
    begun = np.zeros(COUNT)
    wide = begun
    for radius in _WIDE_RADII:
        wide = _climb(objective, wide, ROTATION, radius, _WIDE)
        wide = _bounded(wide)
    starts = (wide, begun, *_promising(objective))
    locations = [_climb(objective, start, ROTATION, _FINE_RADII[0], _FINE) for start in starts]
    highest = _highest(objective, locations)
    return _top_around(objective, highest, highest, ROTATION, _FINE_RADII[1])


def _promising(objective: _Objective) -> list[Float64Array]:
    """Some of many rotates, (8,), around the stated calibration that agree best, none near another."""
    columns = list(ROTATION)
    rotations = _in_ball(_MANY, len(columns), objective.generator) * _MANY_RADIUS
    locations = np.zeros((_MANY, COUNT))
    locations[:, columns] = rotations * UNITS[columns]
    scores = [objective.agreement.score(Change.of(location), _WIDE, rough=True) for location in locations]
    heights = np.array([objective.stationary(score, _WIDE)[0] for score in scores])
    found: list[int] = []
    for row in np.argsort(-heights).tolist():
        if all(np.linalg.norm(rotations[row] - rotations[other]) > _FINE_RADII[0] for other in found):
            found.append(row)
        if len(found) == _PROMISING:
            break
    return [locations[row] for row in found]


def _find_group(objective: _Objective, start: Float64Array, parameters: Sequence[Parameter]) -> _Top:
    """Find the best location by several parameters, from near and from farther away; the higher of both counts."""
    locations = []
    for radii in (_NEAR_RADII, _FAR_RADII):
        location = start
        for radius in radii[:-1]:
            measures = _FINE if radius <= _FINE_FROM else _WIDE
            location = _climb(objective, location, parameters, radius, measures)
        locations.append(location)
    return _top_around(objective, _highest(objective, locations), start, parameters, _NEAR_RADII[-1])


def _highest(objective: _Objective, locations: Sequence[Float64Array]) -> Float64Array:
    """The location, (8,), where images and sweeps agree best."""
    heights = [objective.stationary(objective.agreement.score(Change.of(location), _FINE))[0] for location in locations]
    return locations[int(np.argmax(heights))]


def _top_around(
    objective: _Objective,
    location: Float64Array,
    start: Float64Array,
    parameters: Sequence[Parameter],
    radius: float,
) -> _Top:
    """Find the top in a ball, and what replicates make of it; `start` is what its gain is reported against."""
    location, replicates = _look_around(objective, location, parameters, radius, _FINE)
    there, here = (objective.agreement.score(Change.of(numbers), _FINE, by_cells=True) for numbers in (location, start))
    gains = objective.stationary(there, replicated=True) - objective.stationary(here, replicated=True)
    return _Top(
        tuple(parameters),
        location,
        replicates,
        radius * UNITS[list(parameters)],
        float(objective.stationary(there)[0]),
        objective.distinctness(there),
        float(objective.stationary(there)[0] - objective.stationary(here)[0]),
        float(gains.std()),
    )


def _climb(
    objective: _Objective,
    middle: Float64Array,
    parameters: Sequence[Parameter],
    radius: float,
    measures: Sequence[str],
) -> Float64Array:
    """Go to the top of the quadratic through looks at a ball, (8,), or to the best look where that is higher."""
    columns = list(parameters)
    rough = radius > _ROUGH_FROM
    surface, scores = _looks(objective, middle, columns, radius, measures, rough=rough)
    values = np.array([objective.stationary(score, measures) for score in scores]).T
    top = middle.copy()
    top[columns] += radius * UNITS[columns] * surface.tops(values)[0]
    at_top = objective.agreement.score(Change.of(top), measures, rough=rough)
    if rough or objective.stationary(at_top, measures)[0] >= values.max():
        return top
    found = middle.copy()
    found[columns] += radius * UNITS[columns] * surface.locations[np.argmax(values[0])]
    return found


def _look_around(
    objective: _Objective,
    middle: Float64Array,
    parameters: Sequence[Parameter],
    radius: float,
    measures: Sequence[str],
) -> tuple[Float64Array, Float64Array]:
    """Go to the top like `_climb`, and give those of the replicates, (B, P), too."""
    columns = list(parameters)
    surface, scores = _looks(objective, middle, columns, radius, measures, by_cells=True)
    values = np.array([objective.stationary(score, measures) for score in scores]).T
    replicated = np.array([objective.stationary(score, measures, replicated=True) for score in scores]).T
    found = middle.copy()
    found[columns] += radius * UNITS[columns] * surface.tops(values)[0]
    return found, middle[columns] + radius * UNITS[columns] * surface.tops(replicated)


def _looks(
    objective: _Objective,
    middle: Float64Array,
    columns: list[Parameter],
    radius: float,
    measures: Sequence[str],
    *,
    by_cells: bool = False,
    rough: bool = False,
) -> tuple[Surface, list[Score]]:
    """Score locations in a ball; one number more to be found needs more of them.

    But not as many more as it has terms.
    """
    count = int(_LOOKS_PER_COEFFICIENT[len(columns) > len(ROTATION)] * coefficients(len(columns)))
    surface = Surface.of(count, len(columns), objective.generator)
    scores = []
    for location in surface.locations:
        numbers = middle.copy()
        numbers[columns] += radius * UNITS[columns] * location
        candidate = Change.of(numbers)
        scores.append(objective.agreement.score(candidate, measures, by_cells=by_cells, rough=rough))
    return surface, scores


def _bounded(numbers: Float64Array) -> Float64Array:
    """Stay within what counts as near."""
    angle = float(np.linalg.norm(numbers[:3]))
    bounded = numbers.copy()
    bounded[:3] *= min(1.0, np.radians(_FARTHEST_DEG) / max(angle, 1e-12))
    return bounded


_GROUPS: dict[str, tuple[Parameter, ...]] = {
    "translation": (*ROTATION, *TRANSLATION),
    "focal_length": (*ROTATION, Parameter.FOCAL),
    "time_offset": (*ROTATION, Parameter.LATER),
}
"""What is looked for together with the rotation, by what the verdict is about."""


class Verdict(StrEnum):
    """What is to be stated of one part of a calibration."""

    GOOD = "good"
    DRIFTING = "drifting"
    WRONG = "wrong"
    UNDETERMINED = "cannot determine"


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """One part of a calibration.

    Attributes:
        name: "rotation", "translation", "focal_length", "principal_point" or "time_offset"; "boxes",
            "boxes_roll" and "motion".
        verdict: what is to be stated of it.
        reason: why, where it is not good.
        unit: of the numbers.
        values: what would have to be changed; empty where nothing was found.
        sigmas: their standard deviations, what the measures get wrong by themselves included.
    """

    name: str
    verdict: Verdict
    reason: str = ""
    unit: str = ""
    values: tuple[float, ...] = ()
    sigmas: tuple[float, ...] = ()

    @property
    def suspected(self) -> bool:
        """Whether it seems to be off, but that may be chance."""
        limits = _LIMITS.get(self.name)
        if limits is None or self.verdict is not Verdict.UNDETERMINED or not self.values:
            return False
        return max(abs(v) - 2.0 * s for v, s in zip(self.values, self.sigmas, strict=True)) > limits.good

    @classmethod
    def unknown(cls, name: str, reason: str) -> "Item":
        """Report why nothing can be stated."""
        return cls(name=name, verdict=Verdict.UNDETERMINED, reason=reason)


@dataclass(frozen=True, slots=True)
class Limits:
    """From where on a part is what.

    Attributes:
        name, unit: of the part.
        scale: from radians, metres, logarithms and seconds to the unit.
        good: up to this it is good.
        wrong: beyond this it is wrong.
        floor: what the measures get wrong by themselves, on each axis.
        vague: with a larger standard deviation on any axis nothing is stated.
        what: agrees.
    """

    name: str
    unit: str
    scale: float
    good: float
    wrong: float
    floor: float
    vague: float
    what: str = "images and sweeps agree"


_BOXES = "boxes of images and sweeps come together"

_LIMITS = {
    limits.name: limits
    for limits in (
        Limits("rotation", "deg", 180.0 / np.pi, 0.4, 1.0, 0.12, 0.35),
        Limits("translation", "m", 1.0, 0.1, 0.3, 0.04, 0.06),
        Limits("focal_length", "%", 100.0, 1.0, 3.0, 0.4, 0.8),
        Limits("time_offset", "ms", 1e3, 15.0, 60.0, 4.0, 9.0),
        Limits("boxes", "deg", 180.0 / np.pi, 0.4, 1.0, 0.12, 0.35, _BOXES),
        Limits("boxes_roll", "deg", 180.0 / np.pi, 1.0, 2.0, 0.4, 0.6, _BOXES),
        Limits("motion", "deg", 180.0 / np.pi, 1.5, 3.0, 0.5, 0.8, "camera and lidar rotate alike"),
    )
}

_SIGNIFICANT = 16.0
"""Squared distance from nothing, in standard deviations, of what is more than chance."""


def judge(name: str, values: Float64Array, covariance: Float64Array) -> Item:
    """Judge what would have to be changed of a part.

    Args:
        name: out of `_LIMITS`.
        values: (P,), in radians, metres, logarithms or seconds.
        covariance: (P, P), of the same.
    """
    limits = _LIMITS[name]
    found = values * limits.scale
    spread = covariance * limits.scale**2 + limits.floor**2 * np.eye(len(values))
    sigmas, size = np.sqrt(np.diag(spread)), float(np.linalg.norm(found))
    verdict, reason = Verdict.GOOD, ""
    significant = float(found @ np.linalg.solve(spread, found)) > _SIGNIFICANT
    if sigmas.max() > limits.vague:
        verdict = Verdict.UNDETERMINED
        reason = f"known within {sigmas.max():.2g} {limits.unit} only; expected {limits.vague:g} or better"
    elif size > limits.good and not significant:
        verdict = Verdict.UNDETERMINED
        reason = f"{size:.2g} {limits.unit} may be chance"
    elif size > limits.good:
        verdict = Verdict.WRONG if size > limits.wrong else Verdict.DRIFTING
        reason = f"{limits.what} best {size:.2g} {limits.unit} away from it"
    return Item(
        name=name,
        verdict=verdict,
        reason=reason,
        unit=limits.unit,
        values=tuple(map(float, found)),
        sigmas=tuple(map(float, sigmas)),
    )


_COLUMNS, _ROWS = 41, 25

_MOSTLY = 0.5
"""A rotation of which more than this share is about the optical axis does not come from the principal point."""

_STEP = 1e-4
"""By which the camera is rotated to see what that does [rad]."""


def look_alikes(camera: Camera) -> tuple[Float64Array, Float64Array]:
    """Report which rotation of a camera looks most like a shift of its principal point, and what is left between both.

    Args:
        camera: the camera model, of any model.

    Returns:
        rotations: (2, 3) float64 [rad/px], the rotation vectors of the cloud about the camera's axes that move it as
            the principal point does that goes a pixel to the right, and a pixel down; the focal length may change, too.
        left: (2,) float64, what then is left over the image, as a share of the trajectory of the principal point (root
            of the mean square); NaN where the camera model sees nothing.
    """
    u, v = np.meshgrid(np.linspace(-0.5, camera.width - 0.5, _COLUMNS), np.linspace(-0.5, camera.height - 0.5, _ROWS))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = unproject(camera, pixels)
    moves = [_rotated(camera, rays, axis) for axis in range(3)]
    moves.append(pixels - (camera.cx, camera.cy))
    seen = np.isfinite(np.stack(moves)).all(axis=(0, 2)) & np.isfinite(rays).all(axis=1)
    if seen.sum() < len(moves):
        return np.full((2, 3), np.nan), np.full(2, np.nan)
    columns = np.column_stack([move[seen].ravel() for move in moves])
    shifts = np.tile(np.eye(2), (int(seen.sum()), 1))
    found, *_ = np.linalg.lstsq(columns, shifts, rcond=None)
    left = np.sqrt(((shifts - columns @ found) ** 2).sum(axis=0) / seen.sum())
    return np.ascontiguousarray(found[:3].T), left


def why_untold(camera: Camera) -> str:
    """Report why the principal point of a camera cannot be reported: by how little it differs from a rotation."""
    rotations, left = look_alikes(camera)
    if not np.isfinite(left).all():
        return "moving it looks like rotating the camera"
    trajectory = np.radians(1.0) / np.linalg.norm(rotations, axis=1)
    return (
        f"moving it by {trajectory[0]:.3g} px to the side looks like rotating the camera by 1 deg, but for "
        f"{trajectory[0] * left[0]:.2g} px; by {trajectory[1]:.3g} px upward or downward, but for "
        f"{trajectory[1] * left[1]:.2g} px"
    )


def instead_of_rotation(camera: Camera, rotation: Float64Array) -> str:
    """Report what principal point would look like a rotation (3,) [rad] of the cloud; "" where none would."""
    rotations, left = look_alikes(camera)
    if not np.isfinite(left).all():
        return ""
    trajectory, *_ = np.linalg.lstsq(rotations.T, rotation, rcond=None)
    if np.linalg.norm(rotation - trajectory @ rotations) > _MOSTLY * np.linalg.norm(rotation):
        return ""
    unlike = float(np.hypot(*(trajectory * left)))
    return f"its principal point {np.hypot(*trajectory):.2g} px off looks the same within {unlike:.2g} px"


def _rotated(camera: Camera, rays: Float64Array, axis: int) -> Float64Array:
    """How pixels move by a rotation of the cloud about an axis, (N, 2) [px/rad]."""
    rotation = _STEP * np.eye(3)[axis]
    both = [
        project_unbounded(camera, rotate_vectors(quaternion_from_rotation_vector(sign * rotation), rays))
        for sign in (1.0, -1.0)
    ]
    moved: Float64Array = (both[0] - both[1]) / (2.0 * _STEP)
    return moved


_DISTINCT = 4.5
"""Deviations above chance from which on images and sweeps agree; the best of some hundred chances reaches 3.3."""

PARTS = ("rotation", "translation", "focal_length", "principal_point", "time_offset")
"""What images and points are asked about, in the order of the items."""

_OWN_VIEW_M, _OWN_VIEW_DEG = 4.0, 15.0
_LEAST_SEEN, _LEAST_EDGES = 200, 60

_PLAIN = 0.9
"""Images of which more shows nothing are dark, covered or fogged."""

_BETTER, _BETTER_SIGMAS = 1.0, 3.0
"""A part counts as off only if changing it, too, makes images and sweeps agree better by this."""

_ALIKE = 0.8
"""A good calibration stands so high, as part of the height of the best one. On simulated drives true ones stand at 0.9
and more, those half a degree or 15 cm off below 0.5."""

_LEAST_SPEED, _LEAST_ROTATION = 1.0, 0.03
"""Slower than this [m/s, rad/s] nothing reports when an image was taken."""


class CalibrationHealth(msgspec.Struct, frozen=True, kw_only=True):
    """What a drive says of a calibration.

    Attributes:
        source: the drive.
        camera_id, lidar_id: whose calibration.
        verdict: of all of it: that of the worst part. Cannot report where the rotation cannot be reported, or where
            another part seems to be off but that may be chance, or where the stated one agrees clearly less than the
            best one.
        items: by part; with boxes of detectors two more, of the rotation that these show.
        frames: images that were looked at.
        views: how many different views they show.
        distinctness: how far the best calibration around stands above chance, in chance's own deviations.
        stated_distinctness: the same of the stated one.
        measures: how far each measure stands above chance, under the stated calibration and under the best one.
        change: what leads from the stated calibration to the best one, as `Change.numbers`; zeros where that cannot be
            reported.
        corrections: what was made of the drive's corrections before; what is judged is what they leave.
    """

    source: str
    camera_id: Identifier
    lidar_id: Identifier
    verdict: Verdict
    items: tuple[Item, ...]
    frames: int
    views: int
    distinctness: float
    stated_distinctness: float
    measures: dict[str, tuple[float, float]]
    change: tuple[float, ...] = (0.0,) * COUNT
    corrections: tuple[DataWarning, ...] = ()

    def item(self, name: str) -> Item:
        """The part of that name."""
        return next(item for item in self.items if item.name == name)

    @property
    def doubted(self) -> bool:
        """Whether images and points agree much better elsewhere, where they report the rotation at all."""
        return bool(self.item("rotation").values) and self.stated_distinctness < _ALIKE * self.distinctness


def check_calibration(
    scene: Scene, camera_id: Identifier | None = None, lidar_id: Identifier | None = None, *, most: int = MOST
) -> CalibrationHealth:
    """Check how a camera is stated to lie to a lidar by what both show.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: images to look at, at most.

    Raises:
        OptionError: there is no such camera or lidar.
        PoseError: it is not known how the camera lies to the lidar.
        DataError: an image or a sweep cannot be read.
    """
    scene = scene.corrected()
    health = check_frames(calibration_frames(scene, camera_id, lidar_id, most), source=scene.source)
    return msgspec.structs.replace(health, corrections=scene.correction_warnings)


def check_frames(frames: Sequence[CalibrationFrame], *, source: str = "frames") -> CalibrationHealth:
    """Check a calibration by frames of one camera and one lidar."""
    views = views_of(frames)
    agreement = Agreement(frames, views)
    nothing = _why_nothing(agreement.features)
    if nothing:
        return _untold(frames, views, source, nothing)
    objective = _Objective(agreement)
    rotation = _find_rotation(objective)
    if rotation.distinctness < _DISTINCT:
        reason = (
            f"no calibration within 6 degrees makes images and sweeps agree better than by chance "
            f"({rotation.distinctness:.1f} deviations; expected {_DISTINCT:g}): it is far off, or they show too little"
        )
        return _untold(frames, views, source, reason, objective, rotation)
    joint = {name: _find_group(objective, rotation.change, group) for name, group in _GROUPS.items()}
    found = _Found(frames, objective, rotation, joint)
    items, standings = found.items(), _standings(objective, found.best)
    return CalibrationHealth(
        source=source,
        camera_id=frames[0].camera_id,
        lidar_id=frames[0].lidar_id,
        verdict=_overall(items, standings),
        items=items,
        frames=len(frames),
        views=int(views.max()) + 1,
        **asdict(standings),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """All that was found, and what it means."""

    frames: Sequence[CalibrationFrame]
    objective: _Objective
    rotation: _Top
    joint: dict[str, _Top]

    @property
    def best(self) -> _Top:
        """The rotation alone, or together with what makes a difference."""
        better = [top for top in self.joint.values() if _is_better(top)]
        return max(better, key=lambda top: top.gain, default=self.rotation)

    def items(self) -> tuple[Item, ...]:
        """Judge all parts."""
        return (
            self._rotation(),
            self._joint("translation"),
            self._joint("focal_length"),
            Item.unknown("principal_point", why_untold(self.frames[0].camera)),
            self._time_offset(),
        )

    def _rotation(self) -> Item:
        best = self.best
        item = judge("rotation", best.change[:3], best.covariance[:3, :3])
        stated = self.objective.stationary(self.objective.agreement.score(Change()))[0]
        if item.verdict is Verdict.GOOD and best is self.rotation and stated < _ALIKE * best.height:
            reason = "images and sweeps agree much better a little away from it"
            return msgspec.structs.replace(item, verdict=Verdict.UNDETERMINED, reason=reason)
        if item.verdict in _WORST_FIRST:
            instead = instead_of_rotation(self.frames[0].camera, best.change[:3])
            return msgspec.structs.replace(item, reason=f"{item.reason}; {instead}" if instead else item.reason)
        return item

    def _joint(self, name: str) -> Item:
        top = self.joint[name]
        item = judge(name, top.change[list(top.parameters[3:])], top.covariance[3:, 3:])
        if item.verdict in {Verdict.DRIFTING, Verdict.WRONG} and not _is_better(top):
            reason = "a change of it does not make images and sweeps agree better"
            return msgspec.structs.replace(item, verdict=Verdict.UNDETERMINED, reason=reason)
        return item

    def _time_offset(self) -> Item:
        twists = [frame.twist_lidar for frame in self.frames if frame.twist_lidar is not None]
        if not twists:
            return Item.unknown("time_offset", "the ego's motion is not known")
        speed = max(float(np.linalg.norm(twist[3:])) for twist in twists)
        rotation = max(float(np.linalg.norm(twist[:3])) for twist in twists)
        if speed < _LEAST_SPEED and rotation < _LEAST_ROTATION:
            return Item.unknown(
                "time_offset", f"the ego hardly moved: {speed:.1f} m/s, {np.degrees(rotation):.1f} deg/s"
            )
        return self._joint("time_offset")


def _is_better(top: _Top) -> bool:
    return top.gain > max(_BETTER, _BETTER_SIGMAS * top.gain_deviation)


def _why_nothing(features: Sequence[FrameFeatures]) -> str:
    """Why frames cannot determine anything of a calibration; "" if they may."""
    if sum(f.seen for f in features) < _LEAST_SEEN:
        seen = sum(f.seen for f in features)
        return f"{seen} points fall into {len(features)} images; expected {_LEAST_SEEN} at least"
    if np.median([f.image.plainness for f in features]) > _PLAIN:
        return "the images show nothing: dark, covered or fogged"
    if sum(len(f.edge_weights) for f in features) < _LEAST_EDGES:
        return "the sweeps show hardly any edges where the camera looks"
    return ""


def views_of(frames: Sequence[CalibrationFrame]) -> Int64Array:
    """Number frames by what they show: those from nearly the same location count as one view, (F,)."""
    views = np.zeros(len(frames), np.int64)
    begun = frames[0].world_from_lidar
    for row, frame in enumerate(frames[1:], start=1):
        here = frame.world_from_lidar
        views[row] = views[row - 1]
        if here is None or begun is None:
            continue
        step = begun.inverse() @ here
        rotation = 2.0 * np.degrees(np.arccos(np.clip(step.quaternion_xyzw[3], -1.0, 1.0)))
        if np.linalg.norm(step.translation) > _OWN_VIEW_M or rotation > _OWN_VIEW_DEG:
            views[row], begun = views[row] + 1, here
    return views


_WORST_FIRST = (Verdict.WRONG, Verdict.DRIFTING)


def _overall(items: Sequence[Item], standings: "_Standings") -> Verdict:
    verdicts = {item.verdict for item in items}
    worst = next((verdict for verdict in _WORST_FIRST if verdict in verdicts), items[0].verdict)
    doubted = standings.stated_distinctness < _ALIKE * standings.distinctness
    if worst is Verdict.GOOD and (doubted or any(item.suspected for item in items)):
        return Verdict.UNDETERMINED
    return worst


@dataclass(frozen=True, slots=True)
class _Standings:
    """How far the stated and the best calibration stand above chance."""

    distinctness: float
    stated_distinctness: float
    measures: dict[str, tuple[float, float]]
    change: tuple[float, ...] = (0.0,) * COUNT


def _standings(objective: _Objective, top: _Top) -> _Standings:
    stated, best = (objective.agreement.score(change) for change in (Change(), Change.of(top.change)))
    pairs = zip(
        MEASURES,
        *(objective.deviations_of(score.values()[None])[0].tolist() for score in (stated, best)),
        strict=True,
    )
    return _Standings(
        objective.distinctness(best),
        objective.distinctness(stated),
        {name: (here, there) for name, here, there in pairs},
        tuple(top.change.tolist()),
    )


def _untold(
    frames: Sequence[CalibrationFrame],
    views: Int64Array,
    source: str,
    reason: str,
    objective: _Objective | None = None,
    top: _Top | None = None,
) -> CalibrationHealth:
    reported = _Standings(0.0, 0.0, {})
    if objective is not None and top is not None:
        reported = replace(_standings(objective, top), change=(0.0,) * COUNT)
    return CalibrationHealth(
        source=source,
        camera_id=frames[0].camera_id,
        lidar_id=frames[0].lidar_id,
        verdict=Verdict.UNDETERMINED,
        items=tuple(Item.unknown(name, reason) for name in PARTS),
        frames=len(frames),
        views=int(views.max()) + 1,
        **asdict(reported),
    )


_OFF = (Verdict.WRONG, Verdict.DRIFTING)


def with_coarse(health: CalibrationHealth, item: Item) -> CalibrationHealth:
    """Add what a coarse measure says: it never makes a calibration good, but it may make it doubtful or wrong.

    Where all else calls the calibration good and it does not, nothing can be reported all of it.
    """
    verdict = health.verdict
    if item.verdict in _OFF:
        if verdict is Verdict.GOOD:
            verdict = Verdict.UNDETERMINED
            item = msgspec.structs.replace(item, reason=f"{item.reason}, but the rest agrees with it")
        elif verdict is not Verdict.WRONG:
            verdict = item.verdict
    return msgspec.structs.replace(health, verdict=verdict, items=(*health.items, item))


MOTION = "motion"
_LEAST_STEPS, _LEAST_ROTATION_DEG = 20, 8.0
_BLOCKS = 10
_ROUNDS = 15


def judge_motion(camera_rotations: Float64Array, lidar_rotations: Float64Array, rotation: Float64Array) -> Item:
    """Judge a rotation by how camera and lidar rotate.

    Args:
        camera_rotations: (N, 3) [rad], rotation vectors from image to image in the camera's axes; NaN where unknown.
        lidar_rotations: (N, 3) [rad], of the same times, in the lidar's axes; NaN where unknown.
        rotation: (3, 3), of `camera_from_lidar` as stated.

    Returns:
        What is to be stated of the two axes across the axis of rotating; the first is the nearest to the camera's x
        axis.
    """
    known = np.isfinite(camera_rotations).all(axis=1) & np.isfinite(lidar_rotations).all(axis=1)
    seen, stated = camera_rotations[known], lidar_rotations[known] @ rotation.T
    size = float(np.degrees(np.linalg.norm(stated, axis=1).sum()))
    if len(seen) < _LEAST_STEPS or size < _LEAST_ROTATION_DEG:
        return Item.unknown(
            MOTION,
            f"{len(seen)} steps in which both are known to rotate, by {size:.1f} deg; expected {_LEAST_STEPS} and "
            f"{_LEAST_ROTATION_DEG:g} deg",
        )
    delta_rotation, covariance, axis = _aligned(seen, stated)
    across = _across(axis)
    return judge(MOTION, across @ delta_rotation, across @ covariance @ across.T)


def _aligned(seen: Float64Array, stated: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """The rotation (3,) from the stated to the observed extrinsics, its covariance (3, 3) and rotation axis (3,)."""
    u, _, vt = np.linalg.svd(seen.T @ stated)
    axis = u[:, 0]
    along = np.outer(axis, axis)
    delta_rotation, weights = _first_rotation(axis, vt[0]), np.ones(len(seen))
    for _ in range(_ROUNDS):
        moved = stated @ matrix_from_quaternion(quaternion_from_rotation_vector(delta_rotation)).T
        slopes = -_cross(moved)
        left = seen - moved
        sizes = np.square(left).sum(axis=1)
        weights = 1.0 / (1.0 + sizes / max(4.0 * float(np.median(sizes)), 1e-16))
        normal = np.einsum("nki,n,nkj->ij", slopes, weights, slopes) + along * float(np.sum(stated**2))
        pulls = np.einsum("nki,n,nk->ni", slopes, weights, left)
        step = quaternion_from_rotation_vector(np.linalg.solve(normal, pulls.sum(axis=0)))
        delta_rotation = rotation_vector_from_quaternion(
            multiply_quaternions(step, quaternion_from_rotation_vector(delta_rotation))
        )
    blocks = np.zeros((_BLOCKS, 3))
    np.add.at(blocks, np.arange(len(seen)) * _BLOCKS // len(seen), pulls)
    inverse = np.linalg.inv(normal)
    return delta_rotation, inverse @ (blocks.T @ blocks) @ inverse * _BLOCKS / (_BLOCKS - 2), axis


def _first_rotation(seen_axis: Float64Array, stated_axis: Float64Array) -> Float64Array:
    """The smallest rotate, (3,), that takes one axis to the other."""
    normal = np.cross(stated_axis, seen_axis)
    sine, cosine = float(np.linalg.norm(normal)), float(stated_axis @ seen_axis)
    if sine < 1e-9:
        return np.zeros(3) if cosine > 0 else np.pi * _across(seen_axis)[0]
    delta_rotation: Float64Array = normal / sine * np.arctan2(sine, cosine)
    return delta_rotation


def _across(axis: Float64Array) -> Float64Array:
    """Two directions, (2, 3), across an axis; the first is the nearest to x, or to z where the axis is near x."""
    near = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 0.0, 1.0])
    first = near - axis * (near @ axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(first, axis)])


def _cross(vectors: Float64Array) -> Float64Array:
    """Matrices, (N, 3, 3), that take a vector w to v x w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


_ACROSS, _ABOUT_VISIBILITY = "boxes", "boxes_roll"
"""Rotations about the camera's x and y axes, and about its optical axis, which boxes determine less well."""

_LEAST_AGREEING, _LEAST_IMAGES, _ABOVE_CHANCE = 40, 10, 2.0
"""So many couples must agree, in so many images, and so many times as many as about other rotations: boxes of other
images reach 35, and less than twice as many."""


def judge_boxes(found: BoxRotation | None) -> tuple[Item, Item]:
    """Judge the rotation that boxes of images and sweeps show.

    Args:
        found: the rotation; None where hardly any boxes may be of one object.

    Returns:
        What is to be stated of the camera's x and y axes, and of its optical axis.
    """
    reason = _why_untold(found)
    if found is None or reason:
        return Item.unknown(_ACROSS, reason), Item.unknown(_ABOUT_VISIBILITY, reason)
    return (
        judge(_ACROSS, found.rotation[:2], found.covariance[:2, :2]),
        judge(_ABOUT_VISIBILITY, found.rotation[2:], found.covariance[2:, 2:]),
    )


def _why_untold(found: BoxRotation | None) -> str:
    if found is None:
        return "hardly any boxes of images and sweeps may be of one object"
    if found.agreeing < _LEAST_AGREEING or found.images < _LEAST_IMAGES:
        return (
            f"{found.agreeing} couples of boxes in {found.images} images come together about one rotation; "
            f"expected {_LEAST_AGREEING} in {_LEAST_IMAGES}"
        )
    if found.agreeing < _ABOVE_CHANCE * found.by_chance:
        return (
            f"{found.agreeing} couples of boxes come together about one rotation, {found.by_chance} about another; "
            f"expected {_ABOVE_CHANCE:g} times as many"
        )
    return ""


def health_of_boxes(
    found: BoxRotation | None, *, source: str, camera_id: Identifier, lidar_id: Identifier, frames: int
) -> CalibrationHealth:
    """Check a calibration by boxes alone, where there are neither images nor points.

    Args:
        frames: images whose boxes were looked at.
    """
    nothing = "there are neither images nor points to look at, but boxes alone"
    untold = CalibrationHealth(
        source=source,
        camera_id=camera_id,
        lidar_id=lidar_id,
        verdict=Verdict.UNDETERMINED,
        items=tuple(Item.unknown(name, nothing) for name in PARTS),
        frames=frames,
        views=0,
        distinctness=0.0,
        stated_distinctness=0.0,
        measures={},
    )
    return with_boxes(untold, found)


def with_boxes(health: CalibrationHealth, found: BoxRotation | None) -> CalibrationHealth:
    """Add what boxes state to what images and points state.

    Boxes decide where images and points cannot determine. Where both report, and one calls good what the other clearly
    does not, nothing can be reported all of it.
    """
    boxes = judge_boxes(found)
    reason = _contradiction(health, boxes)
    verdict = Verdict.UNDETERMINED if reason else _together(health, boxes)
    if reason:
        boxes = (msgspec.structs.replace(boxes[0], reason=reason), boxes[1])
    return msgspec.structs.replace(health, verdict=verdict, items=(*health.items, *boxes))


def _together(health: CalibrationHealth, boxes: Sequence[Item]) -> Verdict:
    reported = {health.verdict, *(item.verdict for item in boxes)}
    worst = next((verdict for verdict in _OFF if verdict in reported), None)
    if worst is not None:
        return worst
    if health.verdict is Verdict.UNDETERMINED and (health.doubted or any(i.suspected for i in health.items)):
        return Verdict.UNDETERMINED
    return Verdict.GOOD if Verdict.GOOD in {health.verdict, boxes[0].verdict} else Verdict.UNDETERMINED


def _contradiction(health: CalibrationHealth, boxes: Sequence[Item]) -> str:
    """Why images and boxes cannot both be right; "" if they can."""
    off = [item for item in boxes if item.verdict in _OFF]
    if health.verdict is Verdict.GOOD and off:
        return f"{off[0].reason}, but images and points agree with it"
    rotation = health.item("rotation")
    if rotation.verdict in _OFF and boxes[0].verdict is Verdict.GOOD and _differ(rotation, boxes[0]):
        return f"boxes agree with it, but {rotation.reason}"
    return ""


def _differ(rotation: Item, across: Item) -> bool:
    """Whether two rotations about the axes across are more than chance apart."""
    apart = np.subtract(rotation.values[:2], across.values)
    variances = np.square(rotation.sigmas[:2]) + np.square(across.sigmas)
    far = float(np.linalg.norm(apart)) > _LIMITS[_ACROSS].good
    return far and float(np.sum(apart**2 / variances)) > _SIGNIFICANT
