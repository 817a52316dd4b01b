"""OpenLABEL files of VCD, the format's reference program, and ours in its hands.

The golden file was written by VCD 6.0.3 with `programs/openlabel_vcd_write.py`, which also printed the corners. What is
asked of VCD itself needs its environment: `SCENELOOM_OPENLABEL_PYTHON` names a Python that has `vcd` and `raillabel`.
"""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tests.peers import python_with

from sceneloom import scene as sc
from sceneloom.formats.base.registry import open_scene, write_scene
from sceneloom.geometry.boxes import box_corners
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_poses

HERE = Path(__file__).parent
GOLDEN = HERE / "golden" / "openlabel_vcd.json"
LIMIT_S = 120


def corners_of(scene, cuboid):
    values = cuboid.path.values
    quaternions = CuboidAngles.of(scene).quaternions(values[:, 6:])
    pairs = zip(values, quaternions, strict=True)
    return np.stack([box_corners(row[3:6], row[:3], rotation) for row, rotation in pairs])


def same_corners(found, expected):
    """Corners in any order: each has one that lies on it."""
    distances = np.linalg.norm(np.asarray(found)[:, None] - np.asarray(expected)[None], axis=2)
    # the golden corners are rounded to nine digits
    assert distances.min(axis=1).max() < 1e-8
    assert distances.min(axis=0).max() < 1e-8


def test_all_that_vcd_says_is_read_and_its_boxes_stand_where_vcd_puts_them():
    with open_scene(GOLDEN) as scene:
        by_id = {one.id: one for one in scene.annotations}
        kinds = {type(one).__name__.removesuffix("Annotation") for one in by_id.values()}
        assert kinds == {"Object", "Cuboid", "Box2D", "Shape", "Event", "Link"}
        assert by_id["0:bbox:shape2d"].path.values[0].tolist() == [80, 65, 40, 30]
        assert by_id["0:bbox:shape2d"].sensor_id == "front"
        assert by_id["0:bbox:shape2d"].attributes[0].values == (False, True, False)
        assert by_id["0"].attributes[0].values == (0.0, 1.5, 3.0)
        assert by_id["action:0"].duration_ns == 1_000_000_000
        assert (by_id["relation:0"].from_id, by_id["relation:0"].to_id) == ("1", "action:0")
        front = scene.sensor("front")
        assert front.camera.coefficients == (-0.1, 0.02, 0.001, -0.002, 0.003)
        # the camera looks along the vehicle's x axis
        np.testing.assert_allclose(front.mount.rotate(np.array([0.0, 0.0, 1.0])), [1, 0, 0], atol=1e-12)
        assert np.diff(scene.trajectories["vehicle-iso8855"].timestamps_ns).tolist() == [10**9, 10**9]
    expected = json.loads((HERE / "golden" / "openlabel_vcd_corners.json").read_text())["corners_odom"]
    with open_scene(GOLDEN) as scene:
        car = next(one for one in scene.annotations if one.type == "cuboid" and one.label == "Car")
        for found, there in zip(corners_of(scene, car), expected, strict=True):
            same_corners(found, there)


# with VCD and RailLabel themselves


@pytest.fixture(scope="module")
def peer():
    python = python_with("vcd and raillabel", "SCENELOOM_OPENLABEL_PYTHON")

    def run(program, *arguments):
        command = [python, str(HERE / "programs" / program), *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.strip().splitlines()[-1])

    return run


