"""Edit a scene: cut it in two, join the parts, see it from the ego, come back, and keep only what is near.

A street is simulated and written. Each edit is a function that takes a scene and gives another one, whose frames are
changed when they are read; `sceneloom edit` does the same from file to file.

    python examples/07_edit_a_scene.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.editing import crop_scene, merge_scenes, thin_scene, to_ego, to_world
from sceneloom.simulate import CameraSpec, LidarSpec


def points_of(scene):
    """How many points the sweeps have."""
    return sum(len(frame.points) for frame in scene.lidars[0].frames)


if __name__ == "__main__":
    where = Path(sys.argv[1] if len(sys.argv) > 1 else "edited")
    where.mkdir(exist_ok=True)
    camera = CameraSpec(Camera("pinhole", 160, 96, 100.0, 100.0, 79.5, 47.5))
    drive = sceneloom.simulate_street(4, frames=6, lidar=LidarSpec(beams=16, steps=360), cameras=(camera,))
    sceneloom.write(drive.scene, where / "drive.sfs", overwrite=True)

    with sceneloom.open(where / "drive.sfs") as scene:
        parts = [crop_scene(scene, stop=0.6), crop_scene(scene, start=0.6)]
        print("sweeps of the parts:", [len(part.lidars[0].frames) for part in parts])
        joined = merge_scenes(parts, join=True)
        print("sweeps of the whole:", len(joined.lidars[0].frames))

        world = to_world(joined)
        again = to_world(to_ego(world))
        pairs = zip(world.lidars[0].frames, again.lidars[0].frames, strict=True)
        off = max(np.abs(a.points.positions - b.points.positions).max() for a, b in pairs)
        print(f"seen from the ego and back: {off:.1e} m off at most")

        near = thin_scene(crop_scene(world, reach=25.0), voxel=0.5)
        print(f"points: {points_of(world)}, within 25 m and one per half metre: {points_of(near)}")
        print(f"boxes: {len(world.annotations)}, near the lidar at some time: {len(near.annotations)}")
        sceneloom.write(near, where / "near.sfs", overwrite=True)
