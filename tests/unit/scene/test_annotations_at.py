"""Annotations at any time."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import annotations_at as at
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street
from sceneloom.visualization.annotations import figures_in_world

READINGS = [("degrees", "xyz"), ("radians", "zyx"), ("degrees", "yxz")]
CLOSE = 1e-9  # rotations: what two ways of computing the same sines and cosines may differ by


def a_cuboid(seed=0, *, count=6, unit="degrees", stationary=None):
    generator = np.random.default_rng(seed)
    values = generator.uniform(-3.0, 3.0, (count, 9))
    values[:, :3] = generator.uniform(0.5, 5.0, (count, 3))
    if unit == "degrees":
        values[:, 6:] = generator.uniform(-360.0, 360.0, (count, 3))
    timestamps = np.cumsum(generator.integers(1, 400_000_000, count)).astype(np.int64)
    return sc.CuboidAnnotation("a", sc.CuboidPath(timestamps, values), stationary=stationary)


def scipy_rotations(angles_rpy, unit, order):
    """scipy's upper case is the intrinsic order, which multiplies the matrices from the left to the right."""
    columns = ["xyz".index(axis) for axis in order]
    return Rotation.from_euler(order.upper(), angles_rpy[:, columns], degrees=unit == "degrees")


@pytest.mark.parametrize(("unit", "order"), READINGS)
def test_cuboids_rotate_as_scipys_slerp_does_and_go_straight_through_the_very_numbers_of_their_paths(unit, order):
    cuboid, angles = a_cuboid(unit=unit), at.CuboidAngles(unit, order)
    timestamps, values = cuboid.path.timestamps_ns, cuboid.path.values
    times = np.random.default_rng(9).integers(timestamps[0], timestamps[-1] + 1, 50)
    expected = Slerp(timestamps.astype(float), scipy_rotations(values[:, 6:], unit, order))(times.astype(float))
    poses, (rows, there) = at.cuboid_poses(cuboid, times, angles=angles), at.cuboid_at(cuboid, times, angles=angles)
    for found in (Rotation.from_quat(poses.quaternions_xyzw), scipy_rotations(rows[:, 6:], unit, order)):
        assert (expected.inv() * found).magnitude().max() < CLOSE
    assert there.all()
    straight = [np.interp(times.astype(float), timestamps.astype(float), values[:, column]) for column in range(6)]
    np.testing.assert_allclose(rows[:, :6].T, straight, rtol=0, atol=CLOSE)
    np.testing.assert_array_equal(np.hstack([poses.sizes_lwh, poses.centers_world]), rows[:, :6])
    rows, there = at.cuboid_at(cuboid, timestamps, angles=angles)
    assert there.all()
    np.testing.assert_array_equal(rows, values)
    # the boxes of a moment are those of each cuboid
    cuboids = [a_cuboid(seed, count=3 + seed % 4, unit=unit, stationary=seed % 5 == 0) for seed in range(20)]
    named = tuple(sc.CuboidAnnotation(k, cuboid.path, stationary=cuboid.stationary) for k, cuboid in enumerate(cuboids))
    scene = sc.Scene((), named, metadata={"sceneloom": {"euler_unit": unit, "euler_order": order}})
    time_ns = 450_000_000
    rows, boxes = at.BoxTable(scene).find(time_ns)
    each = [at.cuboid_poses(cuboid, [time_ns], angles=at.CuboidAngles(unit, order)) for cuboid in named]
    assert rows.tolist() == [k for k, poses in enumerate(each) if poses.there[0]]
    assert list(boxes.ids) == rows.tolist()
    np.testing.assert_allclose(boxes.centers_world, [each[k].centers_world[0] for k in rows], atol=1e-12)
    np.testing.assert_allclose(boxes.quaternions_xyzw, [each[k].quaternions_xyzw[0] for k in rows], atol=1e-12)


