"""A small drive in which every field of the model holds something that is distinguished from all else."""

import io
from functools import cache, partial

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.formats.base.images import EncodedImage
from sceneloom.formats.video.reader import VideoReader
from sceneloom.formats.video.writer import VideoWriter
from sceneloom.geometry.rigid import RigidTransform

SWEEPS, POINTS = 3, 40
START_NS = 1_700_000_000_100_200_300
TIMES = START_NS + np.arange(SWEEPS, dtype=np.int64) * 100_000_000
SHOTS = TIMES + 20_000_000
TRAJECTORY_TIMES = START_NS + np.arange(-1, SWEEPS + 2, dtype=np.int64) * 100_000_000
SECONDS = TIMES / 1e9
COEFFICIENTS = (0.1, -0.02, 0.001, 0.002, 0.003)
CAMERA_MODEL = Camera("brown_conrady", 64, 48, 50.0, 51.0, 31.0, 24.0, COEFFICIENTS)
OWN_CAMERA_MODEL = Camera("brown_conrady", 64, 48, 50.5, 51.0, 31.0, 24.0, COEFFICIENTS)
FRONT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""`ego_from_camera` of a camera that looks ahead."""
RANDOM = np.random.default_rng(9)
RANDOM_POINTS = [RANDOM.uniform(2.0, 30.0, (POINTS, 3)).astype(np.float32) for _ in range(SWEEPS)]


def mount(x, y, z, rotation=None):
    return RigidTransform(np.eye(3) if rotation is None else rotation, np.array([x, y, z], np.float64))


def ego_at(times):
    """The ego at 10 m/s along a straight line, rotating slowly: locations and orientations."""
    seconds = (times - START_NS) / 1e9
    return seconds[:, None] * np.array([10.0, 1.0, 0.0]), Rotation.from_euler("z", 0.1 * seconds[:, None])


def path(offset=0.0):
    locations, rotations = ego_at(TRAJECTORY_TIMES)
    return sc.Poses(TRAJECTORY_TIMES.copy(), locations + offset, rotations.as_quat())


def located(transform, odd, times=TIMES):
    """Fields that state a mounting, and where the sensor is: in the world, or as poses onto the ego."""
    locations, rotations = ego_at(times)
    if odd:
        locations, rotations = 0 * locations, Rotation.identity(len(times))
    positions = locations + rotations.apply(transform.translation.copy())
    poses = sc.Poses(times.copy(), positions, (rotations * Rotation.from_matrix(transform.rotation)).as_quat())
    return {"poses": poses, "mount": transform, "coordinates": sc.Coordinates.EGO if odd else sc.Coordinates.WORLD}


def attributes(name):
    return (sc.AttributePath(name, ("slow", "fast"), TIMES[:2].copy(), static=False, extras={"source": "a person"}),)


def lidar(odd):
    def sweep(k):
        points = sc.LidarPoints(
            RANDOM_POINTS[k],
            intensities=np.arange(POINTS, dtype=np.uint8) + k,
            colors=(np.arange(POINTS * 3, dtype=np.uint8) + k).reshape(POINTS, 3),
            timestamps_ns=TIMES[k] + np.arange(POINTS, dtype=np.int64) * 1_000_001,
            rings=(np.arange(POINTS) % 4).astype(np.uint16),
            camera_index=(np.arange(POINTS) % 2).astype(np.uint8),
            extras={"reflectivity": np.linspace(0, 1, POINTS, dtype=np.float32)},
        )
        return sc.LidarFrame(int(TIMES[k]), points, {"sweep_note": f"number {k}"})

    return sc.LidarSensor(
        "top",
        sc.LazyFrames.of([sweep(k) for k in range(SWEEPS)], TIMES.tolist()),
        points_frame=sc.PointsFrame.EGO if odd else sc.PointsFrame.SENSOR,
        model="Velodyne HDL-64E",
        parent_id="odometer",
        extras={"serial": "A1"},
        **located(mount(1.0, 0.0, 1.8), odd),
    )


def radar(odd):
    def cycle(k):
        positions = RANDOM_POINTS[k][:5]
        points = sc.RadarPoints(
            positions,
            directions=(positions / np.linalg.norm(positions, axis=1, keepdims=True)).astype(np.float32),
            lengths=np.linspace(-2, 2, 5, dtype=np.float32),
            timestamps_ns=TIMES[k] + np.arange(5, dtype=np.int64) * 2_000_003,
            extras={"rcs": np.linspace(1, 5, 5, dtype=np.float32)},
        )
        return sc.RadarFrame(int(TIMES[k]), points, {"cycle": k})

    return sc.RadarSensor(
        "radar_front",
        sc.LazyFrames.of([cycle(k) for k in range(SWEEPS)], TIMES.tolist()),
        points_frame=sc.PointsFrame.EGO if odd else sc.PointsFrame.SENSOR,
        parent_id="odometer",
        extras={"band": "77 GHz"},
        **located(mount(3.5, 0.2, 0.5), odd),
    )


@cache
def jpeg(k):
    rows, columns = np.mgrid[0:48, 0:64]
    rgb = np.stack([columns * 3 + k, rows * 4, 0 * rows + 20 * k], axis=2).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "JPEG", quality=90)
    return file.getvalue()


@cache
def video():
    file = io.BytesIO()
    with VideoWriter(file, 64, 48, 10.0, container="mp4") as writer:
        for k in range(SWEEPS):
            writer.add(EncodedImage(jpeg(k), "jpeg", 64, 48)(), k / 10)
    return file.getvalue()


def decoded_video(k):
    with VideoReader(video()) as reader:
        return reader.rgb(k)


def own(odd, k, x, y):
    """The camera model of an image, and its own mounting where it has one."""
    differs = odd and k == 1
    return OWN_CAMERA_MODEL if differs else CAMERA_MODEL, mount(x, y, 1.5, FRONT) if differs else None


def cameras(odd):
    images = []
    for k in range(SWEEPS):
        image, (own_model, place) = EncodedImage(jpeg(k), "jpeg", 64, 48), own(odd, k, 1.51, 0.1)
        extras = {"exposureTimeSeconds": 0.01, "note": f"image {k}"}
        images.append(
            sc.CameraImage(int(SHOTS[k]), own_model, image, mount=place, extras=extras, encoded=image.encoded)
        )
    first = sc.CameraSensor(
        "left",
        CAMERA_MODEL,
        sc.LazyFrames.of(images, SHOTS.tolist()),
        fps=10.0,
        parent_id="odometer",
        extras={"camera_model_serial": "L7"},
        **located(mount(1.5, 0.1, 1.5, FRONT), odd, SHOTS),
    )
    shots = [sc.CameraImage(int(SHOTS[k]), CAMERA_MODEL, partial(decoded_video, k)) for k in range(SWEEPS)]
    second = sc.CameraSensor(
        "right",
        CAMERA_MODEL,
        sc.LazyFrames.of(shots, SHOTS.tolist()),
        video=sc.VideoContent(partial(io.BytesIO, video()), "h264"),
        fps=10.0,
        **located(mount(1.5, -0.1, 1.5, FRONT), odd, SHOTS),
    )
    return first, second


def depth_camera(odd):
    images = []
    for k in range(SWEEPS):
        steps = np.arange(48 * 64).reshape(48, 64) % 500 + k
        decode = sc.DepthFrame.of(int(SHOTS[k]), CAMERA_MODEL, (steps * 0.001).astype(np.float32)).decode
        own_model, place = own(odd, k, 1.5, 0.31)
        images.append(sc.DepthFrame(int(SHOTS[k]), own_model, decode, scale=0.001, mount=place, extras={"gain": k}))
    return sc.DepthCameraSensor(
        "depth",
        CAMERA_MODEL,
        sc.LazyFrames.of(images, SHOTS.tolist()),
        video=sc.VideoContent(partial(io.BytesIO, video()), "h264") if odd else None,
        fps=10.0,
        parent_id="left",
        extras={"baseline": 0.05},
        **located(mount(1.5, 0.3, 1.5, FRONT), odd, SHOTS),
    )


def motion_sensors(odd):
    def samples(columns, offset):
        values = np.linspace(offset, offset + 1, SWEEPS * columns).reshape(SWEEPS, columns)
        return sc.VectorSamples(TIMES.copy(), values, SECONDS.copy())

    streams = {
        "accelerometer": (3, 9.0),
        "gyroscope": (3, 0.1),
        "magnetometer": (3, 40.0),
        "imuTemperature": (1, 300.0),
    }
    fixes = np.linspace([48.1, 11.5, 520.5], [48.1001, 11.5001, 520.5], SWEEPS)
    accuracies = np.array([1.0, 1.5, 2.0])
    antenna = mount(0.1, 0.2, 1.9), "odometer", {"receiver": "u-blox"}
    return (
        sc.OdometrySensor("odometer", path(0.0 if odd else 1.0), "imu_box", {"wheel": "rear"}),
        sc.ImuSensor("imu_box", {k: samples(*v) for k, v in streams.items()}, "top", {"temperature_drift": 0.1}),
        sc.GnssSensor("antenna", TIMES.copy(), fixes, accuracies, accuracies + 1, SECONDS.copy(), *antenna),
    )


CUBOIDS = np.array([[4.0, 2.0, 1.5, 10.0 + k, 1.0, 0.75, 0.0, 0.0, 5.0 * k] for k in range(SWEEPS)])
BOXES = np.array([[10.0 + k, 12.0, 20.0, 15.0] for k in range(SWEEPS)])


def cuboid():
    seen = sc.Activation("top", TIMES[:2].copy(), (50_000_000, 60_000_000), CUBOIDS[:2].copy(), {"how": "by hand"})
    confirmed = True, False, True
    projection = sc.Projection("left", SHOTS.copy(), BOXES.copy(), confirmed, CUBOIDS.copy(), {"tool": "pencil"})
    return sc.CuboidAnnotation(
        "car-1",
        sc.CuboidPath(TIMES.copy(), CUBOIDS.copy(), {"interpolated": "no"}),
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
        return sc.PointPath(TIMES.copy(), locations, f"p{k}", {"visible": True})

    def seen(k):
        pixels = np.array([[10.0 + k, 20.0 + j] for j in range(SWEEPS)])
        locations = np.array([[5.0 + k, 1.5, 0.5 * j] for j in range(SWEEPS)])
        return (sc.PointProjection("left", SHOTS.copy(), pixels, (True, True, False), locations, {"by": "x"}),)

    return sc.PointsAnnotation(
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
    lane = sc.VertexPath(TIMES[:2].copy(), (outline, outline + 0.5), {"drawn": "twice"})
    stated = {"parent_id": "group-1", "attributes": attributes("paint"), "extras": {"width": 0.15}}
    drawn = sc.VertexPath(SHOTS[:1].copy(), (outline[:, :2] * 5,), {})
    return (
        sc.ShapeAnnotation("lane-1", sc.ShapeType.POLYLINE, lane, "top", True, "lane", True, **stated),
        sc.ShapeAnnotation("sign-1", sc.ShapeType.POLYGON_2D, drawn, "left", label="sign"),
    )


def annotations():
    stated = {"parent_id": "group-1", "attributes": attributes("state"), "extras": {"reviewed": True}}
    drawn = sc.BoxPath(SHOTS.copy(), BOXES.copy(), {"drawn": "by hand"})
    tree = sc.LabeledPoints("top", np.array([1, 3, 5], np.uint32), 1, {"by": "brush"})
    moved = located(mount(0.01, 0, 0), True)["poses"]
    return (
        cuboid(),
        sc.Box2DAnnotation("light-1", "left", drawn, "light", True, **stated),
        *shapes(),
        keypoints(),
        sc.EventAnnotation("event-1", int(TIMES[1]), 30_000_000, "braking", "top", **stated),
        sc.LabeledPointsAnnotation("tree-1", (tree,), "tree", True, **stated, type="point_segmentation"),
        sc.LocalizationAdjustment("adjust-1", path(0.01), "group-1", {"source": "map"}),
        sc.CameraCalibration("calib-1", "left", moved, OWN_CAMERA_MODEL, 1_000_000, "group-1", {"rms": 0.2}),
        sc.ObjectAnnotation("object-1", "vehicle", **stated, type="attributes"),
        sc.LinkAnnotation("link-1", "car-1", "person-1", "drives", True, "top", **stated),
        sc.GroupAnnotation("group-1", "platoon", "object-1", attributes("size"), {"colour": "red"}),
        sc.PlainAnnotation("odd-1", "scribble", {"strokes": [1, 2, 3]}),
    )


def trajectories():
    covariances = np.tile(np.diag([1e-4] * 3 + [1e-2] * 3), (len(TRAJECTORY_TIMES), 1, 1))
    more = {"vio": (TRAJECTORY_TIMES / 1e9, covariances), "gnss_ins": ()}
    paths = {"vio": path(), "gnss_ins": path(0.01)}
    return {
        name: sc.Trajectory(name, TRAJECTORY_TIMES.copy(), poses.positions, poses.quaternions_xyzw, *more[name])
        for name, poses in paths.items()
    }


def injected_scene(*, odd):
    """The drive; `odd`: points and poses in the ego's frame, images with camera models and mountings of their own."""
    return sc.Scene(
        (
            lidar(odd),
            *cameras(odd),
            radar(odd),
            sc.PointsSensor("map", RANDOM_POINTS[0], np.full((POINTS, 3), 9, np.uint8), "odometer", {"tile": "A7"}),
            depth_camera(odd),
            *motion_sensors(odd),
            sc.PlainSensor("thermometer", "temperature", {"unit": "K", "readings": [290, 291]}),
        ),
        annotations=annotations(),
        trajectories=trajectories(),
        attributes=(sc.AttributePath("weather", ("rain",), TIMES[:1].copy(), sensor_id="left"),),
        metadata={"location": "Munich", "euler": {"of": "us"}},
        time_offset_ns=1_000_000_000,
        source="injected",
        extras={"licence": "CC0"},
    )
