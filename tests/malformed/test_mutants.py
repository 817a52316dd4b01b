"""Mutants of drives, many of each format: a scene or an error of ours, in bounded time and memory."""

import sys

import pytest
from tests.malformed.mutants import ALL_DRIVES, DRIVES, try_mutants

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="memory of processes is bounded on Linux only"
)

FEW, MANY = 24, 2000
ALWAYS = {"openlabel", "laz", "recording", "kitti-object", "scale-toolkit", "mcap"}
"""Drives whose files are replaced in the usual run; the others follow in the long one."""


@pytest.mark.parametrize("name", DRIVES)
def test_a_mutant_of_a_drive_gives_a_scene_or_an_error_of_ours(name):
    tried = try_mutants(name, range(FEW))
    assert not tried.failures, str(tried)
    assert set(tried.outcomes) == {"scene", "refused"}


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVES)
def test_many_mutants_of_a_drive_give_a_scene_or_an_error_of_ours(name):
    tried = try_mutants(name, range(FEW, FEW + MANY), seconds=110)
    assert not tried.failures, str(tried)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in ALWAYS else pytest.mark.slow) for name in ALL_DRIVES]
)
def test_what_is_no_file_and_what_is_endless_in_the_place_of_any_file_is_refused_and_never_waited_for(name):
    if name == "argoverse2":
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    tried = try_mutants(name, None)
    assert not tried.failures, str(tried)
    assert tried.outcomes["refused"]
