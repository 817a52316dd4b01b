"""The check of a calibration on simulated drives whose truth is known, and on what can go wrong."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames
from sceneloom.calibrate.health import CalibrationHealth, Verdict, check_frames, views_of
from sceneloom.calibrate.measures import Change
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, LidarSpec, SimulatedDrive, simulate_street

Frames = tuple[CalibrationFrame, ...]
AHEAD = Camera("pinhole", 620, 188, 360.0, 360.0, 309.5, 93.5)


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    """Two seconds through a street, seen by a lidar and a camera of half the usual size."""
    return simulate_street(31, frames=25, lidar=LidarSpec(beams=48, steps=1000), cameras=(CameraSpec(AHEAD),))


@pytest.fixture(scope="module")
def frames(drive: SimulatedDrive) -> Frames:
    """Four images of it, more than half a second apart."""
    return calibration_frames(drive.scene, most=4)


@pytest.fixture(scope="module")
def good(frames: Frames) -> CalibrationHealth:
    """What is stated for the true calibration."""
    return check_frames(frames)


def rotated(frames: Frames, rotation_deg: tuple[float, float, float]) -> Frames:
    """Frames whose stated camera is rotated from the true one."""
    error = Change.rotation(np.radians(rotation_deg)).camera_from_lidar(np.eye(4))
    return tuple(
        replace(frame, camera_from_lidar=RigidTransform.nearest(error)[0] @ frame.camera_from_lidar)
        for frame in frames
    )


def repainted(frames: Frames, paint: Callable[[np.ndarray], np.ndarray]) -> Frames:
    """Frames with other images."""
    painted = [paint(frame.rgb).astype(np.uint8) for frame in frames]
    return tuple(
        replace(frame, rgb=rgb, grey=rgb.mean(axis=2, dtype=np.float32))
        for frame, rgb in zip(frames, painted, strict=True)
    )


def thinned(frames: Frames, keep: slice) -> Frames:
    """Frames with some of their points only, whose order is not known."""
    return tuple(
        replace(
            frame,
            points_lidar=np.ascontiguousarray(frame.points_lidar[keep]),
            intensities=None if frame.intensities is None else frame.intensities[keep],
            seconds=None if frame.seconds is None else frame.seconds[keep],
            scan=None,
        )
        for frame in frames
    )


def test_a_true_calibration_is_good(good):
    assert good.verdict is Verdict.GOOD
    rotation = good.item("rotation")
    # what is found lies within what is stated for its uncertainty
    assert np.linalg.norm(np.array(rotation.values) / rotation.sigmas) < 3.0
    assert good.stated_distinctness > 4.5


def test_a_camera_rotated_by_a_degree_is_not_good_and_the_rotation_is_found(frames):
    injected = np.array([0.7, -0.5, 0.5])
    health = check_frames(rotated(frames, tuple(injected)))
    assert health.verdict in {Verdict.DRIFTING, Verdict.WRONG}
    # 0.3 degrees: twice the uncertainty of each axis
    assert np.linalg.norm(np.array(health.item("rotation").values) + injected) < 0.3


@pytest.mark.parametrize(
    "rotation_deg",
    [(0.0, 0.0, 180.0), (0.0, 180.0, 0.0), (25.0, 0.0, 0.0)],
    ids=["upside-down", "backwards", "up"],
)
@pytest.mark.few(1)
def test_a_camera_that_looks_elsewhere_is_never_good(frames, rotation_deg):
    assert check_frames(rotated(frames, rotation_deg)).verdict in {Verdict.WRONG, Verdict.UNDETERMINED}


@pytest.mark.parametrize(
    ("paint", "word"),
    [
        (np.zeros_like, "dark"),
        (lambda rgb: rgb // 64, "dark"),
        (lambda rgb: np.full_like(rgb, 120), "covered"),
    ],
    ids=["black", "night", "covered"],
)
def test_images_that_show_nothing_state_nothing(frames, paint, word):
    health = check_frames(repainted(frames, paint))
    assert health.verdict is Verdict.UNDETERMINED
    assert all(item.verdict is Verdict.UNDETERMINED for item in health.items)
    assert word in health.item("rotation").reason


def test_images_of_noise_state_nothing(frames):
    generator = np.random.default_rng(1)
    health = check_frames(repainted(frames, lambda rgb: generator.integers(0, 256, rgb.shape)))
    assert health.verdict is Verdict.UNDETERMINED


def test_images_of_another_street_state_nothing(frames):
    mirrored = repainted(frames, lambda rgb: np.roll(rgb[:, ::-1], 97, axis=1))
    assert check_frames(mirrored).verdict is Verdict.UNDETERMINED


def test_something_that_fills_the_view_states_nothing(frames):
    """A lorry of one colour right before the camera, and the lidar sees its flat side."""
    filled = []
    for frame in repainted(frames, lambda rgb: np.full_like(rgb, 90)):
        points = frame.camera_from_lidar.apply(frame.points_lidar)
        ahead = points[:, 2] > 3.0
        points[ahead] *= 3.0 / points[ahead, 2:]
        filled.append(replace(frame, points_lidar=frame.camera_from_lidar.inverse().apply(points), scan=None))
    assert check_frames(filled).verdict is Verdict.UNDETERMINED


@pytest.mark.parametrize("count", [0, 1, 20])
def test_clouds_of_hardly_any_points_state_nothing(frames, count):
    health = check_frames(thinned(frames, slice(count)))
    assert health.verdict is Verdict.UNDETERMINED
    assert "points fall into" in health.item("rotation").reason


def test_a_camera_that_sees_no_point_states_nothing(frames):
    lifted = tuple(replace(f, points_lidar=f.points_lidar + np.array([0.0, 0.0, 500.0])) for f in frames)
    health = check_frames(lifted)
    assert health.verdict is Verdict.UNDETERMINED
    assert health.item("rotation").reason.startswith("0 points")


def test_images_seconds_late_are_never_good(frames):
    late = tuple(
        replace(frame, rgb=later.rgb, grey=later.grey)
        for frame, later in zip(frames[:-2], frames[2:], strict=True)
    )
    assert (frames[2].image_ns - frames[0].image_ns) > 1_000_000_000
    assert check_frames(late).verdict in {Verdict.WRONG, Verdict.UNDETERMINED}


def test_frames_from_one_location_are_one_view(frames):
    assert views_of((frames[0],) * 3).tolist() == [0, 0, 0]
    assert views_of(frames).max() >= 1
    unplaced = tuple(replace(frame, world_from_lidar=None) for frame in frames)
    assert views_of(unplaced).tolist() == [0] * len(frames)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40, 52))
def test_over_many_streets_truth_is_good_and_what_is_off_is_not(seed):
    drive = simulate_street(seed, frames=60)
    frames = calibration_frames(drive.scene, most=8)
    assert check_frames(frames).verdict is not Verdict.WRONG
    direction = np.random.default_rng(seed).normal(size=3)
    injected = direction / np.linalg.norm(direction)
    assert check_frames(rotated(frames, tuple(injected))).verdict in {Verdict.DRIFTING, Verdict.WRONG}
