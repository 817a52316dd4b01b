"""Cuboids in images: against the simulated street, OpenCV, very many rays and points, and by hand."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, project_unbounded, unproject
from sceneloom.colouring.cuboid_projection import activation_of, observe_cuboids, project_cuboids
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.boxes import CORNER_SIGNS, EDGES
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.ego import EgoMotion
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, camera_mount, simulate_street

CAMERA_MODEL = Camera("pinhole", 800, 600, 500.0, 500.0, 399.5, 299.5)

LOOKS_ALONG_X = np.array([[-0.5, 0.5, -0.5, 0.5]])
"""`world_from_camera` of a camera that looks along the world's x, as a quaternion."""


def no_image():
    raise AssertionError("images need not be decoded")


def a_camera(times_ns, *, camera_id="camera", camera_model=CAMERA_MODEL, poses=None, mounts=None):
    own = mounts or [None] * len(times_ns)
    images = [sc.CameraImage(t, camera_model, no_image, mount=m) for t, m in zip(times_ns, own, strict=True)]
    path = poses or sc.Poses(np.zeros(1, np.int64), np.zeros((1, 3)), LOOKS_ALONG_X, static=True)
    return sc.CameraSensor(camera_id, camera_model, sc.LazyFrames.of(images, times_ns), poses=path)


def a_box(identifier="a", *, x=(10.0, 10.0), timestamps=(0, 100), **more):
    values = np.array([[4.0, 2.0, 1.0, location, 0.0, 0.0, 0.0, 0.0, 0.0] for location in x])
    return sc.CuboidAnnotation(identifier, sc.CuboidPath(np.array(timestamps, np.int64), values), **more)


def test_a_cuboid_gets_a_row_for_each_image_nan_where_it_is_not_shown_and_confirmed_boxes_stay():
    scene = sc.Scene((a_camera((-50, 0, 50, 100, 150)),), (a_box(x=(10.0, 18.0)), sc.GroupAnnotation("g")))
    projected = project_cuboids(scene).annotations
    (projection,) = projected[0].projections
    assert projection.timestamps_ns.tolist() == [0, 50, 100]
    # fronts at 8, 12 and 16 m; 500 pixels of focal length
    np.testing.assert_allclose(projection.boxes[0], [337.5, 268.75, 125.0, 62.5], atol=1e-3)
    np.testing.assert_allclose(projection.boxes[:, 2], [1000 / 8, 1000 / 12, 1000 / 16], atol=1e-3)
    np.testing.assert_array_equal(projection.cuboids[:, 3], [10.0, 14.0, 18.0])
    assert projection.confirmed is None
    assert isinstance(projected[1], sc.GroupAnnotation)
    scene = sc.Scene((a_camera((0, 50, 100)),), (a_box(x=(-30.0, 30.0)),))
    (projection,) = project_cuboids(scene).annotations[0].projections
    assert np.isfinite(projection.boxes).all(axis=1).tolist() == [False, False, True]
    old, of_others = (sc.Projection(sensor_id, np.array([0]), np.ones((1, 4))) for sensor_id in ("camera", "other"))
    scene = sc.Scene((a_camera((0, 50)),), (a_box(x=(-9.0, -9.0), projections=(old, of_others)),))
    assert project_cuboids(scene).annotations[0].projections == (of_others,)
    old = sc.Projection("camera", np.array([0, 50]), np.full((2, 4), 7.0), confirmed=(True, False))
    scene = sc.Scene((a_camera((0, 50)),), (a_box(projections=(old,)),))
    (projection,) = project_cuboids(scene).annotations[0].projections
    assert (projection.confirmed, projection.boxes[0].tolist()) == ((True, False), [7.0] * 4)
    assert projection.boxes[1, 0] == pytest.approx(337.5)


