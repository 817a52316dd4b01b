"""Writing: what stands in the file, read back by an independent decoder."""

import io
import json
from pathlib import Path

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.sfs import writer as module
from sceneloom.formats.sfs.clock import INT64_MIN, FileClock, TimeRangeError, chosen_offset_ns
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import ALIGNMENT, SceneWriter, Spool, write_scene
from sceneloom.geometry.rigid import RigidTransform

TWO = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
SECOND = 1_000_000_000


def lidar(**fields):
    return sc.LidarSensor(
        **{"id": "top", "frames": sc.LazyFrames.of([], []), "points_frame": sc.PointsFrame.WORLD, **fields}
    )


def sweep(timestamp_ns, times_ns=None, **arrays):
    times = None if times_ns is None else np.array(times_ns, np.int64)
    return sc.LidarFrame(timestamp_ns, sc.LidarPoints(TWO, timestamps_ns=times, **arrays))


def path_at(*timestamps_ns):
    count = len(timestamps_ns)
    return sc.Poses(np.array(timestamps_ns, np.int64), np.zeros((count, 3)), np.tile([0.0, 0, 0, 1], (count, 1)))


@pytest.fixture
def written(target, decode_sfs):
    """Write sweeps of one lidar and decode the file."""

    def write(*frames, sensor=None, poses=None, **options):
        with SceneWriter(target, **options) as writer:
            writer.add_sensor(sensor or lidar())
            for frame in frames:
                writer.add_frame("top", frame)
            writer.set_poses("top", poses or path_at(*(frame.timestamp_ns for frame in frames)))
        return decode_sfs(target.read_bytes())

    return write


def test_the_words_of_the_file_are_those_of_the_format(written):
    arrays = {
        "intensities": np.array([7, 8], np.uint8),
        "colors": TWO.astype(np.uint8),
        "rings": np.array([1, 2], np.uint16),
        "camera_index": np.array([0, 255], np.uint8),
    }
    header = written(sweep(0, [0, 5000], **arrays))
    assert (header["version"], header["time_unit"], header["time_offset"]) == ("1.0", "microseconds", 0)
    sensor = header["sensors"][0]
    assert (sensor["id"], sensor["type"], sensor["coordinates"]) == ("top", "lidar", "world")
    assert sensor["poses"] == {"timestamps": [0], "values": [[0, 0, 0, 0, 0, 0, 1]]}
    points = sensor["frames"][0]["points"]
    types = {"positions": "float32", "timestamps": "uint32", "colors": "uint8", "intensities": "uint8"}
    types |= {"ring": "uint16", "camera_index": "uint8"}
    assert {name: array.dtype.name for name, array in points.items()} == types
    assert points["timestamps"].tolist() == [0, 5]
    np.testing.assert_array_equal(points["positions"], TWO)
    assert [type(value) for value in (sensor["frames"][0]["timestamp"], sensor["poses"]["timestamps"][0])] == [int, int]


def test_every_array_starts_on_a_cache_line_and_is_followed_by_nuls_in_equal_files(written, target):
    def content():
        intensities = np.array([1, 2], np.uint8)
        sweeps = (sweep(k * SECOND, [k * SECOND] * 2, intensities=intensities) for k in range(5))
        written(*sweeps, metadata={"b": 1, "a": TWO}, overwrite=True)
        return target.read_bytes()

    first = content()
    stop = first.index(b"\0")
    assert stop % 64 == 0
    items = json.loads(first[:stop])["$items"]
    assert len(items) == 16
    for item in items:
        assert (stop + item["offset"]) % 64 == 0
        end = stop + item["offset"] + item["length"]
        assert first[end : end + 4] == bytes(4)
    assert content() == first


