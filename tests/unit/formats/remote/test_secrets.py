"""Secrets of addresses stay where they are needed: no error, record, log or traceback of any process has them."""

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest

import sceneloom
from sceneloom.errors import DataError
from sceneloom.formats.remote.mirror import find_urls
from sceneloom.formats.remote.uploads import upload

SIGNED = "?X-Amz-Signature=hidden&X-Amz-Credential=hidden%2Fus&sig=hidden&token=hidden"


def all_that_hangs_on(error):
    """An error, what it came from, and their texts."""
    seen, waiting = [], [error]
    while waiting:
        one = waiting.pop()
        if one is not None and one not in seen:
            seen.append(one)
            waiting += [one.__cause__, one.__context__]
    return seen, "".join(f"{one!r} {one} {one.args} {vars(one)}" for one in seen)


@pytest.mark.parametrize("fault", [None, "503", "cut"])
def test_an_error_brings_nothing_of_what_the_back_end_raised(served, fault):
    served.files["drive.sfs"] = b'{"version": "1.0"' + b" " * 100_000
    served.faults[:] = [fault] * 40
    for url in (served.url("drive.sfs"), served.url("absent.sfs"), "http://127.0.0.1:9/drive.sfs"):
        with pytest.raises(DataError) as reported:
            sceneloom.open(url + SIGNED)
        seen, text = all_that_hangs_on(reported.value)
        assert "hidden" not in text
        assert all(type(one).__module__.startswith("sceneloom") for one in seen)
        assert b"hidden" not in pickle.dumps(reported.value)
        served.faults[:] = [fault] * 40


def test_the_other_doors_bring_nothing_either(tmp_path):
    (tmp_path / "file").write_bytes(b"x")
    url = "nosuch://me:hidden@host/a.sfs" + SIGNED
    for door in (find_urls, lambda location: upload(tmp_path / "file", location)):
        with pytest.raises(sceneloom.SceneloomError) as reported:
            door(url)
        assert "hidden" not in all_that_hangs_on(reported.value)[1]


@pytest.mark.slow
def test_what_is_stated_for_a_drive_that_cannot_be_read_shows_none():
    reported = sceneloom.validate("http://me:hidden@127.0.0.1:9/drive.sfs" + SIGNED)
    assert "127.0.0.1" in reported.source
    assert "hidden" not in repr(reported)


POOL = """
import json, logging, multiprocessing, sys, traceback
from concurrent.futures import ProcessPoolExecutor
import sceneloom
from sceneloom.formats.remote import stores

def read(url):
    # who tries again for long, tries here no longer than the test
    stores.time.sleep = lambda _: None
    with sceneloom.open(url) as scene:
        return float(scene.lidars[0].frames[0].points.positions.sum())

def frame(scene):
    return float(scene.lidars[0].frames[1].points.positions.sum())

if __name__ == "__main__":
    given = json.load(sys.stdin)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        print(pool.submit(read, given["there"]).result())
        with sceneloom.open(given["there"]) as scene:
            print(pool.submit(frame, scene).result())
            for work, what in ((read, given["absent"]), (read, given["nobody"]), (read, given["refused"])):
                try:
                    pool.submit(work, what).result()
                except Exception as error:
                    traceback.print_exc()
                    logging.exception("in the log")
                    print(repr(error), error.args, error.__cause__, error.__context__)
    sceneloom.open(given["absent"])  # and what nobody catches
"""


@pytest.mark.slow
def test_errors_of_worker_processes_show_none_in_tracebacks_and_logs(served, encode_sfs, tmp_path):
    frames = [{"timestamp": 100_000 * k, "points": {"positions": np.ones((30_000, 3), np.float32)}} for k in range(2)]
    served.files["drive.sfs"] = encode_sfs(
        {"version": "1.0", "sensors": [{"id": "top", "type": "lidar", "frames": frames}]}
    )
    (tmp_path / "pool.py").write_text(POOL)
    given = {
        "there": served.url("drive.sfs") + SIGNED,
        "absent": served.url("absent.sfs") + SIGNED,
        "nobody": "http://me:hidden@127.0.0.1:9/drive.sfs" + SIGNED,
        "refused": "nosuch://me:hidden@host/drive.sfs" + SIGNED,
    }
    done = subprocess.run(
        [sys.executable, str(tmp_path / "pool.py")],
        input=json.dumps(given),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stdout.splitlines()[:2] == ["90000.0", "90000.0"]
    assert done.stderr.count("cannot be found") > 4, "each fault is reported in traceback and log"
    assert "in the log" in done.stderr
    # the last line of the program is shown as it stands, without its values
    assert "hidden" not in done.stdout + done.stderr
    assert "***" in done.stderr
