"""A folder with a manifest as a scene; a simulated drive, written as plain files, opens as the drive that it was."""

import io
import os
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.cameras import MODELS, project
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.rig.reader import (
    Edge,
    FrameTree,
    frame_from_camera,
    frame_from_optical,
    read_camera_model,
    read_transform,
)
from sceneloom.formats.rig.spec import FORMAT
from sceneloom.formats.video.writer import VideoWriter
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import PointsFrame
from sceneloom.scene.cameras import Shutter
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

from .conftest import BY_RATE, CAMERA_MODEL, FIELDS, FIRST_SENSOR, POSES, SCALE, START_NS, TUM, codes


def test_a_scene_has_the_sensors_of_the_manifest_with_what_their_files_hold_mountings_and_poses(opened):
    scene = opened()
    assert [(sensor.id, sensor.type) for sensor in scene.sensors] == [("top", "lidar"), ("front", "camera")]
    assert codes(scene) == []
    lidar, camera = pickle.loads(pickle.dumps(scene)).sensors
    assert lidar.frames.timestamps_ns.tolist() == [START_NS, START_NS + 100_000_000, START_NS + 200_000_000]
    assert lidar.frames[2].points.positions[1].tolist() == [6.0, 7.0, 8.0]
    assert lidar.frames[2].points.intensities.tolist() == [5, 9, 13, 17]
    assert lidar.points_frame is PointsFrame.SENSOR
    assert camera.images.timestamps_ns[0] == 1_532_402_927_650_000_000
    assert camera.images[1].rgb[0, 0].tolist() == [10, 20, 30]
    assert (camera.camera.width, camera.camera.height, camera.camera.fy) == (8, 6, 6.0)
    np.testing.assert_allclose(lidar.mount.translation, [1.0, 0.0, 2.0])
    np.testing.assert_allclose(camera.mount.translation, [1.5, 0.0, 1.5])
    # flu: what the camera looks along is the vehicle's x, its right is the vehicle's -y, its down the vehicle's -z
    np.testing.assert_allclose(camera.mount.rotate(np.eye(3)), [[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    # 10 m/s along x from 0.5 s on, the lidar 1 m before and 2 m above the ego
    np.testing.assert_allclose(lidar.poses.positions, [[2.0, 0, 2], [3.0, 0, 2], [4.0, 0, 2]], atol=1e-9)


def test_folder_and_manifest_of_any_name_are_recognised_and_open_alike_and_a_rig_is_only_read(folder, opened, tmp_path):
    with pytest.raises(OptionError, match="a rig is only read; write a scene file"):
        sceneloom.write(opened(), tmp_path / "new.toml", format="rig")
    assert not (tmp_path / "new.toml").exists()
    with pytest.raises(OptionError, match="altitude"):
        FORMAT.open(folder, altitude="msl")
    for path in (folder, folder / "rig.toml"):
        with sceneloom.open(path) as scene:
            assert (scene.format, scene.source, len(scene.sensors)) == ("rig", str(folder), 2)
    (folder / "rig.toml").rename(folder / "day.toml")
    (folder / "other.toml").write_text("[project]\nname = 'x'\n")
    (folder / "broken.toml").write_text("sensors = [")
    recognised = {path.name for path in (folder, *folder.glob("*.toml")) if FORMAT.sniff(path)}
    assert recognised == {"day.toml"}


def test_nothing_but_the_manifest_and_first_heads_is_needed_to_open(folder, opened):
    for path in sorted((folder / "top").iterdir())[1:] + sorted((folder / "front").iterdir())[1:]:
        path.write_bytes(b"broken")
    scene = opened()
    with pytest.raises(DataError, match="6 bytes are 0 points"):
        scene.lidars[0].frames[1]
    with pytest.raises(DataError, match="no PNG and no JPEG"):
        _ = scene.cameras[0].images[2].rgb


def test_what_is_hardly_meant_is_remarked_and_each_part_that_a_lenient_reading_leaves_out_with_its_fault(
    opened, folder
):
    for change, expected_codes, message in (
        ((FIRST_SENSOR, f'[[transforms]]\nfrom = "a"\nto = "b"\ntranslation = [1, 0, 0]\n\n{FIRST_SENSOR}'),
         ["loose-frames"], "'a', 'b' are not connected with 'base'"),
        (("start_s = 1532402927.65", "start_s = 0"), ["clocks-apart"],
         "trajectory 'pose' begins 1532402927.300 s after sensor 'front'"),
        (("[1.0, 0.0, 2.0]", "[1000.0, 0.0, 2000.0]"), ["far-mount"] * 2, "are these millimetres?"),
    ):  # fmt: skip
        scene = opened(change)
        assert codes(scene) == expected_codes
        assert all(message in warning.message for warning in scene.warnings)
    (folder / "poses.txt").write_text("1532402927.5 0 0 0 0 0 0 1\n1532402928.5 9 0 0 0 0 1\n")
    scene = opened(("top/*.bin", "tip/*.bin"), lenient=True)
    assert [sensor.id for sensor in scene.sensors] == ["front"]
    assert codes(scene) == ["parts-at-fault"] * 2
    reported = [f"{warning.location}: {warning.message}" for warning in scene.warnings]
    assert reported[0].startswith(f"{folder / 'rig.toml'}: trajectories[0]: left out: {folder / 'poses.txt'}: line 2: ")
    assert reported[1].startswith(f"{folder / 'rig.toml'}: sensors[0].files: left out: 'tip/*.bin': no such files")


MODEL = Camera("brown_conrady", 96, 64, 60.0, 61.0, 47.5, 31.5, (-0.2, 0.05, 0.001, -0.001, 0.01))
CLOUD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("i", "u1"), ("ring", "<u2"), ("t", "<i8")])
PCD = "FIELDS x y z i ring t\nSIZE 4 4 4 1 2 8\nTYPE F F F U U I\nWIDTH {}\nHEIGHT 1\nDATA binary\n"


@pytest.fixture(scope="module")
def drive():
    """Three sweeps of a coarse lidar and a small camera with distortion."""
    return simulate_street(4, frames=3, lidar=LidarSpec(beams=16, steps=300), cameras=(CameraSpec(MODEL),)).scene


def write_folder(folder: Path, scene: sceneloom.Scene, kind: str) -> None:
    lidar, camera = scene.lidars[0], scene.cameras[0]
    for name in ("lidar", "images"):
        (folder / name).mkdir()
    for frame in lidar.frames:
        points = frame.points
        columns = (*points.positions.T, points.intensities, points.rings, points.timestamps_ns)
        head = PCD.format(len(points)).encode() if kind == "pcd" else b""
        path = folder / "lidar" / f"{frame.timestamp_ns}.{kind}"
        path.write_bytes(head + np.rec.fromarrays(columns, CLOUD).tobytes())
    for image in camera.images:
        Image.fromarray(image.rgb).save(folder / "images" / f"{image.timestamp_ns}.png")
    trajectory = scene.trajectories["groundTruth"]
    poses = np.column_stack([trajectory.positions, trajectory.quaternions_xyzw]).tolist()
    rows = zip(trajectory.timestamps_ns.tolist(), poses, strict=True)
    (folder / "trajectory.txt").write_text("".join(f"{t} {' '.join(map(repr, pose))}\n" for t, pose in rows))
    fields = 'fields = ["x", "y", "z", "i:uint8", "ring:uint16", "t:int64"]' if kind == "bin" else ""
    (folder / "rig.toml").write_text(f"""
[[trajectories]]
name = "truth"
file = "trajectory.txt"
form = "tum"
unit = "nanoseconds"
[[sensors]]
id = "lidar"
type = "lidar"
files = "lidar/*.{kind}"
times = {{ pattern = "{{ns}}" }}
point_times = {{ unit = "nanoseconds", relative_to = "clock" }}
{fields}
extrinsic = {{ to = "base", matrix = {lidar.mount.matrix.tolist()} }}
[[sensors]]
id = "camera"
type = "camera"
files = "images/*.png"
times = {{ pattern = "{{ns}}" }}
extrinsic = {{ from = "base", matrix = {camera.mount.inverse().matrix.tolist()} }}
camera_model = {{ fx = 60, fy = 61, cx = 47.5, cy = 31.5, coefficients = {list(MODEL.coefficients)} }}
""")


@pytest.mark.parametrize("kind", ["pcd", "bin"])
def test_files_that_state_their_columns_or_do_not_bring_the_drive_back_exactly(tmp_path, drive, kind):
    write_folder(tmp_path, drive, kind)
    scene = sceneloom.open(tmp_path)
    for found, known in zip(scene.lidars[0].frames, drive.lidars[0].frames, strict=True):
        assert found.timestamp_ns == known.timestamp_ns
        for name in ("positions", "intensities", "rings", "timestamps_ns"):
            np.testing.assert_array_equal(getattr(found.points, name), getattr(known.points, name))
        assert not found.points.extras
    for found, known in zip(scene.cameras[0].images, drive.cameras[0].images, strict=True):
        assert found.timestamp_ns == known.timestamp_ns
        np.testing.assert_array_equal(found.rgb, known.rgb)
    assert scene.cameras[0].camera == MODEL
    for found, known in zip(scene.sensors, (drive.lidars[0], drive.cameras[0]), strict=True):
        np.testing.assert_allclose(found.mount.matrix, known.mount.matrix, atol=1e-12)
    truth = drive.trajectories["groundTruth"]
    np.testing.assert_array_equal(scene.trajectories["truth"].timestamps_ns, truth.timestamps_ns)
    # an ego frame without transforms is the trajectory's own
    np.testing.assert_allclose(scene.trajectories["truth"].positions, truth.positions, atol=1e-12)


POINT_TIMES = 'point_times = { field = "t", unit = "seconds" }'
BLOB = np.ones((4, 4), "<f4")


@pytest.fixture
def sweeps(folder):
    """Write the points of all sweeps, or of the first ones."""
    paths = sorted((folder / "top").iterdir())

    def write(points, count=3):
        for path in paths[:count]:
            path.write_bytes(points if isinstance(points, bytes) else np.asarray(points, "<f4").tobytes())

    return write


def fields(*names):
    return (FIELDS, f"fields = [{', '.join(map(repr, names))}]".replace("'", '"'))


TIMED = fields("x", "y", "z", "t")


def test_a_frame_has_the_start_of_its_sweep_and_times_of_points_count_from_what_is_stated(opened, sweeps):
    # points have times from 0 to 0.09 s after the timestamp, as float32 seconds
    sweeps(np.column_stack([BLOB[:, :3], [0.0, 0.03, 0.06, 0.09]]))
    for timestamp, relative_to, frame_before_ms, points_before_ms in (
        ("start", "timestamp", 0, 0), ("middle", "timestamp", 50, 0), ("end", "timestamp", 100, 0),
        ("end", "start", 100, 100),
    ):  # fmt: skip
        stated = f'{POINT_TIMES[:-2]}, relative_to = "{relative_to}" }}\ntimestamp = "{timestamp}"\nsweep_s = 0.1'
        frame = opened(TIMED, (SCALE, stated)).lidars[0].frames[0]
        first_ns = START_NS - points_before_ms * 1_000_000
        found = frame.timestamp_ns, frame.points.timestamps_ns[0]
        assert found == (START_NS - frame_before_ms * 1_000_000, first_ns), stated
        assert (frame.points.timestamps_ns - first_ns)[3] == pytest.approx(90_000_000, abs=10)
    # times that were used for deskewing are not used again: all are as if measured at the timestamp
    frame = opened(TIMED, (SCALE, f"{POINT_TIMES}\ndeskewed = true")).lidars[0].frames[0]
    assert set(frame.points.timestamps_ns.tolist()) == {frame.timestamp_ns}
    assert frame.points.extras["t"].tolist() == pytest.approx([0.0, 0.03, 0.06, 0.09])
    # points without times belong to the middle of their sweep
    for stated, after_ms, assumed in (
        ("", 0, False),
        ("sweep_s = 0.1", 50, False),
        ('timestamp = "middle"\nsweep_s = 0.1', 0, False),
        ('timestamp = "end"\nsweep_s = 0.1', -50, False),
        ('timestamp = "end"', -50, True),
        ('timestamp = "end"\ndeskewed = true', 0, False),
    ):
        scene = opened((SCALE, f"{SCALE}\n{stated}"))
        frames = scene.lidars[0].frames
        found = frames.timestamps_ns[0], frames[0].timestamp_ns, codes(scene)
        assert found == (*[START_NS + after_ms * 1_000_000] * 2, ["sweep-length"] * assumed), stated


def test_columns_may_be_named_and_what_is_taken_for_granted_is_stated(opened, sweeps):
    use = '\nuse = { x = "a", y = "b", z = "c", intensity = "d" }'
    scene = opened((FIELDS, fields("a", "b", "c", "d")[1] + use))
    assert scene.lidars[0].frames[0].points.intensities.tolist() == [3, 7, 11, 15]
    scene = opened((SCALE, ""), (FIELDS, ""))
    assert set(codes(scene)) == {"fields-assumed", "intensity-scale"}
    assert [one.lidars[0].extras["intensity_max"] for one in (scene, opened())] == [255.0] * 2
    # the scale is seen in the first file that has any brightness
    for first in (np.column_stack([BLOB[:, :3], np.zeros(4)]), b""):
        sweeps(first, count=1)
        assert opened((SCALE, "")).lidars[0].extras["intensity_max"] == 255.0
    # times as well-known drivers write them are used where they can be
    for column, first, code, message in (
        ("time", 0.0, "point-times-assumed", "seconds relative to the timestamp"),
        ("timestamps", 0.0, "point-times-not-used", "looks like point times"),
        ("time", 5000.0, "point-times-not-used", "5000 s from the file's timestamp"),
    ):
        sweeps(np.column_stack([BLOB[:, :3], [first, 0.03, 0.06, 0.09]]))
        scene = opened(fields("x", "y", "z", column))
        assert (scene.lidars[0].frames[0].points.timestamps_ns is not None) == (code == "point-times-assumed")
        (warning,) = scene.warnings
        assert (warning.code, message in warning.message) == (code, True)
    # and columns that are taken for others are remarked
    sweeps(np.random.default_rng(5).uniform([-50, -50, -3, 0], [50, 50, -1, 255], (400, 4)))
    for names, reported in (
        (("x", "y", "z", "intensity"), None),
        (("x", "y", "intensity", "z"), "intensity below zero"),
        (("x:float64", "y:float64", "z:float64", "intensity:float64"), "points farther than 10000 m"),
    ):
        found = [warning.message for warning in opened(fields(*names)).warnings if warning.code == "odd-points"]
        assert found == [] if reported is None else any(message.startswith(reported) for message in found)


def test_points_stay_in_the_frame_of_ego_or_world_and_are_brought_to_the_sensor_from_others(opened):
    matrix = "[[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    odd = f'[[transforms]]\nfrom = "odd"\nto = "base"\nmatrix = {matrix}\n\n{FIRST_SENSOR}'
    for points_in, frame, first in (
        ("base", PointsFrame.EGO, [0.0, 1.0, 2.0]),
        ("world", PointsFrame.WORLD, [0.0, 1.0, 2.0]),
        # (0, 1, 2) of odd is (-1 + 5, 0, 2) of base, and (3, 0, 0) of the lidar at (1, 0, 2)
        ("odd", PointsFrame.SENSOR, [3.0, 0.0, 0.0]),
    ):
        lidar = opened((SCALE, f'{SCALE}\npoints_in = "{points_in}"'), (FIRST_SENSOR, odd)).lidars[0]
        found = lidar.points_frame, lidar.mount.translation.tolist(), lidar.frames[0].points.positions[0].tolist()
        assert found == (frame, [1.0, 0.0, 2.0], first)


@pytest.mark.parametrize(
    ("points", "changes", "problem"),
    [
        (None, [("top/*.bin", f"top/{START_NS}.bin"), (SCALE, f'{SCALE}\ntimestamp = "end"')],
         "a single sweep has no interval; expected the duration of a sweep"),
        ([[1.0, 1, 1, 0], [1, 1, 1, 0.03]],
         [TIMED, (SCALE, 'point_times = { field = "t", unit = "seconds", relative_to = "clock" }')],
         r't\[1\]: 0\.03.*expected within 10 s|unit = "seconds"'),
        ([[4e5] * 4], [(SCALE, f'{SCALE}\npoints_in = "world"')], "400000 m from the world's origin"),
        ([[1e6] * 4], [(SCALE, "")], r"set what becomes 255 by sensors\[0\]\.intensity_max"),
        (None, [("top/*.bin", "top/*")], r"'1.txt'; expected files that end with \.pcd"),
    ],
)  # fmt: skip
def test_what_makes_no_sweep_is_refused_when_the_drive_is_opened(refused, folder, sweeps, points, changes, problem):
    (folder / "top" / "1.txt").write_text("1")
    if points is not None:
        sweeps(points, count=1)
    refused(problem, *changes)


def test_points_that_are_dropped_are_counted_and_a_lenient_reading_begins_with_the_first_file_that_can_be_read(
    opened, refused, sweeps
):
    sweeps([[1, 2, 3, 4], [0, 0, 0, 9], [np.nan, 1, 1, 1]], count=1)
    scene = opened()
    assert [(n.code, n.count) for n in scene.warnings] == [("points-dropped", 2)]
    assert scene.lidars[0].frames[0].extras["dropped_points"] == 2
    assert scene.lidars[0].frames[1].extras == {"file": f"top/{START_NS + 100_000_000}.bin"}
    sweeps(b"torn", count=2)
    scene = opened(lenient=True)
    assert [frame.timestamp_ns for frame in scene.lidars[0].frames] == [START_NS + 200_000_000]
    assert [(n.count, n.kind) for n in scene.warnings if n.code == "unreadable-files"] == [(2, "skipped")]
    refused(f"{START_NS}.bin")


TIMES = np.array([0.0, 0.5, 1.0])
ROTATIONS = Rotation.from_euler("ZYX", [[0, 0, 0], [30, 5, -3], [60, 0, 2]], degrees=True)
LOCATIONS = np.array([[0.0, 0, 0], [3, 1, 0.1], [5, 4, 0.2]])
WORLD_FROM_FRAME = np.tile(np.eye(4), (3, 1, 1))
WORLD_FROM_FRAME[:, :3, :3], WORLD_FROM_FRAME[:, :3, 3] = ROTATIONS.as_matrix(), LOCATIONS
BASE_FROM_IMU = np.array([[0, -1, 0, 0.5], [1, 0, 0, -0.25], [0, 0, 1, 1.0], [0, 0, 0, 1]])
IMU_FRAME = f'[[transforms]]\nfrom = "imu"\nto = "base"\nmatrix = {BASE_FROM_IMU.tolist()}\n\n{FIRST_SENSOR}'
KITTI = 'file = "trajectory.txt"\nform = "kitti"\ntimes = "times.txt"'
AS_CSV = 'file = "trajectory.csv"\nform = "csv"'


def test_every_form_of_another_frame_gives_the_ego_trajectory(opened, refused, folder):
    rows = np.column_stack([TIMES, LOCATIONS, ROTATIONS.as_quat()])
    np.savetxt(folder / "tum.txt", rows, header="t x y z qx qy qz qw")
    rows[:, 0] *= 1000
    names, path = "timestamp_ms,east,y,z,qw,qx,qy,qz", folder / "trajectory.csv"
    np.savetxt(path, rows[:, [0, 1, 2, 3, 7, 4, 5, 6]], header=names, comments="", delimiter=",")
    np.savetxt(folder / "trajectory.txt", WORLD_FROM_FRAME[:, :3].reshape(3, 12))
    np.savetxt(folder / "times.txt", TIMES)
    expected = WORLD_FROM_FRAME @ np.linalg.inv(BASE_FROM_IMU)
    for stated in ('file = "tum.txt"\nform = "tum"', AS_CSV + '\ncolumns = { x = "east" }', KITTI):
        scene = opened((TUM, f'{stated}\nframe = "imu"\nname = "slam"'), (FIRST_SENSOR, IMU_FRAME))
        found = scene.trajectories["slam"]
        assert found.timestamps_ns.tolist() == [0, 500_000_000, 1_000_000_000]
        # the texts hold 18 digits
        np.testing.assert_allclose(found.positions, expected[:, :3, 3], atol=1e-12)
        rotations = Rotation.from_quat(found.quaternions_xyzw).as_matrix()
        np.testing.assert_allclose(rotations, expected[:, :3, :3], atol=1e-12)
    # of KITTI's form rotations have to be such, and there are as many times
    np.savetxt(folder / "trajectory.txt", (WORLD_FROM_FRAME[:, :3] * [[[1.0]], [[1.1]], [[1.0]]]).reshape(3, 12))
    refused(r"line 2: rotation off by 0.21", (TUM, KITTI))
    (folder / "times.txt").write_text("1\n2\n")
    refused("2 times for 3 poses", (TUM, KITTI))


def test_the_first_trajectory_is_the_default_names_may_stand_in_a_comment_and_optical_worlds_are_rotated(
    opened, folder
):
    second = f'{TUM}\nname = "a"\n\n[[trajectories]]\n{TUM}\nname = "b"\ntime_offset_s = 0.5'
    trajectories = opened((TUM, second.replace('form = "tum"\nname = "b"', 'form = "csv"\nname = "b"'))).trajectories
    assert [*trajectories] == ["a", "b"]
    assert (trajectories["b"].timestamps_ns - trajectories["a"].timestamps_ns).tolist() == [500_000_000] * 2
    assert trajectories["b"].positions.tolist() == [[0, 0, 0], [10, 0, 0]]
    # so that z is up
    (folder / "poses.txt").write_text("1 1 2 3 0 0 0 1\n2 1 2 4 0 0 0 1\n")
    found = opened((TUM, f'{TUM}\nworld_axes = "optical"')).trajectories["pose"]
    assert found.positions.tolist() == [[3.0, -1.0, -2.0], [4.0, -1.0, -2.0]]
    rotated = Rotation.from_quat(found.quaternions_xyzw[0]).apply([0, 0, 1.0])
    np.testing.assert_allclose(rotated, [1, 0, 0], atol=1e-12)


def test_poses_without_orientations_out_of_order_repeated_or_of_a_leaning_ego_are_remarked(opened, folder):
    (folder / "trajectory.csv").write_text("time;x;y;z\n0;1;2;3\n1;2;2;3\n")
    scene = opened((TUM, AS_CSV + '\nframe = "top"'))
    assert (scene.trajectories["pose"].quaternions_xyzw, scene.lidars[0].poses) == (None, None)
    assert {"lever-arm-ignored", "orientations-missing"} < set(codes(scene))
    lines = POSES.splitlines()
    (folder / "poses.txt").write_text("\n".join([lines[2], lines[1], lines[1]]))
    scene = opened()
    assert scene.trajectories["pose"].positions[:, 0].tolist() == [0.0, 10.0]
    assert codes(scene) == ["poses-sorted", "repeated-poses"]
    assert scene.warnings[0].location.endswith("poses.txt: line 2")
    (folder / "poses.txt").write_text("1532402927.5 0 0 0 1 0 0 0\n1532402928.5 9 0 0 0.98 0.02 0 0.198\n")
    (warning,) = opened().warnings
    assert warning.code == "ego-leaning"
    assert "on its side or upside down in 2 of 2 poses; are the quaternions x y z w" in warning.message


IMU = """[[sensors]]
id = "imu"
type = "imu"
file = "imu.csv"
extrinsic = { to = "base", rotation_matrix = [[0, -1, 0], [1, 0, 0], [0, 0, 1]] }
"""
GNSS = '[[sensors]]\nid = "gps"\ntype = "gnss"\nfile = "gnss.csv"\n'
CAMERA = '[[sensors]]\nid = "front"'
WITH = {"poses.txt": (), "imu.csv": ((CAMERA, IMU + CAMERA),), "gnss.csv": ((CAMERA, GNSS + CAMERA),)}
"""What a manifest says of each file."""


def test_imu_values_are_converted_to_the_axes_of_the_ego_and_fixes_read_and_sorted(opened, folder):
    rows = "1000000,1,0,9.8,90,0,0\n1010000,0,2,9.8,0,90,0\n"
    (folder / "imu.csv").write_text(f"t_us,ax,ay,az,gyro_x,gyro_y,gyro_z\n{rows}")
    away = IMU.replace("rotation_matrix", "translation = [1, 0, 0], rotation_matrix")
    scene = opened((CAMERA, f'{away}gyroscope_unit = "deg/s"\n' + CAMERA))
    streams = scene.sensor("imu").streams
    assert streams["accelerometer"].timestamps_ns.tolist() == [1_000_000_000, 1_010_000_000]
    np.testing.assert_allclose(streams["accelerometer"].values, [[0, 1, 9.8], [-2, 0, 9.8]], atol=1e-12)
    np.testing.assert_allclose(streams["gyroscope"].values, [[0, np.pi / 2, 0], [-np.pi / 2, 0, 0]], atol=1e-12)
    assert "imu-lever-arm" in codes(scene)
    assert "imu-lever-arm" not in codes(opened(*WITH["imu.csv"]))
    (folder / "gnss.csv").write_text("time lat lon alt hacc\n2 48.1 11.5 520.5 1.5\n1 48.0 11.6 520 2\n")
    scene = opened(*WITH["gnss.csv"])
    gnss = scene.sensor("gps")
    assert (gnss.timestamps_ns.tolist(), gnss.accuracies.tolist()) == ([1_000_000_000, 2_000_000_000], [2.0, 1.5])
    assert gnss.positions_lla.tolist() == [[48.0, 11.6, 520.0], [48.1, 11.5, 520.5]]
    assert np.isnan(gnss.vertical_accuracies).all()
    assert [one.location.rpartition("/")[2] for one in scene.warnings if one.code == "samples-sorted"] == [
        "gnss.csv: line 3"
    ]
    # times stand in one column or as seconds and nanoseconds
    for text, expected_ns in (
        *((f"{names},gx,gy,gz\n1532402927,5,0,0,0\n1532402927,5000005,0,0,0\n",
           [1_532_402_927_000_000_005, 1_532_402_927_005_000_005])
          for names in ("sec,nanosec", "secs,nsecs", "stamp_sec,stamp_nanosec", "Seconds,Nanoseconds")),
        ("nanoseconds,gx,gy,gz\n0,0,0,0\n5000000,0,0,0\n", [0, 5_000_000]),
        # cells in quotes may hold the sign between cells
        ('t_ns, note ,gx,gy,gz\n"7", "a,b",0,0,0\n 8 ,c,0,0,0\n', [7, 8]),
    ):  # fmt: skip
        (folder / "imu.csv").write_text(text)
        assert opened(*WITH["imu.csv"]).sensor("imu").streams["gyroscope"].timestamps_ns.tolist() == expected_ns


@pytest.mark.parametrize(
    ("file", "text", "problem"),
    [
        ("poses.txt", "", "is empty"),
        ("poses.txt", "# only a comment\n", "is empty"),
        ("poses.txt", "1 2 3\n", "3 values; expected 8: timestamp tx ty tz qx qy qz qw"),
        ("poses.txt", "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", "line 2: 7 values; expected 8"),
        ("poses.txt", "1 0 0 zero 0 0 0 1\n", "line 1: column 4: 'zero'; expected a finite number"),
        ("poses.txt", "1 0 0 0 0 0 0 nan\n", "line 1: column 8: 'nan'"),
        ("poses.txt", "1 0 0 0 0 0 0 2\n", r"line 1: orientation .* of length 2.0000"),
        ("poses.txt", "x 0 0 0 0 0 0 1\n", "line 1: 'x'; expected a number, or a date"),
        ("poses.txt", "1532402927647951001 0 0 0 0 0 0 1\n", 'is `unit = "nanoseconds"` meant'),
        ("gnss.csv", "time,lat,lon\n1,2,3\n", "no column for altitude among time, lat, lon"),
        ("gnss.csv", "lat,lon,alt\n1,2,3\n", "no column of times among lat, lon, alt"),
        ("gnss.csv", "time,lat,lon,alt\n1,91,3,0\n", "line 2: latitude 91.0, .* within ±90"),
        ("gnss.csv", "time,lat,lon,alt\n1,1,3,\n", "line 2: alt: ''; expected a finite number"),
        ("gnss.csv", "time,lat,lon,alt\n1,1,3\n", "line 2: 3 values; expected 4"),
        ("gnss.csv", "1,1,3,5\n", "line 1: '1,1,3,5'; expected the names of the columns"),
        ("imu.csv", "time,foo\n1,2\n", "no columns ax ay az or gx gy gz among time, foo"),
        ("imu.csv", "sec,nanosec,gx,gy,gz\n1.5,500000000,0,0,0\n",
         "line 2: 1.5.* s beside a column nanosec; expected whole seconds"),
        *(("imu.csv", f"sec,nanosec,gx,gy,gz\n1,{nanoseconds},0,0,0\n",
           "line 2: nanosec: .*expected a whole number from 0 to 999999999")
          for nanoseconds in ("-1", "1000000000", "0.5", "x")),
    ],
)  # fmt: skip
def test_a_wrong_line_is_reported_with_its_number(refused, folder, file, text, problem):
    (folder / file).write_text(text)
    refused(problem, *WITH[file])


SIZE = (640, 480)
POINTS = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 9], (50, 3))
K = np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]])
FISHEYE = [0.01, -0.02, 0.003, -0.0004]
TILTED = [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.003, 0.001, 0.001, 0.0005, -0.001, 0.0003, 0.01, -0.02]


