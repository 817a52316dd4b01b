"""Rules about calibrations, `frames` lines, lidar files and images of a stereo rig."""

import json
import struct

import av
import numpy as np
import pytest

from sceneloom.checks import validate
from sceneloom.checks.recordings.files import CALIBRATION_RULES, FRAME_LINE_RULES, LIDAR_LINE_RULES

TABLES = (FRAME_LINE_RULES, CALIBRATION_RULES, LIDAR_LINE_RULES)
RULES = tuple(rule.id for table in TABLES for rule in table)
FRAMES = 12
LAYOUT = "RoboSense M1 XYZIRT"


def camera(y=0.0, width=48, height=32, focal=40.0, **fields):
    """A camera that looks along x of a vehicle whose z points up, `y` to the left."""
    return {
        "model": "pinhole",
        "distortionCoefficients": [],
        "focalLengthX": focal,
        "focalLengthY": focal,
        "principalPointX": (width - 1) / 2,
        "principalPointY": (height - 1) / 2,
        "imageWidth": width,
        "imageHeight": height,
        "imuToCamera": [[0, -1, 0, y], [0, 0, -1, 1.2], [1, 0, 0, -1.5], [0, 0, 0, 1]],
        **fields,
    }


def sound():
    lines = []
    for k in range(FRAMES):
        time = 0.1 * k
        lines.append({"frames": [{"cameraInd": index, "time": time} for index in (0, 1)], "number": k, "time": time})
        lines.append({"lidar": {"model": LAYOUT, "dataFile": f"lidar/{k}.bin"}, "time": time})
    still = {"type": "accelerometer", "values": [0.0, 0.0, 9.81]}
    lines += [{"sensor": still, "time": 0.01 * k + 0.003} for k in range(120)]
    return {
        "lines": sorted(lines, key=lambda line: line["time"]),
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


def encoded(path, images):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10, options={"threads": "1"})
        (stream.height, stream.width), stream.pix_fmt = images[0].shape[:2], "bgr0"
        for rgb in images:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
            container.mux(stream.encode(frame.reformat(format="bgr0")))
        container.mux(stream.encode())
    return path.read_bytes()


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    random = np.random.default_rng(0)
    images = [random.integers(0, 255, (32, 48, 3), np.uint8) for _ in range(FRAMES)]
    return encoded(tmp_path_factory.mktemp("video") / "data.mkv", images)


@pytest.fixture
def found(tmp_path, video):
    def run(change):
        rig = sound()
        change(rig)
        folder = tmp_path / "rig"
        (folder / "lidar").mkdir(parents=True)
        (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in rig["lines"]))
        (folder / "calibration.json").write_text(json.dumps(rig["calibration"]))
        for name in ("data.mkv", "data2.mkv"):
            (folder / name).write_bytes(video)
        for name, points in rig["points"].items():
            (folder / name).write_bytes(b"".join(struct.pack("<fffBHd", *point) for point in points))
        return {finding.rule: finding for finding in validate(folder, rules=RULES).findings}

    return run


def frames_of(rig):
    return [line for line in rig["lines"] if "frames" in line]


def numbered(numbers):
    def change(rig):
        for line, number in zip(frames_of(rig), numbers, strict=True):
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


def centre(x, y):
    return entry(principalPointX=x, principalPointY=y)


def frames_with(change, *rows):
    def injected(rig):
        for line in frames_of(rig)[slice(*rows)]:
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


def far_points(rig):
    rig["points"] = {name: ring_of_points(p[0][5], 12_000.0) for name, p in rig["points"].items()}


def one_file_twice(rig):
    lidar = [line for line in rig["lines"] if "lidar" in line]
    lidar[5]["lidar"]["dataFile"] = lidar[4]["lidar"]["dataFile"]


