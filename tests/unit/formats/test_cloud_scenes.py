"""Files of points as scenes, scenes as files of points, and points in them that no camera saw."""

import pickle
import shutil
from dataclasses import replace

import laspy
import numpy as np
import pytest

import sceneloom
from sceneloom.errors import DataError, OptionError, OutputError, UnknownFormatError, UnknownOptionError
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.registry import find_format, open_scene, write_scene
from sceneloom.formats.points.files import read_cloud
from sceneloom.formats.points.reader import numbers_of_names, stem_of, times_of_names
from sceneloom.pipeline.converting import convert
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, PointsFrame, Poses, Scene, Trajectory

RNG = np.random.default_rng(11)
COUNT = 400
TIMESTAMPS = (1_700_000_000_000_000_001, 1_700_000_000_100_000_003)
ENDINGS = {"kitti-bin": ".bin", "nuscenes-bin": ".pcd.bin"}
HOLD_ALL = ("pcd", "ply", "las", "laz", "npz")
ROUNDED = {"las": 1.3e-5, "laz": 1.3e-5}
"""LAS rounds to steps of 0.01 mm, and float32 of 80 m to 8 µm."""


def points(timestamp_ns, *, extras=None):
    return LidarPoints(
        positions=RNG.uniform(-80, 80, (COUNT, 3)).astype(np.float32),
        intensities=RNG.integers(0, 256, COUNT).astype(np.uint8),
        colors=RNG.integers(0, 256, (COUNT, 3)).astype(np.uint8),
        timestamps_ns=timestamp_ns + RNG.integers(0, 100_000_000, COUNT),
        rings=RNG.integers(0, 128, COUNT).astype(np.uint16),
        camera_index=RNG.integers(0, 3, COUNT).astype(np.uint8),
        extras=extras or {},
    )


def scene_of(frames, **fields):
    return Scene((LidarSensor("lidar", LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]), **fields),))


@pytest.fixture
def scene():
    extras = {"range": RNG.uniform(0, 80, COUNT), "echo": RNG.integers(0, 3, COUNT).astype(np.int8)}
    return scene_of([LidarFrame(timestamp, points(timestamp, extras=extras)) for timestamp in TIMESTAMPS])


def same(frames, expected, *, tolerance=0.0):
    for frame, other in zip(frames, expected, strict=True):
        found, known = frame.points, other.points
        np.testing.assert_allclose(found.positions, known.positions, rtol=0, atol=tolerance)
        for name in ("intensities", "colors", "timestamps_ns", "rings", "camera_index"):
            np.testing.assert_array_equal(getattr(found, name), getattr(known, name), err_msg=name)
        for name, values in known.extras.items():
            assert found.extras[name].dtype == values.dtype
            np.testing.assert_array_equal(found.extras[name], values)


@pytest.mark.parametrize("kind", HOLD_ALL)
def test_a_folder_of_clouds_gives_back_all_that_its_points_bear_also_in_other_processes(tmp_path, scene, kind):
    losses = write_scene(scene, tmp_path / "clouds", format=kind)
    with open_scene(tmp_path / "clouds") as found:
        assert found.format == kind
        assert found.lidars[0].frames.timestamps_ns.tolist() == list(TIMESTAMPS)
        for frames in (found.lidars[0].frames, pickle.loads(pickle.dumps(found.lidars[0].frames))):
            same(frames, scene.lidars[0].frames, tolerance=ROUNDED.get(kind, 0.0))
    if kind in ROUNDED:
        (loss,) = losses
        assert loss.support is Support.APPROXIMATED
        assert 0 < loss.largest_error <= 0.5e-5 + 1e-12
    else:
        assert not losses


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_files_of_every_encoding_hold_the_same_and_become_another_kind_without_loss(tmp_path, scene, encoding):
    write_scene(scene, tmp_path / "clouds", format="pcd", encoding=encoding)
    report = convert(tmp_path / "clouds", tmp_path / "second", to="ply", strict=True)
    assert not [support for support in report.fields if support.support in {Support.APPROXIMATED, Support.DROPPED}]
    for folder in ("clouds", "second"):
        same(open_scene(tmp_path / folder).lidars[0].frames, scene.lidars[0].frames)


