"""Normal equations of a chain of motion states against differences of their cost."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.geometry.rotations import matrix_from_quaternion, quaternion_from_rotation_vector
from sceneloom.motion.gnss_imu.measurements import Fixes, InertialSamples, SmootherSettings
from sceneloom.motion.gnss_imu.smoother import (
    BodySpeeds,
    Chain,
    RelativePoses,
    States,
    equations,
    inertial_residuals,
    step,
)

COUNT = 5
WEIGHTS = np.array([1.0, 0.5, 1.0])


def rotated(rng: np.random.Generator, size: float, count: int) -> np.ndarray:
    return matrix_from_quaternion(quaternion_from_rotation_vector(size * rng.standard_normal((count, 3))))


def made_up_chain(rng: np.random.Generator, parts: str) -> Chain:
    knots = np.array([0, 400, 1000, 1300, 2000]) * 1_000_000
    times = np.arange(0, 2_000_000_001, 10_000_000)
    values = np.hstack([0.3 * rng.standard_normal((201, 3)), rng.standard_normal((201, 3))])
    values[:, 5] += 9.8
    samples = InertialSamples(times, values, np.empty((0, 2), np.int64))
    inertial = samples.preintegrated(knots, biases=np.zeros((4, 6)), densities=np.tile([1e-4, 1e-2], (4, 1)))
    locations, seconds = np.array([0, 2, 4]), np.array([0.3, 0.0, -0.01])
    fixes = Fixes(
        knots[locations] + np.int64(seconds * 1e9), locations, seconds, rng.standard_normal((3, 3)),
        rng.standard_normal((3, 3)), np.array([0.44, 0.0, 0.0]), rng.standard_normal((3, 3, 6)),
        0.02 * rng.standard_normal((3, 6)), rng.uniform(0.5, 2.0, (3, 3)), np.zeros(3, np.int64),
    )  # fmt: skip
    spread = rng.standard_normal((2, 6, 6))
    relative = RelativePoses(
        np.array([1, 3]), rotated(rng, 0.5, 2), rng.standard_normal((2, 3)),
        spread @ spread.swapaxes(1, 2) + np.eye(6),
    )  # fmt: skip
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    speeds = BodySpeeds(np.array([1, 4]), axes, np.array([0.0, 0.7]), np.array([0.3, 0.4]))
    chain = Chain(
        knots, np.array([True, "i" in parts, False, True]), inertial, fixes, 9.8, SmootherSettings()
    )
    if "i" not in parts:
        chain = replace(chain, measured=np.zeros(4, np.bool_))
    return replace(
        chain, relative=(relative,) if "r" in parts else (), speeds=(speeds,) if "s" in parts else ()
    )


def made_up_states(rng: np.random.Generator) -> States:
    return States(
        rotated(rng, 0.7, COUNT),
        rng.standard_normal((COUNT, 3)),
        rng.standard_normal((COUNT, 3)),
        0.02 * rng.standard_normal((COUNT, 6)),
    )


@pytest.mark.parametrize("parts", ["", "i", "r", "s", "irs"])
def test_the_right_side_is_half_the_falling_slope_of_the_cost(parts):
    rng = np.random.default_rng(len(parts))
    chain, states = made_up_chain(rng, parts), made_up_states(rng)
    here = equations(chain, states, WEIGHTS)
    size = 1e-6
    for row in range(COUNT):
        for column in range(15):
            move = np.zeros((COUNT, 15))
            move[row, column] = size
            up, down = (equations(chain, states.stepped(s * move), WEIGHTS).cost for s in (1, -1))
            # costs of some 1e5 leave 1e-11 of them, over 2e-6, to rounding
            assert -(up - down) / (4 * size) == pytest.approx(
                here.right[row, column], rel=1e-4, abs=1e-5 * here.cost + 1e-3
            )


def test_whitened_slopes_of_the_imu_make_up_its_normal_equations():
    rng = np.random.default_rng(3)
    chain, states = made_up_chain(rng, "i"), made_up_states(rng)
    # close to what was measured, where leaving out the second order of the rotation does not matter
    for _ in range(30):
        states = step(chain, states, WEIGHTS, 0.0).states
    here = equations(chain, states, WEIGHTS)
    residuals, first, second = inertial_residuals(chain, states)
    for k in np.flatnonzero(chain.measured):
        coupling = first[k].T @ chain.information[k] @ second[k]
        assert np.allclose(
            coupling[:9, :9], here.couplings[k][:9, :9], rtol=1e-2, atol=1e-2 * np.abs(coupling).max()
        )
        assert residuals[k] @ chain.information[k] @ residuals[k] <= here.cost


def test_steps_lead_to_where_no_direction_leads_down():
    rng = np.random.default_rng(4)
    chain, states = made_up_chain(rng, "irs"), made_up_states(rng)
    before, damping = equations(chain, states, WEIGHTS).cost, 1e-4
    for _ in range(60):
        gone = step(chain, states, WEIGHTS, damping)
        states, damping = gone.states, gone.damping
    after = equations(chain, states, WEIGHTS)
    assert after.cost < before
    solution = np.abs(after.right).max(axis=0) / np.sqrt(np.abs(after.blocks).max(axis=(0, 1)))
    assert solution.max() < 1e-2 * np.sqrt(after.cost)


def test_a_part_of_a_chain_holds_what_was_measured_in_it():
    chain = made_up_chain(np.random.default_rng(5), "irs").part(1, 4)
    assert len(chain.knots_ns) == 3
    assert chain.fixes.locations.tolist() == [1]
    assert chain.relative[0].locations.tolist() == [0]
    assert chain.speeds[0].locations.tolist() == [0]
    assert len(chain.inertial.rotations) == 2