def test_shares_become_attributes_at_images_that_show_it_and_times_in_sight_activations_a_frame_longer():
    older = sc.AttributePath("occlusion", (0.9,), np.array([0]), sensor_id="camera")
    boxes = (a_box(x=(-30.0, 30.0), attributes=(older,)), a_box("b", x=(20.0, 20.0)))
    first, second = project_cuboids(sc.Scene((a_camera((0, 100)),), boxes)).annotations
    found = [(a.name, a.sensor_id, a.values, a.timestamps_ns.tolist()) for a in first.attributes]
    assert found == [("truncation", "camera", (0.0,), [100]), ("occlusion", "camera", (1.0,), [100])]
    assert [a.values for a in second.attributes] == [(0.0, 0.0), (0.0, 0.0)]
    # what fills little of its box may hide nothing
    scene = sc.Scene((a_camera((0,)),), (a_box(x=(20.0, 20.0)), a_box("b", label="tree")))
    for see_through, share in (([], 1.0), (["tree"], 0.0)):
        projected = project_cuboids(scene, see_through=see_through).annotations[0]
        assert projected.attributes[1].values == (share,)
    # it comes out from behind the camera between the second and the third image, and ends after the fourth
    scene = sc.Scene((a_camera((0, 50, 100, 150, 200)),), (a_box(x=(-90.0, 90.0), timestamps=(0, 160)),))
    (activation,) = project_cuboids(scene, activations=True).annotations[0].activations
    assert (activation.timestamps_ns.tolist(), activation.durations_ns) == ([100], (100,))
    assert activation.cuboids[0, 3] == pytest.approx(-90.0 + 180.0 * 100 / 160)
    assert project_cuboids(scene).annotations[0].activations == ()
    times = np.array([0, 10, 20, 30, 40])
    made = activation_of("s", times, np.array([True, False, False, True, True]))
    assert (made.timestamps_ns.tolist(), made.durations_ns) == ([0, 30], (10, 20))
    assert activation_of("s", times, np.zeros(5, bool)) is None
    alone = activation_of("s", times[:1], np.array([True]))
    assert alone.durations_ns == (100_000_000,)


def instance_of(annotation):
    return int(annotation.id.rsplit("-", 1)[1])


def seen_at(annotation, camera_id, time_ns):
    """The box (x1, y1, x2, y2) and the hidden share of a cuboid in an image, or None."""
    for projection in annotation.projections:
        at = np.flatnonzero(projection.timestamps_ns == time_ns)
        if projection.sensor_id == camera_id and len(at) and np.isfinite(projection.boxes[at[0], 0]):
            x, y, width, height = projection.boxes[at[0]]
            (hidden,) = (a for a in annotation.attributes if (a.name, a.sensor_id) == ("occlusion", camera_id))
            share = hidden.values[int(np.searchsorted(hidden.timestamps_ns, time_ns))]
            return np.array([x, y, x + width, y + height]), share
    return None


def overlap(a, b):
    shared = np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0).prod()
    return shared / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - shared)


def test_whatever_an_image_shows_of_a_cuboid_lies_in_its_box_and_open_cars_fill_it():
    aside = Camera("fisheye", 640, 480, 250.0, 250.0, 319.5, 239.5, (0.03, -0.008, 0.002, -0.0004))
    cameras = (CameraSpec(), CameraSpec(aside, camera_mount(yaw_deg=60.0)))
    drive = simulate_street(3, frames=3, lidar=LidarSpec(beams=8, steps=90), cameras=cameras, traffic=TrafficSpec())
    projected = project_cuboids(drive.scene, see_through=("tree", "pole"))
    overlaps = []
    for camera, k in ((camera, k) for camera in drive.scene.cameras for k in range(3)):
        time_ns = camera.images.timestamps_ns[k]
        shown, hidden = drive.truth.instances(camera.id, k), drive.truth.occlusion(camera.id, k)
        shares = dict(zip(hidden.instances.tolist(), hidden.hidden, strict=True))
        for annotation in projected.annotations:
            rows, columns = np.nonzero(shown == instance_of(annotation))
            found = seen_at(annotation, camera.id, time_ns)
            if found is None or len(rows) == 0:
                assert len(rows) < 3, annotation.id  # smaller than `min_pixels`
                continue
            box, share = found
            pixels = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float)
            # centres of pixels; paths are straight between samples, which is some millimetres off
            assert ((pixels - box) * [1, 1, -1, -1] >= -1.0).all(), annotation.id
            if annotation.label == "car" and len(rows) >= 300 and shares[instance_of(annotation)] <= 0.01:
                overlaps.append(overlap(box, pixels))
                assert share < 0.5
    assert len(overlaps) >= 6
    assert np.mean(overlaps) > 0.9  # a car is rounder than its box
    assert min(overlaps) > 0.8


