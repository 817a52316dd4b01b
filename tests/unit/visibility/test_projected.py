"""Cuboids in the cameras of a scene, against the simulated street and by hand."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring.cuboid_points import activation_of
from sceneloom.colouring.cuboid_projection import project_cuboids
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    AttributePath,
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    GroupAnnotation,
    LazyFrames,
    Poses,
    Projection,
    Scene,
)
from sceneloom.scene.ego import EgoMotion
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, camera_mount, simulate_street

CAMERA_MODEL = Camera("pinhole", 800, 600, 500.0, 500.0, 399.5, 299.5)
LOOKS_ALONG_X = np.array([[-0.5, 0.5, -0.5, 0.5]])
"""`world_from_camera` of a camera that looks along the world's x, as a quaternion."""


def no_image():
    raise AssertionError("images need not be decoded")


def a_camera(times_ns, *, camera_id="camera", camera_model=CAMERA_MODEL, poses=None, mounts=None):
    images = [
        CameraImage(t, camera_model, no_image, mount=None if mounts is None else mounts[k])
        for k, t in enumerate(times_ns)
    ]
    path = poses or Poses(np.zeros(1, np.int64), np.zeros((1, 3)), LOOKS_ALONG_X, static=True)
    return CameraSensor(camera_id, camera_model, LazyFrames.of(images, times_ns), poses=path)


def a_box(identifier="a", *, x=(10.0, 10.0), timestamps=(0, 100), **more):
    values = np.array([[4.0, 2.0, 1.0, location, 0.0, 0.0, 0.0, 0.0, 0.0] for location in x])
    return CuboidAnnotation(identifier, CuboidPath(np.array(timestamps, np.int64), values), **more)


def test_a_cuboid_gets_a_row_for_each_image_while_it_is_there():
    scene = Scene((a_camera((-50, 0, 50, 100, 150)),), (a_box(x=(10.0, 18.0)), GroupAnnotation("g")))
    projected = project_cuboids(scene).annotations
    (projection,) = projected[0].projections
    assert projection.timestamps_ns.tolist() == [0, 50, 100]
    # fronts at 8, 12 and 16 m; 500 pixels of focal length
    np.testing.assert_allclose(projection.boxes[0], [337.5, 268.75, 125.0, 62.5], atol=1e-3)
    np.testing.assert_allclose(projection.boxes[:, 2], [1000 / 8, 1000 / 12, 1000 / 16], atol=1e-3)
    np.testing.assert_array_equal(projection.cuboids[:, 3], [10.0, 14.0, 18.0])
    assert projection.confirmed is None
    assert isinstance(projected[1], GroupAnnotation)


def test_images_that_do_not_show_it_have_rows_of_nan():
    scene = Scene((a_camera((0, 50, 100)),), (a_box(x=(-30.0, 30.0)),))
    (projection,) = project_cuboids(scene).annotations[0].projections
    assert np.isnan(projection.boxes[:2]).all()
    assert np.isfinite(projection.boxes[2]).all()


def test_a_cuboid_that_no_image_shows_gets_no_projection_and_loses_an_old_one():
    old = Projection("camera", np.array([0]), np.ones((1, 4)))
    of_others = Projection("other", np.array([0]), np.ones((1, 4)))
    scene = Scene((a_camera((0, 50)),), (a_box(x=(-9.0, -9.0), projections=(old, of_others)),))
    assert project_cuboids(scene).annotations[0].projections == (of_others,)


def test_boxes_that_a_person_confirmed_stay():
    old = Projection("camera", np.array([0, 50]), np.full((2, 4), 7.0), confirmed=(True, False))
    scene = Scene((a_camera((0, 50)),), (a_box(projections=(old,)),))
    (projection,) = project_cuboids(scene).annotations[0].projections
    assert projection.confirmed == (True, False)
    assert projection.boxes[0].tolist() == [7.0] * 4
    assert projection.boxes[1, 0] == pytest.approx(337.5)


def test_shares_become_attributes_of_the_camera_at_images_that_show_it():
    older = AttributePath("occlusion", (0.9,), np.array([0]), sensor_id="camera")
    boxes = (a_box(x=(-30.0, 30.0), attributes=(older,)), a_box("b", x=(20.0, 20.0)))
    scene = Scene((a_camera((0, 100)),), boxes)
    first, second = project_cuboids(scene).annotations
    assert [(a.name, a.sensor_id, a.values) for a in first.attributes] == [
        ("truncation", "camera", (0.0,)),
        ("occlusion", "camera", (1.0,)),
    ]
    assert first.attributes[0].timestamps_ns.tolist() == [100]
    assert [a.values for a in second.attributes] == [(0.0, 0.0), (0.0, 0.0)]


