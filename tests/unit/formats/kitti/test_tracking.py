"""Sequences of KITTI's tracking benchmark as scenes, and its folders of detections."""

import shutil

import numpy as np
import pytest
from PIL import Image

import sceneloom
from sceneloom.errors import DataError, OptionError
from sceneloom.formats import open_scene
from sceneloom.formats.base.registry import drives_of
from sceneloom.formats.kitti.tracking_reader import is_tracking_folder, open_tracking_folder
from sceneloom.scene import ScoreForm

R = "1 0 0 0 1 0 0 0 1"
IMU = "1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8"
VELODYNE = "0 -1 0 0 0 0 -1 {} 1 0 0 {}"
CALIBRATION = f"P2: 48 0 17 2.88 0 48 13 0.5 0 0 1 0.003\nR_rect {R}\nTr_velo_cam {VELODYNE.format(-0.08, -0.27)}\n"
CALIBRATION += f"Tr_imu_velo {IMU}\n\n"
OXTS = "49.0 8.0 110.0 0 0 {yaw}" + " 0" * 24 + "\n"
ROW = "{frame} {track} Car 0 1 -1.5 5 6 20 18 1.5 1.6 4.0 {x} 1.7 12.0 0.8\n"
LABELS = "".join(ROW.format(frame=k, track=4, x=k) for k in (0, 1, 3)) + ROW.format(frame=1, track=9, x=5)


@pytest.fixture
def folder(tmp_path):
    for name, text in {"calib": CALIBRATION, "oxts": OXTS.format(yaw=0) * 4, "label_02": LABELS}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "0002.txt").write_text(text)
    (tmp_path / "image_02/0002").mkdir(parents=True)
    (tmp_path / "velodyne/0002").mkdir(parents=True)
    for k in (0, 1, 3):
        Image.new("RGB", (36, 28)).save(tmp_path / "image_02/0002" / f"{k:06d}.png")
        np.full((2, 4), k, np.float32).tofile(tmp_path / "velodyne/0002" / f"{k:06d}.bin")
    return tmp_path


def test_tracks_are_boxes_over_time_with_their_numbers_as_ids(folder):
    scene = open_scene(folder)
    assert scene.format == "kitti-tracking"
    four, nine = scene.annotations
    assert (four.id, nine.id) == (4, 9)
    assert four.path.timestamps_ns.tolist() == [0, 100_000_000, 300_000_000]
    assert four.projections[0].sensor_id == "camera2"
    assert {a.name for a in four.attributes} == {"truncated", "occluded", "alpha"}
    # the middle of the box is 12 m before the camera and 0.95 m below it: the ego is 0.27 + 0.8 m behind, 0.3 m aside
    np.testing.assert_allclose(four.path.values[0, 3:6], [12 + 0.27 + 0.8, -0.3, 0.8 - 0.08 - 0.95], atol=1e-9)
    frames = scene.sensor("velodyne").frames  # their numbers state which frames they are
    assert frames.timestamps_ns.tolist() == [0, 100_000_000, 300_000_000]
    assert frames[2].points.positions[0, 0] == 3


def test_several_sequences_are_listed_and_one_can_be_chosen(folder):
    (folder / "oxts/0005.txt").write_text(OXTS.format(yaw=0))
    (folder / "calib/0005.txt").write_text(CALIBRATION)
    with pytest.raises(OptionError, match=r"has several sequences: 0002, 0005; choose one with `--sequence NAME`"):
        open_scene(folder)
    assert drives_of(folder) == ("0002", "0005")
    assert open_scene(folder, sequence="5").source.endswith("/0005")
    with pytest.raises(OptionError, match=r"sequence '7': .* has 0002, 0005"):
        open_scene(folder, sequence="7")


