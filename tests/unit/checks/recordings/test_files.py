"""Rules about calibrations, `frames` lines, lidar files, stereo images and faults of a log; and `--fix`."""

import ast
import copy
import gzip
import json
import struct
from pathlib import Path

import av
import numpy as np
import pytest
from click.testing import CliRunner

import sceneloom
from sceneloom.checks import validate
from sceneloom.checks.faults import FAULT_CODES, RECORDING_FAULT_RULES
from sceneloom.checks.recordings.files import CALIBRATION_RULES, FRAME_LINE_RULES, LIDAR_LINE_RULES
from sceneloom.cli.main import sceneloom as command_line

RULES = tuple(rule.id for table in (FRAME_LINE_RULES, CALIBRATION_RULES, LIDAR_LINE_RULES) for rule in table)
FRAMES = 12
LAYOUT = "RoboSense M1 XYZIRT"


def camera(y=0.0, width=48, height=32, focal=40.0, **fields):
    """A camera that looks along x of a vehicle whose z points up, `y` to the left."""
    mount = [[0.0, -1.0, 0.0, y], [0.0, 0.0, -1.0, 1.2], [1.0, 0.0, 0.0, -1.5], [0.0, 0.0, 0.0, 1.0]]
    model = {"model": "pinhole", "distortionCoefficients": [], "focalLengthX": focal, "focalLengthY": focal}
    centre = {"principalPointX": (width - 1) / 2, "principalPointY": (height - 1) / 2}
    return {**model, **centre, "imageWidth": width, "imageHeight": height, "imuToCamera": mount, **fields}


def sample(kind, time, *values):
    return {"sensor": {"type": kind, "values": list(values)}, "time": time}


def lidar_line(k):
    return {"lidar": {"model": LAYOUT, "dataFile": f"lidar/{k}.bin"}, "time": 0.1 * k}


def sound():
    lines = []
    for k in range(FRAMES):
        time = 0.1 * k
        lines.append({"frames": [{"cameraInd": index, "time": time} for index in (0, 1)], "number": k, "time": time})
        lines.append(lidar_line(k))
    lines += [sample("accelerometer", 0.01 * k + 0.003, 0.0, 0.0, 9.81) for k in range(120)]
    return {
        "lines": lines,
        "calibration": {
            "cameras": [camera(), camera(-0.4)],
            "lidars": [{"model": LAYOUT, "imuToLidar": np.eye(4).tolist()}],
        },
        "points": {f"lidar/{k}.bin": ring_of_points(0.1 * k) for k in range(FRAMES)},
    }


def ring_of_points(time, radius=12.0):
    """(x, y, z, intensity, ring, timestamp) of 60 points around the lidar."""
    angles = np.linspace(0, 6, 60)
    return [(radius * np.cos(a), radius * np.sin(a), -1.0, 9, 0, time + 0.01 * a) for a in angles]


def written(folder, lines, calibration, points):
    (folder / "lidar").mkdir(parents=True, exist_ok=True)
    texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
    (folder / "data.jsonl").write_text("".join(text + "\n" for text in texts))
    (folder / "calibration.json").write_text(json.dumps(calibration))
    for name, of_sweep in points.items():
        (folder / name).write_bytes(b"".join(struct.pack("<fffBHd", *point) for point in of_sweep))
    return folder


def encoded(path, images, codec="ffv1", pixels="bgr0", **options):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options={"threads": "1", **options})
        (stream.height, stream.width), stream.pix_fmt = images[0].shape[:2], pixels
        for rgb in images:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
            container.mux(stream.encode(frame.reformat(format=pixels)))
        container.mux(stream.encode())
    return path.read_bytes()


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    images = np.random.default_rng(0).integers(0, 255, (FRAMES, 32, 48, 3), np.uint8)
    return encoded(tmp_path_factory.mktemp("video") / "data.mkv", images)


def frames_of(lines):
    return [line for line in lines if "frames" in line]


def numbered(*numbers):
    def change(rig):
        for line, number in zip(frames_of(rig["lines"]), numbers, strict=True):
            line["number"] = number

    return change


