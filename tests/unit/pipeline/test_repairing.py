"""A repaired calibration in each of its forms, read back by those who read such files."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.calibrate.extrinsics import moved_by, step_between
from sceneloom.calibrate.frames import calibration_frames
from sceneloom.db34t.json import parse_json
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.pipeline.calibrating import Repair, form_for, write_calibration
from sceneloom.scene import Scene
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

STEP = np.array([0.01, 0.02, -0.01, 0.05, 0.02, 0.03])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small recording."""
    drive = simulate_street(1, frames=3, lidar=LidarSpec(beams=8, steps=200), cameras=[CameraSpec()])
    folder = tmp_path_factory.mktemp("drive") / "drive"
    sceneloom.write(drive.scene, folder)
    return folder


def repair_of(scene: Scene) -> Repair:
    frame = calibration_frames(scene, most=1)[0]
    camera_model = replace(frame.camera, fx=frame.camera.fx * 1.01, fy=frame.camera.fy * 1.01)
    repaired = moved_by(frame.camera_from_lidar, STEP)
    return Repair(frame.camera_id, frame.lidar_id, frame.camera_from_lidar, repaired, camera_model, 0.02)


def test_a_recording_with_the_new_calibration_has_the_repaired_mounting_and_camera_model(
    recording: Path, tmp_path: Path
) -> None:
    repaired = tmp_path / "repaired"
    shutil.copytree(recording, repaired)
    with sceneloom.open(recording) as scene:
        repair = repair_of(scene)
        write_calibration(scene, repair, repaired / "calibration.json", overwrite=True)
    with sceneloom.open(repaired) as scene:
        frame = calibration_frames(scene, most=1)[0]
    np.testing.assert_allclose(step_between(frame.camera_from_lidar, repair.repaired), 0.0, atol=1e-9)
    assert frame.camera == repair.camera
    entry = json.loads((repaired / "calibration.json").read_text())["cameras"][0]
    assert entry["imuToCameraShiftSeconds"] == pytest.approx(0.02)


def test_a_scene_file_carries_the_difference_as_an_annotation(recording: Path, tmp_path: Path) -> None:
    with sceneloom.open(recording) as scene:
        repair = repair_of(scene)
        write_calibration(scene, repair, tmp_path / "out.sfs")
    with sceneloom.open(tmp_path / "out.sfs") as scene:
        annotation = scene.annotations[-1]
        assert annotation.type == "camera_calibration"
        assert annotation.time_offset_ns == 20_000_000
        assert annotation.intrinsics.fx == pytest.approx(repair.camera.fx)
        # world_from_camera' = world_from_camera D, so camera'_from_lidar = D⁻¹ camera_from_lidar
        pose = np.concatenate([annotation.poses.positions[0], annotation.poses.quaternions_xyzw[0]])
    difference = repair.stated @ repair.repaired.inverse()
    np.testing.assert_allclose(pose[:3], difference.translation, atol=1e-9)
    np.testing.assert_allclose(pose[3:], difference.quaternion_xyzw, atol=1e-9)


def test_table_3_holds_the_repaired_transform_by_columns(recording: Path, tmp_path: Path) -> None:
    with sceneloom.open(recording) as scene:
        repair = repair_of(scene)
        write_calibration(scene, repair, tmp_path / "pair.json")
    record = parse_json((tmp_path / "pair.json").read_bytes())
    matrix = np.reshape(record.extrinsic_matrix, (4, 4)).T
    np.testing.assert_allclose(matrix, repair.repaired.matrix, atol=1e-12)
    assert record.intrinsic_matrix[0] == pytest.approx(repair.camera.fx)


def test_a_lidar_alone_is_mounted_anew_in_the_calibration(recording: Path, tmp_path: Path) -> None:
    with sceneloom.open(recording) as scene:
        mount = scene.lidars[0].mount
        repair = Repair(None, scene.lidars[0].id, mount, moved_by(mount, STEP))
        write_calibration(scene, repair, tmp_path / "calibration.json")
        with pytest.raises(OptionError, match="camera and a lidar"):
            write_calibration(scene, repair, tmp_path / "pair.json")
    entry = json.loads((tmp_path / "calibration.json").read_text())["lidars"][0]
    np.testing.assert_allclose(np.linalg.inv(entry["imuToLidar"]), repair.repaired.matrix, atol=1e-9)


def test_what_cannot_be_written_is_refused(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"expected NAME\.sfs"):
        form_for(tmp_path / "calibration.yaml", None)
    with sceneloom.open(recording) as scene:
        repair = repair_of(scene)
        (tmp_path / "pair.json").write_text("kept")
        with pytest.raises(OutputError, match="exists already"):
            write_calibration(scene, repair, tmp_path / "pair.json")
        assert (tmp_path / "pair.json").read_text() == "kept"
        with pytest.raises(DataError, match=r"calibration\.json"):
            write_calibration(replace(scene, source="nowhere"), repair, tmp_path / "calibration.json")
