"""What is written as a recording is read back: lines as they were, but for their order, and arrays, times, images."""

import copy
import json
import struct
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image
from scipy.spatial.transform import Rotation
from tests.properties.strategies import floats, timestamps

from sceneloom import scene as sc
from sceneloom.cameras import MODELS, intrinsics_vector
from sceneloom.cameras.camera import Camera
from sceneloom.formats import open_scene, write_scene
from sceneloom.geometry.rigid import RigidTransform

ROWS = [[1.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.75], [0.0, 0.0, 0.0, 1.0]]
PINHOLE = {"model": "pinhole", "focalLengthX": 9.0, "focalLengthY": 9.0, "principalPointX": 3.5, "principalPointY": 3.5}
ROTATION = {"w": 0.53464, "x": -0.15299, "y": -0.826976, "z": -0.082863}
TIMES = (0, 0.1 + 0.2, 1.5, 1.5000000000000002, 1.4497692636718750, 7, -3.25, 1e-10, 1e-9, 123456.789012345)
"""Few, so that many lines have one; some closer than a nanosecond."""

numbers = st.one_of(st.floats(-1e6, 1e6), st.integers(-5, 5))
triples = st.lists(numbers, min_size=3, max_size=3)
beside = st.dictionaries(
    st.sampled_from(["temperature", "status", "note", "ünïcode %s"]),
    st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=3), st.lists(numbers, max_size=2)),
    max_size=2,
)


def write_drive(folder, drive, *, cameras=None):
    """A recording with these lines, a sweep, and an image for each `frames` line of so many cameras."""
    count = sum("frames" in line for line in drive)
    cameras = bool(count) if cameras is None else cameras
    folder.mkdir(parents=True)
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in drive), "utf-8")
    calibration = {"cameras": [PINHOLE | {"imuToCamera": ROWS}] * cameras, "lidars": [{"imuToLidar": ROWS}]}
    (folder / "calibration.json").write_text(json.dumps(calibration))
    (folder / "points.bin").write_bytes(struct.pack("<fffBHd", 1, 2, 3, 4, 5, 0.5))
    for index in range(cameras):
        images = folder / f"frames{index + 1}"
        images.mkdir()
        for number in range(count):
            Image.new("RGB", (8, 8), (10 * number, 0, 100 * index)).save(images / f"{number:08d}.png")


def written_again(folder, change=lambda scene: scene, *, scene_file=True):
    """The lines as they are written, as they are through a scene file, and the loss report of the former."""
    with open_scene(folder) as scene:
        report = write_scene(change(scene), folder.with_name("again"), images="png")
        if scene_file:
            write_scene(scene, folder.with_name("scene.sfs"), time_unit="nanoseconds")
    if scene_file:
        with open_scene(folder.with_name("scene.sfs")) as scene:
            write_scene(scene, folder.with_name("from_scene"), images="png")
    texts = [folder.with_name(name) / "data.jsonl" for name in ("again", "from_scene")[: 1 + scene_file]]
    found = [list(map(json.loads, text.read_text("utf-8").split("\n")[:-1])) for text in texts]
    return *found, report


def axes(names):
    return st.fixed_dictionaries(dict.fromkeys(names, numbers))


@st.composite
def samples(draw):
    width = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3, "imuTemperature": 1}
    name = draw(st.sampled_from([*width, "barometer", "odd"]))
    count = width.get(name) or draw(st.integers(1, 3))
    values = draw(st.lists(numbers, min_size=count, max_size=count))
    return {"sensor": {"type": name, "values": values} | draw(beside)}


@st.composite
def fixes(draw):
    accuracy = st.dictionaries(st.sampled_from(["accuracy", "verticalAccuracy"]), st.floats(0, 99))
    fix = draw(axes(["latitude", "longitude", "altitude"])) | draw(accuracy) | draw(beside)
    root = draw(st.sampled_from(["gps", "gps", "rtkgps", "groundTruth", "pose"]))
    return {root: {"name": "gps"} | fix if root == "pose" else fix}


