"""`--fix` of recordings repairs what it says, changes nothing else, and changes nothing when it is done again."""

import copy
import json
import struct

import av
import numpy as np
import pytest

from sceneloom.checks import validate

FRAMES = 12
LAYOUT = "RoboSense M1 XYZIRT"
CAMERA = {
    "model": "pinhole",
    "distortionCoefficients": [],
    "focalLengthX": 40.0,
    "focalLengthY": 40.0,
    "principalPointX": 23.5,
    "principalPointY": 15.5,
    "imageWidth": 48,
    "imageHeight": 32,
    "imuToCamera": [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.2], [1.0, 0.0, 0.0, -1.5], [0.0, 0.0, 0.0, 1.0]],
    "note": "kept as it is",
}


def sample(kind, time, *values):
    return {"sensor": {"type": kind, "values": list(values)}, "time": time}


def pose(time, x, quaternion=(0.0, 0.0, 0.0, 1.0)):
    rotation = dict(zip("xyzw", quaternion, strict=True))
    return {"groundTruth": {"position": {"x": x, "y": 0.0, "z": 0.0}, "orientation": rotation}, "time": time}


def sound_lines():
    """Lines of a drive with IMU, fixes, poses, images and sweeps, in order."""
    lines = []
    for k in range(120):
        lines.append(sample("accelerometer", 0.01 * k + 0.001, 0.1, 0.001 * k, 9.81))
        lines.append(sample("gyroscope", 0.01 * k + 0.001, 0.0, 0.0, 0.01 + 0.001 * k))
    for k in range(FRAMES):
        time = 0.1 * k
        lines.append({"frames": [{"cameraInd": 0, "time": time, "own": k}], "number": k, "time": time})
        lines.append({"lidar": {"model": LAYOUT, "dataFile": f"lidar/{k:06d}.bin"}, "time": time})
        lines.append(pose(0.1 * k, 0.5 * k))
        fix = {"latitude": 60.17 + 1e-6 * k, "longitude": 24.94, "altitude": 14.0, "accuracy": 0.5}
        lines.append({"gps": fix, "time": time + 0.005})
    return sorted(lines, key=lambda line: line["time"])


