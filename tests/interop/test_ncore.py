"""NVIDIA's own package reads the sequences that we write, and writes some that we read.

It brings PyTorch, so it runs in an environment of its own: SCENELOOM_NCORE_PYTHON names its interpreter.
"""

import numpy as np
import pytest
from tests.peers import python_with
from tests.unit.formats.ncore.models import MODELS

import sceneloom
from sceneloom.cameras import project
from sceneloom.formats import write_scene
from sceneloom.formats.ncore.sequences import camera_of
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_poses
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

READ = """
import json, sys
import numpy as np
from pathlib import Path
from ncore.data import v4
from ncore.impl.data.v4 import components as c
reader = c.SequenceComponentGroupsReader([Path(sys.argv[1])])
out = {"id": reader.sequence_id, "meta": reader.get_sequence_meta().to_dict(), "cameras": {}, "lidars": {}}
out["consolidated"] = c.SequenceComponentGroupsReader([Path(sys.argv[1])], open_consolidated=False).sequence_id
(poses,) = reader.open_component_readers(c.PosesComponent.Reader).values()
out["static"] = {"|".join(k): v.tolist() for k, v in poses.get_static_poses()}
out["dynamic"] = {"|".join(k): [v.tolist(), t.tolist()] for k, (v, t) in poses.get_dynamic_poses()}
(intrinsics,) = reader.open_component_readers(c.IntrinsicsComponent.Reader).values()
for name, camera in reader.open_component_readers(c.CameraSensorComponent.Reader).items():
    frames = [int(end) for _, end in camera.frames_timestamps_us]
    out["cameras"][name] = {
        "model": intrinsics.get_camera_model_parameters(name).to_dict(),
        "frames": camera.frames_timestamps_us.tolist(),
        "images": [[*camera.get_frame_image(end).size] for end in frames],
        "pixels": [np.asarray(camera.get_frame_image(end)).astype(int).sum(axis=(0, 1)).tolist() for end in frames],
    }
for name, lidar in reader.open_component_readers(c.LidarSensorComponent.Reader).items():
    out["lidars"][name] = rows = []
    for start, end in lidar.frames_timestamps_us.tolist():
        rays = lidar.get_frame_ray_bundle_data(end, "direction")
        distance = lidar.get_frame_ray_bundle_return_data(end, "distance_m", 0)
        assert lidar.get_frame_ray_bundle_return_valid_mask(end).all()
        rows.append({
            "span": [start, end],
            "points": (rays * distance[:, None]).tolist(),
            "times": lidar.get_frame_ray_bundle_data(end, "timestamp_us").tolist(),
            "intensity": lidar.get_frame_ray_bundle_return_data(end, "intensity", 0).tolist(),
            "generic": lidar.get_frame_generic_data_names(end),
        })
out["boxes"] = [o.to_dict() for r in reader.open_component_readers(c.CuboidsComponent.Reader).values()
                for o in r.get_observations()]
print(json.dumps(out))
"""

PROJECT = """
import json, sys
import numpy as np, torch
from ncore.impl.data import types
from ncore.impl.sensors.camera import CameraModel
rays = np.array(json.load(open(sys.argv[2])), np.float64)
out = []
for encoded in json.load(open(sys.argv[1])):
    parameters = types.decode_camera_model_parameters(encoded)
    model = CameraModel.from_parameters(parameters, device="cpu", dtype=torch.float64)
    found = model.camera_rays_to_image_points(torch.tensor(rays))
    out.append([found.image_points.tolist(), found.valid_flag.tolist()])
print(json.dumps(out))
"""

