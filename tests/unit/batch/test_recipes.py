"""The recipes for clusters, on this machine: the commands of their pods and tasks, started anew where they die."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import yaml

import sceneloom
from sceneloom.batch.record import Record
from sceneloom.simulate import LidarSpec, simulate_street

RECIPES = Path(__file__).parents[3] / "examples" / "cluster"
pytestmark = pytest.mark.slow


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