def encode(path, codec, pixels, options):
    """Encode images of which each is another; give them as they are decoded."""
    random = np.random.default_rng(0)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options={"threads": "1", **options})
        stream.width, stream.height, stream.pix_fmt = 48, 32, pixels
        for _ in range(FRAMES):
            # grey: ways from YUV to RGB differ in how they spread colours over pixels
            image = np.repeat(np.repeat(random.integers(20, 230, (8, 12, 1), np.uint8), 4, axis=0), 4, axis=1)
            image = np.repeat(image, 3, axis=2)
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixels)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def decoded(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


class Drive:
    """A recording that is written, repaired, and compared with what it was."""

    def __init__(self, folder):
        self.folder, self.repaired, self.again = folder / "drive", folder / "repaired", folder / "again"
        self.lines, self.calibration = sound_lines(), {"cameras": [copy.deepcopy(CAMERA)]}
        lidar = {"model": LAYOUT, "imuToLidar": np.eye(4).tolist()}
        self.calibration["lidars"] = [lidar]
        (self.folder / "lidar").mkdir(parents=True)

    def write(self, *, codec="ffv1", pixels="bgr0", options=None):
        texts = [line if isinstance(line, str) else json.dumps(line) for line in self.lines]
        (self.folder / "data.jsonl").write_text("".join(text + "\n" for text in texts))
        (self.folder / "calibration.json").write_text(json.dumps(self.calibration))
        encode(self.folder / "data.mkv", codec, pixels, options or {"g": "1"})
        for k in range(FRAMES):
            points = [(12.0, 0.01 * i, -1.0, 9, 0, 0.1 * k + 0.001 * i) for i in range(90)]
            records = b"".join(struct.pack("<fffBHd", *point) for point in points)
            (self.folder / f"lidar/{k:06d}.bin").write_bytes(records)

    def fix(self, **options):
        """Write and repair it; what is repaired is not repaired again."""
        self.write(**options)
        report = validate(self.folder, fix=self.repaired)
        assert report.output == str(self.repaired)
        again = validate(self.repaired, fix=self.again)
        assert again.fixed == ()
        assert again.left_out == ()
        assert again.losses == ()
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


@pytest.fixture
def drive(tmp_path):
    return Drive(tmp_path)


def rules_of(findings):
    return {finding.rule for finding in findings}


def kept_lines(lines):
    return sorted(json.dumps(line, sort_keys=True) for line in lines)


def frames_of(lines):
    return [line for line in lines if "frames" in line]


def same_images(drive):
    before, after = decoded(drive.folder / "data.mkv"), decoded(drive.repaired / "data.mkv")
    return all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_a_sound_recording_stays_what_it_was(drive):
    report = drive.fix()
    assert report.fixed == report.losses == ()
    assert kept_lines(drive.repaired_lines()) == kept_lines(drive.lines)
    assert drive.repaired_calibration() == drive.calibration
    assert same_images(drive)


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


def numbered(*numbers):
    def change(lines):
        for line, number in zip(frames_of(lines), numbers, strict=True):
            line["number"] = number

    return change


def with_broken(lines):
    lines.insert(7, '{"sensor":{"type":"gyroscope","values":[NaN,0,0]},"time":0.02}')
    lines.insert(70, '{"sensor":{"type":"gyro')


def with_late_image(lines):
    entry = {"cameraInd": 0, "time": 1.195, "own": FRAMES}
    lines.append({"frames": [entry], "number": FRAMES, "time": 1.195})


@pytest.mark.parametrize(
    ("change", "fixed", "left_out"),
    [
        (with_reversed, {"lines-in-order"}, []),
        (with_doubled, {"stream-times-unique", "frame-numbers-increasing"}, []),
        (with_unit_off, {"orientation-norm"}, []),
        (numbered(*range(28, 40)), {"frame-numbers-begin"}, []),
        (numbered(0, 1, 2, 3, 4, 5, 8, 9, 10, 11, 12, 13), {"frame-numbers-gaps"}, []),
        (numbered(0, 1, 2, 2, 4, 5, 6, 7, 8, 9, 10, 11), {"frame-numbers-gaps", "frame-numbers-increasing"}, []),
        (with_broken, set(), ["broken-lines"] * 2),
        (with_late_image, set(), ["unmatched-images"]),
    ],
)
@pytest.mark.few(6)
def test_lines_become_those_of_the_sound_drive_again(drive, change, fixed, left_out):
    sound = copy.deepcopy(drive.lines)
    change(drive.lines)
    report = drive.fix()
    assert rules_of(report.fixed) == fixed
    assert [finding.rule for finding in report.left_out] == left_out
    assert kept_lines(drive.repaired_lines()) == kept_lines(sound)
    times = [line["time"] for line in drive.repaired_lines()]
    assert times == sorted(times)
    assert same_images(drive)


def test_samples_of_one_time_that_differ_are_left_to_a_person(drive):
    line = next(line for line in drive.lines if line.get("sensor", {}).get("type") == "gyroscope")
    drive.lines.insert(drive.lines.index(line) + 1, sample("gyroscope", line["time"], 1.0, 2.0, 3.0))
    drive.write()
    report = validate(drive.folder, fix=drive.repaired)
    assert "stream-times-unique" in rules_of(report.findings)
    assert kept_lines(drive.repaired_lines()) == kept_lines(drive.lines)


H264 = {"codec": "libx264", "pixels": "yuv420p", "options": {"g": "12", "bf": "0", "sc_threshold": "0"}}


@pytest.mark.parametrize(
    ("dropped", "encoded", "fixed", "left_out"),
    [
        ([4, 5, 9], {}, True, []),  # cut without encoding, as its images stand for themselves
        ([10, 11], {}, False, ["unmatched-images"]),
        ([4, 5, 9], H264, True, []),
    ],
)
def test_the_video_is_cut_to_the_lines(drive, dropped, encoded, fixed, left_out):
    gone = [frames_of(drive.lines)[k] for k in dropped]
    drive.lines = [line for line in drive.lines if line not in gone]
    report = drive.fix(**encoded)
    assert ("frame-numbers-gaps" in rules_of(report.fixed)) is fixed
    assert [finding.rule for finding in report.left_out] == left_out
    # encoded anew without loss, where it cannot be cut
    assert [loss.field for loss in report.losses] == (["sensors[camera0].video"] if encoded else [])
    assert all("FFV1" in loss.what for loss in report.losses)
    stay = [image for k, image in enumerate(decoded(drive.folder / "data.mkv")) if k not in dropped]
    differences = [
        np.abs(a.astype(int) - b).max() for a, b in zip(decoded(drive.repaired / "data.mkv"), stay, strict=True)
    ]
    # the two ways from YUV to RGB, ours and that of PyAV, differ by up to 3 levels
    assert max(differences) <= (3 if encoded else 0)
    frames = frames_of(drive.repaired_lines())
    assert [line["number"] for line in frames] == list(range(len(stay)))
    assert [line["frames"][0]["own"] for line in frames] == [k for k in range(FRAMES) if k not in dropped]


MATRIX = np.array(CAMERA["imuToCamera"])
KANNALA, BROWN = [0.1, 0.01, 0.0, 0.001], [0.1, 0.01, 0.001, 0.002, 0.003]


@pytest.mark.parametrize(
    ("given", "rule", "expected"),
    [
        # the nearest rotation to one stretched along an axis is the unstretched one
        ({"imuToCamera": [[0.0, -1.002, 0.0, 0.0], *MATRIX[1:].tolist()]}, "mounting-rotation", {}),
        (
            {"model": "KANNALA_BRANDT4", "distortionCoefficients": KANNALA},
            "calibration-spelling",
            {"model": "kannala-brandt4", "distortionCoefficients": KANNALA},
        ),
        (
            {"model": "Brown-Conrady", "distortionCoefficients": BROWN},
            "calibration-spelling",
            {"model": "brown-conrady", "distortionCoefficients": [*BROWN, 0.0, 0.0, 0.0]},
        ),
        ({"imuToCamera": None, "imuToCameraMatrix": MATRIX.T.ravel().tolist()}, "calibration-spelling", {}),
    ],
)
def test_the_calibration_is_written_as_the_vendors_software_reads_it(drive, given, rule, expected):
    [entry] = drive.calibration["cameras"]
    entry |= given
    drive.calibration["cameras"] = [{key: value for key, value in entry.items() if value is not None}]
    assert rules_of(drive.fix().fixed) == {rule}
    [repaired] = drive.repaired_calibration()["cameras"]
    np.testing.assert_allclose(repaired.pop("imuToCamera"), MATRIX, atol=1e-12)
    assert repaired == {key: value for key, value in {**CAMERA, **expected}.items() if key != "imuToCamera"}


def test_the_command_line_reports_what_was_fixed_left_out_and_lost(drive):
    from click.testing import CliRunner

    from sceneloom.cli.main import sceneloom

    with_reversed(drive.lines)
    drive.lines.insert(7, "{torn")
    drive.lines.remove(frames_of(drive.lines)[4])
    drive.write(**H264)
    command = ["validate", str(drive.folder), "--fix", str(drive.repaired), "--quiet"]
    reported = CliRunner().invoke(sceneloom, command).stdout
    words = ["\nfixed\n", "lines-in-order", "\nleft out\n", "broken-lines", "\nlost\n"]
    places = [reported.index(word) for word in words]
    assert places == sorted(places)
    as_json = json.loads(CliRunner().invoke(sceneloom, [*command, "--overwrite", "--json"]).stdout)
    assert {finding["rule"] for finding in as_json["fixed"]} == {"lines-in-order", "frame-numbers-gaps"}
    assert [finding["rule"] for finding in as_json["left_out"]] == ["broken-lines"]
    assert [loss["field"] for loss in as_json["losses"]] == ["sensors[camera0].video"]
