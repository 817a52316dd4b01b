"""Fuse a recorded drive and use what comes out.

A recording is a folder: lines with times, videos, lidar files, a calibration. Here a simulated drive is written as
one, then fused like any other: every lidar point is moved into the world by the ego's pose at its own time, gets its
colour from the camera that sees it, and makes a depth in that camera's image unless something nearer hides it.

    python examples/02_fuse_a_drive.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.pipeline import FusionOutputs


def main(folder: Path) -> None:
    """Write a recording, fuse it into a scene file, and look at both ways to get at the results."""
    folder.mkdir(parents=True, exist_ok=True)
    sceneloom.write(sceneloom.simulate_street(frames=5).scene, folder / "drive", overwrite=True)

    with sceneloom.open(folder / "drive") as drive:
        # one way: sweep by sweep, nothing written
        for frame in sceneloom.iter_fused(drive):
            for view in frame.views:
                nearest = view.depths[view.visible].min()
                print(f"sweep {frame.index} in {view.camera_id}: {view.visible.sum()} points, nearest {nearest:.1f} m")

        # the other way: into a file, which others can open
        outputs = FusionOutputs(scene=folder / "drive.sfs", depth=folder / "depth", overwrite=True)
        report = sceneloom.fuse(drive, outputs=outputs)
        print(f"{report.points} points, {report.coloured_percent:.1f} % coloured")
        for loss in report.losses:
            print(f"  {loss.field}: {loss.what}")

    with sceneloom.open(folder / "drive.sfs") as scene:
        points = scene.lidars[0].frames[0].points
        seen = points.camera_index != 255
        print("mean colour of what the camera saw:", np.round(points.colors[seen].mean(axis=0)))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "fused"))
