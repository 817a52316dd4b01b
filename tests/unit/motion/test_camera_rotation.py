"""How cameras rotate, from images of a painted sky whose every brightness is a formula."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras import Camera, unproject
from sceneloom.errors import DataError
from sceneloom.motion.camera_rotation import camera_rotation, rotation_between
from sceneloom.motion.clock.comparison import compare_rotations
from sceneloom.motion.clock.signals import Orientations
from sceneloom.scene import CameraImage, CameraSensor, LazyFrames

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


def test_a_black_image_and_one_that_cannot_be_read_break_the_rotation(sway):
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


def test_what_is_near_does_not_rotate_the_camera_and_directions_that_agree_in_nothing_are_refused():
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
