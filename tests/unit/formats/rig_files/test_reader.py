"""Files of rigs: transforms against SciPy, camera models against OpenCV and papers, faults by their place."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras import project, project_unbounded
from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.rig_files.matching import RigSensor, match_frames, oriented
from sceneloom.formats.rig_files.reader import quaternion_of_rpy, read_rig

pytest.importorskip("ruamel.yaml", reason="ruamel.yaml is not installed")

URDF = """<robot name="car">
  <link name="base_link"/>
  <joint name="kit" type="fixed">
    <parent link="base_link"/><child link="kit"/><origin xyz="1 2 3" rpy="0.1 -0.2 0.3"/>
  </joint>
  <joint name="top" type="fixed"><parent link="kit"/><child link="top"/><origin xyz="0 0 1"/></joint>
  <joint name="side" type="fixed">
    <parent link="kit"/><child link="side"/><origin quat_xyzw="0 0 0.6 0.8" xyz="0 1 0"/>
  </joint>
  <joint name="wheel" type="continuous"><parent link="base_link"/><child link="wheel"/></joint>
</robot>"""
CHAIN = """%YAML:1.0
cam0:
  T_cam_imu: [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]]
  camera_model: pinhole
  distortion_model: equidistant
  distortion_coeffs: [-0.03, 0.07, -0.06, 0.02]
  intrinsics: [276.5, 278.0, 314.6, 240.2]
  resolution: [640, 480]
  rostopic: /left/image_raw