def test_without_oxts_boxes_are_placed_as_if_the_ego_stood_and_beyond_it_left_out(folder):
    (folder / "oxts/0002.txt").write_text(OXTS.format(yaw=0) * 2)
    scene = open_scene(folder)
    assert scene.annotations[0].path.timestamps_ns.tolist() == [0, 100_000_000]
    assert {n.code: n.count for n in scene.warnings}["boxes-beyond-trajectory"] == 1
    (folder / "oxts/0002.txt").unlink()
    scene = open_scene(folder)
    assert list(scene.trajectories) == ["stationary"]
    assert "ego-stands" in [n.code for n in scene.warnings]


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("label_02", ROW.format(frame=0, track=4, x=0) * 2, "frame 0: track 4 stands in it twice"),
        ("label_02", "0 4 Car 0 1\n", "line 1: 5 values; expected 17 or 18"),
        ("calib", "P2: 1 0 0\n", "line 1: 4 values; expected 13"),
        ("oxts", "1 2\n", "line 1: 2 values; expected 30"),
    ],
)
def test_a_fault_is_reported_with_its_location(folder, name, text, problem):
    (folder / name / "0002.txt").write_text(text)
    with pytest.raises(DataError) as caught:
        open_scene(folder)
    assert problem in str(caught.value)
    (folder / "calib/0002.txt").unlink()
    with pytest.raises(DataError, match=r"without calibration: expected .*/calib/0000.txt for each"):
        open_scene(folder)


P2 = "7.070493e+02 0 6.0e+02 3.5e+01 0 7.070493e+02 1.8e+02 7.0e-01 0 0 1 0"
VELODYNE = VELODYNE.format(-0.1, -0.3)
TRACKING = f"P2: {P2}\nR_rect {R}\nTr_velo_cam {VELODYNE}\nTr_imu_velo {IMU}\n\n"
OBJECT = f"P2: {P2}\nR0_rect: {R}\nTr_velo_to_cam: {VELODYNE}\nTr_imu_to_velo: {IMU}\n"
"""The same calibration as the object benchmark spells it."""
CAR_2D, PEDESTRIAN_2D = "det2d_a__Car__0007", "det2d_a__Pedestrian__0007"
CAR_3D, PEDESTRIAN_3D = "det3d_b__Car__0007", "det3d_b__Pedestrian__0007"
GOOD_3D = "2,2,0,0,9,9,-1.5,1.5,1.6,4.0,2.0,1.5,10.0,0.0,0.2"
FILES = {
    "calib__0007": TRACKING,
    "oxts__0007": "".join(OXTS.format(yaw=0.1 * k) for k in range(4)) + "\n",
    CAR_2D: "0,10,20,110,220,0.75\n2,1,2,3,4,0.5\n",
    PEDESTRIAN_2D: "",
    CAR_3D: f"{GOOD_3D}\n",
    PEDESTRIAN_3D: "2,1,0,0,9,9,3.5,1.8,0.6,0.8,-1.0,1.5,8.0,-1.5707963,0.2\n",
}


@pytest.fixture
def tracking_folder(tmp_path):
    """Write a folder of detections, some of its files replaced or, with None, left out."""

    def write(**changed):
        folder = tmp_path / "drive"
        for name, text in (FILES | changed).items():
            if text is not None:
                path = folder / f"{name.replace('__', '/')}.txt"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
        return folder

    return write


def sequence(folder, **options):
    return open_tracking_folder(folder, **options).sequence("0007")


def test_boxes_stand_in_images_from_their_corner_and_in_the_lidars_frame_with_their_middles(tracking_folder):
    found = sequence(tracking_folder())
    assert found.timestamps_ns.tolist() == [0, 100_000_000, 200_000_000, 300_000_000]  # as many as lines of oxts
    assert found.warnings == ()
    boxes = found.boxes_2d(0)
    assert boxes.corners_xyxy.tolist() == [[10.5, 20.5, 110.5, 220.5]]
    assert (boxes.scores.tolist(), boxes.labels, boxes.score_form) == ([0.75], ("Car",), ScoreForm.PROBABILITY)
    assert (len(found.boxes_2d(1)), len(found.boxes_3d(1)), found.boxes_3d(3).timestamp_ns) == (0, 0, 300_000_000)
    boxes = found.boxes_3d(2)
    # by hand: camera (x, y, z) = (-Y, -Z - 0.1, X - 0.3); KITTI's y is that of the bottom, y points down
    np.testing.assert_allclose(boxes.centers, [[10.3, -2.0, -0.85], [8.3, 1.0, -0.7]], atol=1e-12)
    assert boxes.sizes_lwh.tolist() == [[4.0, 1.6, 1.5], [0.8, 0.6, 1.8]]
    # ry 0 heads along the camera's x, which is the lidar's -y; ry -90° along its z, which is the lidar's x
    np.testing.assert_allclose(boxes.yaws, [-np.pi / 2, 0.0], atol=1e-7)
    assert (boxes.labels, boxes.score_form) == (("Car", "Pedestrian"), ScoreForm.LOGIT)
    assert boxes.scores.tolist() == [-1.5, 3.5]
    trajectory = found.world_from_ego  # counter-clockwise from east
    np.testing.assert_allclose(trajectory.quaternions_xyzw[3], [0, 0, np.sin(0.15), np.cos(0.15)], atol=1e-12)
    assert np.abs(trajectory.positions).max() < 1e-6  # the unit is stationary


