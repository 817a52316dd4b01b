"""Scenes with undistorted images and with converted camera models."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras import Camera, project_unbounded, unproject
from sceneloom.cameras.undistortion import undistorted_camera
from sceneloom.editing import convert_camera_models, undistort_scene
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

BARREL = Camera("brown_conrady", 320, 200, 210.0, 215.0, 161.0, 98.0, (-0.28, 0.08, 1e-3, -5e-4, -0.01))
PINHOLE = undistorted_camera(BARREL)
FISHEYE = Camera("fisheye", 640, 480, 320.0, 320.0, 319.5, 239.5, (0.05, -0.02, 0.01, -0.003))
OTHER = Camera("fisheye", 640, 480, 330.0, 320.0, 319.5, 239.5, (0.05, -0.02, 0.01, -0.003))
ALL_AROUND = Camera("fisheye", 640, 640, 140.0, 140.0, 319.5, 319.5)
TIME = np.array([0], np.int64)
CORNER = np.array([[1.0, 1.0, 3.0, 3.0]])  # of a barrel's image, cut off from an image without black border


def street(camera):
    spec = CameraSpec(camera, supersampling=4)
    return simulate_street(1, frames=2, lidar=LidarSpec(beams=8, steps=90), cameras=(spec,)).scene


def scene_of(cameras, *annotations, value=0):
    """A scene of one camera with an image of each of these camera models, or of one."""
    cameras = cameras if isinstance(cameras, list) else [cameras]
    rgb = np.full((cameras[0].height, cameras[0].width, 3), value, np.uint8)
    images = [sc.CameraImage.of(k, camera, rgb) for k, camera in enumerate(cameras)]
    return sc.Scene(
        (sc.CameraSensor("front", cameras[0], sc.LazyFrames.of(images, list(range(len(images))))),), annotations
    )


def box(identifier, row, sensor="front"):
    return sc.Box2DAnnotation(identifier, sensor, sc.BoxPath(TIME, np.array([row])))


def shape(identifier, kind, vertices):
    path = sc.VertexPath(TIME, (np.array(vertices, float),))
    return sc.ShapeAnnotation(identifier, kind, path, sensor_id="front" if kind.value.endswith("_2d") else None)


def cuboid(*boxes):
    projection = sc.Projection("front", np.arange(len(boxes)), boxes=np.array(boxes))
    return sc.CuboidAnnotation("c", sc.CuboidPath(TIME, np.ones((1, 9))), projections=(projection,))


def moved(pixels, before=BARREL, after=PINHOLE):
    """Corner convention in and out: half a pixel off the centres."""
    return project_unbounded(after, unproject(before, np.asarray(pixels, float) - 0.5)) + 0.5


@pytest.fixture(scope="module")
def distorted():
    """Images are rendered when they are asked for, and each test asks again: here they are kept."""
    scene = street(BARREL)
    (camera,) = scene.cameras
    kept = [image.loaded() for image in camera.images]
    seen = replace(camera, images=sc.LazyFrames.of(kept, camera.images.timestamps_ns))
    return replace(scene, sensors=tuple(seen if sensor is camera else sensor for sensor in scene.sensors))


def test_images_are_those_that_a_pinhole_takes_of_the_same_street(distorted):
    undistorted, expected = undistort_scene(distorted), street(PINHOLE)
    assert undistorted.cameras[0].camera == PINHOLE
    for ours, theirs in zip(undistorted.cameras[0].images, expected.cameras[0].images, strict=True):
        assert ours.camera == PINHOLE
        assert ours.timestamp_ns == theirs.timestamp_ns
        off = np.abs(ours.rgb.astype(int) - theirs.rgb).max(axis=2)
        # each image is sampled on its own grid: outlines and textures finer than a pixel differ, areas do not
        assert np.median(off) <= 2
        assert np.mean(off > 40) < 0.03
        assert np.corrcoef(ours.rgb.ravel(), theirs.rgb.ravel())[0, 1] > 0.98


def test_everything_else_stays_and_the_camera_model_that_took_the_images_stands_in_the_metadata(distorted, tmp_path):
    scene = undistort_scene(distorted, keep=1.0)
    before, after = distorted.cameras[0], scene.cameras[0]
    assert (after.poses is before.poses, after.mount is before.mount) == (True, True)
    assert np.array_equal(after.images.timestamps_ns, before.images.timestamps_ns)
    assert scene.lidars == distorted.lidars
    [ours] = scene.metadata["sceneloom"]["undistorted"]
    assert (ours["sensor"], ours["keep"], ours["camera"]["model"]) == (before.id, 1.0, "brown_conrady")
    assert tuple(ours["camera"]["coefficients"]) == BARREL.coefficients
    assert np.array_equal(pickle.loads(pickle.dumps(after.images))[1].rgb, after.images[1].rgb)
    for name in ("drive.sfs", "drive"):
        sceneloom.write(undistort_scene(distorted, width=160, height=100), tmp_path / name)
        with sceneloom.open(tmp_path / name) as scene:
            assert scene.cameras[0].camera == undistorted_camera(BARREL, width=160, height=100)
            assert [image.rgb.shape for image in scene.cameras[0].images] == [(100, 160, 3)] * 2


def test_images_with_camera_models_of_their_own_get_the_same_new_one_and_features_are_no_longer_true():
    other = Camera("brown_conrady", 320, 200, 215.0, 215.0, 160.0, 100.0, (-0.2,))
    found = undistort_scene(scene_of([BARREL, other], value=77)).cameras[0].images
    assert [image.camera for image in found] == [PINHOLE, PINHOLE]
    assert (found[1].rgb == 77).mean() > 0.9
    # encoded images and locations of features are no longer true
    decode = scene_of(BARREL).cameras[0].images[0].decode
    image = sc.CameraImage(0, BARREL, decode, extras={"features": [1], "number": 3}, encoded=lambda: b"jpeg")
    scene = sc.Scene((sc.CameraSensor("front", BARREL, sc.LazyFrames.of([image], [0])),))
    found = undistort_scene(scene).cameras[0].images[0]
    assert found.encoded is None
    assert dict(found.extras) == {"number": 3}


def test_boxes_shapes_points_and_projections_follow():
    row = [60.0, 50.0, 120.0, 80.0]
    other = box("o", row, "rear")
    found, untouched = undistort_scene(scene_of(BARREL, box("b", row), other)).annotations
    along = np.linspace(0, 1, 200)
    sides = [(along, 0 * along), (along, 0 * along + 1), (0 * along, along), (0 * along + 1, along)]
    outline = np.concatenate([np.stack(side, axis=1) for side in sides])
    locations = moved(outline * [120, 80] + [60, 50])
    left, top, width, height = found.path.values[0]
    assert np.allclose([left, top], locations.min(axis=0), atol=0.1)  # nine locations stand for each side
    assert np.allclose([left + width, top + height], locations.max(axis=0), atol=0.1)
    assert untouched is other
    vertices = np.array([[40.5, 30.0], [100.0, 150.0], [200.0, 60.0]])
    space = shape("a", sc.ShapeType.POLYGON, np.zeros((3, 3)))
    point = sc.PointProjection("front", TIME, points=np.array([[70.0, 80.0]]))
    points = sc.PointsAnnotation("p", (sc.PointPath(TIME, np.zeros((1, 3))),), projections=((point,),))
    seen = cuboid([90.0, 60.0, 4.0, 4.0], [np.nan] * 4)
    scene = undistort_scene(scene_of(BARREL, shape("s", sc.ShapeType.POLYGON_2D, vertices), space, seen, points))
    assert np.allclose(scene.annotations[0].path.vertices[0], moved(vertices))
    assert scene.annotations[1] is space
    boxes = scene.annotations[2].projections[0].boxes
    assert np.allclose(boxes[0, :2] + boxes[0, 2:] / 2, moved([[92.0, 62.0]]), atol=0.05)
    assert np.isnan(boxes[1]).all()
    assert np.allclose(scene.annotations[3].projections[0][0].points, moved([[70.0, 80.0]]))
    assert "drawn-beyond-image" not in [warning.code for warning in scene.warnings]


def test_what_the_new_image_does_not_show_is_left_out_and_counted():
    line = shape("s", sc.ShapeType.POLYGON_2D, [[1.0, 1], [4, 1], [1, 4]])
    drawn = scene_of(BARREL, box("b", CORNER[0]), line, cuboid(*CORNER))
    scene = undistort_scene(drawn)
    assert [annotation.id for annotation in scene.annotations] == ["c"]
    assert np.isnan(scene.annotations[0].projections[0].boxes).all()
    assert [warning.count for warning in scene.warnings if warning.code == "drawn-beyond-image"] == [3]
    assert [annotation.id for annotation in undistort_scene(drawn, keep=1.0).annotations] == ["b", "s", "c"]
    # what a pinhole cannot show: 144 degrees off the axis
    wide = Camera("fisheye", 640, 640, 180.0, 180.0, 319.5, 319.5)
    values = np.array([[300.0, 300.0, 9.0, 9.0], [0.0, 0.0, 9.0, 9.0]])
    seen = sc.Box2DAnnotation("box", "front", sc.BoxPath(np.array([0, 5], np.int64), values))
    scene = undistort_scene(scene_of(wide, shape("lone", sc.ShapeType.POINT_2D, [[2.0, 2.0]]), seen))
    assert [(a.id, a.path.timestamps_ns.tolist()) for a in scene.annotations] == [("box", [0])]
    assert [(n.code, n.count) for n in scene.warnings] == [("drawn-beyond-image", 2)]


def test_models_that_fit_stay_with_a_warning_and_those_that_annotations_replace_are_applied_first():
    for scene, change, code in (
        (scene_of(PINHOLE), undistort_scene, "nothing-to-undistort"),
        (scene_of(FISHEYE), lambda scene: convert_camera_models(scene, "fisheye"), "nothing-to-convert"),
    ):
        found = change(scene)
        assert found.sensors == scene.sensors
        assert [warning.code for warning in found.warnings] == [code]
    # those that annotations replace are applied first, and not left off
    calibration = sc.CameraCalibration("better", "front", intrinsics=BARREL)
    straight = undistort_scene(scene_of(PINHOLE, calibration))
    assert (straight.annotations, straight.cameras[0].camera.model) == ((), "pinhole")
    assert straight.metadata["sceneloom"]["undistorted"][0]["camera"]["model"] == BARREL.model
    with pytest.raises(
        OptionError, match=r"annotations\[better\] gives camera 'front' another camera model; apply it first"
    ):
        undistort_scene(replace(scene_of(BARREL, calibration), corrections=sc.Corrections.IGNORE))
    of_another = sc.CameraCalibration("better", "rear", intrinsics=PINHOLE)
    moved_only = sc.CameraCalibration("moved", "front", time_offset_ns=5)
    left_off = replace(scene_of(BARREL, of_another, moved_only), corrections=sc.Corrections.IGNORE)
    assert undistort_scene(left_off).annotations == (of_another, moved_only)


def test_what_is_no_camera_and_limits_and_models_that_are_none_are_refused(distorted):
    with pytest.raises(OptionError, match="no sensor 'periscope'"):
        undistort_scene(distorted, cameras=["periscope"])
    with pytest.raises(OptionError, match="is a lidar; expected a camera"):
        undistort_scene(distorted, cameras=[distorted.lidars[0].id])
    with pytest.raises(OptionError, match="has no camera"):
        undistort_scene(sc.Scene(()))
    for model, options, problem in (
        ("brown_conrady", {"limit_px": -1}, "expected 0 px or more and a share of 0 to 1"),
        ("brown_conrady", {"limit_px": float("nan")}, "expected 0 px or more and a share of 0 to 1"),
        ("brown_conrady", {"share": 1.5}, "expected 0 px or more and a share of 0 to 1"),
        ("periscope", {}, "camera model 'periscope'"),
        ("pinhole", {"cameras": ["rear"]}, "no sensor 'rear'"),
    ):
        with pytest.raises(OptionError, match=problem):
            convert_camera_models(scene_of(FISHEYE), model, **options)


def distances_px(exact, other):
    pixels = np.stack(np.meshgrid(np.arange(0, 640, 7.0), np.arange(0, 480, 7.0)), axis=-1).reshape(-1, 2)
    return np.hypot(*(project_unbounded(other, unproject(exact, pixels)) - pixels).T)


def test_a_camera_model_shows_what_the_old_one_does_within_a_limit_or_is_refused_with_the_figure():
    scene = convert_camera_models(scene_of([FISHEYE, OTHER]), "brown_conrady")
    camera_model = scene.cameras[0].camera
    entry = scene.metadata["sceneloom"]["camera_models"][0]
    assert camera_model.model == "brown_conrady"
    assert distances_px(FISHEYE, camera_model).max() <= entry["largest_px"] < 0.1
    assert entry["camera"]["model"] == "fisheye"
    assert tuple(entry["camera"]["coefficients"]) == FISHEYE.coefficients
    warning = scene.warnings[0]
    assert (warning.code, warning.location) == ("camera-model-fitted", "sensors[front].camera")
    assert "fisheye camera model reported as brown_conrady, off by up to" in warning.message
    # images have their own camera models converted, too
    first, second = scene.cameras[0].images
    assert (first.camera, second.camera.model) == (camera_model, "brown_conrady")
    assert np.nanmax(distances_px(OTHER, second.camera)) < 0.1  # corners may be given up, as the share reports
    with pytest.raises(
        CalibrationError, match=r"sensors\[front\].camera: fisheye camera model reported as pinhole, off by up to"
    ):
        convert_camera_models(scene_of(FISHEYE), "pinhole")
    assert convert_camera_models(scene_of(FISHEYE), "pinhole", limit_px=500).cameras[0].camera.model == "pinhole"
    with pytest.raises(CalibrationError, match="% of the image cannot be held; expected at most 1 px and 1 %"):
        convert_camera_models(scene_of(ALL_AROUND), "brown_conrady")
    found = convert_camera_models(scene_of(ALL_AROUND), "brown_conrady", share=0.2)
    assert found.metadata["sceneloom"]["camera_models"][0]["share"] < 0.5
