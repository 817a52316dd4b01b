"""Tests of objects that an image shows and the points of a sweep location."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from sceneloom.cameras.camera import Camera
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import DetectionPair
from sceneloom.errors import ArrayError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Boxes2D, Boxes3D
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, detect_2d, simulate_street

CAMERA = Camera("pinhole", 1200, 400, 700.0, 700.0, 599.5, 199.5)
# the camera is where the lidar is and looks along its x axis
CAMERA_FROM_LIDAR = RigidTransform(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3))
# what a pedestrian of 1.72 m shows who stands 15 m ahead with his feet 1.7 m below the camera
FEET, HEAD = 199.5 + 0.5 + 700.0 * 1.7 / 15.0, 199.5 + 0.5 - 700.0 * 0.02 / 15.0
PEDESTRIAN = np.array([[590.0, HEAD, 610.0, FEET]])


def pair_of(points, corners=PEDESTRIAN, label="pedestrian", boxes_3d=None):
    return DetectionPair(
        Boxes3D.empty(0) if boxes_3d is None else boxes_3d,
        Boxes2D(0, corners, np.full(len(corners), 0.9), (label,) * len(corners)),
        CAMERA,
        CAMERA_FROM_LIDAR,
        None if points is None else np.asarray(points, np.float32),
    )


def a_wall(distance, left=0.4, low=-1.7, high=0.3, count=9):
    """Points of a flat thing that faces the camera, (N, 3) [m], in the lidar's frame."""
    y, z = (
        grid.ravel() for grid in np.meshgrid(np.linspace(-left, left, count), np.linspace(low, high, count))
    )
    return np.column_stack([np.full(len(y), distance), y, z])


def test_an_object_is_behind_the_points_in_the_middle_of_its_box():
    behind = a_wall(30.0, left=10.0, count=60)
    points = np.concatenate([a_wall(14.0), behind[np.abs(behind[:, 1]) > 0.3]])
    fused = fuse_by_projection(pair_of(points))
    assert fused.by_points.tolist() == [True]
    # a body is a quarter of the usual 0.65 m deep behind its surface; along a ray 5 degrees off the axis
    assert fused.centers[0, 0] == pytest.approx(14.16, abs=0.1)
    by_height = fuse_by_projection(pair_of(None))
    assert by_height.by_points is None
    assert by_height.centers[0, 0] == pytest.approx(15.0, abs=0.5)
    assert fused.center_covariances[0, 0, 0] < by_height.center_covariances[0, 0, 0] / 10.0


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        a_wall(14.0, count=2),  # too few
        np.full((50, 3), np.nan),
        np.column_stack([a_wall(14.0)[:, 0], a_wall(14.0)[:, 1:] + 8.0]),  # beside it
        np.concatenate([a_wall(14.0), a_wall(5.0, count=60)]),  # most of its box shows something nearer
    ],
)
def test_points_that_do_not_report_leave_an_object_where_its_height_puts_it(points):
    fused, by_height = fuse_by_projection(pair_of(points)), fuse_by_projection(pair_of(None))
    assert fused.by_points.tolist() == [False]
    np.testing.assert_array_equal(fused.centers, by_height.centers)
    np.testing.assert_array_equal(fused.center_covariances, by_height.center_covariances)


def test_points_of_a_box_of_the_sweep_are_of_that_object():
    # a car that stands before the pedestrian and hides the lower part, and has a box of its own
    car = Boxes3D(
        0, np.array([[10.0, 0.0, -1.0]]), np.array([[4.2, 1.8, 1.5]]), np.zeros(1), np.array([0.95]), ("car",)
    )
    points = np.concatenate([a_wall(14.0), a_wall(8.0, low=-1.7, high=-0.3, count=14)])
    assert not fuse_by_projection(pair_of(points)).by_points[0]
    fused = fuse_by_projection(pair_of(points, boxes_3d=car))
    assert fused.by_points.tolist() == [False, True]
    assert fused.centers[1, 0] == pytest.approx(14.16, abs=0.1)


def test_what_the_border_cuts_is_known_less_well():
    whole = np.array([[500.0, 150.0, 700.0, 260.0]])
    cut = whole - [500.0, 0.0, 500.0, 0.0]
    sides = a_wall(9.0, left=8.0, low=-1.0, high=0.6, count=60)
    seen, half_seen = (fuse_by_projection(pair_of(sides, box, "car")) for box in (whole, cut))
    assert seen.by_points[0]
    assert half_seen.by_points[0]
    volumes = [np.linalg.det(one.center_covariances[0]) for one in (seen, half_seen)]
    assert volumes[1] > 4.0 * volumes[0]


def test_points_of_another_form_are_refused():
    with pytest.raises(ArrayError, match="points_lidar"):
        replace(pair_of(None), points_lidar=np.zeros((3, 3)))


@pytest.fixture(scope="module")
def errors():
    """Errors of centres with their covariances, and of the distances that heights alone give, of simulated objects."""
    drive = simulate_street(
        21,
        frames=9,
        lidar=LidarSpec(steps=1200),
        cameras=(CameraSpec(Camera("pinhole", 620, 188, 360.0, 360.0, 309.5, 93.5)),),
        traffic=TrafficSpec(cars=4.0, cyclists=3.0, pedestrians=6.0),
    )
    lidar, camera, frames, found = drive.truth.lidar, drive.scene.cameras[0], [0, 4, 8], []
    for k, detected in zip(frames, detect_2d(drive, frames=frames), strict=True):
        sweep = drive.scene.lidars[0].frames[k]
        ego = drive.truth.path.at(np.array([sweep.reference_ns]))
        world_from_lidar = RigidTransform(ego.rotations[0], ego.positions[0]) @ lidar.spec.mount
        camera_from_lidar = drive.truth.world_from_camera(camera.id, k).inverse() @ world_from_lidar
        pair = DetectionPair(
            Boxes3D.empty(0), detected.boxes, camera.camera, camera_from_lidar, sweep.points.positions
        )
        fused, by_height = fuse_by_projection(pair), fuse_by_projection(replace(pair, points_lidar=None))
        truth = drive.truth.boxes(np.array([sweep.reference_ns]))
        centers = world_from_lidar.inverse().apply(truth.centers_world[0])
        origin = camera_from_lidar.inverse().translation
        for row, instance in enumerate(detected.instances[fused.rows_2d].tolist()):
            if instance > 0 and fused.by_points[row]:
                center = centers[truth.instances.tolist().index(instance)]
                off, ray = fused.centers[row] - center, (center - origin) / np.linalg.norm(center - origin)
                found.append(
                    (
                        off @ np.linalg.solve(fused.center_covariances[row], off),
                        abs(off @ ray),
                        abs((by_height.centers[row] - center) @ ray),
                    )
                )
    return np.array(found)


def test_points_report_distances_several_times_better_than_heights(errors):
    assert len(errors) > 15
    assert np.median(errors[:, 1]) < np.median(errors[:, 2]) / 4.0


def test_covariances_of_simulated_objects_are_wide_enough(errors):
    # of some dozens of objects; a few stand behind what fills their box, whatever the covariance says
    assert (errors[:, 0] < chi2.ppf(0.95, 3)).mean() > 0.85
    assert np.median(errors[:, 0]) < chi2.ppf(0.5, 3) * 1.5
