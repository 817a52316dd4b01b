"""Cuboids in images of rolling shutters, against points of their edges, each looked for at the time of its line."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded
from sceneloom.colouring.cuboid_projection import project_cuboids
from sceneloom.geometry.boxes import CORNER_SIGNS, EDGES
from sceneloom.scene import CameraImage, CameraSensor, CuboidAnnotation, CuboidPath, LazyFrames, Poses, Scene
from sceneloom.simulate import camera_mount

SPEED, ROTATION, ROLL_S = 15.0, np.radians(30.0), 0.04
MOUNT = camera_mount(position=(1.5, 0.3, 1.6), yaw_deg=20.0)
PINHOLE = Camera("pinhole", 1280, 720, 600.0, 600.0, 639.5, 359.5)
FISHEYE = Camera("fisheye", 1280, 960, 400.0, 400.0, 639.5, 479.5, (0.03, -0.008, 0.002, -0.0004))
SECOND = 1_000_000_000


def camera_at(seconds, speed=SPEED, rotation=ROTATION):
    """The camera on a vehicle that drives a circle: rotations and positions, in closed form."""
    rotated = np.asarray(seconds) * rotation
    radius = speed / rotation
    ego = Rotation.from_rotvec(np.outer(rotated, (0, 0, 1)))
    locations = np.column_stack([radius * np.sin(rotated), radius * (1 - np.cos(rotated)), 0 * rotated])
    return ego * Rotation.from_matrix(MOUNT.rotation.copy()), ego.apply(MOUNT.translation.copy()) + locations


def stationary(seconds):
    """The same camera on a vehicle that stands."""
    return camera_at(0.0 * np.asarray(seconds))


class Moving:
    """A box that goes straight and rotates evenly; `first` is where it is at time 0."""

    def __init__(self, name, size, first, velocity=(0.0, 0.0, 0.0), yaw=0.3, yaw_rate=0.0):
        self.name, self.size, self.first = name, np.array(size), np.array(first)
        self.velocity, self.yaw, self.yaw_rate = np.array(velocity), yaw, yaw_rate

    def cuboid(self):
        values = [
            [
                *self.size,
                *(self.first + self.velocity * t),
                0.0,
                0.0,
                np.degrees(self.yaw + self.yaw_rate * t),
            ]
            for t in (-1.0, 1.0)
        ]
        return CuboidAnnotation(self.name, CuboidPath(np.array([-SECOND, SECOND]), np.array(values)))

    def rotated(self, seconds):
        return Rotation.from_rotvec(np.outer(self.yaw + self.yaw_rate * seconds, (0, 0, 1)))

    def location(self, points_box, seconds):
        rotated = self.rotated(seconds)
        return rotated.apply(points_box) + self.first + self.velocity * np.asarray(seconds)[:, None]

    def hit(self, origins, rays, seconds):
        """How far along rays (N, 3) it begins, infinity for none: by its three pairs of faces."""
        rotated = self.rotated(seconds).inv()
        origin = rotated.apply(origins - self.first - self.velocity * seconds[:, None])
        ray = rotated.apply(rays)
        bounds = np.stack([(side * self.size / 2 - origin) / ray for side in (-1, 1)])
        near, far = bounds.min(axis=0).max(axis=1), bounds.max(axis=0).min(axis=1)
        return np.where((near < far) & (near > 0), near, np.inf)


def a_scene(camera, boxes, *, over_columns=False, roll_s=ROLL_S, trajectory=camera_at):
    seconds = np.linspace(-0.1, 0.1, 401)
    rotations, positions = trajectory(seconds)
    poses = Poses(np.rint(seconds * SECOND).astype(np.int64), positions, rotations.as_quat())
    stated = {"shutterRollTimeSeconds": roll_s, "rollingShutterLeftToRight": over_columns}
    frames = LazyFrames.of([CameraImage(0, camera, lambda: None)], (0,))
    sensor = CameraSensor("camera", camera, frames, poses=poses, extras={"calibration": stated})
    return Scene((sensor,), tuple(box.cuboid() for box in boxes))


def seen_at_their_lines(camera, box, points_box, *, over_columns, trajectory):
    """Pixels (N, 2) of points of a box: the line of each is looked for by halves."""
    axis, size = (0, camera.width) if over_columns else (1, camera.height)
    low, high = np.full(len(points_box), -0.5), np.full(len(points_box), size - 0.5)
    for _ in range(40):
        line = 0.5 * (low + high)
        seconds = ((line + 0.5) / size - 0.5) * ROLL_S
        rotations, locations = trajectory(seconds)
        pixels = project_unbounded(
            camera, rotations.inv().apply(box.location(points_box, seconds) - locations)
        )
        later = pixels[:, axis] > line
        low, high = np.where(later, line, low), np.where(later, high, line)
    return pixels


def edge_points(box, count=400):
    corners, along = CORNER_SIGNS * box.size / 2, np.linspace(0, 1, count)[:, None]
    return np.concatenate([(1 - along) * corners[a] + along * corners[b] for a, b in EDGES])


def extent(pixels):
    """Left, top, width, height, corner convention."""
    low, high = np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0)
    return [*(low + 0.5), *(high - low)]


CAR = Moving("car", (4.5, 1.9, 1.6), (9.0, 6.5, -0.8), velocity=(-14.0, 2.0, 0.0), yaw_rate=0.6)
NEAR = Moving("near", (4.5, 1.9, 1.6), (6.5, 4.5, 1.2), yaw=1.2)


@pytest.mark.parametrize("trajectory", [camera_at, stationary], ids=["driving", "stationary"])
@pytest.mark.parametrize("over_columns", [False, True], ids=["rows", "columns"])
@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("box", [CAR, NEAR], ids=["car", "near"])
@pytest.mark.few(5)
def test_a_cuboid_lies_where_its_points_are_seen_by_their_lines(camera, box, over_columns, trajectory):
    scene = a_scene(camera, [box], over_columns=over_columns, trajectory=trajectory)
    (projection,) = project_cuboids(scene).annotations[0].projections
    expected = extent(
        seen_at_their_lines(camera, box, edge_points(box), over_columns=over_columns, trajectory=trajectory)
    )
    # Edges are followed within 0.1 px.
    np.testing.assert_allclose(projection.boxes[0], expected, atol=0.1)
    at_once = a_scene(camera, [box], roll_s=0.0, trajectory=trajectory)
    (projection,) = project_cuboids(at_once).annotations[0].projections
    moves = trajectory is camera_at or box is CAR
    assert (np.abs(projection.boxes[0] - expected).max() > 0.5) == moves


def test_what_hides_it_is_reported_at_the_time_of_each_line():
    before = Moving("before", (0.5, 1.2, 4.0), (6.0, 4.0, 0.5), velocity=(0.0, -9.0, 0.0))
    boxes = [CAR, before]
    for roll_s in (ROLL_S, 0.0):
        projected = project_cuboids(a_scene(PINHOLE, boxes, roll_s=roll_s)).annotations[0]
        left, top, width, height = projected.projections[0].boxes[0]
        v, u = (grid.ravel() for grid in np.mgrid[0:150, 0:150])
        pixels = np.column_stack([left + (u + 0.5) / 150 * width, top + (v + 0.5) / 150 * height]) - 0.5
        seconds = ((pixels[:, 1] + 0.5) / PINHOLE.height - 0.5) * roll_s
        rotations, locations = camera_at(seconds)
        rays = np.column_stack([(pixels - (639.5, 359.5)) / 600.0, np.ones(len(pixels))])
        own, other = (box.hit(locations, rotations.apply(rays), seconds) for box in boxes)
        met = np.isfinite(own)
        expected = (other < own)[met].mean()
        found = next(path for path in projected.attributes if path.name == "occlusion").values[0]
        assert 0.1 < expected < 0.9
        assert found == pytest.approx(expected, abs=0.03)  # 24 rays along each side


def test_what_the_image_cuts_off_is_reported_at_the_time_of_each_line():
    """A box that leaves the image upward is whole to the lines that saw it before."""
    rising = Moving("rising", (1.0, 1.0, 1.0), (12.0, 4.5, 8.0), velocity=(0.0, 0.0, 60.0), yaw=0.0)
    shares = {}
    for roll_s in (ROLL_S, 0.0):
        projected = project_cuboids(
            a_scene(PINHOLE, [rising], roll_s=roll_s, trajectory=stationary)
        ).annotations[0]
        shares[roll_s] = next(path for path in projected.attributes if path.name == "truncation").values[0]
    assert shares[0.0] > 0.2
    assert shares[ROLL_S] == 0.0


def test_a_shutter_over_a_scene_that_stands_changes_nothing():
    still = Moving("still", (4.5, 1.9, 1.6), (13.0, 6.0, 0.8))
    found = [
        project_cuboids(a_scene(PINHOLE, [still], roll_s=roll_s, trajectory=stationary)).annotations[0]
        for roll_s in (ROLL_S, 0.0)
    ]
    np.testing.assert_array_equal(found[0].projections[0].boxes, found[1].projections[0].boxes)
    assert [path.values for path in found[0].attributes] == [path.values for path in found[1].attributes]