def shares_of(scene, name, time_ns):
    """The values of an attribute at a time, by instance."""
    paths = [(instance_of(each), path) for each in scene.annotations for path in each.attributes if path.name == name]
    at = ((instance, path, np.flatnonzero(path.timestamps_ns == time_ns)) for instance, path in paths)
    return {instance: path.values[int(rows[0])] for instance, path, rows in at if len(rows)}


def test_points_of_a_lidar_report_what_is_hidden_unless_they_are_early_or_nowhere():
    drive = simulate_street(3, frames=3, traffic=TrafficSpec())
    projected = project_cuboids(drive.scene, see_through=("tree", "pole"), lidar="lidar")
    thin, pairs = {instance_of(a) for a in drive.scene.annotations if a.label in ("tree", "pole")}, []
    for k, time_ns in enumerate(drive.scene.cameras[0].images.timestamps_ns):
        truth, found = drive.truth.occlusion("camera0", k), shares_of(projected, "occlusion_by_points", time_ns)
        for instance, hidden, alone in zip(truth.instances, truth.hidden, truth.alone_px, strict=True):
            if instance in found and alone >= 200 and instance not in thin:
                pairs.append((found[instance], hidden))
    assert len(pairs) > 30
    # lidar and camera stand apart, points are sparse, and things are rounder than their boxes
    assert np.abs(np.diff(pairs, axis=1)).mean() < 0.08
    assert np.corrcoef(np.transpose(pairs))[0, 1] > 0.95
    drive = simulate_street(3, frames=2, lidar=LidarSpec(beams=8, steps=90))
    (lidar,), others = drive.scene.lidars, [s for s in drive.scene.sensors if s.type != "lidar"]
    early = sc.LazyFrames.of(list(lidar.frames), (lidar.frames.timestamps_ns - 10**9).tolist())
    scene = replace(drive.scene, sensors=(*others, replace(lidar, frames=early)))
    reported = {path.name for a in project_cuboids(scene, lidar="lidar").annotations for path in a.attributes}
    assert reported == {"truncation", "occlusion"}
    lost = replace(scene, sensors=(*others, replace(lidar, poses=None)), trajectories={})
    with pytest.raises(OptionError, match="no lidar 'none'"):
        project_cuboids(scene, lidar="none")
    with pytest.raises(PoseError, match="lidar 'lidar'"):
        project_cuboids(lost, lidar="lidar")


def test_a_mounting_of_one_image_counts_and_cameras_and_images_that_are_nowhere_see_nothing_or_are_refused():
    lost = replace(a_camera((0,), camera_id="lost"), poses=None)
    scene = sc.Scene((a_camera((0,)), lost), (a_box(),))
    projected = project_cuboids(scene)
    assert [n.code for n in projected.warnings] == ["camera-unplaced"]
    assert len(projected.annotations[0].projections) == 1
    for sensors, options, error, message in (
        (scene.sensors, {"cameras": "lost"}, PoseError, "'lost'"),
        ((lost,), {}, PoseError, "'lost'"),
        (scene.sensors, {"cameras": "none"}, OptionError, "no camera 'none'"),
        ((), {}, OptionError, "has no camera that could see"),
    ):
        with pytest.raises(error, match=message):
            project_cuboids(replace(scene, sensors=sensors), **options)
    trajectory, reported = sc.Poses(np.array([0, 50]), np.zeros((2, 3)), np.repeat(LOOKS_ALONG_X, 2, axis=0)), []
    scene = sc.Scene((a_camera((0, 10**10), poses=trajectory),), (a_box(stationary=True),))
    projected = project_cuboids(scene, progress=lambda done, total: reported.append((done, total)))
    assert reported == [(1, 2), (2, 2)]
    assert [(n.code, n.count) for n in projected.warnings] == [("images-unplaced", 1)]
    (projection,) = projected.annotations[0].projections
    assert np.isfinite(projection.boxes[:, 0]).tolist() == [True, False]
    ego = sc.Poses(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[0.0, 0, 0, 1]]), static=True)
    ahead = RigidTransform.from_quaternion(np.zeros(3), LOOKS_ALONG_X[0])
    back = RigidTransform(np.diag([-1.0, -1.0, 1.0]) @ ahead.rotation, np.zeros(3))
    camera = replace(a_camera((0, 50), mounts=(None, back)), poses=None, mount=ahead)
    projected = project_cuboids(sc.Scene((camera,), (a_box(),)), trajectory=EgoMotion("still", ego))
    (projection,) = projected.annotations[0].projections
    assert np.isfinite(projection.boxes[:, 0]).tolist() == [True, False]


