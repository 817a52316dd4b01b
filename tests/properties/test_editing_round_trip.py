"""What an edit does and another undoes: the world seen from the ego and back, parts joined, cubes, paths thinned."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation, Slerp

from sceneloom import scene as sc
from sceneloom.editing import crop_scene, merge_scenes, simplify_scene, to_ego, to_sensor, to_world
from sceneloom.editing.simplify import _thin_greedily
from sceneloom.editing.thin import one_per_cube
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CuboidAnnotation, CuboidPath, OdometrySensor, PointPath, PointsAnnotation, Poses, Scene
from sceneloom.scene.annotations_at import CuboidAngles

PERIOD_NS = 100_000_000


@st.composite
def drives(draw):
    """A lidar on an ego that goes any way, with points and annotations in the world."""
    seed = draw(st.integers(0, 2**32 - 1))
    frames = draw(st.integers(1, 6))
    numbers = np.random.default_rng(seed)
    times = np.arange(-1, frames + 1, dtype=np.int64) * PERIOD_NS
    rotations = numbers.normal(size=(len(times), 4))
    positions = numbers.uniform(-1, 1, (len(times), 3)).cumsum(axis=0) * draw(st.floats(0.0, 3.0))
    path = sc.Poses(times, positions, rotations / np.linalg.norm(rotations, axis=1, keepdims=True))
    timestamps = times[1:-1]
    points = [sc.LidarPoints(numbers.uniform(-50, 50, (20, 3)).astype(np.float32)) for _ in timestamps]
    sweeps = [sc.LidarFrame(int(t), p) for t, p in zip(timestamps, points, strict=True)]
    mount = RigidTransform.from_quaternion(numbers.uniform(-2, 2, 3), numbers.normal(size=4))
    frames_world = sc.LazyFrames.of(sweeps, timestamps.tolist())
    lidar = sc.LidarSensor("lidar", frames_world, mount=mount, points_frame=sc.PointsFrame.WORLD)
    rows = numbers.uniform([0.5] * 3 + [-50] * 3 + [-400] * 3, [5] * 3 + [50] * 3 + [400] * 3, (frames, 9))
    corners = tuple(numbers.uniform(-50, 50, (4, 3)) for _ in timestamps)
    annotations = (
        sc.CuboidAnnotation("box", sc.CuboidPath(timestamps, rows)),
        sc.CuboidAnnotation("parked", sc.CuboidPath(timestamps[:1], rows[:1]), stationary=True),
        sc.ShapeAnnotation("area", sc.ShapeType.POLYGON_TOPDOWN, sc.VertexPath(timestamps, corners)),
    )
    trajectory = sc.Trajectory("ego", path.timestamps_ns, path.positions, path.quaternions_xyzw)
    unit, order = draw(st.sampled_from(["degrees", "radians"])), draw(st.sampled_from(["xyz", "zyx", "yxz"]))
    return sc.Scene(
        (lidar, sc.OdometrySensor("ego", path)),
        annotations,
        trajectories={"ego": trajectory},
        metadata={"sceneloom": {"euler_unit": unit, "euler_order": order}},
    )


def assert_same_cuboids(scene, before, after):
    """Rows with equal numbers, and equal rotations whichever angles state them."""
    angles = CuboidAngles.of(scene)
    assert after.path.timestamps_ns.tolist() == before.path.timestamps_ns.tolist()
    np.testing.assert_allclose(after.path.values[:, :6], before.path.values[:, :6], atol=1e-9)
    rotations = [angles.quaternions(annotation.path.values[:, 6:]) for annotation in (before, after)]
    # a quaternion and its negative are one rotation
    np.testing.assert_allclose(np.abs((rotations[0] * rotations[1]).sum(axis=1)), 1.0, atol=1e-9)


@given(drives(), st.floats(1.0, 80.0))
def test_the_world_seen_from_the_ego_or_sensor_and_back_is_the_world_and_cropped_twice_cropped_once(scene, reach):
    again, direct, around = to_world(to_ego(scene)), to_ego(scene), to_ego(to_sensor(scene))
    for found, expected in ((again, scene), (around, direct)):
        for after, before in zip(found.sensor("lidar").frames, expected.sensor("lidar").frames, strict=True):
            # both ways are rounded to float32, at up to 120 m from the origin
            np.testing.assert_allclose(after.points.positions, before.points.positions, atol=4e-5)
    box, parked, area = again.annotations
    assert_same_cuboids(scene, scene.annotations[0], box)
    assert_same_cuboids(scene, scene.annotations[1], parked)
    assert parked.stationary is True
    np.testing.assert_allclose(area.path.vertices, scene.annotations[2].path.vertices, atol=1e-9)
    once = crop_scene(scene, reach=reach, frame="ego")
    twice = crop_scene(once, reach=reach, frame="ego")
    for a, b in zip(once.sensor("lidar").frames, twice.sensor("lidar").frames, strict=True):
        np.testing.assert_array_equal(a.points.positions, b.points.positions)
    assert [a.id for a in once.annotations] == [a.id for a in twice.annotations]
    assert replace(once, warnings=()).source == scene.source


@given(drives(), st.floats(0.0, 0.6))
def test_parts_of_a_scene_are_joined_to_the_whole(scene, seconds):
    lidar = scene.sensor("lidar")
    timestamps = lidar.frames.timestamps_ns
    cut = int(np.searchsorted(timestamps, seconds * 1e9))
    if not 0 < cut < len(timestamps):
        return
    at = (timestamps[cut] - timestamps[0]) * 1e-9
    parts = [crop_scene(scene, stop=at), crop_scene(scene, start=at)]
    joined = merge_scenes(parts, join=True)
    for before, after in zip(lidar.frames, joined.sensor("lidar").frames, strict=True):
        np.testing.assert_array_equal(after.points.positions, before.points.positions)
    np.testing.assert_array_equal(joined.annotations[0].path.values, scene.annotations[0].path.values)


@given(
    st.lists(st.tuples(*(st.floats(-1e5, 1e5, width=32),) * 3), max_size=60),
    st.floats(0.01, 100.0),
    st.sampled_from(["nearest", "first"]),
)
def test_each_cube_with_points_keeps_one_of_them(points, side, keep):
    positions = np.array(points, np.float32).reshape(-1, 3)
    rows = one_per_cube(positions, side, keep=keep)
    cubes = np.floor(positions.astype(np.float64) / side)
    assert np.array_equal(rows, np.unique(rows))
    assert len(np.unique(cubes[rows], axis=0)) == len(rows) == len(np.unique(cubes, axis=0))
    # what was thinned once stays
    assert len(one_per_cube(positions[rows], side, keep=keep)) == len(rows)


STEPS = st.lists(st.integers(1, 10**9), min_size=1, max_size=40)
ARITHMETIC = 1e-6
"""Share of a tolerance: scipy counts times in float64, and the sums are in another order."""


@st.composite
def paths(draw, columns):
    timestamps = np.cumsum(draw(STEPS)).astype(np.int64)
    smooth = np.sin(timestamps[:, None] * draw(st.floats(1e-11, 1e-8)) + np.arange(columns))
    rough = draw(arrays(np.float64, (len(timestamps), columns), elements=st.floats(-1.0, 1.0, width=32)))
    return timestamps, draw(st.sampled_from([0.1, 3.0, 50.0])) * smooth + draw(
        st.sampled_from([0.0, 0.01, 1.0])
    ) * rough


def straight(timestamps, values, times):
    return np.column_stack([np.interp(times.astype(float), timestamps.astype(float), column) for column in values.T])


@given(paths(9), st.sampled_from([0.001, 0.05, 1.0]), st.sampled_from([0.01, 1.0, 20.0]))
def test_timestamps_left_out_of_a_cuboid_are_reported_by_scipy_within_the_tolerances(path, metres, degrees):
    timestamps, values = path
    values[:, 6:] *= 40.0
    cuboid = CuboidAnnotation("a", CuboidPath(timestamps, values))
    (simple,) = simplify_scene(Scene((), (cuboid,)), tolerance_m=metres, tolerance_deg=degrees).annotations
    kept = np.isin(timestamps, simple.path.timestamps_ns)
    np.testing.assert_array_equal(simple.path.values, values[kept])
    assert kept[[0, -1]].all()
    between = straight(simple.path.timestamps_ns, simple.path.values[:, :6], timestamps)
    for part in (slice(0, 3), slice(3, 6)):
        away = np.linalg.norm(between[:, part] - values[:, part], axis=1)
        assert away.max() <= metres * (1 + ARITHMETIC) + 1e-12
    if len(simple.path.timestamps_ns) > 1:
        rotations = Rotation.from_euler("XYZ", values[:, 6:], degrees=True)
        reported = Slerp(simple.path.timestamps_ns.astype(float), rotations[kept])(timestamps.astype(float))
        assert np.degrees((reported.inv() * rotations).magnitude()).max() <= degrees * (1 + ARITHMETIC) + 1e-6


@given(paths(7), st.sampled_from([0.0, 0.01, 1.0]))
def test_poses_and_keypoints_left_out_of_a_trajectory_are_reported_within_the_tolerances(path, metres):
    timestamps, values = path
    quaternions = values[:, 3:] + [0.0, 0.0, 0.0, 200.0]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    poses, points = Poses(timestamps, values[:, :3].copy(), quaternions), PointPath(timestamps, values[:, :3].copy())
    scene = Scene((OdometrySensor("ego", poses),), (PointsAnnotation("a", (points,)),))
    simple = simplify_scene(scene, tolerance_m=metres)
    (left,), found = simple.annotations[0].paths, simple.sensors[0].poses.interpolate(timestamps)
    assert (found.coverage == 0).all()
    for between in (straight(left.timestamps_ns, left.values, timestamps), found.positions):
        assert np.linalg.norm(between - points.values, axis=1).max() <= metres * (1 + ARITHMETIC) + 1e-12
    away = Rotation.from_quat(found.quaternions_xyzw).inv() * Rotation.from_quat(quaternions)
    assert np.degrees(away.magnitude()).max() <= 0.1 * (1 + ARITHMETIC) + 1e-6


@given(arrays(np.float64, st.integers(0, 60), elements=st.integers(0, 3)))
def test_every_step_of_a_thinned_curve_fits_and_the_ends_stay(values):
    def misfits(a, b):
        line = np.interp(np.arange(a + 1, b), [a, b], values[[a, b]])
        return np.abs(line - values[a + 1 : b])

    kept = _thin_greedily(len(values), misfits)
    assert (np.diff(kept) > 0).all()
    assert len(values) == 0 or (kept[0], kept[-1]) == (0, len(values) - 1)
    for a, b in pairwise(kept.tolist()):
        assert (misfits(a, b) <= 1.0).all()
