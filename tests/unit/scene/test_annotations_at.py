"""Annotations at any time."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraSensor,
    Coordinates,
    CuboidAnnotation,
    CuboidPath,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointPath,
    PointsAnnotation,
    PointsFrame,
    Poses,
    Scene,
    ShapeAnnotation,
    ShapeType,
    Support,
    Track,
    TrackedObjects,
    Tracks,
    VertexPath,
)
from sceneloom.scene.annotations_at import (
    BoxTable,
    CuboidAngles,
    active_at,
    attribute_at,
    box_2d_at,
    cuboid_at,
    cuboid_poses,
    point_at,
    points_at,
    shape_at,
)
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street
from sceneloom.visualization.annotations import figures_in_world

READINGS = [("degrees", "xyz"), ("radians", "zyx"), ("degrees", "yxz")]

CLOSE = 1e-9
"""Of rotations: what two ways of computing the same sines and cosines may differ by."""


def a_cuboid(seed=0, *, count=6, unit="degrees", stationary=None):
    generator = np.random.default_rng(seed)
    values = generator.uniform(-3.0, 3.0, (count, 9))
    values[:, :3] = generator.uniform(0.5, 5.0, (count, 3))
    if unit == "degrees":
        values[:, 6:] = generator.uniform(-360.0, 360.0, (count, 3))
    timestamps = np.cumsum(generator.integers(1, 400_000_000, count)).astype(np.int64)
    return CuboidAnnotation("a", CuboidPath(timestamps, values), stationary=stationary)


def scipy_rotations(angles_rpy, unit, order):
    """scipy's upper case is the intrinsic order, which multiplies the matrices from the left to the right."""
    columns = ["xyz".index(axis) for axis in order]
    return Rotation.from_euler(order.upper(), angles_rpy[:, columns], degrees=unit == "degrees")


def times_of(cuboid, count=50):
    timestamps = cuboid.path.timestamps_ns
    return np.random.default_rng(9).integers(timestamps[0], timestamps[-1] + 1, count)


@pytest.mark.parametrize(("unit", "order"), READINGS)
def test_a_cuboid_rotates_as_scipys_slerp_does(unit, order):
    cuboid = a_cuboid(unit=unit)
    times, timestamps, values = times_of(cuboid), cuboid.path.timestamps_ns, cuboid.path.values
    expected = Slerp(timestamps.astype(float), scipy_rotations(values[:, 6:], unit, order))(times.astype(float))
    poses = cuboid_poses(cuboid, times, angles=CuboidAngles(unit, order))
    away = (expected.inv() * Rotation.from_quat(poses.quaternions_xyzw)).magnitude()
    assert away.max() < CLOSE
    rows, there = cuboid_at(cuboid, times, angles=CuboidAngles(unit, order))
    assert there.all()
    assert (expected.inv() * scipy_rotations(rows[:, 6:], unit, order)).magnitude().max() < CLOSE


def test_size_and_location_of_a_cuboid_go_straight_and_pass_through_the_very_numbers_of_its_path():
    cuboid = a_cuboid(1)
    times, timestamps, values = times_of(cuboid), cuboid.path.timestamps_ns, cuboid.path.values
    rows, _ = cuboid_at(cuboid, times)
    poses = cuboid_poses(cuboid, times)
    for column in range(6):
        straight = np.interp(times.astype(float), timestamps.astype(float), values[:, column])
        np.testing.assert_allclose(rows[:, column], straight, rtol=0, atol=CLOSE)
    np.testing.assert_array_equal(poses.sizes_lwh, rows[:, :3])
    np.testing.assert_array_equal(poses.centers_world, rows[:, 3:6])
    rows, there = cuboid_at(cuboid, timestamps)
    assert there.all()
    np.testing.assert_array_equal(rows, values)


@pytest.mark.parametrize(
    ("yaws", "expected"),
    [
        ((270.0, 280.0), [270.0, 275.0, 277.5]),  # three quarters do not come back as minus one quarter
        ((170.0, -170.0), [170.0, 180.0, 185.0]),  # the shorter arc over the end of the circle
    ],
)
def test_a_cuboid_rotates_evenly_in_the_numbers_of_its_path(yaws, expected):
    values = np.array([[4, 2, 1, 0, 0, 0, 0, 0, yaw] for yaw in yaws])
    rows, _ = cuboid_at(CuboidAnnotation("a", CuboidPath(np.array([0, 100]), values)), [0, 50, 75])
    np.testing.assert_allclose(rows[:, 8], expected, atol=CLOSE)


