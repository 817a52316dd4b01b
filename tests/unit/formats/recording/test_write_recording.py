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
import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import scene as sc
from sceneloom.cameras import Camera, project_unbounded, unproject
from sceneloom.cameras.camera import MODELS
from sceneloom.editing import crop_scene, thin_scene
from sceneloom.errors import ArrayError, CalibrationError, DataError, OptionError, OutputError, PoseError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.poses import mounting
from sceneloom.formats.recording.contents import CameraParameters, camera_model, rigid_transform
from sceneloom.formats.recording.reader import open_recording
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.formats.recording.writer import camera_model_entry, to_steps, write_recording
from sceneloom.geometry.rigid import RigidTransform

MS = 1_000_000
MODEL = "RoboSense M1 XYZIRT"
CAMERA = Camera("pinhole", 32, 16, 30.0, 31.0, 16.0, 8.0)
MOUNT = RigidTransform(Rotation.from_euler("zyx", [0.3, -0.2, 0.9]).as_matrix(), np.array([1.5, -0.2, 0.7]))
HERE = RigidTransform.identity()


def times(count, *, start_ms=0, step_ms=100):
    return (np.arange(count, dtype=np.int64) * step_ms + start_ms) * MS


def image_rgb(index, width=32, height=16):
    return np.full((height, width, 3), (10 * index, 200 - 10 * index, 77), np.uint8)


def a_camera(name="camera0", *, timestamps=None, width=32, height=16, **fields):
    timestamps = times(4, start_ms=50) if timestamps is None else timestamps
    model = Camera("pinhole", width, height, 30.0, 31.0, width / 2, height / 2)
    images = [sc.CameraImage.of(int(t), model, image_rgb(k, width, height)) for k, t in enumerate(timestamps)]
    return sc.CameraSensor(name, model, sc.LazyFrames.of(images, timestamps), **({"mount": MOUNT} | fields))


def shooting(decode, timestamps, **fields):
    """A camera whose image k is what `decode(k)` gives when it is asked for."""
    shots = [sc.CameraImage(int(t), CAMERA, lambda k=k: decode(k)) for k, t in enumerate(timestamps)]
    return sc.CameraSensor("camera0", CAMERA, sc.LazyFrames.of(shots, timestamps), **({"mount": MOUNT} | fields))


def some_points(seed, start_ns, count=5):
    rng = np.random.default_rng(seed)
    return sc.LidarPoints(
        positions=rng.normal(size=(count, 3)).astype(np.float32),
        intensities=rng.integers(0, 256, count).astype(np.uint8),
        timestamps_ns=start_ns + np.arange(count, dtype=np.int64) * 1234,
        rings=rng.integers(0, 65536, count).astype(np.uint16),
    )


def a_lidar(name="lidar", *, frames=None, **fields):
    frames = (
        [sc.LidarFrame(int(t), some_points(k, int(t))) for k, t in enumerate(times(3))] if frames is None else frames
    )
    return sc.LidarSensor(
        name, sc.LazyFrames.of(frames, [f.timestamp_ns for f in frames]), **({"mount": MOUNT} | fields)
    )


IMU_VALUES = np.random.default_rng(1).normal(size=(30, 3))


def an_imu(**streams):
    timestamps = times(30, start_ms=3, step_ms=10)
    both = {"accelerometer": IMU_VALUES, "gyroscope": -IMU_VALUES}
    return sc.ImuSensor("imu", streams or {name: sc.VectorSamples(timestamps, values) for name, values in both.items()})


def a_depth_camera(name="camera1"):
    frames = [sc.DepthFrame(int(t), CAMERA, lambda: np.ones((16, 32), np.float32), 0.001) for t in times(3)]
    return sc.DepthCameraSensor(name, CAMERA, sc.LazyFrames.of(frames, times(3)), mount=MOUNT)


def ego_path(count=6):
    rotations = Rotation.from_rotvec(np.linspace(0, 1, count)[:, None] * [0.0, 0.0, 1.0])
    positions = np.stack([np.arange(count, dtype=float), np.zeros(count), np.zeros(count)], axis=1)
    return sc.Poses(times(count), positions, rotations.as_quat())


def a_trajectory(name="groundTruth"):
    path = ego_path()
    return sc.Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)


def a_scene(*sensors, trajectories=(), **fields):
    return sc.Scene(sensors, trajectories={t.name: t for t in trajectories}, **fields)


def whole_scene():
    lla = np.array([[60.173783793064594, 24.906486344581662, 14.18831106834269], [60.2, 24.9, 15.0]])
    gnss = sc.GnssSensor("gnss", times(2, start_ms=20), lla, np.array([4.0, np.nan]), np.array([np.nan, 2.5]))
    return a_scene(a_lidar(), a_camera(), a_camera("camera1"), an_imu(), gnss, trajectories=[a_trajectory()])


def lines_of(folder):
    return [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]


def entries_of(folder):
    return [line["frames"] for line in lines_of(folder)]


def records_of(path):
    return list(struct.iter_unpack("<fffBHd", path.read_bytes()))


def calibration_of(folder):
    return json.loads((folder / "calibration.json").read_text())


def losses_of(report):
    """What is lost, without what the vendor's software makes of it."""
    return {loss.field: loss.what for loss in report if loss.field != "replay"}


