"""A simulated drive, written as a folder of plain files, opens as the drive that it was."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

CAMERA_MODEL = Camera("brown_conrady", 96, 64, 60.0, 61.0, 47.5, 31.5, (-0.2, 0.05, 0.001, -0.001, 0.01))
CLOUD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("i", "u1"), ("ring", "<u2"), ("t", "<i8")])
PCD = "FIELDS x y z i ring t\nSIZE 4 4 4 1 2 8\nTYPE F F F U U I\nWIDTH {}\nHEIGHT 1\nDATA {}\n"
PLY = "".join(
    f"property {kind} {name}\n"
    for kind, name in zip(["float", "float", "float", "uchar", "ushort", "double"], CLOUD.names, strict=True)
)


@pytest.fixture(scope="module")
def drive():
    """Three sweeps of a coarse lidar and a small camera with distortion."""
    return simulate_street(4, frames=3, lidar=LidarSpec(beams=16, steps=300), cameras=(CameraSpec(CAMERA_MODEL),)).scene


def write_cloud(path: Path, points, kind: str) -> None:
    """Write the points in a kind of file, by hand."""
    records = np.zeros(len(points), CLOUD)
    for axis, name in enumerate("xyz"):
        records[name] = points.positions[:, axis]
    records["i"], records["ring"], records["t"] = points.intensities, points.rings, points.timestamps_ns
    if kind == "npz":
        np.savez_compressed(path, **{name: records[name] for name in CLOUD.names})
        return
    if kind == "ascii":
        lines = "".join(" ".join(repr(value.item()) for value in row) + "\n" for row in records)
        path.write_text(PCD.format(len(records), "ascii") + lines)
        return
    heads = {
        "pcd": PCD.format(len(records), "binary"),
        "ply": f"ply\nformat binary_little_endian 1.0\nelement vertex {len(records)}\n{PLY}end_header\n",
        "bin": "",
    }
    if kind == "ply":
        records = records.astype([*CLOUD.descr[:-1], ("t", "<f8")])
    path.write_bytes(heads[kind].encode() + records.tobytes())


def write_folder(folder: Path, scene: sceneloom.Scene, kind: str) -> None:
    """Write plain files and a manifest by hand."""
    lidar, camera = scene.lidars[0], scene.cameras[0]
    suffix = "pcd" if kind == "ascii" else kind
    for name in ("lidar", "images"):
        (folder / name).mkdir()
    for frame in lidar.frames:
        write_cloud(folder / "lidar" / f"{frame.timestamp_ns}.{suffix}", frame.points, kind)
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
files = "lidar/*.{suffix}"
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


@pytest.mark.parametrize("kind", ["pcd", "ascii", "ply", "npz", "bin"])
def test_every_kind_of_cloud_brings_the_drive_back_exactly(tmp_path, drive, kind):
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


def test_fusing_the_folder_gives_the_same_colours_as_fusing_the_drive(tmp_path, drive):
    write_folder(tmp_path, drive, "npz")
    own, known = list(sceneloom.iter_fused(sceneloom.open(tmp_path))), list(sceneloom.iter_fused(drive))
    assert len(own) == len(known) == 3
    for found, expected in zip(own, known, strict=True):
        np.testing.assert_allclose(found.points.positions, expected.points.positions, atol=1e-5)
        # mountings that were inverted twice may move a point over the edge of a pixel
        assert (found.points.colors == expected.points.colors).all(axis=1).mean() > 0.999
        assert (found.points.camera_index != 255).any()
