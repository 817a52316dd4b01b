"""KITTI's benchmarks of objects, odometry (with SemanticKITTI's labels) and tracking, and its text of labels."""

import shutil

import numpy as np
import pytest
from PIL import Image

import sceneloom
from sceneloom.cameras.projection import project
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats import open_scene
from sceneloom.formats.base.registry import drives_of
from sceneloom.formats.kitti.benchmark_writer import write_labels, write_object_labels
from sceneloom.formats.kitti.labels import read_labels
from sceneloom.formats.kitti.tracking_reader import is_tracking_folder, open_tracking_folder
from sceneloom.geometry.boxes import box_corners
from sceneloom.geometry.rigid import rotate_vectors
from sceneloom.scene import ScoreForm
from sceneloom.scene.annotations_at import cuboid_poses
from sceneloom.scene.poses import PoseSource

CAR = "Car 0 1 -1.50 10.0 20.0 30.0 40.0 1.5 1.6 4.0 2.0 1.5 10.0 0.25"
NOWHERE = "DontCare -1 -1 -10 5 6 7 8 -1 -1 -1 -1000 -1000 -1000 -10"
TRACKED = f"0 3 {CAR}\n0 -1 {NOWHERE}\n4 3 {CAR}\n"


def written(tmp_path, text, name="0001.txt"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_labels_of_tracking_are_read_as_they_stand_and_written_again(tmp_path):
    labels = read_labels(written(tmp_path, TRACKED))
    assert (labels.frames.tolist(), labels.track_ids.tolist()) == ([0, 0, 4], [3, -1, 3])
    assert (labels.types, labels.have_position.tolist()) == (("Car", "DontCare", "Car"), [True, False, True])
    solid = (labels.corners_xyxy[0].tolist(), labels.sizes_hwl[0].tolist(), labels.bottoms[0].tolist())
    assert solid == ([10, 20, 30, 40], [1.5, 1.6, 4.0], [2.0, 1.5, 10.0])  # as in the file, not shifted
    assert (labels.alphas[0], labels.rotations_y[0], labels.occlusions[0], labels.scores) == (-1.5, 0.25, 1, None)
    scored = read_labels(written(tmp_path, TRACKED.replace("\n", " 0.125\n")))
    write_labels(scored.select(scored.have_position), tmp_path / "out.txt")
    back = read_labels(tmp_path / "out.txt")
    np.testing.assert_array_equal(back.bottoms, labels.bottoms[[0, 2]])
    assert back.scores.tolist() == [0.125, 0.125]
    assert len((tmp_path / "out.txt").read_text().splitlines()[0].split()) == 18
    with pytest.raises(OutputError, match="exists already"):
        write_labels(labels, tmp_path / "0001.txt")


def test_labels_of_objects_have_a_file_for_each_frame_whose_name_is_its_number(tmp_path):
    labels = read_labels(written(tmp_path, f"{CAR} 0.5\n{CAR} -2.5\n", "000114.txt"))
    assert (labels.frames.tolist(), labels.track_ids.tolist()) == ([114, 114], [-1, -1])
    assert labels.scores.tolist() == [0.5, -2.5]
    assert len(read_labels(written(tmp_path, "\n"))) == 0
    labels = read_labels(written(tmp_path, TRACKED))
    write_object_labels(labels, tmp_path / "out", frames=range(5))
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [f"{k:06d}.txt" for k in range(5)]
    assert (tmp_path / "out" / "000001.txt").read_text() == ""
    back = read_labels(tmp_path / "out" / "000004.txt")
    assert (back.frames.tolist(), back.types, back.track_ids.tolist()) == ([4], ("Car",), [-1])
    np.testing.assert_array_equal(back.bottoms, labels.bottoms[[2]])


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        (f"0 3 {CAR} 0.5 9\n", "line 1: 19 values; expected 17 or 18"),
        (f"0 3 {CAR}\n1 3 {CAR[:-5]}\n", "line 2: 16 values; expected 17 or 18"),
        (f"0 3 {CAR}\n1 3 {CAR} 0.5\n", "line 2: 18 values where others have 17"),
        (f"0 3 {CAR}\n\n1 3 {CAR}\n", "line 2: 0 values"),
        (f"0 3 {CAR}\n1 x {CAR}\n", "line 2: track 'x'"),
        (f"0 3 {CAR.replace('4.0 2.0', '-4.0 2.0')}\n", "line 1: l -4; expected a size above 0"),
        (f"0 3 {CAR.replace('10.0 20.0', 'nan 20.0')}\n", "line 1: x1 'nan'"),
        (f"{CAR.replace('Car', '7')}\n", "line 1: class '1'; expected a word"),
    ],
)
def test_a_faulty_line_is_reported_with_its_location(tmp_path, text, reported):
    with pytest.raises(DataError, match=reported):
        read_labels(written(tmp_path, text))