SPEED, ROTATION, ROLL_S = 15.0, np.radians(30.0), 0.04
MOUNT = camera_mount(position=(1.5, 0.3, 1.6), yaw_deg=20.0)
PINHOLE = Camera("pinhole", 1280, 720, 600.0, 600.0, 639.5, 359.5)
FISHEYE = Camera("fisheye", 1280, 960, 400.0, 400.0, 639.5, 479.5, (0.03, -0.008, 0.002, -0.0004))
SECOND = 1_000_000_000


def camera_at(seconds, speed=SPEED, rotation=ROTATION):
    """The camera on a vehicle that drives a circle: rotations and positions, in closed form."""
    rotated, radius = np.asarray(seconds) * rotation, speed / rotation
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
            [*self.size, *(self.first + self.velocity * t), 0.0, 0.0, np.degrees(self.yaw + self.yaw_rate * t)]
            for t in (-1.0, 1.0)
        ]
        return sc.CuboidAnnotation(self.name, sc.CuboidPath(np.array([-SECOND, SECOND]), np.array(values)))

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
    poses = sc.Poses(np.rint(seconds * SECOND).astype(np.int64), positions, rotations.as_quat())
    stated = {"shutterRollTimeSeconds": roll_s, "rollingShutterLeftToRight": over_columns}
    frames = sc.LazyFrames.of([sc.CameraImage(0, camera, lambda: None)], (0,))
    sensor = sc.CameraSensor("camera", camera, frames, poses=poses, extras={"calibration": stated})
    return sc.Scene((sensor,), tuple(box.cuboid() for box in boxes))


def seen_at_their_lines(camera, box, points_box, *, over_columns, trajectory):
    """Pixels (N, 2) of points of a box: the line of each is looked for by halves."""
    axis, size = (0, camera.width) if over_columns else (1, camera.height)
    low, high = np.full(len(points_box), -0.5), np.full(len(points_box), size - 0.5)
    for _ in range(40):
        line = 0.5 * (low + high)
        seconds = ((line + 0.5) / size - 0.5) * ROLL_S
        rotations, locations = trajectory(seconds)
        pixels = project_unbounded(camera, rotations.inv().apply(box.location(points_box, seconds) - locations))
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
    seen = seen_at_their_lines(camera, box, edge_points(box), over_columns=over_columns, trajectory=trajectory)
    expected = extent(seen)
    # Edges are followed within 0.1 px.
    np.testing.assert_allclose(projection.boxes[0], expected, atol=0.1)
    at_once = a_scene(camera, [box], roll_s=0.0, trajectory=trajectory)
    (projection,) = project_cuboids(at_once).annotations[0].projections
    moves = trajectory is camera_at or box is CAR
    assert (np.abs(projection.boxes[0] - expected).max() > 0.5) == moves


def test_what_hides_it_or_cuts_it_off_is_reported_at_the_time_of_each_line():
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
    # A box that leaves the image upward is whole to the lines that saw it before.
    rising = Moving("rising", (1.0, 1.0, 1.0), (12.0, 4.5, 8.0), velocity=(0.0, 0.0, 60.0), yaw=0.0)
    still = Moving("still", (4.5, 1.9, 1.6), (13.0, 6.0, 0.8))
    (rolled_rising, rolled), (rising_at_once, at_once) = (
        project_cuboids(a_scene(PINHOLE, [rising, still], roll_s=roll_s, trajectory=stationary)).annotations
        for roll_s in (ROLL_S, 0.0)
    )
    cut_off = [
        next(path for path in annotation.attributes if path.name == "truncation").values[0]
        for annotation in (rolled_rising, rising_at_once)
    ]
    assert cut_off[0] == 0.0
    assert cut_off[1] > 0.2
    np.testing.assert_array_equal(rolled.projections[0].boxes, at_once.projections[0].boxes)
    assert [path.values for path in rolled.attributes] == [path.values for path in at_once.attributes]


