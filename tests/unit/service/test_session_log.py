"""The session log: what is written any MCAP reader gives back, and played again it gives the same bytes."""

import signal
import subprocess
import sys
import threading
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from tests.unit.db34t.sending import boxes_2d, boxes_3d, calibration, cloud, image, interface, timestamp

from sceneloom.db34t.events import Result
from sceneloom.db34t.interface import FusionInterface, Rig, format_calibrations
from sceneloom.db34t.protobuf import encode
from sceneloom.db34t.setting import CalibrationEntry
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.messages.mcap_files import McapWriter
from sceneloom.scene.poses import Poses
from sceneloom.service.session_log import SessionLog, compare, is_complete, read_log, replay, unfinished_path

POINTS = np.random.default_rng(0).uniform((2, -3, -2), (30, 3, 2), (200, 3))


def drive(fusion, frames=4, *, start=0):
    """Send pairs of every kind, with a hot calibration in the middle, motion, a refusal and a late record."""
    for seq in range(start, start + frames):
        at = 100 * seq
        if seq == start + frames // 2:
            longer = calibration(intrinsic_matrix=(80.0, 0, 31.5, 0, 80.0, 23.5, 0, 0, 1))
            fusion.set_calibration(longer, camera_id=1, lidar_id=0)
            fusion.set_property("depth_kind", "range")
        times = np.array([timestamp(at).nanoseconds, timestamp(at + 50).nanoseconds])
        locations = np.array([[500_000.0 + seq, 0, 0], [500_000.5 + seq, 0, 0]])
        fusion.send_motion(Poses(times, locations, np.array([[0, 0, 0, 1.0]] * 2)))
        for record in (image(at, seq, seq), cloud(at + 5, seq, POINTS), boxes_2d(at, seq), boxes_3d(at + 5, seq)):
            fusion.send(record)
        fusion.send(image(at, seq))  # its number came already
    fusion.send(cloud(100 * (start + frames), 99, sensor_id=7))


def begun(observer, *, inline=True):
    fusion = interface(inline=inline, observer=observer)
    assert fusion.add_property("site", "where it stands", "string")
    assert fusion.set_property("site", "A1")
    assert fusion.set_property("pairing_timeout_ms", 60_000)
    return fusion


def keeping(observe, results):
    """An observer that keeps the results as well."""

    def observer(event):
        observe(event)
        if isinstance(event, Result):
            results.append(event)

    return observer


@pytest.fixture
def path(tmp_path):
    return tmp_path / "session.mcap"


@pytest.fixture
def logged(path):
    """A log of one inline session, and its results."""
    results = []
    with SessionLog(path) as log, begun(keeping(log.session("rig"), results)) as fusion:
        drive(fusion)
    return path, results