CALIBRATIONS = {
    3: {"P2": "48 0 17 2.88 0 48 13 0.5 0 0 1 0.003", "T": "0.01 -0.08 -0.27"},
    7: {"P2": "60 0 20 3.5 0 60 11 0.1 0 0 1 0.002", "T": "0.02 -0.07 -0.33"},
}
R0 = "0.99995 0.01 0 -0.01 0.99995 0 0 0 1"
POINTS = np.array([[12.0, 1.5, -0.6], [20.0, -3.0, 0.4]])
LABEL = "Car 0.25 1 -1.57 5.5 6.5 20.25 18.0 1.5 1.6 4.0 1.0 1.7 12.0 0.8\n"
AROUND = "DontCare -1 -1 -10 1.00 2.00 3.00 4.00 -1 -1 -1 -1000 -1000 -1000 -10\n"


def calibration(frame):
    rows = CALIBRATIONS[frame]
    velo = "0 -1 0 {} 0 0 -1 {} 1 0 0 {}".format(*rows["T"].split())
    unit = "Tr_imu_to_velo: 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8"
    return f"P2: {rows['P2']}\nR0_rect: {R0}\nTr_velo_to_cam: {velo}\n{unit}\n\n"


@pytest.fixture
def frames(tmp_path):
    for frame, size in ((3, (36, 28)), (7, (40, 24))):
        for kind in ("calib", "label_2", "image_2", "velodyne"):
            (tmp_path / "training" / kind).mkdir(parents=True, exist_ok=True)
        (tmp_path / "training/calib" / f"{frame:06d}.txt").write_text(calibration(frame))
        (tmp_path / "training/label_2" / f"{frame:06d}.txt").write_text(LABEL + AROUND)
        Image.new("RGB", size, (frame, 0, 0)).save(tmp_path / "training/image_2" / f"{frame:06d}.png")
        np.full((4, 4), 0.1 * frame, np.float32).tofile(tmp_path / "training/velodyne" / f"{frame:06d}.bin")
    return tmp_path


def rotation():
    u, _, vt = np.linalg.svd(np.array(R0.split(), float).reshape(3, 3))
    return u @ vt


