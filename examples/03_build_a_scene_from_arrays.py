"""Build a scene file from plain arrays, for data that no reader knows.

What a sensor says comes as arrays with a time each; where it was comes as a path of poses. The writer takes frames
one by one and keeps none of them, so the drive may be longer than the memory. What the format cannot hold is reported
at the end.

    python examples/03_build_a_scene_from_arrays.py [FILE]
"""

import sys
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, PointsFrame


def main(path: Path) -> None:
    """Write a second of a synthetic lidar that drives along x, and read it back."""
    times_ns = np.arange(10, dtype=np.int64) * 100_000_000
    positions_world = np.zeros((10, 3))
    positions_world[:, 0] = np.linspace(0.0, 9.0, 10)
    poses = sceneloom.Poses(times_ns, positions_world, np.tile([0.0, 0.0, 0.0, 1.0], (10, 1)))

    rng = np.random.default_rng(0)
    lidar = LidarSensor("top", LazyFrames.of([], []), poses=poses, points_frame=PointsFrame.WORLD)
    with sceneloom.SceneWriter(path, overwrite=True) as writer:
        writer.add_sensor(lidar)
        for time_ns, location in zip(times_ns.tolist(), positions_world, strict=True):
            around = rng.normal(scale=5.0, size=(2000, 3)) + location
            brightness = rng.integers(0, 256, 2000).astype(np.uint8)
            points = LidarPoints(around, intensities=brightness)  # float64 becomes float32 where that loses nothing
            writer.add_frame("top", LidarFrame(time_ns, points))
    for loss in writer.losses:
        print(f"{loss.field}: {loss.what}")

    with sceneloom.open(path) as scene:
        for frame in scene.lidars[0].frames[::3]:
            print(
                f"{frame.timestamp_ns / 1e9:.1f} s: {len(frame.points)} points around {frame.points.positions.mean(0)}"
            )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "built.sfs"))