def entry(**fields):
    """Change fields of the first camera's entry; None takes one out."""

    def change(rig):
        given = rig["calibration"]["cameras"][0]
        given.update(fields)
        for key in [key for key, value in given.items() if value is None]:
            del given[key]

    return change


def centre(x, y, **fields):
    return entry(principalPointX=x, principalPointY=y, **fields)


def frames_with(change, *rows):
    def injected(rig):
        for line in frames_of(rig["lines"])[slice(*rows)]:
            change(line["frames"])

    return injected


def late(seconds, *cameras):
    """Report of some cameras that their images were taken later than their lines."""

    def change(entries):
        for index in cameras:
            entries[index]["time"] += seconds

    return frames_with(change, None)


def moved(change, *cameras):
    def injected(rig):
        for index in cameras:
            given = rig["calibration"]["cameras"][index]
            given["imuToCamera"] = np.asarray(change(np.array(given["imuToCamera"], float))).tolist()

    return injected


MILLIMETRES = np.array([[1, 1, 1, 1000]] * 3 + [[1, 1, 1, 1]])
SKEWED = np.array([[1, 1.002, 1, 1]] + [[1, 1, 1, 1]] * 3)
# a camera rotated about its own x axis until it looks at the sky
UPWARDS = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
FLAT = [0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0.1, 1.2, -1.5, 1]
MOUNT = camera()["imuToCamera"]
SHIFTED = entry(imuToCameraShiftSeconds=-12.0)
GAPS, DOUBLED = "frame-numbers-gaps", (0, 1, 2, 2, 4, 5, 6, 7, 8, 9, 10, 11)


def far_points(rig):
    rig["points"] = {name: ring_of_points(p[0][5], 12_000.0) for name, p in rig["points"].items()}


def one_file_twice(rig):
    lidar = [line for line in rig["lines"] if "lidar" in line]
    lidar[5]["lidar"]["dataFile"] = lidar[4]["lidar"]["dataFile"]


def brown(count):
    return entry(model="brown-conrady", distortionCoefficients=[0.0] * count)


def without_bitmaps(entries):
    entries[1].update(missingBitmap=True)


# what is done to the rig, then rules and words of their findings
INJECTED = [
    (lambda rig: None,),
    (numbered(*range(28, 40)), "frame-numbers-begin", "the first is 28; expected 0"),
    (numbered(*DOUBLED), "frame-numbers-increasing", "2 after 2; expected 3", GAPS, "4 after 2; 3 missing"),
    (numbered(*range(6), *range(9, 15)), GAPS, "9 after 5; 6 to 8 missing"),
    (frames_with(lambda e: e.pop(1), 3, 5), "frames-without-camera", "cameraInd 1 is missing in 2 of 12 lines"),
    (frames_with(without_bitmaps, 3, 6), "frames-missing-bitmap", "missingBitmap"),
    (late(100.0, 0, 1), "frame-entry-times", "of camera 1 is up to +100.000 s off its line's time in 12 of 12 lines"),
    (late(0.008, 1), "stereo-in-step", "are 8.0 ms apart in 12 of 12 lines"),
    (entry(imuToCamera=None, imuToCameraMatrix=MOUNT), "calibration-spelling", "expected the key `imuToCamera`"),
    (entry(imuToCamera=FLAT), "calibration-spelling", "16 numbers, read column by column; expected 4 rows of 4"),
    (entry(model="KANNALA_BRANDT4"), "calibration-spelling", "'KANNALA_BRANDT4'; expected 'kannala-brandt4'"),
    (brown(5), "calibration-spelling", "5 numbers; expected 8, padded with 0"),
    (entry(shutter_roll_time_seconds=0.01), "calibration-keys-known", "is 'shutterRollTimeSeconds' meant?"),
    (entry(shutterRollTimeSeconds=5.0), "calibration-shutter", "5 s; expected 0 to 0.1: probably milliseconds"),
    (SHIFTED, "calibration-shift", "-12 s; expected at most 0.5 either way: probably milliseconds"),
    (entry(focalLengthX=4.2, focalLengthY=4.2), "calibration-focal-length", "probably in millimetres"),
    (entry(focalLengthX=0.8, focalLengthY=0.8), "calibration-focal-length", "probably in parts of the image's width"),
    (entry(focalLengthY=60), "calibration-focal-length", "expected nearly equal ones"),
    (centre(0.49, 0.51), "calibration-principal-point", "probably in parts of the image"),
    (centre(15.5, 23.5), "calibration-principal-point", "probably x and y are exchanged"),
    (centre(47.5, 31.5), "calibration-principal-point", "probably for images 2 times as wide and high"),
    (centre(47.5, 31.5, imageWidth=96, imageHeight=64), "calibration-size", "calibrated for 96x64, images are 48x32"),
    (moved(SKEWED.__mul__, 0), "mounting-rotation", "the nearest rotation was taken"),
    (moved(MILLIMETRES.__mul__, 1), "mounting-far", "probably millimetres", "stereo-baseline", "probably millimetres"),
    (moved(lambda m: MOUNT, 1), "mounting-repeated", "the same as of camera 0"),
    (moved(np.linalg.inv, 0, 1), "mounting-inverted", "probably inverted or transposed"),
    (moved(UPWARDS.__matmul__, 0), "mounting-steep", "camera 0 looks 90° up"),
    (lambda r: r["calibration"]["cameras"].reverse(), "stereo-sides", "camera 1 is 0.400 m to the left of camera 0"),
    (moved(lambda m: camera(-0.002)["imuToCamera"], 1), "stereo-baseline", "from 2.0 mm apart"),
    (one_file_twice, "lidar-file-repeated", "'lidar/4.bin' is that of line"),
    (far_points, "lidar-range", "probably millimetres"),
]


