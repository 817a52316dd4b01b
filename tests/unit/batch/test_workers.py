"""Worker processes, workers of dask and the recipes for clusters: pools, warming up, those that are killed or lost."""

import json
import multiprocessing.context
import os
import pickle
import random
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from distributed import LocalCluster

import sceneloom
from sceneloom.batch import Input, Job, Task, run
from sceneloom.batch.cluster import DaskCluster, run_packed
from sceneloom.batch.record import FOLDER, Record
from sceneloom.batch.running import OUTCOME, ProcessPool, Warming
from sceneloom.cli.batch import CALL, verb_named
from sceneloom.errors import OptionError
from sceneloom.kernels.cache import KernelCache
from sceneloom.simulate import LidarSpec, simulate_street
from sceneloom.version import __version__


@pytest.mark.parametrize(("openmp", "numba", "seen"), [(None, "3", "13"), ("2", "1", "21"), ("5", "1", "51")])
def test_workers_have_one_thread_unless_the_user_says_otherwise(
    tmp_path, drives, job, monkeypatch, openmp, numba, seen
):
    monkeypatch.setenv("NUMBA_NUM_THREADS", numba)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if openmp:
        monkeypatch.setenv("OMP_NUM_THREADS", openmp)
    run(job("environment", drives("a.sfs")), tmp_path / "out", workers=1)
    assert (tmp_path / "out" / "a.txt").read_text() == seen


def test_a_worker_that_cannot_be_started_is_started_once_more(tmp_path, drives, job, monkeypatch):
    starts = []
    for process in (multiprocessing.context.ForkServerProcess, multiprocessing.context.SpawnProcess):

        def killed_once(process, start=process.start):
            starts.append(process)
            if len(starts) == 1:
                raise EOFError
            start(process)

        monkeypatch.setattr(process, "start", killed_once)
    summary = run(job("copy", drives("a.sfs")), tmp_path / "out", workers=1)
    assert (summary.done, summary.retried, len(starts)) == (1, 0, 2)
    # a fault of a worker that is no outcome is one of its task
    monkeypatch.setattr("sceneloom.batch.running.run_task", refuse_task)
    assert run(job("copy", drives("a.sfs")), tmp_path / "two", workers=1).failed == 1


def refuse_task(task):
    raise RuntimeError(task.location)


def test_others_wait_only_as_long_as_more_and_more_is_compiled(monkeypatch):
    found = {"compiled": 0, "writable": True, "clock": 0.0}
    looked = "sceneloom.batch.running.find_kernel_cache"
    monkeypatch.setattr(looked, lambda: KernelCache(Path(), found["writable"], 9, found["compiled"]))
    monkeypatch.setattr("sceneloom.batch.running.time.monotonic", lambda: found["clock"])
    ended, warming = Warming(grown=0.0), Warming(grown=0.0)
    ended.end()
    assert not ended.goes_on()
    for compiled in (0, 1, 2, 3):
        found |= {"compiled": compiled, "clock": compiled * 9.0}
        assert warming.goes_on()
    found["clock"] += 10.5
    assert not warming.goes_on()
    found["compiled"] = 4
    assert not warming.goes_on()
    for gained_nothing in ({"compiled": 9}, {"compiled": 0, "writable": False}):
        found |= gained_nothing
        assert not Warming(grown=0.0).goes_on()


