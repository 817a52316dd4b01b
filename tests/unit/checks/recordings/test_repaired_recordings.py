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


def test_a_sound_recording_stays_what_it_was(drive):
    report = drive.fix()
    assert report.fixed == ()
    assert report.losses == ()
    assert kept_lines(drive.repaired_lines()) == kept_lines(drive.lines)
    assert drive.repaired_calibration() == drive.calibration
    before, after = decoded(drive.folder / "data.mkv"), decoded(drive.repaired / "data.mkv")
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_lines_are_sorted_and_nothing_else_is_changed(drive):
    sound = list(drive.lines)
    drive.lines[40:60] = reversed(drive.lines[40:60])
    report = drive.fix()
    assert rules_of(report.fixed) == {"lines-in-order"}
    times = [line["time"] for line in drive.repaired_lines()]
    assert times == sorted(times)
    assert kept_lines(drive.repaired_lines()) == kept_lines(sound)


def test_samples_fixes_poses_and_frames_that_stand_there_twice_are_reported_once(drive):
    sound = list(drive.lines)
    kinds = [
        next(line for line in sound if line.get("sensor", {}).get("type") == "gyroscope"),
        next(line for line in sound if "gps" in line),
        next(line for line in sound if "groundTruth" in line and line["time"] > 0.3),
        frames_of(sound)[5],
    ]
    for line in kinds:
        drive.lines.insert(drive.lines.index(line), copy.deepcopy(line))
    report = drive.fix()
    assert "stream-times-unique" in rules_of(report.fixed)
    assert kept_lines(drive.repaired_lines()) == kept_lines(sound)
    before, after = decoded(drive.folder / "data.mkv"), decoded(drive.repaired / "data.mkv")
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_samples_of_one_time_that_differ_are_left_to_a_person(drive):
    line = next(line for line in drive.lines if line.get("sensor", {}).get("type") == "gyroscope")
    other = sample("gyroscope", line["time"], 1.0, 2.0, 3.0)
    drive.lines.insert(drive.lines.index(line) + 1, other)
    drive.write()
    report = validate(drive.folder, fix=drive.repaired)
    assert "stream-times-unique" in rules_of(report.findings)
    assert kept_lines(drive.repaired_lines()) == kept_lines(drive.lines)


@pytest.mark.parametrize(
    ("numbers", "rules"),
    [
        (range(28, 40), {"frame-numbers-begin"}),
        ([0, 1, 2, 3, 4, 5, 8, 9, 10, 11, 12, 13], {"frame-numbers-gaps"}),
        ([0, 1, 2, 2, 4, 5, 6, 7, 8, 9, 10, 11], {"frame-numbers-gaps", "frame-numbers-increasing"}),
    ],
)
@pytest.mark.few(1)
def test_frames_are_numbered_from_0_without_gaps(drive, numbers, rules):
    sound = [copy.deepcopy(line) for line in drive.lines]
    for line, number in zip(frames_of(drive.lines), numbers, strict=True):
        line["number"] = number
    report = drive.fix()
    assert rules_of(report.fixed) == rules
    assert kept_lines(drive.repaired_lines()) == kept_lines(sound)


def cut_lines(drive, dropped):
    """Take frames lines out, while the video keeps all images; give those that stay."""
    gone = [frames_of(drive.lines)[k] for k in dropped]
    drive.lines = [line for line in drive.lines if line not in gone]
    return frames_of(drive.lines)


def check_images(drive, dropped, *, within=0):
    before, after = decoded(drive.folder / "data.mkv"), decoded(drive.repaired / "data.mkv")
    stay = [image for k, image in enumerate(before) if k not in dropped]
    assert len(after) == len(stay)
    differences = [np.abs(a.astype(int) - b).max() for a, b in zip(after, stay, strict=True)]
    assert max(differences) <= within
    frames = frames_of(drive.repaired_lines())
    assert [line["number"] for line in frames] == list(range(len(stay)))
    assert [line["frames"][0]["own"] for line in frames] == [k for k in range(FRAMES) if k not in dropped]


def test_the_video_is_cut_to_the_lines_without_encoding_where_images_stand_for_themselves(drive):
    cut_lines(drive, [4, 5, 9])
    report = drive.fix()
    assert "frame-numbers-gaps" in rules_of(report.fixed)
    assert report.losses == ()
    check_images(drive, [4, 5, 9])


def test_a_video_that_cannot_be_cut_is_encoded_anew_without_loss_and_that_is_reported(drive):
    cut_lines(drive, [4, 5, 9])
    options = {"g": "12", "bf": "0", "sc_threshold": "0"}
    report = drive.fix(codec="libx264", pixels="yuv420p", options=options)
    assert [loss.field for loss in report.losses] == ["sensors[camera0].video"]
    assert "FFV1" in report.losses[0].what
    # the two ways from YUV to RGB, ours and that of PyAV, differ by up to 3 levels
    check_images(drive, [4, 5, 9], within=3)


