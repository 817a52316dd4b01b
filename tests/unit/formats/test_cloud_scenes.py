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
from sceneloom.scene import (
    CuboidAnnotation,
    CuboidPath,
    GnssSensor,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsFrame,
    Poses,
    Scene,
    Trajectory,
)
from sceneloom.scene.clouds import grey_where_unseen, white_where_unseen

RNG = np.random.default_rng(11)
COUNT = 400
TIMESTAMPS = (1_700_000_000_000_000_001, 1_700_000_000_100_000_003)
KINDS = ("pcd", "ply", "las", "laz", "kitti-bin", "nuscenes-bin", "npz")
ENDINGS = {"kitti-bin": ".bin", "nuscenes-bin": ".pcd.bin"}
HOLD_ALL = ("pcd", "ply", "las", "laz", "npz")


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


def same(found, expected, *, tolerance=0.0):
    np.testing.assert_allclose(found.positions, expected.positions, rtol=0, atol=tolerance)
    for name in ("intensities", "colors", "timestamps_ns", "rings", "camera_index"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    for name, values in expected.extras.items():
        assert found.extras[name].dtype == values.dtype
        np.testing.assert_array_equal(found.extras[name], values)


@pytest.mark.parametrize("kind", HOLD_ALL)
def test_a_folder_of_clouds_gives_back_all_that_its_points_bear(tmp_path, scene, kind):
    losses = write_scene(scene, tmp_path / "clouds", format=kind)
    with open_scene(tmp_path / "clouds") as found:
        assert found.format == kind
        assert found.lidars[0].frames.timestamps_ns.tolist() == list(TIMESTAMPS)
        for one, other in zip(found.lidars[0].frames, scene.lidars[0].frames, strict=True):
            # LAS rounds to steps of 0.01 mm, and float32 of 80 m to 8 µm
            same(one.points, other.points, tolerance=1.3e-5 if kind.startswith("la") else 0.0)
    if kind.startswith("la"):
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
        for one, other in zip(open_scene(tmp_path / folder).lidars[0].frames, scene.lidars[0].frames, strict=True):
            same(one.points, other.points)


@pytest.mark.parametrize(("kind", "columns"), [("kitti-bin", 4), ("nuscenes-bin", 5)])
def test_packed_files_hold_the_locations_and_the_brightness_and_what_they_leave_out_is_reported(
    tmp_path, scene, kind, columns
):
    losses = write_scene(scene, tmp_path / "clouds", format=kind)
    file = tmp_path / "clouds" / f"{TIMESTAMPS[0]}{ENDINGS[kind]}"
    rows = np.fromfile(file, "<f4").reshape(-1, columns)
    expected = scene.lidars[0].frames[0].points
    np.testing.assert_array_equal(rows[:, :3], expected.positions)
    # KITTI counts brightness from 0 to 1, nuScenes from 0 to 255
    full = 1.0 if kind == "kitti-bin" else 255.0
    np.testing.assert_allclose(rows[:, 3], expected.intensities * (full / 255.0), rtol=1e-6)
    left = {"timestamps_ns", "colors", "camera_index", "extras.range", "extras.echo"}
    if kind == "nuscenes-bin":
        np.testing.assert_array_equal(rows[:, 4], expected.rings)
    else:
        left.add("rings")
    assert {loss.field.removeprefix("sensors[lidar].frames.points.") for loss in losses} == left
    assert all(loss.support is Support.DROPPED and loss.count == 2 for loss in losses)
    found = open_scene(tmp_path / "clouds").lidars[0].frames[0].points
    np.testing.assert_array_equal(found.positions, expected.positions)
    np.testing.assert_array_equal(found.intensities, expected.intensities)


@pytest.mark.parametrize("kind", KINDS)
def test_a_scene_of_one_frame_is_written_to_a_file(tmp_path, kind):
    one = scene_of([LidarFrame(0, replace(points(0), timestamps_ns=None))])
    target = tmp_path / f"one{ENDINGS.get(kind, f'.{kind}')}"
    write_scene(one, target, format=kind)
    assert find_format(target).name == kind
    found = open_scene(target).lidars[0].frames[0]
    assert found.timestamp_ns == 0
    np.testing.assert_allclose(found.points.positions, one.lidars[0].frames[0].points.positions, atol=1.3e-5)


def test_an_array_without_names_is_read_and_not_written(tmp_path):
    rows = RNG.uniform(-9, 9, (7, 4)).astype(np.float32)
    np.save(tmp_path / "rows.npy", rows)
    one = open_scene(tmp_path / "rows.npy")
    np.testing.assert_array_equal(one.lidars[0].frames[0].points.positions, rows[:, :3])
    with pytest.raises(OptionError, match=r"written as \.npz only"):
        write_scene(one, tmp_path / "out.npy", format="npz")


def test_what_files_of_points_have_no_field_for_is_reported(tmp_path, scene):
    box = CuboidAnnotation("a", CuboidPath(np.zeros(1, np.int64), np.ones((1, 9))))
    fix = GnssSensor("gps", np.zeros(1, np.int64), np.zeros((1, 3)), np.ones(1), np.ones(1))
    lidar = replace(scene.lidars[0], model="M1", id="top")
    losses = write_scene(Scene((lidar, fix), annotations=(box,), metadata={"city": "x"}), tmp_path / "o", format="ply")
    reported = {loss.field: loss for loss in losses}
    assert {"sensors[gps]", "sensors[top].model", "annotations.cuboid", "metadata", "sensors[top].id"} == set(reported)
    assert reported["sensors[top].id"].support is Support.CONVERTED


def test_points_are_written_in_the_frame_that_is_asked_for(tmp_path):
    # a quarter rotation to the left at (10, 0, 0): what lies ahead of the sensor lies to the left in the world
    half = np.sqrt(0.5)
    timestamps = np.array(TIMESTAMPS)
    poses = Poses(timestamps, np.array([[10.0, 0.0, 0.0], [20.0, 0.0, 0.0]]), np.array([[0.0, 0.0, half, half]] * 2))
    ahead = LidarPoints(np.array([[5.0, 0.0, 0.0]], np.float32))
    one = scene_of([LidarFrame(timestamp, ahead) for timestamp in TIMESTAMPS], poses=poses)
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


def test_points_on_the_ego_bring_the_ego_trajectory(tmp_path):
    timestamps = np.array(TIMESTAMPS)
    vio = Trajectory("vio", timestamps, np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([[0.0, 0, 0, 1]] * 2))
    frames = [LidarFrame(timestamp, points(timestamp)) for timestamp in TIMESTAMPS]
    one = scene_of(frames, points_frame=PointsFrame.EGO, poses=vio.poses)
    write_scene(replace(one, trajectories={"vio": vio}), tmp_path / "o", format="pcd")
    with open_scene(tmp_path / "o") as found:
        assert found.lidars[0].points_frame is PointsFrame.EGO
        (trajectory,) = found.trajectories.values()
        np.testing.assert_array_equal(trajectory.positions, vio.positions)


def test_several_lidars_are_folders_of_their_own(tmp_path):
    lidars = [LidarSensor(name, LazyFrames.of([LidarFrame(7, points(7))], [7])) for name in ("top left", "rear/1")]
    losses = write_scene(Scene(tuple(lidars)), tmp_path / "o", format="npz")
    assert not losses
    found = {lidar.id: lidar.frames[0].points for lidar in open_scene(tmp_path / "o").lidars}
    assert set(found) == {"top left", "rear/1"}
    for lidar in lidars:
        same(found[lidar.id], lidar.frames[0].points)


def test_frames_of_one_time_keep_their_order_and_that_is_reported(tmp_path):
    frames = [LidarFrame(5, points(5)) for _ in range(3)]
    (loss,) = write_scene(scene_of(frames), tmp_path / "o", format="pcd")
    assert (loss.support, loss.count, loss.largest_error) == (Support.APPROXIMATED, 2, 2.0)
    found = open_scene(tmp_path / "o").lidars[0].frames
    for one, other in zip(found, frames, strict=True):
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
        (["1700000000000000001", "1700000000100000003"], list(TIMESTAMPS)),
        (["-0000000000000000005", "0000000000000000007"], [-5, 7]),
        (["1700000000.5", "1700000000.6"], [1_700_000_000_500_000_000, 1_700_000_000_600_000_000]),
        (["1700000000_000000001", "1700000000_100000003"], list(TIMESTAMPS)),
        (["a__LIDAR_TOP__1532402927647951"], [1_532_402_927_647_951_000]),
        (["pc-1532402927647"], [1_532_402_927_647_000_000]),
        (["0.1", "0.25"], [100_000_000, 250_000_000]),
        (["000000", "000001"], None),
        (["0000000005"], None),
        (["cloud"], None),
        (["1700000000", "cloud"], None),
    ],
)
def test_names_that_are_times_are_distinguished_from_numbers(names, times):
    assert times_of_names(names) == times


