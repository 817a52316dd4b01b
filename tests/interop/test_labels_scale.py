"""Labels made of tracks, as Scale's library loads and validates them."""

import json
import subprocess

import numpy as np

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.scene import Support, Track, Tracks
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street
from sceneloom.tracking.labels import label_tracks

READ = """
import contextlib, io, json, sys
with contextlib.redirect_stdout(io.StringIO()):
    from scale_json_binary import read_file
    from scale_sensor_fusion_io.loaders import SFSLoader
    from scale_sensor_fusion_io.validation import parse_and_validate_scene
    result = parse_and_validate_scene(read_file(sys.argv[1]))
    scene = SFSLoader(sys.argv[1]).load()
cuboid, = [a for a in scene.annotations if hasattr(a, "projections")]
print(json.dumps({"success": result.success, "types": sorted(str(a.type.value) for a in scene.annotations),
    "times": [int(t) for t in cuboid.path.index], "rows": cuboid.path.values.tolist()}))
"""


def a_rotating_car(times_ns):
    count = len(times_ns)
    yaws = np.linspace(2.5, 3.9, count)
    return Track(
        3,
        "car",
        times_ns,
        np.column_stack([np.linspace(8.0, 14.0, count), np.full(count, 2.0), np.full(count, 0.8)]),
        np.tile([4.2, 1.8, 1.6], (count, 1)),
        (yaws + np.pi) % (2.0 * np.pi) - np.pi,
        np.tile([10.0, 0.0, 0.0], (count, 1)),
        np.zeros(count),
        np.tile(0.01 * np.eye(10), (count, 1, 1)),
        np.full(count, 0.87),
        np.full(count, Support.BOTH, np.uint8),
        {"camera0": np.tile([100.0, 80.0, 160.5, 120.0], (count, 1))},
    )


def test_labels_load_and_validate_there(scale_python, tmp_path):
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    drive = simulate_street(2, frames=4, lidar=LidarSpec(beams=16, steps=360), cameras=(camera,))
    track = a_rotating_car(drive.truth.lidar.timestamps_ns + 50_000_000)
    bare = sceneloom.scene.Scene(drive.scene.sensors, trajectories=drive.scene.trajectories)
    labelled = label_tracks(bare, Tracks((track,)))
    sceneloom.write(labelled.scene, tmp_path / "labels.sfs", profile="scale")
    done = subprocess.run(
        [scale_python, "-c", READ, tmp_path / "labels.sfs"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["success"]
    assert found["types"] == sorted(annotation.type for annotation in labelled.scene.annotations)
    # its rows are x y z yaw pitch roll dx dy dz; a car that rotations evenly needs its first state and its last
    rows = np.array(found["rows"])
    assert len(rows) == 2
    assert np.diff(rows[:, 3])[0] == np.float64(rows[1, 3] - rows[0, 3])
    np.testing.assert_allclose(rows[:, :3], track.centers[[0, -1]], atol=1e-9)
    np.testing.assert_allclose(rows[:, 3], np.degrees([2.5, 3.9]), atol=1e-9)
    np.testing.assert_allclose(rows[:, 6:], track.sizes_lwh[[0, -1]], atol=1e-9)
