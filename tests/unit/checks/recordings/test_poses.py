"""Rules about trajectories of recordings: steps, and agreement with IMU and fixes."""

import json
import shutil
from copy import deepcopy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom import write
from sceneloom.cameras.camera import Camera
from sceneloom.errors import SceneloomError
from sceneloom.simulate import CameraSpec, GnssSpec, ImuSpec, LidarSpec, camera_mount, simulate_street

STEPS = "pose-steps pose-rotations poses-jump poses-rotation"


def rotated(line, degrees):
    half = np.radians(degrees) / 2
    rotation = {"x": 0.0, "y": 0.0, "z": float(np.sin(half)), "w": float(np.cos(half))}
    return {**line, "groundTruth": {**line["groundTruth"], "orientation": rotation}}


def test_poses_that_are_off_or_too_fast_are_reported_once_with_their_lines_and_hard_driving_is_not(check, drive):
    other, stream = drive.copy(), drive.streams["groundTruth"]
    stream[50]["groundTruth"]["position"]["y"] = 30.0
    words = "groundTruth at 3.500000 s is 30.00 m from the pose 0.050 s before, 600.1 m/s"
    check(drive, STEPS, ("pose-steps", stream[50], words))
    stream = other.streams["groundTruth"]
    stream[:] = [rotated(line, 90.0 * np.sin(k / 40)) for k, line in enumerate(stream)]
    check(other, STEPS)
    stream[30] = rotated(stream[30], 175.0)
    check(other, STEPS, ("pose-rotations", stream[30], ""))
    # starting and braking hard are no jumps
    for along, rules in (
        (lambda k: 10.0 * k, {"pose-steps"}),  # nothing moves at two hundred metres a second
        (lambda k: 0.5 * 9.0 * max(k / 20 - 4.0, 0.0) ** 2, set()),
    ):
        for k, line in enumerate(drive.streams["groundTruth"]):
            line["groundTruth"]["position"] |= {"x": along(k), "y": 0.0}
        assert {finding.rule for finding in check.findings(drive, STEPS)} == rules


def test_a_single_torn_yaw_rate_does_not_speak_against_the_poses(check, drive):
    stream = drive.streams["groundTruth"]
    stream[:] = [rotated(line, np.degrees(0.8 * np.sin(0.9 * line["time"]))) for line in stream]
    for line in drive.streams["gyroscope"]:
        line["sensor"]["values"] = [0.0, 0.0, 0.8 * 0.9 * float(np.cos(0.9 * line["time"]))]
    drive.streams["gyroscope"][400]["sensor"]["values"] = [99.0, 0.0, 0.0]
    check(drive, "gyroscope-scale poses-clock poses-against-gyroscope", ("gyroscope-range", None, ""))


OVER_VALUES = {"accelerometer-unit", "gyroscope-unit", "fixes-on-earth"}
"""Rules over values, which no reader judges."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A recording of all kinds of lines, with nothing wrong in it."""
    camera_model = Camera("pinhole", 48, 32, 30.0, 30.0, 23.5, 15.5)
    cameras = [CameraSpec(camera_model, camera_mount(position=(1.5, y, 1.5))) for y in (0.25, -0.25)]
    drive = simulate_street(1, frames=3, lidar=LidarSpec(beams=4, steps=60), cameras=cameras)
    folder = tmp_path_factory.mktemp("sound") / "drive"
    sceneloom.write(drive.scene, folder, format="recording")
    return folder


@pytest.fixture
def copy(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "drive")


def check_agreement(folder):
    """Rules that found something, and whether the recording is refused: by all verbs that read it whole, or by none."""

    def fuse():
        with sceneloom.open(folder) as scene:
            sceneloom.fuse(scene)

    findings = sceneloom.validate(folder).findings
    errors = {f.rule: f.message for f in findings if f.severity == "error" and f.rule not in OVER_VALUES}
    refused = []
    again = folder.with_name("again")
    for run in (lambda: sceneloom.open(folder).close(), fuse, lambda: sceneloom.convert(folder, again, overwrite=True)):
        try:
            run()
        except SceneloomError as error:
            refused.append(str(error))
    assert bool(errors) == bool(refused), (errors, refused)
    return [f.rule for f in findings], bool(refused)


def spoilt(name, edit):
    """Edit the bytes of the first file of a name."""

    def run(folder):
        path = next(folder.glob(name))
        path.write_bytes(edit(path.read_bytes()))

    return run


