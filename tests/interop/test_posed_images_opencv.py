"""COLMAP models and nerfstudio's transforms.json, projected by OpenCV as their documentation says.

COLMAP's own library opens the models, too, where `SCENELOOM_COLMAP_PYTHON` names a Python that has `pycolmap`.
"""

import json
import struct

import numpy as np
import pytest
from tests.peers import python_with

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded
from sceneloom.errors import OptionError, UnknownOptionError
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.registry import format_named, write_scene, written_formats
from sceneloom.geometry.rigid import RigidTransform

cv2 = pytest.importorskip("cv2")
trimesh = pytest.importorskip("trimesh")

RNG = np.random.default_rng(4)
TIMES = np.array([10**18, 10**18 + 10**8, 10**18 + 2 * 10**8])
SIZE = (320, 240)
BENT = (0.2, 0.05, 0.001, -0.002, 0.01, 0.3, 0.02, 0.001)


def brown(*coefficients):
    return Camera("brown_conrady", *SIZE, 300.0, 310.0, 160.5, 118.0, coefficients)


CAMERA_MODELS = {
    "plain": Camera("pinhole", *SIZE, 300.0, 310.0, 160.5, 118.0),
    "five": brown(-0.2, 0.05, 0.001, -0.002, 0.01),
    "four": brown(-0.2, 0.05, 0.001, -0.002),
    "eight": brown(*BENT),
    "fish eye": Camera("fisheye", *SIZE, 120.0, 121.0, 159.0, 119.0, (0.05, -0.01, 0.002, 0.0)),
    "mei": Camera("omnidirectional", *SIZE, 300.0, 300.0, 160.0, 120.0, (-0.05, 0.01, 0, 0, 0, 0, 0.6)),
}
# the camera looks along the ego's x axis
MOUNT = RigidTransform.from_quaternion(np.array([1.5, 0.2, 1.1]), np.array([-0.5, 0.5, -0.5, 0.5]))


def scene(names, *, origin=(0.0, 0.0, 0.0)):
    angles = np.array([0.0, 0.3, -0.2])
    rotations = np.stack([np.zeros(3), np.zeros(3), np.sin(angles / 2), np.cos(angles / 2)], axis=1)
    trajectory = sc.Trajectory("trajectory", TIMES, RNG.normal(size=(3, 3)) + origin, rotations)
    rgb = RNG.integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    cameras = []
    for name in names:
        model = CAMERA_MODELS[name]
        images = sc.LazyFrames.of([sc.CameraImage.of(int(t), model, rgb) for t in TIMES], TIMES)
        cameras.append(sc.CameraSensor(name, model, images, mount=MOUNT))
    positions = RNG.uniform(-20, 20, (500, 3)).astype(np.float32)
    colors = RNG.integers(0, 256, (500, 3)).astype(np.uint8)
    frames = [sc.LidarFrame(int(t), sc.LidarPoints(positions, colors=colors)) for t in TIMES]
    here = RigidTransform.identity()
    lidar = sc.LidarSensor("top", sc.LazyFrames.of(frames, TIMES), mount=here, points_frame=sc.PointsFrame.EGO)
    return sc.Scene((lidar, *cameras), trajectories={"trajectory": trajectory})


def ego_pose(one, k):
    trajectory = one.trajectories["trajectory"]
    return RigidTransform.from_quaternion(trajectory.positions[k], trajectory.quaternions_xyzw[k])


def truth(one, camera_id, k):
    """Points in the world before the camera, and where our own camera model puts them."""
    world_from_camera = ego_pose(one, k) @ one.sensor(camera_id).mount
    points_camera = RNG.uniform((-1.5, -1.0, 4.0), (1.5, 1.0, 9.0), (50, 3))
    return world_from_camera.apply(points_camera), project_unbounded(one.sensor(camera_id).camera, points_camera)


