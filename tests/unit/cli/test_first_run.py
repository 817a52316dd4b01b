"""What a terminal says while kernels are compiled."""

import sys
from importlib.util import find_spec

import pytest

from sceneloom.cli.first_run import telling_of_compiling


@pytest.fixture
def importing(monkeypatch, tmp_path):
    """What happens where a kernel is imported for the first time, and none is kept."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    def asked(*names):
        before = list(sys.meta_path)
        with telling_of_compiling():
            for name in names:
                monkeypatch.delitem(sys.modules, name, raising=False)
                assert find_spec(name) is not None
        assert sys.meta_path == before

    return asked


@pytest.mark.parametrize(
    ("terminal", "names", "times"),
    [
        (True, ("sceneloom.kernels.voxels", "sceneloom.kernels.spacing"), 1),
        (True, ("sceneloom.kernels.cache",), 0),
        (False, ("sceneloom.kernels.voxels",), 0),
    ],
)
def test_a_terminal_hears_once_of_compiling(monkeypatch, capsys, importing, terminal, names, times):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    importing(*names)
    assert capsys.readouterr().err.count("compiling") == times