def test_a_cuboid_is_there_from_its_first_timestamp_to_its_last_and_a_stationary_one_always():
    cuboid, still = a_cuboid(3), a_cuboid(3, stationary=True)
    first, last = cuboid.path.timestamps_ns[[0, -1]]
    rows, there = cuboid_at(cuboid, [first - 1, first, last, last + 1])
    assert there.tolist() == [False, True, True, False]
    assert np.isnan(rows[[0, 3]]).all()
    assert np.isnan(cuboid_poses(cuboid, [first - 1]).quaternions_xyzw).all()
    rows, there = cuboid_at(still, [-(10**18), 10**18])
    assert there.all()
    np.testing.assert_array_equal(rows, cuboid.path.values[[0, -1]])
    nowhere = CuboidAnnotation("a", CuboidPath(np.zeros(0, np.int64), np.zeros((0, 9))), stationary=True)
    assert np.isnan(cuboid_at(nowhere, [0, 1])[0]).all()
    assert not cuboid_poses(nowhere, [0]).there.any()


@pytest.mark.parametrize(("unit", "order"), READINGS)
def test_the_boxes_of_a_moment_are_those_of_each_cuboid(unit, order):
    cuboids = [a_cuboid(seed, count=3 + seed % 4, unit=unit, stationary=seed % 5 == 0) for seed in range(20)]
    named = tuple(CuboidAnnotation(k, cuboid.path, stationary=cuboid.stationary) for k, cuboid in enumerate(cuboids))
    scene = Scene((), named, metadata={"sceneloom": {"euler_unit": unit, "euler_order": order}})
    time_ns = 450_000_000
    rows, boxes = BoxTable(scene).find(time_ns)
    each = [cuboid_poses(cuboid, [time_ns], angles=CuboidAngles(unit, order)) for cuboid in named]
    assert rows.tolist() == [k for k, poses in enumerate(each) if poses.there[0]]
    assert list(boxes.ids) == rows.tolist()
    np.testing.assert_allclose(boxes.centers_world, [each[k].centers_world[0] for k in rows], atol=1e-12)
    np.testing.assert_allclose(boxes.quaternions_xyzw, [each[k].quaternions_xyzw[0] for k in rows], atol=1e-12)


def test_a_box_in_images_goes_straight_and_ends():
    path = BoxPath(np.array([10, 20]), np.array([[0.0, 0.0, 10.0, 4.0], [10.0, 20.0, 30.0, 8.0]]))
    rows, there = box_2d_at(Box2DAnnotation("a", "camera", path), [10, 15, 20, 21])
    assert there.tolist() == [True, True, True, False]
    np.testing.assert_array_equal(rows[:3], [[0, 0, 10, 4], [5, 10, 20, 6], [10, 20, 30, 8]])
    assert np.isnan(rows[3]).all()


def test_points_with_names_go_straight_each_on_its_own_way():
    left = PointPath(np.array([0, 10]), np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]))
    right = PointPath(np.array([5, 10]), np.array([[1.0, 1.0, 1.0], [1.0, 3.0, 1.0]]))
    found = points_at(PointsAnnotation("a", (left, right)), [2, 6])
    np.testing.assert_array_equal(found[0][0], [[2, 0, 0], [6, 0, 0]])
    assert np.isnan(found[1][0][0]).all()
    np.testing.assert_allclose(found[1][0][1], [1.0, 1.4, 1.0])
    held, there = point_at(right, [0, 99], stationary=True)
    assert there.all()
    np.testing.assert_array_equal(held, right.values)


def test_vertices_go_straight_only_where_there_are_as_many_before_and_after():
    three, four = np.zeros((3, 2)), np.ones((4, 2))
    path = VertexPath(np.array([0, 10, 20]), (three, three + 10.0, four))
    line = ShapeAnnotation("a", ShapeType.POLYLINE_2D, path, sensor_id="camera")
    before, between, held, last, after = shape_at(line, [-1, 5, 15, 20, 21])
    assert before is None
    assert after is None
    np.testing.assert_array_equal(between, three + 5.0)
    np.testing.assert_array_equal(held, three + 10.0)
    np.testing.assert_array_equal(last, four)


RED = ("red",)