def opencv(points_camera, fx, fy, cx, cy, distortion, *, fisheye):
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    none = np.zeros(3)
    if fisheye:
        pixels = cv2.fisheye.projectPoints(points_camera[:, None], none, none, matrix, np.array(distortion))[0]
    else:
        pixels = cv2.projectPoints(points_camera, none, none, matrix, np.array(distortion))[0]
    return pixels.reshape(-1, 2)


def read_colmap(folder):
    """The text files as COLMAP's documentation describes them."""
    cameras = {}
    for line in (folder / "cameras.txt").read_text().splitlines():
        if not line.startswith("#"):
            number, model, width, height, *numbers = line.split()
            cameras[int(number)] = (model, int(width), int(height), tuple(map(float, numbers)))
    lines = [line for line in (folder / "images.txt").read_text().splitlines() if not line.startswith("#")]
    images = {}
    for line, points in zip(lines[::2], lines[1::2], strict=True):
        assert points == ""
        number, *numbers, camera, name = line.split()
        images[name] = (int(number), tuple(map(float, numbers)), int(camera))
    rows = [row.split() for row in (folder / "points3D.txt").read_text().splitlines() if not row.startswith("#")]
    return cameras, images, np.array(rows, np.float64)


def rotation(w, x, y, z):
    """Source: the rotation matrix of a unit quaternion, written out."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("plain", ("PINHOLE", 4)),
        ("four", ("OPENCV", 8)),
        ("five", ("FULL_OPENCV", 12)),
        ("eight", ("FULL_OPENCV", 12)),
        ("fish eye", ("OPENCV_FISHEYE", 8)),
        ("mei", None),  # COLMAP does not have it: the nearest is written, with its error
    ],
)
def test_opencv_projects_a_colmap_model_to_where_the_scene_sees_it(tmp_path, name, expected):
    one = scene([name])
    losses = write_scene(one, tmp_path / "o", format="colmap", images="none")
    found = [loss for loss in losses if loss.field == f"sensors[{name}].camera" and loss.largest_error is not None]
    assert [loss.support for loss in found] == [Support.APPROXIMATED] * (expected is None)
    # the error is measured on a grid of the image: between its nodes it may be a little larger
    error = max((1.2 * loss.largest_error for loss in found), default=0.0) + 1e-6
    assert error < 1.2
    cameras, images, _ = read_colmap(tmp_path / "o" / "sparse" / "0")
    assert len(cameras) == 1
    model, width, height, (fx, fy, cx, cy, *distortion) = cameras[1]
    assert expected in (None, (model, 4 + len(distortion)))
    assert ((width, height), len(images)) == (SIZE, len(TIMES))
    for number, pose, camera in images.values():
        points_world, pixels = truth(one, name, number - 1)
        points_camera = points_world @ rotation(*pose[:4]).T + pose[4:]
        # COLMAP counts from the corner of the first pixel, OpenCV from its centre
        seen = opencv(points_camera, fx, fy, cx - 0.5, cy - 0.5, distortion or [0.0] * 4, fisheye="FISHEYE" in model)
        inside = ((pixels > 0) & (pixels < SIZE)).all(axis=1) | (expected is not None)
        assert inside.sum() > 10
        assert np.linalg.norm(seen - pixels, axis=1)[inside].max() < error
        assert camera == 1


def test_the_binary_files_hold_what_the_texts_hold(tmp_path):
    write_scene(scene(["five", "fish eye"]), tmp_path / "o", format="colmap", model="both", images="none")
    folder = tmp_path / "o" / "sparse" / "0"
    cameras, images, points = read_colmap(folder)
    data = (folder / "cameras.bin").read_bytes()
    (count,), location = struct.unpack_from("<Q", data), 8
    models = {4: ("OPENCV", 8), 5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 1: ("PINHOLE", 4)}
    assert count == len(cameras) == 2
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, location)
        name, size = models[model]
        numbers = struct.unpack_from(f"<{size}d", data, location + 24)
        assert cameras[number] == (name, width, height, numbers)
        location += 24 + 8 * size
    assert location == len(data)
    data, location = (folder / "images.bin").read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, *pose, camera = struct.unpack_from("<I7dI", data, location)
        stop = data.index(b"\0", location + 64)
        name = data[location + 64 : stop].decode()
        assert images[name] == (number, tuple(pose), camera)
        assert struct.unpack_from("<Q", data, stop + 1) == (0,)
        location = stop + 9
    assert location == len(data)
    data, location = (folder / "points3D.bin").read_bytes(), 8
    assert struct.unpack_from("<Q", data)[0] == len(points) > 0
    for row in points[:20]:
        number, x, y, z, red, green, blue, error, track = struct.unpack_from("<Q3d3BdQ", data, location)
        np.testing.assert_allclose([number, x, y, z, red, green, blue, error], row, atol=1e-6)
        assert track == 0
        location += 51
    assert len(data) == 8 + 51 * len(points)


PYCOLMAP = """
import json, sys
import numpy as np
import pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
asked = json.load(open(sys.argv[2]))
found = {}
for image in model.images.values():
    pose = image.cam_from_world
    seen = (pose() if callable(pose) else pose) * np.array(asked[image.name])
    found[image.name] = np.array(model.cameras[image.camera_id].img_from_cam(seen)).tolist()