@pytest.mark.parametrize(
    ("kind", "columns", "full"),
    # KITTI counts brightness from 0 to 1, nuScenes from 0 to 255
    [("kitti-bin", 4, 1.0), ("nuscenes-bin", 5, 255.0)],
)
def test_packed_files_hold_the_locations_and_the_brightness_and_what_they_leave_out_is_reported(
    tmp_path, scene, kind, columns, full
):
    losses = write_scene(scene, tmp_path / "clouds", format=kind)
    rows = np.fromfile(tmp_path / "clouds" / f"{TIMESTAMPS[0]}{ENDINGS[kind]}", "<f4").reshape(-1, columns)
    expected = scene.lidars[0].frames[0].points
    np.testing.assert_array_equal(rows[:, :3], expected.positions)
    np.testing.assert_allclose(rows[:, 3], expected.intensities * (full / 255.0), rtol=1e-6)
    left = {"timestamps_ns", "colors", "camera_index", "extras.range", "extras.echo"}
    if kind == "nuscenes-bin":
        np.testing.assert_array_equal(rows[:, 4], expected.rings)
    else:
        left.add("rings")
    assert {loss.field.removeprefix("sensors[lidar].frames.points.") for loss in losses} == left
    assert {(loss.support, loss.count) for loss in losses} == {(Support.DROPPED, 2)}
    found = open_scene(tmp_path / "clouds").lidars[0].frames[0].points
    np.testing.assert_array_equal(found.positions, expected.positions)
    np.testing.assert_array_equal(found.intensities, expected.intensities)


@pytest.mark.parametrize("kind", [*HOLD_ALL, *ENDINGS])
def test_a_scene_of_one_frame_is_written_to_a_file(tmp_path, kind):
    one = scene_of([LidarFrame(0, replace(points(0), timestamps_ns=None))])
    target = tmp_path / f"one{ENDINGS.get(kind, f'.{kind}')}"
    write_scene(one, target, format=kind)
    assert find_format(target).name == kind
    found = open_scene(target).lidars[0].frames[0]
    assert found.timestamp_ns == 0
    np.testing.assert_allclose(found.points.positions, one.lidars[0].frames[0].points.positions, atol=1.3e-5)


def test_points_are_written_in_the_frame_that_is_asked_for_or_with_the_trajectory_of_the_ego_that_they_are_on(tmp_path):
    # a quarter rotation to the left at (10, 0, 0): what lies ahead of the sensor lies to the left in the world
    half = np.sqrt(0.5)
    timestamps = np.array(TIMESTAMPS)
    poses = Poses(timestamps, np.array([[10.0, 0.0, 0.0], [20.0, 0.0, 0.0]]), np.array([[0.0, 0.0, half, half]] * 2))
    ahead = LidarPoints(np.array([[5.0, 0.0, 0.0]], np.float32))
    frames = [LidarFrame(timestamp, ahead) for timestamp in TIMESTAMPS]
    one = scene_of(frames, poses=poses)
    write_scene(one, tmp_path / "world", format="ply", frame="world")
    found = open_scene(tmp_path / "world", points_frame="world").lidars[0]
    assert found.points_frame is PointsFrame.WORLD
    locations = [frame.points.positions[0] for frame in found.frames]
    np.testing.assert_allclose(locations, [[10, 5, 0], [20, 5, 0]], atol=1e-5)
    write_scene(one, tmp_path / "sensor", format="ply", frame="sensor")
    back = open_scene(tmp_path / "sensor").lidars[0]
    assert back.points_frame is PointsFrame.SENSOR
    np.testing.assert_array_equal(back.poses.timestamps_ns, timestamps)
    np.testing.assert_array_equal(back.poses.positions, poses.positions)
    # asked for at times of its own, a path gives its rotations normalised: the last digit may differ
    np.testing.assert_allclose(back.poses.quaternions_xyzw, poses.quaternions_xyzw, rtol=0, atol=1e-15)
    vio = Trajectory("vio", timestamps, np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([[0.0, 0, 0, 1]] * 2))
    on_ego = replace(scene_of(frames, points_frame=PointsFrame.EGO, poses=vio.poses), trajectories={"vio": vio})
    write_scene(on_ego, tmp_path / "ego", format="pcd")
    with open_scene(tmp_path / "ego") as found:
        assert found.lidars[0].points_frame is PointsFrame.EGO
        (trajectory,) = found.trajectories.values()
        np.testing.assert_array_equal(trajectory.positions, vio.positions)


