"""Samples of a scene, and the frames nearest in time."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.samples import _FramesByTimestamp as FramesByTimestamp
from sceneloom.scene.samples import _SweepsByReference as SweepsByReference

CAMERA_MODEL = Camera("brown_conrady", 4, 3, 2.0, 2.5, 1.5, 1.0, (0.1, 0.02))
MS = 1_000_000
SWEEPS_NS = np.array([0, 100, 200, 300], np.int64) * MS
IMAGES_NS = np.array([40, 75, 160, 370], np.int64) * MS
TRAJECTORY_NS = np.arange(0, 420, 30, dtype=np.int64) * MS
ROTATIONS = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.1, -0.2, 1.1], len(TRAJECTORY_NS)))
LOCATIONS = np.column_stack([np.cos(TRAJECTORY_NS / 2e8), np.sin(TRAJECTORY_NS / 2e8), TRAJECTORY_NS / 1e9])


def matrix(rotation, position):
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation.as_matrix(), position
    return whole


EGO_FROM_LIDAR = matrix(Rotation.from_euler("zyx", [20, 3, -2], degrees=True), [0.1, 0.2, 1.8])
EGO_FROM_CAMERA = matrix(Rotation.from_euler("zyx", [-90, 5, -85], degrees=True), [1.5, 0.0, 1.2])


def transform(whole):
    return RigidTransform(whole[:3, :3].copy(), whole[:3, 3].copy())


def assert_poses(*found_and_expected):
    """Composing in another order than scipy rounds the last digits."""
    for found, expected in found_and_expected:
        np.testing.assert_allclose(found.matrix, expected, atol=1e-12)


def world_from_ego(time_ns):
    location = [np.interp(time_ns, TRAJECTORY_NS, LOCATIONS[:, axis]) for axis in range(3)]
    return matrix(Slerp(TRAJECTORY_NS / 1e6, ROTATIONS)(time_ns / 1e6), location)


LIDAR_AT_150, CAMERA_AT_160 = world_from_ego(150 * MS) @ EGO_FROM_LIDAR, world_from_ego(160 * MS) @ EGO_FROM_CAMERA


def sweep(start_ns, middle_ns=50 * MS):
    times = start_ns + np.array([0, middle_ns, 99 * MS], np.int64)
    positions = np.arange(9, dtype=np.float32).reshape(3, 3)
    return sc.LidarFrame(int(start_ns), sc.LidarPoints(positions, np.array([1, 2, 3], np.uint8), timestamps_ns=times))


def lidar(sensor_id="lidar", **fields):
    frames = sc.LazyFrames.of([sweep(start) for start in SWEEPS_NS.tolist()], SWEEPS_NS)
    return replace(sc.LidarSensor(sensor_id, frames, mount=transform(EGO_FROM_LIDAR)), **fields)


def camera(**fields):
    images = [sc.CameraImage.of(int(t), CAMERA_MODEL, np.full((3, 4, 3), k, np.uint8)) for k, t in enumerate(IMAGES_NS)]
    frames = sc.LazyFrames.of(images, IMAGES_NS)
    return replace(sc.CameraSensor("camera0", CAMERA_MODEL, frames, mount=transform(EGO_FROM_CAMERA)), **fields)


def depth_camera(late_ns=0):
    times = (IMAGES_NS + late_ns).tolist()
    depths = [sc.DepthFrame.of(t, CAMERA_MODEL, np.full((3, 4), k + 0.5, np.float32)) for k, t in enumerate(times)]
    frames = sc.LazyFrames.of(depths, times)
    return sc.DepthCameraSensor("depth0", CAMERA_MODEL, frames, mount=transform(EGO_FROM_CAMERA))


def drive(*sensors, **fields):
    trajectory = sc.Trajectory("groundTruth", TRAJECTORY_NS, LOCATIONS, ROTATIONS.as_quat())
    fields = {"trajectories": {"groundTruth": trajectory}, **fields}
    return sc.Scene(sensors or (lidar(), camera()), **fields)


def test_a_sample_holds_the_image_nearest_to_the_middle_of_its_sweep_within_the_tolerance():
    samples = drive().samples()
    assert [sample.timestamp_ns for sample in samples] == (SWEEPS_NS + 50 * MS).tolist()
    # 370 ms is nearer to the last sweep's 350 ms than the tolerance, a sweep period; 250 ms has 160 ms at 90 ms
    assert [sample.images["camera0"].timestamp_ns // MS for sample in samples] == [40, 160, 160, 370]
    assert samples[0].time_differences_ns == {"lidar": 0, "camera0": -10 * MS}
    np.testing.assert_array_equal(samples[3].images["camera0"].rgb, 3)
    assert samples[0].missing == drive().samples(tolerance_ns=90 * MS)[2].missing == {}
    far = drive().samples(tolerance_ns=89 * MS)[2]
    assert far.images == far.world_from_camera == {"camera0": None}
    assert far.missing["camera0"] == "its nearest frame is 0.090 s away; expected at most 0.089 s"
    assert far.cameras == {"camera0": CAMERA_MODEL}
    assert "no frame" in far.unposed["camera0"]


def test_poses_are_those_of_each_sensor_at_its_own_time_and_of_the_points_in_their_frame():
    sample = drive().samples()[1]
    expected = np.linalg.inv(CAMERA_AT_160) @ LIDAR_AT_150
    assert_poses(
        (sample.world_from_lidar, LIDAR_AT_150),
        (sample.world_from_camera["camera0"], CAMERA_AT_160),
        (sample.camera_from_lidar["camera0"], expected),
        (sample.camera_from_points["camera0"], expected),
    )
    assert sample.unposed == {}
    assert drive().samples().trajectory == "groundTruth"
    of_ego = drive(lidar(points_frame=sc.PointsFrame.EGO), camera()).samples()[1]
    assert_poses(
        (of_ego.poses.world_from_points, world_from_ego(150 * MS)),
        (of_ego.camera_from_points["camera0"], np.linalg.inv(CAMERA_AT_160) @ world_from_ego(150 * MS)),
        (of_ego.camera_from_lidar["camera0"], expected),
    )


def test_mountings_alone_join_sensors_without_a_trajectory_and_points_in_the_world_stay_there():
    sample = drive(trajectories={}).samples()[1]
    assert sample.world_from_lidar is None
    assert all("no trajectory" in sample.unposed[name] for name in ("lidar", "camera0"))
    expected = np.linalg.inv(EGO_FROM_CAMERA) @ EGO_FROM_LIDAR
    still = drive(trajectories={}).samples(trajectory="identity")[1]
    assert_poses(
        (sample.camera_from_lidar["camera0"], expected),
        (still.world_from_lidar, EGO_FROM_LIDAR),
        (still.camera_from_lidar["camera0"], expected),
    )
    # points in the world stay there, and no trajectory can be chosen for them
    world = {"coordinates": sc.Coordinates.WORLD, "mount": None}
    whole = np.array([world_from_ego(t) @ EGO_FROM_CAMERA for t in TRAJECTORY_NS])
    rotations, positions = Rotation.from_matrix(whole[:, :3, :3]), whole[:, :3, 3].copy()
    path = sc.Poses(TRAJECTORY_NS, positions, rotations.as_quat())
    sensors = (lidar(points_frame=sc.PointsFrame.WORLD, **world), camera(poses=path, **world))
    sample = drive(*sensors).samples()[1]
    location = [np.interp(160 * MS, TRAJECTORY_NS, positions[:, axis]) for axis in range(3)]
    expected = np.linalg.inv(matrix(Slerp(TRAJECTORY_NS / 1e6, rotations)(160.0), location))
    assert_poses((sample.poses.world_from_points, np.eye(4)), (sample.camera_from_points["camera0"], expected))
    assert sample.world_from_lidar is None
    assert "neither poses nor a mounting" in sample.unposed["lidar"]
    assert sample.camera_from_lidar == {"camera0": None}
    with pytest.raises(OptionError, match="placed in the world already"):
        drive(*sensors).samples(trajectory="groundTruth")


def test_a_trajectory_is_chosen_by_name_or_handed_in_and_continued_for_one_period():
    shifted = sc.Trajectory("other", TRAJECTORY_NS, LOCATIONS + np.array([0, 0, 5]), ROTATIONS.as_quat())
    unturned = sc.Trajectory("gnss", TRAJECTORY_NS, LOCATIONS)
    scene = drive()
    scene = replace(scene, trajectories={**scene.trajectories, "other": shifted, "gnss": unturned})
    heights = [
        scene.samples(trajectory=choice)[0].world_from_lidar.translation[2]
        for choice in (None, "other", EgoMotion.of(shifted))
    ]
    np.testing.assert_allclose(np.subtract(heights, heights[0]), [0, 5, 5], atol=1e-12)
    with pytest.raises(OptionError, match="no trajectory 'vio'; there are: groundTruth, other, gnss, identity"):
        scene.samples(trajectory="vio")
    with pytest.raises(PoseError, match="without orientations"):
        scene.samples(trajectory="gnss")
    assert replace(scene, trajectories={"gnss": unturned}).samples()[0].world_from_lidar is None
    short = sc.Trajectory("short", TRAJECTORY_NS[:5], LOCATIONS[:5], ROTATIONS[:5].as_quat())
    samples = drive(trajectories={"short": short}).samples()
    assert [samples[k].poses.extrapolated for k in (0, 1)] == [(), ("lidar", "camera0")]
    assert samples[3].world_from_lidar is None
    assert samples[3].unposed["lidar"] == "0.230 s beyond the ends of the trajectory"
    assert samples[3].camera_from_lidar["camera0"] is not None


def test_a_camera_as_reference_is_joined_by_the_nearest_sweep_and_further_sensors_when_asked_for():
    samples = drive().samples(reference="camera0")
    assert [sample.timestamp_ns for sample in samples] == IMAGES_NS.tolist()
    # 75 ms is nearer to the middle 50 of the first sweep than to 150 of the second, though that begins at 100
    assert [sample.sweep.timestamp_ns // MS for sample in samples] == [0, 0, 100, 300]
    assert samples[1].time_differences_ns == {"camera0": 0, "lidar": -25 * MS}
    assert drive().samples(reference="camera")[1].reference_id == "camera0"
    assert drive(camera()).samples(reference="camera")[0].sweep is None
    late = sc.LazyFrames.of([sweep(start) for start in (SWEEPS_NS + 30 * MS).tolist()], SWEEPS_NS + 30 * MS)
    echo = sc.RadarFrame(45 * MS, sc.RadarPoints(np.ones((2, 3), np.float32), lengths=np.ones(2, np.float32)))
    radar = sc.RadarSensor("radar", sc.LazyFrames.of([echo], [45 * MS]), mount=transform(EGO_FROM_CAMERA))
    scene = drive(lidar("top"), lidar("front", frames=late), radar, camera())
    sample = scene.samples(lidars="all", radars=["radar"])[1]
    assert (sample.lidar_id, list(sample.sweeps)) == ("top", ["top", "front"])
    assert sample.times_ns["front"] == 180 * MS
    assert sample.radar_frames == {"radar": None}
    early = scene.samples(reference="front", radars="radar", cameras=(), tolerance_ns=40 * MS)[0]
    assert early.radar_frames == {"radar": echo}
    assert_poses((early.poses.world_from_sensor["radar"], world_from_ego(45 * MS) @ EGO_FROM_CAMERA))
    assert list(scene.samples()[0].sweeps) == ["top"]


def test_the_depth_image_nearest_to_a_sweep_is_there_with_its_camera_model_and_pose_or_an_own_mounting():
    scene = drive(lidar(), camera(), depth_camera(5 * MS))
    sample = scene.samples()[1]
    assert sample.times_ns["depth0"] == 165 * MS
    np.testing.assert_array_equal(sample.depth_frames["depth0"].depth, 2.5)
    assert (list(sample.images), sample.cameras["depth0"]) == (["camera0"], CAMERA_MODEL)
    world_from_depth = world_from_ego(165 * MS) @ EGO_FROM_CAMERA
    expected = np.linalg.inv(world_from_depth) @ LIDAR_AT_150
    assert_poses(
        (sample.world_from_camera["depth0"], world_from_depth),
        (sample.camera_from_lidar["depth0"], expected),
        (sample.camera_from_points["depth0"], expected),
    )
    assert scene.samples(depth_cameras=())[1].depth_frames == {}
    with pytest.raises(OptionError, match="no depth camera 'camera0'; expected some of: 'all', 'depth0'"):
        scene.samples(depth_cameras="camera0")
    own = transform(matrix(Rotation.identity(), [9.0, 8.0, 7.0]))
    images, depths = (
        sc.LazyFrames.of([replace(frame, mount=own) for frame in frames], IMAGES_NS)
        for frames in (camera().images, depth_camera().frames)
    )
    sample = drive(lidar(), camera(images=images), replace(depth_camera(), frames=depths)).samples()[0]
    expected = world_from_ego(40 * MS) @ own.matrix
    assert_poses(*((sample.world_from_camera[name], expected) for name in ("camera0", "depth0")))
    np.testing.assert_array_equal(sample.poses.ego_from_sensor["camera0"].matrix, own.matrix)


def test_only_what_a_sample_holds_is_read_when_asked_for_also_through_a_function():
    asked, decoded, numbers, sensor = [], [], [0, 1, 2, 3], lidar()

    def read(k):
        asked.append(k)
        if k == 1:
            raise DataError("drive", f"frames[{k}]", "is torn")
        return sensor.frames[k]

    samples = drive(replace(sensor, frames=sc.LazyFrames(SWEEPS_NS, read)), camera()).samples()
    assert asked == []
    assert samples[2].sweep.timestamp_ns == 200 * MS
    assert asked == [2]
    with pytest.raises(DataError, match="is torn"):
        samples[1]
    samples = drive().samples()
    for part in (slice(1, 3), slice(None, None, -2), slice(3, 1), slice(-2, None)):
        assert [sample.index for sample in samples[part]] == numbers[part]
        assert len(samples[part]) == len(numbers[part])
    assert (samples[1:][1:][0].index, samples[-1].index) == (2, 3)
    with pytest.raises(IndexError):
        samples[4]
    # a decoded image goes along with a pickled sample
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    frame = sc.DepthFrame(40 * MS, CAMERA_MODEL, lambda: decoded.append(1) or image)
    sample = drive(lidar(), replace(depth_camera(), frames=sc.LazyFrames.of([frame], [40 * MS]))).samples()[0]
    assert decoded == []
    carried = pickle.loads(pickle.dumps(sample))
    np.testing.assert_array_equal(carried.depth_frames["depth0"].depth, image)
    assert decoded == [1]
    # what a function makes of samples is a sequence that makes nothing before it is asked
    made = []
    numbers = drive().samples().map(lambda sample: made.append(sample.index) or sample.index * 10)
    assert (len(numbers), made) == (4, [])
    assert (numbers[2], numbers[-1]) == (20, 30)
    assert list(numbers[::-2]) == [30, 10]
    assert made == [2, 3, 3, 1]
    assert drive().samples().map(sc.Sample.arrays)[0]["index"] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reference": "side"}, "reference 'side'; expected one of its lidars and cameras: 'lidar', 'camera0'"),
        ({"cameras": ["camera0", "rear"]}, "no camera 'rear'; expected some of: 'all', 'camera0'"),
        ({"cameras": "lidar"}, "no camera 'lidar'"),
        ({"radars": ["r"]}, "no radar 'r'; expected some of: 'all', none, it has no such sensor"),
        ({"lidars": [1]}, "no lidar 1; expected some of: 'all', 'lidar'"),
        ({"tolerance_ns": -1}, "tolerance -1 ns; expected 0 or more"),
    ],
)
def test_what_is_not_there_is_refused_with_what_is(arguments, message):
    with pytest.raises(OptionError, match=message):
        drive().samples(**arguments)
    with pytest.raises(OptionError, match=r"reference 'lidar'; .*: 'camera0'"):
        drive(camera()).samples()


def box(annotation_id, times_ms, rows, **fields):
    path = sc.CuboidPath(np.array(times_ms, np.int64) * MS, np.array(rows, np.float64))
    return sc.CuboidAnnotation(annotation_id, path, **fields)


def test_boxes_are_those_at_the_moment_rotated_the_shorter_arc_and_by_angles_as_the_metadata_state():
    moving = box("car", [40, 60], [[4, 2, 1.5, 0, 0, 0, 0, 0, 170], [4, 2, 2.5, 8, 0, 0, 0, 0, -170]], label="car")
    stationary = box(7, [900], [[1, 1, 1, 5, 5, 5, 10, 20, 30]], stationary=True)
    gone = box("gone", [0, 49], np.ones((2, 9)))
    boxes = drive(annotations=(gone, moving, stationary)).samples()[0].boxes
    assert (boxes.ids, boxes.labels) == (("car", 7), ("car", None))
    np.testing.assert_allclose(boxes.centers_world, [[4, 0, 0], [5, 5, 5]])
    np.testing.assert_allclose(boxes.sizes_lwh, [[4, 2, 2], [1, 1, 1]])
    np.testing.assert_allclose(np.cos(boxes.yaws_world[0]), -1.0)
    metadata = {"sceneloom": {"euler_unit": "radians", "euler_order": "zyx"}}
    other = drive(annotations=(stationary,), metadata=metadata).samples()[0].boxes
    # capital letters: about the rotated axes one after the other, which is Rx(10) Ry(20) Rz(30)
    expected = Rotation.from_euler("XYZ", [10, 20, 30], degrees=True), Rotation.from_euler("xyz", [10, 20, 30])
    for found, rotation in zip((boxes.rotations_world[1], other.rotations_world[0]), expected, strict=True):
        np.testing.assert_allclose(found, rotation.as_matrix(), atol=1e-12)
    assert len(drive().samples()[0].boxes) == 0


def test_arrays_are_the_caller_s_own_and_have_the_same_names_dtypes_and_numbers_of_boxes_whatever_is_there():
    row = np.array([4.0, 2.0, 1.5, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    annotations = box("early", [0, 100], [row, row], label="car"), box(7, [0, 400], [row, row])
    scene = drive(lidar(), camera(), depth_camera(), annotations=annotations)
    first, last = (scene.samples()[k].arrays() for k in (0, 3))
    near, far = (scene.samples(tolerance_ns=t)[2].arrays() for t in (90 * MS, 10 * MS))
    assert len({tuple((name, a.dtype) for name, a in found.items()) for found in (first, last, near, far)}) == 1
    assert first["boxes.track_ids"].tolist() == ["early", "7"]
    assert first["boxes.labels"].tolist() == ["car", ""]
    assert first["boxes.track_numbers"].tolist() == [0, 1]
    assert (last["boxes.track_ids"].tolist(), last["boxes.track_numbers"].tolist()) == (["7"], [1])
    assert (near["camera0.found"], far["camera0.found"]) == (True, False)
    assert near["camera0.rgb"].shape == far["camera0.rgb"].shape == (3, 4, 3)
    assert not far["camera0.rgb"].any()
    assert not np.isnan(far["camera0.camera_from_lidar"]).any(), "the mountings are known"
    assert np.isnan(far["camera0.world_from_sensor"]).all()
    np.testing.assert_array_equal(near["depth0.depth"], np.full((3, 4), 2.5, np.float32))
    np.testing.assert_array_equal(far["depth0.depth"], np.zeros((3, 4), np.float32))
    np.testing.assert_array_equal(near["depth0.matrix"], [[2, 0, 1.5], [0, 2.5, 1], [0, 0, 1]])
    samples = drive(lidar(), camera(), depth_camera()).samples()
    sample, arrays = samples[1], samples[1].arrays()
    for name, expected in {
        "lidar.positions": sample.sweep.points.positions,
        "lidar.intensities": [1, 2, 3],
        "camera0.matrix": [[2, 0, 1.5], [0, 2.5, 1], [0, 0, 1]],
        "camera0.coefficients": [0.1, 0.02],
        "camera0.camera_from_points": sample.camera_from_points["camera0"].matrix,
        "timestamp_ns": 150 * MS,
        "camera0.time_ns": 160 * MS,
    }.items():
        np.testing.assert_array_equal(arrays[name], expected)
    for name in ("lidar.positions", "camera0.rgb", "depth0.depth"):
        arrays[name][:] = 99
    assert all(array.flags.writeable for array in arrays.values())
    assert samples[1].sweep.points.positions.max() == 8
    assert samples[1].images["camera0"].rgb.max() == 2
    assert samples[1].depth_frames["depth0"].depth.max() == 2.5


PERIOD = 100
TIMESTAMPS = st.lists(st.integers(0, 60), max_size=12)


def images_at(timestamps):
    return sc.LazyFrames.of([sc.CameraImage(t, CAMERA_MODEL, lambda: None) for t in timestamps], timestamps)


def sweep_at(start, times):
    points = sc.LidarPoints(np.zeros((len(times), 3), np.float32), timestamps_ns=np.array(times, np.int64))
    return sc.LidarFrame(start, points)


def nearest_of_all(times, wanted, tolerance):
    """The oracle: the first of the least far, after a stable sort by time."""
    order = sorted(range(len(times)), key=lambda k: times[k])
    best = min(order, key=lambda k: abs(times[k] - wanted), default=None)
    return None if best is None or abs(times[best] - wanted) > tolerance else best


@given(TIMESTAMPS, st.integers(-5, 65), st.integers(0, 20))
def test_the_nearest_image_is_found_and_the_earlier_one_of_two(timestamps, wanted, tolerance):
    frames = images_at(timestamps)
    answer = FramesByTimestamp(frames).find(wanted, tolerance)
    expected = nearest_of_all(timestamps, wanted, tolerance)
    if expected is None:
        assert isinstance(answer, str)
    else:
        assert answer == (frames[expected], timestamps[expected])


@st.composite
def sweeps(draw):
    """Sweeps that begin one after another, whose median times come in the same order, some of them long or late."""
    gaps = draw(st.lists(st.integers(1, 40), min_size=1, max_size=8))
    starts = np.cumsum(gaps).tolist()
    lags = draw(st.lists(st.integers(0, 60), min_size=len(starts), max_size=len(starts)))
    references = np.maximum.accumulate(np.add(starts, lags)).tolist()
    # two times around the median keep it from being the timestamp where all are the same
    return [sweep_at(start, [mid - 1, mid, mid + 1]) for start, mid in zip(starts, references, strict=True)]


@given(sweeps(), st.lists(st.integers(-10, 400), min_size=1, max_size=5), st.integers(0, 200))
def test_the_nearest_sweep_is_found_by_its_own_reference_time_whatever_was_asked_before(frames, times, tolerance):
    finder = SweepsByReference(sc.LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]), PERIOD)
    references = [frame.reference_ns for frame in frames]
    for wanted in times:
        answer = finder.find(wanted, tolerance)
        expected = nearest_of_all(references, wanted, tolerance)
        if expected is None:
            assert isinstance(answer, str)
        else:
            # of sweeps with one reference time any is as near as the other
            assert answer[1] == answer[0].reference_ns == references[expected]


def test_a_sweep_is_found_by_reading_no_other_and_with_its_point_times_put_right():
    asked = []
    frames = [sweep_at(k * PERIOD, [k * PERIOD + 49, k * PERIOD + 50, k * PERIOD + 51]) for k in range(20)]

    def read(k):
        asked.append(k)
        return frames[k]

    finder = SweepsByReference(sc.LazyFrames(np.arange(20, dtype=np.int64) * PERIOD, read), PERIOD)
    assert finder.find(12 * PERIOD + 55, PERIOD) == (frames[12], 12 * PERIOD + 50)
    assert asked == [12]
    frame, reference_ns = SweepsByReference(sc.LazyFrames.of([sweep_at(1000, [5, 6, 7])], [1000]), PERIOD).read(0)
    assert (reference_ns, frame.points.timestamps_ns.tolist()) == (1006, [1005, 1006, 1007])
    # a sensor without anything, or with nothing near, says so
    assert FramesByTimestamp(images_at([])).find(0, 5) == "it has no frames"
    assert "0.000 s away" in FramesByTimestamp(images_at([9])).find(0, 5)
    assert SweepsByReference(sc.LazyFrames.of([], []), PERIOD).find(0, 5) == "it has no frames"