points = [[*one.xyz, *map(int, one.color)] for _, one in sorted(model.points3D.items())]
print(json.dumps({"pixels": found, "points": points, "models": [c.model.name for c in model.cameras.values()]}))
"""


@pytest.mark.parametrize("kind", ["txt", "bin"])
@pytest.mark.parametrize("name", ["plain", "four", "eight", "fish eye"])
def test_pycolmap_opens_a_model_and_sees_points_where_the_scene_does(tmp_path, ask, name, kind):
    one = scene([name])
    write_scene(one, tmp_path / "o", format="colmap", model=kind, images="none")
    write_scene(one, tmp_path / "texts", format="colmap", images="none")
    _, images, points = read_colmap(tmp_path / "texts" / "sparse" / "0")
    expected = {image: truth(one, name, number - 1) for image, (number, _, _) in images.items()}
    (tmp_path / "asked.json").write_text(json.dumps({key: row.tolist() for key, (row, _) in expected.items()}))
    python = python_with("pycolmap", "SCENELOOM_COLMAP_PYTHON")
    found = ask(python, PYCOLMAP, tmp_path / "o" / "sparse" / "0", tmp_path / "asked.json")
    assert found["pixels"].keys() == expected.keys()
    for image, (_, pixels) in expected.items():
        # COLMAP counts from the corner of the first pixel
        np.testing.assert_allclose(np.array(found["pixels"][image]) - 0.5, pixels, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found["points"], points[:, 1:7], rtol=0, atol=1e-6)


@pytest.mark.parametrize(("names", "model"), [(["plain", "five"], "OPENCV"), (["fish eye"], "OPENCV_FISHEYE")])
def test_opencv_projects_transforms_json_to_where_the_scene_sees_it(tmp_path, names, model):
    one = scene(names)
    write_scene(one, tmp_path / "o", format="nerfstudio")
    content = json.loads((tmp_path / "o" / "transforms.json").read_text())
    assert content["camera_model"] == model
    assert len(content["frames"]) == len(names) * len(TIMES)
    for frame in content["frames"]:
        image = tmp_path / "o" / frame["file_path"]
        assert cv2.imread(str(image)).shape == (SIZE[1], SIZE[0], 3)
        name = next(name for name in names if name.replace(" ", "%20") in frame["file_path"])
        points_world, pixels = truth(one, name, int(image.name[:6]))
        matrix = np.linalg.inv(np.array(frame["transform_matrix"]))
        opengl = points_world @ matrix[:3, :3].T + matrix[:3, 3]
        # x right, y up, z back: what is seen has a negative z
        assert (opengl[:, 2] < 0).all()
        fisheye = model == "OPENCV_FISHEYE"
        order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
        fx, fy, cx, cy = (frame[key] for key in ("fl_x", "fl_y", "cx", "cy"))
        distortion = [frame[key] for key in order]
        found = opencv(opengl * (1, -1, -1), fx, fy, cx - 0.5, cy - 0.5, distortion, fisheye=fisheye)
        np.testing.assert_allclose(found, pixels, rtol=0, atol=1e-6)


def test_points_are_in_the_world_thinned_and_coloured(tmp_path):
    one = scene(["plain"])
    write_scene(one, tmp_path / "o", format="nerfstudio", voxel="0.5", images="none")
    content = json.loads((tmp_path / "o" / "transforms.json").read_text())
    cloud = trimesh.load(tmp_path / "o" / content["ply_file_path"])
    frames = one.lidars[0].frames
    everything = np.concatenate([ego_pose(one, k).apply(frame.points.positions) for k, frame in enumerate(frames)])
    colors = np.concatenate([frame.points.colors for frame in frames])
    distances = np.linalg.norm(cloud.vertices[:, None] - everything[None], axis=2)
    nearest = distances.argmin(axis=1)
    assert distances.min(axis=1).max() < 1e-5  # float32 of 30 m
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], colors[nearest])
    cubes = np.unique(np.floor(np.asarray(cloud.vertices) / 0.5), axis=0)
    assert len(cubes) > 0.99 * len(cloud.vertices)  # rounding may move a point over an edge of its cube


def test_far_locations_count_from_an_origin_that_is_reported_as_is_what_jpeg_costs(tmp_path):
    one = scene(["plain"], origin=(500_000.0, 5_400_000.0, 30.0))
    losses = write_scene(one, tmp_path / "o", format="nerfstudio", images="none", points="0")
    content = json.loads((tmp_path / "o" / "transforms.json").read_text())
    applied = np.array(content["applied_transform"])
    first = np.array(content["frames"][0]["transform_matrix"])[:3, 3]
    assert np.abs(first).max() < 10
    camera = (ego_pose(one, 0) @ MOUNT).translation
    np.testing.assert_allclose(applied[:, :3] @ camera + applied[:, 3], first, rtol=0, atol=1e-8)
    assert any("locations count from" in loss.what for loss in losses)
    assert "ply_file_path" not in content
    lossy = write_scene(one, tmp_path / "a", format="colmap", points="0")
    (loss,) = [loss for loss in lossy if loss.field.endswith("images.rgb")]
    assert (loss.support, loss.count) == (Support.APPROXIMATED, 3)
    reported = write_scene(one, tmp_path / "b", format="colmap", points="0", images="png")
    assert not [loss for loss in reported if loss.field.endswith("images.rgb")]
    image = cv2.imread(str(next((tmp_path / "b" / "images" / "plain").iterdir())))
    np.testing.assert_array_equal(image[:, :, ::-1], one.sensor("plain").images[0].rgb)


@pytest.mark.parametrize("name", ["colmap", "nerfstudio"])
def test_these_formats_are_written_only_and_state_what_they_need(tmp_path, name):
    form = format_named(name)
    assert name in written_formats()
    assert not form.sniff(tmp_path)
    with pytest.raises(OptionError, match="only written"):
        form.open(tmp_path)
    with pytest.raises(OptionError, match="no camera with images"):
        write_scene(sc.Scene(scene([]).sensors), tmp_path / "o", format=name)
    with pytest.raises(UnknownOptionError):
        write_scene(scene(["plain"]), tmp_path / "o", format=name, profile="scale")
    for options in ({"images": "gif"}, {"voxel": "-1"}, {"points": "x"}):
        with pytest.raises(OptionError):
            write_scene(scene(["plain"]), tmp_path / "o", format=name, **options)
    assert not list(tmp_path.iterdir())