def test_a_scene_becomes_sorted_lines_packed_sweeps_videos_and_a_calibration_from_the_imu_into_the_sensors(tmp_path):
    folder, changed = tmp_path / "drive", "encoded as H.264, which changes colours a little"
    losses = losses_of(write_recording(whole_scene(), folder))
    assert losses == {f"sensors[camera{k}].images[].rgb": changed for k in range(2)}
    lines = lines_of(folder)
    timestamps = [line["time"] for line in lines]
    assert timestamps == sorted(timestamps)
    counts = {"groundTruth": 6, "sensor": 60, "gps": 2, "lidar": 3, "frames": 4}
    assert Counter(next(iter(line)) for line in lines) == counts
    of = {name: [line for line in lines if name in line] for name in counts}
    assert [line["number"] for line in of["frames"]] == [0, 1, 2, 3]
    entries = [{"cameraInd": 0, "time": 0.15}, {"cameraInd": 1, "time": 0.15}]
    assert of["frames"][1] == {"frames": entries, "number": 1, "time": 0.15}
    gyroscope = [line for line in of["sensor"] if line["sensor"]["type"] == "gyroscope"]
    assert gyroscope[4] == {"sensor": {"type": "gyroscope", "values": (-IMU_VALUES[4]).tolist()}, "time": 0.043}
    fix = {"latitude": 60.173783793064594, "longitude": 24.906486344581662, "altitude": 14.18831106834269}
    assert of["gps"] == [
        {"gps": {**fix, "accuracy": 4.0}, "time": 0.02},
        {"gps": {"latitude": 60.2, "longitude": 24.9, "altitude": 15.0, "verticalAccuracy": 2.5}, "time": 0.12},
    ]
    pose = of["groundTruth"][3]["groundTruth"]
    assert pose["position"] == {"x": 3.0, "y": 0.0, "z": 0.0}
    # a rotation by 0.6 rad about z
    assert pose["orientation"] == pytest.approx({"x": 0, "y": 0, "z": np.sin(0.3), "w": np.cos(0.3)}, abs=1e-15)
    assert of["lidar"][2] == {"lidar": {"model": MODEL, "dataFile": "lidar/000002.bin"}, "time": 0.2}
    points = some_points(2, 200 * MS)
    *positions, intensities, rings, seconds = zip(*records_of(folder / "lidar" / "000002.bin"), strict=True)
    np.testing.assert_array_equal(np.array(positions, np.float32).T, points.positions)
    assert (list(intensities), list(rings)) == (points.intensities.tolist(), points.rings.tolist())
    assert [round(s * 1e9) for s in seconds] == points.timestamps_ns.tolist()
    calibration = calibration_of(folder)
    expected = np.linalg.inv(np.vstack([np.column_stack([MOUNT.rotation, MOUNT.translation]), [0, 0, 0, 1]]))
    found = [entry["imuToCamera"] for entry in calibration["cameras"]]
    np.testing.assert_allclose([*found, calibration["lidars"][0]["imuToLidar"]], [expected] * 3, atol=1e-15)
    assert calibration["lidars"][0]["model"] == MODEL
    assert (calibration["cameras"][0]["imageWidth"], calibration["cameras"][0]["imageHeight"]) == (32, 16)
    for name in ("data.mkv", "data2.mkv"):
        with av.open(str(folder / name)) as container:
            assert container.streams.video[0].codec_context.name == "h264"
        # flat colours survive but for rounding, 1 to 3 levels
        off = np.array(read_video(folder / name), int) - [image_rgb(index) for index in range(4)]
        assert np.abs(off).max() <= 4


def read_video(path):
    capture, images = cv2.VideoCapture(str(path)), []
    while (found := capture.read())[0]:
        images.append(found[1][:, :, ::-1])
    return images


def test_png_images_lose_nothing_and_odd_ones_a_line_in_h264_which_is_reported(tmp_path):
    report = write_recording(whole_scene(), tmp_path / "drive", images="png")
    assert len(report) == 0
    assert not list((tmp_path / "drive").glob("*.mkv"))
    for folder in ("frames1", "frames2"):
        paths = sorted((tmp_path / "drive" / folder).iterdir())
        assert [path.name for path in paths] == [f"{index:08d}.png" for index in range(4)]
        images = [cv2.imread(str(path))[:, :, ::-1] for path in paths]
        np.testing.assert_array_equal(images, [image_rgb(index) for index in range(4)])
    report = write_recording(a_scene(a_camera(width=33, height=17)), tmp_path / "odd")
    assert "cut from 33x17 to 32x16: H.264 needs even sizes" in [loss.what for loss in report]
    entry = calibration_of(tmp_path / "odd")["cameras"][0]
    # the upper left corner stays where it is, so the principal point does
    names = ("imageWidth", "imageHeight", "principalPointX", "principalPointY")
    assert [entry[name] for name in names] == [32, 16, 16.5, 8.5]
    assert read_video(tmp_path / "odd" / "data.mkv")[0].shape == (16, 32, 3)


def packets_of(path):
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


@pytest.mark.parametrize(
    ("codec", "container", "images", "count", "indices", "copied"),
    [
        *(("libx264", container, images, 4, None, True) for container, images in (("mkv", "copy"), ("mkv", "h264"))),
        *((codec, "mp4", "h264", 4, None, True) for codec in ("libx264", "libx265")),
        *(("ffv1", "mkv", images, 4, None, images == "copy") for images in ("copy", "h264")),
        # not all images belong to the camera
        *(("libx264", "mkv", "copy", 6, indices, False) for indices in ((0, 1, 2, 4), None)),
    ],
)
def test_a_camera_s_own_video_is_copied_packet_by_packet(tmp_path, codec, container, images, count, indices, copied):
    path, written = tmp_path / f"{codec}.{container}", tmp_path / "drive" / "data.mkv"
    with av.open(str(path), "w") as output:
        stream = output.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuv420p"
        for index in range(count):
            output.mux(stream.encode(av.VideoFrame.from_ndarray(image_rgb(index), format="rgb24")))
        output.mux(stream.encode(None))
    name = {"libx264": "h264", "libx265": "hevc"}.get(codec, codec)
    video = sc.VideoContent(lambda: io.BytesIO(path.read_bytes()), name, frame_indices=indices)
    options = {} if container == "mp4" else {"images": images}
    report = write_recording(a_scene(a_camera(video=video)), tmp_path / "drive", **options)
    assert (packets_of(written) == packets_of(path)) == copied
    assert (not losses_of(report)) == copied
    assert len(read_video(written)) == 4
    assert written.read_bytes()[:4] == bytes.fromhex("1a45dfa3")
    assert (written.read_bytes() == path.read_bytes()) == (copied and container == "mkv")


