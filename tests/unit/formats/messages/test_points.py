"""Sweeps that go from one log into another stay packed, and are the same to whoever looks at them."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.messages import writer as messages_writer
from sceneloom.formats.messages.writer import kept_record
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene

pytest.importorskip("mcap")

COUNT = 50
TIMESTAMPS = np.array([1_000_000_000, 1_100_000_000])


def points(k):
    rows = np.random.default_rng(k)
    return LidarPoints(
        rows.normal(size=(COUNT, 3)).astype(np.float32),
        intensities=np.arange(COUNT, dtype=np.uint8),
        colors=rows.integers(0, 256, (COUNT, 3), np.uint8),
        timestamps_ns=TIMESTAMPS[k] + np.arange(COUNT) * 1_000,
        rings=np.arange(COUNT, dtype=np.uint16),
        camera_index=np.full(COUNT, k, np.uint8),
        extras={"range": rows.random(COUNT, np.float32)},
    )


def write(path, *sweeps):
    frames = [LidarFrame(int(time), one) for time, one in zip(TIMESTAMPS, sweeps, strict=False)]
    write_scene(Scene((LidarSensor("top", LazyFrames.of(frames, TIMESTAMPS[: len(frames)].tolist())),)), path)
    return path


@pytest.fixture
def log(tmp_path):
    return write(tmp_path / "log.mcap", points(0), points(1))


def test_sweeps_of_a_log_stay_packed_until_a_field_is_asked_for_and_are_the_same_in_a_copy(log, tmp_path):
    with open_scene(log) as scene:
        frame = scene.lidars[0].frames[1]
        assert (frame.points.packed_count(), len(frame.points)) == (COUNT, COUNT)
        np.testing.assert_array_equal(frame.points.positions, points(1).positions)
        assert frame.points.packed_count() is None
        write_scene(scene, tmp_path / "copy.mcap")
    with open_scene(tmp_path / "copy.mcap") as copy:
        for k, frame in enumerate(copy.lidars[0].frames):
            expected = points(k)
            for name in ("positions", "intensities", "colors", "timestamps_ns", "rings", "camera_index"):
                np.testing.assert_array_equal(getattr(frame.points, name), getattr(expected, name), name)
            np.testing.assert_array_equal(frame.points.extras["range"], expected.extras["range"])
    with open_scene(log) as scene:
        frame = scene.lidars[0].frames[0]
        assert kept_record(frame.points, frame.timestamp_ns) is not None
        moved = replace(frame, timestamp_ns=frame.timestamp_ns + 1)
        assert kept_record(moved.points, moved.timestamp_ns) is None
        assert kept_record(points(0), frame.timestamp_ns) is None


def test_a_sweep_without_points_is_written_with_all_its_fields(tmp_path):
    empty = LidarPoints(np.zeros((0, 3), np.float32), intensities=np.zeros(0, np.uint8), rings=np.zeros(0, np.uint16))
    with open_scene(write(tmp_path / "log.mcap", empty, points(1))) as scene:
        first, second = (frame.points for frame in scene.lidars[0].frames)
        assert (len(first), first.rings.shape, first.intensities.shape) == (0, (0,), (0,))
        np.testing.assert_array_equal(second.positions, points(1).positions)


def test_logs_that_state_times_in_their_older_column_are_read(tmp_path, monkeypatch):
    def old(times, timestamp):
        return {("offset_ns",): (times - timestamp).astype(np.int32)}

    monkeypatch.setattr(messages_writer, "_offsets", old)
    write(tmp_path / "old.mcap", points(0))
    monkeypatch.undo()
    with open_scene(tmp_path / "old.mcap") as read:
        np.testing.assert_array_equal(read.lidars[0].frames[0].points.timestamps_ns, points(0).timestamps_ns)
        write_scene(read, tmp_path / "new.mcap")
    with open_scene(tmp_path / "new.mcap") as read:
        found = read.lidars[0].frames[0].points
        np.testing.assert_array_equal(found.timestamps_ns, points(0).timestamps_ns)
        assert "offset_ns" not in found.extras
