"""Scenes become recordings whose files hold what the description of the format says, and nothing else is touched."""

import gc
import io
import json
import struct
import weakref
from collections import Counter
from itertools import pairwise
from types import MappingProxyType

import av
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, CalibrationError, DataError, OptionError, OutputError, PoseError
from sceneloom.formats.recording.reader import open_recording
from sceneloom.formats.recording.writer import write_recording
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    AttributePath,
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    DepthCameraSensor,
    DepthFrame,
    GnssSensor,
    ImuSensor,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    OdometrySensor,
    PlainSensor,
    PointsFrame,
    Poses,
    RadarSensor,
    Scene,
    Trajectory,
    VectorSamples,
    VideoContent,
)

MS = 1_000_000
MODEL = "RoboSense M1 XYZIRT"
CAMERA = Camera("pinhole", 32, 16, 30.0, 31.0, 16.0, 8.0)
MOUNT = RigidTransform(Rotation.from_euler("zyx", [0.3, -0.2, 0.9]).as_matrix(), np.array([1.5, -0.2, 0.7]))


def times(count, *, start_ms=0, step_ms=100):
    return (np.arange(count, dtype=np.int64) * step_ms + start_ms) * MS


def image_rgb(index, width=32, height=16):
    return np.full((height, width, 3), (10 * index, 200 - 10 * index, 77), np.uint8)


def a_camera(name="camera0", *, timestamps=None, width=32, height=16, **fields):
    timestamps = times(4, start_ms=50) if timestamps is None else timestamps
    model = Camera("pinhole", width, height, 30.0, 31.0, width / 2, height / 2)
    images = [CameraImage.of(int(t), model, image_rgb(k, width, height)) for k, t in enumerate(timestamps)]
    return CameraSensor(name, model, LazyFrames.of(images, timestamps), **({"mount": MOUNT} | fields))


def shooting(decode, timestamps, **fields):
    """A camera whose image k is what `decode(k)` gives when it is asked for."""
    shots = [CameraImage(int(t), CAMERA, lambda k=k: decode(k)) for k, t in enumerate(timestamps)]
    return CameraSensor("camera0", CAMERA, LazyFrames.of(shots, timestamps), **({"mount": MOUNT} | fields))


def some_points(seed, start_ns, count=5):
    rng = np.random.default_rng(seed)
    return LidarPoints(
        positions=rng.normal(size=(count, 3)).astype(np.float32),
        intensities=rng.integers(0, 256, count).astype(np.uint8),
        timestamps_ns=start_ns + np.arange(count, dtype=np.int64) * 1234,
        rings=rng.integers(0, 65536, count).astype(np.uint16),
    )


def a_lidar(name="lidar", *, frames=None, **fields):
    frames = [LidarFrame(int(t), some_points(k, int(t))) for k, t in enumerate(times(3))] if frames is None else frames
    return LidarSensor(name, LazyFrames.of(frames, [f.timestamp_ns for f in frames]), **({"mount": MOUNT} | fields))


IMU_VALUES = np.random.default_rng(1).normal(size=(30, 3))


def an_imu(**streams):
    timestamps = times(30, start_ms=3, step_ms=10)
    both = {"accelerometer": IMU_VALUES, "gyroscope": -IMU_VALUES}
    return ImuSensor("imu", streams or {name: VectorSamples(timestamps, values) for name, values in both.items()})


def a_depth_camera(name="camera1"):
    frames = [DepthFrame(int(t), CAMERA, lambda: np.ones((16, 32), np.float32), 0.001) for t in times(3)]
    return DepthCameraSensor(name, CAMERA, LazyFrames.of(frames, times(3)), mount=MOUNT)


def a_gnss():
    lla = np.array([[60.173783793064594, 24.906486344581662, 14.18831106834269], [60.2, 24.9, 15.0]])
    return GnssSensor("gnss", times(2, start_ms=20), lla, np.array([4.0, np.nan]), np.array([np.nan, 2.5]))


def ego_path(count=6):
    rotations = Rotation.from_rotvec(np.linspace(0, 1, count)[:, None] * [0.0, 0.0, 1.0])
    positions = np.stack([np.arange(count, dtype=float), np.zeros(count), np.zeros(count)], axis=1)
    return Poses(times(count), positions, rotations.as_quat())


def a_trajectory(name="groundTruth"):
    path = ego_path()
    return Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)


def a_scene(*sensors, trajectories=(), **fields):
    return Scene(sensors, trajectories={t.name: t for t in trajectories}, **fields)