def files_of(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


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
    # without images it is calibrated alone, and left out beside others
    empty = a_camera("camera1", timestamps=times(0))
    report = write_recording(a_scene(a_camera(), empty), tmp_path / "both", images="png")
    assert "has no images" in losses_of(report)["sensors[camera1]"]
    write_recording(a_scene(a_lidar(), empty), tmp_path / "alone")
    assert [len(calibration_of(tmp_path / name)["cameras"]) for name in ("both", "alone")] == [1, 1]
    assert not list((tmp_path / "alone").glob("*.mkv"))


def test_an_image_s_own_camera_model_and_mounting_stand_in_its_line(tmp_path):
    own = Camera("fisheye", 32, 16, 40.0, 41.0, 15.0, 7.0, (0.1, 0.2, 0.3, 0.4))
    images = [sc.CameraImage.of(0, CAMERA, image_rgb(0))]
    images.append(sc.CameraImage(100 * MS, own, lambda: image_rgb(1), mount=HERE))
    camera = sc.CameraSensor("camera0", CAMERA, sc.LazyFrames.of(images, [0, 100 * MS]), mount=MOUNT)
    write_recording(a_scene(camera), tmp_path / "drive", images="png")
    numbers = {"focalLengthX": 40.0, "focalLengthY": 41.0, "principalPointX": 15.0, "principalPointY": 7.0}
    numbers |= {"distortionModel": "kannala-brandt4", "distortionCoefficients": [0.1, 0.2, 0.3, 0.4]}
    first, second = ({"cameraInd": 0, "time": time} for time in (0.0, 0.1))
    second |= {"cameraParameters": numbers, "imuToCamera": np.eye(4).tolist()}
    assert entries_of(tmp_path / "drive") == [[first], [second]]


def test_several_lidars_have_an_index_what_points_lack_is_filled_and_what_they_have_too_much_is_named(tmp_path):
    bare, zeros = sc.LidarPoints(np.ones((4, 3), np.float32)), np.zeros(2, np.int64)
    told = {"intensities": zeros.astype(np.uint8), "timestamps_ns": zeros, "rings": zeros.astype(np.uint16)}
    extras = {"colors": np.zeros((2, 3), np.uint8), "extras": MappingProxyType({"echo": np.zeros(2)})}
    rich = sc.LidarPoints(np.ones((2, 3), np.float32), **told, **extras)
    stated = MappingProxyType({"left_skewed": "in a gap", "dataFile": "0.bin", "file_seconds": 0.0})
    second = a_lidar("lidar1", frames=[sc.LidarFrame(0, bare, stated), sc.LidarFrame(100 * MS, rich)])
    report = write_recording(a_scene(a_lidar("lidar0"), second), tmp_path / "drive")
    frames = "sensors[lidar1].frames[]"
    counts = {"intensities": 4, "rings": 4, "timestamps_ns": 4, "colors": 2, "echo": 2}
    lost = {f"{frames}.points.{name}": n for name, n in counts.items()} | {f"{frames}.left_skewed": 1}
    assert {loss.field: loss.count for loss in report if loss.field != "replay"} == lost
    assert records_of(tmp_path / "drive" / "lidar2" / "000000.bin")[3] == (1.0, 1.0, 1.0, 0, 0, 0.0)
    lines = [line["lidar"] for line in lines_of(tmp_path / "drive")]
    assert lines[:2] == [
        {"model": MODEL, "dataFile": "lidar/000000.bin"},
        {"model": MODEL, "dataFile": "lidar2/000000.bin", "lidarInd": 1},
    ]
    assert [lidar.get("lidarInd") for lidar in calibration_of(tmp_path / "drive")["lidars"]] == [None, 1]


def world_lidar(**fields):
    """A lidar whose points were brought into the world, each at its own time, and the points before that."""
    timestamps = 120 * MS + np.arange(5, dtype=np.int64) * 17 * MS
    positions = np.random.default_rng(7).normal(size=(5, 3)) * 20
    moving = ego_path().interpolate(timestamps)
    egos = map(RigidTransform.from_quaternion, moving.positions, moving.quaternions_xyzw)
    world = [(ego @ MOUNT).apply(position) for ego, position in zip(egos, positions, strict=True)]
    bare = {"timestamps_ns": timestamps, "rings": np.zeros(5, np.uint16)}
    points = sc.LidarPoints(np.array(world, np.float32), np.zeros(5, np.uint8), **bare)
    return a_lidar(frames=[sc.LidarFrame(120 * MS, points)], points_frame=sc.PointsFrame.WORLD, **fields), positions


def mounted_path(count=6, *, raised=0.0):
    """The way of a sensor on the ego; its last pose is raised [m]."""
    path = ego_path(count)
    pairs = zip(path.positions, path.quaternions_xyzw, strict=True)
    poses = [RigidTransform.from_quaternion(*pair) @ MOUNT for pair in pairs]
    positions = np.array([pose.translation for pose in poses])
    positions[-1, 2] += raised
    return sc.Poses(path.timestamps_ns, positions, np.array([pose.quaternion_xyzw for pose in poses]))


def test_points_in_the_world_or_on_the_ego_are_brought_back_to_where_each_was_measured(tmp_path):
    def brought_back(scene):
        write_recording(scene, tmp_path / "drive", overwrite=True)
        return np.array([record[:3] for record in records_of(tmp_path / "drive" / "lidar" / "000000.bin")])

    (lidar, positions), path, known = world_lidar(), mounted_path(), {"trajectories": [a_trajectory()]}
    posed, aside = (world_lidar(poses=path.moved(np.array([x, 0.0, 0.0])))[0] for x in (0.0, 1.0))
    points = sc.LidarPoints(MOUNT.apply(positions).astype(np.float32))
    on_ego = a_lidar(frames=[sc.LidarFrame(0, points)], points_frame=sc.PointsFrame.EGO)
    for scene, tolerance in (
        (a_scene(lidar, **known), 2e-5),  # float32 at 20 m
        (a_scene(lidar, sc.OdometrySensor("ego", ego_path())), 2e-5),
        (a_scene(on_ego), 2e-5),
        # between poses 0.2 rad apart the lidar, 1.5 m from the axis, takes the chord: 1.5 m (1 - cos 0.1) inside
        (a_scene(posed), 8e-3),
        # its own poses count unless the trajectory says the same and more
        (a_scene(posed, **known), 2e-5),
    ):
        np.testing.assert_allclose(brought_back(scene), positions, atol=tolerance)
    assert np.linalg.norm(brought_back(a_scene(aside, **known)) - positions, axis=1).min() > 0.9


FAR = sc.Poses(times(2, start_ms=5000), np.zeros((2, 3)), np.array([[0.0, 0, 0, 1]] * 2))


def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path):
    front = a_camera("front", mount=None)
    for sensors, error, problem in (
        ([world_lidar()[0]], PoseError, "lidar 'lidar': its points are in the world"),
        ([world_lidar(poses=FAR)[0]], PoseError, "sweep at 120000000 ns: no pose for 5 of its points"),
        ([front], CalibrationError, "camera 'front': nothing says how it is mounted"),
        ([], DataError, "holds nothing that a recording could hold"),
    ):
        with pytest.raises(error, match=problem):
            write_recording(a_scene(*sensors), tmp_path / "drive")
    for images in ("jpeg", ""):
        with pytest.raises(OptionError, match="expected one of: copy, lossless, h264, ffv1, png"):
            write_recording(whole_scene(), tmp_path / "drive", images=images)
    small = depth_camera([np.zeros((3, 4), np.float32)], [0.001])
    for camera, error, problem in (
        *((depth_camera([1.0], [scale]), OptionError, "scale .* expected a length")
          for scale in (0.0, -0.001, float("nan"), float("inf"))),
        (small, ArrayError, "depth"),
    ):  # fmt: skip
        with pytest.raises(error, match=problem):
            write_recording(a_scene(camera), tmp_path / "drive")
    assert list(tmp_path.iterdir()) == []


