"""Fuse a drive with an algorithm that another package brings, by its name.

`examples/algorithm_package` is such a package: one module, and entry points in its pyproject.toml. Once it is installed
(`pip install ./examples/algorithm_package`), `sceneloom fuse --algorithm near`, a session's property `fusion_algorithm`
and this script find it. To run without installing anything, the script puts the package's folder and its entry points
where Python looks for installed ones.

    python examples/10_add_an_algorithm.py
"""

import sys
import tempfile
import tomllib
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.fusion import FusionConfiguration
from sceneloom.fusion.algorithms import FusionType, names
from sceneloom.pipeline import iter_fused

PACKAGE = Path(__file__).parent / "algorithm_package"


def pretend_installed(package: Path, site: Path) -> None:
    """Do what an installation would, in folders that Python forgets afterwards."""
    project = tomllib.loads((package / "pyproject.toml").read_text("utf-8"))["project"]
    metadata = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir()
    about = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (metadata / "METADATA").write_text(about, "utf-8")
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in found.items()) for group, found in groups]
    (metadata / "entry_points.txt").write_text("\n".join(lines), "utf-8")
    sys.path[:0] = [str(site), str(package)]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        if "near" not in names(FusionType.SENSOR_DATA):
            pretend_installed(PACKAGE, Path(folder))
        print("sensor data:", *names(FusionType.SENSOR_DATA), "- detections:", *names(FusionType.DETECTIONS))
        drive = sceneloom.simulate_street(3, frames=4).scene
        for name in ("projection", "near"):
            fused = list(iter_fused(drive, configuration=FusionConfiguration(fusion_algorithm=name)))
            seen = np.mean([(frame.points.camera_index < 255).mean() for frame in fused])
            depth = max(view.depth_image.max() for frame in fused for view in frame.views)
            print(f"{name}: {seen:.1%} of the points have a colour, the farthest at a depth of {depth:.1f} m")
