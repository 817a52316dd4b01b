"""What reading drives behind URLs costs: bytes, requests and seconds, counted by a store on this machine.

`python -m benchmarks.remote [--only scene|folder|mcap|video] [--frames 600]`: one frame of a scene file of a gigabyte;
what `sceneloom info` and five seconds of fusion take of a folder with a drive of a minute, beside fetching it whole by
s3fs; one sweep of an MCAP file of a gigabyte, beside the `mcap` package's reader on a file of fsspec; one image of
a recording's video, beside PyAV on one.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import av
import fsspec
import numpy as np
from mcap.reader import make_reader

import sceneloom
from benchmarks.bucket import Bucket
from sceneloom.cameras.camera import Camera
from sceneloom.scene import ImuSensor, LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene, VectorSamples

POINTS = 131_072
_IMU = ("accelerometer", "gyroscope")
ARRAYS = (("positions", "float32", 3, 4), ("intensities", "uint8", 1, 1))


def write_sparse_scene(path: Path, frames: int) -> None:
    """A lidar whose points are all zero: a gigabyte that takes no room on disk."""
    sweeps, items, offset = [], [], 64
    for k in range(frames):
        sweeps.append({"timestamp": 100_000 * k, "points": dict.fromkeys(("positions", "intensities"))})
        for name, dtype, columns, size in ARRAYS:
            length = POINTS * columns * size
            keys = ["sensors", 0, "frames", k, "points", name]
            shape = [POINTS, columns] if columns > 1 else [POINTS]
            items.append({"keys": keys, "offset": offset, "length": length, "dtype": dtype, "shape": shape})
            offset += length
    lidar = {"id": "top", "type": "lidar", "frames": sweeps}
    header = json.dumps({"version": "1.0", "sensors": [lidar], "$items": items}).encode()
    with path.open("wb") as file:
        file.write(header + b"\0")
        file.truncate(len(header) + offset)


def counted(bucket: Bucket, work: Callable[[], object]) -> str:
    """Do something, and state what it took."""
    bucket.begin()
    begun = time.perf_counter()
    work()
    seconds = time.perf_counter() - begun
    return f"{bucket.sent / 1e6:8.2f} MB, {bucket.requests:5d} requests, {seconds:6.2f} s"


def measure_scene(folder: Path, frames: int, latency: float) -> None:
    path = folder / "drive.sfs"
    write_sparse_scene(path, frames)
    with Bucket(folder, latency) as bucket:
        scenes = []
        print(f"a scene file of {path.stat().st_size / 1e9:.2f} GB, {frames} frames:")
        print("  opening   ", counted(bucket, lambda: scenes.append(sceneloom.open(f"{bucket.address}/b/drive.sfs"))))
        lidar = scenes[0].lidars[0]
        print("  one frame ", counted(bucket, lambda: lidar.frames[frames // 2].points.positions))
        scenes[0].close()


def write_drive(folder: Path, frames: int) -> None:
    """A minute of a street as KITTI has its raw drives."""
    from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

    street = simulate_street(
        0, frames=frames, lidar=LidarSpec(beams=32, steps=900), cameras=(CameraSpec(small_camera_model()),)
    )
    sceneloom.write(replace(street.scene, annotations=()), folder, format="kitti-raw")


def small_camera_model() -> Camera:
    return Camera("pinhole", 621, 188, 360.0, 360.0, 310.0, 93.5)


def measure_folder(folder: Path, frames: int, latency: float) -> None:
    write_drive(folder / "drive", frames)
    files = [path for path in (folder / "drive").rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    print(f"a folder of {size / 1e6:.0f} MB in {len(files)} files, {frames} sweeps and images:")
    with Bucket(folder, latency) as bucket, TemporaryDirectory() as location:
        environment = {
            **os.environ,
            "AWS_ACCESS_KEY_ID": "whoever",
            "AWS_SECRET_ACCESS_KEY": "whatever",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": bucket.address,
        }

        def run(*command: str) -> None:
            subprocess.run([sys.executable, *command], env=environment, check=True, stdout=subprocess.DEVNULL)

        def whole_then(*command: str) -> None:
            copy = Path(location, "whole")
            shutil.rmtree(copy, ignore_errors=True)
            run("-c", f"import s3fs; s3fs.S3FileSystem().get('drives/drive', {str(copy)!r}, recursive=True)")
            run("-m", "sceneloom", command[0], str(copy), *command[1:])

        url, out = "s3://drives/drive", ("-o", str(Path(location, "out.sfs")), "--overwrite", "--quiet")
        commands = {"info": ("info",), "5 s fused": ("fuse", *out, "--start", "20", "--stop", "25")}
        for name, command in commands.items():
            ours = counted(bucket, partial(run, "-m", "sceneloom", command[0], url, *command[1:]))
            print(f"  {name:10}", ours)
            print(f"  {'':10}", counted(bucket, partial(whole_then, *command)), "fetched whole by s3fs first")


def write_log(path: Path, frames: int, compression: str) -> None:
    """Sweeps of points that no compression makes smaller, and an IMU beside them."""
    rng = np.random.default_rng(0)
    sweeps = [rng.normal(size=(POINTS, 3)).astype(np.float32) for _ in range(4)]
    times = np.arange(frames, dtype=np.int64) * 100_000_000
    fast = np.arange(frames * 10, dtype=np.int64) * 10_000_000
    points = LazyFrames(times, lambda k: LidarFrame(int(times[k]), LidarPoints(sweeps[k % 4])))
    imu = ImuSensor("imu", {name: VectorSamples(fast, rng.normal(size=(len(fast), 3))) for name in _IMU})
    sceneloom.write(Scene((LidarSensor("top", points), imu)), path, format="mcap", compression=compression)


def read_by_peer(address: str, time_ns: int) -> None:
    """One sweep by the reader of the package `mcap`, on a file of fsspec."""
    with fsspec.open(address, "rb") as file:
        reader = make_reader(file)
        (_,) = reader.iter_messages(topics=["/top/points"], starting_at=time_ns, ending_before=time_ns + 1)


def measure_log(folder: Path, frames: int, latency: float) -> None:
    for compression in ("none", "zstd"):
        path = folder / f"{compression}.mcap"
        write_log(path, frames, compression)
        print(f"an MCAP file of {path.stat().st_size / 1e9:.2f} GB, compression {compression}, {frames} sweeps:")
        with Bucket(folder, latency) as bucket:
            read_log(bucket, f"{bucket.address}/b/{path.name}", frames)
        path.unlink()


def read_log(bucket: Bucket, address: str, frames: int) -> None:
    scenes = []
    print("  opening   ", counted(bucket, lambda: scenes.append(sceneloom.open(address))))
    lidar = scenes[0].lidars[0]
    print("  one sweep ", counted(bucket, lambda: lidar.frames[frames // 2].points.positions))
    time_ns = int(lidar.frames.timestamps_ns[frames // 2])
    print("  both      ", counted(bucket, lambda: read_by_peer(address, time_ns)), "by the package mcap")
    scenes[0].close()


def write_film(folder: Path, images: int) -> None:
    """A recording with a video of noise that moves, in groups of 20 images."""
    folder.mkdir()
    camera_model = {"model": "pinhole", "focalLengthX": 900, "focalLengthY": 900}
    camera_model |= {"principalPointX": 640, "principalPointY": 360}
    camera = {"cameraInd": 0, "cameraParameters": camera_model, "imuToCamera": np.eye(4).tolist()}
    lines = [json.dumps({"time": k / 10, "number": k, "frames": [camera]}) for k in range(images)]
    (folder / "data.jsonl").write_text("\n".join(lines) + "\n")
    noise = np.random.default_rng(0).integers(0, 256, (720, 1280, 3), np.uint8)
    with av.open(folder / "data.mp4", "w") as movie:
        stream = movie.add_stream("libx264", rate=10, options={"preset": "ultrafast", "g": "20", "crf": "18"})
        stream.width, stream.height = 1280, 720
        for k in range(images):
            movie.mux(stream.encode(av.VideoFrame.from_ndarray(np.roll(noise, 3 * k, 1), format="rgb24")))
        movie.mux(stream.encode())


def image_by_peer(address: str, seconds: float) -> None:
    """One image by PyAV, on a file of fsspec."""
    with fsspec.open(address, "rb") as file, av.open(file) as movie:
        (stream,) = movie.streams.video
        movie.seek(int(seconds / stream.time_base), stream=stream)
        next(frame for frame in movie.decode(stream) if frame.time >= seconds - 0.01).to_ndarray(format="rgb24")


def measure_video(folder: Path, frames: int, latency: float) -> None:
    write_film(folder / "film", frames)
    size = (folder / "film" / "data.mp4").stat().st_size
    print(f"a recording with an mp4 video of {size / 1e6:.0f} MB, {frames} images:")
    with Bucket(folder, latency) as bucket:
        os.environ |= {
            "AWS_ACCESS_KEY_ID": "whoever",
            "AWS_SECRET_ACCESS_KEY": "whatever",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": bucket.address,
        }
        scenes = []
        print("  opening    ", counted(bucket, lambda: scenes.append(sceneloom.open("s3://b/film"))))
        middle = frames // 2 + 10  # of a group
        (camera,) = scenes[0].cameras
        print("  one image", counted(bucket, lambda: camera.images[middle].rgb))
        address = f"{bucket.address}/b/film/data.mp4"
        print("  both       ", counted(bucket, lambda: image_by_peer(address, middle / 10)), "by PyAV on fsspec")
        print("  all        ", counted(bucket, lambda: [image.rgb.shape for image in camera.images]))
        scenes[0].close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--latency", type=float, default=0.02, help="of each answer [s]")
    parser.add_argument("--only", choices=("scene", "folder", "mcap", "video"))
    given = parser.parse_args()
    parts = {"scene": measure_scene, "folder": measure_folder, "mcap": measure_log, "video": measure_video}
    for name, measure in parts.items():
        if given.only in {None, name}:
            with TemporaryDirectory() as folder:
                measure(Path(folder), given.frames, given.latency)


if __name__ == "__main__":
    main()
