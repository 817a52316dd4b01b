"""Rules about camera models, images, videos, and what is drawn into images."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.checks.images import BOX_RULES, CAMERA_RULES, IMAGE_RULES
from sceneloom.formats.video.writer import VideoWriter
from sceneloom.scene import (
    Box2DAnnotation,
    BoxPath,
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    DataWarning,
    LazyFrames,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
    VideoContent,
    WarningKind,
)

PERIOD = 100_000_000
TIMES = np.arange(2, dtype=np.int64) * PERIOD
NULL = [np.nan] * 4
RNG = np.random.default_rng(1)
BLUE = np.full((24, 32, 3), (10, 20, 200), np.uint8)
PINHOLE = {"model": "pinhole", "width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}
FISHEYE = Camera("fisheye", 32, 24, 9.0, 9.0, 15.5, 11.5, (0.1, 0.0, 0.0, 0.0))
NO_VIDEO = VideoContent(lambda: BytesIO(b"no video at all"), "h264")


def camera_with(s, **fields):
    return s.camera(camera_model=Camera(**{**PINHOLE, **fields}))


def camera_of(s, *images):
    usual, times = s.camera().camera, s.times(len(images))
    made = [
        CameraImage.of(int(t), usual.resized(rgb.shape[1], rgb.shape[0]), rgb)
        for t, rgb in zip(times, images, strict=True)
    ]
    return CameraSensor("front", usual, LazyFrames.of(made, times), poses=s.path())


def noise(width=32, height=24, most=255):
    return RNG.integers(0, most, (height, width, 3), np.uint8)


def own_size(s):
    """A camera with an image of another size that has a camera model of its own."""
    camera = camera_of(s, noise(64, 48))
    image = replace(camera.images[0], camera=replace(camera.camera.resized(64, 48), fx=70.0))
    return replace(camera, images=LazyFrames.of([image], [0]))


def drawn(row, sensor_id="front"):
    return Box2DAnnotation("box", sensor_id, BoxPath(TIMES, np.array([[1.0, 1, 5, 5], row])))


def projected(row, *confirmed):
    seen = Projection("front", TIMES, np.array([[1.0, 1, 5, 5], row]), confirmed or None)
    return CuboidAnnotation("car", CuboidPath(TIMES, np.ones((2, 9))), projections=(seen,))


def outlined(*vertices, name="shape"):
    path = VertexPath(TIMES[:1], (np.array(vertices, float),))
    return ShapeAnnotation(name, ShapeType.POLYGON_2D, path, sensor_id="front")


POINT = PointProjection("front", TIMES, np.array([[3.0, 3.0], [60.0, 3.0]]))
KEYPOINTS = PointsAnnotation("hand", (PointPath(TIMES, np.ones((2, 3))),), projections=((POINT,),))
OUTSIDE = outlined([40, 3], [45, 3], [45, 9]), KEYPOINTS, outlined([30, 3], [40, 3], [40, 9], name=2)


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    assert keeps(sound.scene(sound.camera(), sound.camera(id="fish", camera_model=FISHEYE)), CAMERA_RULES)
    assert keeps(sound.scene(camera_of(sound, noise(), noise(), noise())), IMAGE_RULES)
    empty = CuboidAnnotation("other", CuboidPath(TIMES, np.ones((2, 9))), projections=(Projection("front", TIMES),))
    boxes = drawn([0, 0, 32, 24]), projected(NULL, True, False), outlined([0, 0], [32, 0], [16, 24]), empty
    assert keeps(sound.scene(*boxes), BOX_RULES)


def test_boxes(check, sound):
    check("box-not-finite", "annotations[0].path.values[1]", drawn(NULL))
    # a box outside is not reported to reach beyond, too; unknown cameras and lidars are left to other rules
    check("box-beyond-image", "", drawn([50, 5, 4, 4]))
    check("box-outside-image", "", drawn([90, 5, 4, 4], "gone"))
    check("box-outside-image", "", drawn([90, 5, 4, 4], "top"))
    check(
        "box-outside-image", ["annotations[0].path.values[0]", "annotations[1].projections[0][0].points[1]"], *OUTSIDE
    )
    check("box-beyond-image", "annotations[2].path.values[0]", *OUTSIDE)
    check(
        "null-box-confirmed",
        "annotations[0].projections[0].confirmed[1]: true, yet boxes[1] is null",
        projected(NULL, True, True),
    )
    check("null-box-confirmed", "", projected(NULL, True, None))


def test_cameras_and_images(check, sound):
    check(
        "camera-model-known",
        "sensors[0].intrinsics.distortion.model: 'spherical'",
        camera_with(sound, model="spherical"),
    )
    check("principal-point", "sensors[0].intrinsics.cx", camera_with(sound, cx=40.0))
    check(
        "principal-point",
        ["sensors[0].intrinsics.cx", "sensors[0].intrinsics.cy"],
        camera_with(sound, cx=-3.0, cy=24.0),
    )
    check("principal-point", "", camera_with(sound, cx=-0.5, cy=23.5))
    check("video-count", "sensors[0].video.content", sound.camera(video=NO_VIDEO))
    check("image-size", "sensors[0].images[1]: 64 x 48 px", camera_of(sound, noise(), noise(64, 48), noise(64, 48)))
    check("image-size", "", own_size(sound))
    check(
        "image-repeated",
        "sensors[0].images[3]: 2 of 5 images are equal to the one before",
        camera_of(sound, BLUE, noise(), BLUE, BLUE, BLUE.copy()),
    )
    check("image-plain", "sensors[0].images[1]: black, as are 1 more", camera_of(sound, noise(), noise(most=9), BLUE))
    check("image-plain", "sensors[0].images[0]: of one colour, [10, 20, 200]", camera_of(sound, BLUE))


@pytest.mark.parametrize(
    ("rule", "row", "near"),
    [
        ("box-not-finite", [np.nan, 1, 2, 2], [0, 1, 2, 2]),
        ("box-not-finite", [np.inf, 1, 2, 2], [0, 1, 2, 2]),
        ("box-negative-size", [5, 5, -1, 2], [5, 5, 0, 2]),
        ("box-without-area", [5, 5, 3, 0], [5, 5, 3, 0.1]),
        ("box-outside-image", [33.5, 5, 4, 4], [32.5, 5, 4, 4]),
        ("box-outside-image", [3, -6, 4, 4.5], [3, -6, 4, 5.5]),
        ("box-beyond-image", [-1.5, 5, 4, 4], [-0.5, 5, 4, 4]),
        ("box-beyond-image", [3, 5, 4, 20.5], [3, 5, 4, 19.5]),
    ],
)
def test_boxes_drawn_and_projected_are_judged_alike(check, rule, row, near):
    locations = ["annotations[0].path.values[1]", "annotations[1].projections[0].boxes[1]"]
    check(rule, locations, drawn(row), projected(row))
    check(rule, "", drawn(near), projected(near))


@pytest.mark.parametrize(
    ("fx", "fy", "wrong"), [(30.0, 50.0, True), (1.0, 1.0, True), (5000.0, 5000.0, True), (30.0, 31.0, False)]
)
def test_focal_lengths_of_no_camera_model_are_found(sound, found, fx, fy, wrong):
    assert bool(found(sound.scene(camera_with(sound, fx=fx, fy=fy)), "focal-length")) is wrong


@pytest.mark.parametrize(
    ("rule", "code"), [("video-or-images", "video-and-images"), ("distortion-length", "short-distortion")]
)
def test_what_the_reader_remarked_is_known_by_its_own_rule(sound, found, rule, code):
    warning = DataWarning(kind=WarningKind.ASSUMED, code=code, location="sensors[1]", message="so it was")
    scene = sound.scene(warnings=(warning,))
    assert found(scene, rule) == [("sensors[1]", "so it was")]
    assert found(scene, "reading-assumed") == []


def test_a_video_with_more_or_fewer_images_than_timestamps_is_found(sound, found, tmp_path):
    with VideoWriter(tmp_path / "video.mp4", 64, 48, fps=10) as writer:
        for timestamp_ns in sound.times().tolist():
            writer.add(np.zeros((48, 64, 3), np.uint8), timestamp_ns / 1e9)
    content = (tmp_path / "video.mp4").read_bytes()

    def found_in(count, chosen=None):
        """What is found where the video of six images has so many timestamps."""
        video = VideoContent(lambda: BytesIO(content), "h264", frame_indices=chosen)
        camera_model = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
        return found(
            sound.scene(sound.camera(sound.times(count), camera_model=camera_model, video=video)), "video-count"
        )

    assert found_in(6) == found_in(6, (0, 1, 2, 3, 4, 5)) == []
    assert found_in(4) == [("sensors[0].video.timestamps", "4 timestamps; the video has 6 images")]
    assert len(found_in(8)) == len(found_in(6, (0, 6))) == 1
