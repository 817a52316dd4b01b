"""Files behind URLs read by ranges: scene files and MCAP."""

import pickle
import traceback
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import sceneloom
from sceneloom.batch.workers import may_pass
from sceneloom.cli.main import sceneloom as program
from sceneloom.errors import DataError
from sceneloom.formats.remote import stores
from sceneloom.formats.remote.stores import Patience, RemoteIdentity, patiently
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.scene import LidarFrame, LidarPoints, LidarSensor

CONTENT = bytes(np.random.default_rng(3).integers(0, 256, 900_000, np.uint8))
SECRET = "https-me:hidden"
SIGNED = "?X-Amz-Credential=hidden&X-Amz-Signature=hidden&sig=hidden&token=hidden"


def opened(served, name="drive.bin", query=""):
    return RemoteIdentity.of(served.url(name) + query).open()


@pytest.mark.parametrize("faults", [["503"], ["cut"], ["503", "cut", "503"]])
def test_ranges_come_whole_after_faults_that_pass(served, waits, faults):
    served.files["drive.bin"] = CONTENT
    file = opened(served)
    served.faults[:] = faults
    assert file.fetch(1000, 500_000) == CONTENT[1000:500_000]
    assert len(waits) == len(faults)
    file.close()


def test_a_slow_answer_is_asked_for_again(served, waits, monkeypatch):
    served.files["drive.bin"] = CONTENT
    monkeypatch.setattr(stores, "_PATIENCE", Patience(answer=0.3))
    file = opened(served)
    served.faults[:] = ["slow"]
    assert file.fetch(5, 5000) == CONTENT[5:5000]
    assert len(waits) == 1
    file.close()


@pytest.mark.parametrize("fault", ["503", "cut"])
def test_a_fault_that_stays_says_that_it_may_pass(served, waits, fault):
    served.files["drive.bin"] = CONTENT
    file = opened(served)
    served.faults[:] = [fault] * 50
    with pytest.raises(
        DataError, match=r"bytes 5 to 5000: (cannot be read: .*503|.*Not enough data|the server gave)"
    ) as reported:
        file.fetch(5, 5000)
    assert reported.value.passing
    reported.value.__context__ = None  # pickled, too, once a library for clusters was imported
    assert may_pass(pickle.loads(pickle.dumps(reported.value)))
    assert len(waits) == Patience().tries - 1
    assert all(first > 0 for first in waits)
    file.close()


def test_a_server_that_is_busy_at_first_is_opened(served, waits, encode_sfs):
    served.files["drive.sfs"] = encode_sfs({"version": "1.0", "sensors": []})
    served.faults[:] = ["503", "503", "503"]  # of HEAD, and of GET, which is asked for where HEAD is refused
    with sceneloom.open(served.url("drive.sfs")) as scene:
        assert scene.sensors == ()
    assert waits


def test_what_is_missing_is_not_tried_again(served, waits):
    with pytest.raises(DataError, match="cannot be found") as reported:
        opened(served, "absent.sfs")
    assert not reported.value.passing
    assert waits == []


@pytest.mark.parametrize("fault", [None, "503", "cut"])
def test_no_message_shows_secrets(served, fault, encode_sfs):
    """Neither a file that is missing, nor a server that fails, nor a fault inside of the file."""
    user = served.url("drive.sfs").replace("http://", "http://me:hidden@")
    served.files["drive.sfs"] = encode_sfs({"version": "1.0", "sensors": [{"id": 1.5, "type": "lidar"}]})
    served.faults[:] = [fault] * 40
    for url in (served.url("drive.sfs"), user, served.url("absent.sfs"), "http://127.0.0.1:9/drive.sfs"):
        with pytest.raises(DataError) as reported:
            sceneloom.open(url + SIGNED)
        shown = "".join(traceback.format_exception(reported.value)) + repr(reported.value) + str(reported.value.args)
        assert "hidden" not in shown.replace("hidden)", "")
        done = CliRunner().invoke(program, ["info", url + SIGNED])
        assert done.exit_code == 1
        assert "hidden" not in done.output + str(done.exception)
        served.faults[:] = [fault] * 40
    if fault is None:
        assert "sig=hidden" in served.queries[0], "the server has to get what the user stated"


def test_a_scene_reports_its_source_without_secrets(served, encode_sfs):
    served.files["drive.sfs"] = encode_sfs({"version": "1.0", "sensors": []})
    url = served.url("drive.sfs").replace("http://", "http://me:hidden@") + SIGNED
    for arguments in (["info", url], ["info", "--json", url], ["validate", url]):
        done = CliRunner().invoke(program, arguments)
        assert "127.0.0.1" in done.output
        assert "hidden" not in done.output, arguments
    with sceneloom.open(url) as scene:
        assert "hidden" not in repr(scene)


