"""The pages for tasks, walked word for word: each line of their shell blocks, in a folder like a newcomer's."""

import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
PAGES = sorted(PROJECT.glob("docs/tasks/*.md"))
DEMO = "sceneloom demo"
LIMIT_S = 900
PORT = 50051


def shell_lines(page):
    """The commands of a page's shell blocks, without comments."""
    for block in re.findall(r"^```sh\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            command = line.split("  #")[0].strip()
            if command:
                yield command


def run(command, folder, **options):
    """Run a line in a shell whose `sceneloom` and `python` are those of this test."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    words = ["bash", "-c", command]
    return subprocess.run(
        words, cwd=folder, env={**os.environ, "PATH": path}, capture_output=True, text=True, check=False, **options
    )


def wait_for_port(port, server):
    """Wait until a server listens: it loads its kernels first, and compiles those that are not there yet."""
    stop = time.monotonic() + LIMIT_S
    while time.monotonic() < stop and server.poll() is None:
        with socket.socket() as tried:
            if tried.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.2)
    raise AssertionError(f"nothing listens at port {port}")


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """What the pages begin with, made once."""
    folder = tmp_path_factory.mktemp("demo")
    done = run(DEMO, folder, timeout=LIMIT_S)
    assert done.returncode == 0, done.stderr
    return folder / "sceneloom-demo"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_page_for_a_task_has_commands_to_follow(page):
    assert any(shlex.split(line)[0] == "sceneloom" for line in shell_lines(page))
    assert page.read_text("utf-8").startswith("# ")


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_can_be_followed_word_for_word(page, demo, tmp_path):
    (tmp_path / "examples").symlink_to(PROJECT / "examples")
    shutil.copytree(demo, tmp_path / "sceneloom-demo")
    server = None
    try:
        for line in shell_lines(page):
            if line == DEMO:
                continue
            if line.startswith("sceneloom serve"):
                words = shlex.split(line)
                server = subprocess.Popen([sys.executable, "-m", *words], cwd=tmp_path)
                wait_for_port(int(words[words.index("--port") + 1]) if "--port" in words else PORT, server)
                continue
            done = run(line, tmp_path, timeout=LIMIT_S)
            # 3 to 5 are verdicts of a calibration, which a synthetic street of three seconds may leave open
            assert done.returncode in ((0, 3, 4, 5) if "--check" in line else (0,)), f"{line}\n{done.stderr}"
    finally:
        if server is not None:
            server.send_signal(signal.SIGINT)
            server.wait(60)
