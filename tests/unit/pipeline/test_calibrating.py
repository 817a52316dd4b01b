"""Calibrations checked and written."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.calibrate.extrinsics import moved_by, step_between
from sceneloom.calibrate.frames import calibration_frames
from sceneloom.calibrate.health import Verdict
from sceneloom.cameras.camera import Camera
from sceneloom.db34t.json import format_json, parse_json
from sceneloom.db34t.scene_objects import boxes_2d_record, boxes_3d_record
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.calibrating import Repair, check_drive, form_for, write_calibration
from sceneloom.pipeline.detected_drive import poses_at
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.ego import sensor_source
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

CAMERA_MODEL = Camera("pinhole", 640, 320, 360.0, 360.0, 319.5, 159.5)
SIZE = np.array([4.2, 1.8, 1.5])


@pytest.fixture(scope="module")
def drive():
    """A lidar of few beams and a camera, whose images are of another camera model than boxes are made for."""
    return simulate_street(2, frames=14, lidar=LidarSpec(beams=4, steps=60), cameras=(CameraSpec(CAMERA_MODEL),))


def lists(scene, folder, rotation_deg):
    """Boxes of five cars in each sweep and image; the camera really is rotated from where it is stated to be."""
    lidar, camera = scene.lidars[0], scene.cameras[0]
    times = [frame.reference_ns for frame in lidar.frames]
    timestamps = camera.images.timestamps_ns.tolist()
    sources = [sensor_source(scene, sensor, None, reach_ns=10**9) for sensor in (lidar, camera)]
    locations = poses_at(sources[0], np.array(times)), poses_at(sources[1], np.array(timestamps))
    generator, rotation = np.random.default_rng(5), Rotation.from_rotvec(rotation_deg, degrees=True)
    lines = {"boxes3d": [], "boxes2d": []}
    for k, (time, timestamp) in enumerate(zip(times, timestamps, strict=True)):
        ahead = generator.uniform(12.0, 30.0, 5)
        centers = np.column_stack([ahead, ahead * generator.uniform(-0.5, 0.5, 5), generator.uniform(-1, 0, 5)])
        corners = centers[:, None] + CORNER_SIGNS * SIZE / 2
        seen = rotation.apply((locations[1][k].inverse() @ locations[0][k]).apply(corners.reshape(-1, 3)))
        pixels = (seen[:, :2] / seen[:, 2:] * 360.0 + [319.5, 159.5]).reshape(5, 8, 2) + 0.5
        boxes = np.hstack([pixels.min(axis=1), pixels.max(axis=1)])
        three = Boxes3D(time, centers, np.tile(SIZE, (5, 1)), np.zeros(5), np.ones(5), ("Car",) * 5)
        two = Boxes2D(timestamp, boxes, np.ones(5), ("Car",) * 5)
        lines["boxes3d"].append(format_json(boxes_3d_record(three, sensor_id=0, seq=k)))
        lines["boxes2d"].append(format_json(boxes_2d_record(two, sensor_id=0, seq=k)))
    for name, texts in lines.items():
        (folder / f"{name}.jsonl").write_text("\n".join(texts))
    return {"boxes_3d": [folder / "boxes3d.jsonl"], "boxes_2d": [folder / "boxes2d.jsonl"]}


@pytest.mark.parametrize(
    ("rotation_deg", "verdict"), [((0.0, 0.0, 0.0), Verdict.GOOD), ((2.0, -1.0, 0.0), Verdict.WRONG)]
)
def test_boxes_report_what_images_cannot_and_those_of_a_part_alone(drive, tmp_path, rotation_deg, verdict):
    found = lists(drive.scene, tmp_path, rotation_deg)
    health = check_drive(drive.scene, most=2, **found).health
    assert health.item("rotation").verdict is Verdict.UNDETERMINED
    assert health.verdict is verdict
    # boxes of whole pixels, at 6 pixels a degree; a sigma is 0.12
    np.testing.assert_allclose(health.item("boxes").values, rotation_deg[:2], atol=0.2)
    health = check_drive(drive.scene, most=2, stop=0.5, **found).health
    assert health.item("boxes").verdict is Verdict.UNDETERMINED, "five images are too few"
    with pytest.raises(OptionError, match="boxes of images alone"):
        check_drive(drive.scene, boxes_2d=found["boxes_2d"])


@pytest.mark.parametrize(("tilt_deg", "verdict"), [(0.0, Verdict.GOOD), (8.0, Verdict.WRONG)])
@pytest.mark.few(1)
def test_a_drive_that_rotations_reports_a_camera_that_is_tilted(tilt_deg, verdict):
    camera_model = Camera("pinhole", 320, 120, 180.0, 180.0, 159.5, 59.5)
    scene = simulate_street(2, frames=30, lidar=LidarSpec(beams=4, steps=60), cameras=(CameraSpec(camera_model),)).scene
    (camera,) = scene.cameras
    tilt = RigidTransform(Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix(), np.zeros(3))
    tilted = replace(camera, mount=camera.mount @ tilt)
    scene = replace(scene, sensors=tuple(tilted if one is camera else one for one in scene.sensors))
    item = check_drive(scene, most=1, motion=True).health.item("motion")
    assert item.verdict is verdict
    # twice what the measure gets wrong by itself, the sign that of the change that puts it right
    np.testing.assert_allclose(item.values, [tilt_deg, 0.0], atol=1.0)


STEP = np.array([0.01, 0.02, -0.01, 0.05, 0.02, 0.03])


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A small recording."""
    drive = simulate_street(1, frames=3, lidar=LidarSpec(beams=8, steps=200), cameras=[CameraSpec()])
    folder = tmp_path_factory.mktemp("drive") / "drive"
    sceneloom.write(drive.scene, folder)
    return folder