HERE = RigidTransform.identity()
WIDE_PINHOLE = Camera("pinhole", 800, 600, 500.0, 500.0, 399.5, 299.5)
BARREL = Camera("brown_conrady", 800, 600, 500.0, 500.0, 399.5, 299.5, (-0.3, 0.1, 0.001, -0.001, -0.01))
WIDE_FISHEYE = Camera("fisheye", 800, 600, 260.0, 260.0, 399.5, 299.5, (0.03, -0.008, 0.002, -0.0004))
CYLINDER = Camera("cylindrical", 800, 600, 220.0, 220.0, 399.5, 299.5)
CAMERA_MODELS = {"pinhole": WIDE_PINHOLE, "barrel": BARREL, "fisheye": WIDE_FISHEYE, "cylinder": CYLINDER}

AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]).T
"""Columns: forward, left and up of a box that looks away from the camera, in the camera's frame."""

ON_GRID = 0.03
"""Shares are reported by grids of 24 steps: what a border does in one row or column of cells; chance in the oracle."""


def some_boxes(centers, sizes, quaternions=None):
    count, rotations = len(centers), Rotation.from_matrix(AXES).as_quat() if quaternions is None else quaternions
    rows = np.array(centers, np.float64), np.array(sizes, np.float64), np.broadcast_to(rotations, (count, 4))
    return sc.Boxes(tuple(range(count)), (None,) * count, *rows[:2], rows[2].astype(np.float64))


def seen_box(camera, center, size, rotation=None, **options):
    quaternions = None if rotation is None else rotation.as_quat()
    return observe_cuboids(camera, HERE, some_boxes([center], [size], quaternions), **options)


def surface(size, count=120):
    """Points on all faces of a box in its own frame."""
    grid = np.stack(np.meshgrid(*(np.linspace(-0.5, 0.5, count),) * 2), -1).reshape(-1, 2)
    return np.concatenate([np.insert(grid, axis, side, axis=1) * size for axis in range(3) for side in (-0.5, 0.5)])


def opencv_pixels(camera_model, points):
    """Pixels of points ahead of the camera as OpenCV has them."""
    ahead, nowhere = points[points[:, 2] > 0.01][:, None], np.zeros(3)
    coefficients = np.array(camera_model.coefficients or (0.0,) * 4)
    project = cv2.fisheye.projectPoints if camera_model.model == "fisheye" else cv2.projectPoints
    return project(ahead, nowhere, nowhere, camera_model.matrix, coefficients)[0][:, 0]


def random_box(seed, ahead=1.0):
    generator = np.random.default_rng(seed)
    center = generator.uniform([-6, -2, ahead - 1], [6, 2, ahead + 14])
    return center, generator.uniform(0.3, 5.0, 3), Rotation.random(random_state=seed)


def holds_camera(center, size, rotation):
    away = np.abs(rotation.inv().apply(-center)) - size / 2
    return np.linalg.norm(np.maximum(away, 0.0)) < 0.1


def test_a_box_straight_ahead_is_where_its_front_is_and_only_the_part_in_the_image_bounds_it():
    # 2 m wide, 1 m high, front 8 m away: 500 / 8 pixels a metre around the image's middle (400, 300)
    for pose in (HERE, RigidTransform(AXES.T, np.array([1.0, 2.0, 3.0]))):
        rotation = Rotation.from_matrix(pose.rotation @ AXES).as_quat()
        box = some_boxes(pose.apply(np.array([[0.0, 0.0, 10.0]])), [[4.0, 2.0, 1.0]], rotation)
        seen = observe_cuboids(WIDE_PINHOLE, pose, box)
        np.testing.assert_allclose(seen.boxes_xyxy, [[337.5, 268.75, 462.5, 331.25]], atol=1e-9)
        assert (seen.truncations.tolist(), seen.occlusions.tolist()) == ([0.0], [0.0])
    # the left side of a wall 1 m to the right, from 20 m behind to 20 m ahead, 2 m high: its far end shows 25 pixels to
    # the right of the middle and 25 above it; at the border 1 m stands at 1.25 m
    seen = seen_box(WIDE_PINHOLE, [1.5, 0.0, 0.0], [40.0, 1.0, 2.0])
    np.testing.assert_allclose(seen.boxes_xyxy, [[425.0, 0.0, 800.0, 600.0]], atol=1e-6)
    assert seen.truncations[0] > 0.9
    # a diamond in the upper left corner, of half diagonal 2.83 m -> 141.4 px around (-50, 100): the right tip is in the
    # image, so are the crossings of its left border; the whole of it would reach further down and right
    rotated = Rotation.from_matrix(AXES) * Rotation.from_euler("x", 45, degrees=True)
    seen = seen_box(WIDE_PINHOLE, [-9.0, -4.0, 10.0], [0.001, 4.0, 4.0], rotated)
    np.testing.assert_allclose(seen.boxes_xyxy[0], [0.0, 100 - 91.4, 91.4, 100 + 91.4], atol=0.1)  # 1 mm of depth