@pytest.mark.parametrize(
    ("model", "given"), [("equidistant", FISHEYE), *(("plumb_bob", TILTED[:count]) for count in (4, 5, 8, 12, 14))]
)
def test_lists_of_coefficients_have_opencvs_order(model, given):
    camera_model = read_camera_model({"K": K, "coefficients": given, "model": model}, SIZE)
    judge = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    expected = judge(POINTS[:, None], np.zeros(3), np.zeros(3), K, np.array(given))[0][:, 0]
    pixels, visible = project(camera_model, POINTS)
    assert visible.any()
    # two programs, both in float64
    np.testing.assert_allclose(pixels[visible], expected[visible], atol=1e-8)


@pytest.mark.parametrize("model", [name for name in MODELS if MODELS[name].coefficient_names])
def test_every_model_of_the_table_is_read_with_its_own_coefficients(model):
    names = MODELS[model].coefficient_names
    values = {name: 1e-3 * (k + 1) for k, name in enumerate(names)}
    camera_model = read_camera_model({"K": K, "model": model.replace("_", "-").upper(), "coefficients": values}, SIZE)
    assert (camera_model.model, camera_model.coefficients) == (model, tuple(values.values()))
    if model != "brown_conrady":  # whose lists are OpenCV's, without lx and ly
        assert read_camera_model({"K": K, "model": model, "coefficients": [*values.values()]}, SIZE) == camera_model
        with pytest.raises(CalibrationError, match=f"{len(names) + 1} distortion coefficients; {model} has"):
            read_camera_model({"K": K, "model": model, "coefficients": [0.0] * (len(names) + 1)}, SIZE)


