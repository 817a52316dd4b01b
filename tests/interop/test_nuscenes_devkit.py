"""The nuScenes development kit reads what we write: its own poses, boxes, points over images and classes.

It pins old packages, so it runs in an environment of its own: SCENELOOM_NUSCENES_PYTHON names its interpreter.
"""

import numpy as np
import pytest
from tests.peers import python_with
from tests.unit.formats.nuscenes.schema_folder import from_infos, street, with_classes

import sceneloom
from sceneloom.cameras import project
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_poses

PROGRAM = """
import json, sys
import matplotlib
matplotlib.use("Agg")
import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud, RadarPointCloud
root, version = sys.argv[1:]
kit = NuScenes(version=version, dataroot=root, verbose=False)
kit.colormap = {row["name"]: (0, 0, 230) for row in kit.category}
reported = []
for sample in kit.sample:
    frames = {}
    for channel, token in sample["data"].items():
        row = kit.get("sample_data", token)
        path, boxes, matrix = kit.get_sample_data(token)
        world = kit.get_boxes(token)
        frame = {
            "timestamp": row["timestamp"],
            "boxes": {b.name: [*b.center, *b.wlh] for b in boxes},
            "world": {b.token: [*b.center, *b.wlh, *b.orientation.elements] for b in world},
        }
        if row["sensor_modality"] == "camera":
            lidar = sample["data"]["LIDAR_TOP"]
            points, depths, image = kit.explorer.map_pointcloud_to_image(lidar, token, min_dist=0.1)
            frame["pixels"], frame["depths"] = points[:2].T.tolist(), depths.tolist()
            frame["size"] = image.size
        elif row["sensor_modality"] == "lidar":
            frame["points"] = LidarPointCloud.from_file(path).points.T[:, :4].tolist()
        else:
            frame["points"] = RadarPointCloud.from_file(path).points.T[:, :4].tolist()
        frames[channel] = frame
        kit.render_sample_data(token, verbose=False, out_path=root + "/drawn.png")
    kit.render_sample(sample["token"], verbose=False, out_path=root + "/drawn.png")
    reported.append(frames)
classes = {}
if hasattr(kit, "lidarseg"):
    for row in kit.lidarseg:
        labels = np.fromfile(root + "/" + row["filename"], np.uint8)
        names = [kit.lidarseg_idx2name_mapping[int(k)] for k in np.unique(labels)]
        classes[row["sample_data_token"]] = [len(labels), *names]
print(json.dumps({"samples": reported, "classes": classes, "scenes": [s["name"] for s in kit.scene]}))
"""


@pytest.fixture(scope="session")
def nuscenes_python():
    return python_with("nuscenes-devkit", "SCENELOOM_NUSCENES_PYTHON")


@pytest.fixture
def reported_by_kit(nuscenes_python, ask):
    return lambda root, version: ask(nuscenes_python, PROGRAM, root, version)


@pytest.fixture
def rewritten(tmp_path):
    scene = sceneloom.open(with_classes(street(tmp_path / "a"), dict.fromkeys((0, 2, 4), slice(3, 9))).write())
    sceneloom.write(scene, tmp_path / "b", format="nuscenes")
    return scene, tmp_path / "b"


def test_the_kit_loads_the_tables_and_finds_the_same_boxes_points_and_classes(reported_by_kit, rewritten):
    scene, root = rewritten
    reported = reported_by_kit(root, "v1.0-mini")
    assert reported["scenes"] == ["scene-0001"]
    assert sorted(reported["classes"].values()) == [[40 + k, "noise", "vehicle.car"] for k in (0, 2, 4)]
    lidar, radar = scene.lidars[0], scene.sensor("RADAR_FRONT")
    (car,) = (a for a in scene.annotations if a.type == "cuboid")
    for k, frames in enumerate(reported["samples"]):
        assert set(frames) == {"LIDAR_TOP", "RADAR_FRONT", "CAM_FRONT"}
        points = lidar.frames[2 * k].points
        found = np.array(frames["LIDAR_TOP"]["points"])
        assert np.allclose(found[:, :3], points.positions)
        assert found[:, 3].tolist() == points.intensities.tolist()
        assert len(frames["RADAR_FRONT"]["points"]) == len(radar.frames[2 * k].points)
        (world,) = frames["LIDAR_TOP"]["world"].values()
        box = cuboid_poses(car, [lidar.frames.timestamps_ns[2 * k]], angles=CuboidAngles.of(scene))
        length, width, height = box.sizes_lwh[0]
        assert np.allclose(world[:6], [*box.centers_world[0], width, length, height])
        w, x, y, z = world[6:]
        assert abs(np.dot([x, y, z, w], box.quaternions_xyzw[0])) == pytest.approx(1.0)


def pose(poses):
    return RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])


def test_the_kit_puts_points_of_a_real_frame_onto_images_where_we_do(reported_by_kit, data_dir, tmp_path):
    scene = sceneloom.open(from_infos(data_dir / "real" / "nuscenes_one_sample", tmp_path / "a").write())
    sceneloom.write(scene, tmp_path / "b", format="nuscenes")
    (frames,) = reported_by_kit(tmp_path / "b", "v1.0-mini")["samples"]
    again = sceneloom.open(tmp_path / "b")
    lidar = again.lidars[0]
    world = pose(lidar.poses).apply(lidar.frames[0].points.positions)
    for camera in again.cameras:
        seen = pose(camera.poses).inverse().apply(world)
        pixels, visible = project(camera.camera, seen)
        # the kit leaves out a pixel along the edges, and what is nearer than 10 cm
        inside = visible & (seen[:, 2] > 0.1)
        inside &= ((pixels > 1) & (pixels < [1599, 899])).all(axis=1)
        theirs = np.array(frames[camera.id]["pixels"])
        assert frames[camera.id]["size"] == [1600, 900]
        # it computes in float32 in the world, where a step is 0.1 mm: points near an edge fall to either side
        assert abs(len(theirs) - int(inside.sum())) <= 3
        ours = pixels[visible]
        nearest = [np.abs(ours - pixel).max(axis=1).min() for pixel in theirs[::40]]
        assert max(nearest) < 0.5


def test_the_kit_reads_drives_that_have_nothing_of_nuscenes(reported_by_kit, data_dir, tmp_path):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    scene = sceneloom.open(data_dir / "real" / "argoverse2", one_lidar=True)
    sceneloom.write(scene, tmp_path / "b", format="nuscenes", version="v1.0-test")
    (frames,) = reported_by_kit(tmp_path / "b", "v1.0-test")["samples"]
    assert len(frames["LIDAR_TOP"]["points"]) == len(scene.lidars[0].frames[0].points)
    assert len(frames["LIDAR_TOP"]["world"]) == 81
