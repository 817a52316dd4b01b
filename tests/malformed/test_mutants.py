"""Mutants of drives, many of each format: a scene or an error of ours, in bounded time and memory."""

import sys

import pytest
from tests.malformed.mutants import DRIVES, try_mutants

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="memory of processes is bounded on Linux only"
)

FEW, MANY = 24, 2000


@pytest.mark.parametrize("name", [name for name in DRIVES if name != "laz"])
def test_a_mutant_of_a_drive_gives_a_scene_or_an_error_of_ours(name):
    tried = try_mutants(name, range(FEW))
    assert not tried.failures, str(tried)
    assert set(tried.outcomes) == {"scene", "refused"}


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVES)
def test_many_mutants_of_a_drive_give_a_scene_or_an_error_of_ours(name):
    tried = try_mutants(name, range(FEW, FEW + MANY), seconds=110)
    assert not tried.failures, str(tried)
