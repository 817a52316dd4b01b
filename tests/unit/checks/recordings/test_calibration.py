"""Rules about calibrations, `frames` lines, lidar files and images of a stereo rig."""

import copy
import json
import struct

import av
import numpy as np
import pytest

from sceneloom.checks import validate
from sceneloom.checks.recordings.calibration import CALIBRATED_CAMERA_RULES, CALIBRATION_RULES, MOUNTING_RULES
from sceneloom.checks.recordings.lines import FRAME_LINE_RULES, LIDAR_LINE_RULES

TABLES = (FRAME_LINE_RULES, CALIBRATION_RULES, CALIBRATED_CAMERA_RULES, MOUNTING_RULES, LIDAR_LINE_RULES)
RULES = tuple(rule.id for table in TABLES for rule in table)
FRAMES = 12
LAYOUT = "RoboSense M1 XYZIRT"


def camera(y=0.0, **fields):
    """A camera that looks along x of a vehicle whose z points up, `y` to the left."""
    return {
        "model": "pinhole",
        "distortionCoefficients": [],
        "focalLengthX": 40.0,
        "focalLengthY": 40.0,
        "principalPointX": 23.5,
        "principalPointY": 15.5,
        "imageWidth": 48,
        "imageHeight": 32,
        "imuToCamera": [[0, -1, 0, y], [0, 0, -1, 1.2], [1, 0, 0, -1.5], [0, 0, 0, 1]],
        **fields,
    }


def sound():
    """Lines, calibration and lidar files of a sound rig."""
    lines = []
    for k in range(FRAMES):
        time = 0.1 * k
        entries = [{"cameraInd": index, "time": time} for index in (0, 1)]
        lines.append({"frames": entries, "number": k, "time": time})
        lines.append({"lidar": {"model": LAYOUT, "dataFile": f"lidar/{k}.bin"}, "time": time})
    for k in range(120):
        values = [0.0, 0.0, 9.81]
        lines.append({"sensor": {"type": "accelerometer", "values": values}, "time": 0.01 * k + 0.003})
    points = {f"lidar/{k}.bin": ring_of_points(0.1 * k) for k in range(FRAMES)}
    lidar = {"model": LAYOUT, "imuToLidar": np.eye(4).tolist()}
    return {
        "lines": sorted(lines, key=lambda line: line["time"]),
        "calibration": {"cameras": [camera(), camera(-0.4)], "lidars": [lidar]},
        "points": points,
    }


def ring_of_points(time, radius=12.0):
    """(x, y, z, intensity, ring, timestamp) of 60 points around the lidar."""
    angles = np.linspace(0, 6, 60)
    return [(radius * np.cos(a), radius * np.sin(a), -1.0, 9, 0, time + 0.01 * a) for a in angles]


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """A lossless video of noise."""
    path = tmp_path_factory.mktemp("video") / "data.mkv"
    random = np.random.default_rng(0)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10, options={"threads": "1"})
        stream.width, stream.height, stream.pix_fmt = 48, 32, "bgr0"
        for _ in range(FRAMES):
            pixels = random.integers(0, 255, (32, 48, 3), np.uint8)
            image = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="bgr0")
            container.mux(stream.encode(image))
        container.mux(stream.encode())
    return path.read_bytes()


@pytest.fixture
def found(tmp_path, video):
    """What the rules state of a rig to which something was done."""

    def run(change=lambda rig: None, rules=RULES):
        rig = copy.deepcopy(sound())
        change(rig)
        folder = tmp_path / "rig"
        (folder / "lidar").mkdir(parents=True)
        (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in rig["lines"]))
        (folder / "calibration.json").write_text(json.dumps(rig["calibration"]))
        for name in ("data.mkv", "data2.mkv"):
            (folder / name).write_bytes(video)
        for name, points in rig["points"].items():
            (folder / name).write_bytes(b"".join(struct.pack("<fffBHd", *point) for point in points))
        return {finding.rule: finding for finding in validate(folder, rules=rules).findings}

    return run


def frames_of(rig):
    """The frames lines, which can be changed."""
    return [line for line in rig["lines"] if "frames" in line]


def numbered(numbers):
    """Give the frames lines other numbers."""

    def change(rig):
        for line, number in zip(frames_of(rig), numbers, strict=True):
            line["number"] = number

    return change