pytestmark = [
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


@pytest.mark.slow
@pytest.mark.parametrize("make", [ProcessPool, DaskCluster.local], ids=["pool", "dask"])
def test_outputs_under_kills_are_those_of_a_quiet_run(tmp_path, make):
    locations = [tmp_path / f"{k:03d}.sfs" for k in range(40)]
    sceneloom.write(simulate_street(frames=20, lidar=LidarSpec(steps=600)).scene, locations[0])
    for location in locations[1:]:
        location.hardlink_to(locations[0])
    values = verb_named("fuse").make_context("fuse", [str(locations[0]), "-o", "made.sfs"]).params
    left_out = {"path", "output", "as_json", "quiet", "verbose", "overwrite"}
    options = {"verb": "fuse", **{name: value for name, value in values.items() if name not in left_out}}
    inputs = tuple(Input(location=str(location)) for location in locations)
    job = Job(verb="fuse", call=CALL, inputs=inputs, options=options, suffix=".sfs", retries=50)
    run(job, tmp_path / "quiet", workers=2)

    ending, killed, made = threading.Event(), [], Counter()
    killer = threading.Thread(target=kill_now_and_then, args=(ending, killed))
    executor = make(2)
    killer.start()
    try:
        summary = run(
            job, tmp_path / "out", executor=executor,
            reported=lambda _, outcome: made.update([outcome.number] if not outcome.error else []),
        )  # fmt: skip
    finally:
        ending.set()
        killer.join()
    assert killed
    assert (summary.done, summary.failed) == (40, 0)
    assert set(made.values()) == {1}
    assert contents(tmp_path / "out") == contents(tmp_path / "quiet")
    assert not (tmp_path / "out" / FOLDER / "drafts").exists()


def batch(*words):
    """A run of its own, in a group of processes that is no one else's."""
    return subprocess.Popen(
        [sys.executable, "-m", "sceneloom", "batch", *map(str, words), "--quiet", "--workers", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def living(group):
    """Processes of a group that are still there, but for dead ones that nobody has asked for."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state, _, its_group = (process / "stat").read_text().rpartition(")")[2].split()[:3]
            if int(its_group) == group and state not in "ZX":
                found.append(int(process.name))
    return found


@pytest.mark.parametrize("kills", [2, pytest.param(40, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_run_whose_parent_is_killed_again_and_again_is_taken_up_to_the_same_outputs(tmp_path, kills):
    (tmp_path / "in").mkdir()
    first = tmp_path / "in" / "00.sfs"
    sceneloom.write(simulate_street(frames=4, lidar=LidarSpec(beams=8, steps=90)).scene, first)
    for k in range(1, 12):
        (tmp_path / "in" / f"{k:02d}.sfs").hardlink_to(first)
    words = ("convert", *sorted((tmp_path / "in").iterdir()), "-o")
    quiet = batch(*words, tmp_path / "quiet")
    begun = time.monotonic()
    assert quiet.wait() == 0, quiet.stderr.read()
    usual, generator, killed, out = (time.monotonic() - begun, random.Random(kills), Counter(), tmp_path / "out")
    while sum(killed.values()) < kills:
        going = batch(*words, out, *(("--resume",) if (out / FOLDER).exists() else ()))
        with suppress(subprocess.TimeoutExpired):
            going.wait(usual * generator.uniform(0.2, 1.1))
        whom = generator.choice(["parent", "worker"])
        group = living(going.pid)
        if whom == "worker" and len(group) > 1 and going.poll() is None:
            os.kill(generator.choice([one for one in group if one != going.pid]), signal.SIGKILL)
            killed[whom] += 1
            assert going.wait(100 * usual) in {0, 1}, going.stderr.read()
        elif going.poll() is None:
            going.kill()
            killed["parent"] += 1
        else:
            shutil.rmtree(out)
        going.wait()
        for path in out.glob("*.sfs"):
            assert path.read_bytes() == (tmp_path / "quiet" / path.name).read_bytes()
        wait_until(lambda group=going.pid: not living(group))
    last = batch(*words, out, *(("--resume",) if (out / FOLDER).exists() else ()))
    assert last.wait() == 0, last.stderr.read()
    assert contents(out) == contents(tmp_path / "quiet")
    assert not (out / FOLDER / "drafts").exists()
    print(killed)  # noqa: T201 - figures of a long run


def wait_until(holds):
    """Wait until something holds, for a minute at the most."""
    ending = threading.Event()
    for _ in range(600):
        if holds():
            return
        ending.wait(0.1)
    pytest.fail("does not come to hold")


def test_drives_go_to_the_workers_of_a_running_scheduler(tmp_path, drives, job, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wanted = job("copy", drives("a", "bc"))
    with LocalCluster(n_workers=1, processes=False, dashboard_address=None) as workers:
        run(wanted, "out", executor=DaskCluster.at(workers.scheduler_address))
    assert [(tmp_path / "out" / f"{name}.txt").read_text() for name in ("a", "bc")] == ["a", "bc"]


@pytest.fixture
def task(tmp_path, drives, job):
    (tmp_path / "drafts").mkdir()
    (location,) = drives("a.sfs")
    draft = tmp_path / "drafts" / "1-1" / "a.txt"
    return Task(number=1, attempt=1, call=job("copy", []).call, location=location, draft=draft, options={})


def done(task, version=__version__):
    return json.loads(run_packed(version, pickle.dumps(task)))


def test_a_try_that_another_worker_has_begun_is_lost_and_one_that_ended_is_known(task):
    first = done(task)
    assert (first["error"], task.draft.read_text()) == ("", "a.sfs")
    assert done(task) == first
    task.draft.write_text("as the first left it")
    (task.draft.parent / OUTCOME).write_text('{"number": 1, "err')
    again = done(task)
    assert (again["kind"], again["passing"]) == ("Lost", True)
    assert task.draft.read_text() == "as the first left it"


def test_workers_without_the_folder_of_the_run_or_of_another_version_do_nothing(task):
    assert "expected the same" in done(task, "0.0.0")["error"]
    Path(task.draft.parent.parent).rmdir()
    assert "that all workers share" in done(task)["error"]
    assert not task.draft.parent.parent.exists()


def test_a_scheduler_that_is_not_there_is_named():
    with pytest.raises(OptionError, match=r"--cluster tcp://127\.0\.0\.1:9"):
        DaskCluster.at("tcp://127.0.0.1:9", seconds=0.1)


class Client:
    """A client of dask that keeps what it is given."""

    status = "running"

    def __init__(self):
        self.sent = []

    def nthreads(self):
        return {"tcp://one": 1, "tcp://two": 1, "tcp://wide": 4}

    def submit(self, function, version, packed, *, key, **how):
        self.sent.append(pickle.loads(packed))
        return SimpleNamespace(key=key, client=self, add_done_callback=lambda function: None)


def test_workers_elsewhere_have_the_next_task_at_hand_and_find_files_from_the_folder_of_the_run(
    task, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    files = {"boxes": (Path("a.jsonl"), Path("/b.jsonl")), "rig": Path("in/rig.toml"), "name": "a", "more": None}
    client = Client()
    cluster = DaskCluster(client)
    # none is at hand where it would begin beside the first
    assert cluster.free == 5
    cluster.submit(replace(task, location="in/a.sfs", options=files, files={"own": (Path("b"),)}))
    assert cluster.free == 4
    (sent,) = client.sent
    assert (sent.location, sent.files) == (str(tmp_path / "in" / "a.sfs"), {"own": (tmp_path / "b",)})
    absolute = {"boxes": (tmp_path / "a.jsonl", Path("/b.jsonl")), "rig": tmp_path / "in" / "rig.toml"}
    assert sent.options == {**files, **absolute}


RECIPES = Path(__file__).parents[3] / "examples" / "cluster"


@pytest.fixture
def fleet(tmp_path):
    """The shared volume, with the same drive under many names."""
    drives = tmp_path / "drives"
    drives.mkdir()
    sceneloom.write(simulate_street(frames=20, lidar=LidarSpec(steps=600)).scene, drives / "00.sfs")
    for number in range(1, 24):
        (drives / f"{number:02d}.sfs").hardlink_to(drives / "00.sfs")
    return tmp_path


@contextmanager
def pod(command, environment):
    """Run a command, again and again until the end; gives what kills it."""
    ending, running = threading.Event(), []

    def keep():
        while not ending.is_set():
            running[:] = [subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)]
            running[0].wait()

    thread = threading.Thread(target=keep)
    thread.start()
    try:
        yield lambda: running[0].send_signal(signal.SIGKILL)
    finally:
        ending.set()
        while thread.is_alive():
            running[0].kill()
            thread.join(timeout=0.2)


class Pods:
    """What the manifests of Kubernetes start, with locations of this machine."""

    def __init__(self, fleet):
        with socket.socket() as found:
            found.bind(("127.0.0.1", 0))
            self.port = found.getsockname()[1]
        self.fleet = fleet
        manifests = yaml.safe_load_all((RECIPES / "kubernetes.yaml").read_text())
        self.specs = {
            one["metadata"]["name"]: one["spec"]["template"]["spec"]["containers"][0]
            for one in manifests
            if "template" in one["spec"]
        }

    def command(self, name, *more):
        reported = [
            word.replace("sceneloom-scheduler:8786", f"127.0.0.1:{self.port}").replace("/fleet", str(self.fleet))
            for word in self.specs[name]["command"]
        ]
        return [str(Path(sys.executable).with_name(reported[0])), *reported[1:], *more]

    def environment(self, name):
        reported = {one["name"]: one["value"] for one in self.specs[name].get("env", [])}
        reported.pop("NUMBA_CACHE_DIR", None)  # kernels are compiled already
        return {**os.environ, **reported}


@pytest.mark.slow
def test_pods_that_die_are_started_anew_and_all_drives_are_done(fleet):
    pods = Pods(fleet)
    local = ("--host", "127.0.0.1", "--port", str(pods.port), "--dashboard-address", "127.0.0.1:0")
    with ExitStack() as stack:
        scheduler = pods.command("sceneloom-scheduler", *local)
        kill_scheduler = stack.enter_context(pod(scheduler, pods.environment("sceneloom-scheduler")))
        worker, within = pods.command("sceneloom-worker"), pods.environment("sceneloom-worker")
        kill_worker, _ = [stack.enter_context(pod(worker, within)) for _ in range(2)]
        tries = 0
        while True:
            tries += 1
            run = subprocess.Popen(pods.command("sceneloom-fuse"), env=pods.environment("sceneloom-fuse"))
            if tries == 1:
                wait_for(fleet, 3)
                kill_worker()
                wait_for(fleet, 8)
                kill_scheduler()
            if run.wait(timeout=240) == 0:
                break
            assert tries < 10
    assert len(list((fleet / "fused").glob("*.sfs"))) == 24
    with Record.opened(fleet / "fused") as record:
        assert {str(row.state) for row in record.rows()} == {"done"}


def wait_for(fleet, count):
    until = time.monotonic() + 120
    while len(list((fleet / "fused").glob("*.sfs"))) < count:
        assert time.monotonic() < until
        time.sleep(0.05)


@pytest.mark.slow
def test_the_script_for_slurm_runs_a_batch_on_its_tasks(fleet, tmp_path):
    tools = tmp_path / "bin"
    tools.mkdir()
    (tools / "srun").write_text('#!/bin/bash\nfor _ in 1 2; do "$@" & done\nwait\n')
    (tools / "srun").chmod(0o755)
    (tools / "hostname").write_text("#!/bin/bash\necho 127.0.0.1\n")
    (tools / "hostname").chmod(0o755)
    path = os.pathsep.join([str(tools), str(Path(sys.executable).parent), os.environ["PATH"]])
    script = shutil.copy(RECIPES / "slurm.sh", tmp_path)
    command = ["bash", script, "fuse", str(fleet / "drives" / "*"), "-o", str(fleet / "fused")]
    reported = {**os.environ, "PATH": path, "SLURM_JOB_ID": str(os.getpid()), "NUMBA_CACHE_DIR": ""}
    done = subprocess.run(command, env=reported, stderr=subprocess.PIPE, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert len(list((fleet / "fused").glob("*.sfs"))) == 24
