"""Our files against Scale's own library, which runs in an interpreter of its own."""

import json
import subprocess

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import SceneWriter, write_scene
from sceneloom.scene import (
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    GnssSensor,
    GroupAnnotation,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    LinkAnnotation,
    OdometrySensor,
    PlainSensor,
    PointPath,
    PointsAnnotation,
    PointsFrame,
    PointsSensor,
    Poses,
    RadarFrame,
    RadarPoints,
    RadarSensor,
    Scene,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)

READ = """
import contextlib, io, json, sys
import numpy as np
with contextlib.redirect_stdout(io.StringIO()):
    from scale_json_binary import read_file
    from scale_sensor_fusion_io.loaders import SFSLoader
    from scale_sensor_fusion_io.validation import parse_and_validate_scene
    result = parse_and_validate_scene(read_file(sys.argv[1]))
    scene = SFSLoader(sys.argv[1]).load()

def numbers(array):
    return None if array is None else np.asarray(array).tolist()

def sensor(s):
    out = {"id": s.id, "type": s.type.value, "times": [int(t) for t in s.poses.index], "poses": s.poses.values.tolist()}
    if s.type.value == "camera":
        i, d = s.intrinsics, s.intrinsics.distortion
        out["camera_model"] = [i.fx, i.fy, i.cx, i.cy, i.width, i.height]
        out["distortion"] = None if d is None else d.model.value
        out["images"] = [[m.timestamp, len(m.content)] for m in s.images or []]
        out["video"] = None if s.video is None else [s.video.timestamps, len(s.video.content), s.video.fps]
    else:
        out["frames"] = [
            {"timestamp": f.timestamp, "positions": numbers(f.points.positions), "times": numbers(f.points.timestamps),
             "intensities": numbers(getattr(f.points, "intensities", None)),
             "colors": numbers(getattr(f.points, "colors", None))}
            for f in s.frames]
    return out

faults = [] if result.success else [[list(map(str, e.path)), e.errors] for e in result.details]
print(json.dumps({
    "faults": faults,
    "time_offset": scene.time_offset,
    "sensors": [sensor(s) for s in scene.sensors or []],
    "annotations": [[a.id, type(a).__name__] for a in scene.annotations or []],
    "cuboids": [[a.id, a.label, [int(t) for t in a.path.index],
                 a.path[["dx", "dy", "dz", "x", "y", "z", "roll", "pitch", "yaw"]].values.tolist(),
                 [[p.name, p.timestamps, p.values] for p in a.attributes or []]]
                for a in scene.annotations or [] if type(a).__name__ == "CuboidAnnotation"],
}))
"""

WRITE = """
import sys
import numpy as np
from scale_json_binary import write_file
from scale_sensor_fusion_io.model_converters import to_scene_spec_sfs
from scale_sensor_fusion_io.models import (
    AttributePath, CameraDistortion, CameraIntrinsics, CameraSensor, CameraSensorImage, CuboidAnnotation, CuboidPath,
    EventAnnotation, LabeledPoint, LabeledPointsAnnotation, LidarSensor, LidarSensorFrame, LidarSensorPoints,
    LocalizationAdjustmentAnnotation, ObjectAnnotation, Poses, RadarSensor, RadarSensorFrame,
    RadarSensorPoints, Scene,
)
poses = Poses([[1, 2, 3, 0, 0, 0.6, 0.8], [2, 3, 4, 0, 0, 0, 1]], index=[0, 100])
xyz = np.arange(12, dtype=np.float32).reshape(4, 3)
lidar = LidarSensor(id="top", poses=poses, frames=[LidarSensorFrame(timestamp=10, points=LidarSensorPoints(
    positions=xyz, colors=xyz.astype(np.uint8), intensities=np.arange(4, dtype=np.uint8),
    timestamps=np.array([10, 11, 12, 13], np.uint32)))])
radar = RadarSensor(id=2, poses=poses, frames=[RadarSensorFrame(timestamp=10, points=RadarSensorPoints(
    positions=xyz, directions=xyz, timestamps=None))])
distortion = CameraDistortion.from_values("brown_conrady", [0.1, 0.01, 0.001, 0.002])
camera = CameraSensor(id="front", poses=poses, intrinsics=CameraIntrinsics(
    fx=10.0, fy=11.0, cx=3.0, cy=2.0, width=8, height=6, distortion=distortion),
    images=[CameraSensorImage(timestamp=5, content=np.frombuffer(b"\\xff\\xd8\\xff", np.uint8))])
cuboid = CuboidAnnotation(id="c", label="car",
    path=CuboidPath([[1, 2, 3, 90, 0, 0, 4, 2, 1.5]] * 2, index=[0, 100]),
    attributes=[AttributePath(name="colour", timestamps=[0], values=["red"], sensor_id=None, static=True)])
scene = Scene(sensors=[lidar, radar, camera], annotations=[
    cuboid, EventAnnotation(id="e", start=5, duration=3), ObjectAnnotation(id="o", label="thing"),
    LabeledPointsAnnotation(id="l", label="road", is_instance=False, labeled_points=[
        LabeledPoint(sensor_id="top", point_ids=np.array([1, 3], np.uint32), sensor_frame=0)]),
    LocalizationAdjustmentAnnotation(id="a", poses=poses),
], time_offset=1000, time_unit="microseconds", metadata={"town": "Ulm"})
write_file(sys.argv[1], to_scene_spec_sfs(scene))
"""