def test_several_lidars_are_folders_of_their_own_and_frames_of_one_time_keep_their_order_which_is_reported(tmp_path):
    lidars = [LidarSensor(name, LazyFrames.of([LidarFrame(7, points(7))], [7])) for name in ("top left", "rear/1")]
    assert not write_scene(Scene(tuple(lidars)), tmp_path / "o", format="npz")
    found = {lidar.id: lidar.frames for lidar in open_scene(tmp_path / "o").lidars}
    assert set(found) == {"top left", "rear/1"}
    for lidar in lidars:
        same(found[lidar.id], lidar.frames)
    frames = [LidarFrame(5, points(5)) for _ in range(3)]
    (loss,) = write_scene(scene_of(frames), tmp_path / "p", format="pcd")
    assert (loss.support, loss.count, loss.largest_error) == (Support.APPROXIMATED, 2, 2.0)
    for one, other in zip(open_scene(tmp_path / "p").lidars[0].frames, frames, strict=True):
        np.testing.assert_array_equal(one.points.positions, other.points.positions)


def test_brightness_beyond_bytes_is_kept_beside_them_and_goes_on_to_other_kinds(tmp_path):
    rows = RNG.uniform(0, 1, (COUNT, 4)).astype(np.float32)
    (tmp_path / "in").mkdir()
    rows.tofile(tmp_path / "in" / "000000.bin")
    read = open_scene(tmp_path / "in")
    frame = read.lidars[0].frames[0]
    np.testing.assert_array_equal(frame.points.extras["intensity"], rows[:, 3])
    np.testing.assert_array_equal(frame.points.intensities, np.rint(rows[:, 3].astype(np.float64) * 255))
    write_scene(read, tmp_path / "out.ply")
    found = open_scene(tmp_path / "out.ply").lidars[0].frames[0].points
    np.testing.assert_array_equal(found.extras["intensity"], rows[:, 3])


def test_large_coordinates_are_put_on_an_origin_near_them(tmp_path):
    corner = np.array([500_000.0, 5_400_000.0, 200.0])
    header = laspy.LasHeader(version="1.2", point_format=0)
    header.offsets, header.scales = corner, np.full(3, 0.001)
    file = laspy.LasData(header)
    file.xyz = corner + np.rint(RNG.uniform(0, 100, (COUNT, 3)) * 1000) / 1000
    file.write(str(tmp_path / "tile.las"))
    with open_scene(tmp_path / "tile.las") as scene:
        lidar = scene.lidars[0]
        assert "cloud-origin" in {warning.code for warning in scene.warnings}
        world = lidar.frames[0].points.positions.astype(np.float64) + lidar.poses.positions[0]
        # float32 of 50 m is exact to 4 µm
        np.testing.assert_allclose(world, np.asarray(file.xyz), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        ("1700000000000000001 1700000000100000003", list(TIMESTAMPS)),
        ("-0000000000000000005 0000000000000000007", [-5, 7]),
        ("-0000000000000000003", [-3]),
        ("1700000000.5 1700000000.6", [1_700_000_000_500_000_000, 1_700_000_000_600_000_000]),
        ("1700000000_000000001 1700000000_100000003", list(TIMESTAMPS)),
        ("a__LIDAR_TOP__1532402927647951", [1_532_402_927_647_951_000]),
        ("pc-1532402927647", [1_532_402_927_647_000_000]),
        ("0.1 0.25", [100_000_000, 250_000_000]),
        *((names, None) for names in ("000000 000001", "0000000005", "cloud", "1700000000 cloud")),
    ],
)
def test_names_that_are_times_are_distinguished_from_numbers(names, times):
    assert times_of_names(names.split()) == times