def test_coefficients_have_names_or_opencvs_order_images_may_be_rectified_and_a_projection_moves_the_camera():
    named = read_camera_model({"fx": 5.0, "cx": 1.0, "cy": 1.0, "coefficients": {"k3": 0.1, "k1": -0.2}}, SIZE)
    listed = read_camera_model({"fx": 5.0, "fy": 5.0, "cx": 1.0, "cy": 1.0, "coefficients": [-0.2, 0, 0, 0, 0.1]}, SIZE)
    probe = np.array([[0.1, 0.2, 1.0]])
    np.testing.assert_array_equal(project(named, probe)[0], project(listed, probe)[0])
    rectified = read_camera_model({"K": K, "coefficients": [-0.2, 0.1, 0, 0], "undistorted": True}, SIZE)
    assert (rectified.model, rectified.coefficients) == ("pinhole", ())
    P = np.column_stack([K, [45.0, -0.3, 0.005]])
    camera_model, shift = read_camera_model({"P": P}, SIZE), frame_from_camera({"P": P})
    homogeneous = np.column_stack([POINTS, np.ones(50)]) @ P.T
    pixels, visible = project(camera_model, shift.inverse().apply(POINTS))
    np.testing.assert_allclose(pixels[visible], (homogeneous[:, :2] / homogeneous[:, 2:])[visible], atol=1e-9)
    for record, problem in (
        ({}, "no focal length; expected one of fx fy cx cy, K, P"),
        ({"fx": 5.0, "K": K}, "fx and K; expected one of"),
        ({"K": K, "cx": 3.0}, "K beside cx"),
        ({"fx": 5.0, "cx": 3.0}, "cy missing"),
        ({"K": K.T}, r"expected \[fx 0 cx; 0 fy cy; 0 0 1\]"),
        ({"K": K, "model": "pinhol"}, "'pinhol'; expected one of pinhole, .*did you mean 'pinhole'"),
        ({"K": K, "coefficients": [0.1] * 3}, "3 coefficients; expected 0, 4, 5, 8, 12, 14 in OpenCV's order"),
        ({"K": K, "coefficients": {"q1": 0.1}}, "coefficients q1; brown_conrady has k1"),
        ({"K": K, "model": "fisheye", "coefficients": [0.1] * 5}, "5 distortion coefficients; fisheye has 4"),
        ({"K": -K}, "expected"),
        ({"K": K, "width": 640}, "width without height"),
    ):
        with pytest.raises(CalibrationError, match=problem):
            read_camera_model(record, SIZE)