def entry(index, **fields):
    """Change fields of a camera's entry; None takes one out."""

    def change(rig):
        given = rig["calibration"]["cameras"][index]
        given.update(fields)
        for key in [key for key, value in given.items() if value is None]:
            del given[key]

    return change


def without_second_camera(rig):
    """Take the second camera out of two lines."""
    for line in frames_of(rig)[3:5]:
        del line["frames"][1]


def without_second_image(rig):
    """Report of three lines that the second camera has no image."""
    for line in frames_of(rig)[3:6]:
        line["frames"][1]["missingBitmap"] = True


def late_images(seconds, *cameras):
    """Report of some cameras that their images were taken later than their lines."""

    def change(rig):
        for line in frames_of(rig):
            for index in cameras:
                line["frames"][index]["time"] += seconds

    return change


def moved(index, change):
    """Change the matrix of a camera, (4, 4)."""

    def injected(rig):
        given = rig["calibration"]["cameras"][index]
        given["imuToCamera"] = np.asarray(change(np.array(given["imuToCamera"], float))).tolist()

    return injected


def in_millimetres(matrix):
    """The same mounting with its translation in millimetres."""
    matrix[:3, 3] *= 1000
    return matrix


def skewed(matrix):
    """A rotation that is off by 4e-3."""
    matrix[0, 1] *= 1.002
    return matrix


def both_inverted(rig):
    """Write the trajectory from the cameras to the IMU."""
    for index in (0, 1):
        moved(index, np.linalg.inv)(rig)


