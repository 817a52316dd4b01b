"""Make up a drive and compare what its sensors state with what was really there.

A simulated drive has two sides. `drive.scene` is what a reader of recordings would give: a lidar whose sweeps are
bent by the ego's motion, cameras, an inertial unit, a satellite receiver. `drive.truth` knows the exact answer to
every question about it. Here we bring one sweep into the world by the ground-truth trajectory, measure how far its
points end from where the laser really hit, and save an image with its true depth.

    python examples/01_simulate_a_drive.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from sceneloom.motion.deskew import points_to_world
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street


def main(folder: Path) -> None:
    """Simulate ten sweeps and look at the fifth."""
    drive = simulate_street(seed=2, frames=10, lidar=LidarSpec(range_sigma=0.02), cameras=[CameraSpec()])
    lidar, camera = drive.scene.lidars[0], drive.scene.cameras[0]

    frame, clean = lidar.frames[5], drive.truth.clean_points_world(5)
    ego = drive.scene.trajectories["groundTruth"].poses
    points_world, _ = points_to_world(frame, PoseSource(ego, lidar.mount))
    error = np.linalg.norm(points_world - clean.positions_world, axis=1)
    print(
        f"{len(frame.points)} points, {np.sqrt((error**2).mean()):.3f} m from where they come from (root mean square)"
    )

    at_start = ego.interpolate(np.array([frame.timestamp_ns, frame.timestamp_ns + 99_000_000]))
    print(f"the ego moved {np.linalg.norm(np.diff(at_start.positions, axis=0)):.2f} m during the sweep")

    labels = {thing.instance: thing.label for thing in drive.truth.objects} | {0: "ground"}
    for label in sorted(set(labels.values())):
        own = [instance for instance, name in labels.items() if name == label]
        print(f"  {label:9s} {np.isin(clean.instances, own).sum():6d} points")

    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(camera.images[5].rgb).save(folder / "image.png")
    depth = drive.truth.depth("camera0", 5)
    Image.fromarray(np.minimum(depth * 256.0, 65535.0).astype(np.uint16)).save(folder / "depth.png")
    print(f"image.png and depth.png (metres times 256) are in {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "simulated"))
