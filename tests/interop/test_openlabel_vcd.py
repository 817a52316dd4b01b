"""OpenLABEL files of VCD, the format's reference program, and ours in its hands.

The golden file was written by VCD 6.0.3 with `programs/openlabel_vcd_write.py`, which also printed the corners. What is
asked of VCD itself needs its environment: `SCENELOOM_OPENLABEL_PYTHON` names a Python that has `vcd` and `raillabel`.
"""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.peers import python_with

from sceneloom import scene as sc
from sceneloom.cameras.projection import project
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


# files of others


FILES = {
    "uai": ("example_cuboids", "test_bbox_simple_attributes"),
    "vcd": ("dmd", "test_create_streams_simple", "test_cuboids", "test_intrinsics", "test_scene_KITTI_Tracking_3",
        "test_transforms"),
}  # fmt: skip
NAMES = [f"{folder}/openlabel100_{name}.json" for folder, names in FILES.items() for name in names]
NAMES.append("vcd/openlabel_mapillary_poly2d_SRF6DCC.json")
KITTI, CONTOURS = NAMES[-3], NAMES[-1]


@pytest.fixture(scope="module")
def others(data_dir):
    folder = data_dir / "real" / "strangers" / "openlabel"
    if not folder.is_dir():
        pytest.skip(f"no OpenLABEL files of others at {folder}")
    return folder


def written(scene, path):
    losses = write_scene(scene, path, overwrite=True)
    return json.loads(path.read_text("utf-8")), losses


def written_anew(scene, path):
    """What we write of a scene without the document that it was read from."""
    kept = {name: value for name, value in scene.metadata["openlabel"].items() if name != "document"}
    return written(replace(scene, metadata={**scene.metadata, "openlabel": kept}), path)


@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_others_comes_back_equal_and_through_a_scene_file_too(others, tmp_path, name):
    content = json.loads((others / name).read_text("utf-8"))
    with open_scene(others / name) as scene:
        again, losses = written(scene, tmp_path / "again.json")
        assert (again, [*losses]) == (content, [])
        write_scene(scene, tmp_path / "scene.sfs")
    with open_scene(tmp_path / "scene.sfs") as scene:
        assert written(scene, tmp_path / "again.json")[0] == content


def test_of_a_file_of_others_only_what_changed_is_written_anew(others, tmp_path):
    content = json.loads((others / KITTI).read_text("utf-8"))["openlabel"]
    with open_scene(others / KITTI) as scene:
        car = next(one for one in scene.annotations if one.type == "cuboid" and one.parent_id == "2")
        moved = replace(car, path=replace(car.path, values=car.path.values + np.eye(9)[3]))
        left = [
            moved if one is car else one for one in scene.annotations if one.type != "link" or one.label != "Starts"
        ]
        again, _ = written(replace(scene, annotations=tuple(left)), tmp_path / "again.json")
    again = again["openlabel"]
    uids = {kind: {"objects": {"2"}}.get(kind, set()) for kind in ("objects", "actions", "events", "contexts")}
    for kind, changed in uids.items():
        assert again[kind].keys() == content[kind].keys()
        assert all(again[kind][uid] == one for uid, one in content[kind].items() if uid not in changed)
        for number, frame in content["frames"].items():
            here, there = frame.get(kind, {}), again["frames"][number].get(kind, {})
            assert {uid: there.get(uid) for uid in here.keys() - changed} == {u: here[u] for u in here.keys() - changed}
            assert again["frames"][number].get("frame_properties") == frame.get("frame_properties")
    with open_scene(tmp_path / "again.json") as scene:
        found = next(one for one in scene.annotations if one.id == moved.id)
        np.testing.assert_allclose(found.path.values[:, :6], moved.path.values[:, :6], rtol=0, atol=1e-9)


def test_contours_of_others_are_closed_chains_of_pixels(others):
    with open_scene(others / CONTOURS) as scene:
        rings = [one.path.vertices[0] for one in scene.annotations if one.type == "polygon_2d"]
    sides = [np.diff(ring, axis=0, append=ring[:1]) for ring in rings]
    # along rows, columns and diagonals, as the last one is, which leads to where the chain began
    assert all(((side == 0) | (np.abs(side) == np.abs(side).max(axis=1, keepdims=True))).all() for side in sides)
    assert sum(len(ring) > 1 for ring in rings) > 100


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


def test_what_we_write_of_files_of_others_passes_the_schema_kept_changed_or_anew(others, tmp_path, peer):
    paths = []
    for k, name in enumerate(NAMES):
        with open_scene(others / name) as scene:
            fewer = replace(scene, annotations=scene.annotations[1:])
            for how, one, write in (("anew", scene, written_anew), ("changed", fewer, written)):
                paths.append(tmp_path / f"{k}_{how}.json")
                write(one, paths[-1])
    assert dict(zip([path.name for path in paths], peer("openlabel_vcd_judge.py", "schema", *paths), strict=True)) == {
        path.name: [] for path in paths
    }


def test_chain_codes_lead_over_the_pixels_that_vcd_reads_from_them(tmp_path, peer):
    chains = peer("openlabel_vcd_judge.py", "chains")
    data = [{**data, "name": str(k)} for k, (data, _) in enumerate(chains)]
    objects = {"0": {"name": "", "type": "ring", "object_data": {"poly2d": data}}}
    content = {"openlabel": {"metadata": {"schema_version": "1.0.0"}, "objects": objects}}
    (tmp_path / "chains.json").write_text(json.dumps(content), "utf-8")
    with open_scene(tmp_path / "chains.json") as scene:
        rings = {one.id: one.path.vertices[0] for one in scene.annotations if one.type == "polygon_2d"}
    assert len(rings) == len(chains)
    for k, (_, expected) in enumerate(chains):
        assert rings[f"0:poly2d:{k}"].ravel().tolist() == expected


def test_the_fourth_column_of_a_camera_matrix_moves_the_camera_as_in_vcd(others, peer):
    rows = np.array([[-2.0, 0.5, 6.0], [1.0, -1.0, 12.0], [8.0, 1.5, 40.0]])
    with open_scene(others / KITTI) as scene:
        camera = scene.sensor("CAM_RIGHT")
        system = np.array(json.loads((others / KITTI).read_text("utf-8"))["openlabel"]["coordinate_systems"]
            ["CAM_RIGHT"]["pose_wrt_parent"]["matrix4x4"]).reshape(4, 4)  # fmt: skip
        lidar = scene.sensor("VELO_TOP").mount
        in_camera = camera.mount.inverse().apply(lidar.apply(RigidTransform.nearest(system)[0].apply(rows)))
        found, _ = project(camera.camera, in_camera)
    expected = peer("openlabel_vcd_judge.py", "project", others / KITTI, "CAM_RIGHT", json.dumps(rows.tolist()))
    # the rotation of the file is orthogonal to some 1e-9
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
