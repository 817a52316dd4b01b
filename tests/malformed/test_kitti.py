"""KITTI's folders with files cut off, emptied, gone or full of something else: a fault with its file, nothing else."""

import random
from contextlib import suppress

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.errors import SceneloomError
from sceneloom.formats import open_scene, write_scene
from sceneloom.scene import LabeledPoints, LabeledPointsAnnotation, Scene
from sceneloom.simulate import CameraSpec, ImuSpec, LidarSpec, camera_mount, simulate_street

FORMATS = ("kitti-raw", "kitti-object", "kitti-tracking", "kitti-odometry")
LONG = ("kitti-raw", "kitti-tracking")
"""Formats with many kinds of files."""

DAMAGES = {
    "cut": lambda content, chance: content[: chance.randrange(len(content) + 1)],
    "empty": lambda content, chance: b"",
    "noise": lambda content, chance: bytes(chance.randrange(256) for _ in range(64)),
    "flipped": lambda content, chance: bytes(
        byte ^ (1 << chance.randrange(8)) if chance.random() < 0.02 else byte for byte in content
    ),
    "wordy": lambda content, chance: content.replace(b"0", b"zero ", 3),
    "longer": lambda content, chance: content + content[:37],
}


@pytest.fixture(scope="module")
def drive():
    """A small drive with something in each kind of file."""
    camera = CameraSpec(Camera("pinhole", 48, 16, 30.0, 30.0, 23.5, 7.5), camera_mount())
    lidar, imu = LidarSpec(beams=4, steps=60), ImuSpec(rate_hz=20.0)
    made = simulate_street(5, frames=2, lidar=lidar, cameras=(camera,), imu=imu).scene
    ids = LabeledPoints("lidar", np.arange(4, dtype=np.uint32), 0)
    road = LabeledPointsAnnotation("road", (ids,), label="road")
    return Scene(made.sensors, annotations=(*made.annotations, road), trajectories=made.trajectories)


def read_all(path, lenient):
    with open_scene(path, lenient=lenient) as scene:
        for lidar in scene.lidars:
            list(lidar.frames)
        for camera in scene.cameras:
            for image in camera.images:
                image.decode()


def one_of_each_kind(files):
    """The first file of each folder and ending."""
    kinds = {}
    for file in files:
        kinds.setdefault((file.parent, file.suffix if file.parent.name == "data" else file.name), file)
    return list(kinds.values())


def harm(drive, name, damages, location):
    """Damage one file after the other; whatever is no fault reported as such is raised."""
    write_scene(drive, location, format=name)
    files = sorted(path.relative_to(location) for path in location.rglob("*") if path.is_file())
    chance = random.Random(name)
    for file in one_of_each_kind(files):
        content = (location / file).read_bytes()
        for damage in damages:
            (location / file).write_bytes(DAMAGES[damage](content, chance))
            for lenient in (False, True):
                with suppress(SceneloomError):
                    read_all(location, lenient)
        (location / file).unlink()
        with suppress(SceneloomError):
            read_all(location, lenient=False)
        (location / file).write_bytes(content)
    read_all(location, lenient=False)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in FORMATS]
)
def test_a_file_that_is_cut_off_or_gone_is_a_fault_or_does_no_harm(drive, name, tmp_path):
    harm(drive, name, ("cut",), tmp_path / "drive")


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_a_fault_or_does_no_harm(drive, name, tmp_path):
    harm(drive, name, tuple(DAMAGES), tmp_path / "drive")