def test_numbers_and_endings_of_names():
    assert numbers_of_names(["frame_000007", "frame_000009"]) == [7, 9]
    assert numbers_of_names(["a_1", "b_1"]) is None
    assert stem_of("x__1.pcd.bin") == "x__1"
    assert times_of_names(["-0000000000000000003"]) == [-3]


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
    scene = open_scene(folder)
    assert scene.lidars[0].frames.timestamps_ns.tolist() == [0, 100_000_000, 300_000_000]
    assert {"cloud-times-assumed", "cloud-frame-assumed"} <= {warning.code for warning in scene.warnings}
    reported = open_scene(folder, rate_hz=20.0)
    assert reported.lidars[0].frames.timestamps_ns.tolist() == [0, 50_000_000, 150_000_000]
    assert "cloud-times-assumed" not in {warning.code for warning in reported.warnings}


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


def test_folders_with_other_files_or_two_kinds_are_reported_with_what_keeps_them_from_being_clouds(
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


@pytest.mark.parametrize(
    ("content", "reported"),
    [(b"", "it is empty"), *((c, "does not begin so") for c in (bytes(17), np.arange(64, dtype="<i4").tobytes()))],
)
def test_other_bin_files_are_no_clouds(tmp_path, content, reported):
    (tmp_path / "a.bin").write_bytes(content)
    with pytest.raises(UnknownFormatError, match=reported):
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
    with pytest.raises(UnknownOptionError):
        write_scene(scene, tmp_path / "o", format="pcd", profile="scale")
    for options in ({"frame": "moon"}, {"encoding": "zip"}, {"lidar": "none"}):
        with pytest.raises(OptionError):
            write_scene(scene, tmp_path / "o", format="pcd", **options)
    with pytest.raises(OptionError, match="one file for 2 frames"):
        write_scene(scene, tmp_path / "one.pcd")
    assert not list(tmp_path.iterdir())
    write_scene(scene, tmp_path / "o", format="pcd")
    with pytest.raises(OutputError):
        write_scene(scene, tmp_path / "o", format="pcd")
    for options in ({"points_frame": "moon"}, {"rate_hz": 0.0}):
        with pytest.raises(OptionError):
            open_scene(tmp_path / "o", **options)


def test_frames_of_clouds_go_to_other_processes(tmp_path, scene):
    write_scene(scene, tmp_path / "o", format="npz")
    frames = pickle.loads(pickle.dumps(open_scene(tmp_path / "o").lidars[0].frames))
    same(frames[1].points, scene.lidars[0].frames[1].points)


COLORS = np.array([[255, 255, 255], [255, 255, 255], [10, 20, 30], [1, 2, 3]], np.uint8)
SEEN_BY = np.array([255, 0, 1, 255], np.uint8)
"""A point that no camera saw, a white wall, another point, and a colour that came from elsewhere."""
GREY = [[128, 128, 128], *COLORS[1:].tolist()]


@pytest.fixture
def fused():
    points = LidarPoints(np.eye(4, 3, dtype=np.float32) + 1, colors=COLORS, camera_index=SEEN_BY)
    poses = Poses([0], [[0, 0, 0]], [[0, 0, 0, 1]], static=True)
    frames = LazyFrames.of([LidarFrame(10**9, points)], [10**9])
    return Scene((LidarSensor("top", frames, poses=poses, points_frame=PointsFrame.WORLD),))


@pytest.mark.parametrize("suffix", [".sfs", ".ply", ".pcd", ".las", ".laz", ".npz", ".mcap", ".bag", ".ros2"])
def test_the_model_has_them_white_again(fused, tmp_path, suffix):
    sceneloom.write(fused, tmp_path / f"cloud{suffix}")
    with sceneloom.open(tmp_path / f"cloud{suffix}") as scene:
        points = scene.lidars[0].frames[0].points
        assert points.colors.tolist() == COLORS.tolist()
        assert points.camera_index.tolist() == SEEN_BY.tolist()


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".las", ".npz"])
def test_files_of_points_have_them_grey_with_a_column_that_says_so(fused, tmp_path, suffix):
    sceneloom.write(fused, tmp_path / f"cloud{suffix}")
    columns = read_cloud(tmp_path / f"cloud{suffix}").columns
    assert colours_in(columns) == GREY
    assert columns["camera_index"].tolist() == SEEN_BY.tolist()


def colours_in(columns):
    if "rgb" in columns:
        packed = columns["rgb"].view(np.uint32)
        return np.column_stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255]).tolist()
    if "colors" in columns:
        return columns["colors"].tolist()
    found = np.column_stack([columns[name] for name in ("red", "green", "blue")])
    return (found // 257 if found.dtype == np.uint16 else found).tolist()


def test_messages_have_them_grey(fused, tmp_path):
    reader = pytest.importorskip("mcap.reader")
    sceneloom.write(fused, tmp_path / "cloud.mcap")
    with (tmp_path / "cloud.mcap").open("rb") as file:
        data = b"".join(
            message.data
            for schema, _, message in reader.make_reader(file).iter_messages()
            if schema.name == "foxglove.PointCloud"
        )
    assert bytes([128, 128, 128]) in data


def test_only_what_no_camera_saw_changes():
    assert grey_where_unseen(COLORS, SEEN_BY).tolist() == GREY
    assert white_where_unseen(np.array(GREY, np.uint8), SEEN_BY).tolist() == COLORS.tolist()
    assert grey_where_unseen(COLORS, None) is COLORS