# what is done to the rig, then rules and words of their findings
INJECTED = [
    (lambda rig: None,),
    (numbered(range(28, 40)), "frame-numbers-begin", "the first is 28; expected 0"),
    (
        numbered([0, 1, 2, 2, 4, 5, 6, 7, 8, 9, 10, 11]),
        "frame-numbers-increasing",
        "2 after 2; expected 3",
        "frame-numbers-gaps",
        "4 after 2; 3 missing",
    ),
    (numbered([*range(6), *range(9, 15)]), "frame-numbers-gaps", "9 after 5; 6 to 8 missing"),
    (
        frames_with(lambda entries: entries.pop(1), 3, 5),
        "frames-without-camera",
        "cameraInd 1 is missing in 2 of 12 lines",
    ),
    (
        frames_with(lambda entries: entries[1].update(missingBitmap=True), 3, 6),
        "frames-missing-bitmap",
        "missingBitmap",
    ),
    (late(100.0, 0, 1), "frame-entry-times", "of camera 1 is up to +100.000 s off its line's time in 12 of 12 lines"),
    (late(0.008, 1), "stereo-in-step", "are 8.0 ms apart in 12 of 12 lines"),
    (entry(imuToCamera=None, imuToCameraMatrix=MOUNT), "calibration-spelling", "expected the key `imuToCamera`"),
    (entry(imuToCamera=FLAT), "calibration-spelling", "16 numbers, read column by column; expected 4 rows of 4"),
    (entry(model="KANNALA_BRANDT4"), "calibration-spelling", "'KANNALA_BRANDT4'; expected 'kannala-brandt4'"),
    (
        entry(model="brown-conrady", distortionCoefficients=[0.0] * 5),
        "calibration-spelling",
        "5 numbers; expected 8, padded with 0",
    ),
    (entry(shutter_roll_time_seconds=0.01), "calibration-keys-known", "is 'shutterRollTimeSeconds' meant?"),
    (entry(shutterRollTimeSeconds=5.0), "calibration-shutter", "5 s; expected 0 to 0.1: probably milliseconds"),
    (
        entry(imuToCameraShiftSeconds=-12.0),
        "calibration-shift",
        "-12 s; expected at most 0.5 either way: probably milliseconds",
    ),
    (entry(focalLengthX=4.2, focalLengthY=4.2), "calibration-focal-length", "probably in millimetres"),
    (entry(focalLengthX=0.8, focalLengthY=0.8), "calibration-focal-length", "probably in parts of the image's width"),
    (entry(focalLengthY=60), "calibration-focal-length", "expected nearly equal ones"),
    (centre(0.49, 0.51), "calibration-principal-point", "probably in parts of the image"),
    (centre(15.5, 23.5), "calibration-principal-point", "probably x and y are exchanged"),
    (centre(47.5, 31.5), "calibration-principal-point", "probably for images 2 times as wide and high"),
    (
        entry(imageWidth=96, imageHeight=64, principalPointX=47.5, principalPointY=31.5),
        "calibration-size",
        "calibrated for 96x64, images are 48x32",
    ),
    (moved(SKEWED.__mul__, 0), "mounting-rotation", "the nearest rotation was taken"),
    (moved(MILLIMETRES.__mul__, 1), "mounting-far", "probably millimetres", "stereo-baseline", "probably millimetres"),
    (moved(lambda m: MOUNT, 1), "mounting-repeated", "the same as of camera 0"),
    (moved(np.linalg.inv, 0, 1), "mounting-inverted", "probably inverted or transposed"),
    (moved(UPWARDS.__matmul__, 0), "mounting-steep", "camera 0 looks 90° up"),
    (
        lambda rig: rig["calibration"]["cameras"].reverse(),
        "stereo-sides",
        "camera 1 is 0.400 m to the left of camera 0",
    ),
    (moved(lambda m: camera(-0.002)["imuToCamera"], 1), "stereo-baseline", "from 2.0 mm apart"),
    (one_file_twice, "lidar-file-repeated", "'lidar/4.bin' is that of line"),
    (far_points, "lidar-range", "probably millimetres"),
]