def test_a_cuboid_rotates_evenly_in_the_numbers_of_its_path_from_its_first_timestamp_to_its_last():
    for yaws, expected in [
        ((270.0, 280.0), [270.0, 275.0, 277.5]),  # three quarters do not come back as minus one quarter
        ((170.0, -170.0), [170.0, 180.0, 185.0]),  # the shorter arc over the end of the circle
    ]:
        values = np.array([[4, 2, 1, 0, 0, 0, 0, 0, yaw] for yaw in yaws])
        rows, _ = at.cuboid_at(sc.CuboidAnnotation("a", sc.CuboidPath(np.array([0, 100]), values)), [0, 50, 75])
        np.testing.assert_allclose(rows[:, 8], expected, atol=CLOSE)
    cuboid, still = a_cuboid(3), a_cuboid(3, stationary=True)
    first, last = cuboid.path.timestamps_ns[[0, -1]]
    rows, there = at.cuboid_at(cuboid, [first - 1, first, last, last + 1])
    assert there.tolist() == [False, True, True, False]
    assert np.isnan(rows[[0, 3]]).all()
    assert np.isnan(at.cuboid_poses(cuboid, [first - 1]).quaternions_xyzw).all()
    rows, there = at.cuboid_at(still, [-(10**18), 10**18])
    assert there.all()
    np.testing.assert_array_equal(rows, cuboid.path.values[[0, -1]])
    nowhere = sc.CuboidAnnotation("a", sc.CuboidPath(np.zeros(0, np.int64), np.zeros((0, 9))), stationary=True)
    assert np.isnan(at.cuboid_at(nowhere, [0, 1])[0]).all()
    assert not at.cuboid_poses(nowhere, [0]).there.any()


def test_boxes_in_images_named_points_and_vertices_go_straight_and_end():
    path = sc.BoxPath(np.array([10, 20]), np.array([[0.0, 0.0, 10.0, 4.0], [10.0, 20.0, 30.0, 8.0]]))
    rows, there = at.box_2d_at(sc.Box2DAnnotation("a", "camera", path), [10, 15, 20, 21])
    assert there.tolist() == [True, True, True, False]
    np.testing.assert_array_equal(rows, [[0, 0, 10, 4], [5, 10, 20, 6], [10, 20, 30, 8], [np.nan] * 4])
    # each point on its own way
    left = sc.PointPath(np.array([0, 10]), np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]))
    right = sc.PointPath(np.array([5, 10]), np.array([[1.0, 1.0, 1.0], [1.0, 3.0, 1.0]]))
    lefts, rights = at.points_at(sc.PointsAnnotation("a", (left, right)), [2, 6])
    np.testing.assert_array_equal(lefts[0], [[2, 0, 0], [6, 0, 0]])
    np.testing.assert_allclose(rights[0], [[np.nan] * 3, [1.0, 1.4, 1.0]])
    held, there = at.point_at(right, [0, 99], stationary=True)
    assert there.all()
    np.testing.assert_array_equal(held, right.values)
    # vertices only where there are as many before and after
    three, four = np.zeros((3, 2)), np.ones((4, 2))
    path = sc.VertexPath(np.array([0, 10, 20]), (three, three + 10.0, four))
    line = sc.ShapeAnnotation("a", sc.ShapeType.POLYLINE_2D, path, sensor_id="camera")
    before, *found, after = at.shape_at(line, [-1, 5, 15, 20, 21])
    assert before is after is None
    for vertices, expected in zip(found, (three + 5.0, three + 10.0, four), strict=True):
        np.testing.assert_array_equal(vertices, expected)


RED = ("red",)


@pytest.mark.parametrize(
    ("attribute", "times", "expected"),
    [
        (
            sc.AttributePath("colour", ("red", ("green", "blue"), 7), np.array([10, 20, 30])),
            [9, 10, 19, 20, 99],
            [None, "red", "red", ("green", "blue"), 7],
        ),
        (sc.AttributePath("colour", RED, np.array([10]), static=True), [0], ["red"]),
        (sc.AttributePath("colour", RED), [0, 5], ["red", "red"]),
        (sc.AttributePath("colour", ()), [0], [None]),
        # a timestamp without a value says nothing
        (sc.AttributePath("colour", RED, np.array([10, 20])), [10, 19, 20, 30], ["red", "red", None, None]),
    ],
)
def test_an_attribute_holds_until_the_next_and_a_static_one_at_all_times(attribute, times, expected):
    assert at.attribute_at(attribute, times) == expected


