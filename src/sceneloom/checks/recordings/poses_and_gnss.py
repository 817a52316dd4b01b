"""Rules about trajectories that do not agree with the fixes of the satellites: far off, mirrored, of another scale."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.motion.gnss_receivers import usable_fixes
from sceneloom.scene.findings import Severity
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Trajectory

NEAREST_REPORTED = 5.0
"""Fixes within this distance [m] of a trajectory agree with it, whatever they claim: antennas sit elsewhere."""
_ACCURACIES = 4.0
"""And those within so many times the accuracy that they claim,"""
_DRIFT = 0.01
"""and within this part of the trajectory: odometry drifts."""
_FEWEST_FIXES = 10
_LEAST_SPREAD = 5.0
_USUAL_ACCURACY = 5.0
_CLEARLY = 0.3
"""A mirrored trajectory fits better if it leaves less than this part of the distance."""
_MIRRORED_REPORTED = 2.0
"""Trajectories less bent [m] have no left and right."""
_HEIGHTS_REPORT = 3.0
_ROTATED_HEIGHTS = -0.7


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """A trajectory and the fixes during it, locations along the ground as complex numbers [m].

    Attributes:
        fixes: (M,) complex, east and north.
        ups: (M,) height of the fixes.
        seconds: (M,) of the fixes, counted from the trajectory's first pose.
        trajectory: the trajectory.
        tolerance: so far apart they still agree.
        vertical: accuracy of the heights.
    """

    fixes: np.ndarray[tuple[int], np.dtype[np.complex128]]
    ups: Float64Array
    seconds: Float64Array
    trajectory: Trajectory
    tolerance: float
    vertical: float

    def locations(self) -> "np.ndarray[tuple[int], np.dtype[np.complex128]]":
        """Where the trajectory was at the time of each fix: (N,) x + iy [m], world."""
        return np.asarray(self._at(0) + 1j * self._at(1))

    def heights(self) -> Float64Array:
        """How high the trajectory was at the time of each fix, (N,) [m]."""
        return self._at(2)

    def _at(self, axis: int) -> Float64Array:
        seconds = (self.trajectory.timestamps_ns - self.trajectory.timestamps_ns[0]) / 1e9
        return np.interp(self.seconds, seconds, self.trajectory.positions[:, axis])


def _cases(subject: Subject) -> Iterator[_Case]:
    receivers = [s for s in subject.scene.sensors if isinstance(s, GnssSensor)]
    if not receivers or not len(receivers[0].timestamps_ns):
        return
    receiver = receivers[0]
    # a fix at 0, 0 before reception would else be the location from which all are seen
    usable = usable_fixes(receiver) & np.isfinite(receiver.positions_lla).all(axis=1)
    for trajectory in subject.scene.trajectories.values():
        during = usable & (receiver.timestamps_ns >= trajectory.timestamps_ns[0])
        rows = np.flatnonzero(during & (receiver.timestamps_ns <= trajectory.timestamps_ns[-1]))
        if len(rows) < _FEWEST_FIXES:
            continue
        enu = enu_from_geodetic(receiver.positions_lla[rows], receiver.positions_lla[rows[0]])
        length = float(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum())
        accuracy = _usual(receiver.accuracies[rows])
        case = _Case(
            fixes=enu[:, 0] + 1j * enu[:, 1],
            ups=enu[:, 2],
            seconds=(receiver.timestamps_ns[rows] - trajectory.timestamps_ns[0]) / 1e9,
            trajectory=trajectory,
            tolerance=max(NEAREST_REPORTED, _ACCURACIES * accuracy),
            vertical=_usual(receiver.vertical_accuracies[rows]),
        )
        reach = _DRIFT * min(length, float(np.abs(np.diff(case.fixes)).sum()))
        yield _Case(case.fixes, case.ups, case.seconds, trajectory, case.tolerance + reach, case.vertical)


def _usual(accuracies: Float64Array) -> float:
    known = accuracies[np.isfinite(accuracies)]
    return float(np.median(known)) if len(known) else _USUAL_ACCURACY


def _fit(case: _Case, *, mirrored: bool = False) -> float:
    """Distance [m] of half of the fixes once the trajectory is laid onto them by a rotation and a translation.

    It is laid once more without the farthest ones.
    """
    locations = case.locations()
    trajectories = np.conj(locations) if mirrored else locations
    kept = np.ones(len(trajectories), np.bool_)
    for _ in range(2):
        wanted, given = case.fixes - case.fixes[kept].mean(), trajectories - trajectories[kept].mean()
        product = np.vdot(given[kept], wanted[kept])
        rotation = product / np.abs(product) if product else 1.0
        away = np.abs(wanted - rotation * given)
        kept = away <= 3.0 * np.median(away) + 1e-9
    return float(np.median(away))


def _far_apart(subject: Subject) -> Iterator[Hit]:
    for case in _cases(subject):
        spread = float(min(np.abs(case.fixes - case.fixes.mean()).max(), np.inf))
        moved = float(np.abs(case.locations() - case.locations().mean()).max())
        if max(spread, moved) < max(_LEAST_SPREAD, 2.0 * case.tolerance):
            continue
        away, mirrored = _fit(case), _fit(case, mirrored=True)
        # so much better that no drift explains it, though both may be near
        is_mirrored = mirrored < _CLEARLY * away and away > _MIRRORED_REPORTED
        if away <= case.tolerance and not is_mirrored:
            continue
        reported = (
            f"rotated and shifted as well as can be, half of the fixes lie more than {away:.1f} m off; "
            f"expected {case.tolerance:.1f} m at most"
        )
        if is_mirrored:
            reported += f", and it is {mirrored:.1f} m if x and y are exchanged, or one is negated (mirrored)"
        yield Hit(f"trajectories[{case.trajectory.name}]", reported)


def _upside_down(subject: Subject) -> Iterator[Hit]:
    for case in _cases(subject):
        ups, heights = case.ups - case.ups.mean(), case.heights() - case.heights().mean()
        if ups.std() < max(_HEIGHTS_REPORT * case.vertical, _LEAST_SPREAD) or heights.std() == 0:
            continue
        correlation = float((ups * heights).mean() / (ups.std() * heights.std()))
        if correlation < _ROTATED_HEIGHTS:
            reported = f"z falls where the fixes climb (correlation {correlation:.2f}): probably z of the world points down"
            yield Hit(f"trajectories[{case.trajectory.name}]", reported)


RULES: tuple[Rule, ...] = (
    Rule(
        "poses-against-gnss",
        Severity.WARNING,
        f"Trajectories lie along the fixes of the satellites, within {NEAREST_REPORTED:g} m or {_ACCURACIES:g} times "
        f"their "
        f"accuracy, and {_DRIFT:.0%} of the trajectory.",
        "Write positions in metres, in a right-handed world whose z points up, on the clock of the fixes.",
        find=_far_apart,
    ),
    Rule(
        "heights-against-gnss",
        Severity.WARNING,
        "Trajectories climb where the altitudes of the fixes do.",
        "Write positions in a world whose z points up.",
        find=_upside_down,
    ),
)
