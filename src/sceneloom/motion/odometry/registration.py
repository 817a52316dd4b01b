"""Fitting a sweep onto the map: pose and motion together, so that the sweep is deskewed by what is being found."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.kernels.scan_matching import accumulate_normal_equations
from sceneloom.motion.odometry.local_map import LocalMap
from sceneloom.motion.odometry.motion_state import MotionState

_MOST_STEPS = 20
_SCALES = (10.0, 5.0, 3.0)
"""Of the weight, in standard deviations, in the first steps and from then on."""
_ROTATION_DONE, _SHIFT_DONE = 2e-5, 5e-4
"""A step below these [rad], [m] is the last one."""
POINTS_PER_MEASUREMENT = 10.0
"""Neighbouring points share the errors of the surface they lie on; so many count as one."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """What fitting a sweep gave.

    Attributes:
        state: pose and motion, with their covariance given the map.
        information: (6, 6) of the pose by the sweep alone.
        matched: share of the points that met a surface.
        agreeing: share of those that lie on it, within 3 standard deviations.
        steps: how many were made.
    """

    state: MotionState
    information: Float64Array
    matched: float
    agreeing: float
    steps: int


def fit_sweep(
    points_ego: Float64Array, seconds: Float64Array, prior: MotionState, local_map: LocalMap
) -> Fit:
    """Find the state that agrees best with the prior and with the map.

    Args:
        points_ego: (N, 3) float64 [m], each as measured at its own time.
        seconds: (N,) float64, times after the prior's.

    Source: Bell and Cathey 1993: the iterated Kalman filter's update is this Gauss-Newton optimisation.
    """
    prior_information = np.linalg.inv(prior.covariance)
    state, count = prior, len(points_ego)
    fine, coarse = local_map.fine, local_map.coarse
    points_world, arms = np.empty((count, 3)), np.empty((count, 3))
    information, gradient, sums = np.empty((3, 6, 6)), np.empty((2, 6)), np.empty(4)
    for step in range(_MOST_STEPS):
        state.move(points_ego, seconds, points_world, arms)
        accumulate_normal_equations(
            points_world,
            arms,
            seconds,
            _SCALES[min(step, len(_SCALES) - 1)],
            fine.leaf,
            fine.table,
            fine.keys,
            fine.surfaces,
            coarse.leaf,
            coarse.table,
            coarse.keys,
            coarse.surfaces,
            information,
            gradient,
            sums,
        )
        measured = np.block([[information[0], information[1]], [information[1], information[2]]])
        total = measured / POINTS_PER_MEASUREMENT + prior_information
        slope = gradient.ravel() / POINTS_PER_MEASUREMENT + prior_information @ state.minus(prior)
        change = np.asarray(-np.linalg.solve(total, slope), np.float64)
        state = state.changed(change)
        if (
            step >= len(_SCALES) - 1
            and np.linalg.norm(change[:3]) < _ROTATION_DONE
            and np.linalg.norm(change[3:6]) < _SHIFT_DONE
        ):
            break
    covariance = np.linalg.inv(total)
    return Fit(
        replace(state, covariance=0.5 * (covariance + covariance.T)),
        information[0] / POINTS_PER_MEASUREMENT,
        sums[0] / max(count, 1),
        sums[3] / max(sums[0], 1.0),
        step + 1,
    )
