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
from sceneloom.db34t.json import format_json, from_json, parse_json
from sceneloom.db34t.scene_objects import boxes_2d_record, boxes_3d_of, boxes_3d_record
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.kitti.tracking_reader import KittiTracking, open_tracking_folder
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.calibrating import Repair, check_drive, check_sequences, form_for, write_calibration
from sceneloom.pipeline.detected_drive import poses_at
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.ego import sensor_source
from sceneloom.scene.types import PointsFrame
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


def turned(scene, sensor_id, *rotation_deg):
    """The scene with one sensor mounted as if it was rotated."""
    error = RigidTransform(Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix(), np.zeros(3))
    sensors = (replace(s, mount=s.mount @ error) if s.id == sensor_id else s for s in scene.sensors)
    return replace(scene, sensors=tuple(sensors))


@pytest.mark.parametrize("of_lidar", [False, True])
@pytest.mark.few(1)
def test_boxes_judge_the_extrinsics_that_lead_from_their_own_frame_into_the_image(drive, tmp_path, of_lidar):
    files, scene = lists(drive.scene, tmp_path, (0.0, 0.0, 0.0)), drive.scene
    off = turned(scene, scene.lidars[0].id if of_lidar else scene.cameras[0].id, 1.0, -2.0, 0.0)
    assert check_drive(off, most=1, **files).health.verdict is Verdict.WRONG
    # the same boxes as nuScenes states them, in the world
    lidar, results = scene.lidars[0], {}
    source = sensor_source(scene, lidar, None, reach_ns=10**9)
    for record in map(json.loads, files["boxes_3d"][0].read_text().splitlines()):
        (boxes,) = record.values() if len(record) == 1 else (record,)
        results |= nuscenes_sample(boxes_3d_of(from_json("boxes_3d", boxes)), source)
    files["boxes_3d"] = [tmp_path / "results.json"]
    files["boxes_3d"][0].write_text(json.dumps({"results": results}))
    health = check_drive(off, most=1, **files).health
    assert health.verdict is (Verdict.UNDETERMINED if of_lidar else Verdict.WRONG)
    projection = health.item("boxes_projection")
    assert (projection.verdict, projection.judged) == (Verdict.GOOD if of_lidar else Verdict.WRONG, "camera_from_world")
    assert health.item("boxes").verdict is Verdict.UNDETERMINED


