"""Open a folder of your own clouds and images.

One text file, `rig.toml`, says what they are; then the folder opens like any other drive. Here the folder is made up
first: clouds as NumPy files and images as PNG, both named by their time in nanoseconds. For a folder of yours,
`sceneloom formats --template rig.toml --from FOLDER` begins the file.

    python examples/05_open_own_data.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import sceneloom

RIG = """\
trajectories = [{{ file = "poses.txt", form = "tum", unit = "nanoseconds" }}]
[[sensors]]
id = "top"
type = "lidar"
files = "top/*.npz"  # each with an array of points, one of intensity, one of times
times = {{ pattern = "{{ns}}" }}
point_times = {{ unit = "nanoseconds", relative_to = "clock" }}
extrinsic = {{ to = "base", matrix = {lidar} }}
[[sensors]]
id = "front"
type = "camera"
files = "front/*.png"
times = {{ pattern = "{{ns}}" }}
camera_model = {{ fx = {model.fx}, fy = {model.fy}, cx = {model.cx}, cy = {model.cy} }}
extrinsic = {{ to = "base", matrix = {camera} }}
"""


def make_folder(folder: Path) -> None:
    """Write what somebody's own recorder could have written."""
    drive = sceneloom.simulate_street(seed=3, frames=3).scene
    lidar, camera = drive.lidars[0], drive.cameras[0]
    for name in ("top", "front"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for frame in lidar.frames:
        points, path = frame.points, folder / "top" / f"{frame.timestamp_ns}.npz"
        np.savez(path, points=points.positions, intensity=points.intensities, t=points.timestamps_ns)
    for image in camera.images:
        Image.fromarray(image.rgb).save(folder / "front" / f"{image.timestamp_ns}.png")
    trajectory = drive.trajectories["groundTruth"].poses
    rows = np.column_stack([trajectory.timestamps_ns, trajectory.positions, trajectory.quaternions_xyzw])
    np.savetxt(folder / "poses.txt", rows, fmt="%d" + 7 * " %.9f")
    mounts = [sensor.mount.matrix.tolist() for sensor in (lidar, camera)]
    (folder / "rig.toml").write_text(RIG.format(lidar=mounts[0], camera=mounts[1], model=camera.camera))


if __name__ == "__main__":
    where = Path(sys.argv[1] if len(sys.argv) > 1 else "own_data")
    make_folder(where)
    with sceneloom.open(where) as scene:
        print([sensor.id for sensor in scene.sensors], sceneloom.fuse(scene).points, "points in one world")
