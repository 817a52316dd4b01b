"""Programs of others, run in environments of their own."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def _asked(python: str, program: str, *arguments: object) -> Any:
    """What a program prints last, as JSON; `program` is its text."""
    command = [python, "-c", program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1]) if done.stdout.strip() else None


@pytest.fixture(scope="session")
def ask() -> Callable[..., Any]:
    """Run a program in an interpreter: `ask(python, program, *arguments)`."""
    return _asked


@pytest.fixture(scope="session")
def scale(scale_python: str) -> Callable[..., Any]:
    """Run a program in the interpreter that has Scale's library."""
    return lambda program, *arguments: _asked(scale_python, program, *arguments)


READ = """
import contextlib, io, json, sys
import numpy as np
with contextlib.redirect_stdout(io.StringIO()):
    from scale_json_binary import read_file
    from scale_sensor_fusion_io.loaders import SFSLoader
    from scale_sensor_fusion_io.validation import parse_and_validate_scene
    result = parse_and_validate_scene(read_file(sys.argv[1]))
    stored = SFSLoader(sys.argv[1]).load_as_sfs()
    scene = SFSLoader(sys.argv[1]).load()

def plain(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return value

def sensor(s):
    out = {"id": s.id, "type": s.type.value, "times": [int(t) for t in s.poses.index], "poses": s.poses.values.tolist()}
    if s.type.value == "camera":
        i, d = s.intrinsics, s.intrinsics.distortion
        out["camera_model"] = [i.fx, i.fy, i.cx, i.cy, i.width, i.height]
        out["distortion"] = None if d is None else d.model.value
        out["images"] = [[m.timestamp, len(m.content)] for m in s.images or []]
        out["video"] = None if s.video is None else [s.video.timestamps, len(s.video.content), s.video.fps]
    else:
        names = ("positions", "timestamps", "intensities", "colors")
        out["frames"] = [
            {"timestamp": f.timestamp, **{name: plain(getattr(f.points, name, None)) for name in names}}
            for f in s.frames]
    return out

print(json.dumps({
    "faults": [] if result.success else [[list(map(str, e.path)), e.errors] for e in result.details],
    "offset": scene.time_offset,
    "attributes": plain(stored.attributes),
    "sensors": [sensor(s) for s in scene.sensors or []],
    "types": sorted(str(a.type.value) for a in scene.annotations or []),
    "annotations": {str(a.id): {"class": type(a).__name__, **plain(a)} for a in stored.annotations or []},
    "cuboids": {str(a.id): {"rows": a.path.values.tolist(), "boxes": [p.boxes for p in a.projections or ()]}
                for a in scene.annotations or [] if type(a).__name__ == "CuboidAnnotation"},
}))
"""


@pytest.fixture(scope="session")
def read_by_scale(scale: Callable[..., Any]) -> Callable[[Path], Any]:
    """What Scale's library finds in a scene file that it loads, and the faults that its validator finds."""
    return lambda path: scale(READ, path)


@pytest.fixture(scope="session")
def browser() -> tuple[str, str]:
    """A Chromium and the folder of modules with playwright-core; tests are skipped without them."""
    if shutil.which("node") is None:
        pytest.skip("no node")
    program, modules = os.environ.get("SCENELOOM_BROWSER", ""), os.environ.get("SCENELOOM_NODE_MODULES", "")
    if not program or not modules:
        pytest.skip("no browser: set SCENELOOM_BROWSER to a Chromium and SCENELOOM_NODE_MODULES, with playwright-core")
    if not Path(modules, "playwright-core").is_dir():
        pytest.fail(f"SCENELOOM_NODE_MODULES={modules} has no playwright-core")
    return program, modules