def looking_up(matrix):
    """The camera rotated about its own x axis until it looks at the sky."""
    rotation = np.eye(4)
    rotation[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    return rotation @ matrix


def exchanged(rig):
    """Exchange the entries of the two cameras."""
    rig["calibration"]["cameras"].reverse()


def far_points(rig):
    """Write the points in millimetres."""
    rig["points"] = {name: ring_of_points(p[0][5], 12_000.0) for name, p in rig["points"].items()}


def one_file_twice(rig):
    """Let two lines name one file."""
    lidar = [line for line in rig["lines"] if "lidar" in line]
    lidar[5]["lidar"]["dataFile"] = lidar[4]["lidar"]["dataFile"]


FLAT = [0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0.1, 1.2, -1.5, 1]
INJECTED = {
    "numbers from 28": (numbered(range(28, 40)), {"frame-numbers-begin": "the first is 28; expected 0"}),
    "a number twice": (
        numbered([0, 1, 2, 2, 4, 5, 6, 7, 8, 9, 10, 11]),
        {"frame-numbers-increasing": "2 after 2; expected 3", "frame-numbers-gaps": "4 after 2; 3 missing"},
    ),
    "numbers missing": (
        numbered([0, 1, 2, 3, 4, 5, 9, 10, 11, 12, 13, 14]),
        {"frame-numbers-gaps": "9 after 5; 6 to 8 missing"},
    ),
    "a camera missing": (
        without_second_camera,
        {"frames-without-camera": "cameraInd 1 is missing in 2 of 12 lines"},
    ),
    "missingBitmap": (without_second_image, {"frames-missing-bitmap": "missingBitmap"}),
    "images on another clock": (
        late_images(100.0, 0, 1),
        {"frame-entry-times": "of camera 1 is up to +100.000 s off its line's time in 12 of 12 lines"},
    ),
    "a stereo pair out of step": (
        late_images(0.008, 1),
        {"stereo-in-step": "are 8.0 ms apart in 12 of 12 lines"},
    ),
    "the text's word for the matrix": (
        entry(0, imuToCamera=None, imuToCameraMatrix=camera()["imuToCamera"]),
        {"calibration-spelling": "expected the key `imuToCamera`"},
    ),
    "a flat matrix": (
        entry(0, imuToCamera=FLAT),
        {"calibration-spelling": "16 numbers, read column by column; expected 4 rows of 4"},
    ),
    "a model in capitals": (
        entry(0, model="KANNALA_BRANDT4"),
        {"calibration-spelling": "'KANNALA_BRANDT4'; expected 'kannala-brandt4'"},
    ),
    "a short list": (
        entry(0, model="brown-conrady", distortionCoefficients=[0.0] * 5),
        {"calibration-spelling": "5 numbers; expected 8, padded with 0"},
    ),
    "a misspelt key": (
        entry(0, shutter_roll_time_seconds=0.01),
        {"calibration-keys-known": "is 'shutterRollTimeSeconds' meant?"},
    ),
    "a shutter in milliseconds": (
        entry(0, shutterRollTimeSeconds=5.0),
        {"calibration-shutter": "5 s; expected 0 to 0.1: probably milliseconds"},
    ),
    "a shift in milliseconds": (
        entry(0, imuToCameraShiftSeconds=-12.0),
        {"calibration-shift": "-12 s; expected at most 0.5 either way: probably milliseconds"},
    ),
    "a focal length in millimetres": (
        entry(0, focalLengthX=4.2, focalLengthY=4.2),
        {"calibration-focal-length": "probably in millimetres"},
    ),
    "a focal length in widths": (
        entry(0, focalLengthX=0.8, focalLengthY=0.8),
        {"calibration-focal-length": "probably in parts of the image's width"},
    ),
    "unequal focal lengths": (
        entry(0, focalLengthX=40, focalLengthY=60),
        {"calibration-focal-length": "expected nearly equal ones"},
    ),
    "a principal point in parts": (
        entry(0, principalPointX=0.49, principalPointY=0.51),
        {"calibration-principal-point": "probably in parts of the image"},
    ),
    "a principal point exchanged": (
        entry(0, principalPointX=15.5, principalPointY=23.5),
        {"calibration-principal-point": "probably x and y are exchanged"},
    ),
    "a camera model for larger images": (
        entry(0, principalPointX=47.5, principalPointY=31.5),
        {"calibration-principal-point": "probably for images 2 times as wide and high"},
    ),
    "images of another size": (
        entry(0, imageWidth=96, imageHeight=64, principalPointX=47.5, principalPointY=31.5),
        {"calibration-size": "calibrated for 96x64, images are 48x32"},
    ),
    "a rotation that is off": (moved(0, skewed), {"mounting-rotation": "the nearest rotation was taken"}),
    "millimetres": (
        moved(1, in_millimetres),
        {"mounting-far": "probably millimetres", "stereo-baseline": "probably millimetres"},
    ),
    "one matrix for both": (
        entry(1, imuToCamera=camera()["imuToCamera"]),
        {"mounting-repeated": "the same as of camera 0"},
    ),
    "matrices inverted": (both_inverted, {"mounting-inverted": "probably inverted or transposed"}),
    "a camera that looks up": (moved(0, looking_up), {"mounting-steep": "camera 0 looks 90° up"}),
    "cameras exchanged": (exchanged, {"stereo-sides": "camera 1 is 0.400 m to the left of camera 0"}),
    "a narrow pair": (
        entry(1, imuToCamera=camera(-0.002)["imuToCamera"]),
        {"stereo-baseline": "from 2.0 mm apart"},
    ),
    "one file twice": (one_file_twice, {"lidar-file-repeated": "'lidar/4.bin' is that of line"}),
    "points in millimetres": (far_points, {"lidar-range": "probably millimetres"}),
}


def test_nothing_is_stated_for_a_sound_rig(found):
    assert found() == {}


@pytest.mark.parametrize("name", INJECTED)
def test_what_is_wrong_with_a_rig_is_found(found, name):
    change, expected = INJECTED[name]
    findings = found(change)
    assert set(expected) <= set(findings)
    for rule, words in expected.items():
        assert words in findings[rule].message
    # what one mistake spoils besides is reported, too: sides and distances of an inverted or exchanged pair
    assert set(findings) - set(expected) <= {"stereo-sides", "stereo-baseline", "mounting-far"}


def test_every_rule_about_rigs_is_shown_by_a_case():
    assert {rule for _, expected in INJECTED.values() for rule in expected} == set(RULES)


WIDTH, HEIGHT, FRAMES_OF_IMAGES = 384, 192, 5
RULE = "stereo-images"


def camera_of_images(y):
    """A camera_of_images that looks along x of a vehicle whose z points up, `y` to the left."""
    return {
        "model": "pinhole",
        "focalLengthX": 300.0,
        "focalLengthY": 300.0,
        "principalPointX": 191.5,
        "principalPointY": 95.5,
        "imageWidth": WIDTH,
        "imageHeight": HEIGHT,
        "imuToCamera": [
            [0.0, -1.0, 0.0, y],
            [0.0, 0.0, -1.0, 0.0],
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ],
    }


SOUND = (camera_of_images(0.0), camera_of_images(-0.5))


def textures():
    """Images of a wall with blots of 6 pixels, another part of it each time."""
    random = np.random.default_rng(3)
    blots = random.integers(20, 235, (FRAMES_OF_IMAGES, HEIGHT // 6, WIDTH // 6), np.uint8)
    return np.repeat(np.repeat(blots, 6, axis=1), 6, axis=2)


def write_video(path, images):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10, options={"threads": "1"})
        (stream.height, stream.width), stream.pix_fmt = images[0].shape, "bgr0"
        for grey in images:
            pixels = np.repeat(grey[:, :, None], 3, axis=2)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            container.mux(stream.encode(frame.reformat(format="bgr0")))
        container.mux(stream.encode())


@pytest.fixture
def found_of_images(tmp_path):
    """What the rule says of a stereo pair, the second camera_of_images half a metre to the right of the first."""

    def run(first, second, *, cameras=SOUND):
        write_video(tmp_path / "data.mkv", first)
        write_video(tmp_path / "data2.mkv", second)
        lines = [
            {"frames": [{"cameraInd": 0}, {"cameraInd": 1}], "number": k, "time": 0.1 * k}
            for k in range(FRAMES_OF_IMAGES)
        ]
        (tmp_path / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        (tmp_path / "calibration.json").write_text(json.dumps({"cameras": list(cameras)}))
        return [finding.message for finding in validate(tmp_path, rules=[RULE]).findings]

    return run


# a wall 10 m away: focal length 300 px times 0.5 m over 10 m
SHIFT = 15


def test_a_wall_that_the_right_camera_sees_farther_left_is_sound(found_of_images):
    images = textures()
    assert found_of_images(images, np.roll(images, -SHIFT, axis=2)) == []


def test_exchanged_videos_are_found(found_of_images):
    images = textures()
    messages = found_of_images(np.roll(images, -SHIFT, axis=2), images)
    assert len(messages) == 1
    assert "against the side on which their mountings put them" in messages[0]


def test_exchanged_entries_are_found(found_of_images):
    images = textures()
    shifted = np.roll(images, -SHIFT, axis=2)
    assert len(found_of_images(images, shifted, cameras=(camera_of_images(-0.5), camera_of_images(0.0)))) == 1


def test_small_images_are_looked_at_as_they_are(found_of_images):
    small = {"imageWidth": 96, "imageHeight": 96, "principalPointX": 47.5, "principalPointY": 47.5}
    camera_model = {**small, "focalLengthX": 80.0, "focalLengthY": 80.0}
    images = textures()[:, :96, :96]
    cameras = ({**camera_of_images(0.0), **camera_model}, {**camera_of_images(-0.5), **camera_model})
    # 80 px times 0.5 m over 10 m
    shifted = np.roll(images, -4, axis=2)
    assert found_of_images(images, shifted, cameras=cameras) == []
    assert len(found_of_images(shifted, images, cameras=cameras)) == 1


def test_cameras_in_one_location_report_no_side(found_of_images):
    images = textures()
    assert (
        found_of_images(images, np.roll(images, -SHIFT, axis=2), cameras=(camera_of_images(0.0), camera_of_images(0.0)))
        == []
    )


@pytest.mark.parametrize("shift", [0, -1])
def test_nothing_is_stated_where_all_is_far_away(found_of_images, shift):
    images = textures()
    assert found_of_images(images, np.roll(images, shift, axis=2)) == []


def test_nothing_is_stated_for_images_that_show_nothing_or_do_not_match(found_of_images):
    flat = np.full((FRAMES_OF_IMAGES, HEIGHT, WIDTH), 90, np.uint8)
    assert found_of_images(flat, flat) == []


def test_nothing_is_stated_for_images_that_have_nothing_in_common(found_of_images):
    images = textures()
    assert found_of_images(images, images[::-1, ::-1]) == []