@pytest.mark.parametrize("case", INJECTED)
def test_what_is_wrong_with_a_rig_is_found(tmp_path, video, case):
    change, expected, rig = case[0], dict(zip(case[1::2], case[2::2], strict=True)), sound()
    change(rig)
    rig["lines"].sort(key=lambda line: line["time"])
    written(tmp_path, **rig)
    for name in ("data.mkv", "data2.mkv"):
        (tmp_path / name).write_bytes(video)
    findings = {finding.rule: finding for finding in validate(tmp_path, rules=RULES).findings}
    assert set(expected) <= set(findings)
    for rule, words in expected.items():
        assert words in findings[rule].message
    # what one mistake spoils besides is reported, too: sides and distances of an inverted or exchanged pair
    assert set(findings) - set(expected) <= ({"stereo-sides", "stereo-baseline", "mounting-far"} if expected else set())


def test_every_rule_about_rigs_is_shown_by_a_case():
    assert {rule for case in INJECTED for rule in case[1::2]} == set(RULES) - {"stereo-images"}


WIDTH, HEIGHT, COUNT = 384, 192, 5
LEFT, RIGHT = (camera(y, WIDTH, HEIGHT, 300.0) for y in (0.0, -0.5))


def shifted(images, pixels=15):
    """What a camera farther to the right sees of a wall 10 m away: 300 px times 0.5 m over 10 m."""
    return np.roll(images, -pixels, axis=2)


