"""Whatever the shape, the ray, the device or the seed: what must hold of every answer of the scene factory."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.unit.simulate.scenery import PLAIN, excess

from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, LidarSpec, Raster, Rosette, SolidStateSpec, TrafficSpec
from sceneloom.simulate.camera import Exposure, ExposureSpec, camera_mount
from sceneloom.simulate.casting import Rays, cast
from sceneloom.simulate.drive import Rig, simulate_street
from sceneloom.simulate.street import GroundMap, PackedShapes, Shape, ShapeKind, Street

NO_GROUND = GroundMap(np.zeros((2, 2, 4), np.float32), np.zeros(2))
numbers = st.floats(-10, 10, allow_nan=False)
triples = st.tuples(numbers, numbers, numbers)
sizes = st.floats(0.2, 4.0)


@st.composite
def shapes(draw):
    rotation = Rotation.from_rotvec(draw(triples)).as_matrix()
    center = np.add(draw(triples), [0, 0, 40.0])
    half = draw(st.tuples(sizes, sizes, sizes))
    return Shape(draw(st.sampled_from(ShapeKind)), RigidTransform(rotation, center), half, PLAIN)


@given(shape=shapes(), origin=triples, aim=triples)
def test_a_hit_lies_on_the_surface_and_nothing_of_the_shape_lies_before_it(shape, origin, aim):
    def outside(points):
        return excess(shape.kind, shape.pose.inverse().apply(points) / np.array(shape.half))

    origin = np.add(origin, [0, 0, 25.0])
    direction = shape.pose.translation + 0.2 * np.array(aim) - origin
    length = np.linalg.norm(direction)
    assume(length > 1e-3)
    assume(outside(origin) > 1 + 1e-6)
    direction = direction / length
    street = Street((), PackedShapes.of([shape], [1]), NO_GROUND)
    rays = Rays.bundled(direction[None], np.zeros(1, np.int64))
    hits = cast(street, rays, np.eye(3)[None], origin[None], np.zeros(1, np.int64), reach=200.0)
    if hits.shapes[0] == 0:
        # A sphere of 20 cm seen from 50 m loses half of float64's digits in its discriminant where the ray grazes it.
        assert abs(outside(origin + hits.ranges[0] * direction) - 1) < 1e-5
        before = origin + np.linspace(0, max(0.0, hits.ranges[0] - 1e-6), 200)[:, None] * direction
        assert outside(before).min() > 1 - 1e-5
    else:
        reach = 200.0 if hits.shapes[0] == -2 else hits.ranges[0]
        along = origin + np.linspace(0, reach, 4000)[:, None] * direction
        assert outside(along).min() > 1 - 1e-9


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


@given(
    rows=st.integers(1, 12),
    columns=st.integers(1, 9),
    channels=st.integers(1, 4),
    passes=st.integers(1, 12),
    period_ns=st.integers(1_000, 10**9),
)
@settings(max_examples=60)
def test_a_raster_shoots_at_each_of_its_cells_once_and_in_the_order_of_time(rows, columns, channels, passes, period_ns):
    raster = Raster((-40.0, 40.0), (-5.0, 5.0), rows, columns, channels, passes)
    shots = raster.plan_shots(period_ns)(0)
    directions = shots.rays.spread()
    azimuths = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
    cells = np.rint((40.0 - azimuths) / (80.0 / (columns * channels)) - 0.5).astype(int)
    locations = set(zip(shots.rings.tolist(), cells.tolist(), strict=True))
    assert locations == {(ring, cell) for ring in range(rows) for cell in range(columns * channels)}
    assert len(shots.moments) == rows * columns * channels
    assert (np.diff(shots.moments) >= 0).all()
    assert 0 == shots.offsets_ns[0] <= shots.offsets_ns[-1] < period_ns


@given(
    fov_deg=st.floats(1.0, 160.0),
    rotations=st.tuples(st.floats(-9000, 9000), st.floats(-9000, 9000)),
    share=st.floats(0.0, 1.0),
    elapsed_ns=st.integers(0, 10**12),
)
@settings(max_examples=60)
def test_a_rosette_stays_between_its_least_and_its_greatest_bend(fov_deg, rotations, share, elapsed_ns):
    shots = Rosette(fov_deg, 5000.0, rotations, share).plan_shots(20_000_000)(elapsed_ns)
    off_axis = np.degrees(np.arccos(shots.rays.spread()[:, 0].clip(-1.0, 1.0)))
    # The arc cosine loses half of the digits near the axis: 1e-8 rad.
    assert off_axis.max() <= fov_deg / 2 + 2e-6
    assert off_axis.min() >= abs(2 * share - 1) * fov_deg / 2 - 2e-6
    assert len(shots.moments) == 100
    assert shots.rings is None


@given(
    height=st.integers(2, 50), width=st.integers(2, 50), readout_ns=st.integers(1, 10**8), left_to_right=st.booleans()
)
def test_the_lines_of_a_shutter_lie_evenly_around_the_images_time(height, width, readout_ns, left_to_right):
    camera = Camera("pinhole", width, height, 30.0, 30.0, 10.0, 10.0)
    offsets = CameraSpec(camera, readout_ns=readout_ns, left_to_right=left_to_right).line_offsets_ns()
    count = width if left_to_right else height
    assert len(offsets) == count
    # Rounding to whole nanoseconds is half a nanosecond at either end.
    assert np.abs(offsets + offsets[::-1]).max() <= 1
    assert abs(offsets[-1] - offsets[0] - readout_ns * (count - 1) / count) <= 1


@given(
    frames=st.integers(1, 30),
    first_ns=st.integers(10**6, 10**9),
    other_ns=st.integers(10**6, 10**9),
    share=st.floats(0.0, 0.999),
)
def test_each_device_begins_its_frames_while_the_drive_lasts(frames, first_ns, other_ns, share):
    other = SolidStateSpec(Raster(rows=1, columns=1), period_ns=other_ns, offset_ns=int(share * other_ns))
    lidars = (LidarSpec(beams=1, steps=1, period_ns=first_ns), other)
    rig = Rig.of(lidars, (), (), frames=frames, start_ns=-5)
    first, second = (rig.frame_starts_ns(spec) for spec in lidars)
    stop = -5 + frames * first_ns
    assert first.tolist() == list(range(-5, stop, first_ns))
    assert second.tolist() == list(range(-5 + other.offset_ns, stop, other_ns))
    assert rig.span_ns[1] >= max(stop, *(second + other_ns).tolist(), stop)
    assert rig.span_ns[0] < -5


@given(
    seed=st.integers(0, 2**32),
    at_ns=st.integers(0, 10**12),
    drift=st.floats(0.0, 4.0),
    step=st.floats(-4.0, 4.0),
    begin=st.floats(0.0, 100.0),
)
def test_the_gain_stays_within_drift_and_step(seed, at_ns, drift, step, begin):
    spec = ExposureSpec(drift_stops=drift, steps=((begin, step),))
    stops = np.log2(Exposure.of(spec, start_ns=0, seed=seed, camera=1).gain(at_ns))
    assert -drift + min(0.0, step) - 1e-9 <= stops <= drift + max(0.0, step) + 1e-9
