"""A small drive in which every field of the model holds something that is distinguished from all else."""

import io
from functools import cache, partial

import numpy as np
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.formats.base.images import EncodedImage
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CameraImage,
    CameraSensor,
    Coordinates,
    CuboidAnnotation,
    CuboidPath,
    DepthCameraSensor,
    DepthFrame,
    EventAnnotation,
    GnssSensor,
    GroupAnnotation,
    ImuSensor,
    LabeledPoints,
    LabeledPointsAnnotation,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    OdometrySensor,
    PlainAnnotation,
    PlainSensor,
    PointPath,
    PointProjection,
    PointsAnnotation,
    PointsFrame,
    PointsSensor,
    Poses,
    Projection,
    RadarFrame,
    RadarPoints,
    RadarSensor,
    Scene,
    ShapeAnnotation,
    ShapeType,
    Trajectory,
    VectorSamples,
    VertexPath,
    VideoContent,
)

SWEEPS = 3
POINTS = 40
START_NS = 1_700_000_000_100_200_300
TIMES = START_NS + np.arange(SWEEPS, dtype=np.int64) * 100_000_000
SHOTS = TIMES + 20_000_000
TRAJECTORY_TIMES = START_NS + np.arange(-1, SWEEPS + 2, dtype=np.int64) * 100_000_000
SECONDS = TIMES / 1e9
CAMERA_MODEL = Camera("brown_conrady", 64, 48, 50.0, 51.0, 31.0, 24.0, (0.1, -0.02, 0.001, 0.002, 0.003))
OWN_CAMERA_MODEL = Camera("brown_conrady", 64, 48, 50.5, 51.0, 31.0, 24.0, (0.1, -0.02, 0.001, 0.002, 0.003))
FRONT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""`ego_from_camera` of a camera that looks ahead."""

RANDOM = np.random.default_rng(9)


def mount(x, y, z, rotation=None):
    matrix = np.eye(3) if rotation is None else rotation
    return RigidTransform(matrix, np.array([x, y, z], np.float64))


def ego_at(times):
    """The ego at 10 m/s along a straight line, rotating slowly: locations and orientations."""
    seconds = (times - START_NS) / 1e9
    locations = seconds[:, None] * np.array([10.0, 1.0, 0.0])
    return locations, Rotation.from_euler("z", 0.1 * seconds[:, None])


def path(offset=0.0, *, times=TRAJECTORY_TIMES):
    """The ego trajectory, shifted."""
    locations, rotations = ego_at(times)
    return Poses(times.copy(), locations + offset, rotations.as_quat())


def ridden(transform, times):
    """Where a sensor is in the world that is mounted so."""
    locations, rotations = ego_at(times)
    positions = locations + rotations.apply(transform.translation.copy())
    return Poses(times.copy(), positions, (rotations * Rotation.from_matrix(transform.rotation)).as_quat())


def still(transform, times=TIMES):
    """A mounting as poses onto the ego."""
    rotation = Rotation.from_matrix(transform.rotation).as_quat()
    return Poses(times.copy(), np.tile(transform.translation, (len(times), 1)), np.tile(rotation, (len(times), 1)))


def attributes(name):
    return (AttributePath(name, ("slow", "fast"), TIMES[:2].copy(), static=False, extras={"source": "a person"}),)


def lidar(points_frame):
    def sweep(k):
        positions = RANDOM_POINTS[k]
        points = LidarPoints(
            positions,
            intensities=np.arange(POINTS, dtype=np.uint8) + k,
            colors=(np.arange(POINTS * 3, dtype=np.uint8) + k).reshape(POINTS, 3),
            timestamps_ns=TIMES[k] + np.arange(POINTS, dtype=np.int64) * 1_000_001,
            rings=(np.arange(POINTS) % 4).astype(np.uint16),
            camera_index=(np.arange(POINTS) % 2).astype(np.uint8),
            extras={"reflectivity": np.linspace(0, 1, POINTS, dtype=np.float32)},
        )
        return LidarFrame(int(TIMES[k]), points, {"sweep_note": f"number {k}"})

    location = mount(1.0, 0.0, 1.8)
    odd = points_frame != PointsFrame.SENSOR
    return LidarSensor(
        "top",
        LazyFrames.of([sweep(k) for k in range(SWEEPS)], TIMES.tolist()),
        poses=still(location) if odd else ridden(location, TIMES),
        mount=location,
        coordinates=Coordinates.EGO if odd else Coordinates.WORLD,
        points_frame=points_frame,
        model="Velodyne HDL-64E",
        parent_id="odometer",
        extras={"serial": "A1"},
    )


RANDOM_POINTS = [RANDOM.uniform(2.0, 30.0, (POINTS, 3)).astype(np.float32) for _ in range(SWEEPS)]


def radar(points_frame):
    def cycle(k):
        directions = RANDOM_POINTS[k][:5] / np.linalg.norm(RANDOM_POINTS[k][:5], axis=1, keepdims=True)
        points = RadarPoints(
            RANDOM_POINTS[k][:5],
            directions=directions.astype(np.float32),
            lengths=np.linspace(-2, 2, 5, dtype=np.float32),
            timestamps_ns=TIMES[k] + np.arange(5, dtype=np.int64) * 2_000_003,
            extras={"rcs": np.linspace(1, 5, 5, dtype=np.float32)},
        )
        return RadarFrame(int(TIMES[k]), points, {"cycle": k})

    location = mount(3.5, 0.2, 0.5)
    odd = points_frame != PointsFrame.SENSOR
    return RadarSensor(
        "radar_front",
        LazyFrames.of([cycle(k) for k in range(SWEEPS)], TIMES.tolist()),
        poses=still(location) if odd else ridden(location, TIMES),
        mount=location,
        coordinates=Coordinates.EGO if odd else Coordinates.WORLD,
        points_frame=points_frame,
        parent_id="odometer",
        extras={"band": "77 GHz"},
    )


@cache
def jpeg(k):
    from PIL import Image

    rows, columns = np.mgrid[0:48, 0:64]
    rgb = np.stack([columns * 3 + k, rows * 4, 0 * rows + 20 * k], axis=2).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "JPEG", quality=90)
    return file.getvalue()


@cache
def video():
    """An H.264 video of the images."""
    from sceneloom.formats.video.writer import VideoWriter

    file = io.BytesIO()
    with VideoWriter(file, 64, 48, 10.0, container="mp4") as writer:
        for k in range(SWEEPS):
            writer.add(EncodedImage(jpeg(k), "jpeg", 64, 48)(), k / 10)
    return file.getvalue()


def read_back(content):
    return io.BytesIO(content)


def decoded_video(k):
    from sceneloom.formats.video.reader import VideoReader

    with VideoReader(video()) as reader:
        return reader.rgb(k)


def cameras(odd):
    images = []
    for k in range(SWEEPS):
        image = EncodedImage(jpeg(k), "jpeg", 64, 48)
        images.append(
            CameraImage(
                int(SHOTS[k]),
                OWN_CAMERA_MODEL if odd and k == 1 else CAMERA_MODEL,
                image,
                mount=mount(1.51, 0.1, 1.5, FRONT) if odd and k == 1 else None,
                extras={"exposureTimeSeconds": 0.01, "note": f"image {k}"},
                encoded=image.encoded,
            )
        )
    left = mount(1.5, 0.1, 1.5, FRONT)
    first = CameraSensor(
        "left",
        CAMERA_MODEL,
        LazyFrames.of(images, SHOTS.tolist()),
        poses=still(left, SHOTS) if odd else ridden(left, SHOTS),
        mount=left,
        coordinates=Coordinates.EGO if odd else Coordinates.WORLD,
        fps=10.0,
        parent_id="odometer",
        extras={"camera_model_serial": "L7"},
    )
    right = mount(1.5, -0.1, 1.5, FRONT)
    shots = [CameraImage(int(SHOTS[k]), CAMERA_MODEL, partial(decoded_video, k)) for k in range(SWEEPS)]
    second = CameraSensor(
        "right",
        CAMERA_MODEL,
        LazyFrames.of(shots, SHOTS.tolist()),
        poses=still(right, SHOTS) if odd else ridden(right, SHOTS),
        mount=right,
        coordinates=Coordinates.EGO if odd else Coordinates.WORLD,
        video=VideoContent(partial(read_back, video()), "h264"),
        fps=10.0,
    )
    return first, second


def depth_camera(odd):
    location = mount(1.5, 0.3, 1.5, FRONT)
    images = []
    for k in range(SWEEPS):
        steps = np.arange(48 * 64).reshape(48, 64) % 500 + k
        image = DepthFrame.of(int(SHOTS[k]), CAMERA_MODEL, (steps * 0.001).astype(np.float32))
        own = OWN_CAMERA_MODEL if odd and k == 1 else CAMERA_MODEL
        images.append(
            DepthFrame(
                image.timestamp_ns,
                own,
                image.decode,
                scale=0.001,
                mount=mount(1.5, 0.31, 1.5, FRONT) if odd and k == 1 else None,
                extras={"gain": k},
            )
        )
    return DepthCameraSensor(
        "depth",
        CAMERA_MODEL,
        LazyFrames.of(images, SHOTS.tolist()),
        poses=still(location, SHOTS) if odd else ridden(location, SHOTS),
        mount=location,
        coordinates=Coordinates.EGO if odd else Coordinates.WORLD,
        video=VideoContent(partial(read_back, video()), "h264") if odd else None,
        fps=10.0,
        parent_id="left",
        extras={"baseline": 0.05},
    )


def samples(columns, offset):
    values = np.linspace(offset, offset + 1, SWEEPS * columns).reshape(SWEEPS, columns)
    return VectorSamples(TIMES.copy(), values, SECONDS.copy())


def motion_sensors(odd):
    streams = {
        "accelerometer": samples(3, 9.0),
        "gyroscope": samples(3, 0.1),
        "magnetometer": samples(3, 40.0),
        "imuTemperature": samples(1, 300.0),
    }
    fixes = np.stack(
        [np.linspace(48.1, 48.1001, SWEEPS), np.linspace(11.5, 11.5001, SWEEPS), np.full(SWEEPS, 520.5)], 1
    )
    gnss = GnssSensor(
        "antenna",
        TIMES.copy(),
        fixes,
        np.array([1.0, 1.5, 2.0]),
        np.array([2.0, 2.5, 3.0]),
        SECONDS.copy(),
        mount(0.1, 0.2, 1.9),
        "odometer",
        {"receiver": "u-blox"},
    )
    return (
        OdometrySensor("odometer", path(0.0 if odd else 1.0), "imu_box", {"wheel": "rear"}),
        ImuSensor("imu_box", streams, "top", {"temperature_drift": 0.1}),
        gnss,
    )


def cuboid_rows():
    return np.array([[4.0, 2.0, 1.5, 10.0 + k, 1.0, 0.75, 0.0, 0.0, 5.0 * k] for k in range(SWEEPS)])


def box_rows():
    return np.array([[10.0 + k, 12.0, 20.0, 15.0] for k in range(SWEEPS)])


def cuboid():
    seen = Activation("top", TIMES[:2].copy(), (50_000_000, 60_000_000), cuboid_rows()[:2], {"how": "by hand"})
    projection = Projection("left", SHOTS.copy(), box_rows(), (True, False, True), cuboid_rows(), {"tool": "pencil"})
    return CuboidAnnotation(
        "car-1",
        CuboidPath(TIMES.copy(), cuboid_rows(), {"interpolated": "no"}),
        label="car",
        stationary=False,
        parent_id="group-1",
        attributes=attributes("speed"),
        activations=(seen,),
        projections=(projection,),
        extras={"track_id": 7},
    )


def keypoints():
    def point(k):
        locations = np.array([[5.0 + k, 1.0, 0.5 * j] for j in range(SWEEPS)])
        return PointPath(TIMES.copy(), locations, f"p{k}", {"visible": True})

    def seen(k):
        pixels = np.array([[10.0 + k, 20.0 + j] for j in range(SWEEPS)])
        locations = np.array([[5.0 + k, 1.5, 0.5 * j] for j in range(SWEEPS)])
        return (PointProjection("left", SHOTS.copy(), pixels, (True, True, False), locations, {"by": "x"}),)

    return PointsAnnotation(
        "person-1",
        (point(0), point(1)),
        labels=("head", "hand"),
        projections=(seen(0), seen(1)),
        sensor_id="left",
        stationary=True,
        parent_id="group-1",
        attributes=attributes("pose"),
        extras={"skeleton": "coco"},
    )


def shapes():
    outline = np.array([[1.0, 2.0, 0.0], [5.0, 2.0, 0.0], [5.0, 6.0, 0.5]])
    lane = VertexPath(TIMES[:2].copy(), (outline, outline + 0.5), {"drawn": "twice"})
    stated = {"parent_id": "group-1", "attributes": attributes("paint"), "extras": {"width": 0.15}}
    drawn = VertexPath(SHOTS[:1].copy(), (outline[:, :2] * 5,), {})
    return (
        ShapeAnnotation("lane-1", ShapeType.POLYLINE, lane, "top", True, "lane", True, **stated),
        ShapeAnnotation("sign-1", ShapeType.POLYGON_2D, drawn, "left", label="sign"),
    )


def annotations():
    stated = {"parent_id": "group-1", "attributes": attributes("state"), "extras": {"reviewed": True}}
    rows = np.array([1, 3, 5], np.uint32)
    drawn = BoxPath(SHOTS.copy(), box_rows(), {"drawn": "by hand"})
    return (
        cuboid(),
        Box2DAnnotation("light-1", "left", drawn, "light", True, **stated),
        *shapes(),
        keypoints(),
        EventAnnotation("event-1", int(TIMES[1]), 30_000_000, "braking", "top", **stated),
        LabeledPointsAnnotation(
            "tree-1",
            (LabeledPoints("top", rows, 1, {"by": "brush"}),),
            "tree",
            True,
            **stated,
            type="point_segmentation",
        ),
        LocalizationAdjustment("adjust-1", path(0.01), "group-1", {"source": "map"}),
        CameraCalibration(
            "calib-1", "left", still(mount(0.01, 0, 0)), OWN_CAMERA_MODEL, 1_000_000, "group-1", {"rms": 0.2}
        ),
        ObjectAnnotation("object-1", "vehicle", **stated, type="attributes"),
        LinkAnnotation("link-1", "car-1", "person-1", "drives", True, "top", **stated),
        GroupAnnotation("group-1", "platoon", "object-1", attributes("size"), {"colour": "red"}),
        PlainAnnotation("odd-1", "scribble", {"strokes": [1, 2, 3]}),
    )


def trajectories():
    first, second = path(), path(0.01)
    covariances = np.tile(np.diag([1e-4] * 3 + [1e-2] * 3), (len(TRAJECTORY_TIMES), 1, 1))
    seconds = TRAJECTORY_TIMES / 1e9
    return {
        "vio": Trajectory(
            "vio", TRAJECTORY_TIMES.copy(), first.positions, first.quaternions_xyzw, seconds, covariances
        ),
        "gnss_ins": Trajectory("gnss_ins", TRAJECTORY_TIMES.copy(), second.positions, second.quaternions_xyzw),
    }


def injected_scene(*, odd, corrections=True):
    """The drive.

    Args:
        odd: points and poses are in the ego's frame, images have camera models and mountings of their own.
        corrections: it has annotations that repair its locations and a camera.
    """
    frame = PointsFrame.EGO if odd else PointsFrame.SENSOR
    return Scene(
        (
            lidar(frame),
            *cameras(odd),
            radar(frame),
            PointsSensor("map", RANDOM_POINTS[0], np.full((POINTS, 3), 9, np.uint8), "odometer", {"tile": "A7"}),
            depth_camera(odd),
            *motion_sensors(odd),
            PlainSensor("thermometer", "temperature", {"unit": "K", "readings": [290, 291]}),
        ),
        annotations=tuple(
            annotation
            for annotation in annotations()
            if corrections or not isinstance(annotation, LocalizationAdjustment | CameraCalibration)
        ),
        trajectories=trajectories(),
        attributes=(AttributePath("weather", ("rain",), TIMES[:1].copy(), sensor_id="left"),),
        metadata={"location": "Munich", "euler": {"of": "us"}},
        time_offset_ns=1_000_000_000,
        source="injected",
        extras={"licence": "CC0"},
    )