@pytest.mark.parametrize(
    ("attribute", "times", "expected"),
    [
        (
            AttributePath("colour", ("red", ("green", "blue"), 7), np.array([10, 20, 30])),
            [9, 10, 19, 20, 99],
            [None, "red", "red", ("green", "blue"), 7],
        ),
        (AttributePath("colour", RED, np.array([10]), static=True), [0], ["red"]),
        (AttributePath("colour", RED), [0, 5], ["red", "red"]),
        (AttributePath("colour", ()), [0], [None]),
        # a timestamp without a value says nothing
        (AttributePath("colour", RED, np.array([10, 20])), [10, 19, 20, 30], ["red", "red", None, None]),
    ],
)
def test_an_attribute_holds_until_the_next_and_a_static_one_at_all_times(attribute, times, expected):
    assert attribute_at(attribute, times) == expected


MS = 1_000_000
SPEED = 5.0
"""Of the cuboid along x [m/s]: at 10 m at time 0."""
OWN = np.array([4.0, 2.0, 2.0, 10.0, 3.0, 1.0, 0.0, 0.0, 90.0])
"""What lidar `near` computed at 200 ms: 3 m beside the path, longer, rotated by 90 degrees."""


def row(time_ms: float) -> np.ndarray:
    return np.array([3.0, 2.0, 1.5, 10.0 + SPEED * time_ms / 1e3, 0.0, 1.0, 0.0, 0.0, 0.0])


def cuboid(*activations: Activation, **changed: Any) -> CuboidAnnotation:
    times = np.array([0, 1000])
    path = CuboidPath(times * MS, np.stack([row(t) for t in times]))
    return CuboidAnnotation("box", path, label="car", activations=activations, **changed)


def activation(sensor: str, *spans_ms: tuple[int, int], cuboids: Any = None) -> Activation:
    starts = np.array([start for start, _ in spans_ms], np.int64) * MS
    own = None if cuboids is None else np.array(cuboids, np.float64)
    return Activation(sensor, starts, tuple((stop - start) * MS for start, stop in spans_ms), own)


SEEN = cuboid(activation("front", (300, 600)), activation("near", (200, 500), cuboids=[OWN]))


def test_an_activation_lasts_from_its_timestamp_until_its_end_which_no_longer_counts() -> None:
    times = np.array([299, 300, 599, 600]) * MS
    assert active_at(SEEN, "front", times).tolist() == [False, True, True, False]
    assert cuboid_poses(SEEN, times, sensor_id="front").there.tolist() == [False, True, True, False]
    assert active_at(SEEN, "rear", times).all(), "nothing is stated for it"
    assert cuboid_poses(SEEN, times).there.all(), "the object itself is there all the time"
    moment = cuboid(activation("front", (300, 300)))
    assert active_at(moment, "front", [300 * MS - 1, 300 * MS, 300 * MS + 1]).tolist() == [False, True, False]
    static = cuboid(Activation("front", np.array([300 * MS])))
    assert active_at(static, "front", times).tolist() == [False, True, True, True]
    never = cuboid(Activation("front", np.zeros(0, np.int64)))
    assert not active_at(never, "front", times).any()


def test_a_frame_sees_what_is_active_at_any_time_of_it() -> None:
    begun = np.array([150, 250, 550, 600, 650]) * MS
    found = active_at(SEEN, "front", begun + 100 * MS, since_ns=begun)
    assert found.tolist() == [False, True, True, False, False]


