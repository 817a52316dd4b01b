"""Kernels are there before a server listens, and configuration files are tried before a server starts."""

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.unit.db34t.sending import cloud, image

from sceneloom.db34t.interface import FusionInterface
from sceneloom.errors import DataError
from sceneloom.kernels import cache
from sceneloom.service import running
from sceneloom.service.running import read_configuration_file, warm_up
from sceneloom.service.server import ServerSettings


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [(), ("all",)])
def test_requests_and_the_whole_conformance_kit_reach_no_kernel_that_was_not_there_after_warming_up(arguments):
    command, folder = [sys.executable, "-m", "tests.unit.service.reach_kernels", *arguments], Path(__file__).parents[3]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=1200)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"events": 0, "later": []}


def test_missing_kernels_are_compiled_before_requests_and_logged(monkeypatch, caplog):
    asked, waited, loaded, ready = [], [], [], []

    @contextmanager
    def compiling_ahead(names, *, started):
        asked.extend(names)
        cache._report(asked[0], 1)
        yield waited.extend

    monkeypatch.setattr(running, "compiling_ahead", compiling_ahead)
    monkeypatch.setattr(running, "compile_kernels", lambda names: loaded.append(set(names)))
    with caplog.at_level(logging.INFO, "sceneloom.service"):
        assert warm_up(ready=lambda: ready.append(len(loaded))) == 2
    of_models = [f"sceneloom.cameras.{name}.project_into_image" for name in ("perspective:Pinhole", "fisheye:Fisheye")]
    assert {*of_models, "sceneloom.tracking.tracker:_predict"} <= set(asked)
    assert caplog.records[0].fields == {"kernel": asked[0], "left": 1}
    # what a session may ask for comes once the server listens; what its configuration asks for, before
    assert (set(of_models) & set(waited), ready) == ({of_models[0]}, [1])
    assert loaded == [set(waited), set(asked)]

    def configure(fusion):
        fusion.add_property("camera_models", "", "string")
        fisheye = {"model": "fisheye", "image_size": [64, 48], "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5}
        fusion.set_property("camera_models", json.dumps({"1": fisheye}))

    waited.clear()
    assert warm_up(configure=configure, ended=lambda: True) == 0
    assert set(of_models) <= set(waited)


def test_a_server_listens_only_when_it_is_warm_and_ends_at_once_if_it_is_told_so_while_loading(monkeypatch):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    seen, killed, here = [], [], threading.Event()

    def look(name):
        with socket.socket() as client:
            seen.append((name, client.connect_ex(("127.0.0.1", port)) == 0))

    def started(server):
        look("started")
        os.kill(os.getpid(), signal.SIGTERM)

    def load(started, *_):
        started(SimpleNamespace(kill=lambda: killed.append(True)))
        os.kill(os.getpid(), signal.SIGTERM)
        here.wait(60)

    monkeypatch.setattr(running, "warm_up", lambda started, ready, *_: (look("warming up"), ready()))
    monkeypatch.setattr(running.gc, "freeze", lambda: None)
    assert running.serve_until_ended(ServerSettings(port=port), started=started, quiet=True) == ()
    assert seen == [("warming up", False), ("started", True)]
    monkeypatch.setattr(running, "warm_up", load)
    assert running.serve_until_ended(ServerSettings(), started=lambda _: pytest.fail("it listens")) == ()
    assert killed == [True]
    here.set()


WITHOUT_GRPC = """
import sys
sys.modules["grpc"] = None
from sceneloom.cli.main import main
main(["serve"])
"""


def test_without_the_extra_the_verb_says_how_to_get_it():
    command = [sys.executable, "-c", WITHOUT_GRPC]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stdout, "Traceback" in done.stderr) == (1, "", False)
    assert "pip install 'sceneloom[serve]'" in done.stderr


WHOLE = """
[properties]
lidar_frequency = 20
lidar_coordinate = [0, -1, 2]

[[added]]
name = "site"
description = "where the rig is"
type = "string[2]"
value = ["yard", "road"]

[sensors.0]
kind = "lidar"
[sensors.1]
kind = "camera"
raw = "jpeg"

[[calibrations]]
camera_id = 1
image_size = [4, 2]
intrinsic_matrix = [5.0, 0, 1.5, 0, 5.0, 0.5, 0, 0, 1]
reference_frame = 0
extrinsic_matrix = [0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1]

[service]
most_sessions = 3
"""