TWO = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
MS = 1_000_000
START = 1_700_000_000_000 * MS


@pytest.fixture
def scale(scale_python):
    """Run a program in Scale's interpreter."""

    def run(program, path):
        done = subprocess.run(
            [scale_python, "-c", program, str(path)], capture_output=True, text=True, timeout=300, check=False
        )
        assert done.returncode == 0, done.stderr[-2000:]
        return json.loads(done.stdout.splitlines()[-1]) if done.stdout.strip() else None

    return run


def poses(*times_ns, seed=0):
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(len(times_ns), 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Poses(np.array(times_ns, np.int64), rng.normal(size=(len(times_ns), 3)), quaternions)


def a_drive():
    """Every kind of sensor and annotation, with what Scale's library refuses among it."""
    rng = np.random.default_rng(5)
    times = [START + k * 100 * MS for k in range(3)]
    sweeps = []
    for k, t in enumerate(times):
        count = (50, 0, 30)[k]
        points = LidarPoints(
            rng.normal(size=(count, 3)).astype(np.float32),
            rng.integers(0, 256, count).astype(np.uint8),
            rng.integers(0, 256, (count, 3)).astype(np.uint8),
            np.sort(rng.integers(t, t + 100 * MS, count)),
            rng.integers(0, 64, count).astype(np.uint16),
            rng.integers(0, 256, count).astype(np.uint8),
        )
        sweeps.append(LidarFrame(t, points))
    cycle = RadarFrame(times[0], RadarPoints(TWO, TWO, np.array([1.5, 2], np.float32), np.array(times[:2])))
    camera_model = Camera("brown_conrady", 8, 6, 10.0, 11.0, 3.0, 2.0, (0.1, 0.01, 0.001, 0.002))
    wide = Camera("kannala-brandt18", 8, 6, 10.0, 11.0, 3.0, 2.0, (0.1,) * 18)
    images = [CameraImage.of(t, camera_model, np.full((6, 8, 3), 90, np.uint8)) for t in times]
    lazy = LazyFrames.of(images, times)
    row = np.array([[4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 0.0, 0.0, 270.0]])
    timestamps, two = np.array(times[:1]), np.array(times[:2])
    attributes = (AttributePath("speed", (1.5, -2.25), two), AttributePath("colour", ("red", "red"), two, static=True))
    flat, solid = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[1.0, 2.0, 3.0]])
    shapes = [
        ShapeAnnotation(
            kind.value, kind, VertexPath(timestamps, (flat if kind.value.endswith("_2d") else solid,)), "front"
        )
        for kind in ShapeType
        if kind is not ShapeType.POINT_TOPDOWN
    ]
    annotations = [
        CuboidAnnotation("c", CuboidPath(timestamps, row), "car", attributes=attributes),
        Box2DAnnotation("box_2d", "front", BoxPath(timestamps, np.array([[1.0, 2.0, 3.0, 4.0]]))),
        *shapes,
        GroupAnnotation("g", "all"),
        PointsAnnotation("k", (PointPath(timestamps, solid),)),
        EventAnnotation("e", times[1], duration_ns=5 * MS),
        LinkAnnotation("lk", "c", "g", "l", is_bidirectional=False),
    ]
    one = np.ones(1)
    sensors = (
        LidarSensor("top", LazyFrames.of(sweeps, times), poses(*times), points_frame=PointsFrame.WORLD),
        LidarSensor("idle", LazyFrames.of([], []), poses(*times), points_frame=PointsFrame.WORLD),
        RadarSensor("radar", LazyFrames.of([cycle], times[:1]), poses(*times, seed=1)),
        CameraSensor("front", camera_model, lazy, poses(*times, seed=2)),
        CameraSensor("wide", wide, lazy, Poses.identity()),
        OdometrySensor("ego", poses(*times, seed=3)),
        PointsSensor("map", TWO),
        GnssSensor("gnss", np.array(times[:1]), np.ones((1, 3)), one, one),
        PlainSensor("sonar", "sonar", {"depth": 3}),
    )
    scene_attributes = (AttributePath("fog", (0.5,), timestamps),)
    return Scene(sensors, tuple(annotations), attributes=scene_attributes, metadata={"town": "Ulm"})


