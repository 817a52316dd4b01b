"""How fast recordings are read and written: lines and columns, video into images, lidar files into points.

Run with `python -m benchmarks.recording [lines|writing|video|lidar …] [--lines 1000000] [--repetitions 5]`; orjson is
in the extra `bench`. Both sides of each comparison take rotates, and the least time of each counts. A ratio of 1.2
means that the other side takes 1.2 times as long.

Lines: a drive with accelerometer and gyroscope at 200 Hz, ground truth at 100 Hz, images of two cameras at 20 Hz and
fixes at 1 Hz, all numbers with the digits that a 64-bit number needs. The other side is a plain loop of `orjson.loads`
that checks nothing and fills the same arrays. The peak is what reading allocates at most, beside the arrays that it
ends with.

Writing: such a drive without images, from the scene to the folder, against a plain loop of `orjson.dumps` over the
same arrays in the order of their times. Ours finds the exact number of each time and the order of its lines besides.

Video: 1080p H.264, against a bare loop of PyAV as it decodes by itself (one thread for images of one slice), against
one that asks it for red, green and blue, too, by its fast converter, which is a level dark, and against a bare loop
whose decoder works on several images at once, as it does here.

Lidar: files of 23-byte records, let go one by one, against `numpy.fromfile`, which leaves records as they are. Reading
here maps a file and checks the time of every record, and nothing more: fields are taken out of the records at their
first use. The last row has that in it: positions, intensities, rings, and times as seconds and as nanoseconds, each in
an array of its own.
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np

from benchmarks.recording_lines import measure_lines, measure_writing
from benchmarks.sides import measure, show
from sceneloom.formats.recording.contents import XYZIRT
from sceneloom.formats.recording.reader import read_points
from sceneloom.formats.video.reader import open_video

LIDAR_FILES, LIDAR_POINTS = 36, 120_000
IMAGES = 240


def write_video(path: Path) -> None:
    """Write a textured image with a little noise that moves."""
    random = np.random.default_rng(0)
    texture = np.kron(random.integers(0, 255, (60, 120, 3)), np.ones((40, 40, 1), np.int64))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "20", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = 1920, 1080, "yuv420p"
        for k in range(IMAGES):
            part = texture[5 * k : 5 * k + 1080, 8 * k : 8 * k + 1920]
            noisy = np.clip(part + random.integers(-6, 6, (1080, 1920, 1)), 0, 255).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(noisy, format="rgb24")))
        container.mux(stream.encode())


def decode_barely(path: Path, *, colours: bool = False, at_once: bool = False) -> int:
    """Decode all images, and throw them away."""
    count = 0
    with av.open(str(path)) as container:
        if at_once:
            container.streams.video[0].thread_type = "AUTO"
        for frame in container.decode(video=0):
            count += 1
            if colours:
                frame.to_ndarray(format="rgb24")
    return count


def read_images(path: Path) -> int:
    """Read all images here."""
    with open_video(path) as video:
        for k in range(video.count):
            video.rgb(k)
        return video.count


def measure_video(folder: Path, given: argparse.Namespace) -> None:
    path = folder / "data.mkv"
    write_video(path)
    sides: dict[str, Callable[[], object]] = {
        "PyAV, bare": lambda: decode_barely(path),
        "PyAV, with its colours": lambda: decode_barely(path, colours=True),
        "PyAV, bare, AUTO": lambda: decode_barely(path, at_once=True),
        "here": lambda: read_images(path),
    }
    show(f"video: {IMAGES} images of 1080p", "PyAV, bare", measure(sides, given.repetitions))


def write_lidar(folder: Path) -> list[Path]:
    """Write files of about 100 MB in all."""
    random = np.random.default_rng(0)
    paths = [folder / f"{k:06d}.bin" for k in range(LIDAR_FILES)]
    for k, path in enumerate(paths):
        records = np.zeros(LIDAR_POINTS, XYZIRT)
        for axis in "xyz":
            records[axis] = random.normal(size=LIDAR_POINTS)
        records["intensity"] = random.integers(0, 255, LIDAR_POINTS)
        records["ring"] = random.integers(0, 64, LIDAR_POINTS)
        records["timestamp"] = 0.1 * k + 1e-6 * np.arange(LIDAR_POINTS)
        path.write_bytes(records.tobytes())
    return paths


def read_fields(path: Path) -> None:
    """Read a sweep, and have all its fields made."""
    points = read_points(path)
    assert points.positions.flags.c_contiguous
    assert len(points.extras["file_seconds"]) == len(points)


def measure_lidar(folder: Path, given: argparse.Namespace) -> None:
    paths = write_lidar(folder)
    sides: dict[str, Callable[[], object]] = {
        "numpy.fromfile": lambda: [None for path in paths if np.fromfile(path, XYZIRT) is None],
        "here, records": lambda: [None for path in paths if read_points(path) is None],
        "here, all fields as arrays": lambda: [read_fields(path) for path in paths],
    }
    size = sum(path.stat().st_size for path in paths) / 1e6
    show(f"lidar: {size:.0f} MB in {len(paths)} files", "numpy.fromfile", measure(sides, given.repetitions))


PARTS: dict[str, Callable[[Path, argparse.Namespace], None]] = {
    "lines": measure_lines,
    "writing": measure_writing,
    "video": measure_video,
    "lidar": measure_lidar,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all of them if none is named")
    parser.add_argument("--lines", type=int, default=1_000_000)
    parser.add_argument("--repetitions", type=int, default=5)
    given = parser.parse_args()
    for name in given.parts or PARTS:
        with tempfile.TemporaryDirectory() as folder:
            PARTS[name](Path(folder), given)


if __name__ == "__main__":
    main()
