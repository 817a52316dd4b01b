"""The first drive alone where kernels are missing, and no longer than it compiles."""

from pathlib import Path

import pytest

from sceneloom.batch.workers import Warming
from sceneloom.kernels.cache import KernelCache


@pytest.fixture
def cache(monkeypatch):
    """What is found of 9 kernels, and what the clock says."""
    found = {"compiled": 0, "writable": True, "clock": 0.0}
    monkeypatch.setattr(
        "sceneloom.batch.workers.find_kernel_cache",
        lambda: KernelCache(Path(), found["writable"], 9, found["compiled"]),
    )
    monkeypatch.setattr("sceneloom.batch.workers.time.monotonic", lambda: found["clock"])
    return found


def test_others_wait_as_long_as_more_and_more_is_compiled(cache):
    warming = Warming(grown=0.0)
    for compiled in (0, 1, 2, 3):
        cache |= {"compiled": compiled, "clock": compiled * 9.0}
        assert warming.goes_on()
    cache["clock"] += 10.5
    assert not warming.goes_on()
    cache["compiled"] = 4
    assert not warming.goes_on()


@pytest.mark.parametrize("change", [{"compiled": 9}, {"writable": False}])
def test_nobody_waits_where_nothing_would_be_gained(cache, change):
    cache |= change
    assert not Warming(grown=0.0).goes_on()


def test_nobody_waits_once_the_first_drive_has_ended(cache):
    warming = Warming(grown=0.0)
    warming.end()
    assert not warming.goes_on()
