"""A small folder of own data, and how a test changes it."""

import numpy as np
import pytest
from PIL import Image

from sceneloom.errors import DataError
from sceneloom.formats.rig.spec import FORMAT

START_NS = 1_532_402_927_600_000_000
MANIFEST = """\
ego = "base"

[[transforms]]
from = "top"
to = "base"
translation = [1.0, 0.0, 2.0]
quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]

[[sensors]]
id = "top"
type = "lidar"
files = "top/*.bin"
times = { pattern = "{ns}" }
intensity_max = 255
fields = ["x", "y", "z", "intensity"]

[[sensors]]
id = "front"
type = "camera"
files = "front/*.png"
times = { rate_hz = 10, start_s = 1532402927.65 }
axes = "flu"
camera_model = { fx = 6.0, cx = 3.5, cy = 2.5 }
extrinsic = { to = "top", translation = [0.5, 0.0, -0.5] }

[[trajectories]]
file = "poses.txt"
form = "tum"
"""
LIDAR_FILES = 'files = "top/*.bin"'
FIELDS = 'fields = ["x", "y", "z", "intensity"]'
SCALE = "intensity_max = 255"
BY_NAME = 'times = { pattern = "{ns}" }'
BY_RATE = "times = { rate_hz = 10, start_s = 1532402927.65 }"
CAMERA_MODEL = "cy = 2.5 }"
TUM = 'file = "poses.txt"\nform = "tum"'
FIRST_SENSOR = '[[sensors]]\nid = "top"'
POSES = """\
# timestamp tx ty tz qx qy qz qw
1532402927.5 0 0 0 0 0 0 1
1532402928.5 10 0 0 0 0 0 1
"""


def write_folder(tmp_path):
    """Write three sweeps of four points, three images of 8x6, a trajectory, and the manifest."""
    (tmp_path / "top").mkdir()
    (tmp_path / "front").mkdir()
    for k in range(3):
        points = np.arange(16, dtype="<f4").reshape(4, 4) + k
        (tmp_path / "top" / f"{START_NS + k * 100_000_000}.bin").write_bytes(points.tobytes())
        image = np.full((6, 8, 3), (10 * k, 20, 30), np.uint8)
        Image.fromarray(image).save(tmp_path / "front" / f"{k}.png")
    (tmp_path / "poses.txt").write_text(POSES)
    (tmp_path / "rig.toml").write_text(MANIFEST)
    return tmp_path


@pytest.fixture
def folder(tmp_path):
    return write_folder(tmp_path)


@pytest.fixture
def opened(folder):
    """Open the folder with parts of its manifest replaced: pairs of old and new text."""

    def open_changed(*pairs, **options):
        text = MANIFEST
        for old, new in pairs:
            assert old in text, old
            text = text.replace(old, new)
        (folder / "rig.toml").write_text(text)
        return FORMAT.open(folder, **options)

    return open_changed


@pytest.fixture
def refused(opened):
    """Check that the folder with parts of its manifest replaced is refused, with a problem."""

    def check(problem, *pairs):
        with pytest.raises(DataError, match=problem):
            opened(*pairs)

    return check


def codes(scene):
    return [warning.code for warning in scene.warnings]
