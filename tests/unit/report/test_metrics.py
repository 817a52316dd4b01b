"""Comparisons with the truth: known shifts come back as errors."""

from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.errors import DataError
from sceneloom.report.trajectory import Metrics
from sceneloom.scene import Scene, Trajectory


def trajectories(scene: Scene) -> Scene:
    """The drive's true trajectory, and one whose heights wave by 20 cm."""
    angles = np.linspace(0.0, 3.0, 60)
    locations = np.column_stack([20 * np.sin(angles), 20 * np.cos(angles), np.zeros(60)])
    still = np.tile([0.0, 0.0, 0.0, 1.0], (60, 1))
    truth = Trajectory("groundTruth", np.arange(60) * 100_000_000, locations, still)
    waves = truth.positions.copy()
    waves[:, 2] += 0.2 * np.where(np.arange(len(waves)) % 2, 1.0, -1.0)
    odd = Trajectory("odd", truth.timestamps_ns, waves, truth.quaternions_xyzw)
    return replace(scene, trajectories={"odd": odd, "groundTruth": truth})


def test_every_way_is_held_against_the_true_one(short):
    (found,) = Metrics.of(trajectories(short), source=None, truth=None).trajectories
    assert (found.estimate, found.reference) == ("odd", "groundTruth")
    assert found.absolute.vertical.rms == pytest.approx(
        0.2, rel=0.01
    )  # the alignment takes next to nothing off


def test_a_truth_beside_the_drive_gives_tracks_and_ways(short, tmp_path):
    few = replace(short, sensors=())
    sceneloom.write(few, tmp_path / "found.sfs")
    sceneloom.write(few, tmp_path / "true.sfs")
    found = Metrics.of(few, source=tmp_path / "found.sfs", truth=tmp_path / "true.sfs")
    assert all(scores.combined.hota.hota == pytest.approx(1.0) for scores in found.tracks.classes.values())


@pytest.mark.parametrize(("trajectory", "problem"), [("lidar", "has no trajectory"), ("gnss", "gnss")])
def test_what_is_to_be_compared_and_cannot_be_is_an_error(short, trajectory, problem):
    scene = replace(short, trajectories={}) if trajectory == "lidar" else trajectories(short)
    with pytest.raises(DataError, match=rf"{problem}.*leave `--compare {trajectory}` out"):
        Metrics.of(scene, source=None, truth=None, compare=(trajectory,))