@st.composite
def poses(draw):
    root = draw(st.sampled_from(["groundTruth", "pose", "ARKit", "arengine", "output", "externalPose", ""]))
    pose = {"position": draw(axes("xyz")) | draw(beside)}
    # a trajectory has an orientation with each pose, or with none
    if root in {"groundTruth", "ARKit", ""}:
        pose["orientation"] = ROTATION
    if root == "pose" and draw(st.booleans()):
        pose["name"] = "slam"
    pose |= draw(beside)
    return {root: pose} if root else pose


pressures = st.builds(lambda value, more: {"barometer": {"pressureHectopascals": value} | more}, numbers, beside)
enus = st.builds(lambda mean, more: {"gnssEnu": {"mean": mean} | more}, triples, beside)
others = st.dictionaries(
    st.sampled_from(["systemMetrics", "droppedFrame", "trigger", "externalVelocity", "barometer"]),
    st.one_of(st.none(), st.booleans(), numbers, beside),
    min_size=1,
    max_size=1,
)


@st.composite
def lines(draw):
    """A line: one record, unknown keys, a time, in any order."""
    line = draw(st.one_of(samples(), samples(), fixes(), poses(), pressures, enus))
    line |= draw(st.sampled_from([{}, draw(others)])) | draw(beside) | {"time": draw(st.sampled_from(TIMES))}
    return {key: line[key] for key in draw(st.permutations(list(line)))}


@st.composite
def drives(draw):
    """All lines of a recording: of records, of images, of sweeps, without time or subject; in any order."""
    found = draw(st.lists(lines(), max_size=8))
    times = sorted(draw(st.lists(st.sampled_from(TIMES), max_size=3, unique=True)))
    for number, time in enumerate(times):
        entry = {"cameraInd": 0, "time": time} | draw(beside)
        if draw(st.booleans()):
            entry |= {"features": [{"id": 1}], "exposureTimeSeconds": 0.01}
        found.append({"frames": [entry], "number": number, "time": time} | draw(beside))
    for time in draw(st.lists(st.sampled_from(TIMES), max_size=2)):
        sweep = {"model": "RoboSense M1 XYZIRT", "dataFile": "points.bin"} | draw(beside)
        found.append({"lidar": sweep, "time": time} | draw(beside))
    found += draw(st.lists(st.sampled_from([{"sdkVersion": "1.5"}, {"status": None}, {}]), max_size=2))
    return draw(st.permutations(found))


def in_order(drive):
    """Sorted by time, lines without one behind those of the time that they stood behind; of one time by their text."""
    keys, last = [], -float("inf")
    for line in drive:
        last = round(line["time"] * 1e9) if "time" in line else last
        keys.append((last, "time" not in line, json.dumps(as_floats(line), sort_keys=True)))
    return [drive[k] for k in sorted(range(len(drive)), key=lambda k: keys[k])]


def as_floats(value):
    """A value with all its whole numbers as floats, which mean the same."""
    if isinstance(value, dict):
        return {key: as_floats(one) for key, one in value.items()}
    if isinstance(value, list):
        return [as_floats(one) for one in value]
    return float(value) if type(value) is int else value


TWICE = {"gnssEnu": {"mean": [0.0, 0.0, 0.0]}, "time": 7}


@given(drives())
@example([TWICE, {"temperature": None, **TWICE}, TWICE])  # nothing but poses that came before
def test_lines_are_written_as_they_were(drive):
    if drive:
        with TemporaryDirectory() as temporary:
            write_drive(Path(temporary, "drive"), drive)
            found, _ = written_again(Path(temporary, "drive"), scene_file=False)
        timestamps = [round(line["time"] * 1e9) for line in found if "time" in line]
        assert timestamps == sorted(timestamps)
        for line in (line for line in (*drive, *found) if "lidar" in line):
            line["lidar"]["dataFile"] = ""
        expected, written = in_order(drive), in_order(found)
        assert written == expected


