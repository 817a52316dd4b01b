"""`sceneloom edit undistort` and `sceneloom edit camera model`."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

Call = Callable[..., Any]
BARREL = Camera("brown_conrady", 96, 64, 60.0, 60.0, 47.5, 31.5, (-0.2, 0.03))


@pytest.fixture(scope="module")
def distorted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sweeps and two images of a barrel camera model."""
    folder = tmp_path_factory.mktemp("camera_models") / "drive"
    drive = simulate_street(1, frames=2, lidar=LidarSpec(beams=8, steps=90), cameras=(CameraSpec(BARREL),))
    sceneloom.write(drive.scene, folder, images="png")
    return folder


def test_edit_undistort_writes_pinholes_of_the_size_asked_for(
    call: Call, distorted: Path, tmp_path: Path
) -> None:
    size = ("--size", "48x32", "--keep", "all", "--camera", "camera0")
    outcome = call(
        "edit",
        "undistort",
        distorted,
        "-o",
        tmp_path / "d.sfs",
        *size,
        "--keep",
        "all",
        "--camera",
        "camera0",
    )
    assert outcome.code == 0
    assert f"written: {tmp_path / 'd.sfs'}" in outcome.out
    with sceneloom.open(tmp_path / "d.sfs") as scene:
        camera = scene.cameras[0].camera
        assert (camera.model, camera.width, camera.height) == ("pinhole", 48, 32)
        assert scene.metadata["sceneloom"]["undistorted"][0]["camera"]["coefficients"][0] == -0.2


def test_edit_undistort_refuses_sizes_and_cameras_that_are_none(
    call: Call, distorted: Path, tmp_path: Path
) -> None:
    size = call("edit", "undistort", distorted, "-o", tmp_path / "d.sfs", "--size", "48")
    assert (size.code, "expected width x height in pixels" in size.err) == (2, True)
    strange = call("edit", "undistort", distorted, "-o", tmp_path / "d.sfs", "--camera", "camera9")
    assert (strange.code, "no sensor 'camera9'" in strange.err) == (2, True)


def test_edit_camera_model_reports_how_far_off_the_new_camera_model_is(
    call: Call, distorted: Path, tmp_path: Path
) -> None:
    outcome = call(
        "edit", "camera-model", distorted, "-o", tmp_path / "drive", "--model", "fisheye", "--json"
    )
    assert outcome.code == 0
    warnings = {warning["code"]: warning["message"] for warning in json.loads(outcome.out)["warnings"]}
    assert "brown_conrady camera model reported as fisheye, off by up to" in warnings["camera-model-fitted"]
    with sceneloom.open(tmp_path / "drive") as scene:
        assert scene.cameras[0].camera.model == "fisheye"


def test_edit_camera_model_refuses_what_is_further_off_than_the_limit(
    call: Call, distorted: Path, tmp_path: Path
) -> None:
    outcome = call(
        "edit", "camera-model", distorted, "-o", tmp_path / "d.sfs", "--model", "pinhole", "--limit", "0.5"
    )
    assert (outcome.code, "expected at most 0.5 px" in outcome.err) == (1, True)
    assert not (tmp_path / "d.sfs").exists()