def test_numbers_and_endings_of_names():
    assert numbers_of_names(["frame_000007", "frame_000009"]) == [7, 9]
    assert numbers_of_names(["a_1", "b_1"]) is None
    assert stem_of("x__1.pcd.bin") == "x__1"


@pytest.fixture
def numbered(tmp_path):
    """Makes a folder with files of such names."""

    def make(*names):
        (tmp_path / "data").mkdir()
        for name in names:
            RNG.uniform(0, 1, (4, 4)).astype("<f4").tofile(tmp_path / "data" / f"{name}.bin")
        return tmp_path / "data"

    return make


def test_numbered_files_are_taken_at_ten_hertz_and_that_is_reported(numbered):
    folder = numbered("000000", "000001", "000003")
    for options, times_ns, assumed in (
        ({}, [0, 100_000_000, 300_000_000], {"cloud-times-assumed", "cloud-frame-assumed"}),
        ({"rate_hz": 20.0}, [0, 50_000_000, 150_000_000], {"cloud-frame-assumed"}),
    ):
        scene = open_scene(folder, **options)
        assert scene.lidars[0].frames.timestamps_ns.tolist() == times_ns
        codes = {warning.code for warning in scene.warnings}
        assert codes & {"cloud-times-assumed", "cloud-frame-assumed"} == assumed


def test_a_list_of_times_beside_the_files_counts_and_times_are_all_different(numbered):
    folder = numbered("000000", "000001")
    times = folder.parent / "timestamps.txt"
    times.write_text("2011-09-26 13:02:25.5\n2011-09-26 13:02:25.600000001\n")
    assert np.diff(open_scene(folder).lidars[0].frames.timestamps_ns).tolist() == [100_000_001]
    times.write_text("2011-09-26 13:02:25.5\n")
    with pytest.raises(DataError, match="1 times for 2 files"):
        open_scene(folder)
    assert len(open_scene(folder, lenient=True).lidars[0].frames) == 1
    times.unlink()
    for file, name in zip(sorted(folder.iterdir()), ("a_1.5.bin", "b_1.5.bin"), strict=True):
        file.rename(folder / name)
    with pytest.raises(DataError, match="have the same time"):
        open_scene(folder)


def test_folders_with_other_files_or_two_kinds_and_other_bin_files_are_reported_to_be_no_clouds(
    tmp_path, scene, numbered
):
    folder = numbered("000000", "000001")
    (folder / "image.png").write_bytes(b"x")
    with pytest.raises(UnknownFormatError, match=r"2 .*\.bin.* but 'image.png', too"):
        open_scene(folder)
    assert len(open_scene(folder, format="kitti-bin").lidars[0].frames) == 2
    write_scene(scene, tmp_path / "o", format="pcd")
    write_scene(scene, tmp_path / "p", format="ply")
    shutil.copy(next((tmp_path / "p").iterdir()), tmp_path / "o")
    with pytest.raises(UnknownFormatError, match=r"more than one reader claims this: pcd, .*; ply, "):
        open_scene(tmp_path / "o")
    for content in (b"", bytes(17), np.arange(64, dtype="<i4").tobytes()):
        (tmp_path / "a.bin").write_bytes(content)
        with pytest.raises(UnknownFormatError, match="does not begin so" if content else "it is empty"):
            open_scene(tmp_path / "a.bin")


def test_a_file_that_is_torn_is_named_and_left_out_leniently_and_the_folder_recognised(tmp_path, scene):
    write_scene(scene, tmp_path / "o", format="laz")
    torn = tmp_path / "o" / f"{TIMESTAMPS[1]}.laz"
    torn.write_bytes(torn.read_bytes()[:-200])
    strict = open_scene(tmp_path / "o")
    with pytest.raises(DataError, match=f"{TIMESTAMPS[1]}.laz: points: the table of chunks is at byte"):
        strict.lidars[0].frames[1]
    lenient = open_scene(tmp_path / "o", lenient=True)
    assert lenient.lidars[0].frames.timestamps_ns.tolist() == [TIMESTAMPS[0]]
    assert [n.count for n in lenient.warnings if n.code == "unreadable-files"] == [1]
    write_scene(scene, tmp_path / "p", format="ply")
    (tmp_path / "p" / f"{TIMESTAMPS[0] - 5}.ply").touch()
    assert find_format(tmp_path / "p").name == "ply"
    with pytest.raises(DataError, match=r"does not begin with `ply`"):
        open_scene(tmp_path / "p")
    assert len(open_scene(tmp_path / "p", lenient=True).lidars[0].frames) == 2