def test_the_fourth_column_of_the_projection_is_a_shift_of_the_camera_and_both_spellings_mean_the_same(tracking_folder):
    found = sequence(tracking_folder())
    point = np.array([20.0, 3.0, -1.0])
    x, y, z = found.camera_from_lidar.apply(point)
    camera_model = found.camera
    # the oracle is the projection as KITTI writes it: P2 R_rect Tr_velo_cam of the homogeneous point
    rectified = np.array([-point[1], -point[2] - 0.1, point[0] - 0.3, 1.0])
    u, v, w = np.array([[707.0493, 0, 600, 35], [0, 707.0493, 180, 0.7], [0, 0, 1, 0]]) @ rectified
    pixel = camera_model.fx * x / z + camera_model.cx, camera_model.fy * y / z + camera_model.cy
    assert pixel == pytest.approx((u / w, v / w), abs=1e-9)
    other = sequence(tracking_folder(calib__0007=OBJECT))
    for name in ("camera_from_lidar", "lidar_from_imu"):
        np.testing.assert_array_equal(getattr(found, name).matrix, getattr(other, name).matrix)


@pytest.mark.parametrize(
    ("changed", "code", "count", "frames", "in_first"),
    [
        ({"oxts__0007": None}, "no-oxts", 1, 3, 1),
        ({"oxts__0007": ""}, "no-oxts", 1, 3, 1),
        ({PEDESTRIAN_2D: None, CAR_2D: None, "det2d_a__Car__0009": ""}, "no-detections", 1, 4, 0),
        ({PEDESTRIAN_3D: None, "det3d_b__Pedestrian__0009": ""}, "no-detections", 1, 4, 1),
        ({PEDESTRIAN_2D: None}, "one-detector", 1, 4, 1),
        ({CAR_2D: "0,5,5,5,9,0.5\n0,5,9,9,5,0.5\n0,1,1,2,2,0.5\n"}, "boxes-without-area", 2, 4, 1),
        ({CAR_2D: "9,10,20,110,220,0.75\n"}, "oxts-short", 1, 10, 0),
    ],
)
def test_what_is_missing_or_odd_is_reported_and_the_rest_is_read(
    tracking_folder, changed, code, count, frames, in_first
):
    found = sequence(tracking_folder(**changed))
    (reported,) = found.warnings
    assert (reported.code, reported.count, found.frame_count) == (code, count, frames)
    assert code != "one-detector" or reported.location == "0007: Pedestrian"
    assert len(found.boxes_2d(0)) == in_first
    assert found.boxes_2d(2).labels + found.boxes_3d(2).labels != ()
    assert found.world_from_ego is None if code == "no-oxts" else len(found.world_from_ego.timestamps_ns) == 4