def test_images_on_the_wrong_side_are_found_and_nothing_is_stated_where_they_report_no_side(tmp_path):
    # of a wall with blots of 6 pixels, another part of it each time
    blots = np.random.default_rng(3).integers(20, 235, (COUNT, HEIGHT // 6, WIDTH // 6), np.uint8)
    wall = np.repeat(np.repeat(blots, 6, axis=1), 6, axis=2)
    flat = np.full((COUNT, HEIGHT, WIDTH), 90, np.uint8)
    entries = [{"cameraInd": 0}, {"cameraInd": 1}]
    lines = [{"frames": entries, "number": k, "time": 0.1 * k} for k in range(COUNT)]

    def found(first, second, cameras=(LEFT, RIGHT)):
        """Of images of a stereo pair, the second camera half a metre to the right of the first."""
        for name, grey in (("data.mkv", first), ("data2.mkv", second)):
            encoded(tmp_path / name, np.repeat(grey[..., None], 3, axis=3))
        folder = written(tmp_path, lines, {"cameras": list(cameras)}, {})
        return [finding.message for finding in validate(folder, rules=["stereo-images"]).findings]

    [message] = found(shifted(wall), wall)
    assert "against the side on which their mountings put them" in message
    assert len(found(wall, shifted(wall), (RIGHT, LEFT))) == 1
    # small images are looked at as they are: 80 px times 0.5 m over 10 m
    images, cameras = wall[:, :96, :96], [camera(y, 96, 96, 80.0) for y in (0.0, -0.5)]
    assert found(images, shifted(images, 4), cameras) == []
    assert len(found(shifted(images, 4), images, cameras)) == 1
    for pair in (
        (wall, shifted(wall)),
        (wall, shifted(wall), (LEFT, LEFT)),
        (wall, wall),  # all of it far away
        (wall, shifted(wall, 1)),
        (flat, flat),
        (wall, wall[::-1, ::-1]),  # nothing in common
    ):
        assert found(*pair) == []


CAMERA = camera(note="kept as it is")


def pose(time, x):
    rotation = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    return {"groundTruth": {"position": {"x": x, "y": 0.0, "z": 0.0}, "orientation": rotation}, "time": time}


def decoded(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


class Drive:
    """A recording with IMU, fixes, poses, images and sweeps that is written, repaired, and compared."""

    def __init__(self, folder):
        self.folder, self.repaired, self.again = folder / "drive", folder / "repaired", folder / "again"
        lidar = {"model": LAYOUT, "imuToLidar": np.eye(4).tolist()}
        self.lines, self.calibration = [], {"cameras": [copy.deepcopy(CAMERA)], "lidars": [lidar]}
        for k in range(120):
            self.lines.append(sample("accelerometer", 0.01 * k + 0.001, 0.1, 0.001 * k, 9.81))
            self.lines.append(sample("gyroscope", 0.01 * k + 0.001, 0.0, 0.0, 0.01 + 0.001 * k))
        for k in range(FRAMES):
            time = 0.1 * k
            self.lines.append({"frames": [{"cameraInd": 0, "time": time, "own": k}], "number": k, "time": time})
            fix = {"latitude": 60.17 + 1e-6 * k, "longitude": 24.94, "altitude": 14.0, "accuracy": 0.5}
            self.lines += [lidar_line(k), pose(time, 0.5 * k), {"gps": fix, "time": time + 0.005}]
        self.lines.sort(key=lambda line: line["time"])

    def write(self, **encoding):
        points = {
            f"lidar/{k}.bin": [(12.0, 0.01 * i, -1.0, 9, 0, 0.1 * k + 0.001 * i) for i in range(90)]
            for k in range(FRAMES)
        }
        written(self.folder, self.lines, self.calibration, points)
        # grey: ways from YUV to RGB differ in how they spread colours over pixels
        cells = np.random.default_rng(0).integers(20, 230, (FRAMES, 8, 12, 1), np.uint8)
        images = cells.repeat(4, axis=1).repeat(4, axis=2).repeat(3, axis=3)
        encoded(self.folder / "data.mkv", images, **(encoding or {"g": "1"}))

    def fix(self, **encoding):
        """Write and repair it; what is repaired is not repaired again."""
        self.write(**encoding)
        report = validate(self.folder, fix=self.repaired)
        assert report.output == str(self.repaired)
        again = validate(self.repaired, fix=self.again)
        assert again.fixed == again.left_out == again.losses == ()
        for path in (p for p in self.repaired.rglob("*") if p.is_file()):
            other = self.again / path.relative_to(self.repaired)
            if path.suffix == ".mkv":
                # containers that were written and that were copied differ in their heads
                assert all(map(np.array_equal, decoded(path), decoded(other)))
            else:
                assert path.read_bytes() == other.read_bytes(), path.name
        assert not rules_of(report.findings) & rules_of(report.fixed), report.findings
        return report

    def repaired_lines(self):
        return [json.loads(line) for line in (self.repaired / "data.jsonl").read_text().splitlines()]

    def repaired_calibration(self):
        return json.loads((self.repaired / "calibration.json").read_text())

    def has_the_same_images(self):
        before, after = decoded(self.folder / "data.mkv"), decoded(self.repaired / "data.mkv")
        return all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.fixture
def drive(tmp_path):
    return Drive(tmp_path)


def rules_of(findings):
    return {finding.rule for finding in findings}


def kept_lines(lines):
    return sorted(json.dumps(line, sort_keys=True) for line in lines)


def with_reversed(lines):
    lines[40:60] = reversed(lines[40:60])


def with_doubled(lines):
    """Let a sample, a fix, a pose and a frame stand there twice."""
    for key in ("sensor", "gps", "groundTruth", "frames"):
        line = [line for line in lines if key in line][5]
        lines.insert(lines.index(line), copy.deepcopy(line))


def with_unit_off(lines):
    line = next(line for line in lines if "groundTruth" in line and line["time"] > 0.5)
    line["groundTruth"]["orientation"]["w"] = 1.005


def counted(*numbers):
    return lambda lines: numbered(*numbers)({"lines": lines})


def with_broken(lines):
    lines.insert(7, '{"sensor":{"type":"gyroscope","values":[NaN,0,0]},"time":0.02}')
    lines.insert(70, '{"sensor":{"type":"gyro')


def with_late_image(lines):
    entry = {"cameraInd": 0, "time": 1.195, "own": FRAMES}
    lines.append({"frames": [entry], "number": FRAMES, "time": 1.195})


@pytest.mark.parametrize(
    ("change", "fixed", "left_out"),
    [
        (lambda lines: None, set(), []),
        (with_doubled, {"stream-times-unique", "frame-numbers-increasing"}, []),
        (with_reversed, {"lines-in-order"}, []),
        (with_unit_off, {"orientation-norm"}, []),
        (counted(*range(28, 40)), {"frame-numbers-begin"}, []),
        (counted(*range(6), *range(8, 14)), {GAPS}, []),
        (counted(*DOUBLED), {GAPS, "frame-numbers-increasing"}, []),
        (with_broken, set(), ["broken-lines"] * 2),
        (with_late_image, set(), ["unmatched-images"]),
    ],
)
@pytest.mark.few(6)
def test_lines_become_those_of_the_sound_drive_again(drive, change, fixed, left_out):
    sound = copy.deepcopy(drive.lines)
    change(drive.lines)
    report = drive.fix()
    assert (rules_of(report.fixed), [finding.rule for finding in report.left_out]) == (fixed, left_out)
    assert report.losses == () or left_out
    assert kept_lines(drive.repaired_lines()) == kept_lines(sound)
    times = [line["time"] for line in drive.repaired_lines()]
    assert times == sorted(times)
    assert drive.repaired_calibration() == drive.calibration
    assert drive.has_the_same_images()


def test_samples_of_one_time_that_differ_are_left_to_a_person(drive):
    line = next(line for line in drive.lines if line.get("sensor", {}).get("type") == "gyroscope")
    drive.lines.insert(drive.lines.index(line) + 1, sample("gyroscope", line["time"], 1.0, 2.0, 3.0))
    drive.write()
    report = validate(drive.folder, fix=drive.repaired)
    assert "stream-times-unique" in rules_of(report.findings)
    assert kept_lines(drive.repaired_lines()) == kept_lines(drive.lines)


H264 = {"codec": "libx264", "pixels": "yuv420p", "g": "12", "bf": "0", "sc_threshold": "0"}


@pytest.mark.parametrize(
    ("dropped", "encoding", "fixed", "left_out"),
    [
        ([4, 5, 9], {}, True, []),  # cut without encoding, as its images stand for themselves
        ([10, 11], {}, False, ["unmatched-images"]),
        ([4, 5, 9], H264, True, []),
    ],
)
def test_the_video_is_cut_to_the_lines(drive, dropped, encoding, fixed, left_out):
    gone = [frames_of(drive.lines)[k] for k in dropped]
    drive.lines = [line for line in drive.lines if line not in gone]
    report = drive.fix(**encoding)
    assert ("frame-numbers-gaps" in rules_of(report.fixed)) is fixed
    assert [finding.rule for finding in report.left_out] == left_out
    # encoded anew without loss, where it cannot be cut
    assert [loss.field for loss in report.losses] == (["sensors[camera0].video"] if encoding else [])
    assert all("FFV1" in loss.what for loss in report.losses)
    stay = [image for k, image in enumerate(decoded(drive.folder / "data.mkv")) if k not in dropped]
    found = decoded(drive.repaired / "data.mkv")
    # the two ways from YUV to RGB, ours and that of PyAV, differ by up to 3 levels
    assert max(np.abs(a.astype(int) - b).max() for a, b in zip(found, stay, strict=True)) <= (3 if encoding else 0)
    frames = frames_of(drive.repaired_lines())
    assert [line["number"] for line in frames] == list(range(len(stay)))
    assert [line["frames"][0]["own"] for line in frames] == [k for k in range(FRAMES) if k not in dropped]


MATRIX = np.array(MOUNT)
STRETCHED = [[0.0, -1.002, 0.0, 0.0], *MATRIX[1:].tolist()]
KANNALA, BROWN = [0.1, 0.01, 0.0, 0.001], [0.1, 0.01, 0.001, 0.002, 0.003]


def model(name, coefficients):
    return {"model": name, "distortionCoefficients": coefficients}


@pytest.mark.parametrize(
    ("given", "rule", "expected"),
    [
        # the nearest rotation to one stretched along an axis is the unstretched one
        ({"imuToCamera": STRETCHED}, "mounting-rotation", {}),
        (model("KANNALA_BRANDT4", KANNALA), "calibration-spelling", model("kannala-brandt4", KANNALA)),
        (model("Brown-Conrady", BROWN), "calibration-spelling", model("brown-conrady", [*BROWN, 0.0, 0.0, 0.0])),
        ({"imuToCamera": None, "imuToCameraMatrix": MATRIX.T.ravel().tolist()}, "calibration-spelling", {}),
    ],
)
def test_the_calibration_is_written_as_the_vendors_software_reads_it(drive, given, rule, expected):
    entry(**given)({"calibration": drive.calibration})
    assert rules_of(drive.fix().fixed) == {rule}
    [repaired] = drive.repaired_calibration()["cameras"]
    np.testing.assert_allclose(repaired.pop("imuToCamera"), MATRIX, atol=1e-12)
    assert repaired == {key: value for key, value in {**CAMERA, **expected}.items() if key != "imuToCamera"}


def test_the_command_line_reports_what_was_fixed_left_out_and_lost(drive):
    with_reversed(drive.lines)
    drive.lines.insert(7, "{torn")
    drive.lines.remove(frames_of(drive.lines)[4])
    drive.write(**H264)
    command = ["validate", str(drive.folder), "--fix", str(drive.repaired), "--quiet"]
    reported = CliRunner().invoke(command_line, command).stdout
    words = ["\nfixed\n", "lines-in-order", "\nleft out\n", "broken-lines", "\nlost\n"]
    places = [reported.index(word) for word in words]
    assert places == sorted(places)
    as_json = json.loads(CliRunner().invoke(command_line, [*command, "--overwrite", "--json"]).stdout)
    assert {finding["rule"] for finding in as_json["fixed"]} == {"lines-in-order", "frame-numbers-gaps"}
    assert [finding["rule"] for finding in as_json["left_out"]] == ["broken-lines"]
    assert [loss["field"] for loss in as_json["losses"]] == ["sensors[camera0].video"]


READER = Path(sceneloom.__file__).parent / "formats" / "recording"
ROWS = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
CAMERA_MODEL = {"model": "pinhole", "imuToCamera": ROWS, "imageWidth": 8, "imageHeight": 8}
CAMERA_MODEL |= {"focalLengthX": 9.0, "focalLengthY": 9.0, "principalPointX": 3.5, "principalPointY": 3.5}
POSE = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
SOUND = [
    {"groundTruth": POSE, "time": 0.0},
    {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": "0.bin"}, "time": 0.5},
    {"groundTruth": POSE, "time": 1.0},
]
MOST = 1000  # faults of one code that are reported with their locations
FRAME = {"frames": [{"cameraInd": 0}], "number": 0, "time": 0.2}


def codes_of_reader():
    """The first argument of every call that keeps a fault; what reads a trajectory alone is no recording."""
    for path in READER.glob("*.py"):
        if path.name == "pose_lines.py":
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in {"fault", "refuse", "_fault"}:
                first = node.args[0]
                if isinstance(first, ast.Constant):
                    yield first.value


def test_every_code_of_the_reader_has_a_rule():
    codes = set(codes_of_reader())
    assert "broken-lines" in codes
    assert codes - FAULT_CODES == set()
    assert len(FAULT_CODES) == len(RECORDING_FAULT_RULES)


@pytest.fixture
def write(tmp_path):
    """A folder of these lines with a lidar file, and with this calibration."""

    def run(lines=SOUND, calibration=None, **files):
        texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
        (tmp_path / "data.jsonl").write_text("".join(text + "\n" for text in texts))
        if calibration is not None:
            text = calibration if isinstance(calibration, str) else json.dumps(calibration)
            (tmp_path / "calibration.json").write_text(text)
        (tmp_path / "0.bin").write_bytes(b"\0" * 46)
        for name, content in files.items():
            (tmp_path / name.replace("__", ".")).write_bytes(content)
        return tmp_path

    return run


def cameras(**fields):
    return {"cameras": [{**CAMERA_MODEL, **fields}]}


def lines(*more):
    return {"lines": [*SOUND, *more]}


TILTED = [[1.0, 0.0, 0.5, 0.0], *ROWS[1:]]
BAD_POSE = {"groundTruth": {**POSE, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 3.0}}, "time": 2}
OTHER_FILE = {"lidar": {**SOUND[1]["lidar"], "dataFile": "1.bin"}, "time": 1}
FAULTY = [
    (None, {}, None),
    ("recording-readable", {"lines": []}, "data.jsonl"),
    ("broken-lines", lines("{torn"), "data.jsonl: line 4"),
    ("unfit-lines", lines({"gps": {"latitude": 1.0}, "time": 1}), "data.jsonl: line 4"),
    ("unusable-orientations", lines(BAD_POSE), "data.jsonl: line 4"),
    ("unreadable-calibration", {"calibration": "{"}, "calibration.json"),
    ("unusable-calibrations", {"calibration": cameras(imuToCamera=TILTED)}, "calibration.json: cameras[0].imuToCamera"),
    ("repeated-lidars", {"calibration": {"lidars": [{"imuToLidar": ROWS}] * 2}}, "calibration.json: lidars[1]"),
    ("unusable-cameras", {"calibration": cameras(model="kaleidoscope")}, "calibration.json: cameras[0]"),
    ("cameras-without-calibration", lines(FRAME), "calibration.json"),
    ("missing-videos", {**lines(FRAME), "calibration": cameras()}, ""),
    ("unreadable-videos", {**lines(FRAME), "calibration": cameras(), "data__mkv": b"no video"}, "data.mkv"),
    ("unusable-lidar-files", lines(OTHER_FILE), "data.jsonl: line 4"),
    ("unreadable-vio-config", {"vio_config__yaml": b"\xff\xfe\xff"}, "vio_config.yaml"),
]


def reported(folder):
    """Rule and location of each finding that is one of a fault."""
    report = validate(folder)
    return [(f.rule, f.path) for f in report.findings if f.rule in FAULT_CODES]


@pytest.mark.parametrize(("code", "content", "location"), FAULTY)
def test_a_fault_is_reported_once_with_its_location(write, code, content, location):
    found = reported(write(**content))
    assert [path.startswith(location) for rule, path in found if rule == code] == [True] * (code is not None)
    assert {rule for rule, _ in found} <= {code, "missing-videos"} - {None}  # a camera of lines alone lacks that, too


def test_all_faults_are_reported_at_once_and_very_many_counted(write, tmp_path, monkeypatch):
    texts = ["{torn", *SOUND, "", BAD_POSE, FRAME]
    assert reported(write(texts, cameras(focalLengthX="wide"))) == [
        ("broken-lines", "data.jsonl: line 1"),
        ("unfit-lines", "data.jsonl: line 5"),
        ("unusable-orientations", "data.jsonl: line 6"),
        ("unusable-calibrations", "calibration.json: cameras[0].focalLengthX"),
        ("missing-videos", ""),
    ]
    texts = [*SOUND * (3 * MOST), *["{torn"] * (2 * MOST)]
    findings = validate(write(texts), rules=["broken-lines"], locations=None).findings
    assert (sum(finding.count for finding in findings), len(findings)) == (2 * MOST, MOST + 1)
    # nothing is repaired where the calibration cannot be read
    assert validate(write(calibration="["), fix=tmp_path / "out.sfs").output is None
    # a lidar file is named from the folder on, also where that is named relatively
    write([*SOUND, {"lidar": {**SOUND[1]["lidar"], "dataFile": "torn.bin"}, "time": 2}], torn__bin=b"\0" * 24)
    monkeypatch.chdir(tmp_path.parent)
    report = validate(tmp_path.name, rules=["unusable-lidar-files"])
    assert [finding.path for finding in report.findings] == ["torn.bin: byte 23"]


LENGTH = 40
LINES = [{"groundTruth": {"position": {"x": 0.1 * k, "y": 0.0, "z": 0.0}}, "time": 0.1 * k} for k in range(LENGTH)]
TEXTS = [json.dumps(line) for line in LINES]
LOG = "".join(text + "\n" for text in TEXTS).encode()


def reported_of_lines(folder, content):
    """Rule, location, message and count of each error, also of what would be counted at the end of a list."""
    (folder / "data.jsonl").write_bytes(content)
    report = validate(folder, locations=None)
    assert not report.passed
    return [(f.rule, f.path, f.message, f.count) for f in report.findings if f.severity == "error"]


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (gzip.compress(LOG, mtime=0), "compressed by gzip"),
        (LOG.decode().encode("utf-16"), "text in UTF-16"),
        (LOG.decode().encode("utf-16-be"), "text in UTF-16"),
        (b"", "empty"),
    ],
)
def test_a_file_that_is_no_log_is_one_finding(tmp_path, content, kind):
    [(rule, location, message, count)] = reported_of_lines(tmp_path, content)
    assert (rule, location, count, kind in message) == ("recording-readable", "data.jsonl", 1, True)
    [finding] = validate(tmp_path).findings
    assert ("salvage" in finding.remedy, "record" in finding.remedy) == (False, True)


def test_logs_of_another_unit_or_layout_are_few_findings_and_torn_lines_are_listed_singly(tmp_path):
    for factor, unit in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")):
        texts = [json.dumps(line | {"time": int((1.7e9 + line["time"]) * factor)}) + "\n" for line in LINES]
        [(rule, location, message, count)] = reported_of_lines(tmp_path, "".join(texts).encode())
        assert (rule, location, count) == ("unfit-lines", f"data.jsonl: lines 1, 2, 3, … {LENGTH}", LENGTH)
        assert (f"looks like {unit}" in message, f"{LENGTH} of {LENGTH} lines" in message) == (True, True)
    found = reported_of_lines(tmp_path, ("[\n" + ",\n".join(TEXTS) + "\n]\n").encode())
    assert [(rule, count) for rule, _, _, count in found] == [("broken-lines", LENGTH), ("broken-lines", 1)]
    assert "a log is no list" in found[0][2]
    content = "\n".join(json.dumps(line, indent=1) for line in LINES).encode()
    found = reported_of_lines(tmp_path, content)
    assert len(found) <= 5
    assert sum(count for *_, count in found) == content.count(b"\n") + 1
    [(_, location, _, count)] = reported_of_lines(tmp_path, b"time,x,y\n" * (3 * MOST))
    assert count == 3 * MOST
    assert location.endswith(f" {3 * MOST}")
    texts = [text[:-1] if k % 9 == 4 else text for k, text in enumerate(TEXTS)]
    found = reported_of_lines(tmp_path, ("\n".join(texts) + "\n").encode())
    assert [location for _, location, _, _ in found] == [f"data.jsonl: line {k + 1}" for k in range(4, LENGTH, 9)]
