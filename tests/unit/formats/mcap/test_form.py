"""What the format says where the extra is missing, and of files that are none of its own."""

import subprocess
import sys

import pytest

from sceneloom.errors import UnknownFormatError, UnknownOptionError
from sceneloom.formats.base.registry import find_format
from sceneloom.formats.messages.spec import MCAP

WITHOUT = """
import sys, importlib.abc
class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] in {"google", "foxglove_schemas_protobuf", "rosbags", "ruamel"}:
            raise ImportError(f"No module named {name!r}")
sys.meta_path.insert(0, Missing())
import sceneloom
for target, extra in (("a.mcap", "mcap"), ("a.bag", "ros"), ("a.ros2", "ros")):
    try:
        sceneloom.write(sceneloom.Scene(()), target)
    except sceneloom.errors.MissingExtraError as error:
        assert f"sceneloom[{extra}]" in str(error), error
    else:
        raise SystemExit(f"{target} was written")
"""


def test_without_the_extras_a_person_is_reported_which_to_install(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_file_that_is_only_called_so_is_reported(tmp_path):
    path = tmp_path / "drive.mcap"
    path.write_bytes(b"no log")
    with pytest.raises(UnknownFormatError, match="called like an MCAP file"):
        find_format(path)


def test_unknown_options_are_refused(tmp_path):
    with pytest.raises(UnknownOptionError, match="timestamps, ego, world"):
        MCAP.open(tmp_path / "drive.mcap", stamp="header")