CALIBRATION = WHOLE[WHOLE.index("[[calibrations]]") : WHOLE.index("[service]")]


@pytest.fixture
def read(tmp_path):
    def read_text(text, **options):
        path = tmp_path / "rig.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_configuration_file(path, **options)

    return read_text


def test_a_system_starts_as_the_file_says_and_an_empty_one_changes_nothing(read):
    found = read(WHOLE, further=("service",))
    assert found.further == {"service": {"most_sessions": 3}}
    with FusionInterface(inline=True) as fusion:
        found.apply(fusion)
        found = [fusion.get_property(name) for name in ("lidar_frequency", "lidar_coordinate", "site")]
        assert found == [20, (0, -1, 2), ("yard", "road")]
        assert all(map(fusion.send, (image(0, 1, width=4, height=2), cloud(0, 1))))
        assert fusion.send(cloud(0, 1, sensor_id=1)).cause == "unknown-sensor"
    with FusionInterface(inline=True) as fusion:
        before = fusion.list_properties()
        read("").apply(fusion)
        assert fusion.list_properties() == before


@pytest.mark.parametrize(
    ("text", "location", "words"),
    [
        ("propertes = 1", "propertes", "expected one of properties"),
        ("properties = 1", "properties", r"expected a table \[properties\]"),
        ("[added]\nname = 'x'", "added", r"expected a table \[\[added\]\]"),
        ("[service]\nx = 1", "service", "expected one of properties"),
        ("[properties]\nlidar_frequency = 0", "properties.lidar_frequency", "0; expected 1 or more"),
        ("[properties]\nlidar_frequency = 10.5", "properties.lidar_frequency", "10.5; expected a uint32"),
        ("[properties]\nlidar_frequenzy = 1", "properties.lidar_frequenzy", "'lidar_frequenzy' is not there"),
        ("[properties]\nsensors = '{}'", "properties.sensors", "expected \\[sensors.ID\\]"),
        ("[properties]\ncalibration = '[]'", "properties.calibration", "expected \\[\\[calibrations\\]\\]"),
        ("[properties]\nfusion_algorithm = 'MV3d'", "properties.fusion_algorithm", "MV3d"),
        ("[[added]]\nname = 'x'", r"added\[0\].type", "missing"),
        ("[[added]]\nname = 'x'\ntype = 'int64'", r"added\[0\]", "'int64'"),
        ("[[added]]\nname = 'x'\ntype = 7", r"added\[0\].type", "7; expected a string"),
        ("[[added]]\nname = 'x'\ntype = 'bool'\nunit = 'm'", r"added\[0\].unit", "expected one of name"),
        ("[[added]]\nname = 'x'\ntype = 'uint8'\nvalue = 256", r"added\[0\].value", "256; expected a uint8"),
        ("added = [1]", r"added\[0\]", "expected a table"),
        ("[sensors.0]\nkind = 'radar'", "sensors.0.kind", "'radar'"),
        ("[sensors]\n0 = 1979-05-27", "sensors.0", "expected an object"),
        (CALIBRATION + CALIBRATION, r"calibrations\[1\]", "camera 1 and lidar 0 again"),
        (CALIBRATION.replace("[4, 2]", "[4]"), r"calibrations\[0\].image_size", "expected"),
        (CALIBRATION.replace("image_size", "size"), r"calibrations\[0\].size", "not a field of table 3"),
        (CALIBRATION.replace("[5.0,", "[-5.0,"), r"calibrations\[0\]", "-5"),
        ("[properties", "", "no TOML"),
        (b"\xff\xfe", "", "no TOML"),
        ("a = " + "[" * 5000, "", "no TOML"),
    ],
)
def test_a_fault_is_reported_with_its_location(read, text, location, words):
    with pytest.raises(DataError, match=rf"rig\.toml: {location}.*{words}"):
        read(text)
