"""Rules about steps from pose to pose."""

import numpy as np
import pytest

from sceneloom.checks import validate

RULES = ["pose-steps", "pose-rotations", "poses-jump", "poses-rotation"]


@pytest.fixture
def findings(written):
    """What rules about steps state of a drive, those of scenes included."""

    def run(drive):
        return [(f.rule, f.path, f.message) for f in validate(written(drive), rules=RULES).findings]

    return run


def rotated(line, degrees):
    half = np.radians(degrees) / 2
    rotation = {"x": 0.0, "y": 0.0, "z": float(np.sin(half)), "w": float(np.cos(half))}
    return {**line, "groundTruth": {**line["groundTruth"], "orientation": rotation}}


def test_a_pose_that_is_off_is_reported_once_with_its_line(findings, drive, written, line_of):
    wrong = drive.streams["groundTruth"][50]
    wrong["groundTruth"]["position"]["y"] = 30.0
    [(rule, location, message)] = findings(drive)
    assert (rule, location) == ("pose-steps", line_of(written(drive), wrong))
    assert message.startswith("groundTruth at 3.500000 s is 30.00 m from the pose 0.050 s before, 600.1 m/s")


def test_nothing_moves_at_two_hundred_metres_a_second(findings, drive):
    for k, line in enumerate(drive.streams["groundTruth"]):
        line["groundTruth"]["position"]["x"] = 10.0 * k
    assert {rule for rule, _, _ in findings(drive)} == {"pose-steps"}


def test_starting_and_braking_hard_are_no_jumps(findings, drive):
    for k, line in enumerate(drive.streams["groundTruth"]):
        line["groundTruth"]["position"]["x"] = 0.5 * 9.0 * max(k / 20 - 4.0, 0.0) ** 2
    assert findings(drive) == []


def test_a_pose_that_is_rotated_is_reported_once_with_its_line(findings, drive, written, line_of):
    stream = drive.streams["groundTruth"]
    stream[:] = [rotated(line, 90.0 * np.sin(k / 40)) for k, line in enumerate(stream)]
    assert findings(drive) == []
    stream[30] = rotated(stream[30], 175.0)
    [(rule, location, _)] = findings(drive)
    assert (rule, location) == ("pose-rotations", line_of(written(drive), stream[30]))


def test_a_single_torn_yaw_rate_does_not_speak_against_the_poses(written, drive):
    angles = np.degrees(0.8 * np.sin(0.9 * np.array(drive.times(20.0))))
    stream = drive.streams["groundTruth"]
    stream[:] = [rotated(line, angle) for line, angle in zip(stream, angles.tolist(), strict=True)]
    for line in drive.streams["gyroscope"]:
        line["sensor"]["values"] = [0.0, 0.0, 0.8 * 0.9 * float(np.cos(0.9 * line["time"]))]
    drive.streams["gyroscope"][400]["sensor"]["values"] = [99.0, 0.0, 0.0]
    rules = ["gyroscope-scale", "poses-clock", "poses-against-gyroscope", "gyroscope-range"]
    assert [f.rule for f in validate(written(drive), rules=rules).findings] == ["gyroscope-range"]
