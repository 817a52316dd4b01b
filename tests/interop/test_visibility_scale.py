"""Projections, activations, counts and labelled points, as Scale's library loads and validates them."""

import json
import subprocess

import numpy as np

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.cuboid_points import count_points, with_activations, with_counts, with_labeled_points
from sceneloom.colouring.cuboid_projection import project_cuboids
from sceneloom.scene import CuboidAnnotation
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, simulate_street

READ = """
import contextlib, io, json, math, sys
with contextlib.redirect_stdout(io.StringIO()):
    from scale_json_binary import read_file
    from scale_sensor_fusion_io.loaders import SFSLoader
    from scale_sensor_fusion_io.validation import parse_and_validate_scene
    result = parse_and_validate_scene(read_file(sys.argv[1]))
    scene = SFSLoader(sys.argv[1]).load()
boxes = {
    str(a.id): [p.boxes for p in a.projections or ()]
    for a in scene.annotations if hasattr(a, "projections")
}
print(json.dumps({"success": result.success, "count": len(scene.annotations), "boxes": boxes}))
"""


def test_what_was_projected_and_counted_loads_and_validates_there(scale_python, tmp_path):
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    drive = simulate_street(
        2, frames=3, lidar=LidarSpec(beams=16, steps=360), cameras=(camera,), traffic=TrafficSpec()
    ).scene
    counts = count_points(drive, moment="points", listed=True)
    scene = with_labeled_points(with_activations(with_counts(drive, counts), counts), counts)
    scene = project_cuboids(scene, lidar="lidar", activations=True)
    sceneloom.write(scene, tmp_path / "seen.sfs", profile="scale")
    done = subprocess.run(
        [scale_python, "-c", READ, tmp_path / "seen.sfs"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["success"]
    assert found["count"] == len(scene.annotations)
    seen = [a for a in scene.annotations if isinstance(a, CuboidAnnotation) and a.projections]
    assert len(seen) > 3
    for annotation in seen:
        (theirs,) = found["boxes"][annotation.id]
        for box, ours in zip(theirs, annotation.projections[0].boxes, strict=True):
            assert (box is None) == bool(np.isnan(ours).any())
            assert box is None or box == ours.tolist()