def calibration(edit):
    def change(content):
        edited = json.loads(content)
        edit(edited)
        return json.dumps(edited).encode()

    return spoilt("calibration.json", change)


def camera(edit, index=0):
    return calibration(lambda content: edit(content["cameras"][index]))


def fields(**given):
    return camera(lambda entry: entry.update(given))


def without(key, index=0):
    return camera(lambda entry: entry.pop(key), index)


def log(edit):
    return spoilt("data.jsonl", lambda b: "".join(f"{x}\n" for x in edit(b.decode().splitlines())).encode())


def lines_without(text):
    return log(lambda lines: [line for line in lines if text not in line.replace(" ", "")])


def line_with(key, edit, which=0):
    def change(lines):
        at = [k for k, line in enumerate(lines) if f'"{key}"' in line][which]
        content = json.loads(lines[at])
        edit(content)
        return [*lines[:at], json.dumps(content), *lines[at + 1 :]]

    return log(change)


SHIFTED = (np.eye(4) + np.eye(4, k=3)).tolist()
MIRROR = np.diag([1, 1, -1, 1]).tolist()
REFUSED = [
    lambda d: (d / "calibration.json").unlink(),
    calibration(lambda c: c.pop("cameras")),
    calibration(lambda c: c.update(cameras=[])),
    calibration(lambda c: c["cameras"].pop()),
    fields(imuToCameraMatrix=SHIFTED),
    calibration(lambda c: c["lidars"][0].update(imuToLidarMatrix=SHIFTED)),
    without("focalLengthX"),
    without("principalPointY"),
    without("model"),
    fields(model="plate"),
    fields(distortionCoefficients=[0.1] * 7),
    fields(imuToCamera=[[1, 0], [0, 1]]),
    fields(imuToCamera=MIRROR),
    spoilt("calibration.json", lambda b: b"[]"),
    spoilt("calibration.json", lambda b: b[:-20]),
    lambda d: shutil.copy(d / "data.mkv", d / "data.mp4"),
    lines_without('"number":2'),
    lines_without('"frames"'),
    log(lambda x: [*x[:9], "", *x[9:]]),
    spoilt("data.jsonl", lambda b: b[:-9]),
    spoilt("data.jsonl", lambda b: b""),
    spoilt("data.jsonl", lambda b: b.decode().encode("utf-16")),
    line_with("groundTruth", lambda c: c["groundTruth"]["orientation"].update(w=2.0)),
    line_with("gps", lambda c: c.pop("time")),
    line_with("gps", lambda c: c["gps"].pop("altitude")),
    line_with("sensor", lambda c: c["sensor"].update(values=[1, 2])),
    line_with("lidar", lambda c: c["lidar"].update(model="other")),
    lambda d: next((d / "lidar").iterdir()).unlink(),
    spoilt("lidar/*", lambda b: b[:-1]),
    line_with("frames", lambda c: c.pop("number")),
    line_with("frames", lambda c: c["frames"][0].update(cameraParameters={"model": "plate"})),
]
PASSED = [
    lambda d: None,
    calibration(lambda c: c.pop("lidars")),
    camera(lambda c: c.update(imuToCameraMatrix=c["imuToCamera"])),
    spoilt("data.jsonl", lambda b: b + b"\n\r\n  \n"),
    spoilt("data.jsonl", lambda b: b"\xef\xbb\xbf" + b),
    spoilt("calibration.json", lambda b: b"\xef\xbb\xbf" + b),
    line_with("groundTruth", lambda c: c["groundTruth"].pop("orientation"), 7),
    lines_without('"number":1'),
    lines_without('"gps"'),
    log(lambda x: x[::-1]),
    log(lambda x: [*x, '{"trigger":1,"time":1.0}']),
]