def drive():
    timestamps = np.arange(3) * 100_000_000 + 1_700_000_000_000_000_000
    frames = [sc.LidarFrame(int(t), sc.LidarPoints(np.ones((1, 3), np.float32))) for t in timestamps]
    mount = RigidTransform.from_quaternion(np.array([1.0, 0.2, 1.9]), np.array([0.1, -0.2, 0.3, 0.9]))
    rng = np.random.default_rng(1)
    rotations = rng.normal(size=(3, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    trajectory = sc.Trajectory("pose", timestamps, rng.normal(scale=10, size=(3, 3)), rotations)
    values = np.concatenate([rng.uniform(1, 5, (3, 3)), rng.normal(size=(3, 3)), rng.uniform(-80, 80, (3, 3))], axis=1)
    box = sc.CuboidAnnotation(
        "car",
        sc.CuboidPath(timestamps, values),
        "Car",
        attributes=(sc.AttributePath("speed", (1.0, 2.0, 3.0), timestamps),),
    )
    flat = sc.Box2DAnnotation("car 2", "top", sc.BoxPath(timestamps[:1], np.array([[1.0, 2, 3, 4]])), "Car")
    lane = sc.ShapeAnnotation("lane", sc.ShapeType.POLYLINE, sc.VertexPath(timestamps[:1], (rng.normal(size=(4, 3)),)))
    event = sc.EventAnnotation("stop", int(timestamps[0]), 100_000_000, "Stop")
    link = sc.LinkAnnotation("l", "car", "stop", "does")
    lidar = sc.LidarSensor("top", sc.LazyFrames.of(frames, timestamps), mount=mount)
    flat_box = sc.BoxPath(timestamps[:1], np.array([[1.0, 2, 3, 4]]))
    path = sc.CuboidPath(timestamps[[0, 2]], values[[0, 2]])
    seen = (sc.Projection("top", timestamps[:1], np.array([[1.0, 2, 3, 4]]), (True,)),)
    van = (
        sc.ObjectAnnotation("van", "Van"),
        sc.CuboidAnnotation("box of the van", path, "Van", parent_id="van", projections=seen),
        sc.Box2DAnnotation("flat", "top", flat_box, "Van", parent_id="van"),
    )
    return sc.Scene((lidar,), (box, flat, lane, event, link, *van), {"pose": trajectory}), mount


def test_our_files_pass_the_schema_and_vcd_puts_boxes_and_sensors_where_we_do(tmp_path, peer):
    scene, mount = drive()
    write_scene(scene, tmp_path / "ours.json")
    reported = peer("openlabel_vcd_read.py", tmp_path / "ours.json")
    assert reported["errors"] == []
    for number, found in enumerate(corners_of(scene, scene.annotations[0])):
        same_corners(found, reported["corners"][f"car {number}"])
    # one object of three annotations; VCD finds its cuboid in the frame between two key frames, too
    assert reported["objects"] == ["car", "car 2", "lane", "van"]
    van = next(one for one in scene.annotations if one.id == "box of the van")
    poses = cuboid_poses(van, scene.annotations[0].path.timestamps_ns, angles=CuboidAngles.of(scene))
    for number in range(3):
        found = box_corners(poses.centers_world[number], poses.sizes_lwh[number], poses.quaternions_xyzw[number])
        same_corners(found, reported["corners"][f"van {number}"])
    assert reported["loaded"] == {"bbox": 2, "cuboid": 1}
    trajectory = scene.trajectories["pose"]
    for k, found in enumerate(reported["lidar_to_world"]):
        ego = RigidTransform.from_quaternion(trajectory.positions[k], trajectory.quaternions_xyzw[k])
        np.testing.assert_allclose(found, (ego @ mount).matrix, rtol=0, atol=1e-9)


def test_files_written_by_vcd_and_raillabel_now_are_read(tmp_path, peer):
    reported = peer("openlabel_vcd_write.py", tmp_path / "theirs.json")
    with open_scene(tmp_path / "theirs.json") as scene:
        car = next(one for one in scene.annotations if one.type == "cuboid" and one.label == "Car")
        for found, there in zip(corners_of(scene, car), reported["corners_odom"], strict=True):
            same_corners(found, there)
    reported = peer("openlabel_raillabel_write.py", tmp_path / "rail.json")
    with open_scene(tmp_path / "rail.json") as scene:
        cuboid = next(one for one in scene.annotations if one.type == "cuboid")
        np.testing.assert_allclose(cuboid.path.values[0, :6], reported["size_and_position"], rtol=0, atol=1e-9)
        assert cuboid.path.timestamps_ns.tolist() == reported["timestamps_ns"]
        camera = next(one for one in scene.sensors if one.id == "rgb_center")
        assert [camera.camera.fx, camera.camera.cy] == reported["fx_cy"]