def test_one_of_several_detectors_is_chosen_and_without_any_or_a_calibration_the_folder_is_refused(tracking_folder):
    folder = tracking_folder(det2d_other__Car__0007="0,1,1,2,2,0.5\n")
    with pytest.raises(OptionError, match=r"several detectors: det2d_a, det2d_other; choose one with `--det2d NAME`"):
        open_tracking_folder(folder)
    chosen = open_tracking_folder(folder, detector_2d="other").sequence("0007")
    assert chosen.boxes_2d(0).corners_xyxy.tolist() == [[1.5, 1.5, 2.5, 2.5]]
    with pytest.raises(OptionError, match="detector 'x'"):
        open_tracking_folder(folder, detector_2d="x")
    for name in ("det2d_a", "det2d_other"):
        shutil.rmtree(folder / name)
    tracking = open_tracking_folder(folder)
    assert [warning.code for warning in tracking.warnings] == ["no-detector"]
    assert len(tracking.sequence("0007").boxes_2d(0)) == 0
    (folder / "calib/0007.txt").rename(folder / "kept.txt")
    assert is_tracking_folder(folder)
    with pytest.raises(DataError, match=r"calib: holds no \*.txt; expected a calibration for each sequence"):
        open_tracking_folder(folder)
    (folder / "kept.txt").rename(folder / "calib/0007.txt")
    shutil.rmtree(folder / "det3d_b")
    with pytest.raises(DataError, match="no folder det2d_NAME or det3d_NAME; expected one"):
        open_tracking_folder(folder)


@pytest.mark.parametrize(
    ("file", "text", "reported"),
    [
        (CAR_3D, f"2,9{GOOD_3D[3:]}\n", "line 1: type 9 in the folder Car; the types are"),
        (CAR_2D, "0,10,20,110,220\n", "line 1: 5 values; expected 6: frame,x1,y1,x2,y2,score"),
        (CAR_2D, "0,1,1,2,2,0.5\n0,10,2", "line 2: 3 values"),
        (CAR_2D, "0,1,1,2,2,0.5\n0,car,2,3,4,0.5\n", "line 2: x1 'car'; expected a number"),
        (CAR_2D, "0,1,1,2,nan,0.5\n", "line 1: y2 'nan'"),
        (CAR_2D, "0,1,1,2,1e999,0.5\n", "line 1: y2 '1e999'"),
        (CAR_2D, "-1,1,1,2,2,0.5\n", "line 1: frame '-1'; expected a whole number from 0 to 999999"),
        (CAR_2D, "1e8,1,1,2,2,0.5\n", "line 1: frame '1e8'"),
        (CAR_2D, "0.5,1,1,2,2,0.5\n", "line 1: frame '0.5'"),
        (CAR_2D, "0,1,1,2,2,7.5\n", "line 1: score 7.5; expected a probability"),
        (CAR_3D, GOOD_3D.replace("1.5,1.6", "1.5,-1.6"), "line 1: w -1.6; expected a size above 0"),
        (CAR_3D, GOOD_3D.replace("2,2,0", "2,1,0"), "line 1: type 1 in the folder Car"),
        (CAR_3D, f"{GOOD_3D},1", "line 1: 16 values; expected 15"),
        ("oxts__0007", "49 8 110\n", "line 1: 3 values; expected 30"),
        ("oxts__0007", "91 8" + " 0" * 28, "line 1: latitude 91.0"),
        ("oxts__0007", "49 8" + " 0" * 28 + "\n\n49 8" + " 0" * 28, "line 2: 0 values"),
        ("calib__0007", "P2: 1 2 3\n", "line 1: 3 values|line 1: 4 values; expected 13"),
        ("calib__0007", "P0: 1 0 0 0 0 1 0 0 0 0 1 0\n", "no Tr_velo_cam or Tr_velo_to_cam; it has P0"),
        ("calib__0007", TRACKING.replace(f"R_rect {R}", "R_rect 2 0 0 0 1 0 0 0 1"), "off by 3"),
        ("calib__0007", TRACKING.replace(f"R_rect {R}", "R_rect 1 0 0 0 1 0 0 0 -1"), "off by inf"),
        ("calib__0007", f"{TRACKING}Tr_velo_cam 1 0 0 0 0 1 0 0 0 0 1 0", "is in line 3 already"),
        ("calib__0007", f"{TRACKING}Tr_velo_to_cam: 1 0 0 0 0 1 0 0 0 0 1 0", "expected one of both"),
        ("calib__0007", TRACKING.replace(P2, "0 0 6 0 0 7 1 0 0 0 1 0"), "focal lengths above 0"),
    ],
)
def test_a_faulty_line_is_reported_with_its_location_and_what_was_expected(tracking_folder, file, text, reported):
    folder = tracking_folder(**{file: text})
    with pytest.raises(DataError, match=reported) as caught:
        sequence(folder)
    assert caught.value.file == str(folder / f"{file.replace('__', '/')}.txt")


