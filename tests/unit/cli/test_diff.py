"""`sceneloom diff`: its exit codes, and what it prints for people and for machines."""

import json
from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.scene import LazyFrames
from sceneloom.simulate import LidarSpec, simulate_street


def raised(scene, metres):
    """The scene with the points of its second sweep raised."""
    lidar = scene.lidars[0]
    frames = list(lidar.frames)
    points = frames[1].points
    higher = replace(points, positions=points.positions + np.float32([0, 0, metres]))
    frames[1] = replace(frames[1], points=higher)
    moved = replace(lidar, frames=LazyFrames.of(frames, lidar.frames.timestamps_ns.tolist()))
    return replace(scene, sensors=tuple(moved if s is lidar else s for s in scene.sensors))


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    scene = simulate_street(1, frames=2, lidar=LidarSpec(beams=8, steps=90), cameras=()).scene
    folder = tmp_path_factory.mktemp("drives")
    sceneloom.write(scene, folder / "a.sfs")
    sceneloom.write(raised(scene, 0.25), folder / "b.sfs")
    return folder / "a.sfs", folder / "b.sfs"


def test_equal_drives_exit_with_zero_and_drives_that_differ_with_one_and_state_where(call, refuses, succeeds, drives):
    assert succeeds("diff", drives[0], drives[0]).out == "equal\n"
    assert succeeds("diff", *drives, "--tolerance-m", "0.3")
    outcome = call("diff", *drives)
    first, *_, last = outcome.out.splitlines()
    assert first.startswith("~ sensors['lidar'].frames[].points.positions: changed by 0.25 m in 1 frame, most in")
    assert (outcome.code, last) == (1, "1 difference")
    outcome = call("diff", *drives, "--json")
    report = json.loads(outcome.out)
    assert (outcome.code, report["equal"], len(report["differences"])) == (1, False, 1)
    assert report["differences"][0]["amount"] == pytest.approx(0.25, abs=1e-5)
    refuses(2, "", "diff", *drives, "--tolerance-m", "-1")
    refuses(2, "", "diff", drives[0])
    refuses(1, "", "diff", drives[0], drives[0].with_name("none.sfs"))