def test_what_a_recording_cannot_hold_is_named_field_by_field_and_ids_that_it_forgets(tmp_path):
    box = sc.CuboidAnnotation("car", sc.CuboidPath(np.zeros(1, np.int64), np.ones((1, 9))))
    radar = sc.RadarSensor("radar", sc.LazyFrames.of([], []))
    lidar = a_lidar("roof", mount=None)
    scene = a_scene(
        *(a_camera("front"), lidar, an_imu(), sc.ImuSensor("second", {}), radar, sc.PlainSensor("odd", "sonar", {})),
        annotations=(box,),
        attributes=(sc.AttributePath("weather", ()),),
        metadata={"city": "Turku", "recording": {}},
        extras={"future": 1},
    )
    lost = ("annotations", "attributes", "metadata.city", "extras.future", "sensors[radar]", "sensors[odd]")
    assert losses_of(write_recording(scene, tmp_path / "drive", images="png")) == {
        **dict.fromkeys(lost, "left out: the format has none"),
        "sensors[second]": "left out: the format has one imu only",
        "sensors[front].id": "read back as 'camera0'",
        "sensors[roof].id": "read back as 'lidar'",
        "sensors[roof].mount": "taken to be where the IMU is, with the same axes: nothing says how it is mounted",
        "sensors": "read back in another order: lidars, cameras, those of depth last, IMU, satellite receivers",
    }
    assert calibration_of(tmp_path / "drive")["lidars"][0]["imuToLidar"] == np.eye(4).tolist()


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
    odometry = sc.OdometrySensor("ego", ego_path())
    for name, trajectories in (("groundTruth", [a_trajectory()]), ("ego", [])):
        write_recording(a_scene(odometry, trajectories=trajectories), tmp_path / "with odometry", overwrite=True)
        assert {key for line in lines_of(tmp_path / "with odometry") for key in line} == {name, "time"}


def test_samples_and_times_that_json_or_the_format_cannot_hold_are_counted(tmp_path):
    values = np.ones((4, 3))
    values[2, 1] = np.nan
    lla = np.array([[60.0, 24.0, np.nan], [60.0, 24.0, 3.0]])
    at = 1_700_000_000_000_000_000 + np.array([123_456_789, 10**9, 2 * 10**9, 3 * 10**9], np.int64)
    imu = an_imu(accelerometer=sc.VectorSamples(at, values), gyroscope=sc.VectorSamples(at, np.ones((4, 2))))
    gnss = sc.GnssSensor("gnss", at[1:3], lla, np.ones(2), np.ones(2))
    report = write_recording(a_scene(imu, gnss), tmp_path / "drive")
    streams = {"sensors[imu].streams[accelerometer]": 1, "sensors[imu].streams[gyroscope]": 4}
    assert {loss.field: loss.count for loss in report} == {**streams, "sensors[gnss]": 1, "timestamps": 1}
    assert len(lines_of(tmp_path / "drive")) == 3 + 1
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
        an_imu(gyroscope=sc.VectorSamples(timestamps, np.ones((2, 3)))),
        trajectories=[sc.Trajectory("pose:lidar", timestamps[:1] + 20 * MS, np.zeros((1, 3)))],
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


