"""Inputs that the fuzzer of the codec found to be answered with something else than values or an error of ours."""

import contextlib
import json

import pytest

from sceneloom.errors import SceneloomError
from sceneloom.formats.sfs.salvage import salvage
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene

UNKNOWN = {"id": "p", "type": "x", "paths": [[{"timestamps": [1]}]], "projections": [[1]]}
STREAMS = {"id": "i", "type": "imu", "streams": {"gyroscope": {"values": 1}}}

STRANGER = {"id": "c", "type": "x", "images": [{"timestamp": "x", "content": ""}], "video": {"timestamps": "yz"}}

MAP = {"id": "m", "type": "points", "points": 1, "poses": {"timestamps": [{}], "values": [[]]}, "frames": [{}]}

FOUND = {
    "a map at fault with poses, which a map does not have": {"version": "1.0", "sensors": [MAP]},
    "an unknown sensor whose images have text for times": {"version": "1.0", "sensors": [STRANGER]},
    "an unknown annotation with lists of numbers in the position of projections": {
        "version": "1.0",
        "annotations": [UNKNOWN],
    },
    "the same beside damage": {"version": "lidar", "time_unit": 1, "annotations": [UNKNOWN]},
    "a stream of an IMU without its times": {"version": "1.0", "metadata": {"sceneloom": {"sensors": [STREAMS]}}},
    "sensors that are an object": {"version": "1.0", "sensors": {"lidar": {"type": "lidar"}}},
}


@pytest.mark.parametrize("header", FOUND.values(), ids=FOUND)
def test_what_fuzzing_found_is_answered(header, tmp_path):
    path, target = tmp_path / "found.sfs", tmp_path / "out.sfs"
    path.write_bytes(json.dumps(header).encode() + bytes(4))
    for options in ({}, {"lenient": True}):
        with contextlib.suppress(SceneloomError), FORMAT.open(path, **options) as scene:
            write_scene(scene, target, overwrite=True)
            FORMAT.open(target).close()
    with contextlib.suppress(SceneloomError):
        salvage(path, target, overwrite=True)
        FORMAT.open(target).close()
