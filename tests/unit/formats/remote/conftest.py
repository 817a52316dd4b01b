"""A store in memory."""

import fsspec
import pytest


@pytest.fixture
def memory():
    """A store in memory, empty at first."""
    files = fsspec.filesystem("memory")
    files.store.clear()
    files.pseudo_dirs[:] = [""]
    yield files
    files.store.clear()
    files.pseudo_dirs[:] = [""]
