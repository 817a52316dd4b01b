"""Hand-eye alignment against exact motions, scipy and simulated drives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.calibrate.extrinsics import ground_plane, step_between
from sceneloom.calibrate.lidar_to_ego import align_motions, lidar_to_ego, paired_motions
from sceneloom.calibrate.lidar_to_lidar import lidar_to_lidar
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry import rigid
from sceneloom.scene import Poses
from sceneloom.simulate import Faults, LidarSpec, PathSpec, SensorFaults, inject, sensor_mount, simulate_street

COUNT = 200
TIMES_NS = 1_000_000_000 + 100_000_000 * np.arange(COUNT, dtype=np.int64)
MOUNT = rigid.RigidTransform.from_quaternion(
    np.array([0.6, -0.2, 1.8]), rigid.quaternion_from_rotation_vector(np.radians([1.0, -2.0, 30.0]))
)


def tumbling_body():
    seconds = np.arange(COUNT) * 0.1
    rotations = np.stack([0.4 * np.sin(0.9 * seconds), 0.3 * np.sin(1.3 * seconds), 0.2 * seconds], axis=1)
    locations = np.stack([4.0 * seconds, np.sin(seconds), 0.3 * np.cos(seconds)], axis=1)
    return Poses(TIMES_NS, locations, rigid.quaternion_from_rotation_vector(rotations))


def seen_by_sensor(body, *, rotation_noise=0.0, shift_noise=0.0, seed=0):
    """The sensor's own trajectory, in a world of its own."""
    rng, count = np.random.default_rng(seed), len(body.timestamps_ns)
    locations = body.positions + rigid.rotate_vectors(body.quaternions_xyzw, MOUNT.translation)
    locations = locations + rng.normal(0.0, 1.0, (count, 3)) * shift_noise
    rotations = rigid.multiply_quaternions(body.quaternions_xyzw, MOUNT.quaternion_xyzw)
    noise = rigid.quaternion_from_rotation_vector(rng.normal(0.0, 1.0, (count, 3)) * rotation_noise)
    world = rigid.RigidTransform.from_quaternion(rng.normal(0, 3, 3), rigid.normalise_quaternion(rng.normal(0, 1, 4)))
    rotated = rigid.multiply_quaternions(world.quaternion_xyzw, rigid.multiply_quaternions(rotations, noise))
    return Poses(body.timestamps_ns, world.apply(locations), rotated)


def _by_scipy(body, sensor):
    """Park and Martin's two steps: rotation vectors aligned by scipy, then the translation by least squares."""
    a, b = _relative(body), _relative(sensor)
    rotation, _ = Rotation.align_vectors(a[0].as_rotvec(), b[0].as_rotvec())
    matrix, right = (a[0].as_matrix() - np.eye(3)).reshape(-1, 3), rotation.apply(b[1]) - a[1]
    translation, *_ = np.linalg.lstsq(matrix, right.ravel(), rcond=None)
    return rigid.RigidTransform(rotation.as_matrix(), translation)


def _relative(path):
    rotations = Rotation.from_quat(path.quaternions_xyzw)
    back = rotations[:-10].inv()
    return back * rotations[10:], back.apply(path.positions[10:] - path.positions[:-10])