def test_the_same_scene_gives_the_same_files_and_a_recording_is_replaced_on_request_whole_but_for_its_readme(tmp_path):
    folder = tmp_path / "drive"
    folder.mkdir()
    write_recording(whole_scene(), folder, overwrite=True)
    write_recording(whole_scene(), tmp_path / "first")
    before = files_of(folder)
    assert len(before) == 7
    assert files_of(tmp_path / "first") == before
    # a recording can take its own location
    with open_recording(folder) as scene:
        write_recording(scene, folder, overwrite=True)
    assert files_of(folder) == before
    with pytest.raises(OutputError, match="exists already"):
        write_recording(a_scene(an_imu()), folder)
    # without cameras and lidars there is no calibration
    write_recording(a_scene(an_imu()), folder, overwrite=True)
    assert [path.name for path in folder.iterdir()] == ["data.jsonl"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive", "first"]
    (folder / "README.md").write_text("from the attic")
    write_recording(a_scene(a_camera()), folder, overwrite=True)
    assert (folder / "README.md").read_text() == "from the attic"


def test_somebody_s_folder_is_never_replaced_and_no_recording_written_into_another(tmp_path):
    for k, names in enumerate((["thesis.odt"], ["data.jsonl", "thesis.odt"], ["calibration.json"])):
        folder = tmp_path / f"{k}"
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
    outer = tmp_path / "drive"
    write_recording(whole_scene(), outer)
    before = sorted(outer.rglob("*"))
    for location in ("repaired", "lidar/repaired", "frames1/../repaired"):
        with pytest.raises(OutputError, match="inside the recording"):
            write_recording(a_scene(an_imu()), outer / location)
    assert sorted(outer.rglob("*")) == before


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
        return sc.LidarFrame(int(sweeps[k]), points)

    camera = shooting(lambda k: born("image", shots[k], image_rgb(k)), shots)
    lidar = sc.LidarSensor("lidar", sc.LazyFrames(sweeps, sweep), mount=MOUNT)
    write_recording(a_scene(lidar, camera), tmp_path / "drive", images=images)
    gc.collect()
    # the one before is let go when the next is there; a camera keeps its last image for lines without one
    assert most == {"lidar": 2, "image": 2}
    assert alive == {"lidar": 0, "image": 0}
    assert Counter(kind for kind, _ in asked) == {"lidar": 40, "image": 40}
    # a merge looks one line ahead in every stream, and no farther
    assert all(later > earlier - 101 * MS for (_, earlier), (_, later) in pairwise(asked))


NO_IMU = "the vendor's software gives no output without accelerometer and gyroscope"
ACCELEROMETER = sc.VectorSamples(times(60, start_ms=1, step_ms=5), np.ones((60, 3)))
EXACT = (
    "images have exactly the times of IMU samples, which makes the vendor's diagnosis suspect that their times "
    "were not measured; they are written as they are"
)
FIRST_TWO = "the vendor's software uses the first two cameras, not camera2"
DEPTH_FIRST = "the vendor's software tracks in the first camera, and camera0 measures depth"


NO_GYROSCOPE = "the vendor's software gives no output without gyroscope"
LIDARS = "the vendor's software does not report lidars apart (`lidarInd`)"
UNKNOWN = "the vendor's software may stop at settings that are not publicly known: sparkle"


@pytest.mark.parametrize(
    ("sensors", "expected"),
    [
        ((a_camera(), a_camera("camera1"), an_imu()), {}),
        ((a_camera(), a_depth_camera(), an_imu()), {}),
        ((a_camera(),), {NO_IMU: 1}),
        ((a_camera(), an_imu(accelerometer=ACCELEROMETER)), {NO_GYROSCOPE: 1}),
        ((a_lidar("lidar"),), {}),
        ((a_camera(timestamps=times(3, start_ms=3)), an_imu()), {EXACT: 3}),
        ((a_camera(), a_camera("camera1"), a_camera("camera2"), an_imu()), {FIRST_TWO: 1}),
        ((a_lidar("lidar0"), a_lidar("lidar1")), {LIDARS: 2}),
        ((a_depth_camera("camera0"), an_imu()), {DEPTH_FIRST: 1}),
    ],
)
def test_what_will_not_be_replayed_is_named(tmp_path, sensors, expected):
    settings = "useStereo: True\nsparkle: 3\n"
    kept = {"metadata": {"recording": {"vio_config": settings}}, "format": "recording"}
    for name, fields, found in (("drive", {}, expected), ("again", kept, expected | {UNKNOWN: 1})):
        report = write_recording(a_scene(*sensors, **fields), tmp_path / name, images="png")
        assert {loss.what: loss.count for loss in report if loss.field == "replay"} == found
    assert (tmp_path / "again" / "vio_config.yaml").read_text() == settings


GREY_CAMERA = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
GREY_NS = np.arange(12, dtype=np.int64) * 100_000_000
GREYS = 15 + 20 * np.arange(12)
# H.264 at its usual quality moves an even grey by a level or two, twice here; neighbours are 20 apart
TWICE_ENCODED = 4


def test_of_a_part_of_a_video_what_packets_cannot_give_alone_is_encoded_anew_and_reported(tmp_path):
    def written(scene, name, **options):
        report = FORMAT.write(scene, tmp_path / name, **options)
        with FORMAT.open(tmp_path / name) as again:
            images = again.cameras[0].images
            reported = {loss.field: loss.what for loss in report if loss.field.startswith("sensors[camera0]")}
            return reported, images.timestamps_ns.tolist(), [int(np.median(shot.rgb)) for shot in images]

    # an H.264 video of greys, the first image its only key frame
    pairs = zip(GREY_NS.tolist(), GREYS, strict=True)
    images = [sc.CameraImage.of(t, GREY_CAMERA, np.full((48, 64, 3), grey, np.uint8)) for t, grey in pairs]
    camera = sc.CameraSensor("camera0", GREY_CAMERA, sc.LazyFrames.of(images, GREY_NS), mount=HERE, fps=10.0)
    _, _, whole = written(a_scene(camera), "drive")
    with FORMAT.open(tmp_path / "drive") as drive:
        for part, rows in (
            (thin_scene(drive, every=3), slice(None, None, 3)),
            (crop_scene(drive, start=0.45), slice(5, None)),
            (crop_scene(drive, start=0.25, stop=0.85), slice(3, 9)),
        ):
            reported, timestamps_ns, greys = written(part, f"part {rows}")
            assert timestamps_ns == GREY_NS[rows].tolist()
            np.testing.assert_allclose(greys, GREYS[rows], atol=TWICE_ENCODED)
            assert reported["sensors[camera0].video"].startswith("encoded anew as H.264: the video could not be copied")
            assert reported["sensors[camera0].images[].rgb"] == "encoded as H.264, which changes colours a little"
        # a key frame by itself is copied
        assert written(crop_scene(drive, stop=0.05), "one") == ({}, GREY_NS[:1].tolist(), whole[:1])
        reported, _, greys = written(thin_scene(drive, every=3), "lossless", images="lossless")
    # colours of 8-bit YUV as 8-bit RGB, decoded once and kept
    assert greys == whole[::3]
    assert list(reported) == ["sensors[camera0].video"]
    assert "FFV1, which loses nothing" in reported["sensors[camera0].video"]


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "options", "encoded"),
    [
        ("data.mkv", "ffv1", "bgr0", {"g": "1"}, False),
        ("data.mkv", "ffv1", "bgr0", {"g": "4"}, True),
        ("data.avi", "mjpeg", "yuvj444p", {}, False),
        ("data.mov", "png", "rgb24", {}, True),
        ("data.mp4", "libx264", "yuv420p", {"g": "1"}, False),
    ],
)
def test_gaps_in_numbers_cost_no_image_anything_and_stay(
    recording, pinhole, tmp_path, name, codec, pixels, options, encoded
):
    generator = np.random.default_rng(1)
    with av.open(str(recording.path / name), "w") as container:
        stream = container.add_stream(codec, rate=10, options={"threads": "1", **options})
        stream.width, stream.height, stream.pix_fmt = 32, 16, pixels
        for _ in range(9):
            rgb = generator.integers(0, 255, (16, 32, 3)).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(format=pixels)))
        container.mux(stream.encode())
    numbers = [3, 4, 6, 7, 11]
    recording.calibration([pinhole])
    recording.lines({"frames": [{"cameraInd": 0}], "number": number, "time": 0.1 * number} for number in numbers)
    with recording.open() as scene:
        before = [image.rgb for image in scene.cameras[0].images]
        report = FORMAT.write(scene, tmp_path / "again")
    with FORMAT.open(tmp_path / "again") as scene:
        assert [image.extras["number"] for image in scene.cameras[0].images] == numbers
        np.testing.assert_array_equal([image.rgb for image in scene.cameras[0].images], before)
    reported = losses_of(report)
    assert list(reported) == (["sensors[camera0].video"] if encoded else [])
    assert not encoded or "FFV1, which loses nothing" in reported["sensors[camera0].video"]
    packets = packets_of(recording.path / name)
    assert encoded or packets_of(tmp_path / "again" / "data.mkv") == [packets[k - 3] for k in numbers]