@pytest.mark.parametrize("case", INJECTED)
def test_what_is_wrong_with_a_rig_is_found(found, case):
    change, expected = case[0], dict(zip(case[1::2], case[2::2], strict=True))
    findings = found(change)
    assert set(expected) <= set(findings)
    for rule, words in expected.items():
        assert words in findings[rule].message
    # what one mistake spoils besides is reported, too: sides and distances of an inverted or exchanged pair
    assert set(findings) - set(expected) <= ({"stereo-sides", "stereo-baseline", "mounting-far"} if expected else set())


def test_every_rule_about_rigs_is_shown_by_a_case():
    assert {rule for case in INJECTED for rule in case[1::2]} == set(RULES) - {"stereo-images"}


WIDTH, HEIGHT, COUNT = 384, 192, 5
LEFT, RIGHT = (camera(y, WIDTH, HEIGHT, 300.0) for y in (0.0, -0.5))
# a wall 10 m away: focal length 300 px times 0.5 m over 10 m
SHIFT = 15


@pytest.fixture(scope="module")
def wall():
    """Images of a wall with blots of 6 pixels, another part of it each time."""
    blots = np.random.default_rng(3).integers(20, 235, (COUNT, HEIGHT // 6, WIDTH // 6), np.uint8)
    return np.repeat(np.repeat(blots, 6, axis=1), 6, axis=2)


def shifted(images, pixels=SHIFT):
    """What a camera farther to the right sees of the wall."""
    return np.roll(images, -pixels, axis=2)


@pytest.fixture
def found_in_images(tmp_path):
    """What the rule says of images of a stereo pair, the second camera half a metre to the right of the first."""

    def run(first, second, cameras=(LEFT, RIGHT)):
        for name, grey in (("data.mkv", first), ("data2.mkv", second)):
            encoded(tmp_path / name, np.repeat(grey[..., None], 3, axis=3))
        entries = [{"cameraInd": 0}, {"cameraInd": 1}]
        lines = [json.dumps({"frames": entries, "number": k, "time": 0.1 * k}) for k in range(COUNT)]
        (tmp_path / "data.jsonl").write_text("\n".join(lines) + "\n")
        (tmp_path / "calibration.json").write_text(json.dumps({"cameras": list(cameras)}))
        return [finding.message for finding in validate(tmp_path, rules=["stereo-images"]).findings]

    return run


def test_exchanged_videos_and_entries_are_found(found_in_images, wall):
    [message] = found_in_images(shifted(wall), wall)
    assert "against the side on which their mountings put them" in message
    assert len(found_in_images(wall, shifted(wall), (RIGHT, LEFT))) == 1


def test_small_images_are_looked_at_as_they_are(found_in_images, wall):
    images, cameras = wall[:, :96, :96], [camera(y, 96, 96, 80.0) for y in (0.0, -0.5)]
    # 80 px times 0.5 m over 10 m
    assert found_in_images(images, shifted(images, 4), cameras) == []
    assert len(found_in_images(shifted(images, 4), images, cameras)) == 1


FLAT_IMAGES = np.full((COUNT, HEIGHT, WIDTH), 90, np.uint8)


@pytest.mark.parametrize(
    "pair",
    [
        lambda wall: (wall, shifted(wall)),
        lambda wall: (wall, shifted(wall), (LEFT, LEFT)),
        lambda wall: (wall, wall),  # all of it far away
        lambda wall: (wall, shifted(wall, 1)),
        lambda wall: (FLAT_IMAGES, FLAT_IMAGES),
        lambda wall: (wall, wall[::-1, ::-1]),  # nothing in common
    ],
)
def test_nothing_is_stated_for_sound_images_and_those_that_report_no_side(found_in_images, wall, pair):
    assert found_in_images(*pair(wall)) == []