def nuscenes_sample(boxes, source):
    """Boxes of a sweep in the world, by their time."""
    (world_from_lidar,) = poses_at(source, np.array([boxes.timestamp_ns], np.int64))
    yaw = Rotation.from_matrix(world_from_lidar.rotation).as_euler("ZYX")[0]
    rows = [
        {
            "translation": center.tolist(),
            "size": size[[1, 0, 2]].tolist(),
            "rotation": [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))],
            "detection_name": "Car",
            "detection_score": 1.0,
        }
        for center, size in zip(world_from_lidar.apply(boxes.centers), boxes.sizes_lwh, strict=True)
    ]
    return {str(boxes.timestamp_ns // 1000): rows}


KITTI = {
    "P2:": [700.0, 0.0, 600.0, 40.0, 0.0, 700.0, 180.0, 0.0, 0.0, 0.0, 1.0, 0.0],
    "R_rect": np.eye(3).ravel().tolist(),
    "Tr_velo_cam": [0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, -0.1, 1.0, 0.0, 0.0, -0.3],
    "Tr_imu_velo": [1.0, 0.0, 0.0, -0.8, 0.0, 1.0, 0.0, 0.3, 0.0, 0.0, 1.0, -0.8],
}


def calibration_text(values):
    return "".join(f"{name} {' '.join(f'{v:.12g}' for v in row)}\n" for name, row in values.items())


def with_turned(values, name, degrees):
    """KITTI's calibration with one entry off; of a projection the principal point, as that many degrees would be."""
    row = np.array(values[name])
    if name == "P2:":
        row[[2, 6]] += row[0] * np.tan(np.radians(degrees))
    else:
        matrix = row.reshape(3, -1)
        row = (Rotation.from_rotvec([0.0, degrees, 0.0], degrees=True).as_matrix() @ matrix).ravel()
    return {**values, name: row.tolist()}


@pytest.mark.parametrize("degrees", [2.0, 20.0])
@pytest.mark.parametrize("name", [None, *KITTI])
def test_lists_of_kitti_judge_p2_and_nothing_that_relates_the_lidar_to_the_camera(tmp_path, name, degrees):
    generator, cube = np.random.default_rng(4), np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, 8).T
    lines_2d, lines_3d = [], []
    p2 = np.reshape(KITTI["P2:"], (3, 4))
    for frame in range(20):
        for depth in generator.uniform(12.0, 30.0, 4):
            center = np.array([depth * generator.uniform(-0.5, 0.5), generator.uniform(0.0, 1.0), depth])
            seen = (center + cube) @ p2[:, :3].T + p2[:, 3]
            pixels = seen[:, :2] / seen[:, 2:]
            corners = ",".join(f"{value:.2f}" for value in (*pixels.min(axis=0), *pixels.max(axis=0)))
            x, y, z = center + np.array([0.0, 1.0, 0.0])
            lines_2d.append(f"{frame},{corners},0.9\n")
            lines_3d.append(f"{frame},2,{corners},3.0,2.0,2.0,2.0,{x:.3f},{y:.3f},{z:.3f},0.0,0.0\n")
    values = KITTI if name is None else with_turned(KITTI, name, degrees)
    texts = {
        "calib/0001.txt": calibration_text(values),
        "oxts/0001.txt": ("0 0" + " 0" * 28 + "\n") * 20,
        "det2d_a/Car/0001.txt": "".join(lines_2d),
        "det3d_b/Car/0001.txt": "".join(lines_3d),
    }
    for file, text in texts.items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(text)
    (health,) = check_sequences(open_tracking_folder(tmp_path))
    off_p2 = name == "P2:"
    assert health.verdict is (Verdict.WRONG if off_p2 and degrees < 5.0 else Verdict.UNDETERMINED)
    # what is good is the camera model, and that alone
    assert {item.judged for item in health.items if item.verdict is Verdict.GOOD} <= {"camera model"}
    assert (health.item("boxes_projection").verdict is Verdict.GOOD) is not off_p2
    reason = health.item("boxes").reason
    assert all(word in reason for word in ("R_rect", "Tr_velo_cam", "Tr_imu_velo", "expected sweeps with images"))


@pytest.fixture(scope="module")
def kitti_sweeps(tmp_path_factory):
    """A street with sweeps and images as a folder of the tracking benchmark, and its calibration."""
    camera = Camera("pinhole", 620, 188, 360.0, 360.0, 309.5, 93.5)
    street = simulate_street(31, frames=25, lidar=LidarSpec(beams=48, steps=1000), cameras=(CameraSpec(camera),))
    folder = tmp_path_factory.mktemp("kitti") / "drive"
    sceneloom.write(street.scene, folder, format="kitti-tracking")
    text = (folder / "training" / "calib" / "0000.txt").read_text()
    entries = (line.split() for line in text.splitlines() if line.strip())
    return folder / "training", {words[0]: [float(word) for word in words[1:]] for words in entries}


@pytest.mark.parametrize("name", [None, "P2:", "R_rect", "Tr_velo_cam", "Tr_imu_velo"])
@pytest.mark.few(2)
def test_sweeps_with_images_judge_what_relates_lidar_and_camera(kitti_sweeps, tmp_path, name):
    folder, values = kitti_sweeps
    (folder / "calib" / "0000.txt").write_text(calibration_text(with_turned(values, name, 2.0) if name else values))
    (health,) = check_sequences(KittiTracking(folder, ("0000",), None, None), most=4)
    assert health.item("ego_from_lidar").verdict is Verdict.UNDETERMINED
    assert "Tr_imu_velo" in health.item("ego_from_lidar").reason
    if name is None:
        assert health.item("rotation").verdict is Verdict.GOOD
    elif name != "Tr_imu_velo":
        assert health.verdict in {Verdict.WRONG, Verdict.DRIFTING, Verdict.UNDETERMINED}
        assert health.item("rotation").verdict is not Verdict.GOOD


def test_points_in_ego_coordinates_judge_the_camera_and_not_the_lidar(drive):
    scene, found = drive.scene, []
    lidar = scene.lidars[0]
    stored = replace(
        scene, sensors=tuple(replace(s, points_frame=PointsFrame.EGO) if s is lidar else s for s in scene.sensors)
    )
    for degrees in (0.0, 20.0):
        off = turned(stored, lidar.id, 0.0, 0.0, degrees)
        (frame,) = calibration_frames(off, most=1)
        found.append(frame.camera_from_lidar.apply(frame.points_lidar))
    np.testing.assert_allclose(*found, atol=1e-4)
    health = check_drive(off, most=1).health
    assert {item.judged for item in health.items} == {"camera_from_ego"}
    assert health.item("ego_from_lidar").verdict is Verdict.UNDETERMINED
    (frame,) = calibration_frames(turned(scene, lidar.id, 0.0, 0.0, 20.0), most=1)
    assert np.abs(frame.camera_from_lidar.apply(frame.points_lidar) - found[0]).max() > 1.0


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