cam1:
  T_cn_cnm1: [[1, 0, 0, -0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: omni
  distortion_model: radtan
  distortion_coeffs: [-0.05, 0.5, -0.0003, 0.0002]
  intrinsics: [1.8, 1321.8, 1323.7, 352.6, 229.7]
  resolution: [752, 480]
"""
KIT = "base_link:\n  kit: {x: 0.9, y: 0, z: 2.0, roll: -0.001, pitch: 0.015, yaw: -0.0364}\n"
INFO = """image_width: 964
image_height: 724
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [484.1, 0, 457.2, 0, 484.5, 364.9, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.07, 0.003, 0.0003, 0.01]}
"""
OPENCV = """%YAML:1.0
---
image_width: 964
image_height: 724
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 484.1, 0., 457.2, 0., 484.5, 364.9, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 14
   cols: 1
   dt: d
   data: [ -0.2, 0.07, 0.003, 0.0003, 0.01, 0.02, 0.03, 0.004, 0.001, 0.002, 0.003, 0.004, 0., 0. ]
"""
MEI = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 752
image_height: 480
mirror_parameters: {xi: 1.8}
distortion_parameters: {k1: -0.05, k2: 0.5, p1: -0.0003, p2: 0.0002}
projection_parameters: {gamma1: 1321.8, gamma2: 1323.7, u0: 352.6, v0: 229.7}
"""
VINS = """%YAML:1.0
imu_topic: /imu
body_T_cam0: !!opencv-matrix
   rows: 4
   cols: 4
   dt: d
   data: [0, 0, 1, 0.1, -1, 0, 0, 0.2, 0, -1, 0, 0.3, 0, 0, 0, 1]
cam0_calib: "left.yaml"
image0_topic: /left
"""
MANIFEST = """transforms = [{ from = "top", to = "base_link", translation = [1, 2, 3], quaternion_xyzw = [0, 0, 0.6, 0.8] }]
sensors = [{ id = "front", extrinsic = { to = "top", translation = [1, 0, 0] }, camera_model = { width = 8, height = 6, fx = 6.0, cx = 3.5, cy = 2.5 } }]
"""  # noqa: E501 - a table in { } stands in one line
DS = {"fx": 158.286, "fy": 158.274, "cx": 254.961, "cy": 256.889, "xi": -0.17213, "alpha": 0.59312}
EUCM = {"fx": 460.0, "fy": 459.0, "cx": 365.5, "cy": 249.5, "alpha": 0.6, "beta": 1.1}


def basalt(kind, numbers, size=(512, 512)):
    pose = {"px": 0.1, "py": 0.2, "pz": 0.3, "qx": 0.0, "qy": 0.0, "qz": 0.6, "qw": 0.8}
    model = {"camera_type": kind, "intrinsics": numbers}
    return json.dumps({"value0": {"T_imu_cam": [pose], "intrinsics": [model], "resolution": [size]}})


FILES = {
    "rig.urdf": URDF, "camchain.yaml": CHAIN, "kit.yaml": KIT, "info.yaml": INFO, "opencv.yaml": OPENCV,
    "mei.yaml": MEI, "vins.yaml": VINS, "rig.toml": MANIFEST, "basalt.json": basalt("ds", DS),
}  # fmt: skip
"""A small file of each kind of text."""


@pytest.fixture
def rig(tmp_path):
    """Read the text of a file."""

    def read(name, text=None, **options):
        (tmp_path / "left.yaml").write_text(MEI)
        (tmp_path / name).write_text(FILES[name] if text is None else text)
        return read_rig(tmp_path / name, **options)

    return read


def poses(rig, root):
    """`root_from_frame`, (4, 4), of all frames below a root."""
    found = {root: np.eye(4)}
    for one in oriented(rig.transforms, [root]):
        if one.parent in found:
            found[one.child] = found[one.parent] @ one.parent_from_child.matrix
    return found


def rigid(rotation, translation):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def notes(rig):
    return {one.code: one.message for one in rig.ledger.warnings}


def test_fixed_joints_are_chained_as_scipy_has_them_and_others_are_listed(rig):
    found = rig("rig.urdf")
    kit = rigid(Rotation.from_euler("xyz", [0.1, -0.2, 0.3]).as_matrix(), [1, 2, 3])
    expected = {"base_link": np.eye(4), "kit": kit, "top": kit @ rigid(np.eye(3), [0, 0, 1])}
    expected["side"] = kit @ rigid(Rotation.from_quat([0, 0, 0.6, 0.8]).as_matrix(), [0, 1, 0])
    assert poses(found, "base_link").keys() == expected.keys()
    for name, pose in poses(found, "base_link").items():
        np.testing.assert_allclose(pose, expected[name], atol=1e-12)
    assert notes(found) == {"moving-joints": "1 joints move and are not used: wheel (base_link to wheel)"}
    # any frame may be the root
    np.testing.assert_allclose(poses(found, "top")["base_link"], np.linalg.inv(expected["top"]), atol=1e-12)
    for rpy in np.random.default_rng(1).uniform(-7, 7, (50, 3)):
        assert abs(quaternion_of_rpy(*rpy) @ Rotation.from_euler("xyz", rpy).as_quat()) == pytest.approx(1, abs=1e-14)


def test_chains_of_cameras_go_from_imu_to_camera_and_configurations_of_vins_the_other_way(rig):
    camera_from_imu = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]])
    second_from_first = rigid(np.eye(3), [-0.5, 0, 0])
    found = rig("camchain.yaml")
    chain = poses(found, "imu0")
    np.testing.assert_allclose(chain["cam0"], np.linalg.inv(camera_from_imu), atol=1e-12)
    np.testing.assert_allclose(chain["cam1"], np.linalg.inv(second_from_first @ camera_from_imu), atol=1e-12)
    assert found.topics == {"cam0": "/left/image_raw"}
    other = rig("camchain.yaml", CHAIN.replace("T_cam_imu", "T_imu_cam"))
    np.testing.assert_allclose(poses(other, "imu0")["cam0"], camera_from_imu, atol=1e-12)
    vins = rig("vins.yaml")
    np.testing.assert_allclose(poses(vins, "imu0")["cam0"][:3, 3], [0.1, 0.2, 0.3])
    assert (vins.cameras[0].names, vins.cameras[0].topic) == (("cam0", "camera", "left"), "/left")
    kit = poses(rig("kit.yaml"), "base_link")["kit"]
    np.testing.assert_allclose(
        kit[:3, :3], Rotation.from_euler("xyz", [-0.001, 0.015, -0.0364]).as_matrix(), atol=1e-12
    )
    manifest = rig("rig.toml")
    np.testing.assert_allclose(poses(manifest, "base_link")["front"][:3, 3], [1 + 0.28, 2 + 0.96, 3], atol=1e-12)
    # a camera whose axes are those of a body
    manifest = rig("rig.toml", MANIFEST.replace('id = "front",', 'id = "front", axes = "flu",'))
    front = poses(manifest, "top")["front"]
    np.testing.assert_allclose(front, rigid([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [1, 0, 0]), atol=1e-12)
    basalt_pose = poses(rig("basalt.json"), "imu0")["cam0"]
    expected = rigid(Rotation.from_quat([0, 0, 0.6, 0.8]).as_matrix(), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(basalt_pose, expected, atol=1e-12)


def test_optical_frames_of_a_kit_are_those_of_its_links_as_rep_103_has_them(rig):
    text = "kit:\n  front/camera_link: {x: 1, y: 0, z: 0, roll: 0, pitch: 0.1, yaw: 0.2}\n"
    found = rig("kit.yaml", text)
    sensor = RigSensor("front", is_camera=True, frame="front/camera_optical_link", topic="/front/image")
    made = replace(found, transforms=tuple(match_frames(found, [sensor], {})))
    link, optical = (poses(made, "kit")[f"front/camera_{name}"] for name in ("link", "optical_link"))
    # x right, y down, z forward of x forward, y left, z up
    np.testing.assert_allclose(optical[:3, :3], np.stack([-link[:3, 1], -link[:3, 2], link[:3, 0]], axis=1), atol=1e-12)
    assert "as REP 103 has it" in notes(found)["rig-frame-optical"]


POINTS = np.random.default_rng(2).uniform([-1, -1, 1.5], [1, 1, 4], (200, 3))
K, ZERO = np.array([[484.1, 0, 457.2], [0, 484.5, 364.9], [0, 0, 1]]), np.zeros(3)
FOURTEEN = np.array([-0.2, 0.07, 0.003, 0.0003, 0.01, 0.02, 0.03, 0.004, 0.001, 0.002, 0.003, 0.004, 0, 0])


@pytest.mark.parametrize("name", ["info.yaml", "opencv.yaml", "camchain.yaml", "mei.yaml"])
def test_camera_models_project_as_opencv_does(rig, name):
    found, points = rig(name).cameras, POINTS[:, None]
    if name in ("info.yaml", "opencv.yaml"):
        coefficients = FOURTEEN if name == "opencv.yaml" else FOURTEEN[:5]
        expected = [cv2.projectPoints(points, ZERO, ZERO, K, coefficients)[0]]
    else:
        plane = np.array([[1321.8, 0, 352.6], [0, 1323.7, 229.7], [0, 0, 1]])
        mirrored = np.array([-0.05, 0.5, -0.0003, 0.0002])
        expected = [cv2.omnidir.projectPoints(points, ZERO, ZERO, plane, 1.8, mirrored)[0]]
    if name == "camchain.yaml":
        matrix = np.array([[276.5, 0, 314.6], [0, 278.0, 240.2], [0, 0, 1]])
        coefficients = np.array([-0.03, 0.07, -0.06, 0.02])
        expected.insert(0, cv2.fisheye.projectPoints(points, ZERO, ZERO, matrix, coefficients)[0])
    for camera, pixels in zip(found, expected, strict=True):
        np.testing.assert_allclose(project_unbounded(camera.camera, POINTS), pixels.reshape(-1, 2), atol=1e-9)


def on_plane(kind, numbers, points):
    """The double sphere and the (extended) unified model as Usenko and others 2018 have them."""
    x, y, z = points.T
    alpha = numbers["alpha"]
    if kind == "ds":
        first = np.sqrt(x * x + y * y + z * z)
        depth = numbers["xi"] * first + z
        scale = alpha * np.sqrt(x * x + y * y + depth**2) + (1 - alpha) * depth
    else:
        scale = alpha * np.sqrt(numbers.get("beta", 1.0) * (x * x + y * y) + z * z) + (1 - alpha) * z
    return np.stack([numbers["fx"] * x / scale + numbers["cx"], numbers["fy"] * y / scale + numbers["cy"]], axis=1)


@pytest.mark.parametrize(
    ("kind", "numbers", "size"),
    [("ds", DS, (512, 512)), ("eucm", EUCM, (752, 480)), ("ucm", {**EUCM, "beta": 1.0}, (752, 480))],
)
def test_models_that_we_do_not_have_are_met_within_a_thousandth_of_a_pixel_and_it_is_said_so(rig, kind, numbers, size):
    found = rig("basalt.json", basalt(kind, numbers, size))
    points = np.random.default_rng(3).normal(size=(5000, 3))
    expected = on_plane(kind, numbers, points)
    pixels, visible = project(found.cameras[0].camera, points)
    inside = visible & (np.abs(expected - np.array(size) / 2) < np.array(size) / 2 - 1).all(axis=1)
    assert inside.sum() > 500
    assert np.abs(pixels - expected)[inside].max() < 1e-3
    assert ("off by up to" in notes(found).get("camera-model-fitted", "")) is (kind != "ucm")


@pytest.mark.parametrize(
    ("name", "old", "new", "problem"),
    [
        ("rig.urdf", "fixed", "welded", r"rig\.urdf: joint 'kit': type 'welded'; expected one of fixed"),
        ("rig.urdf", 'link="top"', 'link="kit"', r"joint 'top': child link 'kit' is also that of joint 'kit'"),
        ("rig.urdf", "0.1 -0.2", "0.1", r"joint 'kit' origin rpy: 2 numbers; expected 3"),
        ("rig.urdf", "1 2 3", "1 2 x", r"joint 'kit' origin xyz: '1 2 x'; expected numbers within"),
        ("rig.urdf", "0 0 0.6", "0 0 6", r"side' origin quat_xyzw: quaternion .* of length 6\.053; expected 1"),
        ("rig.urdf", '<parent link="kit"/>', "", r"joint 'top': no <parent link"),
        ("rig.urdf", "</robot>", "", r"line 11, column 1: is no XML: no element found"),
        ("rig.urdf", "robot", "model", r"root element 'model'; expected <robot>"),
        ("rig.urdf", "1 2 3", "${x} 2 3", r"is xacro with macros; expand them first: xacro rig\.urdf > rig\.urdf"),
        ("camchain.yaml", "0, 0.1]", "1, 0.1]", r"cam0\.T_cam_imu: rotation off by \d"),
        ("camchain.yaml", "[640, 480]", "[640]", r"cam0\.resolution: 1 numbers; expected 2"),
        ("camchain.yaml", "equidistant", "square", r"cam0: distortion 'square' of pinhole; expected one of plumb_bob"),
        ("camchain.yaml", "-0.03, ", "", r"cam0: 3 coefficients of equidistant; expected 4"),
        ("camchain.yaml", "omni", "mirror", r"cam1: camera model 'mirror'; expected one of pinhole, omni"),
        ("camchain.yaml", "278.0, ", "", r"cam0: 3 intrinsics of pinhole; expected fx fy cx cy"),
        ("camchain.yaml", "[276.5", "[[276.5", r"camchain\.yaml: line \d+, column \d+: cannot be read: is no YAML"),
        ("kit.yaml", "x: 0.9", "x: far", r"base_link\.kit\.x: 'far'; expected numbers"),
        ("kit.yaml", ", yaw: -0.0364", "", r"base_link\.kit: no 'yaw'; it has x, y, z, roll, pitch"),
        ("kit.yaml", "kit", "base_link", r"from frame 'base_link' to itself"),
        ("info.yaml", "image_width", "width_px", r"info\.yaml: no 'image_width'; it has width_px"),
        ("info.yaml", "[484.1, 0,", "[484.1, 9,", r"camera_matrix: \[484.1, 9.0.*expected \[fx 0 cx"),
        ("info.yaml", "[484.1", "[-484.1", r"focal lengths -484\.1, 484\.5; expected positive"),
        ("mei.yaml", "MEI", "SCARAMUZZA", r"model_type: 'SCARAMUZZA'; expected PINHOLE, MEI"),
        ("mei.yaml", "xi: 1.8", "xy: 1.8", r"mirror_parameters: no 'xi'; it has xy"),
        ("vins.yaml", "0, 0, 0, 1]", "0, 0, 1]", r"body_T_cam0: 15 numbers; expected 16 or 12"),
        ("rig.toml", '"top", to', '"base_link", to', r"rig\.toml: transforms\[0\]: from 'base_link' to itself"),
        ("rig.toml", "fx = 6.0", "fx = -6.0", r"sensors\[0\]\.camera_model\.fx: -6\.0; expected a number"),
        ("rig.toml", 'id = "front",', 'id = "front", axes = 3,', r"sensors\[0\]\.axes: 3; expected a word"),
        ("basalt.json", '"ds"', '"dc"', r"value0\.intrinsics\[0\]\.camera_type: 'dc'; expected one of pinhole"),
        ("basalt.json", "[512, 512]", "", r"0 resolutions; expected as many of each"),
        ("basalt.json", "value0", "value", r"has value; expected URDF"),
        ("basalt.json", "{", "{{", r"is no JSON"),
    ],
)  # fmt: skip
def test_a_fault_is_reported_with_file_place_value_and_what_was_expected(rig, name, old, new, problem):
    assert old in FILES[name]
    with pytest.raises(DataError, match=problem):
        rig(name, FILES[name].replace(old, new, 1 if old != "robot" else 2))


def test_what_is_no_rig_and_names_that_are_none_are_refused(rig, tmp_path):
    for text in ("", "a: 1\n", "- 1\n", "hello"):
        with pytest.raises(DataError, match="expected URDF, Kalibr's camchain"):
            rig("other.yaml", text)
    with pytest.raises(DataError, match=r"none\.urdf: no such file; expected URDF"):
        read_rig(tmp_path / "none.urdf")
    with pytest.raises(OptionError, match="rig name 'lidar'; expected SENSOR=NAME"):
        rig("rig.urdf", names=("lidar",))
    contradicting = CHAIN.replace("T_cn_cnm1", "T_cam_imu: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]\n  T_cn_cnm1")
    with pytest.raises(SceneloomError, match=r"contradicts the other transforms between 'cam0' and 'cam1' by 0\.\d+ m"):
        oriented(rig("camchain.yaml", contradicting).transforms, ["imu0"])


def test_rigs_of_others_are_read_as_scipy_and_opencv_have_them(data_dir):
    folder = data_dir / "real" / "strangers"
    if not folder.is_dir():
        pytest.skip("no files of others beside the real data")
    edgar = poses(read_rig(folder / "rigs" / "edgar" / "edgar.urdf"), "base_link")
    rpy = [-0.3461248, 0.0165291, -0.0162606]
    lidar = rigid(Rotation.from_euler("xyz", rpy).as_matrix(), [2.312053, 0.581505, 1.610277 + 0.338])
    np.testing.assert_allclose(edgar["lidar_ouster_frontleft"], lidar, atol=1e-12)
    # the kit of the same vehicle has a camera where its URDF has it
    kits = [folder / "rigs" / "edgar" / f"{name}_calibration.yaml" for name in ("sensor_kit", "sensors")]
    np.testing.assert_allclose(poses(read_rig(kits), "base_link")["lidar_ouster_frontleft"], lidar, atol=1e-12)
    fetch = read_rig(folder / "rigs" / "fetch" / "fetch.urdf")
    assert len(fetch.transforms) == 10
    assert notes(fetch)["moving-joints"].startswith("15 joints move")
    bags = [read_rig(folder / "tf_bags" / f"tf_example.{suffix}") for suffix in ("bag", "db3")]
    assert [[(one.parent, one.child) for one in bag.transforms] for bag in bags] == [
        [("base_footprint", "base_link")]
    ] * 2
    # corners that somebody clicked in an image and a cloud, with their extrinsics
    clicked = folder / "rigs" / "camera_info_heethesh"
    extrinsics = np.load(clicked / "extrinsics.npz")
    corners = np.load(clicked / "pcl_corners.npy") @ extrinsics["R"].T + extrinsics["T"].ravel()
    camera = read_rig(clicked / "ost.yaml").cameras[0].camera
    off = np.linalg.norm(project_unbounded(camera, corners) - np.load(clicked / "img_corners.npy"), axis=1)
    assert np.median(off) < 10
    kalibr = read_rig(folder / "rigs" / "kalibr_ironsides" / "kalibr_imucam_chain.yaml")
    baseline = poses(kalibr, "cam0")["cam1"][:3, 3]
    assert np.linalg.norm(baseline) == pytest.approx(0.0664, abs=1e-3)
