"""`validate` and the verbs that read a recording agree: it has an error where, and only where, one of them refuses."""

import json
import shutil
from functools import partial

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.errors import SceneloomError
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

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


def refusals(folder, out):
    """What verbs that read a recording whole raise, by their names."""

    def fuse():
        with sceneloom.open(folder) as scene:
            sceneloom.fuse(scene)

    verbs = {
        "open": lambda: sceneloom.open(folder).close(),
        "fuse": fuse,
        "convert": lambda: sceneloom.convert(folder, out / "again", overwrite=True),
    }
    found = {}
    for name, run in verbs.items():
        try:
            run()
        except SceneloomError as error:
            found[name] = str(error)
    return found


def check_agreement(folder, out):
    """Whether a recording is refused, by all or by none."""
    report = sceneloom.validate(folder)
    errors = {
        f.rule: f.message for f in report.findings if f.severity == "error" and f.rule not in OVER_VALUES
    }
    refused = refusals(folder, out)
    assert bool(errors) == bool(refused), (errors, refused)
    return bool(refused)


def change(folder, edit, name="calibration.json"):
    path = folder / name
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def change_lines(folder, edit):
    path = folder / "data.jsonl"
    path.write_text("".join(line + "\n" for line in edit(path.read_text().splitlines())))


def first_with(lines, key, edit, which=0):
    """Edit one line that has a key."""
    at = [k for k, line in enumerate(lines) if f'"{key}"' in line][which]
    content = json.loads(lines[at])
    edit(content)
    return [*lines[:at], json.dumps(content), *lines[at + 1 :]]


def camera(folder, edit, index=0):
    change(folder, lambda content: edit(content["cameras"][index]))


def spoil(folder, name, edit):
    path = folder / name
    path.write_bytes(edit(path.read_bytes()))


SHIFTED = np.eye(4) + np.eye(4, k=3)
REFUSED = {
    "no calibration": lambda d: (d / "calibration.json").unlink(),
    "no cameras in it": lambda d: change(d, lambda c: c.pop("cameras")),
    "an empty list of cameras": lambda d: change(d, lambda c: c.update(cameras=[])),
    "one camera too few": lambda d: change(d, lambda c: c["cameras"].pop()),
    "no imuToCamera": lambda d: camera(d, lambda c: c.pop("imuToCamera")),
    "no imuToCamera of the second": lambda d: camera(d, lambda c: c.pop("imuToCamera"), 1),
    "two matrices": lambda d: camera(d, lambda c: c.update(imuToCameraMatrix=SHIFTED.tolist())),
    "two matrices of a lidar": lambda d: change(
        d, lambda c: c["lidars"][0].update(imuToLidarMatrix=SHIFTED.tolist())
    ),
    "no focal length": lambda d: camera(d, lambda c: c.pop("focalLengthX")),
    "no principal point": lambda d: camera(d, lambda c: c.pop("principalPointY")),
    "no model": lambda d: camera(d, lambda c: c.pop("model")),
    "an unknown model": lambda d: camera(d, lambda c: c.update(model="plate")),
    "too many coefficients": lambda d: camera(d, lambda c: c.update(distortionCoefficients=[0.1] * 7)),
    "a matrix of 2 x 2": lambda d: camera(d, lambda c: c.update(imuToCamera=[[1, 0], [0, 1]])),
    "a mirror": lambda d: camera(d, lambda c: c.update(imuToCamera=np.diag([1, 1, -1, 1]).tolist())),
    "a calibration that is a list": lambda d: (d / "calibration.json").write_text("[]"),
    "a torn calibration": lambda d: spoil(d, "calibration.json", lambda b: b[:-20]),
    "no video": lambda d: (d / "data2.mkv").unlink(),
    "an empty video": lambda d: spoil(d, "data.mkv", lambda b: b""),
    "a cut video": lambda d: spoil(d, "data.mkv", lambda b: b[:-200]),
    "two videos": lambda d: shutil.copy(d / "data.mkv", d / "data.mp4"),
    "a lost line of images": lambda d: change_lines(
        d, lambda x: [t for t in x if '"number":2' not in t.replace(" ", "")]
    ),
    "no lines of images": lambda d: change_lines(d, lambda x: [t for t in x if '"frames"' not in t]),
    "a blank line": lambda d: change_lines(d, lambda x: [*x[:9], "", *x[9:]]),
    "a torn line": lambda d: spoil(d, "data.jsonl", lambda b: b[:-9]),
    "an empty log": lambda d: spoil(d, "data.jsonl", lambda b: b""),
    "a log in UTF-16": lambda d: spoil(d, "data.jsonl", lambda b: b.decode().encode("utf-16")),
    "a pose rotated by 2": lambda d: change_lines(
        d, lambda x: first_with(x, "groundTruth", lambda c: c["groundTruth"]["orientation"].update(w=2.0))
    ),
    "a line without time": lambda d: change_lines(d, lambda x: first_with(x, "gps", lambda c: c.pop("time"))),
    "a fix without altitude": lambda d: change_lines(
        d, lambda x: first_with(x, "gps", lambda c: c["gps"].pop("altitude"))
    ),
    "a sample of two": lambda d: change_lines(
        d, lambda x: first_with(x, "sensor", lambda c: c["sensor"].update(values=[1, 2]))
    ),
    "an unknown lidar": lambda d: change_lines(
        d, lambda x: first_with(x, "lidar", lambda c: c["lidar"].update(model="other"))
    ),
    "a lost sweep": lambda d: next((d / "lidar").iterdir()).unlink(),
    "a cut sweep": lambda d: spoil(next((d / "lidar").iterdir()), "", lambda b: b[:-1]),
    "no number": lambda d: change_lines(d, lambda x: first_with(x, "frames", lambda c: c.pop("number"))),
    "a camera model of its own that is none": lambda d: change_lines(
        d,
        lambda x: first_with(
            x, "frames", lambda c: c["frames"][0].update(cameraParameters={"model": "plate"})
        ),
    ),
}
PASSED = {
    "as it is": lambda d: None,
    "no lidars in the calibration": lambda d: change(d, lambda c: c.pop("lidars")),
    "two equal matrices": lambda d: camera(d, lambda c: c.update(imuToCameraMatrix=c["imuToCamera"])),
    "blank last lines": lambda d: spoil(d, "data.jsonl", lambda b: b + b"\n\r\n  \n"),
    "a byte order mark": lambda d: spoil(d, "data.jsonl", lambda b: b"\xef\xbb\xbf" + b),
    "one in the calibration": lambda d: spoil(d, "calibration.json", lambda b: b"\xef\xbb\xbf" + b),
    "a pose without orientation": lambda d: change_lines(
        d, lambda x: first_with(x, "groundTruth", lambda c: c["groundTruth"].pop("orientation"), 7)
    ),
    "a gap in the numbers": lambda d: change_lines(
        d, lambda x: [t for t in x if '"number":1' not in t.replace(" ", "")]
    ),
    "no fixes": lambda d: change_lines(d, lambda x: [t for t in x if '"gps"' not in t]),
    "lines out of order": lambda d: change_lines(d, lambda x: x[::-1]),
    "a strange line": lambda d: change_lines(d, lambda x: [*x, '{"trigger":1,"time":1.0}']),
}