def test_a_camera_model_for_another_size_is_scaled_and_rolling_shutters_kept_as_recordings_state_them(opened):
    scene = opened((CAMERA_MODEL, "cy = 2.5, width = 4, height = 3 }"))
    camera_model = scene.cameras[0].camera
    assert (camera_model.width, camera_model.fx, camera_model.cx) == (8, 12.0, (3.5 + 0.5) * 2 - 0.5)
    assert codes(scene) == ["camera-model-scaled"]
    rolling = (CAMERA_MODEL, CAMERA_MODEL + "\nshutter_roll_s = 0.033\nshutter_left_to_right = true")
    assert Shutter.of(opened(rolling).cameras[0]) == Shutter(0.033, over_columns=True)
    assert Shutter.of(opened().cameras[0]) == Shutter()


def test_images_of_8_bits_are_decoded_their_bytes_are_at_hand_and_those_of_16_or_another_size_refused(opened, folder):
    rng = np.random.default_rng(1)
    smooth = cv2.resize(rng.integers(0, 255, (3, 4, 3)).astype(np.uint8), (80, 60))
    Image.fromarray(smooth).save(folder / "front" / "0.jpg", quality=98, subsampling=0)
    Image.fromarray(smooth[:, :, 0]).save(folder / "front" / "1.jpg", quality=98)
    images = opened(("front/*.png", "front/*.jpg")).cameras[0].images
    # quality 98 leaves a few levels
    assert np.abs(images[0].rgb.astype(int) - smooth).max() < 12
    assert np.abs(images[1].rgb.astype(int) - smooth[:, :, :1]).max() < 12
    assert images[0].encoded() == (folder / "front" / "0.jpg").read_bytes()
    # png images of 8 bits become red, green and blue
    path = folder / "front" / "1.png"
    for image, problem in (
        *((Image.new(mode, (8, 6), 1), None) for mode in ("L", "P", "1")),
        (Image.new("RGBA", (8, 6), (1, 2, 3, 4)), None),
        (Image.new("I;16", (8, 6), 70), "'I;16'; expected 8-bit grey or colour"),
        *((np.full((6, 8, n), 300, np.uint16), "'RGBA?;16'; expected 8-bit grey or colour") for n in (3, 4)),
        (Image.new("RGB", (6, 8)), r"1\.png: is 6x8; expected 8x6"),
    ):
        if isinstance(image, Image.Image):
            image.save(path)
        else:
            cv2.imwrite(str(path), image)
        read = opened().cameras[0].images[1]
        if problem is None:
            assert read.rgb.shape == (6, 8, 3)
        else:
            with pytest.raises(DataError, match=problem):
                _ = read.rgb