EVERY_KIND = [
    {"sdkVersion": "1.5"},
    {"sensor": {"type": "gyroscope", "values": [1, 2.5, -3]}, "time": 0.30000000000000004},
    {"time": 0.30000000000000004, "sensor": {"type": "accelerometer", "values": [1, 2, 3], "temperature": 40}},
    {"sensor": {"type": "gyroscope", "values": [1, 2.5, 4]}, "time": 0.30000000000000004, "note": None},
    {"gps": {"longitude": 25, "latitude": 60, "altitude": 14.2}, "time": 0.5},
    {"rtkgps": {"latitude": 60, "longitude": 25, "altitude": 14.1, "accuracy": 0.02}, "time": 0.5},
    {"barometer": {"pressureHectopascals": 1013.25}, "time": 0.5},
    {"status": "TRACKING"},
    {"groundTruth": {"orientation": ROTATION, "position": {"x": 1, "y": 2, "z": 3}}, "time": 0.75},
    {"groundTruth": {"orientation": ROTATION, "position": {"x": 1, "y": 2, "z": 4}}, "time": 0.75},
    {"pose": {"name": "slam", "position": {"x": 1, "y": 2, "z": 3}}, "time": 1.25},
    {"gnssEnu": {"mean": [1, 2, 3], "covariance": [0.5]}, "time": 1.25},
    {"time": 1.5, "position": {"x": 1, "y": 2, "z": 3}, "orientation": ROTATION, "status": "TRACKING"},
    {"droppedFrame": True, "time": 1.5},
]


def test_lines_of_every_kind_come_back_key_by_key_and_what_was_changed_is_written(tmp_path):
    write_drive(tmp_path / "drive", EVERY_KIND)
    for found in written_again(tmp_path / "drive")[:2]:
        assert in_order(found) == in_order(EVERY_KIND)

    def rotated(scene):
        imu = scene.sensor("imu")
        gyroscope = imu.streams["gyroscope"]
        changed = replace(imu, streams={**imu.streams, "gyroscope": replace(gyroscope, values=gyroscope.values + 1)})
        return replace(scene, sensors=tuple(changed if sensor is imu else sensor for sensor in scene.sensors))

    write_drive(tmp_path / "changed" / "drive", EVERY_KIND)
    expected = copy.deepcopy(EVERY_KIND)
    for sensor in (line["sensor"] for line in expected if "sensor" in line):
        sensor["values"] = [value + (sensor["type"] == "gyroscope") for value in sensor["values"]]
    found, _ = written_again(tmp_path / "changed" / "drive", rotated, scene_file=False)
    assert in_order(found) == in_order(expected)


def test_the_records_of_a_line_are_written_one_by_one_and_its_unknown_keys_stay(tmp_path):
    sample = {"sensor": {"type": "gyroscope", "values": [9.0, 9.0, 9.0], "temperature": 40}}
    fix = {"gps": {"latitude": 1.0, "longitude": 2.0, "altitude": 3.0}}
    images = {"frames": [{"cameraInd": 0, "time": 0.5, "features": [1]}], "number": 0}
    drive = [sample | images | fix | {"status": "INIT", "time": 0.5}, fix | sample | {"note": 1, "time": 1.5}]
    write_drive(tmp_path / "drive", drive)
    expected = [sample | {"time": 0.5}, fix | {"time": 0.5}, images | {"status": "INIT", "time": 0.5}]
    expected += [sample | {"note": 1, "time": 1.5}, fix | {"time": 1.5}]
    assert in_order(written_again(tmp_path / "drive", scene_file=False)[0]) == in_order(expected)


beside_entry = st.dictionaries(
    st.sampled_from(["exposureTimeSeconds", "number", "line", "note", "ünïcode %s"]),
    st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=3)),
    max_size=2,
).map(lambda found: found if isinstance(found.get("exposureTimeSeconds", 0.5), float) else {})
beside_line = st.dictionaries(st.sampled_from(["status", "note"]), st.one_of(st.none(), numbers), max_size=1)
SPELLINGS = [("KANNALA_BRANDT4", 4), ("kannala-brandt4", 0), ("brown-conrady", 5), ("PINHOLE", 3), ("pinhole", 0)]


