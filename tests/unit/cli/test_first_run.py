"""What a terminal says while kernels are compiled."""

import importlib
import sys

import pytest

from sceneloom.cli.main import reported_compiling

KERNELS = """
from numba import int64
from sceneloom.kernels.cache import kernel

@kernel(int64(int64))
def doubled(number):
    return 2 * number

@kernel([int64(int64, int64)], nogil=True)
def added(first, second):
    return doubled(first) + second
"""


@pytest.fixture
def kernels(monkeypatch, tmp_path, request):
    """A module of two kernels that nobody has compiled yet."""
    name = f"kernels_{abs(hash(request.node.name))}"
    (tmp_path / f"{name}.py").write_text(KERNELS)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield lambda: importlib.import_module(name)
    sys.modules.pop(name, None)


def test_a_terminal_hears_once_of_compiling_and_not_when_kernels_are_kept(monkeypatch, capsys, kernels):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with reported_compiling():
        module = kernels()
        assert not capsys.readouterr().err
        assert [module.added(2, 3), module.doubled(4)] == [7, 8]
    assert capsys.readouterr().err.count("compiling") == 1
    sys.modules.pop(module.__name__)
    with reported_compiling():
        assert kernels().added(2, 3) == 7
    assert not capsys.readouterr().err


def test_nothing_is_stated_but_on_a_terminal(monkeypatch, capsys, kernels):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False)
    with reported_compiling():
        assert kernels().added(2, 3) == 7
    assert not capsys.readouterr().err