def depth_camera(images, scales):
    frames = [
        sc.DepthFrame(int(t), CAMERA, lambda d=depth: np.full(np.shape(d) or (16, 32), d, np.float32), scale)
        for t, depth, scale in zip(times(len(images)), images, scales, strict=True)
    ]
    return sc.DepthCameraSensor("depth", CAMERA, sc.LazyFrames.of(frames, times(len(images))), mount=HERE)


def steps_of(path):
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "ffv1"
        return [frame.to_ndarray(format="gray16le") for frame in container.decode(video=0)]


def lost(report):
    return {loss.what: loss.count for loss in report if loss.field.endswith(".depth")}


def test_the_steps_of_the_source_lose_nothing_else_the_smallest_that_hold_the_largest_depth_are_taken(tmp_path):
    for k, (largest, scale) in enumerate(
        [(65.535, 0.001), (65.6, 0.002), (131.0, 0.002), (131.2, 0.005), (300.0, 0.005), (400.0, 0.01)]
    ):
        report = write_recording(a_scene(depth_camera([0.5, largest], [None, None])), tmp_path / f"{k}")
        found = [(entry["depthScale"], entry["colorFormat"]) for (entry,) in entries_of(tmp_path / f"{k}")]
        assert found == [(scale, "gray16")] * 2
        first, second = steps_of(tmp_path / f"{k}" / "data.mkv")
        assert (first == round(0.5 / scale)).all()
        assert abs(second[0, 0] * scale - largest) <= scale / 2
        assert not [what for what in lost(report) if what.startswith("left out")]
    steps = np.random.default_rng(1).integers(0, 65536, (3, 16, 32)).astype(np.uint16)
    scales = [0.001, 0.00025, 1 / 3]
    images = [(image * scale).astype(np.float32) for image, scale in zip(steps, scales, strict=True)]
    report = write_recording(sc.Scene((depth_camera(images, scales),)), tmp_path / "d")
    assert lost(report) == {}
    assert [entry["depthScale"] for (entry,) in entries_of(tmp_path / "d")] == scales
    np.testing.assert_array_equal(steps_of(tmp_path / "d" / "data.mkv"), steps)
    depth = np.array([[0.0, 0.001, 0.0014, 0.0002, 65.535, 65.6, -1.0, np.nan, np.inf, 0.0020001]], np.float32)
    found = to_steps(depth, 0.001)
    # what is nearer than the first step is something, not nothing
    assert (found.steps.tolist(), found.rounded, found.beyond) == ([[0, 1, 1, 1, 65535, 0, 0, 0, 0, 2]], 2, 4)


