"""Any `frames` lines of a recording, opened and written, state the same again, be it through a scene file."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from sceneloom.formats import open_scene, write_scene

SIZE = 8
ROWS = [[1.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.75], [0.0, 0.0, 0.0, 1.0]]
CAMERA_MODEL = {
    "model": "pinhole",
    "focalLengthX": 9.0,
    "focalLengthY": 9.0,
    "principalPointX": 3.5,
    "principalPointY": 3.5,
    "imuToCamera": ROWS,
}
GYROSCOPE = {"sensor": {"type": "gyroscope", "values": [0, 0.5, 1]}}

numbers = st.one_of(st.floats(-1e6, 1e6), st.integers(-5, 5))
beside = st.dictionaries(
    st.sampled_from(["exposureTimeSeconds", "number", "line", "note", "ünïcode %s"]),
    st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=3)),
    max_size=2,
).map(lambda found: found if isinstance(found.get("exposureTimeSeconds", 0.5), float) else {})
beside_line = st.dictionaries(st.sampled_from(["status", "note"]), st.one_of(st.none(), numbers), max_size=1)


@st.composite
def camera_models(draw: st.DrawFn) -> dict[str, Any]:
    """Parameters in any spelling, some or all of them."""
    coefficients = st.floats(-0.01, 0.01)
    name, count = draw(
        st.sampled_from(
            [("KANNALA_BRANDT4", 4), ("kannala-brandt4", 0), ("brown-conrady", 5), ("PINHOLE", 3), ("pinhole", 0)]
        )
    )
    whole = {
        "focalLengthX": draw(st.sampled_from([9, 9.0, 284.929992675781])),
        "focalLengthY": draw(st.floats(5, 300)),
        "principalPointX": 3.5,
        "principalPointY": draw(st.floats(2, 5)),
        draw(st.sampled_from(["model", "distortionModel"])): name,
        "distortionCoefficients": draw(st.lists(coefficients, min_size=count, max_size=count)),
    }
    some = {"principalPointX": draw(st.sampled_from([3, 3.5, 4.25]))}
    found = draw(st.sampled_from([whole, some, {"focalLength": 11}, {}]))
    return found | draw(st.sampled_from([{}, {"rollingShutter": True}]))


@st.composite
def mounts(draw: st.DrawFn) -> list[Any]:
    """A matrix with rounded digits, by rows or flat by columns."""
    matrix = np.eye(4)
    rotation = draw(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
    # five digits leave a rotation within 1e-4 of one, which is read without a word
    matrix[:3, :3] = Rotation.from_rotvec(rotation).as_matrix().round(5)
    matrix[:3, 3] = draw(st.lists(st.floats(-5, 5), min_size=3, max_size=3))
    return draw(st.sampled_from([matrix.tolist(), matrix.T.ravel().tolist()]))


@st.composite
def entries(draw: st.DrawFn, index: int, seconds: float) -> dict[str, Any]:
    entry = {"cameraInd": index, "time": seconds + draw(st.sampled_from([0, 0, 1e-9, -0.004, 0.4]))}
    entry |= draw(beside)
    if draw(st.booleans()):
        entry["cameraParameters"] = draw(camera_models())
    if draw(st.booleans()):
        entry["imuToCamera"] = draw(mounts())
    entry |= draw(st.sampled_from([{}, {}, {"missingBitmap": True}]))
    return {key: entry[key] for key in draw(st.permutations(list(entry)))}


@st.composite
def drives(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Lines of images, each of some cameras, with a sample between."""
    first, count = draw(st.sampled_from([0, 0, 28])), draw(st.integers(1, 5))
    cameras = draw(st.integers(1, 2))
    steps = draw(st.lists(st.sampled_from([0.1, 0.033, 1.5]), min_size=count, max_size=count))
    lines: list[dict[str, Any]] = []
    for number, seconds in enumerate(np.cumsum(steps).tolist(), first):
        listed = [index for index in range(cameras) if draw(st.integers(0, 4))]
        found = [draw(entries(index, seconds)) for index in draw(st.permutations(listed))]
        lines.append({"frames": found, "number": number, "time": seconds} | draw(beside_line))
        if draw(st.booleans()):
            lines.append({**GYROSCOPE, "time": seconds + 0.01})
    return lines


def cameras_of(drive: list[dict[str, Any]]) -> list[int]:
    return sorted({entry["cameraInd"] for line in drive for entry in line.get("frames", [])})


def images_of(drive: list[dict[str, Any]], index: int) -> int:
    shown = [entry for line in drive for entry in line.get("frames", []) if entry["cameraInd"] == index]
    return sum(entry.get("missingBitmap") is not True for entry in shown)