def test_times_are_rounded_half_to_even_which_is_reported_and_frames_start_with_their_earliest_point(
    written, target, decode_sfs
):
    times = [1_000_000_500, 1_000_001_500, 1_000_002_501, 1_000_003_499]
    points = sc.LidarPoints(np.zeros((4, 3), np.float32), timestamps_ns=np.array(times, np.int64))
    frame = written(sc.LidarFrame(1_000_000_400, points))["sensors"][0]["frames"][0]
    assert frame["points"]["timestamps"].tolist() == [1_000_000, 1_000_002, 1_000_003, 1_000_003]
    assert frame["timestamp"] == 1_000_000
    for start, times, expected in ((900, [1999, 3000], 1), (5000, [1999, 3000], 1), (2999, None, 2)):
        header = written(sweep(start, times), poses=path_at(0), overwrite=True)
        assert header["sensors"][0]["frames"][0]["timestamp"] == expected
    header = written(sweep(-1500, [-1500, 0]), poses=path_at(0), overwrite=True)
    assert header["metadata"]["sceneloom"]["time_shift_ns"] == SECOND
    assert header["sensors"][0]["frames"][0]["timestamp"] == 999_998
    with SceneWriter(target, overwrite=True) as writer:
        writer.add_sensor(lidar())
        writer.add_frame("top", sweep(10, [1, 1000]))
        writer.set_poses("top", path_at(7, 1000))
    report = {(loss.field, loss.count): loss for loss in writer.losses}
    assert "halves to even" in report["sensors[top].frames[].points.timestamps", 1].what
    assert "rounded down" in report["sensors[top].frames[].timestamp", 1].what
    assert report["sensors[], annotations[], attributes[]", 1].what.startswith("times rounded")


def test_the_offset_makes_the_first_timestamp_small_and_one_of_the_caller_stands_or_is_refused(written, target):
    late = 1_700_000_000 * SECOND + 999
    for first, offset in ((0, 0), (9 * SECOND, 0), (12 * SECOND + 345, 12), (late, 1_700_000_000)):
        header = written(sweep(first, [first, first + 1000]), overwrite=True)
        assert header["time_offset"] == offset * 1_000_000
        assert 0 <= header["sensors"][0]["frames"][0]["timestamp"] < 10_000_000
    header = written(sweep(3 * SECOND, [3 * SECOND] * 2), time_offset_ns=2 * SECOND, overwrite=True)
    assert header["time_offset"] == 2_000_000
    for frame, offset_ns, problem in (
        (sweep(SECOND, [SECOND] * 2), 2 * SECOND, "expected at most 1000000000"),
        (sweep(SECOND), 1, "whole microseconds"),
        (sweep(2**62, [2**62, 2**62]), -8 * 10**18, "does not fit 64 bits"),
    ):
        with pytest.raises(OptionError, match=problem):
            written(frame, time_offset_ns=offset_ns, overwrite=True)
    assert list(target.parent.iterdir()) == [target]


def test_something_earlier_moves_the_offset_and_the_times_written_before_and_arrays_stay_with_their_fields(target):
    late, early = 1_700_000_005 * SECOND, 1_699_999_990 * SECOND
    for sensor_times, event in (([early, late], late), ([late], early)):
        with SceneWriter(target, overwrite=True) as writer:
            writer.add_sensor(lidar(poses=path_at(*sensor_times)))
            writer.add_frame("top", sweep(late, [late, late + 7000]))
            labels = (sc.LabeledPoints("top", np.array([0, 1], np.uint32)),)
            writer.add_annotation(sc.LabeledPointsAnnotation(1, labels, label="x"))
            writer.add_annotation(sc.EventAnnotation(2, event))
        scene = FORMAT.open(target)
        assert (scene.time_offset_ns, scene.annotations[1].start_ns) == (early, event)
        assert scene.sensors[0].frames[0].points.timestamps_ns.tolist() == [late, late + 7000]
        assert scene.sensors[0].poses.timestamps_ns.tolist() == sensor_times
        assert scene.annotations[0].labeled_points[0].point_ids.tolist() == [0, 1]
    # in the profile `scale` the lidar then starts too late and goes aside, so that the order of writing changes
    late, early = 1_700_000_200 * SECOND, 1_700_000_000 * SECOND
    chart, grid = np.arange(4.0), np.arange(5)
    metadata = {"grid": grid, "again": grid}
    with SceneWriter(target, profile="scale", metadata=metadata, overwrite=True) as writer:
        writer.add_sensor(lidar(poses=path_at(late), extras={"chart": chart}))
        writer.add_frame("top", sweep(late, [late, late]))
        writer.add_annotation(sc.EventAnnotation(2, early, extras={"drawn": TWO}))
    scene = FORMAT.open(target)
    assert scene.time_offset_ns == early
    np.testing.assert_array_equal(scene.sensors[0].extras["chart"], chart)
    np.testing.assert_array_equal(scene.annotations[0].extras["drawn"], TWO)
    np.testing.assert_array_equal(scene.metadata["grid"], grid)
    np.testing.assert_array_equal(scene.metadata["again"], grid)
    assert "within 100 s" in next(iter(writer.losses)).what


