"""A folder with a manifest as a scene."""

import pickle

import numpy as np
import pytest

import sceneloom
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.rig.spec import FORMAT
from sceneloom.scene import PointsFrame

from .conftest import FIRST_SENSOR, START_NS, codes


def test_sensors_have_the_ids_of_the_manifest_and_what_their_files_hold(opened):
    scene = opened()
    assert [(sensor.id, sensor.type) for sensor in scene.sensors] == [("top", "lidar"), ("front", "camera")]
    lidar, camera = scene.lidars[0], scene.cameras[0]
    assert lidar.frames.timestamps_ns.tolist() == [START_NS, START_NS + 100_000_000, START_NS + 200_000_000]
    assert lidar.frames[2].points.positions[1].tolist() == [6.0, 7.0, 8.0]
    assert lidar.frames[2].points.intensities.tolist() == [5, 9, 13, 17]
    assert lidar.points_frame is PointsFrame.SENSOR
    assert camera.images.timestamps_ns[0] == 1_532_402_927_650_000_000
    assert camera.images[1].rgb[0, 0].tolist() == [10, 20, 30]
    assert (camera.camera.width, camera.camera.height, camera.camera.fy) == (8, 6, 6.0)
    assert codes(scene) == []


def test_mountings_follow_the_chain_of_frames(opened):
    scene = opened()
    np.testing.assert_allclose(scene.lidars[0].mount.translation, [1.0, 0.0, 2.0])
    mount = scene.cameras[0].mount
    np.testing.assert_allclose(mount.translation, [1.5, 0.0, 1.5])
    # flu: what the camera looks along is the vehicle's x, its right is the vehicle's -y, its down the vehicle's -z
    np.testing.assert_allclose(mount.rotate(np.eye(3)), [[0, -1, 0], [0, 0, -1], [1, 0, 0]])


def test_sensors_have_poses_along_the_trajectory(opened):
    scene = opened()
    poses = scene.lidars[0].poses
    # 10 m/s along x from 0.5 s on, the lidar 1 m before and 2 m above the ego
    np.testing.assert_allclose(poses.positions, [[2.0, 0, 2], [3.0, 0, 2], [4.0, 0, 2]], atol=1e-9)


def test_the_folder_and_the_manifest_are_recognised_and_open_alike(folder):
    assert FORMAT.sniff(folder)
    assert FORMAT.sniff(folder / "rig.toml")
    for path in (folder, folder / "rig.toml"):
        with sceneloom.open(path) as scene:
            assert (scene.format, scene.source, len(scene.sensors)) == ("rig", str(folder), 2)


def test_a_manifest_of_another_name_is_recognised_by_its_sensors(folder):
    (folder / "rig.toml").rename(folder / "day.toml")
    assert not FORMAT.sniff(folder)
    assert FORMAT.sniff(folder / "day.toml")
    (folder / "other.toml").write_text("[project]\nname = 'x'\n")
    (folder / "broken.toml").write_text("sensors = [")
    assert not FORMAT.sniff(folder / "other.toml")
    assert not FORMAT.sniff(folder / "broken.toml")


def test_a_rig_is_not_written(opened, tmp_path):
    with pytest.raises(OptionError, match="a rig is only read; write a scene file"):
        sceneloom.write(opened(), tmp_path / "new.toml", format="rig")
    assert not (tmp_path / "new.toml").exists()


def test_unknown_options_are_refused(folder):
    with pytest.raises(OptionError, match="altitude"):
        FORMAT.open(folder, altitude="msl")


def test_nothing_but_the_manifest_and_first_heads_is_needed_to_open(folder, opened):
    for path in sorted((folder / "top").iterdir())[1:] + sorted((folder / "front").iterdir())[1:]:
        path.write_bytes(b"broken")
    scene = opened()
    with pytest.raises(DataError, match="6 bytes are 0 points"):
        scene.lidars[0].frames[1]
    with pytest.raises(DataError, match="no PNG and no JPEG"):
        _ = scene.cameras[0].images[2].rgb


def test_a_scene_goes_to_other_processes(opened):
    scene = pickle.loads(pickle.dumps(opened()))
    assert scene.lidars[0].frames[0].points.positions.shape == (4, 3)
    assert scene.cameras[0].images[0].rgb.shape == (6, 8, 3)
    scene.close()


def test_frames_that_are_not_connected_are_remarked_when_nothing_needs_them(opened):
    loose = f'[[transforms]]\nfrom = "a"\nto = "b"\ntranslation = [1, 0, 0]\n\n{FIRST_SENSOR}'
    assert codes(opened((FIRST_SENSOR, loose))) == ["loose-frames"]


def test_clocks_that_never_meet_are_remarked(opened):
    scene = opened(("start_s = 1532402927.65", "start_s = 0"))
    (warning,) = scene.warnings
    assert warning.code == "clocks-apart"
    assert "trajectory 'pose' begins 1532402927.300 s after sensor 'front'" in warning.message


def test_mountings_in_millimetres_are_remarked(opened):
    scene = opened(("[1.0, 0.0, 2.0]", "[1000.0, 0.0, 2000.0]"))
    assert [(n.code, "are these millimetres?" in n.message) for n in scene.warnings] == [("far-mount", True)] * 2


def test_fusing_a_rig_writes_a_scene(folder, tmp_path):
    sceneloom.fuse(sceneloom.open(folder), tmp_path / "out.sfs")
    with sceneloom.open(tmp_path / "out.sfs") as scene:
        assert [sensor.id for sensor in scene.lidars] == ["top"]
        assert len(scene.lidars[0].frames) == 3


def test_each_part_that_a_lenient_reading_leaves_out_is_known_by_its_location_and_its_fault(opened, folder):
    (folder / "poses.txt").write_text("1532402927.5 0 0 0 0 0 0 1\n1532402928.5 9 0 0 0 0 1\n")
    scene = opened(("top/*.bin", "tip/*.bin"), lenient=True)
    assert [sensor.id for sensor in scene.sensors] == ["front"]
    assert codes(scene) == ["parts-at-fault"] * 2
    reported = [f"{warning.location}: {warning.message}" for warning in scene.warnings]
    assert reported[0].startswith(f"{folder / 'rig.toml'}: trajectories[0]: left out: {folder / 'poses.txt'}: line 2: ")
    assert reported[1].startswith(f"{folder / 'rig.toml'}: sensors[0].files: left out: 'tip/*.bin': no such files")