def write_drive(folder: Path, drive: list[dict[str, Any]], *, calibrated: int) -> None:
    folder.mkdir()
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in drive), "utf-8")
    (folder / "calibration.json").write_text(json.dumps({"cameras": [CAMERA_MODEL] * calibrated}))
    for index in range(calibrated):
        images = folder / f"frames{index + 1}"
        images.mkdir()
        for number in range(sum("frames" in line for line in drive)):
            Image.new("RGB", (SIZE, SIZE), (10 * number, 0, 100 * index)).save(images / f"{number:08d}.png")


def read_lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "data.jsonl").read_text("utf-8").split("\n")[:-1]]


def by_camera(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The cameras of a line stand in it in the order of their numbers."""
    ordered = copy.deepcopy(lines)
    for line in ordered:
        if "frames" in line:
            line["frames"].sort(key=lambda entry: entry["cameraInd"])
    return ordered


def written_again(folder: Path, temporary: Path) -> list[list[dict[str, Any]]]:
    """The lines as they are written, and as they are through a scene file."""
    with open_scene(folder) as scene:
        write_scene(scene, temporary / "again", images="png")
        write_scene(scene, temporary / "scene.sfs", time_unit="nanoseconds")
    with open_scene(temporary / "scene.sfs") as scene:
        write_scene(scene, temporary / "from_scene", images="png")
    return [read_lines(temporary / name) for name in ("again", "from_scene")]


def check_images(drive: list[dict[str, Any]], index: int, folder: Path) -> None:
    """There is an image for each line, and its own one where it has one."""
    lines = [line["frames"] for line in drive if "frames" in line]
    files = sorted(folder.iterdir())
    assert len(files) == len(lines)
    for location, (path, listed) in enumerate(zip(files, lines, strict=True)):
        if any(e["cameraInd"] == index and e.get("missingBitmap") is not True for e in listed):
            shown = np.asarray(Image.open(path))[0, 0].astype(int)
            # scene files hold JPEG, which is off by a step or two where an image is of one colour
            assert np.abs(shown - [10 * location, 0, 100 * index]).max() <= 4


@settings(deadline=None)
@given(drives())
def test_frames_lines_are_written_as_they_were(drive):
    cameras = cameras_of(drive)
    if not cameras or cameras != list(range(len(cameras))) or not all(images_of(drive, index) for index in cameras):
        return  # a camera without any image is left out, and the loss report says so
    camera_models = [entry.get("cameraParameters") for line in drive for entry in line.get("frames", ())]
    if any(camera_model is not None and "focalLengthX" not in camera_model for camera_model in camera_models):
        return  # a part of a camera model is written whole where the calibration becomes that of the images
    with TemporaryDirectory() as temporary:
        folder = Path(temporary, "drive")
        write_drive(folder, drive, calibrated=len(cameras))
        expected = by_camera(drive)
        for found in written_again(folder, Path(temporary)):
            assert by_camera(found) == expected
        for name in ("again", "from_scene"):
            for index in cameras:
                check_images(drive, index, Path(temporary, name, f"frames{index + 1}"))


ROTATION = {"w": 0.53464, "x": -0.15299, "y": -0.826976, "z": -0.082863}
RECORDED: list[dict[str, Any]] = [
    {
        "groundTruth": {
            "position": {"x": -0.0081264712, "y": 0.022171846215, "z": 0.0079135264873},
            "orientation": ROTATION,
        },
        "time": 1.410257080078125,
    },
    {
        "frames": [
            {
                "cameraInd": index,
                "cameraParameters": {
                    "focalLengthX": 284.917388916016,
                    "focalLengthY": 285.203491210938,
                    "principalPointX": 3.4547119140625,
                    "principalPointY": 3.77349853515625 + index,
                    "distortionModel": "KANNALA_BRANDT4",
                    "distortionCoefficients": [-0.005131, 0.04012, -0.03751, 0.006324],
                },
                "imuToCamera": [
                    [0.01361, 0.9996, -0.02533, 0.0611 - index / 10],
                    [-0.9998, 0.01371, 0.003916, -0.0203],
                    [0.00426, 0.02527, 0.9997, -0.008021],
                    [0, 0, 0, 1],
                ],
                "time": 1.416107177734375,
            }
            for index in range(2)
        ],
        "number": 31,
        "time": 1.416107177734375,
    },
    {
        "gps": {"accuracy": 3.5, "altitude": 12.70541106834269, "latitude": 60.1729, "longitude": 24.9211},
        "time": 1.41977294921875,
    },
]
"""Lines as recorders write them: a stereo pair with all its parameters, more decimals than a nanosecond."""


def test_lines_of_a_recorder_come_back_without_a_loss(tmp_path):
    write_drive(tmp_path / "drive", RECORDED, calibrated=2)
    found, from_scene = written_again(tmp_path / "drive", tmp_path)
    assert found == RECORDED
    assert from_scene == RECORDED
    with open_scene(tmp_path / "drive") as scene:
        report = write_scene(scene, tmp_path / "once more", images="png")
    assert [loss for loss in report if loss.field != "replay"] == []


def frames_written(drive, tmp_path, change=lambda scene: scene):
    calibrated = len(cameras_of(drive))
    write_drive(tmp_path / "drive", drive, calibrated=calibrated)
    with open_scene(tmp_path / "drive") as scene:
        report = write_scene(change(scene), tmp_path / "again", images="png")
    reported = {loss.field: loss for loss in report if loss.field != "replay"}
    return [line for line in read_lines(tmp_path / "again") if "frames" in line], reported


def test_a_mounting_that_was_normalised_is_written_as_it_was_taken(tmp_path):
    drive = copy.deepcopy(RECORDED[1:2])
    off = drive[0]["frames"][0]["imuToCamera"]
    off[0] = [1.003 * number for number in off[0]]
    found, _ = frames_written(drive, tmp_path)
    taken, kept = (np.array(entry["imuToCamera"]) for entry in found[0]["frames"])
    np.testing.assert_allclose(taken[:3, :3] @ taken[:3, :3].T, np.eye(3), atol=1e-12)
    # the nearest rotation is hardly more off than the row that is 0.003 too long
    np.testing.assert_allclose(taken, np.array(off), atol=0.0035)
    assert kept.tolist() == drive[0]["frames"][1]["imuToCamera"]


def test_a_camera_model_that_was_changed_is_written_as_it_is_now(tmp_path):
    def wider(scene):
        camera = scene.sensor("camera0")
        images = [replace(shot, camera=replace(shot.camera, fx=200.0)) for shot in camera.images]
        changed = replace(camera, images=type(camera.images).of(images, camera.images.timestamps_ns))
        return replace(scene, sensors=tuple(changed if sensor is camera else sensor for sensor in scene.sensors))

    found, _ = frames_written(RECORDED, tmp_path, wider)
    changed, kept = (entry["cameraParameters"] for entry in found[0]["frames"])
    before = RECORDED[1]["frames"]
    assert changed["focalLengthX"] == 200.0
    assert changed["focalLengthY"] == before[0]["cameraParameters"]["focalLengthY"]
    assert kept == before[1]["cameraParameters"]


def numbered(numbers: list[int]) -> list[dict[str, Any]]:
    return [
        {"frames": [{"cameraInd": 0, "time": k / 10}], "number": number, "time": k / 10}
        for k, number in enumerate(numbers)
    ]


@pytest.mark.parametrize("numbers", [[0, 1, 2], [28, 29, 30], [28, 30, 31]])
def test_numbers_stay_with_their_gaps(numbers, tmp_path):
    found, reported = frames_written(numbered(numbers), tmp_path)
    assert [line["number"] for line in found] == numbers
    assert "frames[].number" not in reported


def test_images_that_were_left_out_are_not_counted(tmp_path):
    def shorter(scene):
        camera = scene.cameras[0]
        kept = [camera.images[k] for k in (1, 2)]
        images = type(camera.images).of(kept, [shot.timestamp_ns for shot in kept])
        return replace(scene, sensors=(replace(camera, images=images),))

    drive = numbered([28, 29, 30])
    found, _ = frames_written(drive, tmp_path, shorter)
    assert [line["number"] for line in found] == [0, 1]
    assert [line["time"] for line in found] == [0.1, 0.2]


def test_lines_whose_clock_was_moved_are_put_together_anew_and_that_is_reported(tmp_path):
    def later(scene):
        moved = []
        for camera in scene.cameras:
            shots = [replace(shot, timestamp_ns=shot.timestamp_ns + 10**9, extras={}) for shot in camera.images]
            images = type(camera.images).of(shots, [shot.timestamp_ns for shot in shots])
            moved.append(replace(camera, images=images))
        return replace(scene, sensors=tuple(moved))

    drive = numbered([0, 1, 2])
    drive[0]["time"] = -0.05
    drive[1]["frames"][0]["missingBitmap"] = True
    found, reported = frames_written(drive, tmp_path, later)
    assert [line["time"] for line in found] == [1.0, 1.2]
    assert [line["number"] for line in found] == [0, 1]
    assert reported["frames"].count == 2


def test_cameras_that_a_line_does_not_list_are_not_listed_and_that_is_reported(tmp_path):
    short = {"frames": [{"cameraInd": 1, "time": 2.0}], "number": 32, "time": 2.0}
    drive = [*copy.deepcopy(RECORDED[1:2]), short]
    write_drive(tmp_path / "drive", drive, calibrated=2)
    with open_scene(tmp_path / "drive") as scene:
        report = write_scene(scene, tmp_path / "again", images="png")
    assert read_lines(tmp_path / "again") == drive
    assert [loss.count for loss in report if "do not list every camera" in loss.what] == [1]
    assert not [loss for loss in report if "not in step" in loss.what]