def test_depth_comes_after_the_images_and_a_line_without_it_repeats_the_last(tmp_path):
    depth = depth_camera([1.0, 2], [0.001, 0.001])
    report = write_recording(sc.Scene((depth, a_camera("colour", timestamps=times(4)))), tmp_path / "d")
    found = [[(e.get("depthScale"), e.get("missingBitmap")) for e in line] for line in entries_of(tmp_path / "d")]
    assert found == [[(None, None), (0.001, None)]] * 2 + [[(None, None), (None, True)]] * 2
    assert [image[0, 0] for image in steps_of(tmp_path / "d" / "data2.mkv")] == [1000, 2000, 2000, 2000]
    assert "sensors[depth].frames" in [loss.field for loss in report]


def test_a_video_whose_steps_are_known_is_copied(tmp_path):
    write_recording(sc.Scene((depth_camera([1.0, 2], [0.001] * 2),)), tmp_path / "first")
    content = (tmp_path / "first" / "data.mkv").read_bytes()
    video = sc.VideoContent(lambda: io.BytesIO(content), "ffv1")

    frames = [sc.DepthFrame(int(t), CAMERA, lambda: pytest.fail("decoded"), 0.001) for t in times(2)]
    copied = sc.DepthCameraSensor("camera0", CAMERA, sc.LazyFrames.of(frames, times(2)), mount=HERE, video=video)
    report = write_recording(sc.Scene((copied,)), tmp_path / "second")
    assert (tmp_path / "second" / "data.mkv").read_bytes() == content
    assert lost(report) == {}


def camera(model, *coefficients):
    return Camera(model, 640, 480, 500.0, 501.0, 320.5, 240.25, coefficients)


WRITTEN = [
    (camera("pinhole"), "pinhole", []),
    (camera("fisheye", 0.1, -0.2, 0.3, -0.4), "kannala-brandt4", [0.1, -0.2, 0.3, -0.4]),
    (camera("fisheye", 0.1), "kannala-brandt4", [0.1, 0.0, 0.0, 0.0]),
    (camera("brown_conrady", *range(1, 6)), "brown-conrady", [*range(1, 6), 0.0, 0.0, 0.0]),
    (camera("brown_conrady", *range(1, 9), 0, 0, *range(11, 17)), "brown-conrady", [*range(1, 9), *range(11, 17)]),
    (camera("kannala_brandt18", *range(1, 19)), "kannala-brandt18", list(range(1, 19))),
    (camera("kannala_brandt18", 0.1, 0.2), "kannala-brandt18", [0.1, 0.2] + [0.0] * 16),
    (camera("omnidir", 1, 2, 3, 4, 5, 6), "omnidir", [1, 2, 3, 4, 5, 6]),
    # sixteen numbers without a prism
    (camera("brown_conrady", *range(1, 9), *[0.0] * 8), "brown-conrady", list(range(1, 9))),
]


STRANGERS = [
    camera("brown_conrady", -0.2, 0.05, 0, 0, 0, 0, 0, 0, 0.002, -0.001),
    camera("fisheye_rad_tan_prism", 0.05, -0.01, 0, 0, 0, 0, 1e-3, 0, 1e-3, 0, 0, 0),
    Camera("omnidirectional", 640, 480, 900.0, 900.0, 320.0, 240.0, (-0.1, 0.02, 0, 0, 0, 0, 1.1)),
    camera("mod_kannala", 0.02),
    camera("mod_equi_fish", 0.0, -0.02, 0.01, -0.003),
    Camera("ftheta", 640, 480, 1.0, 1.0, 320.0, 240.0, (0.0, 500.0, 0.0, -12.0, 2.0)),
    camera("ftheta_skewed", 0.0, 0.01, -0.02, 0.0, 0.0, 0.3, -0.4),
    camera("fisheye_radial_custom", 0.05, -0.01, 0, 0, 0, 0, 1e-4, 0, 0.5, -0.3),
    Camera("cylindrical", 640, 480, 1500.0, 1500.0, 320.0, 240.0),
    Camera("equirectangular", 640, 480, 1500.0, 1500.0, 320.0, 240.0),
]


@pytest.mark.parametrize("exact", STRANGERS)
@pytest.mark.few(3)
def test_a_camera_model_that_the_format_lacks_is_fitted_and_the_error_that_is_left_is_stated(exact):
    fields, how_far = camera_model_entry(exact)
    assert how_far.startswith(f"{exact.model} camera model reported as ")
    # what the format's own reader makes of the fields
    written = camera_model(msgspec.convert(fields, CameraParameters), None, "calibration.json")
    u, v = np.meshgrid(np.linspace(-0.5, 639.5, 50), np.linspace(-0.5, 479.5, 40))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    off = np.hypot(*(project_unbounded(written, unproject(exact, pixels)) - pixels).T)
    stated = float(how_far.split("up to ")[1].split()[0])
    assert np.nanmax(off) <= 1.1 * stated
    assert stated < 1.5


def test_models_are_written_under_the_format_s_names_or_fitted_or_refused_where_nothing_of_the_format_comes_near():
    assert {exact.model for exact in [*STRANGERS, *(exact for exact, _, _ in WRITTEN)]} == set(MODELS)
    numbers = {"focalLengthX": 500.0, "focalLengthY": 501.0, "principalPointX": 320.5, "principalPointY": 240.25}
    for exact, model, coefficients in WRITTEN:
        distortion = {"model": model, "distortionCoefficients": coefficients}
        assert camera_model_entry(exact) == ({**distortion, **numbers, "imageWidth": 640, "imageHeight": 480}, None)
    for exact, problem in (
        (Camera("cylindrical", 640, 480, 110.0, 200.0, 320.0, 240.0), "cylindrical camera model reported as .* a"),
        (camera("periscope"), "camera model 'periscope'; a"),
    ):
        with pytest.raises(CalibrationError, match=f"{problem} recording can hold pinhole, fisheye"):
            camera_model_entry(exact)