@pytest.mark.parametrize("name", CAMERA_MODELS)
@pytest.mark.parametrize("part", range(4))
@pytest.mark.few(5)
def test_boxes_bound_all_points_of_their_surface_in_the_image_tightly(name, part):
    camera_model, compared = CAMERA_MODELS[name], 0
    for seed in range(part * 10, part * 10 + 10):
        center, size, rotation = random_box(seed, ahead=0.0)
        seen = seen_box(camera_model, center, size, rotation, min_pixels=0.0)
        if holds_camera(center, size, rotation):
            assert len(seen.rows) == 0
            continue
        pixels, visible = project(camera_model, rotation.apply(surface(size)) + center)
        pixels = pixels[visible] + 0.5
        if len(pixels) >= 100:
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            beyond = np.array([*(low - seen.boxes_xyxy[0, :2]), *(seen.boxes_xyxy[0, 2:] - high)])
            # curved edges between samples, after their bulge is taken from parabolas
            assert (beyond >= -0.02).all()
            # the oracle's points are that far apart, more near the camera
            assert (beyond <= 4.0 * (high - low).max() / 120 + 1.0).all()
            compared += 1
    assert compared >= 5


def test_boxes_within_the_image_are_those_of_opencv_bulges_of_bent_edges_too():
    for name in ["pinhole", "barrel", "fisheye"]:
        camera_model, compared = CAMERA_MODELS[name], 0
        for seed in range(30):
            center, size, rotation = random_box(seed, ahead=6.0)
            pixels = opencv_pixels(camera_model, rotation.apply(surface(size / 3, 61)) + center) + 0.5
            if (pixels >= 1).all() and (pixels <= [799, 599]).all():
                found, expected = seen_box(camera_model, center, size / 3, rotation).boxes_xyxy[0], extent(pixels - 0.5)
                # all edges are among OpenCV's points; a curved one may bulge by a part of the step between two of them
                np.testing.assert_allclose([*found[:2], *(found[2:] - found[:2])], expected, atol=0.02)
                compared += 1
        assert compared >= 8
    # a straight bar above the middle of a barrel camera model: its ends are bent down, so that its middle is highest
    seen = seen_box(BARREL, [0.0, -2.0, 5.0], [0.01, 6.0, 0.2])
    along = np.column_stack([np.linspace(-3, 3, 100_001), np.full(100_001, -2.1), np.full(100_001, 4.995)])
    heights = opencv_pixels(BARREL, along)[:, 1] + 0.5
    assert heights.min() < heights[[0, -1]].min() - 10
    np.testing.assert_allclose(seen.boxes_xyxy[0, 1], heights.min(), atol=1e-3)  # parabolas


@pytest.mark.parametrize("name", CAMERA_MODELS)
def test_the_share_outside_the_image_is_that_of_random_directions(name):
    camera_model, compared = CAMERA_MODELS[name], 0
    directions = np.random.default_rng(1).normal(size=(60_000, 3))
    _, inside = project(camera_model, directions)
    for seed in range(25):
        center, size, rotation = random_box(seed)
        seen = seen_box(camera_model, center, size, rotation)
        enter, leave = along_rays(directions, center, size, rotation)
        met = (enter <= leave) & (leave > 0)
        if len(seen.rows) and not holds_camera(center, size, rotation) and met.sum() > 1_000:
            assert seen.truncations[0] == pytest.approx((met & ~inside).sum() / met.sum(), abs=0.05)
            compared += 1
    assert compared >= 5