def test_times_before_zero_come_back_and_microseconds_in_32_bits_end_after_71_minutes(written, target):
    header = written(sweep(-5 * SECOND, [-5 * SECOND, -4_999_999_000]))
    assert header["time_offset"] == 0
    assert header["sensors"][0]["frames"][0]["points"]["timestamps"].tolist() == [0, 1]
    assert FORMAT.open(target).sensors[0].frames[0].points.timestamps_ns.tolist() == [-5 * SECOND, -4_999_999_000]
    last = 2**32 * 1000 - 1000
    header = written(sweep(0), sweep(last, [last, last]), overwrite=True)
    assert header["sensors"][0]["frames"][1]["points"]["timestamps"].tolist() == [2**32 - 1] * 2
    with pytest.raises(OptionError, match=r"4294.967 s after .* `--time-unit nanoseconds`"):
        written(sweep(0, [0, 0]), sweep(last, [last, last + 1000]), overwrite=True)


def test_positions_in_the_world_stay_within_ten_kilometres_unless_they_are_not_finite(written):
    far = np.array([[10_001, 0, 0], [0, 0, 0]], np.float32)
    frame = sc.LidarFrame(0, sc.LidarPoints(far))
    with pytest.raises(DataError, match=r"sensors\[top\].frames\[0\].points.positions\[0\]: 10001 m"):
        written(frame)
    written(frame, sensor=lidar(points_frame=sc.PointsFrame.SENSOR))
    though_another_is_infinitely_far = np.array([[np.inf, 0, 0], [0, -20_000, 0]], np.float32)
    with pytest.raises(DataError, match=r"frames\[0\].points.positions\[1\]: 20000 m from .* in parts"):
        written(sc.LidarFrame(0, sc.LidarPoints(though_another_is_infinitely_far)), overwrite=True)
    for nowhere in (np.inf, -np.inf, np.nan):
        positions = np.array([[1.0, nowhere, 2.0], [3, 4, 5]], np.float32)
        header = written(sc.LidarFrame(0, sc.LidarPoints(positions)), overwrite=True)
        np.testing.assert_array_equal(header["sensors"][0]["frames"][0]["points"]["positions"], positions)


def test_a_failure_leaves_nothing_behind_and_an_existing_file_is_kept_unless_stated(target):
    with pytest.raises(OptionError, match="no sensor 'front' in the file; it has 'top'"), SceneWriter(target) as writer:
        writer.add_sensor(lidar())
        writer.add_frame("front", sweep(0))
    assert list(target.parent.iterdir()) == []
    target.write_bytes(b"precious")
    with pytest.raises(OutputError, match="exists already"), SceneWriter(target):
        pass
    assert target.read_bytes() == b"precious"
    write_scene(sc.Scene(()), target, overwrite=True)
    assert FORMAT.open(target).sensors == ()