def test_what_fills_little_of_its_box_may_hide_nothing():
    boxes = (a_box(x=(20.0, 20.0)), a_box("b", label="tree"))
    scene = Scene((a_camera((0,)),), boxes)
    hidden = project_cuboids(scene).annotations[0].attributes[1].values
    shown = project_cuboids(scene, see_through=["tree"]).annotations[0].attributes[1].values
    assert (hidden, shown) == ((1.0,), (0.0,))


def test_times_in_which_a_camera_sees_it_become_activations():
    # it comes out from behind the camera between the second and the third image, and ends after the fourth
    scene = Scene((a_camera((0, 50, 100, 150, 200)),), (a_box(x=(-90.0, 90.0), timestamps=(0, 160)),))
    (activation,) = project_cuboids(scene, activations=True).annotations[0].activations
    assert activation.timestamps_ns.tolist() == [100]
    assert activation.durations_ns == (100,)
    assert activation.cuboids[0, 3] == pytest.approx(-90.0 + 180.0 * 100 / 160)
    assert project_cuboids(scene).annotations[0].activations == ()


def test_runs_of_frames_become_activations_with_a_frame_longer_at_the_end():
    times = np.array([0, 10, 20, 30, 40])
    made = activation_of("s", times, np.array([True, False, False, True, True]))
    assert made.timestamps_ns.tolist() == [0, 30]
    assert made.durations_ns == (10, 20)
    assert activation_of("s", times, np.zeros(5, bool)) is None
    alone = activation_of("s", times[:1], np.array([True]))
    assert alone.durations_ns == (100_000_000,)


def test_cameras_that_are_nowhere_are_passed_over_or_refused_when_asked_for():
    lost = replace(a_camera((0,), camera_id="lost"), poses=None)
    scene = Scene((a_camera((0,)), lost), (a_box(),))
    projected = project_cuboids(scene)
    assert [n.code for n in projected.warnings] == ["camera-unplaced"]
    assert len(projected.annotations[0].projections) == 1
    with pytest.raises(PoseError, match="'lost'"):
        project_cuboids(scene, cameras="lost")
    with pytest.raises(PoseError, match="'lost'"):
        project_cuboids(replace(scene, sensors=(lost,)))
    with pytest.raises(OptionError, match="no camera 'none'"):
        project_cuboids(scene, cameras="none")
    with pytest.raises(OptionError, match="has no camera that could see"):
        project_cuboids(replace(scene, sensors=()))


def test_images_beyond_the_trajectory_of_the_camera_see_nothing():
    trajectory = Poses(np.array([0, 50]), np.zeros((2, 3)), np.repeat(LOOKS_ALONG_X, 2, axis=0))
    late = 10**10
    scene = Scene((a_camera((0, late), poses=trajectory),), (a_box(stationary=True),))
    projected = project_cuboids(scene)
    assert [(n.code, n.count) for n in projected.warnings] == [("images-unplaced", 1)]
    (projection,) = projected.annotations[0].projections
    assert np.isfinite(projection.boxes[:, 0]).tolist() == [True, False]


def test_progress_counts_images():
    reported = []
    project_cuboids(
        Scene((a_camera((0, 1)),), (a_box(),)), progress=lambda done, total: reported.append((done, total))
    )
    assert reported == [(1, 2), (2, 2)]


@pytest.fixture(scope="module")
def street():
    """A street with traffic, seen by a camera ahead and one aside."""
    aside = Camera("fisheye", 640, 480, 250.0, 250.0, 319.5, 239.5, (0.03, -0.008, 0.002, -0.0004))
    cameras = (CameraSpec(), CameraSpec(aside, camera_mount(yaw_deg=60.0)))
    drive = simulate_street(
        3, frames=3, lidar=LidarSpec(beams=8, steps=90), cameras=cameras, traffic=TrafficSpec()
    )
    return drive, project_cuboids(drive.scene, see_through=("tree", "pole"))


def seen_at(annotation, camera_id, time_ns):
    """The box (x1, y1, x2, y2) and the hidden share of a cuboid in an image, or None."""
    for projection in annotation.projections:
        at = np.flatnonzero(projection.timestamps_ns == time_ns)
        if projection.sensor_id == camera_id and len(at) and np.isfinite(projection.boxes[at[0], 0]):
            x, y, width, height = projection.boxes[at[0]]
            (hidden,) = (
                a for a in annotation.attributes if (a.name, a.sensor_id) == ("occlusion", camera_id)
            )
            share = hidden.values[int(np.searchsorted(hidden.timestamps_ns, time_ns))]
            return np.array([x, y, x + width, y + height]), share
    return None


def overlap(a, b):
    shared = np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0).prod()
    return shared / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - shared)