MS = 1_000_000
SPEED = 5.0  # of the cuboid along x [m/s]: at 10 m at time 0
OWN = np.array([4.0, 2.0, 2.0, 10.0, 3.0, 1.0, 0.0, 0.0, 90.0])
"""What lidar `near` computed at 200 ms: 3 m beside the path, longer, rotated by 90 degrees."""


def row(time_ms: float) -> np.ndarray:
    return np.array([3.0, 2.0, 1.5, 10.0 + SPEED * time_ms / 1e3, 0.0, 1.0, 0.0, 0.0, 0.0])


def cuboid(*activations: sc.Activation, **changed: Any) -> sc.CuboidAnnotation:
    times = np.array([0, 1000])
    path = sc.CuboidPath(times * MS, np.stack([row(t) for t in times]))
    return sc.CuboidAnnotation("box", path, label="car", activations=activations, **changed)


def activation(sensor: str, *spans_ms: tuple[int, int], cuboids: Any = None) -> sc.Activation:
    starts = np.array([start for start, _ in spans_ms], np.int64) * MS
    own = None if cuboids is None else np.array(cuboids, np.float64)
    return sc.Activation(sensor, starts, tuple((stop - start) * MS for start, stop in spans_ms), own)


SEEN = cuboid(activation("front", (300, 600)), activation("near", (200, 500), cuboids=[OWN]))


def test_an_activation_lasts_from_its_timestamp_until_its_end_which_no_longer_counts() -> None:
    times = np.array([299, 300, 599, 600]) * MS
    assert at.active_at(SEEN, "front", times).tolist() == [False, True, True, False]
    assert at.cuboid_poses(SEEN, times, sensor_id="front").there.tolist() == [False, True, True, False]
    assert at.active_at(SEEN, "rear", times).all(), "nothing is stated for it"
    assert at.cuboid_poses(SEEN, times).there.all(), "the object itself is there all the time"
    moment = cuboid(activation("front", (300, 300)))
    assert at.active_at(moment, "front", [300 * MS - 1, 300 * MS, 300 * MS + 1]).tolist() == [False, True, False]
    static, never = (cuboid(sc.Activation("front", np.array(starts, np.int64))) for starts in ([300 * MS], []))
    assert at.active_at(static, "front", times).tolist() == [False, True, True, True]
    assert not at.active_at(never, "front", times).any()
    # a frame sees what is active at any time of it
    begun = np.array([150, 250, 550, 600, 650]) * MS
    found = at.active_at(SEEN, "front", begun + 100 * MS, since_ns=begun)
    assert found.tolist() == [False, True, True, False, False]


def test_an_own_cuboid_holds_at_its_timestamp_and_moves_on_as_the_path_does() -> None:
    def rows_of(box: sc.CuboidAnnotation, *times_ms: int, sensor: str = "near") -> np.ndarray:
        rows, there = at.cuboid_at(box, np.array(times_ms) * MS, sensor_id=sensor)
        np.testing.assert_array_equal(there, np.isfinite(rows[:, 0]))
        return rows

    rows = rows_of(SEEN, 100, 200, 400)
    np.testing.assert_array_equal(rows[:2], [np.full(9, np.nan), OWN])
    np.testing.assert_allclose(rows[2], OWN + np.array([0, 0, 0, SPEED * 0.2, 0, 0, 0, 0, 0]), atol=1e-12)
    np.testing.assert_allclose(rows_of(SEEN, 400, sensor="rear")[0], row(400), atol=1e-12)
    # one that is null leaves the path, and one beyond the path stays
    null = cuboid(activation("near", (200, 500), cuboids=[np.full(9, np.nan)]))
    np.testing.assert_allclose(rows_of(null, 300)[0], row(300), atol=1e-12)
    late = cuboid(activation("near", (2000, 2500), cuboids=[OWN]))
    np.testing.assert_allclose(rows_of(late, 300, 2200), [np.full(9, np.nan), OWN], atol=1e-12)


SIGHT = Camera("pinhole", 200, 100, 100.0, 100.0, 99.5, 49.5)


