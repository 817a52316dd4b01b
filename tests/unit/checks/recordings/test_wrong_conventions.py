"""Conventions that are wrong in a simulated drive, injected in the lines of its recording, are found."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import write
from sceneloom.checks import validate
from sceneloom.simulate import GnssSpec, ImuSpec, LidarSpec, simulate_street

RULES = (
    "poses-against-gravity",
    "poses-against-gyroscope",
    "gyroscope-scale",
    "poses-clock",
    "poses-against-gnss",
    "heights-against-gnss",
)
NORTH_EAST_DOWN = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLIP = np.diag([1.0, -1.0, 1.0])
CAMERA = {
    "model": "pinhole",
    "focalLengthX": 300,
    "focalLengthY": 300,
    "principalPointX": 160,
    "principalPointY": 100,
    "imageWidth": 320,
    "imageHeight": 200,
    "imuToCamera": [[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, -1], [0, 0, 0, 1]],
}
CAMERA_FROM_IMU = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """The lines of 14 s of driving through bends, with IMU, fixes and the true poses; without images and points."""
    scene = simulate_street(
        3,
        frames=140,
        lidar=LidarSpec(beams=4, steps=60),
        cameras=(),
        imu=ImuSpec(rate_hz=100.0),
        gnss=GnssSpec(rate_hz=5.0),
        trajectory_hz=25.0,
    ).scene
    numbers = replace(scene, sensors=tuple(s for s in scene.sensors if s.id in {"imu", "gnss"}))
    folder = tmp_path_factory.mktemp("drive") / "recording"
    write(numbers, folder)
    return [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]


@pytest.fixture
def found(lines, tmp_path):
    """What the rules state of the lines after something was done to each."""

    def run(injected):
        changed = sorted((injected(json.loads(json.dumps(line))) for line in lines), key=lambda x: x["time"])
        folder = tmp_path / "injected"
        folder.mkdir()
        (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in changed))
        (folder / "calibration.json").write_text(json.dumps({"cameras": [CAMERA]}))
        return {finding.rule: finding.message for finding in validate(folder, rules=RULES).findings}

    return run


def poses(change):
    """Change position and rotation of every true pose; the change gives the four numbers as they are written."""

    def injected(line):
        if "groundTruth" in line:
            pose = line["groundTruth"]
            position = np.array([pose["position"][k] for k in "xyz"])
            rotation = Rotation.from_quat([pose["orientation"][k] for k in "xyzw"])
            position, quaternion = change(position, rotation)
            pose["position"] = dict(zip("xyz", map(float, position), strict=True))
            pose["orientation"] = dict(zip("xyzw", map(float, quaternion), strict=True))
        return line

    return injected


def samples(kind, change):
    """Change the values of every sample of a sensor."""

    def injected(line):
        if line.get("sensor", {}).get("type") == kind:
            line["sensor"]["values"] = np.asarray(change(np.array(line["sensor"]["values"]))).tolist()
        return line

    return injected


def shifted(key, seconds):
    """Shift the times of all lines with a key."""

    def injected(line):
        line["time"] += seconds if key in line else 0.0
        return line

    return injected


def flipped(rotation):
    """A rotation seen in a mirror that negates y, as the four numbers of its quaternion."""
    return Rotation.from_matrix(FLIP @ rotation.as_matrix() @ FLIP).as_quat()


WORLD_UP_IS_Y = Rotation.from_euler("x", -90, degrees=True)
WORLD_DOWN_IS_Z = Rotation.from_euler("x", 180, degrees=True)
INJECTED = {
    "quaternions inverted": (
        poses(lambda p, r: (p, r.inv().as_quat())),
        {"poses-against-gyroscope": "rates of the orientations and of the gyroscope correlate"},
    ),
    "world to device": (
        poses(lambda p, r: (-r.inv().apply(p), r.inv().as_quat())),
        {
            "poses-against-gyroscope": "rates of the orientations and of the gyroscope correlate",
            "poses-against-gnss": "half of the fixes lie more than",
        },
    ),
    "z down": (
        poses(lambda p, r: (WORLD_DOWN_IS_Z.apply(p), (WORLD_DOWN_IS_Z * r).as_quat())),
        {"poses-against-gravity": "180° off up", "poses-against-gnss": "mirrored"},
    ),
    "north, east, down": (
        poses(lambda p, r: (NORTH_EAST_DOWN.apply(p), (NORTH_EAST_DOWN * r).as_quat())),
        {"poses-against-gravity": "180° off up", "poses-against-gnss": "x and y are exchanged"},
    ),
    "y up": (
        poses(lambda p, r: (WORLD_UP_IS_Y.apply(p), (WORLD_UP_IS_Y * r).as_quat())),
        {"poses-against-gravity": "90° off up"},
    ),
    "left-handed": (
        poses(lambda p, r: (FLIP @ p, flipped(r))),
        {
            "poses-against-gyroscope": "rates of the orientations and of the gyroscope correlate",
            "poses-against-gnss": "mirrored",
        },
    ),
    "left-handed positions": (
        poses(lambda p, r: (FLIP @ p, r.as_quat())),
        {"poses-against-gnss": "mirrored"},
    ),
    "w first": (
        poses(lambda p, r: (p, r.as_quat()[[3, 0, 1, 2]])),
        {
            "poses-against-gravity": "off up",
            "poses-against-gyroscope": "rates of the orientations and of the gyroscope correlate",
        },
    ),
    "w last": (
        poses(lambda p, r: (p, r.as_quat()[[1, 2, 3, 0]])),
        {"poses-against-gyroscope": "rates of the orientations and of the gyroscope correlate"},
    ),
    "poses of the camera": (
        poses(lambda p, r: (p, (r * CAMERA_FROM_IMU.inv()).as_quat())),
        {
            "poses-against-gravity": "off up",
            "poses-against-gyroscope": "rates of the orientations and of the gyroscope correlate",
        },
    ),
    "orientations that do not rotate": (
        poses(lambda p, r: (p, [0.0, 0.0, 0.0, 1.0])),
        {"poses-against-gyroscope": "the orientations do not rotate"},
    ),
    "millimetres": (
        poses(lambda p, r: (1000 * p, r.as_quat())),
        {"poses-against-gnss": "half of the fixes lie more than"},
    ),
    "gyroscope in degrees": (
        samples("gyroscope", np.degrees),
        {"gyroscope-scale": "degrees per second"},
    ),
    "gyroscope's axes exchanged": (
        samples("gyroscope", lambda v: v[[1, 2, 0]]),
        {"poses-against-gyroscope": "rates of the orientations and of the gyroscope correlate"},
    ),
    "gyroscope's signs rotated": (
        samples("gyroscope", lambda v: -v),
        {"poses-against-gyroscope": "rates of the orientations and of the gyroscope correlate"},
    ),
    "accelerometer's signs rotated": (
        samples("accelerometer", lambda v: -v),
        {"poses-against-gravity": "180° off up"},
    ),
    "accelerometer's axes exchanged": (
        samples("accelerometer", lambda v: v[[1, 2, 0]]),
        {"poses-against-gravity": "90° off up"},
    ),
    "IMU late": (
        shifted("sensor", 0.5),
        {"poses-clock": "if the IMU's times are 0.50 s later"},
    ),
    "IMU early": (
        shifted("sensor", -0.5),
        {"poses-clock": "if the IMU's times are 0.50 s earlier"},
    ),
    "IMU very late": (
        shifted("sensor", 0.1),
        {"poses-clock": "if the IMU's times are 0.10 s later"},
    ),
}


def test_fixes_before_reception_put_no_other_out_of_location(found):
    """They stand at 0, 0, from where the others lie nearly around a quarter of the earth."""

    def injected(line):
        if "gps" in line:
            line["gps"]["longitude"] += 60.0
            if line["time"] < 2.0:
                line["gps"].update(latitude=0.0, longitude=0.0)
        return line

    assert found(injected) == {}


def test_nothing_is_stated_for_a_drive_as_it_was(found):
    assert found(lambda line: line) == {}


@pytest.mark.parametrize("name", INJECTED)
@pytest.mark.few(6)
def test_a_wrong_convention_is_found_where_it_disagrees(found, name):
    injected, expected = INJECTED[name]
    messages = found(injected)
    assert set(messages) == set(expected)
    for rule, words in expected.items():
        assert words in messages[rule]


NOISE = np.random.default_rng(5)
DEVICE = Rotation.from_euler("xyz", [90, 20, 50], degrees=True)
WORLD = Rotation.from_euler("z", 130, degrees=True)


def rotated_device(line):
    """Mount the whole device another way: its poses and its IMU rotate together."""
    line = poses(lambda p, r: (p, (r * DEVICE).as_quat()))(line)
    for kind in ("gyroscope", "accelerometer"):
        line = samples(kind, lambda v: DEVICE.inv().apply(v))(line)
    return line


SOUND = {
    "another mounting": rotated_device,
    "a world rotated about z": poses(
        lambda p, r: (WORLD.apply(p) + np.array([90, -4, 7]), (WORLD * r).as_quat())
    ),
    "a gyroscope full of noise": samples("gyroscope", lambda v: v + NOISE.standard_normal(3)),
    "orientations full of noise": poses(
        lambda p, r: (p, (r * Rotation.from_rotvec(0.03 * NOISE.standard_normal(3))).as_quat())
    ),
    "a biased IMU": samples("gyroscope", lambda v: v + np.array([0.05, -0.05, 0.1])),
    "positions with noise": poses(lambda p, r: (p + 0.5 * NOISE.standard_normal(3), r.as_quat())),
}


@pytest.mark.parametrize("name", SOUND)
def test_nothing_is_stated_for_what_is_allowed_or_only_noisy(found, name):
    assert found(SOUND[name]) == {}


def test_nothing_is_stated_for_a_vehicle_that_stands(found):
    stationary = poses(lambda p, r: (0.0 * p, [0.0, 0.0, 0.0, 1.0]))
    still = samples("gyroscope", lambda v: 0.002 * NOISE.standard_normal(3))
    level = samples("accelerometer", lambda v: [0.1, 0.0, 9.81])

    def injected(line):
        if "gps" in line:
            line["gps"].update(latitude=60.17, longitude=24.94, altitude=14.0)
        return level(still(stationary(line)))

    assert found(injected) == {}
