"""Fixtures that all tests share, and how hard Hypothesis tries."""

import os
import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile("default", max_examples=40, derandomize=True, database=None, deadline=None)
settings.register_profile(
    "deep",
    max_examples=2_000,
    database=None,
    deadline=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("default")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("SCENELOOM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: set SCENELOOM_DATA")
    return folder


@pytest.fixture(scope="session")
def scale_python() -> str:
    """A Python interpreter that has scale-sensor-fusion-io; tests against it are skipped without one."""
    interpreter = os.environ.get("SCENELOOM_SCALE_PYTHON", "")
    if not interpreter:
        pytest.skip("no interpreter with Scale's library: set SCENELOOM_SCALE_PYTHON")
    found = shutil.which(interpreter)
    if found is None:
        pytest.fail(f"SCENELOOM_SCALE_PYTHON={interpreter} is not a program")
    return found
