"""Samples of a scene, and the frames nearest in time."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    CameraImage,
    CameraSensor,
    Coordinates,
    CuboidAnnotation,
    CuboidPath,
    DepthCameraSensor,
    DepthFrame,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsFrame,
    Poses,
    RadarFrame,
    RadarPoints,
    RadarSensor,
    Sample,
    Scene,
    Trajectory,
)
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
EGO_FROM_LIDAR = (Rotation.from_euler("zyx", [20, 3, -2], degrees=True), np.array([0.1, 0.2, 1.8]))
EGO_FROM_CAMERA = (Rotation.from_euler("zyx", [-90, 5, -85], degrees=True), np.array([1.5, 0.0, 1.2]))
# composing in another order than scipy rounds the last digits
EXACT = 1e-12


def transform(pose):
    return RigidTransform(pose[0].as_matrix(), pose[1])


def matrix(rotation, position):
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation.as_matrix(), position
    return whole


def world_from_ego(time_ns):
    location = [np.interp(time_ns, TRAJECTORY_NS, LOCATIONS[:, axis]) for axis in range(3)]
    return matrix(Slerp(TRAJECTORY_NS / 1e6, ROTATIONS)(time_ns / 1e6), location)


def sweep(start_ns, middle_ns=50 * MS):
    times = start_ns + np.array([0, middle_ns, 99 * MS], np.int64)
    positions = np.arange(9, dtype=np.float32).reshape(3, 3)
    return LidarFrame(int(start_ns), LidarPoints(positions, np.array([1, 2, 3], np.uint8), timestamps_ns=times))


def lidar(sensor_id="lidar", **fields):
    frames = LazyFrames.of([sweep(start) for start in SWEEPS_NS.tolist()], SWEEPS_NS)
    return replace(LidarSensor(sensor_id, frames, mount=transform(EGO_FROM_LIDAR)), **fields)


def camera(**fields):
    images = [CameraImage.of(int(t), CAMERA_MODEL, np.full((3, 4, 3), k, np.uint8)) for k, t in enumerate(IMAGES_NS)]
    frames = LazyFrames.of(images, IMAGES_NS)
    return replace(CameraSensor("camera0", CAMERA_MODEL, frames, mount=transform(EGO_FROM_CAMERA)), **fields)


def depth_camera(late_ns=0):
    times = IMAGES_NS + late_ns
    depths = [DepthFrame.of(int(t), CAMERA_MODEL, np.full((3, 4), k + 0.5, np.float32)) for k, t in enumerate(times)]
    return DepthCameraSensor("depth0", CAMERA_MODEL, LazyFrames.of(depths, times), mount=transform(EGO_FROM_CAMERA))


def drive(*sensors, **fields):
    trajectory = Trajectory("groundTruth", TRAJECTORY_NS, LOCATIONS, ROTATIONS.as_quat())
    fields = {"trajectories": {"groundTruth": trajectory}, **fields}
    return Scene(sensors or (lidar(), camera()), **fields)


def test_a_sample_holds_the_image_nearest_to_the_middle_of_its_sweep():
    samples = drive().samples()
    assert len(samples) == 4
    middles = (SWEEPS_NS + 50 * MS).tolist()
    assert [sample.timestamp_ns for sample in samples] == middles
    found = [sample.images["camera0"] for sample in samples]
    # 370 ms is nearer to the last sweep's 350 ms than the tolerance, a sweep period; 250 ms has 160 ms at 90 ms
    assert [image.timestamp_ns // MS for image in found] == [40, 160, 160, 370]
    assert samples[0].time_differences_ns == {"lidar": 0, "camera0": -10 * MS}
    assert samples[0].missing == {}
    np.testing.assert_array_equal(samples[3].images["camera0"].rgb, 3)


def test_an_image_beyond_the_tolerance_is_missing_and_the_sample_says_how_far_it_is():
    sample = drive().samples(tolerance_ns=89 * MS)[2]
    assert sample.images == {"camera0": None}
    assert sample.missing["camera0"] == "its nearest frame is 0.090 s away; expected at most 0.089 s"
    assert sample.cameras == {"camera0": CAMERA_MODEL}
    assert sample.world_from_camera == {"camera0": None}
    assert "no frame" in sample.unposed["camera0"]
    assert drive().samples(tolerance_ns=90 * MS)[2].missing == {}


def test_poses_are_those_of_each_sensor_at_its_own_time():
    sample = drive().samples()[1]
    world_from_lidar = world_from_ego(150 * MS) @ matrix(*EGO_FROM_LIDAR)
    world_from_camera = world_from_ego(160 * MS) @ matrix(*EGO_FROM_CAMERA)
    np.testing.assert_allclose(sample.world_from_lidar.matrix, world_from_lidar, atol=EXACT)
    np.testing.assert_allclose(sample.world_from_camera["camera0"].matrix, world_from_camera, atol=EXACT)
    expected = np.linalg.inv(world_from_camera) @ world_from_lidar
    np.testing.assert_allclose(sample.camera_from_lidar["camera0"].matrix, expected, atol=EXACT)
    np.testing.assert_allclose(sample.camera_from_points["camera0"].matrix, expected, atol=EXACT)
    assert sample.unposed == {}
    assert drive().samples().trajectory == "groundTruth"


def test_without_a_trajectory_the_mountings_alone_join_lidar_and_camera():
    sample = drive(trajectories={}).samples()[1]
    assert sample.world_from_lidar is None
    assert "no trajectory" in sample.unposed["lidar"]
    assert "no trajectory" in sample.unposed["camera0"]
    expected = np.linalg.inv(matrix(*EGO_FROM_CAMERA)) @ matrix(*EGO_FROM_LIDAR)
    np.testing.assert_allclose(sample.camera_from_lidar["camera0"].matrix, expected, atol=EXACT)
    still = drive(trajectories={}).samples(trajectory="identity")[1]
    np.testing.assert_allclose(still.world_from_lidar.matrix, matrix(*EGO_FROM_LIDAR), atol=EXACT)
    np.testing.assert_allclose(still.camera_from_lidar["camera0"].matrix, expected, atol=EXACT)


def test_points_in_the_ego_frame_take_the_ego_s_pose_and_keep_the_lidar_s():
    sample = drive(lidar(points_frame=PointsFrame.EGO), camera()).samples()[1]
    np.testing.assert_allclose(sample.poses.world_from_points.matrix, world_from_ego(150 * MS), atol=EXACT)
    world_from_camera = world_from_ego(160 * MS) @ matrix(*EGO_FROM_CAMERA)
    expected = np.linalg.inv(world_from_camera) @ world_from_ego(150 * MS)
    np.testing.assert_allclose(sample.camera_from_points["camera0"].matrix, expected, atol=EXACT)
    expected = expected @ matrix(*EGO_FROM_LIDAR)
    np.testing.assert_allclose(sample.camera_from_lidar["camera0"].matrix, expected, atol=EXACT)


def posed(pose, times=TRAJECTORY_NS):
    """`world_from_sensor` at some times."""
    whole = np.array([world_from_ego(t) @ matrix(*pose) for t in times])
    return Poses(times, whole[:, :3, 3].copy(), Rotation.from_matrix(whole[:, :3, :3]).as_quat())


def test_points_in_the_world_stay_there_and_no_trajectory_can_be_chosen_for_them():
    world = {"coordinates": Coordinates.WORLD, "mount": None}
    sensors = (lidar(points_frame=PointsFrame.WORLD, **world), camera(poses=posed(EGO_FROM_CAMERA), **world))
    sample = drive(*sensors).samples()[1]
    np.testing.assert_allclose(sample.poses.world_from_points.matrix, np.eye(4), atol=EXACT)
    path = posed(EGO_FROM_CAMERA)
    location = [np.interp(160 * MS, TRAJECTORY_NS, path.positions[:, axis]) for axis in range(3)]
    rotation = Slerp(TRAJECTORY_NS / 1e6, Rotation.from_quat(path.quaternions_xyzw))(160.0)
    expected = np.linalg.inv(matrix(rotation, location))
    np.testing.assert_allclose(sample.camera_from_points["camera0"].matrix, expected, atol=EXACT)
    assert sample.world_from_lidar is None
    assert "neither poses nor a mounting" in sample.unposed["lidar"]
    assert sample.camera_from_lidar == {"camera0": None}
    with pytest.raises(OptionError, match="placed in the world already"):
        drive(*sensors).samples(trajectory="groundTruth")


def test_beyond_the_trajectory_poses_are_continued_for_one_period_and_then_not_known():
    short = Trajectory("short", TRAJECTORY_NS[:5], LOCATIONS[:5], ROTATIONS[:5].as_quat())
    samples = drive(trajectories={"short": short}).samples()
    assert samples[0].poses.extrapolated == ()
    assert samples[1].poses.extrapolated == ("lidar", "camera0")
    assert samples[3].world_from_lidar is None
    assert samples[3].unposed["lidar"] == "0.230 s beyond the ends of the trajectory"
    assert samples[3].camera_from_lidar["camera0"] is not None


def test_a_trajectory_is_chosen_by_name_or_handed_in():
    shifted = Trajectory("other", TRAJECTORY_NS, LOCATIONS + np.array([0, 0, 5]), ROTATIONS.as_quat())
    unturned = Trajectory("gnss", TRAJECTORY_NS, LOCATIONS)
    scene = drive()
    scene = replace(scene, trajectories={**scene.trajectories, "other": shifted, "gnss": unturned})
    heights = [
        scene.samples(trajectory=choice)[0].world_from_lidar.translation[2]
        for choice in (None, "other", EgoMotion.of(shifted))
    ]
    np.testing.assert_allclose(np.subtract(heights, heights[0]), [0, 5, 5], atol=EXACT)
    with pytest.raises(OptionError, match="no trajectory 'vio'; there are: groundTruth, other, gnss, identity"):
        scene.samples(trajectory="vio")
    with pytest.raises(PoseError, match="without orientations"):
        scene.samples(trajectory="gnss")
    by_default = replace(scene, trajectories={"gnss": unturned}).samples()[0]
    assert by_default.world_from_lidar is None


def test_the_own_mounting_of_an_image_and_of_a_depth_image_counts_before_the_camera_s():
    own = transform((Rotation.identity(), np.array([9.0, 8.0, 7.0])))
    images = LazyFrames.of([replace(image, mount=own) for image in camera().images], IMAGES_NS)
    depths = LazyFrames.of([replace(frame, mount=own) for frame in depth_camera().frames], IMAGES_NS)
    sample = drive(lidar(), camera(images=images), replace(depth_camera(), frames=depths)).samples()[0]
    for name in ("camera0", "depth0"):
        expected = world_from_ego(40 * MS) @ own.matrix
        np.testing.assert_allclose(sample.world_from_camera[name].matrix, expected, atol=EXACT)
    np.testing.assert_array_equal(sample.poses.ego_from_sensor["camera0"].matrix, own.matrix)


def test_a_camera_as_reference_is_joined_by_the_nearest_sweep():
    samples = drive().samples(reference="camera0")
    assert [sample.timestamp_ns for sample in samples] == IMAGES_NS.tolist()
    # 75 ms is nearer to the middle 50 of the first sweep than to 150 of the second, though that begins at 100
    assert [sample.sweep.timestamp_ns // MS for sample in samples] == [0, 0, 100, 300]
    assert samples[1].time_differences_ns == {"camera0": 0, "lidar": -25 * MS}
    assert drive().samples(reference="camera")[1].reference_id == "camera0"
    assert drive(camera()).samples(reference="camera")[0].sweep is None


def test_further_lidars_and_radars_are_there_when_asked_for():
    late = LazyFrames.of([sweep(start) for start in (SWEEPS_NS + 30 * MS).tolist()], SWEEPS_NS + 30 * MS)
    echo = RadarFrame(45 * MS, RadarPoints(np.ones((2, 3), np.float32), lengths=np.ones(2, np.float32)))
    radar = RadarSensor("radar", LazyFrames.of([echo], [45 * MS]), mount=transform(EGO_FROM_CAMERA))
    scene = drive(lidar("top"), lidar("front", frames=late), radar, camera())
    sample = scene.samples(lidars="all", radars=["radar"])[1]
    assert (sample.lidar_id, list(sample.sweeps)) == ("top", ["top", "front"])
    assert sample.times_ns["front"] == 180 * MS
    assert sample.radar_frames == {"radar": None}
    early = scene.samples(reference="front", radars="radar", cameras=(), tolerance_ns=40 * MS)[0]
    assert early.radar_frames == {"radar": echo}
    expected = world_from_ego(45 * MS) @ matrix(*EGO_FROM_CAMERA)
    np.testing.assert_allclose(early.poses.world_from_sensor["radar"].matrix, expected, atol=EXACT)
    assert list(scene.samples()[0].sweeps) == ["top"]


def test_the_depth_image_nearest_to_a_sweep_is_there_with_its_camera_model_and_pose():
    scene = drive(lidar(), camera(), depth_camera(5 * MS))
    sample = scene.samples()[1]
    assert sample.times_ns["depth0"] == 165 * MS
    np.testing.assert_array_equal(sample.depth_frames["depth0"].depth, 2.5)
    assert (list(sample.images), sample.cameras["depth0"]) == (["camera0"], CAMERA_MODEL)
    world_from_depth = world_from_ego(165 * MS) @ matrix(*EGO_FROM_CAMERA)
    np.testing.assert_allclose(sample.world_from_camera["depth0"].matrix, world_from_depth, atol=EXACT)
    world_from_lidar = world_from_ego(150 * MS) @ matrix(*EGO_FROM_LIDAR)
    expected = np.linalg.inv(world_from_depth) @ world_from_lidar
    np.testing.assert_allclose(sample.camera_from_lidar["depth0"].matrix, expected, atol=EXACT)
    np.testing.assert_allclose(sample.camera_from_points["depth0"].matrix, expected, atol=EXACT)
    assert scene.samples(depth_cameras=())[1].depth_frames == {}
    with pytest.raises(OptionError, match="no depth camera 'camera0'; expected some of: 'all', 'depth0'"):
        scene.samples(depth_cameras="camera0")


def test_a_depth_image_is_decoded_when_it_is_asked_for_and_goes_along_with_a_pickled_sample():
    decoded = []
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    frame = DepthFrame(40 * MS, CAMERA_MODEL, lambda: decoded.append(1) or image)
    sensor = depth_camera()
    sample = drive(lidar(), replace(sensor, frames=LazyFrames.of([frame], [40 * MS]))).samples()[0]
    assert decoded == []
    carried = pickle.loads(pickle.dumps(sample))
    np.testing.assert_array_equal(carried.depth_frames["depth0"].depth, image)
    assert decoded == [1]


def torn_at(broken, asked):
    """A lidar that notes which sweeps are read, and whose sweep of a number is torn."""
    sensor = lidar()

    def read(k):
        asked.append(k)
        if k == broken:
            raise DataError("drive", f"frames[{k}]", "is torn")
        return sensor.frames[k]

    return replace(sensor, frames=LazyFrames(SWEEPS_NS, read))


def test_samples_are_a_list_of_which_only_what_a_sample_holds_is_read():
    asked, numbers = [], [0, 1, 2, 3]
    samples = drive(torn_at(1, asked), camera()).samples()
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
    path = CuboidPath(np.array(times_ms, np.int64) * MS, np.array(rows, np.float64))
    return CuboidAnnotation(annotation_id, path, **fields)


def test_boxes_are_those_that_are_there_at_the_moment_rotated_the_shorter_arc():
    moving = box("car", [40, 60], [[4, 2, 1.5, 0, 0, 0, 0, 0, 170], [4, 2, 2.5, 8, 0, 0, 0, 0, -170]], label="car")
    stationary = box(7, [900], [[1, 1, 1, 5, 5, 5, 10, 20, 30]], stationary=True)
    gone = box("gone", [0, 49], np.ones((2, 9)))
    boxes = drive(annotations=(gone, moving, stationary)).samples()[0].boxes
    assert (boxes.ids, boxes.labels) == (("car", 7), ("car", None))
    np.testing.assert_allclose(boxes.centers_world, [[4, 0, 0], [5, 5, 5]])
    np.testing.assert_allclose(boxes.sizes_lwh, [[4, 2, 2], [1, 1, 1]])
    np.testing.assert_allclose(np.cos(boxes.yaws_world[0]), -1.0)
    # capital letters: about the rotated axes one after the other, which is Rx(10) Ry(20) Rz(30)
    expected = Rotation.from_euler("XYZ", [10, 20, 30], degrees=True).as_matrix()
    np.testing.assert_allclose(boxes.rotations_world[1], expected, atol=EXACT)


def test_arrays_name_each_box_and_number_it_alike_in_all_samples():
    row = np.array([4.0, 2.0, 1.5, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    annotations = box("early", [0, 100], [row, row], label="car"), box(7, [0, 400], [row, row])
    first, last = (drive(annotations=annotations).samples()[k].arrays() for k in (0, 3))
    assert first["boxes.track_ids"].tolist() == ["early", "7"]
    assert first["boxes.labels"].tolist() == ["car", ""]
    assert first["boxes.track_numbers"].tolist() == [0, 1]
    assert (last["boxes.track_ids"].tolist(), last["boxes.track_numbers"].tolist()) == (["7"], [1])
    assert {name: array.dtype for name, array in first.items()} == {name: array.dtype for name, array in last.items()}


def test_angles_of_boxes_are_read_as_the_metadata_state():
    stationary = box(7, [0], [[1, 1, 1, 0, 0, 0, 0.1, 0.2, 0.3]], stationary=True)
    metadata = {"sceneloom": {"euler_unit": "radians", "euler_order": "zyx"}}
    boxes = drive(annotations=(stationary,), metadata=metadata).samples()[0].boxes
    expected = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix()
    np.testing.assert_allclose(boxes.rotations_world[0], expected, atol=EXACT)
    assert len(drive().samples()[0].boxes) == 0


def test_arrays_have_the_same_names_and_dtypes_whether_an_image_is_there_or_not():
    scene = drive(lidar(), camera(), depth_camera())
    near, far = (scene.samples(tolerance_ns=t)[2].arrays() for t in (90 * MS, 10 * MS))
    assert {name: array.dtype for name, array in near.items()} == {n: a.dtype for n, a in far.items()}
    assert (near["camera0.found"], far["camera0.found"]) == (True, False)
    assert near["camera0.rgb"].shape == far["camera0.rgb"].shape == (3, 4, 3)
    assert not far["camera0.rgb"].any()
    assert np.isnan(far["camera0.camera_from_lidar"]).any() == np.False_, "the mountings are known"
    assert np.isnan(far["camera0.world_from_sensor"]).all()
    np.testing.assert_array_equal(near["depth0.depth"], np.full((3, 4), 2.5, np.float32))
    np.testing.assert_array_equal(far["depth0.depth"], np.zeros((3, 4), np.float32))
    np.testing.assert_array_equal(near["depth0.matrix"], [[2, 0, 1.5], [0, 2.5, 1], [0, 0, 1]])
    near["depth0.depth"][:] = 9
    assert scene.samples()[2].depth_frames["depth0"].depth.max() == 2.5


def test_arrays_are_what_the_sample_says_and_the_caller_s_own():
    samples = drive().samples()
    sample, arrays = samples[1], samples[1].arrays()
    np.testing.assert_array_equal(arrays["lidar.positions"], sample.sweep.points.positions)
    np.testing.assert_array_equal(arrays["lidar.intensities"], [1, 2, 3])
    np.testing.assert_array_equal(arrays["camera0.matrix"], [[2, 0, 1.5], [0, 2.5, 1], [0, 0, 1]])
    np.testing.assert_array_equal(arrays["camera0.coefficients"], [0.1, 0.02])
    np.testing.assert_array_equal(arrays["camera0.camera_from_points"], sample.camera_from_points["camera0"].matrix)
    assert arrays["timestamp_ns"] == 150 * MS
    assert arrays["camera0.time_ns"] == 160 * MS
    for array in arrays.values():
        assert array.flags.writeable
    arrays["lidar.positions"][:] = -1
    arrays["camera0.rgb"][:] = 99
    assert samples[1].sweep.points.positions.min() == 0
    assert samples[1].images["camera0"].rgb.max() == 2


def test_what_a_function_makes_of_samples_is_a_sequence_that_makes_nothing_before_it_is_asked():
    made = []
    numbers = drive().samples().map(lambda sample: made.append(sample.index) or sample.index * 10)
    assert len(numbers) == 4
    assert made == []
    assert (numbers[2], numbers[-1]) == (20, 30)
    assert list(numbers[::-2]) == [30, 10]
    assert made == [2, 3, 3, 1]
    assert drive().samples().map(Sample.arrays)[0]["index"] == 0


PERIOD = 100
TIMESTAMPS = st.lists(st.integers(0, 60), max_size=12)


def images_at(timestamps):
    return LazyFrames.of([CameraImage(t, CAMERA_MODEL, lambda: None) for t in timestamps], timestamps)


def sweep_at(start, times):
    points = LidarPoints(np.zeros((len(times), 3), np.float32), timestamps_ns=np.array(times, np.int64))
    return LidarFrame(start, points)


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
    finder = SweepsByReference(LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]), PERIOD)
    references = [frame.reference_ns for frame in frames]
    for wanted in times:
        answer = finder.find(wanted, tolerance)
        expected = nearest_of_all(references, wanted, tolerance)
        if expected is None:
            assert isinstance(answer, str)
        else:
            # of sweeps with one reference time any is as near as the other
            assert answer[1] == references[expected]
            assert answer[0].reference_ns == references[expected]


def test_a_sweep_in_the_middle_of_its_image_is_read_once_and_no_other():
    asked = []
    frames = [sweep_at(k * PERIOD, [k * PERIOD + 49, k * PERIOD + 50, k * PERIOD + 51]) for k in range(20)]

    def read(k):
        asked.append(k)
        return frames[k]

    finder = SweepsByReference(LazyFrames(np.arange(20, dtype=np.int64) * PERIOD, read), PERIOD)
    assert finder.find(12 * PERIOD + 55, PERIOD) == (frames[12], 12 * PERIOD + 50)
    assert asked == [12]


def test_point_times_that_count_from_the_timestamp_are_put_right_before_they_report_the_moment():
    frame, reference_ns = SweepsByReference(LazyFrames.of([sweep_at(1000, [5, 6, 7])], [1000]), PERIOD).read(0)
    assert reference_ns == 1006
    assert frame.points.timestamps_ns.tolist() == [1005, 1006, 1007]


def test_that_a_sensor_has_nothing_or_nothing_near_is_stated():
    assert FramesByTimestamp(images_at([])).find(0, 5) == "it has no frames"
    assert "0.000 s away" in FramesByTimestamp(images_at([9])).find(0, 5)
    assert SweepsByReference(LazyFrames.of([], []), PERIOD).find(0, 5) == "it has no frames"