def test_what_cannot_be_written_is_refused_with_its_location_or_the_options_there_are(target):
    with SceneWriter(target) as writer:
        writer.add_sensor(lidar())
        writer.add_sensor(sc.OdometrySensor("car", path_at(0)))
        with pytest.raises(OptionError, match=r"sensors\[car\] is a odometry; it takes no LidarFrame"):
            writer.add_frame("car", sweep(0))
        with pytest.raises(OptionError, match="'top' is in the file already"):
            writer.add_sensor(lidar())
        assert [loss.field for loss in writer.finish()] == ["sensors[top].poses"]
        assert target.is_file()
        with pytest.raises(OptionError, match="not open"):
            writer.add_sensor(lidar())
    for metadata, problem in (
        ({"why": [{"what": object()}]}, r"why\[0\].what: a object"),
        ({"names": np.array(["a"])}, "names: an array of <U1"),
    ):
        with pytest.raises(OptionError, match=problem), SceneWriter(target, overwrite=True) as writer:
            writer.set_metadata(metadata)
    for options, problem in (
        ({"profile": "kitti"}, "profile 'kitti'; expected one of sfs, scale"),
        ({"time_unit": "seconds"}, "time_unit 'seconds'"),
        ({"profile": "scale", "time_unit": "nanoseconds"}, "expected microseconds in profile 'scale'"),
        ({"metadata": {"sceneloom": {"layout": 2}}}, "metadata.sceneloom.layout is filled by the writer"),
    ):
        with pytest.raises(OptionError, match=problem):
            SceneWriter(target, **options)


def test_numbers_that_json_cannot_state_become_null_and_are_counted_and_the_meaning_of_angles_is_written(
    target, decode_sfs
):
    with SceneWriter(target, metadata={"a": float("nan"), "b": [1.0, float("inf")], "c": np.float32(0.5)}) as writer:
        pass
    assert decode_sfs(target.read_bytes())["metadata"] == {"a": None, "b": [1.0, None], "c": 0.5}
    assert [(loss.count, loss.what[:7]) for loss in writer.losses] == [(2, "numbers")]
    cuboid = sc.CuboidAnnotation("a", sc.CuboidPath(np.zeros(1, np.int64), np.ones((1, 9))))
    for unit, metadata in (("degrees", {}), ("radians", {"sceneloom": {"euler_unit": "radians"}})):
        write_scene(sc.Scene((), (cuboid,), metadata=metadata), target, overwrite=True)
        ours = {"layout": 1, "euler_unit": unit, "euler_order": "xyz"}
        assert decode_sfs(target.read_bytes())["metadata"]["sceneloom"] == ours


def test_poses_within_one_tick_are_left_out_and_a_sensor_with_a_mounting_alone_is_placed_on_the_ego(
    written, target, decode_sfs
):
    header = written(sweep(0), poses=path_at(0, 400, 1000))
    assert header["sensors"][0]["poses"]["timestamps"] == [0, 1]
    first = 1_700_000_000 * SECOND
    header = written(sweep(first, [first, first]), poses=sc.Poses.identity(), overwrite=True)
    assert header["sensors"][0]["poses"]["timestamps"] == [0]
    assert FORMAT.open(target).sensors[0].poses.static
    mount = RigidTransform.from_quaternion(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3, 0.9]))
    with SceneWriter(target, overwrite=True) as writer:
        writer.add_sensor(lidar(mount=mount, points_frame=sc.PointsFrame.SENSOR))
        writer.add_frame("top", sweep(5 * SECOND))
    record = decode_sfs(target.read_bytes())["sensors"][0]
    assert (record["coordinates"], record["poses"]["timestamps"]) == ("ego", [5_000_000])
    np.testing.assert_allclose(record["poses"]["values"][0][:3], [1, 2, 3])
    read = FORMAT.open(target).sensors[0]
    assert (read.poses, read.coordinates, read.points_frame) == (None, sc.Coordinates.WORLD, sc.PointsFrame.SENSOR)
    np.testing.assert_array_equal(read.mount.matrix, mount.matrix)
    (what,) = (loss.what for loss in writer.losses if loss.field == "sensors[top].poses")
    assert "not known; the mounting is written" in what


