"""Files behind URLs read by ranges, and secrets of addresses, which no error, record, log or traceback has."""

import json
import pickle
import subprocess
import sys
import traceback

import numpy as np
import pytest
from click.testing import CliRunner

import sceneloom
from sceneloom.batch.running import may_pass
from sceneloom.cli.main import sceneloom as program
from sceneloom.errors import DataError
from sceneloom.formats.remote import stores
from sceneloom.formats.remote.mirror import find_urls
from sceneloom.formats.remote.stores import Patience, RemoteIdentity, patiently
from sceneloom.formats.remote.uploads import upload
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene

CONTENT = bytes(np.random.default_rng(3).integers(0, 256, 900_000, np.uint8))


@pytest.fixture
def file(served):
    served.files["drive.bin"] = CONTENT
    file = RemoteIdentity.of(served.url("drive.bin")).open()
    yield file
    file.close()


@pytest.mark.parametrize("faults", [["503"], ["cut"], ["503", "cut", "503"], ["slow"]])
def test_ranges_come_whole_after_faults_that_pass_and_slow_answers(served, file, waits, faults, monkeypatch):
    if "slow" in faults:
        monkeypatch.setattr(stores, "_PATIENCE", Patience(answer=0.3))
    served.faults[:] = faults
    assert file.fetch(1000, 500_000) == CONTENT[1000:500_000]
    assert len(waits) == len(faults)


@pytest.mark.parametrize("fault", ["503", "cut"])
def test_a_fault_that_stays_says_that_it_may_pass(served, file, waits, fault):
    served.faults[:] = [fault] * 50
    problem = r"bytes 5 to 5000: (cannot be read: .*503|.*Not enough data|the server gave)"
    with pytest.raises(DataError, match=problem) as reported:
        file.fetch(5, 5000)
    assert reported.value.passing
    reported.value.__context__ = None  # pickled, too, once a library for clusters was imported
    assert may_pass(pickle.loads(pickle.dumps(reported.value)))
    assert len(waits) == Patience().tries - 1
    assert all(first > 0 for first in waits)


def test_a_server_that_is_busy_at_first_is_opened(served, waits, encode_sfs):
    served.files["drive.sfs"] = encode_sfs({"version": "1.0", "sensors": []})
    served.faults[:] = ["503", "503", "503"]  # of HEAD, and of GET, which is asked for where HEAD is refused
    with sceneloom.open(served.url("drive.sfs")) as scene:
        assert scene.sensors == ()
    assert waits


def test_what_is_missing_or_refused_is_not_tried_again_and_waits_grow_and_end_at_the_deadline(served, waits):
    def failing(error, *rule):
        def fail():
            raise error

        with pytest.raises(type(error)):
            patiently(fail, *rule)

    with pytest.raises(DataError, match="cannot be found") as reported:
        RemoteIdentity.of(served.url("absent.sfs")).open()
    assert not reported.value.passing
    failing(PermissionError(13, "no"))
    failing(ConnectionResetError("cut"), Patience(deadline=0.0))
    assert waits == []
    failing(ConnectionResetError("cut"), Patience(tries=9, wait=1.0, longest_wait=4.0, deadline=1000.0))
    bounds = [1, 2, 4, 4, 4, 4, 4, 4]
    assert all(top / 2 <= wait <= top for wait, top in zip(waits, bounds, strict=True))


def test_what_is_asked_for_ahead_is_not_asked_for_again_and_reading_near_takes_what_follows(served, file):
    file.ask_ahead([(0, 100), (200_000, 200_300), (200_400, 200_500), (800_000, 800_001)])
    assert len(served.asked) == 3
    for start, stop in ((0, 100), (10, 20), (200_290, 200_450), (800_000, 800_001)):
        assert file.fetch(start, stop) == CONTENT[start:stop]
    assert len(served.asked) == 3
    assert file.fetch(50, 150) == CONTENT[50:150]
    assert len(served.asked) == 4
    assert file.read_near(1100, 1110, 50_000) == CONTENT[1100:1110]
    assert file.read_near(40_000, 40_010, 50_000) == CONTENT[40_000:40_010]
    assert len(served.asked) == 5
    assert file.read_near(899_990, 900_000, 50_000) == CONTENT[-10:]


@pytest.fixture
def drive(tmp_path):
    """40 sweeps of 8,000 points, in chunks that are not compressed, as bytes of an MCAP file."""
    rng = np.random.default_rng(5)
    frames = [
        LidarFrame(k * 100_000_000, LidarPoints(rng.normal(size=(8_000, 3)).astype(np.float32))) for k in range(40)
    ]
    lidar = LidarSensor("top", LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]))
    sceneloom.write(Scene((lidar,)), tmp_path / "drive.mcap", compression="none")
    return tmp_path / "drive.mcap"


