"""Where sensors sit and look, in words: told so that a wrong extrinsic is seen before anything is fused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.cli.mountings import mounting_text
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CameraSensor, LazyFrames, LidarSensor

LENS = Camera("pinhole", 8, 6, 6.0, 6.0, 3.5, 2.5)
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: the optical frame's right, down and forward on an ego of x ahead, y left, z up."""


def mount(rotation: np.ndarray) -> RigidTransform:
    return RigidTransform.from_quaternion(
        np.array([1.5, -0.25, 2.0]), Rotation.from_matrix(rotation).as_quat()
    )


def camera(rotation: np.ndarray) -> CameraSensor:
    return CameraSensor("c", LazyFrames.of([], []), LENS, mount=mount(rotation))


@pytest.mark.parametrize(
    ("yaw_deg", "words"),
    [(0, "ahead"), (50, "ahead left"), (90, "left"), (-90, "right"), (180, "back"), (-140, "back right")],
)
def test_a_camera_is_told_by_the_way_it_looks(yaw_deg, words):
    turned = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ OPTICAL
    assert mounting_text(camera(turned)) == f"mounted on the ego at (1.50, -0.25, 2.00) m, looks {words}"


def test_an_extrinsic_of_the_wrong_way_shows_itself():
    assert "looks right, lying on its side" in mounting_text(camera(OPTICAL.T))


def test_a_quaternion_of_the_wrong_order_shows_itself():
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix() @ OPTICAL
    assert "looks left" in mounting_text(camera(turned))
    wrong = Rotation.from_quat(np.roll(Rotation.from_matrix(turned).as_quat(), 1)).as_matrix()
    assert "looks left" not in mounting_text(camera(wrong))


@pytest.mark.parametrize(
    ("euler_deg", "words"),
    [((0, 0, 90), "its x axis points left"), ((180, 0, 0), "upside down"), ((90, 0, 0), "lying on its side")],
)
def test_a_lidar_is_told_by_how_it_is_turned(euler_deg, words):
    rotation = Rotation.from_euler("xyz", euler_deg, degrees=True).as_matrix()
    assert mounting_text(LidarSensor("l", LazyFrames.of([], []), mount=mount(rotation))).endswith(
        f", {words}"
    )


def test_a_lidar_that_is_the_ego_says_no_more_than_that():
    sensor = LidarSensor("l", LazyFrames.of([], []), mount=RigidTransform.identity())
    assert mounting_text(sensor) == "mounted on the ego"
    assert mounting_text(LidarSensor("l", LazyFrames.of([], []))) is None


def test_info_tells_where_each_sensor_looks(call: Callable[..., Any], recording: Path) -> None:
    assert "looks ahead" in call("info", recording).out


def test_fuse_remarks_a_camera_that_sees_no_point(
    call: Callable[..., Any], recording: Path, tmp_path: Path
) -> None:
    drive = tmp_path / "drive"
    shutil.copytree(recording, drive)
    calibration = json.loads((drive / "calibration.json").read_text())
    matrix = calibration["cameras"][0]["imuToCamera"]
    matrix[1], matrix[2] = matrix[2], [-number for number in matrix[1]]  # so that it looks at the sky
    (drive / "calibration.json").write_text(json.dumps(calibration))
    assert "looks up" in call("info", drive).out
    outcome = call("fuse", drive, "-o", tmp_path / "a.sfs")
    assert "no point falls into the pictures of camera0" in outcome.err
    assert "no point falls" not in call("fuse", recording, "-o", tmp_path / "b.sfs").err