@pytest.mark.parametrize("name", [*REFUSED, *PASSED])
@pytest.mark.few(20)
def test_what_is_refused_has_an_error_and_nothing_else_has(sound, tmp_path, name):
    folder = shutil.copytree(sound, tmp_path / "drive")
    {**REFUSED, **PASSED}[name](folder)
    assert check_agreement(folder, tmp_path) == (name in REFUSED)


@pytest.mark.parametrize(
    ("name", "rule"),
    [
        ("no imuToCamera", "mounts-missing"),
        ("no imuToCamera of the second", "mounts-missing"),
        ("no video", "missing-videos"),
        ("an empty video", "unreadable-videos"),
        ("a cut video", "unreadable-videos"),
    ],
)
def test_one_fault_of_a_recording_is_one_finding(sound, tmp_path, name, rule):
    folder = shutil.copytree(sound, tmp_path / "drive")
    REFUSED[name](folder)
    assert [finding.rule for finding in sceneloom.validate(folder).findings] == [rule]


def test_an_empty_camera_is_found_beside_the_missing_video_of_another_one(sound, tmp_path):
    folder = shutil.copytree(sound, tmp_path / "drive")
    (folder / "data2.mkv").unlink()
    change(folder, lambda content: content["cameras"].append(content["cameras"][0]))
    assert "sensor-empty" in {finding.rule for finding in sceneloom.validate(folder).findings}


@pytest.mark.parametrize("seed", range(12))
def test_they_agree_on_lines_and_calibrations_changed_at_random(sound, tmp_path, seed):
    generator = np.random.default_rng(seed)
    folder = shutil.copytree(sound, tmp_path / "drive")
    name = "calibration.json" if seed % 3 == 0 else "data.jsonl"
    texts = (folder / name).read_text().splitlines()
    at = int(generator.integers(len(texts)))
    content = texts[at] if name == "calibration.json" else _mutated(json.loads(texts[at]), generator)
    texts[at] = json.dumps(content) if not isinstance(content, str) else content[: len(content) // 2]
    (folder / name).write_text("\n".join(texts) + "\n")
    check_agreement(folder, tmp_path)


def _mutated(value, generator):
    """Leave out a part of an object or list, or exchange a value for one of another kind."""
    others = partial(generator.choice, [0, 3, 9])
    if isinstance(value, dict | list) and value and others():
        key = (
            generator.choice(list(value)) if isinstance(value, dict) else int(generator.integers(len(value)))
        )
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