def test_the_type_reports_the_class_where_the_folder_has_another_name_and_faulty_lines_can_be_left_out(tracking_folder):
    other = {"det3d_b__Car_val__0007": f"{GOOD_3D}\n2,2,0\n{GOOD_3D}\n", "det3d_b__cyclist__0007": ""}
    found = sequence(tracking_folder(**{CAR_3D: None, PEDESTRIAN_3D: None}, **other), lenient=True)
    assert (found.boxes_3d(2).labels, found.classes_3d) == (("Car", "Car"), {"Car", "Cyclist"})
    assert [(n.code, n.count) for n in found.warnings if n.code != "one-detector"] == [("faulty-detections", 1)]


def test_sequences_are_chosen_without_their_zeros_and_each_once_or_reported_with_those_that_are(tracking_folder):
    folder = open_tracking_folder(tracking_folder())
    assert folder.chosen(["7", "0007"]) == folder.chosen([]) == ("0007",)
    with pytest.raises(DataError, match="sequence 0001: is not there; expected one of 0007"):
        folder.sequence("0001")
    with pytest.raises(OptionError, match="sequence '1'"):
        folder.chosen(["7", "1"])


def test_images_report_their_size_else_the_focal_length_else_the_camera_model(tracking_folder):
    def size(folder):
        camera_model = sequence(folder).camera
        return camera_model.width, camera_model.height

    assert size(tracking_folder()) == (1224, 370)
    other = tracking_folder(calib__0007=TRACKING.replace("7.070493e+02", "7.0e+02"))
    assert size(other) == (1201, 361)
    assert [warning.code for warning in sequence(other).warnings] == ["image-size"]
    (other / "image_02" / "0007").mkdir(parents=True)
    head = b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4, "big") + b"IHDR"
    (other / "image_02/0007/000000.png").write_bytes(head + (640).to_bytes(4, "big") + (480).to_bytes(4, "big"))
    assert size(other) == (640, 480)


def test_times_of_frames_are_taken_where_there_are(tracking_folder):
    folder = tracking_folder(times__0007="5.0\n5.1\n5.25\n5.3\n")
    assert sequence(folder).timestamps_ns.tolist() == [5_000_000_000, 5_100_000_000, 5_250_000_000, 5_300_000_000]
    with pytest.raises(DataError, match="3 times for 4 frames"):
        sequence(tracking_folder(times__0007="5.0\n5.1\n5.25\n"))
    with pytest.raises(DataError, match="line 2: is not later"):
        sequence(tracking_folder(times__0007="5.0\n5.0\n5.25\n5.3\n"))


def test_the_camera_is_where_the_calibration_and_the_trajectory_put_it(tracking_folder, tmp_path):
    sequence = open_tracking_folder(tracking_folder()).sequence("0007")
    scene = sequence.scene()
    ego, camera = scene.sensors
    expected = sequence.lidar_from_imu.inverse() @ sequence.camera_from_lidar.inverse()
    assert camera.mount.translation == pytest.approx(expected.translation, abs=1e-9)
    assert ego.poses is sequence.world_from_ego
    sceneloom.write(scene, tmp_path / "sequence.sfs")
    report = sceneloom.validate(tmp_path / "sequence.sfs")
    assert "error" not in {finding.severity for finding in report.findings}
    with sceneloom.open(tmp_path / "sequence.sfs") as read:
        assert (read.cameras[0].camera, len(read.cameras[0].images)) == (sequence.camera, 0)
    (tmp_path / "drive/oxts/0007.txt").unlink()  # without a trajectory, the ego is the lidar
    ego, camera = open_tracking_folder(tmp_path / "drive").sequence("0007").scene().sensors
    assert ego.poses.static
    assert camera.mount.matrix == pytest.approx(sequence.camera_from_lidar.inverse().matrix, abs=1e-12)