def still_scene(*annotations: sc.CuboidAnnotation) -> sc.Scene:
    """Two lidars in the world with a point in the path's box and one in the own cuboid's, and a camera, at rest."""
    times = np.arange(0, 1000, 100) * MS

    def lidar(name: str) -> sc.LidarSensor:
        frames = []
        for t in times.tolist():
            drift = SPEED * (t / 1e9 - 0.2)
            points = np.array([row(t / MS)[3:6], OWN[3:6] + np.array([drift, 1.5, 0.0])], np.float32)
            frames.append(sc.LidarFrame(t, sc.LidarPoints(points)))
        world = {"poses": sc.Poses.identity(), "points_frame": sc.PointsFrame.WORLD}
        return sc.LidarSensor(name, sc.LazyFrames.of(frames, times), **world)

    optical = RigidTransform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    poses = sc.Poses(np.zeros(1, np.int64), optical.translation[None], optical.quaternion_xyzw[None], static=True)
    drive = simulate_street(0, frames=10, lidar=LidarSpec(beams=2, steps=8), cameras=(CameraSpec(SIGHT),)).scene
    images = [replace(drive.cameras[0].images[k], timestamp_ns=int(t)) for k, t in enumerate(times)]
    camera = sc.CameraSensor(
        "front", SIGHT, sc.LazyFrames.of(images, times), poses=poses, coordinates=sc.Coordinates.WORLD
    )
    return sc.Scene((lidar("near"), lidar("other"), camera), annotations)


