"""Files of each tool, made by hand to its description: what is read of them is what the description says."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sceneloom.errors import DataError, OptionError
from sceneloom.formats import open_scene
from sceneloom.formats.points.cloud import WrittenPoints
from sceneloom.formats.points.files import open_cloud_writer
from sceneloom.scene.annotations_at import CuboidAngles, attribute_at

NEAR = 1e-9
POINTS = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.float32)
CAMERA_FROM_CLOUD = [0, -1, 0, 0.1, 0, 0, -1, 0.2, 1, 0, 0, 0.3]  # looks along the cloud's x
INTRINSICS = [50, 0, 31.5, 0, 50, 23.5, 0, 0, 1]
QUARTER = Rotation.from_euler("z", 90, degrees=True).as_quat()


def put(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value), "utf-8")


def put_cloud(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    with open_cloud_writer(path) as writer:
        writer.add(WrittenPoints(POINTS.astype(np.float64)))


def put_image(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (64, 48), (9, 9, 9)).save(path)


def vector(*values):
    return dict(zip("xyz", values, strict=True))


def forward_of(scene, row=0):
    """Position, size and forward axis of the first cuboid."""
    values = scene.annotations[0].path.values[row]
    rotation = Rotation.from_quat(CuboidAngles.of(scene).quaternions(values[6:]))
    return values[3:6], values[:3], rotation.apply([1, 0, 0])


# Supervisely


def figure(key, *, yaw=0.0):
    geometry = {"position": vector(1, 2, 3), "rotation": vector(0, 0, yaw), "dimensions": vector(1.5, 4.0, 1.2)}
    return {"key": "f" * 32, "objectKey": key, "geometryType": "cuboid_3d", "geometry": geometry}


@pytest.fixture
def episode(tmp_path):
    """Three frames of which one has no cloud; an object with tags in ranges, and one of points."""
    root, car, road = tmp_path / "project", "a" * 32, "b" * 32
    folder = root / "ds0"
    names = {str(k): f"scan_{1_500_000_000_000_000_000 + k * 100_000_000}.pcd" for k in range(3)}
    tags = [{"name": "state", "value_type": "any_string"}, {"name": "seen", "value_type": "none"}]
    classes = [{"title": "car", "shape": "cuboid_3d", "color": "#FF0000"}, {"title": "road", "shape": "point_cloud"}]
    put(root / "meta.json", {"classes": classes, "tags": tags, "projectType": "point_cloud_episodes"})
    put(folder / "frame_pointcloud_map.json", names)
    spans = [{"name": "state", "value": "parked", "frameRange": [0, 1]}, {"name": "seen"}]
    points = {"key": "e" * 32, "objectKey": road, "geometryType": "point_cloud", "geometry": {"indices": [0, 2]}}
    put(
        folder / "annotation.json",
        {
            "description": "",
            "tags": [{"name": "state", "value": "wet", "frameRange": [1, 2]}],
            "objects": [
                {"key": car, "classTitle": "car", "tags": spans},
                {"key": road, "classTitle": "road", "tags": []},
            ],
            "framesCount": 3,
            "frames": [
                {"index": 0, "figures": [figure(car), points]},
                {"index": 2, "figures": [figure(car, yaw=np.pi / 2)]},
            ],
        },
    )
    for k in (0, 2):
        put_cloud(folder / "pointcloud" / names[str(k)])
    image = folder / "related_images" / names["0"].replace(".", "_") / "front.png"
    put_image(image)
    data = {"extrinsicMatrix": CAMERA_FROM_CLOUD, "intrinsicMatrix": INTRINSICS}
    meta = {"deviceId": "FRONT", "timestamp": "2017-07-14T02:40:00.050Z", "sensorsData": data}
    put(image.with_name("front.png.json"), {"name": "front.png", "meta": meta})
    return root


def test_an_episode_is_read_as_described(episode):
    scene = open_scene(episode)
    center, size, forward = forward_of(scene)
    np.testing.assert_allclose(center, [1, 2, 3], atol=NEAR)
    np.testing.assert_allclose(size, [4.0, 1.5, 1.2], atol=NEAR)
    np.testing.assert_allclose(forward, [0, 1, 0], atol=NEAR)  # along +y at yaw 0
    np.testing.assert_allclose(forward_of(scene, 1)[2], [-1, 0, 0], atol=NEAR)
    car, road = scene.annotations
    assert (car.id, car.label) == ("a" * 32, "car")
    times = 1_500_000_000_000_000_000 + np.arange(3) * 100_000_000
    stated = {path.name: attribute_at(path, times) for path in car.attributes}
    assert stated == {"state": ["parked", "parked", None], "seen": [True] * 3}
    assert attribute_at(scene.attributes[0], times) == [None, "wet", "wet"]
    assert car.activations[0].timestamps_ns.tolist() == times[[0, 2]].tolist()
    assert [(one.sensor_frame, one.point_ids.tolist()) for one in road.labeled_points] == [(0, [0, 2])]
    assert scene.lidars[0].frames.timestamps_ns.tolist() == times[[0, 2]].tolist()
    front = scene.sensor("FRONT")
    assert front.images[0].timestamp_ns == times[0] + 50_000_000
    assert (front.camera.fx, front.camera.cx, front.camera.width) == (50, 31.5, 64)
    seen = scene.samples()[0].camera_from_points["FRONT"].apply(POINTS)
    expected = np.array(CAMERA_FROM_CLOUD).reshape(3, 4) @ np.hstack([POINTS, np.ones((3, 1))]).T
    np.testing.assert_allclose(seen, expected.T, atol=NEAR)
    assert {warning.code for warning in scene.warnings} == {"clouds-missing", "ego-stands"}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda a: a["frames"][0].update(index=7), r"frames\[0\]\.index: 7; expected one of the 3"),
        (lambda a: a["frames"][0]["figures"][0].update(objectKey="c" * 32), r"figures\[0\]: object 'c+' is none"),
        (lambda a: a["frames"][0]["figures"].append(figure("a" * 32)), r"is in the frame twice"),
        (lambda a: a["objects"][0]["tags"][0].update(frameRange=[0, 9]), r"in frames 0 to 9; expected some of 3"),
        (
            lambda a: a["frames"][0]["figures"][0]["geometry"]["dimensions"].update(x=0.0),
            r"size \[4\.0, 0\.0, 1\.2\]; expected sizes above 0",
        ),
        (
            lambda a: a["frames"][0]["figures"][0]["geometry"]["position"].update(x=1e9),
            r"geometry\.position: .*expected finite numbers",
        ),
        (
            lambda a: a["frames"][0]["figures"][0]["geometry"]["position"].update(x="1"),
            r"annotation\.json: frames\[0\]\.figures\[0\]\.geometry\.position\.x: Expected `float`, got `str`",
        ),
    ],
)
def test_a_fault_of_an_episode_is_named_with_its_location_and_passed_over_if_asked_for(episode, change, problem):
    path = episode / "ds0" / "annotation.json"
    content = json.loads(path.read_text())
    change(content)
    put(path, content)
    with pytest.raises(DataError, match=problem):
        open_scene(episode)
    assert open_scene(episode, lenient=True).warnings


def test_one_of_several_datasets_has_to_be_chosen(episode):
    (episode / "ds0").rename(episode / "day")
    for name in ("annotation", "frame_pointcloud_map"):
        put(episode / "night" / f"{name}.json", json.loads((episode / "day" / f"{name}.json").read_text()))
    with pytest.raises(OptionError, match=r"--sequence NAME.*day, night"):
        open_scene(episode)
    assert open_scene(episode, sequence="night").source.endswith("night")
    assert open_scene(episode / "day").source.endswith("day")


# Segments.ai


def release(kind, frames, labels, categories=({"id": 1, "name": "car"},)):
    sample = {
        "uuid": "u",
        "name": "drive",
        "attributes": {"frames": frames},
        "metadata": {},
        "labels": {"ground-truth": {"label_status": "LABELED", "attributes": {"frames": labels}}},
    }
    dataset = {"name": "set", "task_type": kind, "task_attributes": {"categories": [*categories]}, "samples": [sample]}
    return {"name": "v1", "dataset": dataset}


def segments_frame(k, **more):
    heading = dict(zip(("qx", "qy", "qz", "qw"), QUARTER.tolist(), strict=True))
    return {
        "pcd": {"url": f"https://assets.example/a/{k}.pcd", "type": "pcd"},
        "name": str(k),
        "timestamp": str(1_000_000_000 * (k + 1)),
        "ego_pose": {"position": vector(10 * k, 0, 0), "heading": heading},
        **more,
    }


def segments_cuboid(**more):
    box = {"position": vector(10, 1, 0), "dimensions": vector(4, 2, 1.5), "yaw": np.pi / 2}
    return {"id": 3, "track_id": 3, "category_id": 1, "type": "cuboid", **box, **more}


def test_a_sequence_of_segments_is_read_as_described(tmp_path):
    rotation = dict(zip(("qx", "qy", "qz", "qw"), [0.5, -0.5, -0.5, 0.5], strict=True))  # looks along +x, as OpenGL
    camera = {
        "url": "front.png",
        "name": "front",
        "intrinsics": {"intrinsic_matrix": [INTRINSICS[:3], INTRINSICS[3:6], INTRINSICS[6:]]},
        "extrinsics": {"translation": vector(0.5, 0, 0), "rotation": rotation},
        "distortion": {"model": "brown-conrady", "coefficients": {"k1": 0.1, "k2": 0, "k3": 0.3, "p1": 0.01, "p2": 0}},
    }
    attributes = {"colour": "red", "parked": True}
    labels = [{"annotations": [segments_cuboid(attributes=attributes)]}, {"annotations": [segments_cuboid()]}]
    frames = [segments_frame(0, images=[camera]), segments_frame(1)]
    put(tmp_path / "release.json", release("pointcloud-cuboid-sequence", frames, labels))
    put_image(tmp_path / "front.png")
    for k in range(2):
        put_cloud(tmp_path / f"{k}.pcd")
    for path in (tmp_path, tmp_path / "release.json"):
        scene = open_scene(path)
        assert scene.format == "segments"
    center, size, forward = forward_of(scene)
    np.testing.assert_allclose(center, [10, 1, 0], atol=NEAR)  # in the world, wherever the cloud is
    np.testing.assert_allclose(size, [4, 2, 1.5], atol=NEAR)
    np.testing.assert_allclose(forward, [0, 1, 0], atol=NEAR)
    assert (scene.annotations[0].id, scene.annotations[0].label) == (3, "car")
    np.testing.assert_allclose(scene.trajectories["pose"].positions, [[0, 0, 0], [10, 0, 0]], atol=NEAR)
    front = scene.sensor("front")
    assert front.camera.coefficients[:5] == (0.1, 0.0, 0.01, 0.0, 0.3)
    looks = front.mount.rotation
    expected = Rotation.from_quat([0.5, -0.5, -0.5, 0.5]).as_matrix() @ np.diag([1, -1, -1])
    np.testing.assert_allclose(looks, expected, atol=NEAR)


def test_points_of_a_segmentation_belong_to_the_objects_whose_numbers_they_have(tmp_path):
    categories = ({"id": 1, "name": "car"}, {"id": 2, "name": "road", "has_instances": False})
    objects = [{"id": 1, "category_id": 1}, {"id": 2, "category_id": 2}]
    labels = [{"annotations": objects, "point_annotations": [2, 0, 1]}]
    put(tmp_path / "r.json", release("pointcloud-segmentation-sequence", [segments_frame(0)], labels, categories))
    put_cloud(tmp_path / "0.pcd")
    found = {one.label: one for one in open_scene(tmp_path).annotations}
    assert found["car"].labeled_points[0].point_ids.tolist() == [2]
    assert found["road"].labeled_points[0].point_ids.tolist() == [0]
    assert (found["car"].is_instance, found["road"].is_instance) == (True, False)
    labels[0]["point_annotations"] = [2, 0, 9]
    put(tmp_path / "r.json", release("pointcloud-segmentation-sequence", [segments_frame(0)], labels, categories))
    with pytest.raises(DataError, match=r"point_annotations: 9 is none of the annotations' ids"):
        open_scene(tmp_path)
    labels[0]["point_annotations"] = [2, 0, "9"]
    put(tmp_path / "r.json", release("pointcloud-segmentation-sequence", [segments_frame(0)], labels, categories))
    with pytest.raises(DataError, match=r"r\.json: .*frames\[0\]\.point_annotations\[2\]: Expected `int`, got `str`"):
        open_scene(tmp_path)


# Scale


@pytest.fixture
def scale_task(tmp_path):
    """Two frames in reverse order of their names, as the attachments have them."""
    heading = dict(zip("xyzw", QUARTER.tolist(), strict=True))
    image = {
        "image_url": "https://files.example/cam/0.png",
        "position": vector(1, 0, 2),
        "heading": dict(zip("xyzw", [-0.5, 0.5, -0.5, 0.5], strict=True)),
        "fx": 50,
        "fy": 51,
        "cx": 31.5,
        "cy": 23.5,
        "camera_index": 4,
        "k1": 0.1,
    }
    points = [{**vector(*map(float, row)), "i": 0.5, "d": 1, "t": 1_541_196_976_735_462_000} for row in POINTS]
    for k, name in enumerate(("b", "a")):
        frame = {
            "device_position": vector(float(k), 0, 2),
            "device_heading": heading,
            "timestamp": 1_541_196_976_735_462_000 + k * 100_000_000,
            "images": [image] if k == 0 else [],
            "points": points,
            "radar_points": [{"position": vector(9, 9, 0), "direction": vector(0, 2, 0), "size": 0.7}] if k else [],
        }
        put(tmp_path / "frames" / f"{name}.json", frame)
    put_image(tmp_path / "images" / "camera4" / "0.png")
    attachments = [f"https://files.example/{name}.json" for name in ("b", "a")]
    response = {"annotations": {"url": "https://results.example/000003f0"}}
    task = {"task_id": "t", "type": "lidarannotation", "params": {"attachments": attachments}, "response": response}
    put(tmp_path / "task.json", task)
    box = {"position": vector(5, 6, 1), "dimensions": vector(1.8, 4.2, 1.5), "yaw": 0.0, "stationary": False}
    more = {"camera_used": 1, "numberOfPoints": 64, "distance_to_device": 14.5, "attributes": {"heading": "front"}}
    cuboid = {"uuid": "4DBCC561-D6E1-4F1E-B862-054189939075", "label": "Car", **box, **more}
    put(tmp_path / "000003f0.json", [{"cuboids": [cuboid]}, {"cuboids": [{**cuboid, "yaw": np.pi / 2}]}])
    return tmp_path


def test_a_task_of_scale_is_read_as_described(scale_task):
    scene = open_scene(scale_task)
    center, size, forward = forward_of(scene)
    np.testing.assert_allclose(center, [5, 6, 1], atol=NEAR)
    np.testing.assert_allclose(size, [4.2, 1.8, 1.5], atol=NEAR)
    np.testing.assert_allclose(forward, [0, 1, 0], atol=NEAR)  # yaw 0 is along <0, 1, 0>
    np.testing.assert_allclose(forward_of(scene, 1)[2], [-1, 0, 0], atol=NEAR)  # counter-clockwise
    stated = {path.name: path.values for path in scene.annotations[0].attributes}
    assert stated["heading"] == ("front",)
    assert stated["numberOfPoints"] == (64,)
    sweep = scene.lidars[0].frames[0]
    np.testing.assert_array_equal(sweep.points.positions, POINTS)
    assert sweep.points.intensities.tolist() == [128] * 3
    assert sweep.points.extras["t"].tolist() == [1_541_196_976_735_462_000] * 3
    assert scene.trajectories["pose"].positions[:, 0].tolist() == [0, 1]  # as the attachments are listed
    camera = scene.sensor("camera4")
    assert (camera.camera.model, camera.camera.coefficients[0]) == ("brown_conrady", 0.1)
    np.testing.assert_allclose(camera.poses.positions, [[1, 0, 2]], atol=NEAR)
    expected = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(camera.poses.quaternions_xyzw[0]).as_matrix(), expected, atol=NEAR)
    radar = scene.sensor("radar").frames[0].points
    np.testing.assert_allclose(radar.directions, [[0, 1, 0]], atol=1e-6)
    assert radar.lengths.tolist() == pytest.approx([0.7])


def test_a_frame_of_scale_without_its_file_or_with_points_nowhere_is_named(scale_task):
    (scale_task / "frames" / "a.json").unlink()
    with pytest.raises(DataError, match=r"attachment 'a\.json' is not there"):
        open_scene(scale_task)
    frame = json.loads((scale_task / "frames" / "b.json").read_text())
    frame["points"][1]["x"] = 1e12
    put(scale_task / "frames" / "b.json", frame)
    scene = open_scene(scale_task, lenient=True)
    with pytest.raises(DataError, match=r"points\[1\]: \[1000000000000\.0"):
        scene.lidars[0].frames[0]


# SUSTechPOINTS


@pytest.fixture
def sustech(tmp_path):
    psr = {"position": vector(1, 2, 3), "scale": vector(4, 2, 1.5), "rotation": vector(0, 0, np.pi / 2)}
    box = {"psr": psr, "obj_type": "Car", "obj_id": "12"}
    put(tmp_path / "label" / "000.json", [box, {**box, "obj_id": "", "obj_type": "Truck"}])
    put(tmp_path / "label" / "001.json", {"frame": "001", "objs": [{**box, "obj_attr": "opened"}]})
    for name in ("000", "001"):
        put_cloud(tmp_path / "lidar" / f"{name}.pcd")
        put_image(tmp_path / "camera" / "front" / f"{name}.png")
        put(tmp_path / "lidar_pose" / f"{name}.json", {"lidarPose": [*np.eye(4).ravel().tolist()]})
    extrinsic = [*CAMERA_FROM_CLOUD, 0, 0, 0, 1]
    put(tmp_path / "calib" / "camera" / "front.json", {"extrinsic": extrinsic, "intrinsic": INTRINSICS})
    put_cloud(tmp_path / "radar" / "bumper" / "001.pcd")
    put(tmp_path / "calib" / "radar" / "bumper.json", {"translation": [3, 0, 0.5], "rotation": [0, 0, np.pi / 2]})
    return tmp_path


def test_a_scene_of_sustechpoints_is_read_as_described(sustech):
    scene = open_scene(sustech)
    center, size, forward = forward_of(scene)
    np.testing.assert_allclose(center, [1, 2, 3], atol=NEAR)
    np.testing.assert_allclose(size, [4, 2, 1.5], atol=NEAR)
    np.testing.assert_allclose(forward, [0, 1, 0], atol=NEAR)  # yaw 0 is along +x
    ids = {one.id: one for one in scene.annotations}
    assert set(ids) == {12, "000.1"}  # a box without an id is an object of its own
    assert len(ids[12].path.timestamps_ns) == 2
    assert [path.values for path in ids[12].attributes] == [("opened",)]
    seen = scene.samples()[1].camera_from_points["front"].apply(POINTS)
    expected = np.array(CAMERA_FROM_CLOUD).reshape(3, 4) @ np.hstack([POINTS, np.ones((3, 1))]).T
    np.testing.assert_allclose(seen, expected.T, atol=NEAR)
    radar = scene.sensor("bumper")
    np.testing.assert_allclose(radar.mount.apply(np.array([1.0, 0, 0])), [3, 1, 0.5], atol=NEAR)
    np.testing.assert_array_equal(radar.frames[0].points.positions, POINTS)


def test_calibrations_of_single_frames_count_before_that_of_the_camera(sustech):
    moved = [*CAMERA_FROM_CLOUD, 0, 0, 0, 1]
    moved[3] += 1
    put(sustech / "calib" / "camera" / "front" / "001.json", {"lidar_to_camera": moved})
    samples = open_scene(sustech).samples()
    first, second = (sample.camera_from_points["front"].translation for sample in samples)
    np.testing.assert_allclose(second - first, [1, 0, 0], atol=NEAR)


def test_a_frame_without_pose_among_others_is_a_fault(sustech):
    (sustech / "lidar_pose" / "001.json").unlink()
    with pytest.raises(DataError, match="frame 001 has no pose, and others have"):
        open_scene(sustech)
    assert any(warning.code == "poses-missing" for warning in open_scene(sustech, lenient=True).warnings)