def test_each_frame_has_a_camera_model_mounting_and_labels_of_its_own_and_shares_no_world(frames):
    scene = open_scene(frames)
    assert scene.format == "kitti-object"
    for row, (frame, calibrated) in enumerate(CALIBRATIONS.items()):
        image = scene.sensor("camera2").images[row]
        projection = np.array(calibrated["P2"].split(), float).reshape(3, 4)
        camera = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ POINTS.T
        camera += np.array(calibrated["T"].split(), float)[:, None]
        homogeneous = projection @ np.vstack([rotation() @ camera, np.ones(2)])
        pixels, _ = project(image.camera, image.mount.inverse().apply(POINTS))
        np.testing.assert_allclose(pixels, (homogeneous[:2] / homogeneous[2]).T, atol=1e-9)
        assert image.rgb.shape == ((28, 36, 3), (24, 40, 3))[row]
        assert image.extras["file"] == f"image_2/{frame:06d}.png"
    assert scene.sensor("velodyne").frames.timestamps_ns.tolist() == [0, 10**9]
    assert scene.metadata["kitti"]["numbers"] == [3, 7]
    assert [n.code for n in scene.warnings] == ["frames-apart"]
    assert not scene.trajectories["frames"].positions.any()
    assert [a.id for a in scene.annotations] == ["000003.0", "000003.1", "000007.0", "000007.1"]
    car, around = scene.annotations[:2]
    stated = {a.name: a.values for a in car.attributes}
    assert stated == {"truncated": (0.25,), "occluded": (1,), "alpha": (-1.57,)}
    # the text counts from the centre of the first pixel, boxes here from the image's corner
    assert car.projections[0].boxes.tolist() == [[6.0, 7.0, 14.75, 11.5]]
    assert (around.label, around.type, around.attributes) == ("DontCare", "box_2d", ())
    assert around.path.values.tolist() == [[1.5, 2.5, 2.0, 2.0]]


def test_boxes_stand_where_the_kits_formula_puts_their_corners(frames):
    scene = open_scene(frames)
    box = next(a for a in scene.annotations if a.id == "000007.0")
    poses = cuboid_poses(box, box.path.timestamps_ns)
    found = box_corners(poses.centers_world[0], poses.sizes_lwh[0], poses.quaternions_xyzw[0])
    # corners of the kit: x along the length, y down from the bottom, rotated about y, moved to the location
    height, width, length, cosine, sine = 1.5, 1.6, 4.0, np.cos(0.8), np.sin(0.8)
    x = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * length / 2
    y = np.array([0, 0, 0, 0, -1, -1, -1, -1]) * height
    z = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * width / 2
    about_y = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    rectified = (about_y @ np.array([x, y, z])).T + np.array([1.0, 1.7, 12.0])
    camera = rectified @ rotation()
    lidar = (camera - np.array(CALIBRATIONS[7]["T"].split(), float)) @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    distances = np.linalg.norm(found[:, None] - lidar[None], axis=2)
    np.testing.assert_allclose([distances.min(axis=0), distances.min(axis=1)], 0, atol=1e-9)


def test_of_training_and_testing_the_former_is_read_and_a_frame_without_calibration_is_a_fault(frames):
    (frames / "testing/image_2").mkdir(parents=True)
    Image.new("RGB", (36, 28)).save(frames / "testing/image_2/000000.png")
    assert "other-part" in [n.code for n in open_scene(frames).warnings]
    (frames / "training/calib/000007.txt").unlink()
    with pytest.raises(DataError, match=r"calib/000007.txt: is missing; velodyne/000007.bin needs"):
        open_scene(frames)
    assert len(open_scene(frames, lenient=True).sensor("velodyne").frames) == 1
    (frames / "training/calib/000003.txt").unlink()
    with pytest.raises(DataError, match=r"without calibration: expected training/calib/000000.txt for each"):
        open_scene(frames)