@pytest.mark.parametrize("frame_count", [0, 1, 40])
def test_many_arrays_are_spooled_to_disk_and_come_back(target, decode_sfs, frame_count):
    rng = np.random.default_rng(1)
    clouds = [rng.normal(size=(40_000, 3)).astype(np.float32) for _ in range(25)]
    notes = {f"note {k}": "x" * 1000 for k in range(2000 if frame_count else 0)}
    with SceneWriter(target, frame_count=frame_count, metadata=notes) as writer:
        writer.add_sensor(lidar(poses=path_at(0)))
        for k, cloud in enumerate(clouds):
            points = sc.LidarPoints(cloud, timestamps_ns=np.full(len(cloud), k * SECOND, np.int64))
            writer.add_frame("top", sc.LidarFrame(k * SECOND, points))
        writer.set_poses("top", path_at(-SECOND, 0))
    header = decode_sfs(target.read_bytes())
    assert header["metadata"]["sceneloom"]["time_shift_ns"] == SECOND
    for k, (cloud, frame) in enumerate(zip(clouds, header["sensors"][0]["frames"], strict=True)):
        np.testing.assert_array_equal(frame["points"]["positions"], cloud)
        assert set(frame["points"]["timestamps"].tolist()) == {(k + 1) * 1_000_000}
    assert list(target.parent.iterdir()) == [target]


def test_sweeps_that_could_not_be_fused_stand_under_our_metadata(target, decode_sfs):
    with SceneWriter(target) as writer:
        writer.add_sensor(lidar(poses=path_at(0)))
        writer.add_frame("top", sweep(0))
        writer.add_unfused("top", sweep(1_700_000_000 * SECOND + 1, [1, 2]), "no pose")
    scene = FORMAT.open(target)
    assert len(scene.sensors[0].frames) == 1
    kept = scene.metadata["sceneloom"]["unfused"][0]
    assert (kept["sensor_id"], kept["timestamp_ns"], kept["reason"]) == ("top", 1_700_000_000 * SECOND + 1, "no pose")
    assert kept["points"]["timestamps_ns"].tolist() == [1, 2]
    np.testing.assert_array_equal(kept["points"]["positions"], TWO)
    assert "no pose" in next(iter(writer.losses)).what
    with SceneWriter(target, overwrite=True) as writer:
        writer.add_scene(scene)
        writer.add_unfused("top", sweep(5), "still no pose")
        for timestamp in (0, 1):
            writer.add_unfused("top", sweep(timestamp), f"beyond the trajectory: points at {timestamp} ns")
    losses = [(loss.what, loss.count) for loss in writer.losses if "left out of the frames" in loss.what]
    assert ("left out of the frames: beyond the trajectory", 2) in losses
    assert len(scene.metadata["sceneloom"]["unfused"]) == 1
    reasons = [kept["reason"] for kept in FORMAT.open(target).metadata["sceneloom"]["unfused"]]
    assert reasons[:2] == ["no pose", "still no pose"]


def test_trajectories_stand_under_our_metadata_in_their_order(target):
    trajectories = {
        "truth": sc.Trajectory("truth", np.array([1, 2**60]), np.ones((2, 3)), None, np.array([0.1, 0.2])),
        "car": sc.Trajectory("car", np.array([0]), np.zeros((1, 3)), np.array([[0.0, 0, 0, 1]])),
    }
    scene = sc.Scene((sc.OdometrySensor("car", path_at(0)),), trajectories=trajectories)
    report = write_scene(scene, target)
    read = FORMAT.open(target).trajectories
    assert list(read) == ["truth", "car"]
    assert read["truth"].timestamps_ns.tolist() == [1, 2**60]
    assert read["truth"].quaternions_xyzw is None
    assert read["truth"].file_seconds.tolist() == [0.1, 0.2]
    (loss,) = report
    assert (loss.field, loss.count, loss.kept) == ("trajectories[]", 1, "metadata.sceneloom.trajectories")