WRITE = """
import io, json, sys
import numpy as np
from PIL import Image
from upath import UPath
from ncore.impl.common.transformations import HalfClosedInterval
from ncore.impl.data import types
from ncore.impl.data.v4 import components as c
start, stop = 1_700_000_000_000_000, 1_700_000_000_200_001
writer = c.SequenceComponentGroupsWriter(UPath(sys.argv[1]), "clip", "clip", HalfClosedInterval(start, stop),
                                         {"site": "here"}, store_type=sys.argv[2])
poses = writer.register_component_writer(c.PosesComponent.Writer, "default")
mount = np.eye(4, dtype=np.float32); mount[:3, 3] = [1, 2, 3]
for name in ("top", "front", "radar"):
    poses.store_static_pose(name, "rig", mount)
path = np.tile(np.eye(4), (2, 1, 1)); path[1, 0, 3] = 20.0
poses.store_dynamic_pose("rig", "world", path, np.array([start, stop - 1], np.uint64))
intrinsics = writer.register_component_writer(c.IntrinsicsComponent.Writer, "default")
intrinsics.store_camera_intrinsics("front", types.decode_camera_model_parameters(json.loads(sys.argv[3])))
camera = writer.register_component_writer(c.CameraSensorComponent.Writer, "front")
with io.BytesIO() as buffer:
    Image.new("RGB", (640, 480), (9, 99, 199)).save(buffer, "png")
    camera.store_frame(buffer.getvalue(), "png", np.array([start + 10, start + 40], np.uint64), {}, {"k": 1})
rng = np.random.default_rng(0)
rays = rng.normal(size=(5003, 3)).astype(np.float32)
rays /= np.linalg.norm(rays, axis=1, keepdims=True)
distance = rng.uniform(1, 90, (2, len(rays))).astype(np.float32)
distance[0, ::7] = np.nan
distance[1, ::2] = np.nan
intensity = np.where(np.isnan(distance), np.nan, rng.uniform(0, 1, distance.shape)).astype(np.float32)
times = np.linspace(start + 5, start + 100_000, len(rays)).astype(np.uint64)
elements = np.stack([np.arange(len(rays)) % 64, np.arange(len(rays)) // 64], 1).astype(np.uint16)
lidar = writer.register_component_writer(c.LidarSensorComponent.Writer, "top", "lidar")
lidar.store_frame(rays, times, elements, distance, intensity, np.array([start, start + 100_000], np.uint64),
                  {"flag": np.arange(len(rays), dtype=np.uint8), "table": np.arange(6.0).reshape(2, 3)}, {"note": "x"})
radar = writer.register_component_writer(c.RadarSensorComponent.Writer, "radar", "radar")
radar.store_frame(rays[:9], times[:9], distance[1:, 1:19:2].copy(), np.array([start, start + 100_000], np.uint64),
                  {"radial_velocity": np.arange(-4, 5, dtype=np.float32)}, {})
box = types.BBox3((5.0, 1.0, 0.5), (4.0, 2.0, 1.5), (0.1, -0.2, 2.5))
cuboids = writer.register_component_writer(c.CuboidsComponent.Writer, "default")
cuboids.store_observations([
    types.CuboidTrackObservation("a", "car", start + 50_000, "top", start + 100_000, box, types.LabelSource.AUTOLABEL),
    types.CuboidTrackObservation("a", "car", start + 150_000, "rig", start + 150_000, box, types.LabelSource.AUTOLABEL),
])
paths = writer.finalize()
meta = c.SequenceComponentGroupsReader(paths).get_sequence_meta() if sys.argv[2] == "itar" else None
if meta is not None:
    (UPath(sys.argv[1]) / "clip.json").write_text(json.dumps(meta.to_dict()))
from scipy.spatial.transform import Rotation
np.savez(sys.argv[1] + "/truth.npz", rays=rays, distance=distance, intensity=intensity, times=times,
         rotation=Rotation.from_euler("xyz", box.rot).as_matrix())
print(json.dumps([str(p) for p in paths]))
"""


@pytest.fixture(scope="session")
def ncore_python():
    return python_with("nvidia-ncore", "SCENELOOM_NCORE_PYTHON")