def test_cars_that_nothing_hides_are_where_their_pixels_are(street):
    drive, projected = street
    overlaps, checked = [], 0
    for camera in drive.scene.cameras:
        for k, time_ns in enumerate(camera.images.timestamps_ns):
            shown, hidden = drive.truth.instances(camera.id, k), drive.truth.occlusion(camera.id, k)
            open_ones = dict(zip(hidden.instances.tolist(), hidden.hidden, strict=True))
            for annotation in projected.annotations:
                instance = int(annotation.id.rsplit("-", 1)[1])
                rows, columns = np.nonzero(shown == instance)
                if annotation.label != "car" or len(rows) < 300 or open_ones[instance] > 0.01:
                    continue
                box, share = seen_at(annotation, camera.id, time_ns)
                pixels = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float)
                overlaps.append(overlap(box, pixels))
                assert share < 0.5
                checked += 1
    assert checked >= 6
    assert np.mean(overlaps) > 0.9  # a car is rounder than its box
    assert min(overlaps) > 0.8


def test_whatever_an_image_shows_of_a_cuboid_lies_in_its_box(street):
    drive, projected = street
    for camera in drive.scene.cameras:
        for k, time_ns in enumerate(camera.images.timestamps_ns):
            shown = drive.truth.instances(camera.id, k)
            for annotation in projected.annotations:
                rows, columns = np.nonzero(shown == int(annotation.id.rsplit("-", 1)[1]))
                if len(rows) == 0:
                    continue
                found = seen_at(annotation, camera.id, time_ns)
                if found is None:
                    assert len(rows) < 3, annotation.id  # smaller than `min_pixels`
                    continue
                low, high = found[0][:2], found[0][2:]
                # centres of pixels; paths are straight between samples, which is some millimetres off
                assert (np.array([columns.min(), rows.min()]) + 0.5 >= low - 0.5).all(), annotation.id
                assert (np.array([columns.max(), rows.max()]) + 0.5 <= high + 0.5).all(), annotation.id


def shares_of(scene, name, time_ns):
    """The values of an attribute at a time, by instance."""
    return {
        int(annotation.id.rsplit("-", 1)[1]): path.values[
            int(np.flatnonzero(path.timestamps_ns == time_ns)[0])
        ]
        for annotation in scene.annotations
        for path in annotation.attributes
        if path.name == name and (path.timestamps_ns == time_ns).any()
    }


def test_points_of_a_lidar_report_how_much_is_hidden_by_whatever_stands_there():
    drive = simulate_street(3, frames=3, traffic=TrafficSpec())
    projected = project_cuboids(drive.scene, see_through=("tree", "pole"), lidar="lidar")
    thin = {int(a.id.rsplit("-", 1)[1]) for a in drive.scene.annotations if a.label in ("tree", "pole")}
    reported, exact = [], []
    for k, time_ns in enumerate(drive.scene.cameras[0].images.timestamps_ns):
        truth = drive.truth.occlusion("camera0", k)
        found = shares_of(projected, "occlusion_by_points", time_ns)
        for instance, hidden, alone in zip(truth.instances, truth.hidden, truth.alone_px, strict=True):
            if instance in found and alone >= 200 and instance not in thin:
                reported.append(found[instance])
                exact.append(hidden)
    assert len(reported) > 30
    # lidar and camera stand apart, points are sparse, and things are rounder than their boxes
    assert np.abs(np.subtract(reported, exact)).mean() < 0.08
    assert np.corrcoef(reported, exact)[0, 1] > 0.95


def test_sweeps_long_before_an_image_and_lidars_that_are_nowhere_are_no_evidence():
    drive = simulate_street(3, frames=2, lidar=LidarSpec(beams=8, steps=90))
    (lidar,), others = drive.scene.lidars, [s for s in drive.scene.sensors if s.type != "lidar"]
    early = LazyFrames.of(list(lidar.frames), (lidar.frames.timestamps_ns - 10**9).tolist())
    scene = replace(drive.scene, sensors=(*others, replace(lidar, frames=early)))
    reported = {path.name for a in project_cuboids(scene, lidar="lidar").annotations for path in a.attributes}
    assert reported == {"truncation", "occlusion"}
    lost = replace(scene, sensors=(*others, replace(lidar, poses=None)), trajectories={})
    with pytest.raises(OptionError, match="no lidar 'none'"):
        project_cuboids(scene, lidar="none")
    with pytest.raises(PoseError, match="lidar 'lidar'"):
        project_cuboids(lost, lidar="lidar")


def test_a_mounting_of_one_image_counts():
    ego = Poses(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[0.0, 0, 0, 1]]), static=True)
    ahead = RigidTransform.from_quaternion(np.zeros(3), LOOKS_ALONG_X[0])
    back = RigidTransform(np.diag([-1.0, -1.0, 1.0]) @ ahead.rotation, np.zeros(3))
    camera = replace(a_camera((0, 50), mounts=(None, back)), poses=None, mount=ahead)
    projected = project_cuboids(Scene((camera,), (a_box(),)), trajectory=EgoMotion("still", ego))
    (projection,) = projected.annotations[0].projections
    assert np.isfinite(projection.boxes[:, 0]).tolist() == [True, False]