def along_rays(rays, center, size, rotation):
    """Where rays (N, 3) from the origin enter and leave a box."""
    directions, origin = rotation.inv().apply(rays), rotation.inv().apply(-center)
    with np.errstate(divide="ignore"):
        first, last = (-size / 2 - origin) / directions, (size / 2 - origin) / directions
    return np.minimum(first, last).max(axis=1), np.maximum(first, last).min(axis=1)


@pytest.mark.parametrize("name", ["pinhole", "fisheye"])
def test_hidden_shares_are_those_of_a_fine_image(name):
    camera_model, generator = CAMERA_MODELS[name], np.random.default_rng(5)
    centers = generator.uniform([-8, -1, 4], [8, 1, 25], (25, 3))
    sizes, rotations = generator.uniform(1, 4, (25, 3)), Rotation.random(25, random_state=2)
    seen = observe_cuboids(camera_model, HERE, some_boxes(centers, sizes, rotations.as_quat()))
    v, u = (grid.ravel() for grid in np.mgrid[0:600:2, 0:800:2])
    rays, depths = unproject(camera_model, np.column_stack([u, v])), []
    for box in zip(centers, sizes, rotations, strict=True):
        enter, leave = along_rays(rays, *box)
        depths.append(np.where((enter <= leave) & (enter > 0), enter, np.inf))
    nearest, compared = np.min(depths, axis=0), 0
    for row, occlusion in zip(seen.rows, seen.occlusions, strict=True):
        met = np.isfinite(depths[row])
        if met.sum() > 500:
            assert occlusion == pytest.approx((depths[row][met] > nearest[met]).mean(), abs=ON_GRID)
            compared += 1
    assert compared > 10


def test_boxes_that_cannot_be_seen_hide_nothing_small_ones_do_and_points_before_and_on_a_box_are_evidence():
    boxes = some_boxes([[0, 0, -10.0], [0, 0, 0.0], [0, 0, 20.0]], [[2.0, 2, 2], [5.0, 2, 2], [4.0, 2, 2]])
    seen = observe_cuboids(WIDE_PINHOLE, HERE, boxes)
    assert (seen.rows.tolist(), seen.occlusions.tolist()) == ([2], [0.0])
    plates = some_boxes([[0.0, 0.0, 10.0], [0.0, 0.0, 5.0]], [[0.01, 2.0, 2.0], [0.01, 0.02, 2.0]])
    seen = observe_cuboids(WIDE_PINHOLE, HERE, plates, min_pixels=4.0)
    assert (seen.rows.tolist(), seen.occlusions[0]) == ([0], pytest.approx(0.02, abs=ON_GRID))
    for center, size in [
        ((0, 0, 9), (1, 0, 1)),
        ((0, 0, 9), (1, -1, 1)),
        ((0, np.nan, 9), (1, 1, 1)),
        *(((0, 0, far), (1, 1, 1)) for far in (np.inf, -np.inf, 1e300)),
        *(((0, 0, 9), (1, 1, large)) for large in (np.inf, 1e300)),
    ]:
        boxes = some_boxes([center, (0, 0, 9)], [size, (1, 1, 1)])
        assert observe_cuboids(WIDE_PINHOLE, HERE, boxes).rows.tolist() == [1]
        assert len(observe_cuboids(WIDE_PINHOLE, HERE, some_boxes(np.zeros((0, 3)), np.zeros((0, 3)))).rows) == 0
    # 7.9 and 12.1 m are within 0.2 m of its faces at 8 and 12 m
    ahead = [5.0, 2.5, 7.9, 10.0, 12.1, 20.0, -5.0]
    points = np.array([*([0.0, 0.0, z] for z in ahead), [3.0, 0, 10]])
    nowhere = np.array([[np.nan, 0.0, 1.0], [0.0, 0.0, np.inf], [0.0, 0.0, 0.0]])
    for some, evidence in ((points, [2, 3]), (None, [0, 0]), (nowhere, [0, 0])):
        seen = seen_box(WIDE_PINHOLE, [0.0, 0.0, 10.0], [4.0, 2.0, 2.0], points_world=some)
        assert seen.evidences.tolist() == [evidence]