def test_their_package_opens_what_we_write_and_finds_the_same(ncore_python, ask, tmp_path):
    from sceneloom.cameras.camera import Camera

    camera = Camera("brown_conrady", 64, 48, 50.0, 51.0, 31.5, 23.25, (-0.2, 0.05, 0.001, -0.002, 0.01))
    lidar = LidarSpec(beams=8, steps=90)
    scene = simulate_street(5, frames=3, lidar=lidar, cameras=(CameraSpec(camera, camera_mount()),)).scene
    report = write_scene(scene, tmp_path / "drive.ncore4.zarr.itar", format="ncore")
    assert report
    found = ask(ncore_python, READ, tmp_path / "drive.ncore4.zarr.itar")
    assert found["id"] == found["consolidated"] == "drive"
    (sweeps,) = found["lidars"].values()
    for sweep, frame in zip(sweeps, scene.lidars[0].frames, strict=True):
        # float32 rays and distances of up to 100 m
        assert np.allclose(sweep["points"], frame.points.positions, atol=3e-5)
        assert np.allclose(np.array(sweep["times"]) * 1000, frame.points.timestamps_ns, atol=500)
        assert np.array_equal(np.rint(np.array(sweep["intensity"]) * 255), frame.points.intensities)
    (images,) = found["cameras"].values()
    assert images["images"] == [[64, 48]] * len(scene.cameras[0].images)
    model = images["model"]
    assert np.allclose(model["principal_point"], [32.0, 23.75])
    assert np.allclose(model["radial_coeffs"], [-0.2, 0.05, 0.01, 0, 0, 0])
    matrices, times = found["dynamic"]["rig|world"]
    path = next(iter(scene.trajectories.values())).poses.held(np.array(times) * 1000)
    assert np.allclose(
        np.array(matrices)[:, :3, 3], path.positions, atol=1e-3
    )  # half a microsecond at 10 m/s, and more
    angles = CuboidAngles.of(scene)
    boxes = {(row["track_id"], row["timestamp_us"]): row["bbox3"] for row in found["boxes"]}
    for one in scene.annotations:
        expected = cuboid_poses(one, one.path.timestamps_ns, angles=angles)
        for k, time in enumerate(one.path.timestamps_ns.tolist()):
            box = boxes[str(one.id), (time + 500) // 1000]
            assert np.allclose(box["centroid"], expected.centers_world[k])
            assert np.allclose(box["dim"], expected.sizes_lwh[k])


def test_projections_of_all_camera_models_agree_with_theirs(ncore_python, ask, tmp_path):
    import json

    rng = np.random.default_rng(3)
    angles, around = rng.uniform(0, 1.4, 4000), rng.uniform(-np.pi, np.pi, 4000)
    rays = np.stack([np.sin(angles) * np.cos(around), np.sin(angles) * np.sin(around), np.cos(angles)], 1)
    (tmp_path / "models.json").write_text(json.dumps([*MODELS.values()]))
    (tmp_path / "rays.json").write_text(json.dumps(rays.tolist()))
    answers = ask(ncore_python, PROJECT, tmp_path / "models.json", tmp_path / "rays.json")
    for (name, encoded), (pixels, valid) in zip(MODELS.items(), answers, strict=True):
        camera, error = camera_of(encoded["camera_model_type"], encoded["camera_model_parameters"])
        ours, visible = project(camera, rays)
        both = visible & np.array(valid)  # theirs leaves out pixels that a pinhole model moves far
        assert both.sum() > 300, name
        off = np.linalg.norm(ours[both] + 0.5 - np.array(pixels)[both], axis=1)
        assert max(off.max(), error) < 0.01, name


@pytest.mark.parametrize("store", ["itar", "directory"])
def test_we_read_what_their_package_writes(ncore_python, ask, tmp_path, store):
    import json

    folder = tmp_path / "out"
    ask(ncore_python, WRITE, folder, store, json.dumps(MODELS["ftheta"]))
    truth = np.load(folder / "truth.npz")
    paths = [folder, *([folder / "clip.json"] if store == "itar" else [])]
    for path in paths:
        scene = sceneloom.open(path)
        frame = scene.sensor("top").frames[0]
        there = ~np.isnan(truth["distance"])
        expected = (truth["rays"][None] * truth["distance"][..., None])[there]
        assert np.allclose(frame.points.positions, expected, atol=1e-5)
        times = np.broadcast_to(truth["times"], there.shape)[there].astype(np.int64) * 1000
        assert np.array_equal(frame.points.timestamps_ns, times)
        assert np.array_equal(frame.points.extras["intensity"], truth["intensity"][there])
        assert np.array_equal(frame.points.rings, np.nonzero(there)[1] % 64)
        assert np.array_equal(frame.points.extras["flag"], (np.nonzero(there)[1] % 256).astype(np.uint8))
        assert frame.extras["generic_data"]["table"].tolist() == [[0, 1, 2], [3, 4, 5]]
        image = scene.cameras[0].images[0]
        assert image.rgb[5, 6].tolist() == [9, 99, 199]
        assert image.timestamp_ns == 1_700_000_000_000_025_000
        cycle = scene.sensor("radar").frames[0].points
        speeds = np.einsum("ij,ij->i", cycle.directions, truth["rays"][:9]) * cycle.lengths
        assert np.allclose(speeds, np.arange(-4, 5), atol=1e-5)
        (box,) = scene.annotations
        # the lidar stands at 1, 2, 3 on a rig that drives 20 m in 0.2 s
        assert np.allclose(box.path.values[:, 3:6], [[16, 3, 3.5], [20, 1, 0.5]], atol=1e-4)
        rotation = RigidTransform.from_quaternion(
            np.zeros(3), CuboidAngles.of(scene).quaternions(box.path.values[0, 6:])
        )
        assert np.allclose(rotation.rotation, truth["rotation"], atol=1e-6)
        # written again: the same points
        write_scene(scene, tmp_path / f"{len(str(path))}.zarr.itar", format="ncore")
        again = sceneloom.open(tmp_path / f"{len(str(path))}.zarr.itar").sensor("top").frames[0]
        assert np.allclose(again.points.positions, frame.points.positions, atol=3e-5)