def test_options_that_do_not_count_and_targets_that_cannot_be_are_refused(tmp_path, scene):
    rows = RNG.uniform(-9, 9, (7, 4)).astype(np.float32)
    np.save(tmp_path / "rows.npy", rows)
    one = open_scene(tmp_path / "rows.npy")
    np.testing.assert_array_equal(one.lidars[0].frames[0].points.positions, rows[:, :3])
    for source, name, error, problem, options in (
        (scene, "o", UnknownOptionError, ".", {"format": "pcd", "profile": "scale"}),
        (scene, "o", OptionError, ".", {"format": "pcd", "frame": "moon"}),
        (scene, "o", OptionError, ".", {"format": "pcd", "encoding": "zip"}),
        (scene, "o", OptionError, ".", {"format": "pcd", "lidar": "none"}),
        (scene, "one.pcd", OptionError, "one file for 2 frames", {}),
        (one, "out.npy", OptionError, r"written as \.npz only", {"format": "npz"}),
    ):
        with pytest.raises(error, match=problem):
            write_scene(source, tmp_path / name, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["rows.npy"]
    write_scene(scene, tmp_path / "o", format="pcd")
    with pytest.raises(OutputError):
        write_scene(scene, tmp_path / "o", format="pcd")
    for options in ({"points_frame": "moon"}, {"rate_hz": 0.0}):
        with pytest.raises(OptionError):
            open_scene(tmp_path / "o", **options)


COLORS = np.array([[255, 255, 255], [255, 255, 255], [10, 20, 30], [1, 2, 3]], np.uint8)
SEEN_BY = np.array([255, 0, 1, 255], np.uint8)
"""A point that no camera saw, a white wall, another point, and a colour that came from elsewhere."""
GREY = [[128, 128, 128], *COLORS[1:].tolist()]


def colours_in(columns):
    if "rgb" in columns:
        packed = columns["rgb"].view(np.uint32)
        return np.column_stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255]).tolist()
    if "colors" in columns:
        return columns["colors"].tolist()
    found = np.column_stack([columns[name] for name in ("red", "green", "blue")])
    return (found // 257 if found.dtype == np.uint16 else found).tolist()


@pytest.mark.parametrize("suffix", [".sfs", ".ply", ".pcd", ".las", ".laz", ".npz", ".mcap", ".bag", ".ros2"])
def test_points_that_no_camera_saw_are_grey_in_files_with_a_column_that_says_so_and_white_again_in_the_model(
    tmp_path, suffix
):
    points = LidarPoints(np.eye(4, 3, dtype=np.float32) + 1, colors=COLORS, camera_index=SEEN_BY)
    poses = Poses([0], [[0, 0, 0]], [[0, 0, 0, 1]], static=True)
    frames = LazyFrames.of([LidarFrame(10**9, points)], [10**9])
    fused = Scene((LidarSensor("top", frames, poses=poses, points_frame=PointsFrame.WORLD),))
    path = tmp_path / f"cloud{suffix}"
    sceneloom.write(fused, path)
    with sceneloom.open(path) as scene:
        found = scene.lidars[0].frames[0].points
        assert (found.colors.tolist(), found.camera_index.tolist()) == (COLORS.tolist(), SEEN_BY.tolist())
    if suffix[1:] in HOLD_ALL:
        columns = read_cloud(path).columns
        assert (colours_in(columns), columns["camera_index"].tolist()) == (GREY, SEEN_BY.tolist())
    if suffix == ".mcap":
        reader = pytest.importorskip("mcap.reader")
        with path.open("rb") as file:
            messages = [(schema.name, one.data) for schema, _, one in reader.make_reader(file).iter_messages()]
        assert bytes([128, 128, 128]) in b"".join(data for name, data in messages if name == "foxglove.PointCloud")