def repair_of(scene):
    frame = calibration_frames(scene, most=1)[0]
    camera_model = replace(frame.camera, fx=frame.camera.fx * 1.01, fy=frame.camera.fy * 1.01)
    repaired = moved_by(frame.camera_from_lidar, STEP)
    return Repair(frame.camera_id, frame.lidar_id, frame.camera_from_lidar, repaired, camera_model, 0.02)


def test_a_recording_has_the_repaired_mounting_and_camera_model_and_a_scene_file_the_difference(recording, tmp_path):
    repaired = tmp_path / "repaired"
    shutil.copytree(recording, repaired)
    with sceneloom.open(recording) as scene:
        repair = repair_of(scene)
        write_calibration(scene, repair, repaired / "calibration.json", overwrite=True)
        write_calibration(scene, repair, tmp_path / "out.sfs")
    with sceneloom.open(repaired) as scene:
        frame = calibration_frames(scene, most=1)[0]
    np.testing.assert_allclose(step_between(frame.camera_from_lidar, repair.repaired), 0.0, atol=1e-9)
    assert frame.camera == repair.camera
    entry = json.loads((repaired / "calibration.json").read_text())["cameras"][0]
    assert entry["imuToCameraShiftSeconds"] == pytest.approx(0.02)
    with sceneloom.open(tmp_path / "out.sfs") as scene:
        annotation = scene.annotations[-1]
        assert (annotation.type, annotation.time_offset_ns) == ("camera_calibration", 20_000_000)
        assert annotation.intrinsics.fx == pytest.approx(repair.camera.fx)
        # world_from_camera' = world_from_camera D, so camera'_from_lidar = D⁻¹ camera_from_lidar
        pose = np.concatenate([annotation.poses.positions[0], annotation.poses.quaternions_xyzw[0]])
    difference = repair.stated @ repair.repaired.inverse()
    np.testing.assert_allclose(pose, [*difference.translation, *difference.quaternion_xyzw], atol=1e-9)


def test_table_3_holds_the_repaired_transform_by_columns_and_a_lidar_alone_is_mounted_anew(recording, tmp_path):
    calibration, pair = tmp_path / "calibration.json", tmp_path / "pair.json"
    with sceneloom.open(recording) as scene:
        repair = repair_of(scene)
        write_calibration(scene, repair, pair)
        text = pair.read_bytes()
        with pytest.raises(OutputError, match="exists already"):
            write_calibration(scene, repair, pair)
        assert pair.read_bytes() == text
        with pytest.raises(DataError, match=r"calibration\.json"):
            write_calibration(replace(scene, source="nowhere"), repair, calibration)
        with pytest.raises(OptionError, match=r"expected NAME\.sfs"):
            form_for(tmp_path / "calibration.yaml", None)
        record = parse_json(text)
        matrix = np.reshape(record.extrinsic_matrix, (4, 4)).T
        np.testing.assert_allclose(matrix, repair.repaired.matrix, atol=1e-12)
        assert record.intrinsic_matrix[0] == pytest.approx(repair.camera.fx)
        mount = scene.lidars[0].mount
        repair = Repair(None, scene.lidars[0].id, mount, moved_by(mount, STEP))
        write_calibration(scene, repair, calibration)
        with pytest.raises(OptionError, match="camera and a lidar"):
            write_calibration(scene, repair, tmp_path / "other.json")
    entry = json.loads(calibration.read_text())["lidars"][0]
    np.testing.assert_allclose(np.linalg.inv(entry["imuToLidar"]), repair.repaired.matrix, atol=1e-9)
