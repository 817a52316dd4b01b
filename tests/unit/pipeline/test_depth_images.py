"""Depth images of whole drives, also where a lidar or a camera is blind."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sceneloom.cameras.camera import Camera
from sceneloom.colouring.depth_completion import METHODS
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.pipeline.depth_images import write_depth_images
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, camera_mount, inject, simulate_street

CAMERA = Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5)


@pytest.fixture(scope="module")
def drive():
    cameras = (
        CameraSpec(CAMERA, camera_mount()),
        CameraSpec(CAMERA, camera_mount(pitch_deg=-88.0)),  # sees the sky
    )
    return simulate_street(2, frames=3, lidar=LidarSpec(beams=16, steps=180), cameras=cameras)


def depths_of(folder, camera, number):
    with np.load(folder / camera / f"{number:06d}.npz") as arrays:
        return arrays["depth"], arrays["confidence"]


@pytest.mark.parametrize("method", METHODS)
def test_depths_come_near_to_the_truth_where_they_are_sure(drive, tmp_path, method):
    report = write_depth_images(drive.scene, tmp_path / "out", method=method, form="npz")
    assert [(camera.camera, camera.images) for camera in report.cameras] == [("camera0", 3), ("camera1", 3)]
    depths, confidence = depths_of(tmp_path / "out", "camera0", 1)
    truth = drive.truth.depth("camera0", 1)
    sure = confidence > 0.9
    assert sure.mean() > 0.2
    right = np.abs(depths - truth) < np.maximum(0.5, 0.05 * truth)
    assert right[sure].mean() > 0.85


@pytest.mark.parametrize("method", ["sparse", *METHODS])
def test_a_camera_that_sees_no_point_gets_empty_images(drive, tmp_path, method):
    report = write_depth_images(drive.scene, tmp_path / "out", method=method, cameras=["camera1"])
    (camera,) = report.cameras
    assert (camera.filled_percent, camera.images) == (0, 3)
    assert not np.array(Image.open(tmp_path / "out" / "camera1" / "000000.png")).any()
    assert not (tmp_path / "out" / "camera0").exists()


@pytest.mark.parametrize("sensor", ["lidar", "camera0"])
def test_blind_sensors_make_no_depths_out_of_nothing(drive, tmp_path, sensor):
    blind = inject(drive, Faults({sensor: SensorFaults(blind=((0, 10**12),))}, seed=1))
    write_depth_images(blind.scene, tmp_path / "out", form="npz", cameras=["camera0"], images=tmp_path / "look")
    depths, confidence = depths_of(tmp_path / "out", "camera0", 0)
    if sensor == "lidar":
        assert not np.any([depths, confidence])
    else:
        truth = drive.truth.depth("camera0", 0)
        right = np.abs(depths - truth) < np.maximum(0.5, 0.05 * truth)
        assert right[confidence > 0.9].mean() > 0.85
    assert len(list((tmp_path / "look" / "camera0").iterdir())) == 3


def test_a_part_of_the_drive_keeps_the_numbers_that_the_index_reports(drive, tmp_path):
    write_depth_images(drive.scene, tmp_path / "out", method="fast", stop=0.35, cameras=["camera0"])
    lines = [json.loads(line) for line in (tmp_path / "out" / "index.jsonl").read_text().splitlines()]
    assert len(lines) == len(list((tmp_path / "out" / "camera0").glob("*.png"))) < 3
    assert all((tmp_path / "out" / line["file"]).is_file() for line in lines)


def test_values_that_cannot_be_followed_are_refused_before_anything_is_read(drive, tmp_path):
    for options in ({"method": "best"}, {"form": "tiff"}, {"cameras": ["roof"]}, {"images": tmp_path / "out"}):
        with pytest.raises(OptionError):
            write_depth_images(drive.scene, tmp_path / "out", **options)
    with pytest.raises(DataError, match="no lidar"):
        write_depth_images(replace(drive.scene, sensors=()), tmp_path / "out")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    with pytest.raises(OutputError):
        write_depth_images(drive.scene, tmp_path / "full")
    assert not (tmp_path / "out").exists()