def test_lines_that_lack_an_image_at_the_end_are_left_out_and_reported(drive):
    extra = {"frames": [{"cameraInd": 0, "time": 1.195, "own": FRAMES}], "number": FRAMES, "time": 1.195}
    sound = list(drive.lines)
    drive.lines.append(extra)
    report = drive.fix()
    assert "unmatched-images" in rules_of(report.left_out)
    assert kept_lines(drive.repaired_lines()) == kept_lines(sound)


def test_images_that_lack_a_line_at_the_end_are_cut_off_and_reported(drive):
    cut_lines(drive, [10, 11])
    report = drive.fix()
    assert "unmatched-images" in rules_of(report.left_out)
    check_images(drive, [10, 11])


def test_broken_lines_are_left_out_and_reported(drive):
    sound = list(drive.lines)
    drive.lines.insert(7, '{"sensor":{"type":"gyroscope","values":[NaN,0,0]},"time":0.02}')
    drive.lines.insert(70, '{"sensor":{"type":"gyro')
    report = drive.fix()
    assert rules_of(report.left_out) == {"broken-lines"}
    assert len(report.left_out) == 2
    assert kept_lines(drive.repaired_lines()) == kept_lines(sound)


def test_orientations_become_unit_quaternions_and_others_keep_their_numbers(drive):
    sound = [copy.deepcopy(line) for line in drive.lines]
    line = next(line for line in drive.lines if "groundTruth" in line and line["time"] > 0.5)
    line["groundTruth"]["orientation"]["w"] = 1.005
    report = drive.fix()
    assert rules_of(report.fixed) == {"orientation-norm"}
    assert kept_lines(drive.repaired_lines()) == kept_lines(sound)


def test_a_rotation_that_is_off_becomes_the_nearest_one(drive):
    matrix = np.array(CAMERA["imuToCamera"])
    drive.calibration["cameras"][0]["imuToCamera"] = [[0.0, -1.002, 0.0, 0.0], *matrix[1:].tolist()]
    report = drive.fix()
    assert rules_of(report.fixed) == {"mounting-rotation"}
    written = np.array(drive.repaired_calibration()["cameras"][0]["imuToCamera"])
    # the nearest rotation to one stretched along an axis is the unstretched one
    np.testing.assert_allclose(written, matrix, atol=1e-12)


@pytest.mark.parametrize(
    "given",
    [
        {"model": "KANNALA_BRANDT4", "distortionCoefficients": [0.1, 0.01, 0.0, 0.001]},
        {"model": "Brown-Conrady", "distortionCoefficients": [0.1, 0.01, 0.001, 0.002, 0.003]},
    ],
)
def test_models_are_written_as_the_vendors_software_reads_them(drive, given):
    drive.calibration["cameras"][0].update(given)
    report = drive.fix()
    assert rules_of(report.fixed) == {"calibration-spelling"}
    padded = given["distortionCoefficients"] + [0.0] * (3 if len(given["distortionCoefficients"]) == 5 else 0)
    name = given["model"].lower().replace("_b", "-b")
    expected = {**CAMERA, "model": name, "distortionCoefficients": padded}
    assert drive.repaired_calibration()["cameras"] == [expected]


def test_matrices_are_written_by_rows_under_the_key_that_software_reads(drive):
    entry = drive.calibration["cameras"][0]
    entry["imuToCameraMatrix"] = np.array(entry.pop("imuToCamera")).T.ravel().tolist()
    report = drive.fix()
    assert rules_of(report.fixed) == {"calibration-spelling"}
    assert drive.repaired_calibration()["cameras"] == [CAMERA]


def test_the_command_line_reports_what_was_fixed_left_out_and_lost(drive):
    from click.testing import CliRunner

    from sceneloom.cli.main import sceneloom

    drive.lines[40:60] = reversed(drive.lines[40:60])
    drive.lines.insert(7, "{torn")
    cut_lines(drive, [4])
    drive.write(codec="libx264", pixels="yuv420p", options={"g": "12", "bf": "0", "sc_threshold": "0"})
    command = ["validate", str(drive.folder), "--fix", str(drive.repaired), "--quiet"]
    reported = CliRunner().invoke(sceneloom, command).stdout
    fixed, left_out = reported.index("\nfixed\n"), reported.index("\nleft out\n")
    lost = reported.index("\nlost\n")
    assert fixed < reported.index("lines-in-order") < left_out < reported.index("broken-lines") < lost
    as_json = json.loads(CliRunner().invoke(sceneloom, [*command, "--overwrite", "--json"]).stdout)
    assert {finding["rule"] for finding in as_json["fixed"]} == {"lines-in-order", "frame-numbers-gaps"}
    assert [finding["rule"] for finding in as_json["left_out"]] == ["broken-lines"]
    assert [loss["field"] for loss in as_json["losses"]] == ["sensors[camera0].video"]