def timestamps(times_ns, offset_us):
    """Microseconds since the offset, halves to even, by exact fractions."""
    from fractions import Fraction

    return [round(Fraction(int(t), 1000) - offset_us) for t in times_ns]


def test_the_profile_of_scale_loads_and_validates_with_equal_values(scale, tmp_path):
    path, drive = tmp_path / "drive.sfs", a_drive()
    write_scene(drive, path, profile="scale")
    read = scale(READ, path)
    assert read["faults"] == []
    offset = read["time_offset"]
    assert 0 <= START // 1000 - offset < 100_000_000
    sensors = {sensor["id"]: sensor for sensor in read["sensors"]}
    assert sorted(sensors) == ["front", "radar", "top", "wide"]
    for name in ("top", "front", "radar"):
        original = drive.sensor(name).poses
        assert sensors[name]["times"] == timestamps(original.timestamps_ns, offset)
        np.testing.assert_array_equal(
            sensors[name]["poses"], np.hstack([original.positions, original.quaternions_xyzw])
        )
    for frame, original in zip(sensors["top"]["frames"], drive.sensor("top").frames, strict=True):
        points = original.points
        assert len(frame["positions"]) == len(points)
        np.testing.assert_array_equal(np.array(frame["positions"], np.float32).reshape(-1, 3), points.positions)
        if len(points):
            assert frame["times"] == timestamps(points.timestamps_ns, offset)
            assert frame["timestamp"] == int(points.timestamps_ns.min()) // 1000 - offset
            assert frame["intensities"] == points.intensities.tolist()
            assert frame["colors"] == points.colors.tolist()
    assert sensors["front"]["camera_model"] == [10.0, 11.0, 3.0, 2.0, 8, 6]
    assert (sensors["front"]["distortion"], sensors["wide"]["distortion"]) == ("brown_conrady", None)
    assert [image[0] for image in sensors["front"]["images"]] == timestamps(
        drive.sensor("top").frames.timestamps_ns, offset
    )
    identifier, label, times, rows, attributes = read["cuboids"][0]
    assert (identifier, label, rows) == ("c", "car", [[4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 0.0, 0.0, 270.0]])
    assert times == timestamps([START], offset)
    assert attributes[0][2] == [1500, -2250]
    assert len(attributes[1][1]) == 1
    kept = {"c", "box_2d", "polygon_2d", "polygon_topdown", "polyline", "e"}
    assert {identifier for identifier, _ in read["annotations"]} == kept


def test_the_profile_of_the_text_loads_in_scales_library(scale, tmp_path):
    """Its loader takes more than its validator; annotations that it has no converter for are left out here."""
    path, drive = tmp_path / "drive.sfs", a_drive()
    with SceneWriter(path) as writer:
        for name in ("top", "front", "ego", "map"):
            writer.add_sensor(drive.sensor(name))
        writer.add_annotation(EventAnnotation("e", START))
    read = scale(READ, path)
    assert [len(frame["positions"]) for frame in read["sensors"][0]["frames"]] == [50, 0, 30]
    refused = sorted(where[:2] for where, _ in read["faults"])
    assert refused == [["sensors", "2"], ["sensors", "3"]]


def test_a_file_of_that_library_opens_here_and_survives_writing(scale, tmp_path):
    path, ours = tmp_path / "theirs.sfs", tmp_path / "ours.sfs"
    scale(WRITE, path)
    scene = FORMAT.open(path)
    frame = scene.sensor("top").frames[0]
    np.testing.assert_array_equal(frame.points.positions, np.arange(12, dtype=np.float32).reshape(4, 3))
    assert frame.points.timestamps_ns.tolist() == [1_010_000, 1_011_000, 1_012_000, 1_013_000]
    assert frame.points.intensities.tolist() == [0, 1, 2, 3]
    path_of_lidar = scene.sensor("top").poses
    assert path_of_lidar.timestamps_ns.tolist() == [1_000_000, 1_100_000]
    assert path_of_lidar.quaternions_xyzw[0].tolist() == [0, 0, 0.6, 0.8]
    np.testing.assert_array_equal(scene.sensor(2).frames[0].points.directions, frame.points.positions)
    camera = scene.sensor("front").camera
    assert (camera.model, camera.coefficients[:4]) == ("brown_conrady", (0.1, 0.01, 0.001, 0.002))
    by_id = {annotation.id: annotation for annotation in scene.annotations}
    assert by_id["c"].path.values[0].tolist() == [4, 2, 1.5, 1, 2, 3, 0, 0, 90]
    assert by_id["e"].start_ns == 1_005_000
    assert by_id["l"].labeled_points[0].point_ids.tolist() == [1, 3]
    assert scene.metadata["town"] == "Ulm"
    assert len(write_scene(scene, ours, profile="scale")) == 0
    assert scale(READ, ours) == scale(READ, path)