@pytest.mark.parametrize("offset_ns", [0, 1_700_000_000_000_000_000, -5_000])
@pytest.mark.parametrize("start_ns", [0, 1_001, 3_000_000_500])
@pytest.mark.parametrize("span_ns", [100_000_000, 4_200_000_000, 60_000_000_000])
@pytest.mark.parametrize("dtype", [np.uint32, np.int64])
def test_timestamps_of_many_are_those_of_each(offset_ns, start_ns, span_ns, dtype):
    clock, rng = FileClock(1_000, offset_ns), np.random.default_rng(3)
    # many lie on or beside a whole or half microsecond
    whole = rng.integers(0, span_ns // 500, 2_000) * 500
    times_ns = offset_ns + start_ns + whole + rng.integers(-1, 2, 2_000).clip(-whole)
    timestamps, inexact = clock.timestamp_array(times_ns, dtype=dtype)
    assert timestamps.dtype == dtype
    assert timestamps.tolist() == [clock.timestamp(time) for time in times_ns.tolist()]
    assert inexact == sum((time - offset_ns) % 1_000 != 0 for time in times_ns.tolist())
    # exact times are counted as exact, and nanoseconds pass as they are
    exact_ns = offset_ns + 1_000 * np.arange(20_000)
    timestamps, inexact = clock.timestamp_array(exact_ns, dtype=dtype, span_ns=(int(exact_ns[0]), int(exact_ns[-1])))
    assert (timestamps.tolist(), inexact) == (list(range(20_000)), 0)
    timestamps, inexact = FileClock(1, 5).timestamp_array(np.array([5, 2**62], np.int64), dtype=np.uint64)
    assert (timestamps.tolist(), inexact) == ([0, 2**62 - 5], 0)


@pytest.mark.parametrize("tick_ns", [1, 1_000])
@pytest.mark.parametrize("dtype", [np.uint32, np.int64])
def test_the_earliest_times_of_64_bits_have_timestamps_and_a_span_beyond_is_refused(tick_ns, dtype):
    # their offset, in whole seconds, lies before every time that 64 bits hold
    times_ns = INT64_MIN + np.array([400, 1_307, 1_308, 2_000, 10_000_000], np.int64)
    clock = FileClock(tick_ns, chosen_offset_ns(INT64_MIN))
    timestamps, inexact = clock.timestamp_array(times_ns, dtype=dtype)
    assert (timestamps.dtype, inexact) == (dtype, 0 if tick_ns == 1 else 5)
    assert timestamps.tolist() == [clock.timestamp(time) for time in times_ns.tolist()]
    np.testing.assert_allclose(clock.absolute_array(timestamps) - INT64_MIN, times_ns - INT64_MIN, atol=tick_ns // 2)
    clock = FileClock(tick_ns, -(2**62))
    with pytest.raises(TimeRangeError):
        clock.timestamp_array(np.array([2**62 + 2**61], np.int64))
    with pytest.raises(TimeRangeError):
        clock.timestamps_of_span(0, 2**62 + 2**61)


SMALL = np.arange(7, dtype=np.uint8)
LARGE = np.arange(100_000, dtype=np.float32).reshape(-1, 2)


def spooled(path, arrays, header):
    """Write arrays, or the bytes of files, and a header, and give the file's bytes and the arrays' locations."""
    with Spool(path, reserve=lambda: 640) as spool:
        blobs = [spool.add_file(each) if isinstance(each, Path) else spool.add(each) for each in arrays]
        spool.finish(header)
    return path.read_bytes(), blobs


def check(content, header, arrays, blobs):
    """The header, blanks, NULs, and every array at its location, aligned, followed by NULs."""
    stop = content.index(b"\0")
    assert content[:stop].rstrip(b" ") == header
    assert content[stop : stop + 4] == bytes(4)
    assert stop % ALIGNMENT == 0
    end = stop
    for array, blob in zip(arrays, blobs, strict=True):
        start = stop + blob.offset
        assert start % ALIGNMENT == 0
        assert start >= end + 4
        assert not any(content[end:start])
        assert content[start : start + blob.length] == array.tobytes()
        end = start + blob.length
    assert len(content) - end in range(4, ALIGNMENT + 4)
    assert not any(content[end:])


@pytest.fixture(params=["in memory", "on disk"])
def kept(request, monkeypatch):
    """Arrays stay in memory, or go to disk after the first kilobyte."""
    if request.param == "on disk":
        monkeypatch.setattr(module, "_IN_MEMORY", 1000)
        monkeypatch.setattr(module, "_GATHERED", 500)


@pytest.mark.parametrize("length", [0, 1, 639, 640, 641, 5000, 300_000])
def test_headers_of_any_length_stand_before_the_arrays_and_files(tmp_path, kept, length):
    header, files = b"x" * length, []
    for size in (0, 100, 200_000):
        content = np.random.default_rng(3).integers(0, 256, size, np.uint8)
        (tmp_path / f"video {size}").write_bytes(content.tobytes())
        files.append((content, tmp_path / f"video {size}"))
    arrays = [SMALL, LARGE, SMALL[:0], *[SMALL] * 100, LARGE.T, np.float64(2.5)]
    content, blobs = spooled(tmp_path / "file", [*arrays, *(path for _, path in files), SMALL], header)
    check(content, header, [*arrays, *(content for content, _ in files), SMALL], blobs)
    assert (blobs[3].shape, blobs[len(arrays) - 1].shape) == ((7,), ())


def test_arrays_are_written_as_they_were_added_in_little_endian_order_and_can_be_changed_meanwhile(tmp_path, kept):
    array, big_endian = SMALL.copy(), np.array([1, 258], ">u4")
    with Spool(tmp_path / "file", reserve=lambda: 640) as spool:
        blobs = [spool.add(LARGE), spool.add(array), spool.add(big_endian), spool.add(SMALL)]
        array[:] = 0
        spool.change(blobs[3], lambda array: array + 2)
        blobs.append(spool.add(LARGE))
        spool.change(blobs[0], lambda array: array + 1)
        spool.finish(b"{}")
    assert blobs[2].dtype == "uint32"
    arrays = [LARGE + 1, SMALL, big_endian.astype("<u4"), SMALL + 2, LARGE]
    check((tmp_path / "file").read_bytes(), b"{}", arrays, blobs)


def test_a_file_system_that_takes_only_a_part_or_cannot_make_room_gives_the_same_bytes(tmp_path, monkeypatch):
    class Reluctant(io.FileIO):
        """Takes at most a thousand bytes at once, as a full pipe or a signal makes a file do."""

        def write(self, content):
            return super().write(bytes(memoryview(content)[:1000]))

    monkeypatch.setattr(module, "_IN_MEMORY", 1000)
    header, path = b"x" * 10_000, tmp_path / "file"
    quick, _ = spooled(tmp_path / "quick", [SMALL, LARGE], header)
    with Spool(path, reserve=lambda: 640) as spool:
        spool._file_for(0).close()
        spool._file = Reluctant(path, "r+b")
        spool._file.seek(640 + ALIGNMENT)
        blobs = [spool.add(LARGE), spool.add(SMALL)]
        spool.finish(b"{}")
    check(path.read_bytes(), b"{}", [LARGE, SMALL], blobs)
    monkeypatch.setattr(module, "_fallocate", lambda *arguments: False)
    monkeypatch.delattr(module.os, "copy_file_range", raising=False)
    slow, blobs = spooled(tmp_path / "slow", [SMALL, LARGE], header)
    assert slow == quick
    check(slow, header, [SMALL, LARGE], blobs)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "quick", "slow"]