def test_what_is_active_for_a_sensor_is_counted_sampled_seen_plotted_and_listed() -> None:
    counts = sceneloom.count_points(still_scene(SEEN))
    near, other = counts.lidars
    # the point at +1.5 m beside the own centre is inside, since that is rotated by 90 degrees and 4 m long
    assert near.there[:, 0].tolist() == [False, False, True, True, True, *[False] * 5]
    assert near.counts[:, 0].tolist() == [0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    assert other.there[:, 0].all()
    assert other.counts[:, 0].tolist() == [1] * 10
    anew = sceneloom.count_points(still_scene(SEEN), activations=False).lidars[0]
    assert anew.there[:, 0].all()
    samples = still_scene(SEEN).samples(reference="near", cameras="front", lidars=["near", "other"])
    assert [len(sample.boxes) for sample in samples] == [0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(samples[4].boxes.centers_world[0], [11.0, 3.0, 1.0])
    np.testing.assert_allclose(samples[4].boxes.yaws_world, np.pi / 2)
    assert [len(sample.boxes_for("front")) for sample in samples] == [0, 0, 0, 1, 1, 1, 0, 0, 0, 0]
    assert all(len(sample.boxes_for("other")) == 1 for sample in samples)
    np.testing.assert_allclose(samples[4].boxes_for("other").centers_world[0], row(400)[3:6])
    with pytest.raises(OptionError, match="no frame in this sample"):
        samples[0].boxes_for("rear")
    own = cuboid(activation("front", (300, 600), cuboids=[OWN]))
    (seen,) = sceneloom.project_cuboids(still_scene(own)).annotations
    (projection,) = seen.projections
    shown = projection.timestamps_ns[np.isfinite(projection.boxes[:, 0])]
    assert (shown // MS).tolist() == [300, 400, 500]
    np.testing.assert_array_equal(projection.cuboids[projection.timestamps_ns == 300 * MS][0], OWN)
    (anew,) = sceneloom.project_cuboids(still_scene(own), activations=True).annotations
    assert np.isfinite(anew.projections[0].boxes[:, 0]).sum() == 10
    assert (anew.activations[0].timestamps_ns // MS).tolist() == [0]
    scene = still_scene(SEEN)
    for sensor, shown in (("front", [0, 1, 1, 0]), (None, [1, 1, 1, 1])):
        drawn = [len(list(figures_in_world(scene, t * MS, sensor_id=sensor))) for t in (200, 300, 500, 600)]
        assert drawn == shown
    table = at.BoxTable(scene)
    rows, boxes = table.find(800 * MS)
    assert rows.tolist() == [0]
    np.testing.assert_allclose(boxes.centers_world[0], row(800)[3:6])
    assert table.find(800 * MS, sensor_id="near")[0].tolist() == []
    assert len(table.at(800 * MS, sensor_id="front", window_ns=(550 * MS, 800 * MS))) == 1


@pytest.mark.parametrize(
    ("to", "sensor", "least", "frames"),
    [
        ("nuscenes", "lidar", 1, 0),
        ("kitti-tracking", "camera0", 5, 2),
        ("kitti-raw", "lidar", 5, 2),
        ("kitti-object", "", 0, 0),
    ],
)
def test_exports_write_boxes_while_they_are_active_and_list_what_they_cannot_carry(
    to: str, sensor: str, least: int, frames: int, tmp_path: Path
) -> None:
    def written(scene: sc.Scene, name: str, *parts: sc.Activation, values: Any) -> tuple[int, Any]:
        """How many boxes come back from the format, and what it could not carry."""
        path = sc.CuboidPath(np.array([0, 10**10]), np.tile([3.0, 2.0, 2.0, *values, 0.0, 0.0, 0.0], (2, 1)))
        box = sc.CuboidAnnotation("box", path, label="car", activations=parts)
        losses = sceneloom.write(replace(scene, annotations=(box,)), tmp_path / name, format=to)
        with sceneloom.open(tmp_path / name) as found:
            boxes = [a for a in found.annotations if isinstance(a, sc.CuboidAnnotation)]
            return sum(len(a.path.timestamps_ns) for a in boxes), losses

    options = {"frames": 5, "lidar": LidarSpec(beams=8, steps=90)}
    if sensor:
        scene = simulate_street(1, cameras=(CameraSpec(SIGHT),), **options).scene
        ego = next(iter(scene.trajectories.values()))
        timestamps = (scene.lidars[0].frames if sensor == "lidar" else scene.cameras[0].images).timestamps_ns
        world_from_ego = RigidTransform.from_quaternion(ego.positions[40], ego.quaternions_xyzw[40])
        values = world_from_ego.apply(np.array([15.0, 0.0, 1.0]))
        assert written(scene, "all", values=values)[0] >= least
        part = sc.Activation(sensor, timestamps[1:2], (int(timestamps[3] - timestamps[1]),))
        count, losses = written(scene, "some", part, values=values)
        assert count == frames
        assert any(loss.field.endswith("cuboid.activations") for loss in losses)
    if to != "nuscenes":
        # labels of sweeps hold what is active at any time of them
        scene = simulate_street(1, cameras=(), **options).scene
        early = sc.Activation("lidar", scene.lidars[0].frames.timestamps_ns[1:2], (10 * MS,))
        assert written(scene, "early", early, values=[15.0, 0.0, 1.0])[0] == 1


def columns(count, **others):
    return {
        **{name: np.zeros((count, 3)) for name in ("centers", "velocities")},
        **{name: np.zeros(count) for name in ("yaws", "yaw_rates")},
        "sizes_lwh": np.ones((count, 3)),
        "covariances": np.tile(np.eye(10), (count, 1, 1)),
        "scores": np.ones(count),
        "supports": np.full(count, sc.Support.SWEEP, np.uint8),
        **others,
    }


def track(number, times, **others):
    return sc.Track(number, "car", np.array(times, np.int64), **columns(len(times), **others))


def test_tracks_are_a_sequence_that_cannot_be_written_to_and_refuse_what_does_not_fit():
    tracks = sc.Tracks((track(1, [0]), track(4, [0, 5])))
    assert [(one.id, len(one)) for one in tracks] == [(1, 1), (4, 2)]
    corners = np.ones((2, 4))
    found = track(3, [0, 10], corners_xyxy={"left": corners})
    for array in (found.centers, found.supports, found.timestamps_ns, found.corners_xyxy["left"]):
        assert not array.flags.writeable
    assert corners.flags.writeable
    for times, wrong, named in (
        ([10, 10], {}, "do not rise"),
        ([10, 0], {}, "do not rise"),
        ([0, 10], {"yaws": np.zeros(3)}, "yaws"),
        ([0, 10], {"corners_xyxy": {"left": np.zeros((2, 3))}}, "corners_xyxy"),
    ):
        with pytest.raises(ArrayError, match=named):
            track(3, times, **wrong)
    with pytest.raises(ArrayError, match="labels"):
        sc.TrackedObjects(0, np.arange(2), ("car",), **columns(2))