def test_exact_motions_about_all_axes_give_the_exact_mounting_those_on_a_plane_all_but_the_height():
    body = tumbling_body()
    found = align_motions(paired_motions(body, seen_by_sensor(body), TIMES_NS))
    # what keeps unknown directions at the guess pulls by a millionth of what the motions report
    np.testing.assert_allclose(step_between(found.mounting.a_from_b, MOUNT), 0.0, atol=1e-5)
    # also from a guess that is upside down
    flipped = rigid.RigidTransform(MOUNT.rotation @ np.diag([1.0, -1.0, -1.0]), MOUNT.translation)
    guessed = align_motions(paired_motions(body, seen_by_sensor(body), TIMES_NS), guess=flipped)
    np.testing.assert_allclose(step_between(guessed.mounting.a_from_b, MOUNT), 0.0, atol=1e-4)
    assert (found.mounting.unobserved, found.inliers) == ((), 1.0)
    # a car on a perfect plane, which rotates about its z axis alone and moves along its x axis
    yaws = 0.8 * np.sin(0.5 * np.arange(COUNT) * 0.1)
    steps = 0.8 * np.stack([np.cos(yaws), np.sin(yaws), 0.0 * yaws], axis=1)
    rotations = np.stack([0.0 * yaws, 0.0 * yaws, yaws], axis=1)
    body = Poses(TIMES_NS, np.cumsum(steps, axis=0), rigid.quaternion_from_rotation_vector(rotations))
    guess = rigid.RigidTransform(MOUNT.rotation, MOUNT.translation + np.array([0.2, -0.1, 0.3]))
    found = align_motions(paired_motions(body, seen_by_sensor(body), TIMES_NS), guess=guess).mounting
    step = step_between(found.a_from_b, MOUNT)
    np.testing.assert_allclose(np.degrees(step[:3]), 0.0, atol=1e-3)
    np.testing.assert_allclose(step[3:5], 0.0, atol=1e-3)
    assert found.a_from_b.translation[2] == pytest.approx(guess.translation[2], abs=1e-6)
    assert len(found.unobserved) == 1
    assert found.unobserved[0].startswith("translation along z of the ego: known within")


def test_noisy_and_wild_motions_give_a_mounting_at_least_as_good_as_that_of_scipy_within_its_covariance():
    body = tumbling_body()
    ours, theirs = [], []
    for seed in range(6):
        sensor = seen_by_sensor(body, rotation_noise=np.radians(0.1), shift_noise=0.02, seed=seed)
        found = align_motions(paired_motions(body, sensor, TIMES_NS)).mounting.a_from_b
        ours.append(step_between(found, MOUNT))
        theirs.append(step_between(_by_scipy(body, sensor), MOUNT))
    errors = [np.sqrt(np.mean(np.square(steps), axis=0)) for steps in (ours, theirs)]
    assert np.linalg.norm(errors[0][:3]) <= np.linalg.norm(errors[1][:3])
    assert np.linalg.norm(errors[0][3:]) <= np.linalg.norm(errors[1][3:])
    sensor = seen_by_sensor(body, rotation_noise=np.radians(0.02), shift_noise=0.01)
    locations = sensor.positions.copy()
    locations[::10] += 3.0
    wild = Poses(TIMES_NS, locations, sensor.quaternions_xyzw)
    step = step_between(align_motions(paired_motions(body, wild, TIMES_NS)).mounting.a_from_b, MOUNT)
    assert np.degrees(np.abs(step[:3])).max() < 0.02
    assert np.abs(step[3:]).max() < 0.02  # twice the noise of one pose
    inside = []
    for seed in range(20):
        sensor = seen_by_sensor(body, rotation_noise=np.radians(0.05), shift_noise=0.02, seed=seed)
        mounting = align_motions(paired_motions(body, sensor, TIMES_NS)).mounting
        inside.append(np.abs(step_between(mounting.a_from_b, MOUNT)) < 1.96 * mounting.sigmas)
    assert np.mean(inside) > 0.9


def test_a_body_that_stands_ways_without_common_time_and_the_lidars_own_trajectory_are_refused():
    body = tumbling_body()
    still = Poses(TIMES_NS, np.zeros((COUNT, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1)))
    with pytest.raises(PoseError, match="stationary ego determines nothing"):
        align_motions(paired_motions(still, still, TIMES_NS))
    later = Poses(TIMES_NS + 10**12, body.positions, body.quaternions_xyzw)
    with pytest.raises(PoseError, match="are they on one clock"):
        paired_motions(body, later, TIMES_NS)
    with pytest.raises(OptionError, match="found from the lidar itself"):
        lidar_to_ego(simulate_street(3, frames=2).scene, trajectory="lidar")


