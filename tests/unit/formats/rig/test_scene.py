"""A folder with a manifest as a scene; a simulated drive, written as plain files, opens as the drive that it was."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.rig.spec import FORMAT
from sceneloom.scene import PointsFrame
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

from .conftest import FIRST_SENSOR, START_NS, codes


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


@pytest.mark.parametrize(
    ("change", "expected_codes", "message"),
    [
        ((FIRST_SENSOR, f'[[transforms]]\nfrom = "a"\nto = "b"\ntranslation = [1, 0, 0]\n\n{FIRST_SENSOR}'),
         ["loose-frames"], "'a', 'b' are not connected with 'base'"),
        (("start_s = 1532402927.65", "start_s = 0"), ["clocks-apart"],
         "trajectory 'pose' begins 1532402927.300 s after sensor 'front'"),
        (("[1.0, 0.0, 2.0]", "[1000.0, 0.0, 2000.0]"), ["far-mount"] * 2, "are these millimetres?"),
    ],
)  # fmt: skip
def test_what_is_hardly_meant_is_remarked(opened, change, expected_codes, message):
    scene = opened(change)
    assert codes(scene) == expected_codes
    assert all(message in warning.message for warning in scene.warnings)


def test_each_part_that_a_lenient_reading_leaves_out_is_known_by_its_location_and_its_fault(opened, folder):
    (folder / "poses.txt").write_text("1532402927.5 0 0 0 0 0 0 1\n1532402928.5 9 0 0 0 0 1\n")
    scene = opened(("top/*.bin", "tip/*.bin"), lenient=True)
    assert [sensor.id for sensor in scene.sensors] == ["front"]
    assert codes(scene) == ["parts-at-fault"] * 2
    reported = [f"{warning.location}: {warning.message}" for warning in scene.warnings]
    assert reported[0].startswith(f"{folder / 'rig.toml'}: trajectories[0]: left out: {folder / 'poses.txt'}: line 2: ")
    assert reported[1].startswith(f"{folder / 'rig.toml'}: sensors[0].files: left out: 'tip/*.bin': no such files")


CAMERA_MODEL = Camera("brown_conrady", 96, 64, 60.0, 61.0, 47.5, 31.5, (-0.2, 0.05, 0.001, -0.001, 0.01))
CLOUD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("i", "u1"), ("ring", "<u2"), ("t", "<i8")])
PCD = "FIELDS x y z i ring t\nSIZE 4 4 4 1 2 8\nTYPE F F F U U I\nWIDTH {}\nHEIGHT 1\nDATA binary\n"


@pytest.fixture(scope="module")
def drive():
    """Three sweeps of a coarse lidar and a small camera with distortion."""
    return simulate_street(4, frames=3, lidar=LidarSpec(beams=16, steps=300), cameras=(CameraSpec(CAMERA_MODEL),)).scene


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
camera_model = {{ fx = 60, fy = 61, cx = 47.5, cy = 31.5, coefficients = {list(CAMERA_MODEL.coefficients)} }}
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
    assert scene.cameras[0].camera == CAMERA_MODEL
    for found, known in zip(scene.sensors, (drive.lidars[0], drive.cameras[0]), strict=True):
        np.testing.assert_allclose(found.mount.matrix, known.mount.matrix, atol=1e-12)
    truth = drive.trajectories["groundTruth"]
    np.testing.assert_array_equal(scene.trajectories["truth"].timestamps_ns, truth.timestamps_ns)
    # an ego frame without transforms is the trajectory's own
    np.testing.assert_allclose(scene.trajectories["truth"].positions, truth.positions, atol=1e-12)
