"""Whatever the shape, the ray, the device or the seed: what must hold of every answer of the scene factory."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, camera_mount, simulate_street
from sceneloom.simulate.casting import Rays, cast
from sceneloom.simulate.street import GroundMap, Material, PackedShapes, Pattern, Shape, ShapeKind, Street

NO_GROUND = GroundMap(np.zeros((2, 2, 4), np.float32), np.zeros(2))
PLAIN = Material(Pattern.PLAIN, ((90.0, 90.0, 90.0),) * 3)

numbers = st.floats(-10, 10, allow_nan=False)
triples = st.tuples(numbers, numbers, numbers)
sizes = st.floats(0.2, 4.0)


@st.composite
def shapes(draw):
    rotation = Rotation.from_rotvec(draw(triples)).as_matrix()
    center = np.add(draw(triples), [0, 0, 40.0])
    half = draw(st.tuples(sizes, sizes, sizes))
    return Shape(draw(st.sampled_from(ShapeKind)), RigidTransform(rotation, center), half, PLAIN)


def excess(shape, points):
    """How far outside its unit body points are, as a factor of its size: below 1 inside, 1 on the surface."""
    local = shape.pose.inverse().apply(points) / np.array(shape.half)
    x, y, z = np.moveaxis(np.abs(local), -1, 0)
    return {
        ShapeKind.BOX: np.maximum.reduce([x, y, z]),
        ShapeKind.CYLINDER: np.maximum(np.hypot(x, y), z),
        ShapeKind.ELLIPSOID: np.linalg.norm(local, axis=-1),
        ShapeKind.GABLE: np.maximum.reduce([x, y + 0.5 * local[..., 2] + 0.5, -local[..., 2]]),
    }[shape.kind]


@given(shape=shapes(), origin=triples, aim=triples)
def test_a_hit_lies_on_the_surface_and_nothing_of_the_shape_lies_before_it(shape, origin, aim):
    origin = np.add(origin, [0, 0, 25.0])
    direction = shape.pose.translation + 0.2 * np.array(aim) - origin
    length = np.linalg.norm(direction)
    assume(length > 1e-3)
    assume(excess(shape, origin) > 1 + 1e-6)
    direction = direction / length
    street = Street((), PackedShapes.of([shape], [1]), NO_GROUND)
    rays = Rays.bundled(direction[None], np.zeros(1, np.int64))
    hits = cast(street, rays, np.eye(3)[None], origin[None], np.zeros(1, np.int64), reach=200.0)
    if hits.shapes[0] == 0:
        # A sphere of 20 cm seen from 50 m loses half of float64's digits in its discriminant where the ray grazes it.
        assert abs(excess(shape, origin + hits.ranges[0] * direction) - 1) < 1e-5
        before = origin + np.linspace(0, max(0.0, hits.ranges[0] - 1e-6), 200)[:, None] * direction
        assert excess(shape, before).min() > 1 - 1e-5
    else:
        reach = 200.0 if hits.shapes[0] == -2 else hits.ranges[0]
        along = origin + np.linspace(0, reach, 4000)[:, None] * direction
        assert excess(shape, along).min() > 1 - 1e-9


@settings(max_examples=8)
@given(
    seed=st.integers(0, 2**63),
    beams=st.integers(1, 40),
    steps=st.integers(1, 200),
    clockwise=st.booleans(),
    sigma=st.floats(0, 0.1),
)
def test_any_lidar_on_any_street_gives_points_within_their_sweep_near_where_they_come_from(
    seed, beams, steps, clockwise, sigma
):
    spec = LidarSpec(beams=beams, steps=steps, clockwise=clockwise, range_sigma=sigma)
    drive = simulate_street(seed, frames=2, lidar=spec, cameras=())
    frame, sweep = drive.scene.lidars[0].frames[1], drive.truth.sweep(1)
    times = frame.points.timestamps_ns
    assert len(times) == len(sweep.ranges) == len(sweep.points_world)
    assert ((times >= frame.timestamp_ns) & (times < frame.timestamp_ns + spec.period_ns)).all()
    assert (frame.points.rings < beams).all()
    assert (sweep.ranges <= spec.max_range).all()
    # 8000 draws stay within seven deviations; float32 adds 1e-5 m.
    error = np.abs(np.linalg.norm(frame.points.positions.astype(np.float64), axis=1) - sweep.ranges)
    assert (error <= 7 * sigma + 1e-5).all()
    assert (sweep.points_world[:, 2] > -1e-9).all()


MODELS = [("pinhole", ()), ("brown_conrady", (-0.2, 0.05, 0.001, -0.001)), ("fisheye", (0.01, -0.004))]


@settings(max_examples=6)
@given(seed=st.integers(0, 2**31), yaw=st.floats(-180, 180), pitch=st.floats(-30, 60), model=st.sampled_from(MODELS))
@pytest.mark.slow
def test_any_camera_on_any_street_sees_depth_where_it_sees_something(seed, yaw, pitch, model):
    camera_model = Camera(model[0], 64, 48, 40.0, 42.0, 31.0, 24.0, model[1])
    spec = CameraSpec(camera_model, camera_mount(yaw_deg=yaw, pitch_deg=pitch))
    drive = simulate_street(seed, frames=1, lidar=LidarSpec(beams=1, steps=1), cameras=(spec,))
    image = drive.truth.image("camera0", 0)
    assert ((image.depths > 0) == (image.instances >= 0)).all()
    assert image.instances.max() <= len(drive.truth.objects)
    np.testing.assert_array_equal(drive.scene.cameras[0].images[0].rgb, image.colors)


@settings(max_examples=6)
@given(
    seed=st.integers(0, 2**31),
    cars=st.floats(0, 6),
    cyclists=st.floats(0, 10),
    pedestrians=st.floats(0, 15),
    stationary=st.floats(0, 0.5),
)
@pytest.mark.slow
def test_in_any_traffic_points_lie_on_what_is_there_at_their_times(seed, cars, cyclists, pedestrians, stationary):
    traffic = TrafficSpec(cars=cars, cyclists=cyclists, pedestrians=pedestrians, stationary=stationary)
    spec = LidarSpec(beams=16, steps=300, range_sigma=0.0, drop_rate=0.0)
    drive = simulate_street(seed, frames=2, lidar=spec, cameras=(), traffic=traffic)
    truth, clean = drive.truth, drive.truth.clean_points_world(1)
    times = drive.scene.lidars[0].frames[1].points.timestamps_ns
    first, movers = len(truth.objects) + 1, truth.street.movers
    assert clean.instances.max() < first + len(movers)
    rows = np.flatnonzero(clean.instances >= first)
    which = clean.instances[rows].astype(np.int64) - first
    assert movers.present(which, times[rows]).all()
    states = movers.states(which, times[rows])
    sizes = np.array([truth.movers[k].size_lwh for k in which]).reshape(-1, 3)
    apart = clean.positions_world[rows] - states.positions
    ahead = np.cos(states.yaws) * apart[:, 0] + np.sin(states.yaws) * apart[:, 1]
    left = np.cos(states.yaws) * apart[:, 1] - np.sin(states.yaws) * apart[:, 0]
    within = np.column_stack([ahead, left, apart[:, 2] - sizes[:, 2] / 2])
    assert (np.abs(within) <= sizes / 2 + 1e-9).all()
    assert np.isfinite(clean.velocities).all()
