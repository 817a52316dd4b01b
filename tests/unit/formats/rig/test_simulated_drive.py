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


@pytest.fixture(scope="module")
def drive():
    """Three sweeps of a coarse lidar and a small camera with distortion."""
    return simulate_street(4, frames=3, lidar=LidarSpec(beams=16, steps=300), cameras=(CameraSpec(CAMERA_MODEL),)).scene


def table(points) -> np.ndarray:
    """The points as records."""
    records = np.zeros(len(points), CLOUD)
    for axis, name in enumerate("xyz"):
        records[name] = points.positions[:, axis]
    records["i"], records["ring"], records["t"] = points.intensities, points.rings, points.timestamps_ns
    return records


def write_pcd(path: Path, records: np.ndarray) -> None:
    head = "FIELDS x y z i ring t\nSIZE 4 4 4 1 2 8\nTYPE F F F U U I\nWIDTH {}\nHEIGHT 1\nDATA binary\n"
    path.with_suffix(".pcd").write_bytes(head.format(len(records)).encode() + records.tobytes())


def write_ascii(path: Path, records: np.ndarray) -> None:
    head = "FIELDS x y z i ring t\nSIZE 4 4 4 1 2 8\nTYPE F F F U U I\nWIDTH {}\nHEIGHT 1\nDATA ascii\n"
    lines = "".join(" ".join(repr(value.item()) for value in row) + "\n" for row in records)
    path.with_suffix(".pcd").write_text(head.format(len(records)) + lines)


def write_ply(path: Path, records: np.ndarray) -> None:
    names = zip(["float", "float", "float", "uchar", "ushort", "double"], CLOUD.names, strict=True)
    head = "".join(f"property {kind} {name}\n" for kind, name in names)
    records = records.astype([*CLOUD.descr[:-1], ("t", "<f8")])
    text = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(records)}\n{head}end_header\n"
    path.with_suffix(".ply").write_bytes(text.encode() + records.tobytes())


def write_npz(path: Path, records: np.ndarray) -> None:
    np.savez_compressed(path.with_suffix(".npz"), **{name: records[name] for name in CLOUD.names})


def write_bin(path: Path, records: np.ndarray) -> None:
    path.with_suffix(".bin").write_bytes(records.tobytes())


WRITERS = {"pcd": write_pcd, "ascii": write_ascii, "ply": write_ply, "npz": write_npz, "bin": write_bin}


def write_folder(folder: Path, scene: sceneloom.Scene, kind: str) -> None:
    """Write plain files and a manifest by hand."""
    lidar, camera = scene.lidars[0], scene.cameras[0]
    for name in ("lidar", "images"):
        (folder / name).mkdir()
    for frame in lidar.frames:
        WRITERS[kind](folder / "lidar" / str(frame.timestamp_ns), table(frame.points))
    for image in camera.images:
        Image.fromarray(image.rgb).save(folder / "images" / f"{image.timestamp_ns}.png")
    trajectory = scene.trajectories["groundTruth"]
    rows = zip(
        trajectory.timestamps_ns.tolist(),
        trajectory.positions.tolist(),
        trajectory.quaternions_xyzw.tolist(),
        strict=True,
    )
    (folder / "trajectory.txt").write_text("".join(f"{t} {' '.join(map(repr, p + q))}\n" for t, p, q in rows))
    suffix = "pcd" if kind == "ascii" else kind
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


@pytest.mark.parametrize("kind", WRITERS)
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
    own = list(sceneloom.iter_fused(sceneloom.open(tmp_path)))
    known = list(sceneloom.iter_fused(drive))
    assert len(own) == len(known) == 3
    for found, expected in zip(own, known, strict=True):
        np.testing.assert_allclose(found.points.positions, expected.points.positions, atol=1e-5)
        same = (found.points.colors == expected.points.colors).all(axis=1)
        # mountings that were inverted twice may move a point over the edge of a pixel
        assert same.mean() > 0.999
        assert (found.points.camera_index != 255).any()
