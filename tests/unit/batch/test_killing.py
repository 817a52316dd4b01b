"""Workers that are killed again and again while drives are fused: nothing is lost, nothing is made twice."""

import os
import random
import signal
import threading
from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest

import sceneloom
from sceneloom.batch import Input, Job, run
from sceneloom.batch.cluster import DaskCluster
from sceneloom.batch.pool import ProcessPool
from sceneloom.batch.record import FOLDER
from sceneloom.cli.batch.one_drive import CALL, verb_named
from sceneloom.simulate import LidarSpec, simulate_street

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # of sockets to workers that were killed
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds its workers in Linux's /proc"),
]


def children(process):
    with suppress(OSError):
        for thread in Path(f"/proc/{process}/task").iterdir():
            yield from map(int, (thread / "children").read_text().split())


def workers():
    """Processes that were forked for us or started afresh."""
    for child in children("self"):
        with suppress(OSError):
            command = Path(f"/proc/{child}/cmdline").read_bytes()
            if b"forkserver" in command:
                yield from children(child)
            elif b"spawn_main" in command:
                yield child


def kill_now_and_then(ending, killed):
    generator = random.Random(0)
    while not ending.wait(generator.uniform(2.0, 5.0)):
        found = list(workers())
        if found:
            with suppress(ProcessLookupError):
                os.kill(generator.choice(found), signal.SIGKILL)
                killed.append(1)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize("make", [ProcessPool, DaskCluster.local], ids=["pool", "dask"])
def test_outputs_under_kills_are_those_of_a_quiet_run(tmp_path, make):
    places = [tmp_path / f"{k:03d}.sfs" for k in range(40)]
    sceneloom.write(simulate_street(frames=20, lidar=LidarSpec(steps=600)).scene, places[0])
    for place in places[1:]:
        place.hardlink_to(places[0])
    values = verb_named("fuse").make_context("fuse", [str(places[0]), "-o", "made.sfs"]).params
    left_out = {"path", "output", "as_json", "quiet", "verbose", "overwrite"}
    options = {"verb": "fuse", **{name: value for name, value in values.items() if name not in left_out}}
    inputs = tuple(Input(place=str(place)) for place in places)
    job = Job(verb="fuse", call=CALL, inputs=inputs, options=options, suffix=".sfs", retries=50)
    run(job, tmp_path / "quiet", workers=2)

    ending, killed, made = threading.Event(), [], Counter()
    killer = threading.Thread(target=kill_now_and_then, args=(ending, killed))
    executor = make(2)
    killer.start()
    try:
        summary = run(
            job, tmp_path / "out", executor=executor,
            told=lambda _, outcome: made.update([outcome.number] if not outcome.error else []),
        )  # fmt: skip
    finally:
        ending.set()
        killer.join()
    assert killed
    assert (summary.done, summary.failed) == (40, 0)
    assert set(made.values()) == {1}
    assert contents(tmp_path / "out") == contents(tmp_path / "quiet")
    assert not (tmp_path / "out" / FOLDER / "drafts").exists()
