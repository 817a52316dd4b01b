"""Trajectories against ones that are known as formulas, and comparisons with the truth."""

from dataclasses import replace

import numpy as np
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.errors import DataError
from sceneloom.report.trajectory import MOST_CORNERS, Metrics, Trajectories
from sceneloom.scene import GnssSensor, Scene, Trajectory

RADIUS, SPEED, SECONDS = 40.0, 8.0, 20.0


def circle(count=401):
    """A part of a circle at a constant speed, rising by 2 m; the ego looks ahead."""
    t = np.linspace(0.0, SECONDS, count)
    angle = SPEED * t / RADIUS
    locations = np.column_stack([RADIUS * np.sin(angle), RADIUS * (1 - np.cos(angle)), 0.1 * t])
    rotations = Rotation.from_euler("z", angle[:, None]).as_quat()
    return Trajectory("trajectory", np.rint(t * 1e9).astype(np.int64), locations, rotations)


def fixes(trajectory, north_deg):
    """What a receiver on the ego reports where north lies so much counter-clockwise from the world's x axis."""
    north = np.radians(north_deg)
    x, y, z = trajectory.positions.T
    along_north = x * np.cos(north) + y * np.sin(north)
    along_east = x * np.sin(north) - y * np.cos(north)
    lla = np.column_stack(pymap3d.enu2geodetic(along_east, along_north, z, 52.5, 13.4, 40.0))
    accuracies = np.full(len(lla), 0.5)
    return GnssSensor("gnss", trajectory.timestamps_ns, lla, accuracies, accuracies)


def test_length_speed_rotation_and_climb_are_those_of_the_formula_or_of_what_stands():
    (found,) = Trajectories.of(Scene((), trajectories={"trajectory": circle()}), start_ns=0).trajectories
    # the trajectory rises by 0.1 m/s beside 8 m/s; chords of 0.05 s are 1e-6 shorter than arcs
    length = np.hypot(SPEED, 0.1) * SECONDS
    assert found.metres == pytest.approx(length, rel=1e-4)
    assert found.mean_speed == pytest.approx(length / SECONDS, rel=1e-4)
    # over half a second the chord is 0.05 % shorter than the arc
    assert found.top_speed == pytest.approx(SPEED, rel=2e-3)
    assert found.rotated_deg == pytest.approx(np.degrees(SPEED * SECONDS / RADIUS), rel=1e-3)
    assert (found.climb, found.descent) == (pytest.approx(2.0, abs=0.06), 0.0)  # steps below 5 cm are noise
    assert found.farthest == pytest.approx(2 * RADIUS, rel=1e-3)
    assert found.stationary_share == 0.0
    trajectory = replace(circle(), positions=np.tile([5.0, 6.0, 7.0], (401, 1)))
    (found,) = Trajectories.of(Scene((), trajectories={"trajectory": trajectory}), start_ns=0).trajectories
    assert (found.stationary_share, found.metres, found.mean_speed) == (1.0, 0.0, 0.0)
    (found,) = Trajectories.of(Scene((), trajectories={"trajectory": circle(20_001)}), start_ns=0).trajectories
    assert len(found.corners) <= MOST_CORNERS
    assert found.corners[-1].seconds == SECONDS
    assert Trajectories.of(Scene(()), start_ns=0).trajectories == ()


@pytest.mark.parametrize("north_deg", [90.0, 25.0, -140.0])
def test_north_is_found_from_the_fixes(north_deg):
    trajectory = circle()
    scene = Scene((fixes(trajectory, north_deg),), trajectories={"trajectory": trajectory})
    found = Trajectories.of(scene, start_ns=0)
    assert (found.north.direction_deg - north_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=0.01)
    assert found.north.rms < 0.01
    assert found.fixes[0].first_lla == pytest.approx((52.5, 13.4, 40.0))
    assert found.fixes[0].accuracy_m == 0.5


def test_north_is_taken_as_the_scene_states_it_and_not_known_of_an_ego_that_stands():
    trajectory = circle()
    stated = {"sceneloom": {"enu_origin": {"latitude": 52.5, "longitude": 13.4, "altitude": 40.0}}}
    known = fixes(trajectory, 90.0)
    scene = Scene((known,), trajectories={"trajectory": trajectory}, metadata=stated)
    found = Trajectories.of(scene, start_ns=0).north
    assert (found.direction_deg, found.rms) == (90.0, None)
    assert found.shift == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    still = replace(trajectory, positions=np.zeros_like(trajectory.positions))
    assert Trajectories.of(Scene((fixes(still, 90.0),), trajectories={"trajectory": still}), start_ns=0).north is None
    # fixes without reception are no locations
    lla = known.positions_lla.copy()
    lla[:100, :2] = 0.0
    found = Trajectories.of(Scene((replace(known, positions_lla=lla),)), start_ns=0)
    assert (found.fixes[0].usable, found.fixes[0].count) == (301, 401)


def test_a_drive_is_held_against_its_true_trajectory_and_a_truth_beside_it(short, tmp_path):
    angles, still = np.linspace(0.0, 3.0, 60), np.tile([0.0, 0.0, 0.0, 1.0], (60, 1))
    locations = np.column_stack([20 * np.sin(angles), 20 * np.cos(angles), np.zeros(60)])
    truth = Trajectory("groundTruth", np.arange(60) * 100_000_000, locations, still)
    waves = locations + np.outer(np.where(np.arange(60) % 2, 0.2, -0.2), [0, 0, 1])
    odd = replace(truth, name="odd", positions=waves)
    scene = replace(short, trajectories={"odd": odd, "groundTruth": truth})
    (found,) = Metrics.of(scene, source=None, truth=None).trajectories
    assert (found.estimate, found.reference) == ("odd", "groundTruth")
    assert found.absolute.vertical.rms == pytest.approx(0.2, rel=0.01)  # the alignment takes next to nothing off
    few, paths = replace(short, sensors=()), [tmp_path / "found.sfs", tmp_path / "true.sfs"]
    for path in paths:
        sceneloom.write(few, path)
    found = Metrics.of(few, source=paths[0], truth=paths[1])
    assert all(scores.combined.hota.hota == pytest.approx(1.0) for scores in found.tracks.classes.values())
    bare = replace(short, trajectories={})
    for compared, way, problem in ((bare, "lidar", "has no trajectory"), (scene, "gnss", "gnss")):
        with pytest.raises(DataError, match=rf"{problem}.*leave `--compare {way}` out"):
            Metrics.of(compared, source=None, truth=None, compare=(way,))