def test_a_sweep_costs_its_message_faults_that_pass_do_not_show_and_other_processes_refuse_a_changed_drive(
    served, drive, waits
):
    served.files["drive.mcap"] = drive.read_bytes()
    with sceneloom.open(served.url("drive.mcap") + "?sig=hidden") as scene, sceneloom.open(drive) as local:
        assert served.bytes_sent < len(served.files["drive.mcap"]) / 4
        opened = served.bytes_sent
        found, expected = scene.lidars[0].frames[17], local.lidars[0].frames[17]
        assert found.timestamp_ns == expected.timestamp_ns
        np.testing.assert_array_equal(found.points.positions, expected.points.positions)
        assert served.bytes_sent - opened < 2 * 8_000 * 16 + 200_000
        served.faults[:] = ["503", "cut", "503"]
        assert len(scene.lidars[0].frames[3].points.positions) == 8_000
        assert waits
        again, late = (pickle.loads(pickle.dumps(scene)) for _ in range(2))
        assert len(again.lidars[0].frames[3].points.positions) == 8_000
    served.files["drive.mcap"] += b"\0"
    with pytest.raises(DataError, match="was changed after it was opened") as reported:
        _ = late.lidars[0].frames[5].points.positions
    assert "hidden" not in str(reported.value)


SIGNED = "?X-Amz-Signature=hidden&X-Amz-Credential=hidden%2Fus&sig=hidden&token=hidden"


def all_that_hangs_on(error):
    """An error, what it came from, and their texts."""
    seen, waiting = [], [error]
    while waiting:
        one = waiting.pop()
        if one is not None and one not in seen:
            seen.append(one)
            waiting += [one.__cause__, one.__context__]
    texts = [f"{one!r} {one} {one.args} {vars(one)}" for one in seen]
    return seen, "".join([*texts, *traceback.format_exception(error)]).replace("hidden)", "")


@pytest.mark.parametrize("fault", [None, "503", "cut"])
@pytest.mark.parametrize("sensors", [[{"id": 1.5, "type": "lidar"}], None])
def test_an_error_brings_nothing_of_what_the_back_end_raised(served, encode_sfs, fault, sensors):
    """Neither a file that is missing or faulty, nor one that is cut, nor a server that fails."""
    whole = encode_sfs({"version": "1.0", "sensors": sensors})
    served.files["drive.sfs"] = whole if sensors else b'{"version": "1.0"' + b" " * 100_000
    there = served.url("drive.sfs")
    user = there.replace("http://", "http://me:hidden@")
    for url in (there, user, served.url("absent.sfs"), "http://127.0.0.1:9/drive.sfs"):
        served.faults[:] = [fault] * 40
        with pytest.raises(DataError) as reported:
            sceneloom.open(url + SIGNED)
        seen, text = all_that_hangs_on(reported.value)
        assert "hidden" not in text
        assert all(type(one).__module__.startswith("sceneloom") for one in seen)
        assert b"hidden" not in pickle.dumps(reported.value)
        done = CliRunner().invoke(program, ["info", url + SIGNED])
        assert done.exit_code == 1
        assert "hidden" not in done.output + str(done.exception)
    if fault is None:
        assert "sig=hidden" in served.queries[0], "the server has to get what the user stated"


def test_a_scene_reports_its_source_without_secrets_and_the_other_doors_bring_none_either(served, encode_sfs, tmp_path):
    served.files["drive.sfs"] = encode_sfs({"version": "1.0", "sensors": []})
    url = served.url("drive.sfs").replace("http://", "http://me:hidden@") + SIGNED
    for arguments in (["info", url], ["info", "--json", url], ["validate", url]):
        done = CliRunner().invoke(program, arguments)
        assert "127.0.0.1" in done.output
        assert "hidden" not in done.output, arguments
    with sceneloom.open(url) as scene:
        assert "hidden" not in repr(scene)
    (tmp_path / "file").write_bytes(b"x")
    for door in (find_urls, lambda location: upload(tmp_path / "file", location)):
        with pytest.raises(sceneloom.SceneloomError) as reported:
            door("nosuch://me:hidden@host/a.sfs" + SIGNED)
        assert "hidden" not in all_that_hangs_on(reported.value)[1]


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
    print("validated", repr(sceneloom.validate(given["nobody"])))
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
        "there": served.url("drive.sfs"),
        "absent": served.url("absent.sfs"),
        "nobody": "http://me:hidden@127.0.0.1:9/drive.sfs",
        "refused": "nosuch://me:hidden@host/drive.sfs",
    }
    signed = json.dumps({name: url + SIGNED for name, url in given.items()})
    command = [sys.executable, str(tmp_path / "pool.py")]
    done = subprocess.run(command, input=signed, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.splitlines()[:2] == ["90000.0", "90000.0"]
    assert "127.0.0.1:9/drive.sfs" in done.stdout.partition("validated")[2]
    assert done.stderr.count("cannot be found") > 4, "each fault is reported in traceback and log"
    assert "in the log" in done.stderr
    # the last line of the program is shown as it stands, without its values
    assert "hidden" not in done.stdout + done.stderr
    assert "***" in done.stderr
