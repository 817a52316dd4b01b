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


def with_camera_model(sound, **fields):
    return sound.camera(camera_model=Camera(**{**sound_camera_model(), **fields}))


def sound_camera_model():
    return {"model": "pinhole", "width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    scene = sound.scene(sound.camera(), with_fisheye(sound))
    assert keeps(scene, CAMERA_RULES)


def with_fisheye(sound):
    camera_model = Camera("fisheye", 32, 24, 9.0, 9.0, 15.5, 11.5, (0.1, 0.0, 0.0, 0.0))
    return sound.camera(id="fish", camera_model=camera_model)


def test_an_unknown_camera_model_is_found(sound, found):
    scene = sound.scene(with_camera_model(sound, model="spherical"))
    [(path, message)] = found(scene, "camera-model-known")
    assert path == "sensors[0].intrinsics.distortion.model"
    assert "'spherical'" in message


@pytest.mark.parametrize(
    ("fields", "locations"),
    [({"cx": 40.0}, ["cx"]), ({"cx": -3.0, "cy": 24.0}, ["cx", "cy"]), ({"cx": -0.5, "cy": 23.5}, [])],
)
def test_a_centre_outside_the_image_is_found(sound, found, fields, locations):
    hits = found(sound.scene(with_camera_model(sound, **fields)), "principal-point")
    assert [path for path, _ in hits] == [f"sensors[0].intrinsics.{name}" for name in locations]


@pytest.mark.parametrize(
    ("fields", "wrong"),
    [
        ({"fx": 30.0, "fy": 50.0}, True),
        ({"fx": 1.0, "fy": 1.0}, True),
        ({"fx": 5000.0, "fy": 5000.0}, True),
        ({"fx": 30.0, "fy": 31.0}, False),
    ],
)
def test_focal_lengths_of_no_camera_model_are_found(sound, found, fields, wrong):
    assert bool(found(sound.scene(with_camera_model(sound, **fields)), "focal-length")) is wrong


@pytest.mark.parametrize(
    ("rule", "code"), [("video-or-images", "video-and-images"), ("distortion-length", "short-distortion")]
)
def test_what_the_reader_remarked_is_known_by_its_own_rule(sound, found, rule, code):
    warning = DataWarning(kind=WarningKind.ASSUMED, code=code, location="sensors[1]", message="so it was")
    scene = sound.scene(warnings=(warning,))
    assert found(scene, rule) == [("sensors[1]", "so it was")]
    assert found(scene, "reading-assumed") == []


@pytest.fixture
def filmed(sound, tmp_path):
    """Make a camera with a video of six images, and some number of timestamps."""
    path = tmp_path / "video.mp4"
    times = sound.times()
    with VideoWriter(path, 64, 48, fps=10) as writer:
        for timestamp_ns in times.tolist():
            writer.add(np.zeros((48, 64, 3), np.uint8), timestamp_ns / 1e9)
    content = path.read_bytes()

    def camera(count=6, **fields):
        camera_model = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
        video = VideoContent(lambda: BytesIO(content), "h264", **fields)
        return sound.camera(sound.times(count), camera_model=camera_model, video=video)

    return camera


@pytest.mark.parametrize("chosen", [None, (0, 1, 2, 3, 4, 5)])
def test_a_video_with_an_image_for_each_timestamp_is_sound(sound, filmed, found, chosen):
    assert found(sound.scene(filmed(frame_indices=chosen)), "video-count") == []


def test_a_video_with_more_or_fewer_images_than_timestamps_is_found(sound, filmed, found):
    problem = "4 timestamps; the video has 6 images"
    assert found(sound.scene(filmed(4)), "video-count") == [("sensors[0].video.timestamps", problem)]
    assert len(found(sound.scene(filmed(8)), "video-count")) == 1
    assert len(found(sound.scene(filmed(6, frame_indices=(0, 6))), "video-count")) == 1


def test_a_video_that_is_none_is_found(sound, found):
    video = VideoContent(lambda: BytesIO(b"no video at all"), "h264")
    [(path, _)] = found(sound.scene(sound.camera(video=video)), "video-count")
    assert path == "sensors[0].video.content"


RNG = np.random.default_rng(1)


def camera_of(sound, *images, camera_model=None, **fields):
    usual = sound.camera().camera
    times = sound.times(len(images))
    made = [
        CameraImage.of(int(t), usual.resized(rgb.shape[1], rgb.shape[0]), rgb)
        for t, rgb in zip(times, images, strict=True)
    ]
    return CameraSensor("front", camera_model or usual, LazyFrames.of(made, times), poses=sound.path(), **fields)


def noise(width=32, height=24):
    return RNG.integers(0, 255, (height, width, 3), np.uint8)


def test_a_sound_scene_keeps_all_rules_about_images(sound, keeps):
    scene = sound.scene(camera_of(sound, noise(), noise(), noise()))
    assert keeps(scene, IMAGE_RULES)


def test_images_of_another_size_are_reported_once_for_the_camera(sound, found):
    scene = sound.scene(camera_of(sound, noise(), noise(64, 48), noise(64, 48)))
    [(path, message)] = found(scene, "image-size")
    assert path == "sensors[0].images[1]"
    assert message.startswith("64 x 48 px")


def test_images_with_camera_models_of_their_own_may_have_their_own_sizes(sound, found):
    scene = sound.scene(camera_of(sound, noise(64, 48)))
    camera = scene.sensors[0]
    own = replace(camera.camera.resized(64, 48), fx=70.0)
    image = replace(camera.images[0], camera=own)
    camera = replace(camera, images=LazyFrames.of([image], [0]))
    assert found(sound.scene(camera), "image-size") == []


def test_images_equal_to_the_one_before_are_counted(sound, found):
    one, other = noise(), noise()
    scene = sound.scene(camera_of(sound, one, other, one, one, one.copy()))
    assert found(scene, "image-repeated") == [("sensors[0].images[3]", "2 of 5 images are equal to the one before")]


def test_black_images_and_those_of_one_colour_are_reported(sound, found):
    dark = RNG.integers(0, 9, (24, 32, 3), np.uint8)
    blue = np.full((24, 32, 3), (10, 20, 200), np.uint8)
    assert found(sound.scene(camera_of(sound, noise(), dark, blue)), "image-plain") == [
        ("sensors[0].images[1]", "black, as are 1 more")
    ]
    assert found(sound.scene(camera_of(sound, blue)), "image-plain") == [
        ("sensors[0].images[0]", "of one colour, [10, 20, 200]")
    ]


PERIOD = 100_000_000
TIMES = np.arange(2, dtype=np.int64) * PERIOD
NULL = [np.nan] * 4


def drawn(row, sensor_id="front"):
    return Box2DAnnotation("box", sensor_id, BoxPath(TIMES, np.array([[1.0, 1, 5, 5], row])))


def projected(row, confirmed=None):
    seen = Projection("front", TIMES, np.array([[1.0, 1, 5, 5], row]), confirmed)
    return CuboidAnnotation("car", CuboidPath(TIMES, np.ones((2, 9))), projections=(seen,))


def outlined(*vertices, name="shape"):
    return ShapeAnnotation(
        name, ShapeType.POLYGON_2D, VertexPath(TIMES[:1], (np.array(vertices, float),)), sensor_id="front"
    )


def test_a_sound_scene_keeps_all_rules_about_boxes(sound, keeps):
    empty = CuboidAnnotation("other", CuboidPath(TIMES, np.ones((2, 9))), projections=(Projection("front", TIMES),))
    annotations = (drawn([0, 0, 32, 24]), projected(NULL, (True, False)), outlined([0, 0], [32, 0], [16, 24]), empty)
    scene = sound.scene(annotations=annotations)
    assert keeps(scene, BOX_RULES)


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
def test_boxes_drawn_and_projected_are_judged_alike(sound, found, rule, row, near):
    scene = sound.scene(annotations=(drawn(row), projected(row)))
    assert [path for path, _ in found(scene, rule)] == [
        "annotations[0].path.values[1]",
        "annotations[1].projections[0].boxes[1]",
    ]
    assert found(sound.scene(annotations=(drawn(near), projected(near))), rule) == []


def test_a_box_drawn_cannot_be_null(sound, found):
    assert len(found(sound.scene(annotations=(drawn(NULL),)), "box-not-finite")) == 1


def test_a_box_outside_is_not_reported_to_reach_beyond_too(sound, found):
    scene = sound.scene(annotations=(drawn([50, 5, 4, 4]),))
    assert found(scene, "box-beyond-image") == []


def test_boxes_of_unknown_cameras_and_of_lidars_are_left_to_other_rules(sound, found):
    for sensor_id in ("gone", "top"):
        scene = sound.scene(annotations=(drawn([90, 5, 4, 4], sensor_id),))
        assert found(scene, "box-outside-image") == []


def test_shapes_and_points_outside_are_found(sound, found):
    point = PointProjection("front", TIMES, np.array([[3.0, 3.0], [60.0, 3.0]]))
    keypoints = PointsAnnotation("hand", (PointPath(TIMES, np.ones((2, 3))),), projections=((point,),))
    annotations = (outlined([40, 3], [45, 3], [45, 9]), keypoints, outlined([30, 3], [40, 3], [40, 9], name=2))
    scene = sound.scene(annotations=annotations)
    assert [path for path, _ in found(scene, "box-outside-image")] == [
        "annotations[0].path.values[0]",
        "annotations[1].projections[0][0].points[1]",
    ]
    assert [path for path, _ in found(scene, "box-beyond-image")] == ["annotations[2].path.values[0]"]


def test_a_null_that_a_person_confirmed_is_found(sound, found):
    scene = sound.scene(annotations=(projected(NULL, (True, True)),))
    assert found(scene, "null-box-confirmed") == [
        ("annotations[0].projections[0].confirmed[1]", "true, yet boxes[1] is null")
    ]
    assert found(sound.scene(annotations=(projected(NULL, (True, None)),)), "null-box-confirmed") == []
