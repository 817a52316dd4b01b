"""Scenes and files that the tests of this format share."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sceneloom.formats.sfs.spec import FORMAT

POSE_ROW = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]


def lidar_header(**fields):
    """The least lidar: two points, one pose."""
    return {
        "id": "top",
        "type": "lidar",
        "poses": {"timestamps": [0], "values": [POSE_ROW]},
        "frames": [{"timestamp": 0, "points": {"positions": np.ones((2, 3), np.float32)}}],
        **fields,
    }


def scene_header(*sensors, **fields):
    """The root of a file."""
    return {"version": "1.0", "sensors": list(sensors), **fields}


make = SimpleNamespace(lidar=lidar_header, scene=scene_header)


@pytest.fixture
def open_header(tmp_path, encode_sfs):
    """Write a header with arrays in it through the independent writer, and open it."""

    def open_it(header, **options):
        path = tmp_path / "scene.sfs"
        path.write_bytes(encode_sfs(header))
        return FORMAT.open(path, **options)

    return open_it


@pytest.fixture
def target(tmp_path) -> Path:
    """A file to be written."""
    return tmp_path / "written.sfs"