def test_pipes_and_files_of_another_kind_among_the_images_are_refused_and_torn_ones_left_out(refused, opened, folder):
    (folder / "front" / "t.txt").write_text("1")
    refused(r"'t.txt'; expected files that end with .png .jpg .jpeg", ("front/*.png", "front/*"))
    # a lenient reading takes the size of the first image that can be read
    (folder / "front" / "0.png").write_bytes(b"torn")
    scene = opened(lenient=True)
    assert (len(scene.cameras[0].images), codes(scene)) == (2, ["unreadable-files"])
    refused(r"0\.png: is no PNG and no JPEG image")
    os.mkfifo(folder / "front" / "9.png")
    refused(r"'front/9\.png': is a named pipe; expected a regular file")


REDS = [0, 40, 80, 120, 160]
LISTS = {"t.csv": "frame,time_ms\n0,5\n1,7\n2,11\n3,13\n4,17\n", "t.txt": "5\n7\n11\n13\n17\n", "two.txt": "1\n2\n"}
AS_VIDEO = ('files = "front/*.png"', 'video = "front.mkv"')
BY_LINES = 'times = { lines = "t.txt", unit = "milliseconds" }'


@pytest.fixture
def video(folder):
    """Five images of growing brightness, 64x48 at 20 a second, and lists of times."""
    path = folder / "front.mkv"
    with VideoWriter(path, 64, 48, 20.0, codec="ffv1") as writer:
        for red in REDS:
            writer.add(np.full((48, 64, 3), red, np.uint8))
    for name, text in LISTS.items():
        (folder / name).write_text(text)
    return path