def messages_of(path):
    """All messages as a reader that knows nothing of ours gives them: classes are made of the file's own schemas."""
    pools = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if schema.id not in pools:
                pool = descriptor_pool.DescriptorPool()
                for described in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(described)
                pools[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            yield schema.name, channel, pools[schema.id].FromString(message.data)


def test_any_reader_gives_back_all_that_came_in_and_went_out_and_played_again_it_gives_the_same_bytes(logged):
    path, results = logged
    found = list(messages_of(path))
    counts = Counter((c.metadata["what"], name.removeprefix("sceneloom.db34t4101.v1.")) for name, c, _ in found)
    records = {name: count for (what, name), count in counts.items() if what == "record"}
    assert records == dict.fromkeys(("ImageData", "PointCloudData", "Boxes3d", "Boxes2d"), 4)
    expected = {("result", "GetReply"): 8, ("refused", "Status"): 5, ("motion", "SendMotionRequest"): 4}
    expected |= {("refused-record", "ImageData"): 4, ("refused-record", "PointCloudData"): 1}
    expected |= {("properties", "Properties"): 2, ("calibration", "SetCalibrationRequest"): 2}
    assert {key: counts[key] for key in expected} == expected
    first = next(message for name, _, message in found if name.endswith("Properties"))
    assert {prop.name: prop.value.string_value for prop in first.properties}["site"] == "A1"
    sent = [message for name, _, message in found if name.endswith("SendMotionRequest")]
    assert sent[3].poses[0].position == [500_003.0, 0, 0]  # as it came, not from an origin of our own
    again = [result for _, result in replay(path)]
    for said in (lambda r: encode(r.record), lambda r: r.number, lambda r: r.configuration.revision):
        assert list(map(said, again)) == list(map(said, results))
    assert again[-1].configuration["site"] == "A1"
    report = compare(path)
    assert (report.equal, report.complete, bool(report)) == ({"rig": 8}, True, True)
    with FusionInterface() as threaded, pytest.raises(OptionError, match="inline"):
        threaded.repeat(None, None)


def test_a_result_that_differs_is_named(logged, tmp_path):
    path, _ = logged
    changed = tmp_path / "changed.mcap"
    with path.open("rb") as source, changed.open("wb") as target:
        writer = McapWriter(target, library="test", compression="lz4", chunk_bytes=1 << 20)
        channels = {}
        for schema, channel, message in make_reader(source).iter_messages(log_time_order=False):
            if channel.id not in channels:
                number = writer.add_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.add_channel(channel.topic, "protobuf", number, channel.metadata)
            content = message.data
            if channel.topic == "/rig/results/detections":
                reply = fusion_pb2.GetReply.FromString(content)
                reply.detections.image_seq += reply.number == 2
                content = reply.SerializeToString()
            writer.add_message(channels[channel.id], message.log_time, [content], message.publish_time)
        writer.finish()
    report = compare(changed)
    assert not report
    assert (report.equal, report.different) == ({"rig": 7}, {"rig": ("detections 2",)})


def test_a_live_session_with_drops_idle_flushes_and_hot_calibration_can_be_played_again(path, monkeypatch):
    gate, held, results = threading.Event(), threading.Event(), []
    feed = Rig.feed

    def feed_once_the_gate_is_open(rig, *arguments):
        held.set()
        assert gate.wait(30)
        return feed(rig, *arguments)

    monkeypatch.setattr(Rig, "feed", feed_once_the_gate_is_open)
    with SessionLog(path) as log, begun(keeping(log.session("live"), results), inline=False) as fusion:
        assert fusion.set_property("queue_length", 2)
        fusion.send(image(0, 1000))
        assert held.wait(30)
        drive(fusion, 6)  # two of each kind can wait
        gate.set()
        fusion.flush()
        assert fusion.set_property("pairing_timeout_ms", 1)
        fusion.send(image(700, 50))
        fusion.send(cloud(705, 50))  # waits for a later image until nothing comes any more
        while fusion.get(0, timeout_s=30).record.points_seq != 50:
            pass
        counts = fusion.counters.counts().items()
        dropped = sum(count for name, count in counts if name.startswith("dropped.queue-full."))
    assert dropped > 0
    assert len([entry for entry in read_log(path) if entry.what == "dropped-record"]) == dropped
    assert [result.record.points_seq for result in results][-1] == 50
    again = [result for _, result in replay(path, session="live")]
    assert [encode(result.record) for result in again] == [encode(result.record) for result in results]
    assert compare(path)


def test_calibrations_that_were_replaced_altogether_are_played_so(path):
    other = CalibrationEntry(1, 0, calibration(intrinsic_matrix=(70.0, 0, 31.5, 0, 70.0, 23.5, 0, 0, 1)))
    with SessionLog(path) as log, begun(log) as fusion:
        assert fusion.set_calibration(calibration(), camera_id=2, lidar_id=0)
        fusion.send(image(0, 0, sensor_id=2))
        drive(fusion, 2)
        assert fusion.set_property("calibration", format_calibrations((other,)))
        drive(fusion, 2, start=2)
        fusion.send(image(500, 0, sensor_id=2))
    with path.open("rb") as file:
        pairs = [m for _, c, m in make_reader(file).iter_messages() if c.metadata["what"] == "pairs"]
    assert len(pairs) == 1
    assert compare(path)


def test_several_sessions_stand_side_by_side_in_one_file(path):
    with SessionLog(path) as log:
        first, second = (begun(log.session(name)) for name in ("a", "b"))
        for seq in range(3):
            drive(first, 1, start=seq)
            drive(second, 1, start=2 * seq)
        first.close()
        second.close()
        with begun(log.session("a")) as again:
            drive(again, 1)
    report = compare(path)
    assert report
    assert set(report.equal) == {"a", "b", "a#2"}
    assert {name for name, _ in replay(path, session="b")} == {"b"}
    with path.open("rb") as file:
        reported = [record.metadata["session"] for record in make_reader(file).iter_metadata()]
    assert reported == ["a", "b", "a#2"]


CRASHING = """
import os, signal, sys
sys.path.insert(0, {folder!r})
from tests.unit.service.test_session_log import SessionLog, begun, drive
log = SessionLog({path!r}, kept_back_s=0)
drive(begun(log.session("rig")), 3)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_what_was_written_before_a_kill_can_be_read_and_played(path):
    program = CRASHING.format(folder=str(Path(__file__).parents[3]), path=str(path))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert not path.exists()
    left = unfinished_path(path)
    assert not is_complete(left)
    report = compare(left)
    assert report
    assert report.equal == {"rig": 4}  # the third sweep waits for an image
    with pytest.raises(OutputError, match="exists already"):
        SessionLog(path)


def test_a_file_that_was_cut_anywhere_ends_where_it_was_cut(logged, tmp_path):
    path, _ = logged
    content, cut, counts = path.read_bytes(), tmp_path / "cut.mcap", []
    for length in range(len(content) // 20, len(content), len(content) // 20):
        cut.write_bytes(content[:length])
        with suppress(DataError):
            counts.append(len(list(read_log(cut))))
    assert len(counts) > 5
    assert counts == sorted(counts)
    assert counts[-1] <= len(list(read_log(path)))


def test_what_is_no_log_is_refused_and_a_log_never_replaces_another_unless_it_may(path):
    for content in (b"", b"\x89MCAP0\r\n", b"no log at all", bytes(range(256))):
        path.write_bytes(content)
        with pytest.raises(DataError):
            list(read_log(path))
    with pytest.raises(OutputError, match="exists already"):
        SessionLog(path)
    ticks = iter([5_000, 4_000, 9_000] * 1000)
    with SessionLog(path, overwrite=True, clock_ns=lambda: next(ticks)) as log, begun(log) as fusion:
        drive(fusion, 1)
    assert compare(path).equal == {"default": 2}
    with path.open("rb") as file:  # whatever the clock does, times stand in order
        times = [record.log_time for record in StreamReader(file).records if type(record).__name__ == "Message"]
    assert times == sorted(times)


@pytest.fixture
def stalled(monkeypatch):
    """A disk that takes nothing until its gate is opened."""
    gate, add = threading.Event(), McapWriter.add_message

    def add_once_the_gate_is_open(writer, *arguments, **options):
        assert gate.wait(60)
        return add(writer, *arguments, **options)

    monkeypatch.setattr(McapWriter, "add_message", add_once_the_gate_is_open)
    yield gate
    gate.set()


def test_fusion_does_not_wait_for_the_disk_and_nothing_is_lost_of_what_there_is_room_for(path, stalled):
    log = SessionLog(path)
    with begun(log.session("rig")) as fusion:
        drive(fusion)
        results = [*fusion.results(0), *fusion.results(1)]
    assert len(results) == 6  # the fourth waits for a later image; and not a message is in the file
    stalled.set()
    log.close()
    assert (compare(path).equal, compare(path).gaps, log.lost) == ({"rig": 8}, {}, {})


def test_what_there_is_no_room_for_is_counted_and_the_log_says_where_its_gap_is_and_goes_on(path, stalled, caplog):
    log = SessionLog(path, most_bytes=60_000)
    with begun(log.session("rig")) as fusion:
        drive(fusion)
        counts = fusion.counters.counts()
        assert counts["results.sensor_data"] == 3
        assert log.lost["rig"] >= counts["errors.observer.NotLoggedError"] > 0
        stalled.set()
        with log._changed:
            assert log._changed.wait_for(log._is_done, 60)
        log._most_bytes = 1 << 30  # that the disk is slow once more is not asked here
        drive(fusion, 1, start=4)
    log.close()
    assert len([record for record in caplog.records if "has a gap" in record.message]) == 1
    report = compare(path)
    assert (report.gaps, bool(report), report.complete, report.different) == ({"rig": 1}, False, True, {})
    entries = list(read_log(path))
    (k,) = (k for k, entry in enumerate(entries) if entry.what == "gap")
    assert entries[k].message.reason.startswith(f"{log.lost['rig']} entries are missing")
    assert [entry.what for entry in entries[k:]].count("record") == 4


def test_an_error_of_the_disk_leaves_the_session_alone_and_is_reported_once(path, caplog):
    log = SessionLog(path, kept_back_s=0)
    with begun(log.session("rig")) as fusion:
        drive(fusion, 1)
        log._file._stream.close()
        drive(fusion, 2, start=1)
        counts = fusion.counters.counts()
    assert counts["results.sensor_data"] == 2
    assert counts["errors.observer.NotLoggedError"] > 10
    assert log.lost["rig"] >= counts["errors.observer.NotLoggedError"]
    assert len([record for record in caplog.records if "is cut" in record.message]) == 1
    assert isinstance(log.failure, ValueError)
    with pytest.raises(OutputError, match="cannot be written"):
        log.close()
    assert not is_complete(unfinished_path(path))
    assert [entry.what for entry in read_log(unfinished_path(path))].count("record") == 4
