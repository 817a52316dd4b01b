"""Drives with a rig: bags without their tf, folders without extrinsics, what is missing, and rigs that are written."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.unit.formats.rig.conftest import write_folder
from tests.unit.formats.rig_files.test_reader import CHAIN, basalt

import sceneloom
from sceneloom.cameras import project_unbounded
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats import open_scene, write_scene
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="rosbags is not installed")
highlevel = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")

MODEL = Camera("brown_conrady", 48, 32, 30.0, 30.0, 23.5, 15.5, (-0.1, 0.01, 0.001, 0.002))
LEVER, RPY = [1.25, -0.5, 1.75], [0.02, -0.05, 0.3]
NOTES = "/sceneloom/scene"


@pytest.fixture(scope="module")
def street():
    """A drive whose lidar is mounted as URDF states it."""
    camera = CameraSpec(MODEL, camera_mount())
    scene = simulate_street(5, frames=3, lidar=LidarSpec(beams=4, steps=60), cameras=(camera,)).scene
    mount = RigidTransform(Rotation.from_euler("xyz", RPY).as_matrix(), np.array(LEVER))
    sensors = (replace(one, mount=mount, poses=None) if one.id == "lidar" else one for one in scene.sensors)
    return replace(scene, sensors=tuple(sensors))


def rewritten(sound, target, *without):
    """Write a bag again without some topics."""
    target.parent.mkdir(exist_ok=True)
    with highlevel.AnyReader([sound]) as reader, rosbag1.Writer(target) as bag:
        kept = [one for one in reader.connections if one.topic not in without]
        known = {one.id: bag.add_connection(one.topic, one.msgtype, typestore=reader.typestore) for one in kept}
        for connection, time_ns, raw in reader.messages(connections=kept):
            bag.write(known[connection.id], time_ns, raw)
    return target


def urdf_of(bag, target, *, names=None):
    """Write the fixed transforms of a bag as a URDF, number for number."""
    lines = ['<robot name="car">']
    with highlevel.AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            if connection.topic != "/tf_static":
                continue
            for one in reader.deserialize(raw, connection.msgtype).transforms:
                p, q = one.transform.translation, one.transform.rotation
                child = (names or {}).get(one.child_frame_id, one.child_frame_id)
                origin = f'xyz="{p.x!r} {p.y!r} {p.z!r}" quat_xyzw="{q.x!r} {q.y!r} {q.z!r} {q.w!r}"'
                lines.append(f'<joint name="{child}_joint" type="fixed"><origin {origin}/>')
                lines.append(f'<parent link="{one.header.frame_id}"/><child link="{child}"/></joint>')
    target.write_text("\n".join([*lines, "</robot>"]))
    return target


@pytest.fixture(scope="module")
def bags(street, tmp_path_factory):
    """The bag of a stranger, whole and without its fixed transforms and calibrations, and a URDF of those."""
    folder = tmp_path_factory.mktemp("bags")
    write_scene(street, folder / "sound.bag", images="raw")
    whole = rewritten(folder / "sound.bag", folder / "whole" / "drive.bag", NOTES)
    bare = rewritten(folder / "sound.bag", folder / "bare" / "drive.bag", NOTES, "/tf_static")
    blind = rewritten(folder / "sound.bag", folder / "blind" / "drive.bag", NOTES, "/tf_static", "/camera0/camera_info")
    return whole, bare, blind, urdf_of(whole, folder / "rig.urdf")


def codes(scene):
    return {one.code: one.message for one in scene.warnings}


def mounts(scene):
    return {one.id: one.mount.matrix for one in scene.sensors if getattr(one, "mount", None) is not None}


def written(scene, path):
    with scene:
        write_scene(scene, path)
    return path.read_bytes()


def test_a_bag_without_its_fixed_tf_and_a_urdf_of_it_give_the_bytes_of_the_whole_bag(bags, tmp_path):
    whole, bare, _, urdf = bags
    expected = written(open_scene(whole), tmp_path / "whole.sfs")
    assert written(open_scene(bare, rig=urdf), tmp_path / "rig.sfs") == expected
    assert written(open_scene(bare), tmp_path / "bare.sfs") != expected
    # rounded by no more than the last digit where the rotation is stated by angles, in our own URDF
    with open_scene(whole) as scene:
        write_scene(scene, tmp_path / "own.urdf")
    with open_scene(whole) as right, open_scene(bare, rig=tmp_path / "own.urdf") as found:
        assert mounts(found).keys() == mounts(right).keys() == {"lidar", "camera0"}
        for name, mount in mounts(right).items():
            np.testing.assert_allclose(mounts(found)[name], mount, atol=1e-14)
        np.testing.assert_allclose(found.lidars[0].poses.positions, right.lidars[0].poses.positions, atol=1e-9)
        np.testing.assert_allclose(
            mounts(right)["lidar"][:3, :3], Rotation.from_euler("xyz", RPY).as_matrix(), atol=1e-9
        )
    # what a bag states of its own gives way
    moved = urdf.read_text().replace('xyz="1.25 ', 'xyz="1.5 ')
    (tmp_path / "moved.urdf").write_text(moved)
    with open_scene(whole, rig=tmp_path / "moved.urdf") as found:
        assert mounts(found)["lidar"][0, 3] == 1.5
        assert codes(found)["rig-replaces"].startswith("the rig replaces the mounting of frame 'lidar' in 'base_link'")
    # transforms of another bag, and the notes of ours that name the frames
    with open_scene(bare, rig=whole) as found:
        np.testing.assert_array_equal(mounts(found)["lidar"], mounts(right)["lidar"])


def test_what_a_bag_lacks_is_asked_for_by_name_with_the_lines_to_write_and_these_lines_do(bags, tmp_path):
    _, bare, blind, urdf = bags
    with open_scene(blind) as scene:
        asked = [one.message for one in scene.warnings if one.code == "frames-missing"]
        assert "`--rig FILE`" in codes(scene)["camera-model-missing"]
    assert [message.partition(": ")[0] for message in asked] == [
        "no extrinsics of sensor 'camera0' (frame 'camera0')",
        "no extrinsics of sensor 'lidar' (frame 'lidar')",
    ]
    stated = asked[1].partition("or in a rig.toml as ")[2].replace("[X, Y, Z]", "[1, 2, 3]")
    (tmp_path / "rig.toml").write_text(stated.replace("[X, Y, Z, W]", "[0, 0, 0.6, 0.8]"))
    joint = asked[0].partition("in a URDF as ")[2].partition(", or in")[0]
    joint = joint.replace("X Y Z", "4 5 6").replace("R P Y", "0 0 0")
    (tmp_path / "car.urdf").write_text(f"<robot>{joint}</robot>")
    with open_scene(blind, rig=[tmp_path / "rig.toml", tmp_path / "car.urdf"]) as scene:
        assert "frames-missing" not in codes(scene)
        assert [mounts(scene)[name][:3, 3].tolist() for name in ("lidar", "camera0")] == [[1, 2, 3], [4, 5, 6]]
    with open_scene(bare, rig=urdf) as scene:
        assert "frames-missing" not in codes(scene)
    with pytest.raises(DataError, match=r"transforms\[0\]: contradicts the other transforms .* by 2\.81 m and 56\.6°"):
        open_scene(bare, rig=[urdf, tmp_path / "rig.toml"])


def test_names_that_differ_are_matched_by_statement_topic_or_the_only_one_and_else_refused(bags, tmp_path):
    whole, bare, blind, _ = bags
    other = urdf_of(whole, tmp_path / "other.urdf", names={"lidar": "velodyne", "camera0": "front"})
    (tmp_path / "kit.yaml").write_text("car:\n  top: {x: 0, y: 0, z: 2, roll: 0, pitch: 0, yaw: 0}\n")
    with pytest.raises(OptionError, match=r"kit\.yaml: none of its frames \(car, top\) is one of the drive's "):
        open_scene(bare, rig=tmp_path / "kit.yaml")
    names = {"lidar": "velodyne", "camera0": "front"}
    with open_scene(bare, rig=other, rig_names=names) as scene, open_scene(whole) as right:
        for name, mount in mounts(right).items():
            np.testing.assert_array_equal(mounts(scene)[name], mount)
    for wrong, problem in (("top=velodyne", "no sensor 'top'"), ("lidar=nix", "no frame or camera 'nix'")):
        with pytest.raises(OptionError, match=problem):
            open_scene(bare, rig=other, rig_names=(wrong,))
    # a tree that shares nothing with the drive but its ego; a camera's frame that has the axes of a body
    (tmp_path / "kit.yaml").write_text("base_link:\n  top: {x: 0, y: 0, z: 2, roll: 0, pitch: 0, yaw: 0}\n")
    with pytest.raises(OptionError, match="none of its frames"):
        open_scene(bare, rig=tmp_path / "kit.yaml")
    with open_scene(bare, rig=tmp_path / "kit.yaml", rig_names="camera0=top") as scene:
        assert "its x axis is taken as the optical axis" in codes(scene)["rig-frame-upright"]
        np.testing.assert_allclose(mounts(scene)["camera0"], camera_mount(position=(0.0, 0.0, 2.0)).matrix, atol=1e-12)
    # a chain of Kalibr knows the topic of the camera, beside a tree that has its IMU
    chain = CHAIN.partition("cam1:")[0].replace("/left/image_raw", "/camera0/image").replace("[640, 480]", "[48, 32]")
    (tmp_path / "chain.yaml").write_text(chain)
    joint = '<joint name="j" type="fixed"><parent link="base_link"/><child link="imu0"/><origin xyz="0 0 1"/></joint>'
    (tmp_path / "car.urdf").write_text(f"<robot>{joint}</robot>")
    with open_scene(blind, rig=[tmp_path / "chain.yaml", tmp_path / "car.urdf"]) as scene:
        assert "by its topic /camera0/image" in codes(scene)["rig-frame-taken"]
        assert scene.cameras[0].camera.model == scene.cameras[0].images[0].camera.model == "fisheye"
        np.testing.assert_allclose(mounts(scene)["camera0"][:3, 3], [-0.3, 0.1, 1.2], atol=1e-12)
    (tmp_path / "one.json").write_text(basalt("pinhole", {"fx": 60, "fy": 60, "cx": 47, "cy": 31}, (96, 64)))
    with open_scene(blind, rig=tmp_path / "one.json", rig_names="ego=imu0") as scene:
        assert "'cam0' is taken for the only camera 'camera0'" in codes(scene)["rig-camera-taken"]
        assert "the camera model was scaled" in codes(scene)["camera-model-scaled"]
        assert (scene.cameras[0].camera.width, scene.cameras[0].camera.fx) == (48, 30)
    (tmp_path / "one.json").write_text(basalt("pinhole", {"fx": 60, "fy": 60, "cx": 47, "cy": 31}, (96, 96)))
    with pytest.raises(OptionError, match=r"one\.json: value0\.intrinsics\[0\]: for 96x96, .* 48x32, another shape"):
        open_scene(blind, rig=tmp_path / "one.json", rig_names="ego=imu0")


def test_a_rig_replaces_what_a_drive_states_and_places_its_sensors_along_the_trajectory(street, tmp_path):
    write_scene(street, tmp_path / "drive", format="recording")
    joints = "".join(
        f'<joint name="{name}" type="fixed"><parent link="base_link"/><child link="{name}"/><origin {origin}/></joint>'
        for name, origin in (("lidar", 'xyz="0 0 2"'), ("camera0", 'xyz="1 0 2" rpy="0 0.1 0"'))
    )
    (tmp_path / "car.urdf").write_text(f"<robot>{joints}</robot>")
    with open_scene(tmp_path / "drive", rig=tmp_path / "car.urdf") as scene:
        replaced = [one.message for one in scene.warnings if one.code == "rig-replaces"]
        assert replaced[0].startswith("the rig replaces the mounting of sensor 'lidar': moved by 1.")
        assert "its x axis is taken as the optical axis" in codes(scene)["rig-frame-upright"]
        # the optical axis of the camera looks ahead and a little down
        np.testing.assert_allclose(mounts(scene)["camera0"][:3, 2], [np.cos(0.1), 0, -np.sin(0.1)], atol=1e-12)
        lidar = scene.lidars[0]
        ego = next(iter(scene.trajectories.values())).poses.interpolate(lidar.poses.timestamps_ns)
        moved = Rotation.from_quat(ego.quaternions_xyzw).apply([0, 0, 2]) + ego.positions
        np.testing.assert_allclose(lidar.poses.positions, moved, atol=1e-9)
    # a camera of Kalibr looks along z, wherever the IMU's axes point
    same = "[[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    chain = f"cam0:\n  T_imu_cam: {same}\n  rostopic: /camera0/image_raw\n"
    (tmp_path / "chain.yaml").write_text(chain)
    names = {"camera0": "cam0", "ego": "imu0"}
    with open_scene(tmp_path / "drive", rig=tmp_path / "chain.yaml", rig_names=names) as scene:
        np.testing.assert_array_equal(mounts(scene)["camera0"], RigidTransform(np.eye(3), np.array([0.5, 0, 0])).matrix)
    # and what the drive has placed places what it has not
    with open_scene(tmp_path / "drive", rig=tmp_path / "chain.yaml") as scene:
        np.testing.assert_allclose(mounts(scene)["camera0"], mounts(street)["camera0"], atol=1e-6)
    (tmp_path / "none.urdf").write_text(f"<robot>{joints.replace('lidar', 'top').replace('camera0', 'front')}</robot>")
    with pytest.raises(OptionError, match=r"none of its frames .* state which is which with `--rig-name SENSOR=FRAME`"):
        open_scene(tmp_path / "drive", rig=tmp_path / "none.urdf")
    with pytest.raises(OptionError, match="rig_names without rig"):
        open_scene(tmp_path / "drive", rig_names="lidar=top")


def test_own_data_without_extrinsics_and_intrinsics_takes_them_from_a_rig(tmp_path):
    folder = write_folder(tmp_path)
    manifest = (folder / "rig.toml").read_text()
    with open_scene(folder) as scene:
        expected = mounts(scene)
    bare = manifest.replace(manifest[manifest.index("[[transforms]]") : manifest.index("[[sensors]]")], "")
    bare = bare.replace("camera_model = { fx = 6.0, cx = 3.5, cy = 2.5 }\n", "")
    (folder / "rig.toml").write_text(bare)
    with pytest.raises(DataError, match="camera_model: missing"):
        open_scene(folder)
    joint = '<joint name="j" type="fixed"><parent link="base_link"/><child link="top"/><origin xyz="1 0 2"/></joint>'
    (tmp_path / "car.urdf").write_text(f"<robot>{joint}</robot>")
    info = "camera_name: front\nimage_width: 8\nimage_height: 6\ncamera_matrix: [6, 0, 3.5, 0, 6, 2.5, 0, 0, 1]\n"
    (tmp_path / "front.yaml").write_text(info)
    with open_scene(folder, rig=[tmp_path / "car.urdf", tmp_path / "front.yaml"]) as scene:
        assert "taken as the manifest's ego 'base'" in codes(scene)["rig-ego-taken"]
        assert scene.cameras[0].camera == Camera("pinhole", 8, 6, 6.0, 6.0, 3.5, 2.5)
        for name, mount in expected.items():
            np.testing.assert_allclose(mounts(scene)[name], mount, atol=1e-12)


@pytest.mark.parametrize(
    "model",
    [
        MODEL,
        Camera("pinhole", 48, 32, 30.0, 31.0, 23.5, 15.5),
        Camera("fisheye", 48, 32, 20.0, 20.0, 23.5, 15.5, (0.01, -0.002, 0.001, -0.0001)),
        Camera("omnidir", 48, 32, 60.0, 60.0, 23.5, 15.5, (-0.05, 0.1, 0.0, 1.2, 0.001, 0.002)),
    ],
    ids=lambda model: model.model,
)
def test_a_rig_that_is_written_is_read_back_and_is_what_opencv_reads(street, model, tmp_path):
    camera = replace(street.cameras[0], camera=model)
    scene = replace(street, sensors=(*(one for one in street.sensors if one.id != camera.id), camera))
    for name in ("rig.urdf", "rig-camchain.yaml", "rig.camera_info"):
        sceneloom.write(scene, tmp_path / name)
    ray = np.array([[0.3, -0.2, 1.0], [0.0, 0.1, 2.0]])
    info = tmp_path / "rig.camera_info" / "camera0.yaml"
    rigs = [[tmp_path / "rig-camchain.yaml", tmp_path / "rig.urdf"], [info, tmp_path / "rig.urdf"]]
    write_scene(street, tmp_path / "drive", format="recording")
    for rig in rigs:
        with open_scene(tmp_path / "drive", rig=rig) as found:
            for name, mount in mounts(scene).items():
                np.testing.assert_allclose(mounts(found)[name], mount, atol=1e-12)
            # ROS has no model of mirrors: the nearest of its own is a loss
            if not (rig[0] == info and model.model == "omnidir"):
                pixels = project_unbounded(found.cameras[0].camera, ray)
                np.testing.assert_allclose(pixels, project_unbounded(model, ray), atol=1e-9)
    if model.model == "brown_conrady":
        text = Path(info).read_text("utf-8")
        for name in ("camera_matrix", "distortion_coefficients"):
            text = text.replace(f"{name}:", f"{name}: !!opencv-matrix").replace("  data:", "  dt: d\n  data:", 1)
        Path(tmp_path / "opencv.yaml").write_text("%YAML:1.0\n---\n" + text.partition("rectification")[0])
        storage = cv2.FileStorage(str(tmp_path / "opencv.yaml"), cv2.FILE_STORAGE_READ)
        k = storage.getNode("camera_matrix").mat()
        pixels = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), k, np.array(model.coefficients))[0]
        np.testing.assert_allclose(pixels.reshape(-1, 2), project_unbounded(model, ray), atol=1e-9)


def test_a_drive_that_knows_no_mounting_and_no_camera_has_no_rig_to_write(street, tmp_path):
    lidar = replace(street.lidars[0], mount=None, poses=None)
    for name, problem in (
        ("r.urdf", "how any sensor is mounted"),
        ("r-camchain.yaml", "no camera with a camera model"),
    ):
        with pytest.raises(OptionError, match=problem):
            write_scene(replace(street, sensors=(lidar,)), tmp_path / name)