def written_entry(folder, entry, mount=MOUNT):
    """The entry of a camera that came with one from a recording, as it is written."""
    still = sc.ImuSensor("imu", {"gyroscope": sc.VectorSamples(np.zeros(1, np.int64), np.zeros((1, 3)))})
    sensor = posed_camera(camera("fisheye"), mount=mount, extras=MappingProxyType({"calibration": entry}))
    write_recording(sc.Scene((sensor, still)), folder, overwrite=True)
    (written,) = json.loads((folder / "calibration.json").read_text())["cameras"]
    return written


def test_what_else_a_recording_stated_of_a_camera_and_the_numbers_of_its_mounting_are_kept_while_they_mean_it(tmp_path):
    before = {"shutterRollTimeSeconds": 0.02, "model": "pinhole", "imuToCameraMatrix": [[1]], "note": {"a": 1}}
    entry = written_entry(tmp_path / "drive", before)
    assert (entry["model"], entry["shutterRollTimeSeconds"], entry["note"]) == ("kannala-brandt4", 0.02, {"a": 1})
    assert "imuToCameraMatrix" not in entry
    assert entry["imuToCamera"] == MOUNT.inverse().matrix.tolist()
    rows = MOUNT.inverse().matrix.tolist()
    rows[0][3] = np.nextafter(rows[0][3], 9.0)
    read = rigid_transform(rows, "", Ledger(lenient=False)).inverse()
    assert written_entry(tmp_path / "drive", {"imuToCameraMatrix": rows}, read)["imuToCamera"] == rows
    moved = RigidTransform(read.rotation, read.translation + 1.0)
    anew = written_entry(tmp_path / "drive", {"imuToCamera": rows}, moved)["imuToCamera"]
    assert anew == moved.inverse().matrix.tolist()
    for wrong in (None, "there", [1, 2], [[1.0] * 4] * 3, [["a"] * 4] * 4, [[float("nan")] * 4] * 4):
        entry = written_entry(tmp_path / "drive", {"imuToCamera": wrong}, read)
        assert entry["imuToCamera"] == read.inverse().matrix.tolist()


def posed_camera(model=None, **fields):
    return sc.CameraSensor("camera0", model or camera("pinhole"), sc.LazyFrames.of([], []), **fields)


def turned(x):
    return RigidTransform(MOUNT.rotation @ Rotation.from_rotvec([x, 0, 0]).as_matrix(), MOUNT.translation)


RAISED = RigidTransform(MOUNT.rotation, MOUNT.translation + np.array([0, 0, 0.3]))
ON_EGO = sc.Poses(np.zeros(1, np.int64), MOUNT.translation[None], MOUNT.quaternion_xyzw[None])
SHORT = sc.Poses(ego_path(5).timestamps_ns[:3], ego_path(5).positions[:3], ego_path(5).quaternions_xyzw[:3])
POSED = {"poses": mounted_path(5)}


@pytest.mark.parametrize(
    ("fields", "ego", "expected", "lost"),
    [
        (POSED, ego_path(5), MOUNT, []),
        ({"poses": ON_EGO, "coordinates": sc.Coordinates.EGO}, None, MOUNT, []),
        ({"poses": mounted_path(5, raised=0.5)}, ego_path(5), MOUNT, [(5, "moves up to 0.5 m")]),
        ({**POSED, "mount": MOUNT}, ego_path(5), MOUNT, []),
        ({**POSED, "mount": RAISED}, ego_path(5), RAISED, [(5, "up to 0.3 m and 0 degrees")]),
        ({**POSED, "mount": turned(0.01)}, ego_path(5), turned(0.01), [(5, "0.573 degrees")]),
        ({**POSED, "mount": MOUNT}, SHORT, MOUNT, [(2, "left out:")]),
        ({}, ego_path(5), None, []),
        (POSED, None, None, []),
    ],
)
def test_mountings_come_from_poses_that_agree_with_the_ego_s_and_others_are_reported(fields, ego, expected, lost):
    mount, losses = mounting(posed_camera(**fields), ego)
    assert (mount is None) == (expected is None)
    if mount is not None:
        np.testing.assert_allclose(mount.matrix, expected.matrix, atol=1e-12)
    assert [(loss.count, what in loss.what) for loss, (_, what) in zip(losses, lost, strict=True)] == [
        (count, True) for count, _ in lost
    ]


def test_the_position_of_an_antenna_is_written_and_comes_back(tmp_path):
    mount = RigidTransform.from_quaternion(np.array([0.4, -0.1, 1.2]), np.array([0.0, 0.0, 0.6, 0.8]))
    times, ones = np.arange(3, dtype=np.int64) * 10**9, np.ones(3)
    receivers = [sc.GnssSensor(name, times, np.ones((3, 3)), ones, ones, mount=mount) for name in ("gnss", "rtkgps")]
    losses = FORMAT.write(sc.Scene(tuple(receivers)), tmp_path / "drive")
    assert [loss.field for loss in losses] == ["sensors[rtkgps].mount"]
    with FORMAT.open(tmp_path / "drive") as scene:
        # a matrix and its inverse, each rounded to float64
        np.testing.assert_allclose(scene.sensor("gnss").mount.matrix, mount.matrix, atol=1e-15)
        assert scene.sensor("rtkgps").mount is None
        text = (tmp_path / "drive" / "calibration.json").read_bytes()
        FORMAT.write(scene, tmp_path / "again")
    assert (tmp_path / "again" / "calibration.json").read_bytes() == text