def whole_scene():
    return a_scene(a_lidar(), a_camera(), a_camera("camera1"), an_imu(), a_gnss(), trajectories=[a_trajectory()])


def lines_of(folder):
    return [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]


def records_of(path):
    return list(struct.iter_unpack("<fffBHd", path.read_bytes()))


def losses_of(report):
    """What is lost, without what the vendor's software makes of it."""
    return {loss.field: loss.what for loss in report if loss.field != "replay"}


def replay_of(report):
    return {loss.what: loss.count for loss in report if loss.field == "replay"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A folder with all of a whole scene, and what was lost."""
    folder = tmp_path_factory.mktemp("whole") / "drive"
    return folder, write_recording(whole_scene(), folder)


def test_lines_are_sorted_and_each_says_one_thing_in_the_format_s_words(whole):
    lines = lines_of(whole[0])
    timestamps = [line["time"] for line in lines]
    assert timestamps == sorted(timestamps)
    assert Counter(next(iter(line)) for line in lines) == {
        "groundTruth": 6,
        "sensor": 60,
        "gps": 2,
        "lidar": 3,
        "frames": 4,
    }
    frames = [line for line in lines if "frames" in line]
    assert [line["number"] for line in frames] == [0, 1, 2, 3]
    entries = [{"cameraInd": 0, "time": 0.15}, {"cameraInd": 1, "time": 0.15}]
    assert frames[1] == {"frames": entries, "number": 1, "time": 0.15}
    gyroscope = [line for line in lines if line.get("sensor", {}).get("type") == "gyroscope"]
    assert gyroscope[4] == {"sensor": {"type": "gyroscope", "values": (-IMU_VALUES[4]).tolist()}, "time": 0.043}
    fix = {"latitude": 60.173783793064594, "longitude": 24.906486344581662, "altitude": 14.18831106834269}
    assert [line for line in lines if "gps" in line] == [
        {"gps": {**fix, "accuracy": 4.0}, "time": 0.02},
        {"gps": {"latitude": 60.2, "longitude": 24.9, "altitude": 15.0, "verticalAccuracy": 2.5}, "time": 0.12},
    ]
    pose = [line for line in lines if "groundTruth" in line][3]["groundTruth"]
    assert pose["position"] == {"x": 3.0, "y": 0.0, "z": 0.0}
    # a rotation by 0.6 rad about z
    assert pose["orientation"] == pytest.approx({"x": 0, "y": 0, "z": np.sin(0.3), "w": np.cos(0.3)}, abs=1e-15)
    sweeps = [line for line in lines if "lidar" in line]
    assert sweeps[2] == {"lidar": {"model": MODEL, "dataFile": "lidar/000002.bin"}, "time": 0.2}
    changed = "encoded as H.264, which changes colours a little"
    assert losses_of(whole[1]) == {f"sensors[camera{k}].images[].rgb": changed for k in range(2)}


def test_a_sweep_is_a_file_of_packed_records(whole):
    points = some_points(2, 200 * MS)
    records = records_of(whole[0] / "lidar" / "000002.bin")
    for row, (x, y, z, intensity, ring, seconds) in enumerate(records):
        assert (np.float32([x, y, z]) == points.positions[row]).all()
        assert (intensity, ring) == (points.intensities[row], points.rings[row])
        assert round(seconds * 1e9) == points.timestamps_ns[row]
    assert len(records) == 5


def calibration_of(folder):
    return json.loads((folder / "calibration.json").read_text())


def test_the_calibration_takes_points_of_the_imu_into_the_sensors(whole):
    calibration = calibration_of(whole[0])
    expected = np.linalg.inv(np.vstack([np.column_stack([MOUNT.rotation, MOUNT.translation]), [0, 0, 0, 1]]))
    assert len(calibration["cameras"]) == 2
    np.testing.assert_allclose(calibration["cameras"][1]["imuToCamera"], expected, atol=1e-15)
    np.testing.assert_allclose(calibration["lidars"][0]["imuToLidar"], expected, atol=1e-15)
    assert calibration["lidars"][0]["model"] == MODEL
    assert (calibration["cameras"][0]["imageWidth"], calibration["cameras"][0]["imageHeight"]) == (32, 16)


def read_video(path):
    capture, images = cv2.VideoCapture(str(path)), []
    while (found := capture.read())[0]:
        images.append(found[1][:, :, ::-1])
    return images


def test_videos_are_h264_with_one_image_per_frames_line(whole):
    for name in ("data.mkv", "data2.mkv"):
        with av.open(str(whole[0] / name)) as container:
            assert container.streams.video[0].codec_context.name == "h264"
        images = read_video(whole[0] / name)
        assert len(images) == 4
        for index, rgb in enumerate(images):
            # flat colours survive but for rounding, 1 to 3 levels
            assert np.abs(rgb.astype(int) - image_rgb(index)).max() <= 4


def test_png_images_lose_nothing(tmp_path):
    report = write_recording(whole_scene(), tmp_path / "drive", images="png")
    assert len(report) == 0
    assert not list((tmp_path / "drive").glob("*.mkv"))
    for folder in ("frames1", "frames2"):
        names = sorted(path.name for path in (tmp_path / "drive" / folder).iterdir())
        assert names == [f"{index:08d}.png" for index in range(4)]
        for index, name in enumerate(names):
            bgr = cv2.imread(str(tmp_path / "drive" / folder / name))
            np.testing.assert_array_equal(bgr[:, :, ::-1], image_rgb(index))


def test_odd_images_lose_a_line_in_h264_and_report_it(tmp_path):
    report = write_recording(a_scene(a_camera(width=33, height=17)), tmp_path / "drive")
    assert "cut from 33x17 to 32x16: H.264 needs even sizes" in [loss.what for loss in report]
    entry = calibration_of(tmp_path / "drive")["cameras"][0]
    assert (entry["imageWidth"], entry["imageHeight"]) == (32, 16)
    # the upper left corner stays where it is, so the principal point does
    assert (entry["principalPointX"], entry["principalPointY"]) == (16.5, 8.5)
    assert read_video(tmp_path / "drive" / "data.mkv")[0].shape == (16, 32, 3)


def encoded(tmp_path, codec="libx264", count=4, container="mkv"):
    path = tmp_path / f"{codec}.{container}"
    with av.open(str(path), "w") as output:
        stream = output.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuv420p"
        for index in range(count):
            output.mux(stream.encode(av.VideoFrame.from_ndarray(image_rgb(index), format="rgb24")))
        output.mux(stream.encode(None))
    return path


def packets_of(path):
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


@pytest.mark.parametrize(
    ("codec", "name", "container", "images", "copied"),
    [
        ("libx264", "h264", "mkv", "copy", True),
        ("libx264", "h264", "mkv", "h264", True),
        ("libx264", "h264", "mp4", "h264", True),
        ("libx265", "hevc", "mp4", "h264", True),
        ("ffv1", "ffv1", "mkv", "copy", True),
        ("ffv1", "ffv1", "mkv", "h264", False),
    ],
)
def test_a_camera_s_own_video_is_copied_packet_by_packet(tmp_path, codec, name, container, images, copied):
    path, written = encoded(tmp_path, codec, container=container), tmp_path / "drive" / "data.mkv"
    video = VideoContent(lambda: io.BytesIO(path.read_bytes()), name)
    options = {} if container == "mp4" else {"images": images}
    report = write_recording(a_scene(a_camera(video=video)), tmp_path / "drive", **options)
    assert (packets_of(written) == packets_of(path)) == copied
    assert (not losses_of(report)) == copied
    assert len(read_video(written)) == 4
    assert written.read_bytes()[:4] == bytes.fromhex("1a45dfa3")
    assert (written.read_bytes() == path.read_bytes()) == (copied and container == "mkv")


def files_of(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_same_scene_gives_the_same_files_and_a_recording_can_take_its_own_location(tmp_path):
    for name in ("first", "drive"):
        write_recording(whole_scene(), tmp_path / name)
    before = files_of(tmp_path / "drive")
    assert len(before) == 7
    assert files_of(tmp_path / "first") == before
    with open_recording(tmp_path / "drive") as scene:
        write_recording(scene, tmp_path / "drive", overwrite=True)
    assert files_of(tmp_path / "drive") == before


def test_a_video_of_which_not_all_images_belong_to_the_camera_is_encoded(tmp_path):
    path = encoded(tmp_path, count=6)
    content = VideoContent(lambda: path.open("rb"), "h264", frame_indices=(0, 1, 2, 4))
    write_recording(a_scene(a_camera(video=content)), tmp_path / "some")
    write_recording(a_scene(a_camera(video=VideoContent(content.open, "h264"))), tmp_path / "too many")
    for name in ("some", "too many"):
        assert len(read_video(tmp_path / name / "data.mkv")) == 4


def test_a_camera_out_of_step_repeats_an_image_and_one_a_little_apart_keeps_its_times(tmp_path):
    second = a_camera("camera1", timestamps=times(4, start_ms=50)[[0, 2, 3]])
    report = write_recording(a_scene(a_camera(), second), tmp_path / "drive", images="png")
    frames = [line["frames"] for line in lines_of(tmp_path / "drive")]
    assert [entries[1].get("missingBitmap", False) for entries in frames] == [False, True, False, False]
    assert all([entry["cameraInd"] for entry in entries] == [0, 1] for entries in frames)
    written = [cv2.imread(str(path))[0, 0, 2] for path in sorted((tmp_path / "drive" / "frames2").iterdir())]
    assert written == [0, 0, 10, 20]
    ((field, what),) = losses_of(report).items()
    assert field == "sensors[camera1].images"
    assert "not in step" in what
    second = a_camera("camera1", timestamps=times(4, start_ms=50) - 7 * MS)
    write_recording(a_scene(a_camera(), second), tmp_path / "apart", images="png")
    entries = [{"cameraInd": 0, "time": 0.05}, {"cameraInd": 1, "time": 0.043}]
    assert lines_of(tmp_path / "apart")[0] == {"frames": entries, "number": 0, "time": 0.043}


def test_an_image_s_own_camera_model_and_mounting_stand_in_its_line(tmp_path):
    own, here = Camera("fisheye", 32, 16, 40.0, 41.0, 15.0, 7.0, (0.1, 0.2, 0.3, 0.4)), RigidTransform.identity()
    images = [CameraImage.of(0, CAMERA, image_rgb(0)), CameraImage(100 * MS, own, lambda: image_rgb(1), mount=here)]
    camera = CameraSensor("camera0", CAMERA, LazyFrames.of(images, [0, 100 * MS]), mount=MOUNT)
    write_recording(a_scene(camera), tmp_path / "drive", images="png")
    first, second = (line["frames"][0] for line in lines_of(tmp_path / "drive"))
    assert set(first) == {"cameraInd", "time"}
    numbers = {"focalLengthX": 40.0, "focalLengthY": 41.0, "principalPointX": 15.0, "principalPointY": 7.0}
    distortion = {"distortionModel": "kannala-brandt4", "distortionCoefficients": [0.1, 0.2, 0.3, 0.4]}
    assert second["cameraParameters"] == {**distortion, **numbers}
    assert second["imuToCamera"] == np.eye(4).tolist()


def test_several_lidars_are_distinguished_by_an_index(tmp_path):
    write_recording(a_scene(a_lidar("lidar0"), a_lidar("lidar1")), tmp_path / "drive")
    first, second, *_ = (line["lidar"] for line in lines_of(tmp_path / "drive"))
    assert first == {"model": MODEL, "dataFile": "lidar/000000.bin"}
    assert second == {"model": MODEL, "dataFile": "lidar2/000000.bin", "lidarInd": 1}
    assert [lidar.get("lidarInd") for lidar in calibration_of(tmp_path / "drive")["lidars"]] == [None, 1]
    assert (tmp_path / "drive" / "lidar2" / "000002.bin").stat().st_size == 5 * 23


def test_what_points_lack_is_filled_and_what_they_have_too_much_is_named(tmp_path):
    bare, zeros = LidarPoints(np.ones((4, 3), np.float32)), np.zeros(2, np.int64)
    told = {"intensities": zeros.astype(np.uint8), "timestamps_ns": zeros, "rings": zeros.astype(np.uint16)}
    extras = {"colors": np.zeros((2, 3), np.uint8), "extras": MappingProxyType({"echo": np.zeros(2)})}
    rich = LidarPoints(np.ones((2, 3), np.float32), **told, **extras)
    lidar = a_lidar(frames=[LidarFrame(0, bare), LidarFrame(100 * MS, rich)])
    report = write_recording(a_scene(lidar), tmp_path / "drive")
    points = "sensors[lidar].frames[].points"
    counts = {"intensities": 4, "rings": 4, "timestamps_ns": 4, "colors": 2, "echo": 2}
    assert {loss.field: loss.count for loss in report} == {f"{points}.{name}": n for name, n in counts.items()}
    assert records_of(tmp_path / "drive" / "lidar" / "000000.bin")[3] == (1.0, 1.0, 1.0, 0, 0, 0.0)


def world_lidar(**fields):
    """A lidar whose points were brought into the world, each at its own time, and the points before that."""
    timestamps = 120 * MS + np.arange(5, dtype=np.int64) * 17 * MS
    positions = np.random.default_rng(7).normal(size=(5, 3)) * 20
    moving = ego_path().interpolate(timestamps)
    egos = map(RigidTransform.from_quaternion, moving.positions, moving.quaternions_xyzw)
    world = [(ego @ MOUNT).apply(position) for ego, position in zip(egos, positions, strict=True)]
    bare = {"timestamps_ns": timestamps, "rings": np.zeros(5, np.uint16)}
    points = LidarPoints(np.array(world, np.float32), np.zeros(5, np.uint8), **bare)
    return a_lidar(frames=[LidarFrame(120 * MS, points)], points_frame=PointsFrame.WORLD, **fields), positions


def mounted_path():
    path = ego_path()
    poses = [
        RigidTransform.from_quaternion(*pose) @ MOUNT
        for pose in zip(path.positions, path.quaternions_xyzw, strict=True)
    ]
    positions = np.array([pose.translation for pose in poses])
    return Poses(path.timestamps_ns, positions, np.array([pose.quaternion_xyzw for pose in poses]))


def positions_in(path):
    return np.array([record[:3] for record in records_of(path)])


@pytest.mark.parametrize("known", ["the trajectory and the mounting", "the lidar's own poses", "an odometry sensor"])
def test_points_in_the_world_are_brought_back_to_where_each_was_measured(tmp_path, known):
    tolerance = 2e-5  # float32 at 20 m
    if known == "the lidar's own poses":
        lidar, positions = world_lidar(poses=mounted_path())
        scene = a_scene(lidar)
        # between poses 0.2 rad apart the lidar, 1.5 m from the axis, takes the chord: 1.5 m (1 - cos 0.1) inside
        tolerance = 8e-3
    else:
        lidar, positions = world_lidar()
        odometry = OdometrySensor("ego", ego_path())
        scene = a_scene(lidar, odometry) if "odometry" in known else a_scene(lidar, trajectories=[a_trajectory()])
    write_recording(scene, tmp_path / "drive")
    np.testing.assert_allclose(positions_in(tmp_path / "drive" / "lidar" / "000000.bin"), positions, atol=tolerance)


@pytest.mark.parametrize("aside", [0.0, 1.0])
def test_a_lidars_own_poses_count_unless_the_trajectory_says_the_same_and_more(tmp_path, aside):
    path = mounted_path()
    lidar, positions = world_lidar(poses=path.moved(np.array([aside, 0.0, 0.0])))
    write_recording(a_scene(lidar, trajectories=[a_trajectory()]), tmp_path / "drive")
    back = positions_in(tmp_path / "drive" / "lidar" / "000000.bin")
    off = np.linalg.norm(back - positions, axis=1)
    assert off.max() < 2e-5 if aside == 0 else off.min() > 0.9


def test_points_on_the_ego_are_brought_back_by_the_mounting(tmp_path):
    positions = np.random.default_rng(7).normal(size=(5, 3)) * 20
    points = LidarPoints(MOUNT.apply(positions).astype(np.float32))
    write_recording(a_scene(a_lidar(frames=[LidarFrame(0, points)], points_frame=PointsFrame.EGO)), tmp_path / "drive")
    np.testing.assert_allclose(positions_in(tmp_path / "drive" / "lidar" / "000000.bin"), positions, atol=2e-5)


FAR = Poses(times(2, start_ms=5000), np.zeros((2, 3)), np.array([[0.0, 0, 0, 1]] * 2))


@pytest.mark.parametrize(
    ("sensors", "error", "problem"),
    [
        (lambda: [world_lidar()[0]], PoseError, "lidar 'lidar': its points are in the world"),
        (lambda: [world_lidar(poses=FAR)[0]], PoseError, "sweep at 120000000 ns: no pose for 5 of its points"),
        (lambda: [a_camera("front", mount=None)], CalibrationError, "camera 'front': nothing says how it is mounted"),
        (list, DataError, "holds nothing that a recording could hold"),
    ],
)
def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path, sensors, error, problem):
    with pytest.raises(error, match=problem):
        write_recording(a_scene(*sensors()), tmp_path / "drive")
    assert list(tmp_path.iterdir()) == []


def test_a_lidar_whose_mounting_is_unknown_is_taken_to_be_the_ego(tmp_path):
    report = write_recording(a_scene(a_lidar(mount=None)), tmp_path / "drive")
    assert "where the IMU is" in losses_of(report)["sensors[lidar].mount"]
    assert calibration_of(tmp_path / "drive")["lidars"][0]["imuToLidar"] == np.eye(4).tolist()


def test_what_a_recording_cannot_hold_is_named_field_by_field(tmp_path):
    box = CuboidAnnotation("car", CuboidPath(np.zeros(1, np.int64), np.ones((1, 9))))
    radar = RadarSensor("radar", LazyFrames.of([], []))
    scene = a_scene(
        *(an_imu(), ImuSensor("second", {}), radar, PlainSensor("odd", "sonar", {})),
        annotations=(box,),
        attributes=(AttributePath("weather", ()),),
        metadata={"city": "Turku", "recording": {}},
        extras={"future": 1},
    )
    lost = ("annotations", "attributes", "metadata.city", "extras.future", "sensors[radar]", "sensors[odd]")
    assert losses_of(write_recording(scene, tmp_path / "drive")) == {
        **dict.fromkeys(lost, "left out: the format has none"),
        "sensors[second]": "left out: the format has one imu only",
    }


def test_ids_that_the_format_forgets_are_named(tmp_path):
    report = write_recording(a_scene(a_camera("front"), a_lidar("roof")), tmp_path / "drive", images="png")
    assert losses_of(report) == {
        "sensors[front].id": "read back as 'camera0'",
        "sensors[roof].id": "read back as 'lidar'",
        "sensors": "read back in another order: lidars, cameras, those of depth last, IMU, satellite receivers",
    }


def test_samples_that_json_or_the_format_cannot_hold_are_left_out_and_counted(tmp_path):
    values = np.ones((4, 3))
    values[2, 1] = np.nan
    lla = np.array([[60.0, 24.0, np.nan], [60.0, 24.0, 3.0]])
    imu = an_imu(accelerometer=VectorSamples(times(4), values), gyroscope=VectorSamples(times(4), np.ones((4, 2))))
    gnss = GnssSensor("gnss", times(2), lla, np.ones(2), np.ones(2))
    report = write_recording(a_scene(imu, gnss), tmp_path / "drive")
    assert {loss.field: loss.count for loss in report} == {
        "sensors[imu].streams[accelerometer]": 1,
        "sensors[imu].streams[gyroscope]": 4,
        "sensors[gnss]": 1,
    }
    assert len(lines_of(tmp_path / "drive")) == 3 + 1


def test_trajectories_go_under_their_name_but_where_the_format_means_something_else(tmp_path):
    for name, root, inner in (
        ("groundTruth", "groundTruth", None),
        ("arkit", "arkit", None),
        ("pose", "pose", None),
        ("lidar", "pose", "lidar"),
        ("time", "pose", "time"),
    ):
        write_recording(a_scene(trajectories=[a_trajectory(name)]), tmp_path / name)
        line = lines_of(tmp_path / name)[0]
        assert set(line) == {root, "time"}
        assert line[root].get("name") == inner
    # an odometry sensor becomes a trajectory unless it is one
    odometry = OdometrySensor("ego", ego_path())
    for name, trajectories in (("groundTruth", [a_trajectory()]), ("ego", [])):
        write_recording(a_scene(odometry, trajectories=trajectories), tmp_path / "with odometry", overwrite=True)
        assert {key for line in lines_of(tmp_path / "with odometry") for key in line} == {name, "time"}


def test_the_loss_of_64_bit_numbers_of_seconds_is_reported(tmp_path):
    timestamps = np.array([1_700_000_000_123_456_789, 1_700_000_001_000_000_000], np.int64)
    imu = an_imu(gyroscope=VectorSamples(timestamps, np.ones((2, 3))))
    (loss,) = write_recording(a_scene(imu), tmp_path / "drive")
    assert (loss.field, loss.count) == ("timestamps", 1)
    assert '"time":1700000000.123456789' in (tmp_path / "drive" / "data.jsonl").read_text()


def test_what_a_recording_stated_beside_is_written_back(tmp_path):
    timestamps = np.array([0, 10 * MS], np.int64)
    text = '{"sensor": {"type": "gyroscope", "values": [9], "bias": 1}, "time": 1, "note": "x"}'
    notes = {
        "calibration": {"imuForward": [1, 0, 0], "cameras": [{"model": "old"}]},
        "vio_config": "useStereo: true\n",
        "other_lines": ['{"barometer": {"pressure": 1013}, "time": 0.005}', '{"sdkVersion": "1.2"}'],
        "further_keys": {"imu.gyroscope": {"10000000": text}},
        "trajectory_origins": {"pose:lidar": ["pose", "lidar"]},
    }
    scene = a_scene(
        an_imu(gyroscope=VectorSamples(timestamps, np.ones((2, 3)))),
        trajectories=[Trajectory("pose:lidar", timestamps[:1] + 20 * MS, np.zeros((1, 3)))],
        metadata={"recording": notes},
    )
    assert len(write_recording(scene, tmp_path / "drive")) == 0
    assert lines_of(tmp_path / "drive") == [
        {"sdkVersion": "1.2"},
        {"sensor": {"type": "gyroscope", "values": [1, 1, 1]}, "time": 0.0},
        {"barometer": {"pressure": 1013}, "time": 0.005},
        {"sensor": {"type": "gyroscope", "values": [1, 1, 1], "bias": 1}, "note": "x", "time": 0.01},
        {"pose": {"name": "lidar", "position": {"x": 0, "y": 0, "z": 0}}, "time": 0.02},
    ]
    assert (tmp_path / "drive" / "vio_config.yaml").read_text() == "useStereo: true\n"
    calibration = json.loads((tmp_path / "drive" / "calibration.json").read_text())
    assert calibration == {"imuForward": [1, 0, 0], "cameras": []}


def test_a_camera_without_images_is_calibrated_alone_and_left_out_beside_others(tmp_path):
    empty = a_camera("camera1", timestamps=times(0))
    report = write_recording(a_scene(a_camera(), empty), tmp_path / "both", images="png")
    assert "has no images" in losses_of(report)["sensors[camera1]"]
    assert len(calibration_of(tmp_path / "both")["cameras"]) == 1
    write_recording(a_scene(a_lidar(), empty), tmp_path / "alone")
    assert len(calibration_of(tmp_path / "alone")["cameras"]) == 1
    assert not list((tmp_path / "alone").glob("*.mkv"))


@pytest.mark.parametrize("images", ["jpeg", ""])
def test_an_unknown_way_of_keeping_images_is_refused(tmp_path, images):
    with pytest.raises(OptionError, match="expected one of: copy, lossless, h264, ffv1, png"):
        write_recording(whole_scene(), tmp_path / "drive", images=images)


def test_an_existing_recording_is_replaced_only_on_request_and_whole_but_for_its_readme(tmp_path):
    folder = tmp_path / "drive"
    folder.mkdir()
    write_recording(whole_scene(), folder, overwrite=True)
    with pytest.raises(OutputError, match="exists already"):
        write_recording(a_scene(an_imu()), folder)
    # without cameras and lidars there is no calibration
    write_recording(a_scene(an_imu()), folder, overwrite=True)
    assert [path.name for path in folder.iterdir()] == ["data.jsonl"]
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]
    (folder / "README.md").write_text("from the attic")
    write_recording(a_scene(a_camera()), folder, overwrite=True)
    assert (folder / "README.md").read_text() == "from the attic"


@pytest.mark.parametrize("names", [["thesis.odt"], ["data.jsonl", "thesis.odt"], ["calibration.json"]])
def test_somebody_s_folder_is_never_replaced(tmp_path, names):
    folder = tmp_path / "drive"
    folder.mkdir()
    for name in names:
        (folder / name).write_text("mine")
    with pytest.raises(OutputError, match="no recording that could be replaced"):
        write_recording(whole_scene(), folder, overwrite=True)
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="is a file"):
        write_recording(a_scene(an_imu()), tmp_path / "file", overwrite=True)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("images", ["copy", "h264", "png", "ffv1"])
def test_a_failure_in_the_middle_leaves_what_was_there_and_nothing_new(tmp_path, images):
    def interrupted(k):
        if k == 2:
            raise KeyboardInterrupt
        return image_rgb(k)

    write_recording(a_scene(an_imu()), tmp_path / "drive")
    before = (tmp_path / "drive" / "data.jsonl").read_bytes()
    camera = shooting(lambda k: image_rgb(k, 32, 16 if k < 2 else 14), times(4))
    with pytest.raises(ArrayError, match=r"image.*\(14, 32, 3\)"):
        write_recording(a_scene(camera), tmp_path / "drive", overwrite=True, images=images)
    with pytest.raises(KeyboardInterrupt):
        write_recording(a_scene(shooting(interrupted, times(4)), a_lidar()), tmp_path / "new", images=images)
    assert (tmp_path / "drive" / "data.jsonl").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]


@pytest.mark.parametrize("images", ["copy", "png", "ffv1"])
def test_frames_and_images_are_asked_for_in_the_order_of_time_and_no_more_than_one_of_each_sensor_is_held(
    tmp_path, images
):
    alive, most, asked = {"lidar": 0, "image": 0}, {"lidar": 0, "image": 0}, []

    def born(kind, timestamp, array):
        asked.append((kind, int(timestamp)))
        alive[kind] += 1
        most[kind] = max(most[kind], alive[kind])
        weakref.finalize(array, lambda: alive.__setitem__(kind, alive[kind] - 1))
        return array

    sweeps, shots = times(40), times(40, start_ms=50)

    def sweep(k):
        points = some_points(k, int(sweeps[k]))
        born("lidar", sweeps[k], points.positions)
        return LidarFrame(int(sweeps[k]), points)

    camera = shooting(lambda k: born("image", shots[k], image_rgb(k)), shots)
    lidar = LidarSensor("lidar", LazyFrames(sweeps, sweep), mount=MOUNT)
    write_recording(a_scene(lidar, camera), tmp_path / "drive", images=images)
    gc.collect()
    # the one before is let go when the next is there; a camera keeps its last image for lines without one
    assert most == {"lidar": 2, "image": 2}
    assert alive == {"lidar": 0, "image": 0}
    assert Counter(kind for kind, _ in asked) == {"lidar": 40, "image": 40}
    # a merge looks one line ahead in every stream, and no farther
    assert all(later > earlier - 101 * MS for (_, earlier), (_, later) in pairwise(asked))


def test_further_fields_of_sweeps_are_reported_as_lost(tmp_path):
    stated = MappingProxyType({"left_skewed": "in a gap", "dataFile": "0.bin", "file_seconds": 0.0})
    frames = [LidarFrame(0, some_points(0, 0), stated), LidarFrame(100 * MS, some_points(1, 100 * MS))]
    scene = Scene(sensors=(a_lidar("top", frames=frames), a_camera()))
    lost = {loss.field: loss.count for loss in write_recording(scene, tmp_path / "drive")}
    assert lost["sensors[top].frames[].left_skewed"] == 1
    assert not [field for field in lost if "dataFile" in field or "file_seconds" in field]


@pytest.mark.parametrize("location", ["repaired", "lidar/repaired", "frames1/../repaired"])
def test_no_recording_is_written_into_another(tmp_path, location):
    outer = tmp_path / "drive"
    write_recording(whole_scene(), outer)
    before = sorted(outer.rglob("*"))
    with pytest.raises(OutputError, match="inside the recording"):
        write_recording(a_scene(an_imu()), outer / location)
    assert sorted(outer.rglob("*")) == before


NO_IMU = "the vendor's software gives no output without accelerometer and gyroscope"
ACCELEROMETER = VectorSamples(times(60, start_ms=1, step_ms=5), np.ones((60, 3)))
EXACT = (
    "images have exactly the times of IMU samples, which makes the vendor's diagnosis suspect that their times "
    "were not measured; they are written as they are"
)
FIRST_TWO = "the vendor's software uses the first two cameras, not camera2"
DEPTH_FIRST = "the vendor's software tracks in the first camera, and camera0 measures depth"


@pytest.mark.parametrize(
    ("sensors", "expected"),
    [
        ((a_camera(), a_camera("camera1"), an_imu()), {}),
        ((a_camera(), a_depth_camera(), an_imu()), {}),
        ((a_camera(),), {NO_IMU: 1}),
        (
            (a_camera(), an_imu(accelerometer=ACCELEROMETER)),
            {"the vendor's software gives no output without gyroscope": 1},
        ),
        ((a_lidar("lidar"),), {}),
        ((a_camera(timestamps=times(3, start_ms=3)), an_imu()), {EXACT: 3}),
        ((a_camera(), a_camera("camera1"), a_camera("camera2"), an_imu()), {FIRST_TWO: 1}),
        (
            (a_lidar("lidar0"), a_lidar("lidar1")),
            {"the vendor's software does not report lidars apart (`lidarInd`)": 2},
        ),
        ((a_depth_camera("camera0"), an_imu()), {DEPTH_FIRST: 1}),
    ],
)
def test_what_will_not_be_replayed_is_named(tmp_path, sensors, expected):
    assert replay_of(write_recording(a_scene(*sensors), tmp_path / "drive", images="png")) == expected


def test_settings_that_are_not_publicly_known_are_named(tmp_path):
    metadata = {"recording": {"vio_config": "useStereo: True\nsparkle: 3\n"}}
    scene = a_scene(a_camera(), an_imu(), metadata=metadata, format="recording")
    known = "the vendor's software may stop at settings that are not publicly known: sparkle"
    assert replay_of(write_recording(scene, tmp_path / "drive")) == {known: 1}
    assert (tmp_path / "drive" / "vio_config.yaml").read_text() == "useStereo: True\nsparkle: 3\n"