def test_videos_are_images_with_times(opened, video):
    for times, expected_ms in (
        ("times = { rate_hz = 10, start_s = 1.5 }", [1500, 1600, 1700, 1800, 1900]),
        ("times = { container = true, start_s = 2 }", [2000, 2050, 2100, 2150, 2200]),
        ('times = { csv = "t.csv" }', [5, 7, 11, 13, 17]),
        (BY_LINES, [5, 7, 11, 13, 17]),
    ):
        with opened(AS_VIDEO, (BY_RATE, times)) as scene:
            camera = scene.cameras[0]
            assert camera.images.timestamps_ns.tolist() == [ms * 1_000_000 for ms in expected_ms]
            assert [int(image.rgb[0, 0, 0]) for image in camera.images] == REDS
            assert (camera.video.codec, camera.video.frame_indices) == ("ffv1", None)
            assert pickle.loads(pickle.dumps(scene)).cameras[0].images[3].rgb[0, 0, 0] == 120
            with camera.video.open() as file:
                assert isinstance(file, io.IOBase)
        with pytest.raises(DataError, match="is closed"):
            _ = camera.images[0].rgb


def test_of_a_video_that_breaks_off_a_lenient_reading_keeps_the_images_before_the_cut(refused, opened, video):
    refused("2 times for 5 files or images", AS_VIDEO, (BY_RATE, 'times = { lines = "two.txt" }'))
    content = video.read_bytes()
    video.write_bytes(content[: len(content) * 3 // 5])
    changes = (AS_VIDEO, (BY_RATE, BY_LINES))
    refused("cut off", *changes)
    with opened(*changes, lenient=True) as scene:
        camera = scene.cameras[0]
        count = len(camera.images)
        assert 0 < count < 5
        assert [int(image.rgb[0, 0, 0]) for image in camera.images] == REDS[:count]
        assert pickle.loads(pickle.dumps(scene)).cameras[0].images[0].rgb[0, 0, 0] == 0
        assert camera.video is None
        counts = {warning.code: warning.count for warning in scene.warnings}
        assert (counts["unreadable-videos"], counts["counts-disagree"]) == (1, 5 - count)
    video.write_bytes(b"no video")
    refused("cannot be read as video", AS_VIDEO)


ROTATION = Rotation.from_euler("ZYX", [30.0, -20.0, 10.0], degrees=True)
SHIFT = np.array([1.0, -2.0, 3.0])
MATRIX = np.vstack([np.column_stack([ROTATION.as_matrix(), SHIFT]), [0, 0, 0, 1]])


def read(record, ledger=None):
    arrays = {name: value if name == "euler_order" else np.asarray(value) for name, value in record.items()}
    return read_transform(arrays, "here", ledger or Ledger(lenient=False))


def test_all_ways_to_write_a_transform_mean_the_same_and_a_rotation_that_is_a_little_off_is_repaired():
    for record in (
        {"translation": SHIFT, "quaternion_xyzw": ROTATION.as_quat()},
        {"translation": SHIFT, "quaternion_wxyz": np.roll(ROTATION.as_quat(), 1)},
        {"translation": SHIFT, "rotation_matrix": ROTATION.as_matrix()},
        # capital letters are SciPy's intrinsic rotations: Rz(yaw)·Ry(pitch)·Rx(roll)
        {"translation": SHIFT, "euler_deg": [10.0, -20.0, 30.0], "euler_order": "zyx"},
        {"matrix": MATRIX},
        {"matrix": MATRIX[:3]},
    ):
        np.testing.assert_allclose(read(record).matrix, MATRIX, atol=1e-12, err_msg=[*record][-1])
    ledger = Ledger(lenient=False)
    found = read({"rotation_matrix": ROTATION.as_matrix() * 1.002}, ledger)
    np.testing.assert_allclose(found.rotation, ROTATION.as_matrix(), atol=1e-12)
    assert [(warning.code, warning.location) for warning in ledger.warnings] == [("rotation-normalised", "here")]
    for record, problem in (
        ({}, "no transform; expected matrix, or translation and one of"),
        ({"matrix": MATRIX, "translation": SHIFT}, "matrix beside translation"),
        ({"quaternion_xyzw": [0, 0, 0, 1], "euler_deg": [0, 0, 0]}, "quaternion_xyzw and euler_deg; expected one"),
        ({"euler_deg": [0, 0, 0]}, "euler_deg and euler_order; expected both"),
        ({"quaternion_xyzw": [0, 0, 0, 2.0]}, "length 2.0000; expected 1"),
        ({"rotation_matrix": np.diag([1.0, 1.0, -1.0])}, "mirrored or singular"),
        ({"rotation_matrix": np.eye(3) * 1.01}, "off by 0.02"),
        ({"matrix": MATRIX.T}, "last row"),
    ):
        with pytest.raises(CalibrationError, match=problem):
            read(record)


def edge(source, target, seed):
    rng = np.random.default_rng(seed)
    transform = RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    return Edge(source, target, transform, f"{source} to {target}")


def test_loops_that_agree_are_taken_and_contradictions_and_frames_without_connection_reported():
    one, two = edge("a", "base", 1), edge("b", "a", 2)
    closing = one.target_from_source @ two.target_from_source
    loop = Edge("b", "base", closing, "b to base")
    np.testing.assert_allclose(FrameTree("base", [one, two, loop]).ego_from("b").matrix, closing.matrix, atol=1e-12)
    tree = FrameTree("base", [one, edge("cam", "rig", 2)])
    assert (tree.frames, tree.loose) == (("base", "a", "cam", "rig"), ("cam", "rig"))
    for failing, problem in (
        (lambda: FrameTree("base", [one, two, Edge("base", "b", closing, "transforms[2]")]),
         r"contradicts the chain 'b' - 'base' - 'a' by .* m and .*°; is one of these"),
        (lambda: tree.ego_from("cam"), "'cam' to the ego's frame 'base'; it is connected with 'rig', the ego's"),
        (lambda: tree.ego_from("radar"),
         r"\(known frames: 'base', 'a', 'cam', 'rig'\); give it an `extrinsic`"),
        (lambda: FrameTree("base", [edge("a", "a", 1)]), "from 'a' to itself"),
    ):  # fmt: skip
        with pytest.raises(CalibrationError, match=problem):
            failing()


def test_axes_state_what_points_right_down_and_forward_and_mirrors_are_refused():
    for axes, rotated in (
        (("optical",), [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        (("flu",), [[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        (("frd",), [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
        (("-y", "-z", "+x"), [[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        (("x", "z", "-y"), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    ):
        assert frame_from_optical(axes).rotate(np.eye(3)).tolist() == rotated, axes
    for axes in (("body",), ("-y", "+z", "+x"), ("x", "x", "y"), ("x", "y"), ("x", "y", "w"), ("",)):
        with pytest.raises(CalibrationError):
            frame_from_optical(axes)


def test_both_directions_of_an_extrinsic_mean_the_same_and_angles_that_look_like_radians_are_remarked(opened):
    as_it_is = opened().cameras[0].mount.matrix
    inverse = opened(('to = "top", translation = [0.5, 0.0, -0.5]', 'from = "top", translation = [-0.5, 0.0, 0.5]'))
    np.testing.assert_allclose(inverse.cameras[0].mount.matrix, as_it_is, atol=1e-12)
    for euler, remarked in (
        ("[-1.5708, 0, -1.5708]", True), ("[0, 0, 3.14]", True), ("[1.5, 0.2, -0.8]", False), ("[0, 0, 0]", False),
    ):  # fmt: skip
        scene = opened(("quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]", f'euler_deg = {euler}\neuler_order = "zyx"'))
        assert codes(scene) == ["angles-in-radians"] * remarked, euler