@st.composite
def camera_models(draw):
    """Parameters in any spelling, some or all of them."""
    name, count = draw(st.sampled_from(SPELLINGS))
    whole = {
        "focalLengthX": draw(st.sampled_from([9, 9.0, 284.929992675781])),
        "focalLengthY": draw(st.floats(5, 300)),
        "principalPointX": 3.5,
        "principalPointY": draw(st.floats(2, 5)),
        draw(st.sampled_from(["model", "distortionModel"])): name,
        "distortionCoefficients": draw(st.lists(st.floats(-0.01, 0.01), min_size=count, max_size=count)),
    }
    some = {"principalPointX": draw(st.sampled_from([3, 3.5, 4.25]))}
    return draw(st.sampled_from([whole, some, {"focalLength": 11}, {}])) | draw(
        st.sampled_from([{}, {"rollingShutter": True}])
    )


@st.composite
def mounts(draw):
    """A matrix with rounded digits, by rows or flat by columns."""
    matrix = np.eye(4)
    rotation = draw(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
    # five digits leave a rotation within 1e-4 of one, which is read without a word
    matrix[:3, :3] = Rotation.from_rotvec(rotation).as_matrix().round(5)
    matrix[:3, 3] = draw(st.lists(st.floats(-5, 5), min_size=3, max_size=3))
    return draw(st.sampled_from([matrix.tolist(), matrix.T.ravel().tolist()]))


@st.composite
def entries(draw, index, seconds):
    entry = {"cameraInd": index, "time": seconds + draw(st.sampled_from([0, 0, 1e-9, -0.004, 0.4]))}
    entry |= draw(beside_entry)
    if draw(st.booleans()):
        entry["cameraParameters"] = draw(camera_models())
    if draw(st.booleans()):
        entry["imuToCamera"] = draw(mounts())
    entry |= draw(st.sampled_from([{}, {}, {"missingBitmap": True}]))
    return {key: entry[key] for key in draw(st.permutations(list(entry)))}


@st.composite
def drives_of_images(draw):
    """Lines of images, each of some cameras, with a sample between."""
    first, count, cameras = draw(st.sampled_from([0, 0, 28])), draw(st.integers(1, 5)), draw(st.integers(1, 2))
    steps = draw(st.lists(st.sampled_from([0.1, 0.033, 1.5]), min_size=count, max_size=count))
    found = []
    for number, seconds in enumerate(np.cumsum(steps).tolist(), first):
        listed = [index for index in range(cameras) if draw(st.integers(0, 4))]
        listed = [draw(entries(index, seconds)) for index in draw(st.permutations(listed))]
        found.append({"frames": listed, "number": number, "time": seconds} | draw(beside_line))
        if draw(st.booleans()):
            found.append({"sensor": {"type": "gyroscope", "values": [0, 0.5, 1]}, "time": seconds + 0.01})
    return found


def by_camera(drive):
    """The cameras of a line stand in it in the order of their numbers."""
    ordered = copy.deepcopy(drive)
    for line in ordered:
        line.get("frames", []).sort(key=lambda entry: entry["cameraInd"])
    return ordered


def shows(line, index):
    return any(entry["cameraInd"] == index and entry.get("missingBitmap") is not True for entry in line)


@given(drives_of_images())
def test_frames_lines_are_written_as_they_were(drive):
    listed = [line["frames"] for line in drive if "frames" in line]
    cameras = range(len({entry["cameraInd"] for line in listed for entry in line}))
    if not cameras or not all(any(shows(line, index) for line in listed) for index in cameras):
        return  # a camera without any image is left out, and the loss report says so
    models = [entry["cameraParameters"] for line in listed for entry in line if "cameraParameters" in entry]
    if not all("focalLengthX" in model for model in models):
        return  # a part of a camera model is written whole where the calibration becomes that of the images
    with TemporaryDirectory() as temporary:
        folder = Path(temporary, "drive")
        write_drive(folder, drive, cameras=len(cameras))
        for found in written_again(folder)[:2]:
            assert by_camera(found) == by_camera(drive)
        for name in ("again", "from_scene"):
            for index in cameras:
                files = sorted(Path(temporary, name, f"frames{index + 1}").iterdir())
                for number, (path, line) in enumerate(zip(files, listed, strict=True)):
                    if shows(line, index):
                        shown = np.asarray(Image.open(path))[0, 0].astype(int)
                        # scene files hold JPEG, which is off by a step or two where an image is of one colour
                        assert np.abs(shown - [10 * number, 0, 100 * index]).max() <= 4


def recorded_entry(index):
    parameters = {
        "focalLengthX": 284.917388916016,
        "focalLengthY": 285.203491210938,
        "principalPointX": 3.4547119140625,
        "principalPointY": 3.77349853515625 + index,
        "distortionModel": "KANNALA_BRANDT4",
        "distortionCoefficients": [-0.005131, 0.04012, -0.03751, 0.006324],
    }
    rows = [[0.01361, 0.9996, -0.02533, 0.0611 - index / 10], [-0.9998, 0.01371, 0.003916, -0.0203]]
    rows += [[0.00426, 0.02527, 0.9997, -0.008021], [0, 0, 0, 1]]
    return {"cameraInd": index, "cameraParameters": parameters, "imuToCamera": rows, "time": 1.416107177734375}


POSITION = {"x": -0.0081264712, "y": 0.022171846215, "z": 0.0079135264873}
FIX = {"accuracy": 3.5, "altitude": 12.70541106834269, "latitude": 60.1729, "longitude": 24.9211}
RECORDED = [
    {"groundTruth": {"position": POSITION, "orientation": ROTATION}, "time": 1.410257080078125},
    {"frames": [recorded_entry(0), recorded_entry(1)], "number": 31, "time": 1.416107177734375},
    {"gps": FIX, "time": 1.41977294921875},
]
"""Lines as recorders write them: a stereo pair with all its parameters, more decimals than a nanosecond."""


def test_lines_of_a_recorder_come_back_without_a_loss(tmp_path):
    write_drive(tmp_path / "drive", RECORDED, cameras=2)
    found, from_scene, report = written_again(tmp_path / "drive")
    assert found == from_scene == RECORDED
    assert {loss.field for loss in report} <= {"replay"}


def frames_written(drive, tmp_path, change=lambda scene: scene, cameras=1):
    write_drive(tmp_path / "drive", drive, cameras=cameras)
    found, reported = written_again(tmp_path / "drive", change, scene_file=False)
    return [line for line in found if "frames" in line], reported


def with_images(camera, images):
    return replace(camera, images=type(camera.images).of(images, [image.timestamp_ns for image in images]))


def test_a_mounting_that_was_normalised_and_a_camera_model_that_was_changed_are_written_as_they_are_now(tmp_path):
    drive = copy.deepcopy(RECORDED[1:2])
    off = drive[0]["frames"][0]["imuToCamera"]
    off[0] = [1.003 * number for number in off[0]]
    found, _ = frames_written(drive, tmp_path, cameras=2)
    taken, kept = (np.array(entry["imuToCamera"]) for entry in found[0]["frames"])
    np.testing.assert_allclose(taken[:3, :3] @ taken[:3, :3].T, np.eye(3), atol=1e-12)
    # the nearest rotation is hardly more off than the row that is 0.003 too long
    np.testing.assert_allclose(taken, np.array(off), atol=0.0035)
    assert kept.tolist() == drive[0]["frames"][1]["imuToCamera"]

    def wider(scene):
        camera = scene.sensor("camera0")
        changed = with_images(camera, [replace(shot, camera=replace(shot.camera, fx=200.0)) for shot in camera.images])
        return replace(scene, sensors=tuple(changed if sensor is camera else sensor for sensor in scene.sensors))

    found, _ = frames_written(RECORDED, tmp_path / "changed", wider, cameras=2)
    changed, kept = (entry["cameraParameters"] for entry in found[0]["frames"])
    before, other = (entry["cameraParameters"] for entry in RECORDED[1]["frames"])
    assert (changed["focalLengthX"], changed["focalLengthY"]) == (200.0, before["focalLengthY"])
    assert kept == other


def numbered(*numbers):
    times = [k / 10 for k in range(len(numbers))]
    entries = [[{"cameraInd": 0, "time": time}] for time in times]
    return [{"frames": e, "number": n, "time": t} for e, n, t in zip(entries, numbers, times, strict=True)]


def test_numbers_stay_with_their_gaps_and_images_that_were_left_out_are_not_counted(tmp_path):
    def shorter(scene):
        camera = scene.cameras[0]
        return replace(scene, sensors=(with_images(camera, [camera.images[k] for k in (1, 2)]),))

    for numbers in ([0, 1, 2], [28, 29, 30], [28, 30, 31]):
        found, reported = frames_written(numbered(*numbers), tmp_path / str(numbers))
        assert [line["number"] for line in found] == numbers
        assert "frames[].number" not in {loss.field for loss in reported}
    found, _ = frames_written(numbered(28, 29, 30), tmp_path, shorter)
    assert [(line["number"], line["time"]) for line in found] == [(0, 0.1), (1, 0.2)]


def test_lines_whose_clock_was_moved_are_put_together_anew_and_that_is_reported(tmp_path):
    def later(scene):
        (camera,) = scene.cameras
        moved = [replace(shot, timestamp_ns=shot.timestamp_ns + 10**9, extras={}) for shot in camera.images]
        return replace(scene, sensors=(with_images(camera, moved),))

    drive = numbered(0, 1, 2)
    drive[0]["time"] = -0.05
    drive[1]["frames"][0]["missingBitmap"] = True
    found, reported = frames_written(drive, tmp_path, later)
    assert [(line["number"], line["time"]) for line in found] == [(0, 1.0), (1, 1.2)]
    assert {loss.field: loss.count for loss in reported}["frames"] == 2


def test_cameras_that_a_line_does_not_list_are_not_listed_and_that_is_reported(tmp_path):
    drive = [*RECORDED[1:2], {"frames": [{"cameraInd": 1, "time": 2.0}], "number": 32, "time": 2.0}]
    found, reported = frames_written(drive, tmp_path, cameras=2)
    assert found == drive
    assert [loss.count for loss in reported if "do not list every camera" in loss.what] == [1]
    assert not [loss for loss in reported if "not in step" in loss.what]


EXACT_NS = 2**51
"""Up to 26 days, a 64-bit number of seconds holds every nanosecond."""
EPOCH_NS = 1_700_000_000_000_000_000
rigids = st.builds(
    lambda rotation, translation: RigidTransform(Rotation.from_rotvec(rotation).as_matrix(), translation),
    floats(3, within=3),
    floats(3, within=50),
)


def round_trip(scene: sc.Scene, **options):
    """Write a scene and read it; gives what was read, and the losses that were reported."""
    with TemporaryDirectory() as folder:
        report = write_scene(scene, Path(folder, "drive"), **options)
        with open_scene(Path(folder, "drive")) as found:
            yield found, [loss for loss in report if loss.field != "replay"]


def gyroscope(timestamps, values=None, seconds=None):
    values = np.ones((len(timestamps), 3)) if values is None else values
    return sc.Scene((sc.ImuSensor("imu", {"gyroscope": sc.VectorSamples(timestamps, values, seconds)}),))


@given(timestamps(-EXACT_NS, EXACT_NS, unique=False), st.data())
def test_samples_keep_their_times_to_the_nanosecond_and_their_values_to_the_bit(timestamps, data):
    values = data.draw(floats(len(timestamps), 3, within=1e6))
    for found, report in round_trip(gyroscope(timestamps, values)):
        assert not report
        stream = found.sensor("imu").streams["gyroscope"]
        np.testing.assert_array_equal(stream.timestamps_ns, timestamps)
        np.testing.assert_array_equal(stream.values, values)


@given(st.lists(st.floats(-9e9, 9e9), min_size=1, max_size=12), timestamps(EPOCH_NS, EPOCH_NS + 10**13, unique=False))
def test_the_seconds_that_a_file_had_are_in_the_next_and_times_since_1970_off_as_reported(seconds, since_1970):
    numbers = np.array(sorted(seconds))
    times = np.rint(numbers * 1e9).astype(np.int64)
    for found, report in round_trip(gyroscope(times, None, numbers)):
        assert not report
        stream = found.sensor("imu").streams["gyroscope"]
        np.testing.assert_array_equal(stream.file_seconds, numbers)  # equal as numbers: -0.0 is 0.0
        np.testing.assert_array_equal(stream.timestamps_ns, times)
    for found, report in round_trip(gyroscope(since_1970)):
        off = np.abs(found.sensor("imu").streams["gyroscope"].timestamps_ns - since_1970)
        # half of the step of such seconds, 2^-22 s, and half of the step of the same time in nanoseconds, 2^8 ns
        assert off.max() <= 119 + 128
        assert sum(loss.count for loss in report) == int((off > 0).sum())


@given(timestamps(-EXACT_NS, EXACT_NS), st.booleans(), st.data())
def test_trajectories_come_back_under_their_names(timestamps, oriented, data):
    count = len(timestamps)
    positions = data.draw(floats(count, 3, within=1e6))
    rotations = data.draw(floats(count, 3, within=3))
    quaternions = Rotation.from_rotvec(rotations).as_quat() if oriented else None
    known = ["groundTruth", "pose", "arkit", "my method", "output"]
    names = data.draw(st.lists(st.sampled_from(known), min_size=1, unique=True))
    scene = sc.Scene((), trajectories={name: sc.Trajectory(name, timestamps, positions, quaternions) for name in names})
    for found, _ in round_trip(scene):
        assert set(found.trajectories) == set(names)
        for trajectory in found.trajectories.values():
            np.testing.assert_array_equal(trajectory.timestamps_ns, timestamps)
            np.testing.assert_array_equal(trajectory.positions, positions)
            assert (trajectory.quaternions_xyzw is None) == (not oriented)
            if oriented:
                np.testing.assert_array_equal(trajectory.quaternions_xyzw, quaternions)


@given(timestamps(-EXACT_NS, EXACT_NS, unique=False), st.data())
def test_fixes_come_back_with_the_accuracies_that_they_have(timestamps, data):
    count = len(timestamps)
    lla = data.draw(floats(count, 3, within=90))
    known = st.one_of(st.just(np.nan), st.floats(0, 100))
    accuracies = [data.draw(hnp.arrays(np.float64, count, elements=known)) for _ in range(2)]
    scene = sc.Scene((sc.GnssSensor("gnss", timestamps, lla, *accuracies),))
    for found, _ in round_trip(scene):
        gnss = found.sensor("gnss")
        np.testing.assert_array_equal(gnss.timestamps_ns, timestamps)
        np.testing.assert_array_equal(gnss.positions_lla, lla)
        np.testing.assert_array_equal(gnss.accuracies, accuracies[0])
        np.testing.assert_array_equal(gnss.vertical_accuracies, accuracies[1])


def points_at(data: st.DataObject, start_ns: int) -> sc.LidarPoints:
    count = data.draw(st.integers(0, 6))
    floats = st.floats(allow_nan=True, allow_infinity=True, width=32)
    offsets = data.draw(hnp.arrays(np.int64, count, elements=st.integers(0, 10**8)))
    return sc.LidarPoints(
        positions=data.draw(hnp.arrays(np.float32, (count, 3), elements=floats)),
        intensities=data.draw(hnp.arrays(np.uint8, count)),
        timestamps_ns=start_ns + offsets,
        rings=data.draw(hnp.arrays(np.uint16, count)),
    )


@given(timestamps(-EXACT_NS, EXACT_NS), rigids, st.data())
def test_sweeps_come_back_point_by_point(timestamps, mount, data):
    frames = [sc.LidarFrame(int(timestamp), points_at(data, int(timestamp))) for timestamp in timestamps]
    lidars = tuple(
        sc.LidarSensor(f"lidar{index}", sc.LazyFrames.of(frames, timestamps), mount=mount) for index in range(2)
    )
    for found, report in round_trip(sc.Scene(lidars)):
        assert not report
        for lidar in found.lidars:
            # the mounting is inverted on the way there and back
            np.testing.assert_allclose(lidar.mount.matrix, mount.matrix, atol=1e-12)
            np.testing.assert_array_equal(lidar.frames.timestamps_ns, timestamps)
            for before, after in zip(frames, lidar.frames, strict=True):
                for name in ("positions", "intensities", "timestamps_ns", "rings"):
                    np.testing.assert_array_equal(getattr(after.points, name), getattr(before.points, name))


HELD = ("brown_conrady", "fisheye", "kannala_brandt18", "omnidir", "pinhole")
"""The models that the format has; others come back as the nearest of these."""


@st.composite
def exact_camera_models(draw: st.DrawFn) -> Camera:
    name = draw(st.sampled_from(HELD))
    names = MODELS[name].coefficient_names
    count = draw(st.sampled_from(sorted({0, min(5, len(names)), len(names)})))
    # the format has no decentring
    values = [0.0 if names[k] in {"lx", "ly"} else draw(st.floats(-0.01, 0.01)) for k in range(count)]
    numbers = [draw(st.floats(10, 50)) for _ in range(4)]
    return Camera(name, 32, 16, *numbers, tuple(values))


@given(exact_camera_models(), rigids, timestamps(-EXACT_NS, EXACT_NS), st.integers(1, 2))
def test_cameras_come_back_with_camera_model_mounting_times_and_pixels(camera_model, mount, timestamps, count):
    rng = np.random.default_rng(len(timestamps))
    shots = [rng.integers(0, 256, (16, 32, 3), dtype=np.uint8) for _ in timestamps]
    images = [sc.CameraImage.of(int(time), camera_model, rgb) for time, rgb in zip(timestamps, shots, strict=True)]
    frames = sc.LazyFrames.of(images, timestamps)
    cameras = tuple(sc.CameraSensor(f"camera{index}", camera_model, frames, mount=mount) for index in range(count))
    for found, report in round_trip(sc.Scene(cameras), images="png"):
        assert not report
        assert len(found.cameras) == count
        for camera in found.cameras:
            np.testing.assert_array_equal(intrinsics_vector(camera.camera), intrinsics_vector(camera_model))
            np.testing.assert_allclose(camera.mount.matrix, mount.matrix, atol=1e-12)
            np.testing.assert_array_equal(camera.images.timestamps_ns, timestamps)
            for rgb, image in zip(shots, camera.images, strict=True):
                np.testing.assert_array_equal(image.rgb, rgb)


@pytest.mark.parametrize("start_ns", [0, -5_000_000_000, EPOCH_NS])
def test_a_drive_with_h264_has_as_many_images_at_the_same_times(start_ns, tmp_path):
    camera_model = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
    timestamps = start_ns + np.cumsum([0, 100, 100, 33, 170, 97, 100]).astype(np.int64) * 1_000_000
    shots = [np.full((48, 64, 3), 30 * k + 20, np.uint8) for k in range(len(timestamps))]
    images = [sc.CameraImage.of(int(time), camera_model, rgb) for time, rgb in zip(timestamps, shots, strict=True)]
    frames = sc.LazyFrames.of(images, timestamps)
    camera = sc.CameraSensor("camera0", camera_model, frames, mount=RigidTransform.identity())
    write_scene(sc.Scene((camera,)), tmp_path / "drive")
    with open_scene(tmp_path / "drive") as found:
        after = found.cameras[0]
        # whole milliseconds since 1970 come back within what a 64-bit number of seconds holds
        assert np.abs(after.images.timestamps_ns - timestamps).max() <= (0 if start_ns < 10**12 else 128)
        for rgb, image in zip(shots, after.images, strict=True):
            assert np.abs(image.rgb.astype(int) - rgb).max() <= 3  # flat grey through crf 18