def test_an_own_cuboid_holds_at_its_timestamp_and_moves_on_as_the_path_does() -> None:
    rows, there = cuboid_at(SEEN, [100 * MS, 200 * MS, 400 * MS], sensor_id="near")
    assert there.tolist() == [False, True, True]
    np.testing.assert_array_equal(rows[1], OWN)
    expected = OWN + np.array([0, 0, 0, SPEED * 0.2, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(rows[2], expected, atol=1e-12)
    assert np.isnan(rows[0]).all()
    beside, _ = cuboid_at(SEEN, [400 * MS], sensor_id="rear")
    np.testing.assert_allclose(beside[0], row(400), atol=1e-12)


def test_an_own_cuboid_that_is_null_leaves_the_path_and_one_beyond_the_path_stays() -> None:
    null = cuboid(activation("near", (200, 500), cuboids=[np.full(9, np.nan)]))
    np.testing.assert_allclose(cuboid_at(null, [300 * MS], sensor_id="near")[0][0], row(300), atol=1e-12)
    late = cuboid(activation("near", (2000, 2500), cuboids=[OWN]))
    rows, there = cuboid_at(late, [300 * MS, 2200 * MS], sensor_id="near")
    assert there.tolist() == [False, True]
    np.testing.assert_allclose(rows[1], OWN, atol=1e-12)


SIGHT = Camera("pinhole", 200, 100, 100.0, 100.0, 99.5, 49.5)


def still_scene(*annotations: CuboidAnnotation) -> Scene:
    """Two lidars in the world with a point in the path's box and one in the own cuboid's, and a camera, at rest."""
    times = np.arange(0, 1000, 100) * MS

    def lidar(name: str) -> LidarSensor:
        frames = []
        for t in times.tolist():
            drift = SPEED * (t / 1e9 - 0.2)
            points = np.array([row(t / MS)[3:6], OWN[3:6] + np.array([drift, 1.5, 0.0])], np.float32)
            frames.append(LidarFrame(t, LidarPoints(points)))
        return LidarSensor(name, LazyFrames.of(frames, times), poses=Poses.identity(), points_frame=PointsFrame.WORLD)

    optical = RigidTransform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    poses = Poses(np.zeros(1, np.int64), optical.translation[None], optical.quaternion_xyzw[None], static=True)
    drive = simulate_street(0, frames=10, lidar=LidarSpec(beams=2, steps=8), cameras=(CameraSpec(SIGHT),)).scene
    images = [replace(drive.cameras[0].images[k], timestamp_ns=int(t)) for k, t in enumerate(times)]
    camera = CameraSensor("front", SIGHT, LazyFrames.of(images, times), poses=poses, coordinates=Coordinates.WORLD)
    return Scene((lidar("near"), lidar("other"), camera), annotations)


def test_points_are_counted_while_a_cuboid_is_active_for_their_lidar_and_in_its_own_cuboid() -> None:
    counts = sceneloom.count_points(still_scene(SEEN))
    near, other = counts.lidars
    # the point at +1.5 m beside the own centre is inside, since that is rotated by 90 degrees and 4 m long
    assert near.there[:, 0].tolist() == [False, False, True, True, True, *[False] * 5]
    assert near.counts[:, 0].tolist() == [0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    assert other.there[:, 0].all()
    assert other.counts[:, 0].tolist() == [1] * 10
    anew = sceneloom.count_points(still_scene(SEEN), activations=False).lidars[0]
    assert anew.there[:, 0].all()


def test_samples_have_the_boxes_of_their_sensors() -> None:
    samples = still_scene(SEEN).samples(reference="near", cameras="front", lidars=["near", "other"])
    assert [len(sample.boxes) for sample in samples] == [0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(samples[4].boxes.centers_world[0], [11.0, 3.0, 1.0])
    np.testing.assert_allclose(samples[4].boxes.yaws_world, np.pi / 2)
    assert [len(sample.boxes_for("front")) for sample in samples] == [0, 0, 0, 1, 1, 1, 0, 0, 0, 0]
    assert all(len(sample.boxes_for("other")) == 1 for sample in samples)
    np.testing.assert_allclose(samples[4].boxes_for("other").centers_world[0], row(400)[3:6])
    with pytest.raises(OptionError, match="no frame in this sample"):
        samples[0].boxes_for("rear")


def test_cameras_see_what_is_active_for_them_unless_activations_are_found_anew() -> None:
    own = cuboid(activation("front", (300, 600), cuboids=[OWN]))
    (seen,) = sceneloom.project_cuboids(still_scene(own)).annotations
    (projection,) = seen.projections
    shown = projection.timestamps_ns[np.isfinite(projection.boxes[:, 0])]
    assert (shown // MS).tolist() == [300, 400, 500]
    np.testing.assert_array_equal(projection.cuboids[projection.timestamps_ns == 300 * MS][0], OWN)
    (anew,) = sceneloom.project_cuboids(still_scene(own), activations=True).annotations
    assert np.isfinite(anew.projections[0].boxes[:, 0]).sum() == 10
    assert (anew.activations[0].timestamps_ns // MS).tolist() == [0]


def test_plots_and_tables_show_what_is_active_for_the_sensor() -> None:
    scene = still_scene(SEEN)
    for sensor, shown in (("front", [0, 1, 1, 0]), (None, [1, 1, 1, 1])):
        drawn = [len(list(figures_in_world(scene, t * MS, sensor_id=sensor))) for t in (200, 300, 500, 600)]
        assert drawn == shown
    table = BoxTable(scene)
    rows, boxes = table.find(800 * MS)
    assert rows.tolist() == [0]
    np.testing.assert_allclose(boxes.centers_world[0], row(800)[3:6])
    assert table.find(800 * MS, sensor_id="near")[0].tolist() == []
    assert len(table.at(800 * MS, sensor_id="front", window_ns=(550 * MS, 800 * MS))) == 1


def boxes_written(scene: Scene, box: CuboidAnnotation, path: Path, to: str) -> tuple[int, Any]:
    """How many boxes come back from a format, and what it could not carry."""
    losses = sceneloom.write(replace(scene, annotations=(box,)), path, format=to)
    with sceneloom.open(path) as found:
        boxes = [a for a in found.annotations if isinstance(a, CuboidAnnotation)]
        return sum(len(a.path.timestamps_ns) for a in boxes), losses


@pytest.mark.parametrize(
    ("to", "sensor", "least", "frames"),
    [("nuscenes", "lidar", 1, 0), ("kitti-tracking", "camera0", 5, 2), ("kitti-raw", "lidar", 5, 2)],
)
def test_exports_write_boxes_while_they_are_active_and_list_what_they_cannot_carry(
    to: str, sensor: str, least: int, frames: int, tmp_path: Path
) -> None:
    scene = simulate_street(1, frames=5, lidar=LidarSpec(beams=8, steps=90), cameras=(CameraSpec(SIGHT),)).scene
    ego = next(iter(scene.trajectories.values()))
    timestamps = (scene.lidars[0].frames if sensor == "lidar" else scene.cameras[0].images).timestamps_ns
    world_from_ego = RigidTransform.from_quaternion(ego.positions[40], ego.quaternions_xyzw[40])
    values = [3.0, 2.0, 2.0, *world_from_ego.apply(np.array([15.0, 0.0, 1.0])), 0.0, 0.0, 0.0]
    whole = CuboidAnnotation("box", CuboidPath(np.array([0, 10**10]), np.tile(values, (2, 1))), label="car")
    assert boxes_written(scene, whole, tmp_path / "all", to)[0] >= least
    part = Activation(sensor, timestamps[1:2], (int(timestamps[3] - timestamps[1]),))
    count, losses = boxes_written(scene, replace(whole, activations=(part,)), tmp_path / "some", to)
    assert count == frames
    assert any(loss.field.endswith("cuboid.activations") for loss in losses)


@pytest.mark.parametrize("to", ["kitti-object", "kitti-tracking", "kitti-raw"])
def test_labels_of_sweeps_hold_what_is_active_at_any_time_of_them(to: str, tmp_path: Path) -> None:
    scene = simulate_street(1, frames=4, lidar=LidarSpec(beams=8, steps=90), cameras=()).scene
    timestamps = scene.lidars[0].frames.timestamps_ns
    path = CuboidPath(np.array([0, 10**10]), np.tile([3.0, 2.0, 2.0, 15.0, 0.0, 1.0, 0.0, 0.0, 0.0], (2, 1)))
    early = Activation("lidar", timestamps[1:2], (10 * MS,))
    box = CuboidAnnotation("box", path, label="car", activations=(early,))
    assert boxes_written(scene, box, tmp_path / "out", to)[0] == 1


def columns(count, **others):
    return {
        **{name: np.zeros((count, 3)) for name in ("centers", "velocities")},
        **{name: np.zeros(count) for name in ("yaws", "yaw_rates")},
        "sizes_lwh": np.ones((count, 3)),
        "covariances": np.tile(np.eye(10), (count, 1, 1)),
        "scores": np.ones(count),
        "supports": np.full(count, Support.SWEEP, np.uint8),
        **others,
    }


def track(number, times, **others):
    return Track(number, "car", np.array(times, np.int64), **columns(len(times), **others))


def test_a_track_cannot_be_written_to():
    corners = np.ones((2, 4))
    found = track(3, [0, 10], corners_xyxy={"left": corners})
    for array in (found.centers, found.supports, found.timestamps_ns, found.corners_xyxy["left"]):
        assert not array.flags.writeable
    assert corners.flags.writeable


@pytest.mark.parametrize(
    ("times", "wrong", "named"),
    [
        ([10, 10], {}, "do not rise"),
        ([10, 0], {}, "do not rise"),
        ([0, 10], {"yaws": np.zeros(3)}, "yaws"),
        ([0, 10], {"corners_xyxy": {"left": np.zeros((2, 3))}}, "corners_xyxy"),
    ],
)
def test_times_that_do_not_rise_and_columns_of_another_length_are_refused(times, wrong, named):
    with pytest.raises(ArrayError, match=named):
        track(3, times, **wrong)


def test_objects_at_one_time_need_a_class_each_and_tracks_are_a_sequence():
    with pytest.raises(ArrayError, match="labels"):
        TrackedObjects(0, np.arange(2), ("car",), **columns(2))
    tracks = Tracks((track(1, [0]), track(4, [0, 5])))
    assert [(one.id, len(one)) for one in tracks] == [(1, 1), (4, 2)]