@pytest.mark.parametrize(("change", "refused"), [*((c, True) for c in REFUSED), *((c, False) for c in PASSED)])
@pytest.mark.few(18)
def test_what_is_refused_has_an_error_and_nothing_else_has(copy, change, refused):
    change(copy)
    assert check_agreement(copy)[1] == refused


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        (without("imuToCamera"), "mounts-missing"),
        (without("imuToCamera", 1), "mounts-missing"),
        (lambda d: (d / "data2.mkv").unlink(), "missing-videos"),
        (spoilt("data.mkv", lambda b: b""), "unreadable-videos"),
        (spoilt("data.mkv", lambda b: b[:-200]), "unreadable-videos"),
    ],
)
def test_one_fault_of_a_recording_is_one_finding_and_an_empty_camera_is_another_one(copy, change, rule):
    change(copy)
    assert check_agreement(copy) == ([rule], True)
    if rule == "missing-videos":
        calibration(lambda content: content["cameras"].append(content["cameras"][0]))(copy)
        assert "sensor-empty" in {finding.rule for finding in sceneloom.validate(copy).findings}


@pytest.mark.parametrize("seed", range(12))
def test_they_agree_on_lines_and_calibrations_changed_at_random(copy, seed):
    generator = np.random.default_rng(seed)
    path = copy / ("calibration.json" if seed % 3 == 0 else "data.jsonl")
    texts = path.read_text().splitlines()
    at = int(generator.integers(len(texts)))
    if path.suffix == ".json":
        texts[at] = texts[at][: len(texts[at]) // 2]
    else:
        texts[at] = json.dumps(_mutated(json.loads(texts[at]), generator))
    path.write_text("\n".join(texts) + "\n")
    check_agreement(copy)


def _mutated(value, generator):
    """Leave out a part of an object or list, or exchange a value for one of another kind."""
    others = partial(generator.choice, [0, 3, 9])
    if isinstance(value, dict | list) and value and others():
        key = generator.choice(list(value)) if isinstance(value, dict) else int(generator.integers(len(value)))
        changed = value.copy()
        if others():
            changed[key] = _mutated(changed[key], generator)
        else:
            changed.pop(key)
        return changed
    return [None, "text", -1, 1e12, [], {}][int(generator.integers(6))]


def test_they_agree_on_real_recordings(data_dir, tmp_path):
    folders = sorted(path for path in (data_dir / "recordings").iterdir() if (path / "data.jsonl").exists())
    assert folders
    for folder in folders:
        report = sceneloom.validate(folder, frames=False)
        assert "error" not in {finding.severity for finding in report.findings}
        sceneloom.open(folder).close()


CONVENTIONS = (
    "poses-against-gravity poses-against-gyroscope gyroscope-scale poses-clock poses-against-gnss heights-against-gnss"
)
NORTH_EAST_DOWN = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLIP = np.diag([1.0, -1.0, 1.0])
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
def found(lines, check):
    """What the rules state of the lines after something was done to each."""

    def run(injected):
        changed = sorted((injected(deepcopy(line)) for line in lines), key=lambda x: x["time"])
        return {finding.rule: finding.message for finding in check.findings(changed, CONVENTIONS)}

    return run


def poses(change):
    """Change position and rotation of every true pose; the change gives a rotation, or its numbers as written."""

    def injected(line):
        if "groundTruth" in line:
            pose = line["groundTruth"]
            position = np.array([pose["position"][k] for k in "xyz"])
            rotation = Rotation.from_quat([pose["orientation"][k] for k in "xyzw"])
            position, rotation = change(position, rotation)
            quaternion = rotation.as_quat() if isinstance(rotation, Rotation) else rotation
            pose["position"] = dict(zip("xyz", map(float, position), strict=True))
            pose["orientation"] = dict(zip("xyzw", map(float, quaternion), strict=True))
        return line

    return injected


def world(rotation, shift=(0.0, 0.0, 0.0)):
    return poses(lambda p, r: (rotation.apply(p) + shift, rotation * r))


def samples(kind, change):
    def injected(line):
        if line.get("sensor", {}).get("type") == kind:
            line["sensor"]["values"] = np.asarray(change(np.array(line["sensor"]["values"]))).tolist()
        return line

    return injected


def late(seconds):
    return lambda line: {**line, "time": line["time"] + (seconds if "sensor" in line else 0.0)}


def flipped(rotation):
    """A rotation seen in a mirror that negates y."""
    return Rotation.from_matrix(FLIP @ rotation.as_matrix() @ FLIP)


GYROSCOPE = {"poses-against-gyroscope": "of the orientations and of the gyroscope correlate"}
OFF_UP = {"poses-against-gravity": "off up"}
UP_90, UP_180 = {"poses-against-gravity": "90° off up"}, {"poses-against-gravity": "180° off up"}
MIRRORED = {"poses-against-gnss": "mirrored"}
EXCHANGED = {"poses-against-gnss": "x and y are exchanged"}
FAR = {"poses-against-gnss": "half of the fixes lie more than"}
INJECTED = [
    (poses(lambda p, r: (p, r.inv())), GYROSCOPE),
    (poses(lambda p, r: (-r.inv().apply(p), r.inv())), GYROSCOPE | FAR),
    (world(Rotation.from_euler("x", 180, degrees=True)), UP_180 | MIRRORED),
    (world(NORTH_EAST_DOWN), UP_180 | EXCHANGED),
    (world(Rotation.from_euler("x", -90, degrees=True)), UP_90),
    (poses(lambda p, r: (FLIP @ p, flipped(r))), GYROSCOPE | MIRRORED),
    (poses(lambda p, r: (FLIP @ p, r)), MIRRORED),
    (poses(lambda p, r: (p, r.as_quat()[[3, 0, 1, 2]])), OFF_UP | GYROSCOPE),
    (poses(lambda p, r: (p, r.as_quat()[[1, 2, 3, 0]])), GYROSCOPE),
    (poses(lambda p, r: (p, r * CAMERA_FROM_IMU.inv())), OFF_UP | GYROSCOPE),
    (poses(lambda p, r: (p, [0.0, 0.0, 0.0, 1.0])), {"poses-against-gyroscope": "the orientations do not rotate"}),
    (poses(lambda p, r: (1000 * p, r)), FAR),
    (samples("gyroscope", np.degrees), {"gyroscope-scale": "degrees per second"}),
    (samples("gyroscope", lambda v: v[[1, 2, 0]]), GYROSCOPE),
    (samples("gyroscope", lambda v: -v), GYROSCOPE),
    (samples("accelerometer", lambda v: -v), UP_180),
    (samples("accelerometer", lambda v: v[[1, 2, 0]]), UP_90),
    (late(0.5), {"poses-clock": "if the IMU's times are 0.50 s later"}),
    (late(-0.5), {"poses-clock": "if the IMU's times are 0.50 s earlier"}),
    (late(0.1), {"poses-clock": "if the IMU's times are 0.10 s later"}),
]


@pytest.mark.parametrize(("injected", "expected"), INJECTED)
@pytest.mark.few(6)
def test_a_wrong_convention_is_found_where_it_disagrees(found, injected, expected):
    messages = found(injected)
    assert set(messages) == set(expected)
    for rule, words in expected.items():
        assert words in messages[rule]


NOISE = np.random.default_rng(5)
DEVICE = Rotation.from_euler("xyz", [90, 20, 50], degrees=True)


def before_reception(line):
    """Fixes at 0, 0, from where the others lie nearly around a quarter of the earth."""
    if "gps" in line:
        line["gps"]["longitude"] += 60.0
        if line["time"] < 2.0:
            line["gps"].update(latitude=0.0, longitude=0.0)
    return line


def rotated_device(line):
    """Mount the whole device another way: its poses and its IMU rotate together."""
    line = poses(lambda p, r: (p, r * DEVICE))(line)
    for kind in ("gyroscope", "accelerometer"):
        line = samples(kind, DEVICE.inv().apply)(line)
    return line


def standing(line):
    if "gps" in line:
        line["gps"].update(latitude=60.17, longitude=24.94, altitude=14.0)
    line = poses(lambda p, r: (0.0 * p, [0.0, 0.0, 0.0, 1.0]))(line)
    line = samples("gyroscope", lambda v: 0.002 * NOISE.standard_normal(3))(line)
    return samples("accelerometer", lambda v: [0.1, 0.0, 9.81])(line)


@pytest.mark.parametrize(
    "allowed",
    [
        lambda line: line,
        before_reception,
        rotated_device,
        world(Rotation.from_euler("z", 130, degrees=True), np.array([90, -4, 7])),
        samples("gyroscope", lambda v: v + NOISE.standard_normal(3)),
        poses(lambda p, r: (p, r * Rotation.from_rotvec(0.03 * NOISE.standard_normal(3)))),
        samples("gyroscope", lambda v: v + np.array([0.05, -0.05, 0.1])),
        poses(lambda p, r: (p + 0.5 * NOISE.standard_normal(3), r)),
        standing,
    ],
)
def test_nothing_is_stated_for_what_is_allowed_or_only_noisy(found, allowed):
    assert found(allowed) == {}
