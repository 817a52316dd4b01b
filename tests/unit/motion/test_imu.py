"""How the ego rotated by its gyroscope and cameras by their images, against scipy and truth known by formula."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras import Camera, unproject
from sceneloom.errors import DataError, PoseError
from sceneloom.geometry.rigid import angle_between
from sceneloom.motion.camera_rotation import camera_rotation, rotation_between
from sceneloom.motion.clock.comparison import compare_rotations
from sceneloom.motion.clock.signals import Orientations
from sceneloom.motion.imu import find_stationary, imu_motion, integrate_rates
from sceneloom.scene import CameraImage, CameraSensor, ImuSensor, LazyFrames, Scene, VectorSamples, WarningKind
from sceneloom.simulate import simulate_street
from sceneloom.simulate.drive import ImuSpec
from sceneloom.simulate.trajectory import PathSpec, Stop

SECOND = 1_000_000_000


def swinging_rates(seconds):
    """A vehicle that turns, rolls and pitches at once, about axes that change."""
    return np.stack([0.4 * np.sin(7 * seconds), 0.3 * np.cos(5 * seconds + 1), 0.6 + 0.5 * np.sin(2 * seconds)], axis=1)


def finely_integrated(stop, rate_hz):
    """The product of many tiny rotations, each with the rate in its middle."""
    middles, rotated = (np.arange(int(stop * rate_hz)) + 0.5) / rate_hz, Rotation.identity()
    for chunk in np.array_split(middles, len(middles) // 50):
        product = Rotation.identity()
        for rotation in Rotation.from_rotvec(swinging_rates(chunk) / rate_hz):
            product = product * rotation
        rotated = rotated * product
    return rotated


@pytest.mark.slow
def test_the_integral_of_a_swinging_motion_is_that_of_tiny_steps():
    seconds = np.arange(0, 401) / 200.0
    rotating = integrate_rates((seconds * SECOND).astype(np.int64), swinging_rates(seconds))
    true = finely_integrated(2.0, 20_000)
    apart = (Rotation.from_quat(rotating[-1]).inv() * true).magnitude()
    # the trapezoid's error over 2 s at 200 Hz is some h² |ω''| t / 12 = 2e-4; a wrong order of rotations gives 1e-1
    assert apart < 3e-4
    np.testing.assert_allclose(np.linalg.norm(rotating, axis=1), 1.0, atol=1e-12)


def test_rates_are_integrated_in_order_with_the_coning_between_them():
    rates = np.array([[2.0, 0, 0.3], [0, 2.0, 0.3]])
    rotated = Rotation.from_quat(integrate_rates(np.array([0, SECOND // 5]), rates)[1])
    true = Rotation.identity()
    for fraction in (np.arange(2000) + 0.5) / 2000:
        true = true * Rotation.from_rotvec((rates[0] + fraction * (rates[1] - rates[0])) * 0.2 / 2000)
    missed = (Rotation.from_rotvec(0.2 * rates.mean(axis=0)).inv() * true).magnitude()
    assert missed > 0.01
    assert (rotated.inv() * true).magnitude() < missed / 20  # what is left is of the third order
    for count in [1, 2, 3, 16, 17]:
        rates = np.random.default_rng(count).normal(size=(count, 3))
        rotating = integrate_rates(np.arange(count) * SECOND // 10, rates)
        expected = Rotation.identity()
        for k in range(count):
            if k:
                mean, cross = 0.5 * (rates[k - 1] + rates[k]), np.cross(rates[k - 1], rates[k])
                expected = expected * Rotation.from_rotvec(0.1 * mean + 0.01 / 12 * cross)
            assert (Rotation.from_quat(rotating[k]).inv() * expected).magnitude() < 1e-12


def stationary_signals(seconds=4.0, rate_hz=100):
    rng, count = np.random.default_rng(0), int(seconds * rate_hz)
    times = np.arange(count) * SECOND // rate_hz
    rates = np.array([0.01, -0.004, 0.002]) + 0.001 * rng.normal(size=(count, 3))
    forces = np.array([0.1, 0.2, 9.8]) + 0.01 * rng.normal(size=(count, 3))
    return times, rates, forces


def test_a_simulated_drive_rotates_as_it_truly_did_with_the_bias_found_only_while_it_stands():
    drive = simulate_street(3, frames=20, cameras=(), imu=ImuSpec(gyroscope_bias_sigma=0.0))
    motion = imu_motion(drive.scene)
    times = motion.ego.path.timestamps_ns
    true = drive.truth.world_from_ego(times).quaternions_xyzw
    found = Rotation.from_quat(true[0]) * Rotation.from_quat(motion.ego.path.quaternions_xyzw)
    # 2.4 s of white noise of 1e-4 rad/s/√Hz on three axes: 1e-4 √2.4 √3 = 2.7e-4 rad; four times that
    assert angle_between(found.as_quat(), true).max() < 1.1e-3
    assert motion.bias is None
    assert [warning.code for warning in motion.ego.warnings] == ["rotation-only", "gyroscope-bias-unknown"]
    spec, path = ImuSpec(gyroscope_bias_sigma=0.01), PathSpec(stops=(Stop(4.0, 5.0),))
    drive = simulate_street(1, frames=120, cameras=(), imu=spec, path=path)
    motion = imu_motion(drive.scene)
    assert motion.bias is not None
    # 1e-4 rad/s/√Hz over 3 s: 6e-5 rad/s; five times that
    np.testing.assert_allclose(motion.bias, drive.truth.imu.gyroscope_bias, atol=3e-4)
    reported = next(warning for warning in motion.ego.warnings if warning.code == "gyroscope-bias")
    assert reported.kind is WarningKind.REPAIRED
    path = PathSpec(speeds=(20.0, 25.0), yaw_rate=0.05)
    drive = simulate_street(2, frames=60, cameras=(), path=path)
    assert imu_motion(drive.scene).bias is None


def test_an_ego_that_stands_is_seen_to_stand_and_gaps_and_odd_samples_are_reported():
    bias = [0.01, -0.004, 0.002]
    times, rates, forces = stationary_signals()
    stationary = find_stationary(times, rates, times, forces)
    assert stationary is not None
    assert stationary.seconds == 4.0
    np.testing.assert_allclose(stationary.rate, bias, atol=3e-4)
    times, rates, forces = stationary_signals(6.0)
    rates[200:300, 2] += 0.03
    stationary = find_stationary(times, rates, times, forces)
    assert stationary is not None
    assert stationary.seconds == 5.0
    np.testing.assert_allclose(stationary.rate, bias, atol=3e-4)
    # samples that never change
    times = np.arange(200) * 10_000_000
    stationary = find_stationary(times, np.full((200, 3), 0.01), times, np.full((200, 3), 5.6))
    assert stationary is not None
    assert stationary.seconds == 2.0
    for rotation, sway, shake in [(0.1, 0.0, 0.0), (0.0, 0.003, 0.0), (0.0, 0.0, 0.03), (0.0, 0.0, 2.0)]:
        times, rates, forces = stationary_signals()
        swing = np.sin(times * 1e-9 * 6)[:, None] * np.ones(3)
        moved = rates + [0, 0, rotation] + sway * swing
        assert find_stationary(times, moved, times, forces + shake * swing) is None
    times, rates, forces = stationary_signals(rate_hz=5)
    assert find_stationary(times, rates, times, forces) is None
    none = np.zeros(0, np.int64), np.zeros((0, 3))
    assert find_stationary(*none, *none) is None
    many = stationary_signals()
    assert find_stationary(many[0], many[1], *none) is None
    times = np.delete(np.arange(100) * 10_000_000, np.r_[30:34, 60:66])
    motion = imu_motion(imu_scene(times, np.zeros((90, 3))))
    assert motion.gaps_ns.tolist() == [[590_000_000, 660_000_000]]
    spans = [(550, 600), (600, 610), (500, 590), (250, 400)]
    assert [motion.is_known(a * 1_000_000, b * 1_000_000) for a, b in spans] == [False, False, True, True]
    assert ("imu-gaps", 1) in [(warning.code, warning.count) for warning in motion.ego.warnings]
    seconds = np.arange(0, 201) / 100.0
    times, rates = (seconds * SECOND).astype(np.int64), swinging_rates(seconds)
    sound = imu_motion(imu_scene(times, rates)).ego.path
    order = np.random.default_rng(0).permutation(201)
    times, rates = (np.append(times[order], [55, times[7]]), np.vstack([rates[order], [[np.nan] * 3, [9.0] * 3]]))
    motion = imu_motion(imu_scene(times, rates))
    np.testing.assert_array_equal(motion.ego.path.quaternions_xyzw, sound.quaternions_xyzw)
    assert ("imu-samples", 2) in [(warning.code, warning.count) for warning in motion.ego.warnings]
    empty = VectorSamples(np.zeros(0, np.int64), np.zeros((0, 3)))
    with pytest.raises(PoseError, match="no IMU"):
        imu_motion(Scene((), source="drive"))
    with pytest.raises(PoseError, match="no gyroscope; it has: accelerometer"):
        imu_motion(Scene((ImuSensor("imu", {"accelerometer": empty}),)))
    with pytest.raises(PoseError, match="0 usable samples"):
        imu_motion(Scene((ImuSensor("imu", {"gyroscope": empty}),)))
    # the first IMU with a gyroscope counts
    scene, other = imu_scene(np.arange(3) * 10, np.zeros((3, 3))), ImuSensor("thermometer", {})
    assert len(imu_motion(replace(scene, sensors=(other, *scene.sensors))).ego.path.timestamps_ns) == 3


def imu_scene(times_ns, rates):
    return Scene((ImuSensor("imu", {"gyroscope": VectorSamples(times_ns, rates)}),), source="drive")


CAMERA_MODEL = Camera("fisheye", 160, 120, 90.0, 90.0, 79.5, 59.5, (0.02, -0.005, 0.001, 0.0))


@dataclass(frozen=True)
class Sky:
    """Brightness by direction: a sum of waves."""

    waves: np.ndarray
    phases: np.ndarray

    @classmethod
    def of(cls, seed):
        draw = np.random.default_rng(seed)
        return cls(draw.normal(0.0, 12.0, (3, 8)), draw.uniform(0, 2 * np.pi, 8))

    def image(self, world_from_camera, rays):
        grey = 127 + 38 * np.sin(world_from_camera.apply(rays) @ self.waves + self.phases).sum(axis=1)
        rows = np.clip(grey, 0, 255).reshape(CAMERA_MODEL.height, CAMERA_MODEL.width)
        return np.repeat(rows[:, :, None], 3, axis=2).astype(np.uint8)


def camera_of(images, times_ns, **more):
    frames = [CameraImage.of(int(t), CAMERA_MODEL, rgb) for t, rgb in zip(times_ns, images, strict=True)]
    return CameraSensor("camera0", CAMERA_MODEL, LazyFrames.of(frames, [int(t) for t in times_ns]), **more)


def swayed(sway, seconds, readout=0.0):
    """Images of a swaying camera, row by row where the shutter rolls, and its rates."""
    body, sky = sway(1, size=0.12, axes=(0.5, 1.0, 0.4)), Sky.of(0)
    v, u = np.mgrid[: CAMERA_MODEL.height, : CAMERA_MODEL.width]
    rays = unproject(CAMERA_MODEL, np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
    fine = np.arange(-0.1, seconds[-1] + 0.2, 0.005)
    rotations = Rotation.from_quat(body.orientations(fine))
    delays = (np.arange(CAMERA_MODEL.height) + 0.5) / CAMERA_MODEL.height * readout - readout / 2
    shown = []
    for at in seconds:
        rows = rotations[np.rint((at + delays - fine[0]) / 0.005).astype(int)]
        quaternions = np.repeat(rows.as_quat(), CAMERA_MODEL.width, axis=0)
        shown.append(sky.image(Rotation.from_quat(quaternions), rays))
    return shown, body.rates(fine), fine


def test_rotations_from_image_to_image_are_those_of_the_camera(sway):
    seconds = np.arange(0.0, 1.0, 0.05)
    images, _, _ = swayed(sway, seconds)
    rotating = camera_rotation(camera_of(images, seconds * 1e9))
    truth = Rotation.from_quat(sway(1, size=0.12, axes=(0.5, 1.0, 0.4)).orientations(seconds))
    found = Rotation.from_quat(rotating.quaternions_xyzw)
    errors = ((truth[:-1].inv() * truth[1:]).inv() * (found[:-1].inv() * found[1:])).magnitude()
    # a hundredth of a pixel, over some hundred corners of 90 pixels' focal length
    assert np.median(errors) < 3e-4
    assert (rotating.chunks == 0).all()


@pytest.mark.parametrize(("readout", "offset"), [(0.0, 0.03), (0.04, -0.2)])
def test_the_offset_of_a_camera_against_a_gyroscope_comes_back(sway, timestamps, readout, offset):
    seconds = np.arange(0.0, 3.0, 0.1)
    images, rates, fine = swayed(sway, seconds, readout)
    calibration = {"calibration": {"shutterRollTimeSeconds": readout}}
    camera = camera_of(images, timestamps(seconds, offset), extras=calibration)
    found = compare_rotations(Orientations.of_rates(timestamps(fine), rates), camera_rotation(camera))
    # 5 ms are asked for; rows of a rolling shutter are 5 ms apart in this test's own steps
    assert found.offset_ns == pytest.approx(offset * 1e9, abs=3e6)


def test_unusable_images_break_the_rotation_near_things_do_not_turn_it_and_random_directions_are_refused(sway):
    seconds = np.arange(0.0, 0.45, 0.05)
    images, _, _ = swayed(sway, seconds)
    images[6] = np.zeros_like(images[6])
    whole = camera_of(images, seconds * 1e9)
    assert np.flatnonzero(np.diff(camera_rotation(whole).chunks)).tolist() == [5, 6]

    def read(k):
        if k == 3:
            raise DataError("data.mp4", "image 3", "is torn")
        return whole.images[k]

    broken = CameraSensor("camera0", CAMERA_MODEL, LazyFrames(whole.images.timestamps_ns[:6], read))
    assert np.flatnonzero(np.diff(camera_rotation(broken).chunks)).tolist() == [2, 3]
    draw = np.random.default_rng(2)
    locations = draw.uniform([-8, -3, 4], [8, 3, 40], (200, 3))
    rotation = Rotation.from_rotvec([0.002, 0.04, -0.003])
    seen = rotation.apply(locations - np.array([0.1, 0.0, 1.0]))
    first, second = (x / np.linalg.norm(x, axis=1)[:, None] for x in (locations, seen))
    second += 2e-4 * draw.standard_normal(second.shape)
    second[:20] = second[20:40]
    found = rotation_between(first, second)
    # trajectory of 1 m past things 4 to 40 m away, directions known to 0.2 mrad, one in ten mistaken
    assert (Rotation.from_matrix(found.rotation).inv() * rotation).magnitude() < 5e-4
    assert found.influences.sum() == pytest.approx(1.0)
    assert not found.agreeing[:20].all()
    draw = np.random.default_rng(3)
    first, second = draw.standard_normal((2, 100, 3))
    first, second = (x / np.linalg.norm(x, axis=1)[:, None] for x in (first, second))
    assert rotation_between(first, second) is None
    assert rotation_between(first[:5], first[:5]) is None