def test_the_mounting_and_the_clock_of_a_simulated_lidar_are_found_again():
    small = LidarSpec(beams=24, steps=600)
    drive = simulate_street(3, frames=60, path=PathSpec(yaw_rate=0.5), lidar=small)
    wrong = SensorFaults(rotation_deg=(1.0, -2.0, 3.0), shift=(0.3, -0.2, 0.0), time_offset_ns=30_000_000)
    found = lidar_to_ego(inject(drive, Faults({"lidar": wrong})).scene)
    mounting = found.found.mounting
    step = step_between(mounting.a_from_b, drive.scene.lidars[0].mount)
    assert np.degrees(np.abs(step[:3])).max() < 0.05
    assert np.abs(step[3:5]).max() < 0.05
    assert abs(step[5]) < 3.0 * mounting.sigmas[5]
    assert found.clock.offset_ns == pytest.approx(30e6, abs=2e6)


ROOF = LidarSpec(beams=32, steps=900)
ASIDE = sensor_mount(position=(1.5, 0.6, 0.9), yaw_deg=70.0, pitch_deg=3.0, roll_deg=-4.0)
CORNER = LidarSpec(beams=16, steps=900, elevations_deg=(-30.0, 10.0), mount=ASIDE)


@pytest.fixture(scope="module")
def drive():
    """Six sweeps of two lidars, the second of which is stated 3.7 degrees and 24 cm off."""
    wrong = SensorFaults(rotation_deg=(1.0, -2.0, 3.0), shift=(0.2, -0.1, 0.1))
    return inject(simulate_street(3, frames=6, lidars=(ROOF, CORNER)), Faults({"lidar1": wrong}))


@pytest.mark.parametrize(("use_stated", "started"), [(True, "stated"), (False, "ground")])
@pytest.mark.few(1)
def test_the_second_lidar_is_found_from_a_wrong_mounting_and_from_none(drive, use_stated, started):
    found = lidar_to_lidar(drive.scene, use_stated=use_stated, most=4)
    step = step_between(found.mounting.a_from_b, ROOF.mount.inverse() @ CORNER.mount)
    # range noise of 2 cm over thousands of points, thinned to one in 40 cm
    assert np.degrees(np.linalg.norm(step[:3])) < 0.1
    assert np.linalg.norm(step[3:]) < 0.02
    assert found.started == started
    assert found.agreeing >= 3
    assert found.overlap > 0.4
    assert (np.abs(step) < 4.0 * found.mounting.sigmas).all()


@pytest.mark.slow
def test_a_start_far_off_is_refused_and_not_refined_into_something(drive):
    far = inject(
        simulate_street(3, frames=4, lidars=(ROOF, CORNER)),
        Faults({"lidar1": SensorFaults(rotation_deg=(0.0, 90.0, 0.0), shift=(0.0, 0.0, 30.0))}),
    )
    with pytest.raises(PoseError, match="expected"):
        lidar_to_lidar(far.scene, most=3)


def test_lidars_that_are_not_there_are_refused_and_the_ground_is_found_below_the_sensor(drive):
    with pytest.raises(OptionError, match="expected two"):
        lidar_to_lidar(drive.scene, "lidar0", "lidar7")
    one = replace(drive.scene, sensors=drive.scene.lidars[:1])
    with pytest.raises(OptionError, match=r"expected two$"):
        lidar_to_lidar(one)
    with pytest.raises(OptionError, match="named twice"):
        lidar_to_lidar(drive.scene, "lidar0", "lidar0")
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-15, 15, (3000, 2)), rng.normal(-1.7, 0.02, 3000)])
    wall = np.column_stack([np.full(2000, 8.0), rng.uniform(-10, 10, 2000), rng.uniform(-1.7, 4.0, 2000)])
    found = ground_plane(np.concatenate([ground, wall]))
    assert found is not None
    np.testing.assert_allclose(found[0], [0.0, 0.0, 1.0], atol=0.005)
    assert found[1] == pytest.approx(1.7, abs=0.01)
    assert ground_plane(wall) is None
    assert ground_plane(wall[:10]) is None