TR = np.array([[0, -1, 0, 0.01], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
POSES = np.stack([np.eye(4), np.eye(4)])
POSES[1, :3, :3] = [[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]]
POSES[1, :3, 3] = 0.05, -0.02, 1.3
ODOMETRY = (
    "P0: 48 0 17 0 0 48 13 0 0 0 1 0\nP2: 48 0 17 2.88 0 48 13 0.5 0 0 1 0.003\n"
    f"Tr: {' '.join(map(str, TR[:3].reshape(-1)))}\n"
)
CLASSES = np.array([40, 10 | 5 << 16, 10 | 5 << 16, 0, 777], np.uint32)


def rows(matrices):
    return "".join(" ".join(map(repr, matrix[:3].reshape(-1).tolist())) + "\n" for matrix in matrices)


@pytest.fixture
def odometry(tmp_path):
    folder = tmp_path / "sequences/04"
    for kind in ("velodyne", "image_2", "labels"):
        (folder / kind).mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    (folder / "calib.txt").write_text(ODOMETRY)
    (folder / "times.txt").write_text("0.000000000\n1.037360001e-01\n")
    (tmp_path / "poses/04.txt").write_text(rows(POSES))
    for k in range(2):
        np.arange(20, dtype=np.float32).reshape(5, 4).tofile(folder / "velodyne" / f"{k:06d}.bin")
        Image.new("RGB", (36, 28)).save(folder / "image_2" / f"{k:06d}.png")
        CLASSES.tofile(folder / "labels" / f"{k:06d}.label")
    return tmp_path


@pytest.mark.parametrize("location", ["", "sequences", "sequences/04"])
def test_a_sequence_is_found_from_every_folder_and_its_points_where_poses_of_the_camera_put_them(odometry, location):
    scene = open_scene(odometry / location)
    assert (scene.format, list(scene.trajectories)) == ("kitti-odometry", ["groundTruth"])
    assert scene.sensor("camera2").images.timestamps_ns.tolist() == [0, 103_736_000]
    lidar, point = scene.sensor("velodyne"), np.array([7.0, 1.0, -1.5, 1.0])
    source = PoseSource(scene.trajectories["groundTruth"].poses, lidar.mount)
    at = source.at(lidar.frames.timestamps_ns)
    found = rotate_vectors(at.quaternions_xyzw, np.tile(point[:3], (2, 1))) + at.positions
    # the world is the lidar's first frame: back from the first camera's
    expected = [(np.linalg.inv(TR) @ pose @ TR @ point)[:3] for pose in POSES]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_labels_are_points_of_classes_and_objects_unless_they_are_left_aside(odometry):
    (odometry / "sequences/04/voxels").mkdir()
    scene = open_scene(odometry)
    found = {a.id: a for a in scene.annotations}
    assert set(found) == {"road", "car 5", "777"}
    car = found["car 5"]
    assert (car.label, car.is_instance, found["road"].is_instance) == ("car", True, False)
    assert [part.sensor_frame for part in car.labeled_points] == [0, 1]
    assert car.labeled_points[0].point_ids.tolist() == [1, 2]
    assert found["777"].label == "777"
    assert "unknown-classes" in [n.code for n in scene.warnings]
    scene = open_scene(odometry, labels="skip")
    assert scene.annotations == ()
    reported = {n.code: n for n in scene.warnings}
    assert (reported["labels-aside"].count, reported["not-read"].message) == (2, "voxels not read")
    with pytest.raises(OptionError, match=r"labels 'no'; expected one of read, skip"):
        open_scene(odometry, labels="no")


def test_without_a_lidar_the_ego_is_camera_0_rotated_to_look_ahead(odometry):
    for kind in ("velodyne", "labels"):
        shutil.rmtree(odometry / "sequences/04" / kind)
    (odometry / "sequences/04/calib.txt").write_text(ODOMETRY.split("Tr", maxsplit=1)[0])
    trajectory = open_scene(odometry).trajectories["groundTruth"]
    # 1.3 m along the camera's axis is 1.3 m ahead, its x to the right, its y down
    np.testing.assert_allclose(trajectory.positions[1], [1.3, -0.05, 0.02], atol=1e-12)


def test_each_sequence_is_a_drive_and_one_or_a_calibration_that_is_not_there_is_reported(odometry):
    assert drives_of(odometry) == ()
    shutil.copytree(odometry / "sequences/04", odometry / "sequences/06")
    assert drives_of(odometry) == (odometry / "sequences/04", odometry / "sequences/06")
    shutil.rmtree(odometry / "sequences/06")
    with pytest.raises(OptionError, match=r"sequence '05': .* has 04"):
        open_scene(odometry, sequence="05")
    (odometry / "sequences/04/calib.txt").unlink()
    with pytest.raises(DataError, match=r"calib.txt: is missing; expected P0 to P3, and Tr"):
        open_scene(odometry)


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
    shutil.rmtree(folder / "calib")
    with pytest.raises(DataError, match=r"without calibration: expected .*/calib/0000.txt for each"):
        open_scene(folder)


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
    ("benchmark", "name", "text", "problem"),
    [
        ("odometry", "sequences/04/times.txt", "0\n", "2 files up to number 1 for 1 times"),
        ("odometry", "sequences/04/times.txt", "0\n1\n2\n", "3 times, and the last file has number 1"),
        ("odometry", "sequences/04/times.txt", "1\n0\n", "line 2: is not later than the line before"),
        ("odometry", "poses/04.txt", rows(POSES[:1]), "1 poses for 2 times; expected as many"),
        ("odometry", "poses/04.txt", "1 2 3\n", "line 1: 3 values; expected 12"),
        ("odometry", "poses/04.txt", "2 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "line 1: a rotation off by"),
        ("odometry", "sequences/04/calib.txt", "P2: 48 0 17 0 0 48 13 0 0 0 1 0\n", "no Tr_velo_cam"),
        ("odometry", "sequences/04/labels/000001.label", "abc", "3 bytes for the 5 points of the sweep; expected 20"),
        ("folder", "label_02/0002.txt", ROW.format(frame=0, track=4, x=0) * 2, "frame 0: track 4 stands in it twice"),
        ("folder", "label_02/0002.txt", "0 4 Car 0 1\n", "line 1: 5 values; expected 17 or 18"),
        ("folder", "calib/0002.txt", "P2: 1 0 0\n", "line 1: 4 values; expected 13"),
        ("folder", "oxts/0002.txt", "1 2\n", "line 1: 2 values; expected 30"),
    ],
)
def test_a_fault_is_reported_with_its_location(request, benchmark, name, text, problem):
    root = request.getfixturevalue(benchmark)
    (root / name).write_text(text)
    with pytest.raises(DataError) as caught:
        open_scene(root)
    assert problem in str(caught.value)


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


def test_sequences_are_chosen_without_their_zeros_and_times_and_sizes_taken_where_there_are(tracking_folder):
    folder = open_tracking_folder(tracking_folder())
    assert folder.chosen(["7", "0007"]) == folder.chosen([]) == ("0007",)
    with pytest.raises(DataError, match="sequence 0001: is not there; expected one of 0007"):
        folder.sequence("0001")
    with pytest.raises(OptionError, match="sequence '1'"):
        folder.chosen(["7", "1"])
    timed = sequence(tracking_folder(times__0007="5.0\n5.1\n5.25\n5.3\n"))
    assert timed.timestamps_ns.tolist() == [5_000_000_000, 5_100_000_000, 5_250_000_000, 5_300_000_000]
    for text, problem in (
        ("5.0\n5.1\n5.25\n", "3 times for 4 frames"),
        ("5.0\n5.0\n5.25\n5.3\n", "line 2: is not later"),
    ):
        with pytest.raises(DataError, match=problem):
            sequence(tracking_folder(times__0007=text))


def test_images_report_their_size_else_the_focal_length_else_the_camera_model(tracking_folder):
    camera_model = sequence(tracking_folder()).camera
    assert (camera_model.width, camera_model.height) == (1224, 370)
    folder = tracking_folder(calib__0007=TRACKING.replace("7.070493e+02", "7.0e+02"))
    other = sequence(folder)
    assert (other.camera.width, other.camera.height) == (1201, 361)
    assert [warning.code for warning in other.warnings] == ["image-size"]
    (folder / "image_02" / "0007").mkdir(parents=True)
    Image.new("RGB", (640, 480)).save(folder / "image_02/0007/000000.png")
    camera_model = sequence(folder).camera
    assert (camera_model.width, camera_model.height) == (640, 480)


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
