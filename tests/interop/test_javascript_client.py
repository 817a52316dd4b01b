"""A client that knows the .proto and nothing else, in JavaScript, gets from the service what it has to get."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from sceneloom.service.running import _fuse_a_pair, running_server

CLIENT = Path(__file__).parents[2] / "examples" / "clients" / "javascript" / "client.js"
LIMIT_S = 120


@pytest.fixture(scope="module")
def modules():
    """The folder of modules that `npm install` made; tests are skipped without it, and without node."""
    if shutil.which("node") is None:
        pytest.skip("no node")
    folder = os.environ.get("SCENELOOM_NODE_MODULES", "")
    if not folder:
        pytest.skip(f"no modules of {CLIENT.parent.name}: npm install elsewhere and set SCENELOOM_NODE_MODULES")
    if not Path(folder, "@grpc", "grpc-js").is_dir():
        pytest.fail(f"SCENELOOM_NODE_MODULES={folder} has no @grpc/grpc-js")
    _fuse_a_pair()  # what it sends is fused within its deadline, which compiling would take
    return folder


def run(modules, *arguments):
    command, environment = ["node", str(CLIENT), *arguments], {**os.environ, "NODE_PATH": modules}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False)


def test_it_reads_both_fusion_types(modules):
    with running_server() as server:
        done = run(modules, server.address)
        assert done.returncode == 0, done.stderr
        assert len(server.sessions) == 0  # it ended its own
    found = json.loads(done.stdout)
    sensor_data = found["sensor_data"]
    assert (sensor_data["image_seq"], sensor_data["points_seq"], sensor_data["points"]) == (5, 5, 41)
    assert sensor_data["fields"] == ["x", "y", "z", "r", "g", "b"]
    # points lie on two lines that part from (10, 0, 0); a pixel is 0.2 m wide there
    assert sensor_data["nearest_m"] == pytest.approx(10.0)
    assert 5 <= sensor_data["depths"] <= 12
    (car,) = found["detections"]
    assert (car["class"], car["box_3d_id"], car["box_2d_id"]) == ("car", 7, 4)
    assert car["confidence"] > 0.9  # seen by both
    assert car["at"] == pytest.approx([10, 0, 0], abs=0.5)
    assert found["counts"]["results.detections"] == found["counts"]["results.sensor_data"] == 1


def test_it_says_when_nobody_answers(modules):
    done = run(modules, "127.0.0.1:9")
    assert done.returncode == 1
    assert "UNAVAILABLE" in done.stderr or "DEADLINE" in done.stderr