def test_waits_grow_and_end_at_the_deadline(waits):
    rule = Patience(tries=9, wait=1.0, longest_wait=4.0, deadline=1000.0)

    def fails():
        raise ConnectionResetError("cut")

    with pytest.raises(ConnectionResetError):
        patiently(fails, rule)
    bounds = [1, 2, 4, 4, 4, 4, 4, 4]
    assert all(top / 2 <= wait <= top for wait, top in zip(waits, bounds, strict=True))
    waits.clear()
    with pytest.raises(ConnectionResetError):
        patiently(fails, Patience(deadline=0.0))
    assert waits == []


def test_errors_of_data_are_not_tried_again(waits):
    def fails():
        raise PermissionError(13, "no")

    with pytest.raises(PermissionError):
        patiently(fails)
    assert waits == []


def test_what_is_asked_for_ahead_is_not_asked_for_again(served):
    served.files["drive.bin"] = CONTENT
    file = opened(served)
    file.ask_ahead([(0, 100), (200_000, 200_300), (200_400, 200_500), (800_000, 800_001)])
    asked = len(served.asked)
    assert asked == 3
    for start, stop in ((0, 100), (10, 20), (200_290, 200_450), (800_000, 800_001)):
        assert file.fetch(start, stop) == CONTENT[start:stop]
    assert len(served.asked) == asked
    assert file.fetch(50, 150) == CONTENT[50:150]
    assert len(served.asked) == asked + 1
    file.close()


def test_reading_near_takes_what_follows_with_it(served):
    served.files["drive.bin"] = CONTENT
    file = opened(served)
    assert file.read_near(100, 110, 50_000) == CONTENT[100:110]
    assert file.read_near(40_000, 40_010, 50_000) == CONTENT[40_000:40_010]
    assert len(served.asked) == 1
    assert file.read_near(899_990, 900_000, 50_000) == CONTENT[-10:]
    file.close()


def test_one_frame_of_a_file_of_a_gigabyte_costs_a_few_megabytes(tmp_path, monkeypatch):
    """The file is sparse; the server of the benchmark counts."""
    monkeypatch.syspath_prepend(Path(__file__).parents[4])
    from benchmarks.bucket import Bucket
    from benchmarks.remote import POINTS, write_sparse_scene

    write_sparse_scene(tmp_path / "drive.sfs", 600)
    assert (tmp_path / "drive.sfs").stat().st_size > 1e9
    with Bucket(tmp_path) as bucket, sceneloom.open(f"{bucket.address}/b/drive.sfs") as scene:
        opened = bucket.sent
        assert len(scene.lidars[0].frames[300].points.positions) == POINTS
        assert bucket.sent < 20e6
        assert bucket.sent - opened > POINTS * 13 * 0.99, "the points did come"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """40 sweeps of 8,000 points, in chunks that are not compressed, as bytes of an MCAP file."""
    folder = tmp_path_factory.mktemp("mcap")
    rng = np.random.default_rng(5)
    with SceneWriter(folder / "drive.sfs") as writer:
        writer.add_sensor(LidarSensor("top", ()))
        for k in range(40):
            points = LidarPoints(rng.normal(size=(8_000, 3)).astype(np.float32))
            writer.add_frame("top", LidarFrame(k * 100_000_000, points))
    with sceneloom.open(folder / "drive.sfs") as scene:
        sceneloom.write(scene, folder / "drive.mcap", compression="none")
    return folder / "drive.mcap"


def test_a_sweep_costs_its_message_and_not_the_file(served, drive):
    served.files["drive.mcap"] = drive.read_bytes()
    with sceneloom.open(served.url("drive.mcap")) as scene, sceneloom.open(drive) as local:
        assert served.bytes_sent < len(served.files["drive.mcap"]) / 4
        opened = served.bytes_sent
        found, expected = scene.lidars[0].frames[17], local.lidars[0].frames[17]
        assert found.timestamp_ns == expected.timestamp_ns
        np.testing.assert_array_equal(found.points.positions, expected.points.positions)
        assert served.bytes_sent - opened < 2 * 8_000 * 16 + 200_000


def test_faults_that_pass_do_not_show(served, drive, waits):
    served.files["drive.mcap"] = drive.read_bytes()
    with sceneloom.open(served.url("drive.mcap")) as scene:
        served.faults[:] = ["503", "cut", "503"]
        assert len(scene.lidars[0].frames[3].points.positions) == 8_000
    assert waits


def test_a_drive_goes_to_other_processes_and_is_distinguished_from_another_one(served, drive):
    served.files["drive.mcap"] = drive.read_bytes()
    with sceneloom.open(served.url("drive.mcap") + "?sig=hidden") as scene:
        again = pickle.loads(pickle.dumps(scene))
        assert len(again.lidars[0].frames[3].points.positions) == 8_000
        late = pickle.loads(pickle.dumps(scene))
    served.files["drive.mcap"] += b"\0"
    with pytest.raises(DataError, match="was changed after it was opened") as reported:
        _ = late.lidars[0].frames[5].points.positions
    assert "hidden" not in str(reported.value)
