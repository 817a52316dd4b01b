"""What is reported two scenes that differ in one known thing, and that nothing is reported equal ones."""

from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.editing import simplify_scene
from sceneloom.editing.diff import Change, apart, diff_scenes, pairs
from sceneloom.errors import OptionError
from sceneloom.geometry.euler import cuboid_angles_from_rotation
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    AttributePath,
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    DataWarning,
    EventAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    OdometrySensor,
    PointPath,
    PointsAnnotation,
    PointsFrame,
    Poses,
    Projection,
    Scene,
    ShapeAnnotation,
    ShapeType,
    Trajectory,
    VertexPath,
    WarningKind,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.simulate import LidarSpec, TrafficSpec

CAMERA_MODEL = Camera("pinhole", 8, 6, 5.0, 5.0, 3.5, 2.5)
TIMESTAMPS = np.array([0, 100, 200])
COARSE = LidarSpec(beams=8, steps=90)


def a_path(timestamps=TIMESTAMPS, *, x=0.0):
    positions = np.column_stack([timestamps * 0.01 + x, timestamps * 0.0, timestamps * 0.0])
    return Poses(timestamps, positions, np.tile([0.0, 0.0, 0.6, 0.8], (len(timestamps), 1)))


def sweeps(count=3, *, moved=None, extra=0):
    frames = []
    for k in range(count):
        positions = np.arange(30, dtype=np.float32).reshape(10, 3) + k
        if moved and k in moved:
            positions[4] += np.float32(moved[k])
            positions = np.concatenate([positions, positions[:extra]])
        points = LidarPoints(positions, intensities=np.full(len(positions), 9, np.uint8))
        frames.append(LidarFrame(int(TIMESTAMPS[k]), points))
    return LazyFrames.of(frames, [frame.timestamp_ns for frame in frames])


def a_image(k, *, value=7, encoded=b"jpeg"):
    rgb = np.full((6, 8, 3), value, np.uint8)
    return replace(
        CameraImage.of(int(TIMESTAMPS[k]), CAMERA_MODEL, rgb), encoded=None if encoded is None else (lambda: encoded)
    )


def a_camera(images=None):
    made = images or [a_image(k) for k in range(3)]
    return CameraSensor("camera", CAMERA_MODEL, LazyFrames.of(made, [p.timestamp_ns for p in made]), poses=a_path())


def a_cuboid(identifier="car", *, yaw=30.0, x=5.0, timestamps=TIMESTAMPS, **more):
    values = np.tile([4.0, 2.0, 1.5, x, 0.0, 0.0, 0.0, 0.0, yaw], (len(timestamps), 1))
    return CuboidAnnotation(identifier, CuboidPath(np.asarray(timestamps), values), **more)


def a_scene(**more):
    given = {
        "sensors": (
            LidarSensor("lidar", sweeps(), mount=RigidTransform(np.eye(3), np.array([0.0, 0.0, 2.0]))),
            a_camera(),
            OdometrySensor(7, a_path()),
        ),
        "annotations": (a_cuboid(), EventAnnotation("event", 50, label="stop")),
        "trajectories": {"trajectory": Trajectory("trajectory", TIMESTAMPS, a_path().positions)},
        "metadata": {"location": "here", "weather": {"rain": 0.5, "words": ["wet", "dark"]}},
    }
    return Scene(**{**given, **more})


def with_lidar(frames):
    scene = a_scene()
    return replace(scene, sensors=(replace(scene.sensors[0], frames=frames), *scene.sensors[1:]))


def only(first, second, **tolerances):
    (difference,) = diff_scenes(first, second, **tolerances).differences
    return difference


def test_equal_scenes_do_not_differ():
    assert diff_scenes(a_scene(), a_scene()).equal


def test_where_a_scene_comes_from_does_not_count():
    note = DataWarning(kind=WarningKind.ASSUMED, code="x", location="y", message="z")
    assert diff_scenes(a_scene(), a_scene(source="elsewhere", format="sfs", warnings=(note,))).equal


def test_moved_points_are_reported_once_with_the_largest_distance():
    found = only(a_scene(), with_lidar(sweeps(moved={0: (0, 0, 0.5), 2: (0.3, 0.4, 1.2)})))
    assert found.path == "sensors['lidar'].frames[].points.positions"
    assert (found.change, found.unit, found.count, found.frame) == (Change.CHANGED, "m", 2, 2)
    assert found.amount == pytest.approx(1.3, abs=1e-5)  # float32 coordinates
    assert "1 of 10 rows differ, row 4 most" in found.message


def test_a_tolerance_lets_pass_what_is_within_it():
    moved = with_lidar(sweeps(moved={1: (0, 0, 0.5)}))
    assert not diff_scenes(a_scene(), moved, tolerance_m=0.49).equal
    assert diff_scenes(a_scene(), moved, tolerance_m=0.51).equal


def test_other_numbers_of_points_are_reported_as_such():
    found = only(a_scene(), with_lidar(sweeps(moved={1: (0, 0, 0)}, extra=3)))
    assert (found.path, found.amount, found.unit) == ("sensors['lidar'].frames[].points", 3.0, "points")
    assert found.message == "10 points; then 13"


def test_frames_are_the_same_by_their_timestamps():
    fewer = with_lidar(sweeps(2))
    assert (only(a_scene(), fewer).change, only(a_scene(), fewer).frame) == (Change.REMOVED, 2)
    assert only(fewer, a_scene()).change is Change.ADDED


@pytest.mark.parametrize(
    ("first", "second", "tolerance", "expected"),
    [
        ([0, 10], [0, 10], 0, [(0, 0), (1, 1)]),
        ([0, 10, 20], [10, 30], 0, [(0, None), (1, 0), (2, None), (None, 1)]),
        ([0, 10], [3, 12], 2, [(0, None), (None, 0), (1, 1)]),
        ([0, 10], [3, 12], 3, [(0, 0), (1, 1)]),
        ([], [5], 0, [(None, 0)]),
    ],
)
def test_frames_are_paired_in_the_order_of_their_timestamps(first, second, tolerance, expected):
    assert list(pairs(np.array(first, np.int64), np.array(second, np.int64), tolerance)) == expected


def test_timestamps_within_the_tolerance_are_the_same_and_others_are_reported():
    later = with_lidar(
        LazyFrames.of([replace(f, timestamp_ns=f.timestamp_ns + 3) for f in sweeps()], (TIMESTAMPS + 3).tolist())
    )
    assert diff_scenes(a_scene(), later, tolerance_ns=3).equal
    changes = diff_scenes(a_scene(), later, tolerance_ns=2).differences
    assert {(c.change, c.count) for c in changes} == {(Change.REMOVED, 3), (Change.ADDED, 3)}


def test_timestamps_of_today_are_compared_to_the_nanosecond():
    first = np.array([1_700_000_000_000_000_001], np.int64)
    assert apart(first, first + 1, "ns").tolist() == [1.0]


def test_images_are_compared_byte_by_byte():
    images = [a_image(0), a_image(1, encoded=b"other"), a_image(2)]
    changed = a_scene(sensors=(a_scene().sensors[0], a_camera(images), a_scene().sensors[2]))
    found = only(a_scene(), changed)
    assert (found.path, found.message, found.frame) == ("sensors['camera'].images[].content", "other bytes", 1)
    assert diff_scenes(a_scene(), changed, pixels=True).equal


def test_pixels_are_compared_on_request():
    images = [a_image(0), a_image(1, value=9, encoded=b"other"), a_image(2)]
    changed = a_scene(sensors=(a_scene().sensors[0], a_camera(images), a_scene().sensors[2]))
    found = only(a_scene(), changed, pixels=True)
    assert (found.path, found.amount, found.unit) == ("sensors['camera'].images[].rgb", 2.0, "of 255")


def test_images_without_bytes_are_reported_to_be_left_out():
    bare = a_scene(sensors=(a_camera([a_image(k, encoded=None) for k in range(3)]),))
    other = a_scene(sensors=(a_camera([a_image(k, value=8, encoded=None) for k in range(3)]),))
    passed = diff_scenes(bare, other)
    assert passed.equal
    assert len(passed.not_compared) == 1
    assert only(bare, other, pixels=True).count == 3


def test_another_camera_model_and_another_mounting_are_reported_by_their_fields():
    scene = a_scene()
    rotation = RigidTransform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.0, 3.0, 6.0]))
    lidar = replace(scene.sensors[0], mount=rotation)
    camera = replace(scene.sensors[1], camera=replace(CAMERA_MODEL, fx=5.5))
    found = diff_scenes(scene, replace(scene, sensors=(lidar, camera, scene.sensors[2]))).differences
    assert {(f.path, round(f.amount, 6), f.unit) for f in found} == {
        ("sensors['lidar'].mount.rotation", 90.0, "deg"),
        ("sensors['lidar'].mount.translation", 4.0, "m"),
        ("sensors['camera'].camera.fx", 0.5, ""),
    }


def test_a_quaternion_and_its_negative_are_one_rotation():
    scene, path = a_scene(), a_path()
    rotated = Poses(path.timestamps_ns, path.positions, -path.quaternions_xyzw)
    assert diff_scenes(scene, replace(scene, sensors=(*scene.sensors[:2], OdometrySensor(7, rotated)))).equal


def test_paths_reported_at_other_timestamps_are_compared_as_ways():
    scene = a_scene()
    fewer = replace(scene, sensors=(*scene.sensors[:2], OdometrySensor(7, a_path(np.array([0, 200])))))
    found = only(scene, fewer)
    assert (found.path, found.unit) == ("sensors[7].poses", "m")
    assert found.amount == pytest.approx(0.0, abs=1e-12)
    assert found.message.startswith("3 timestamps; then 2; as paths up to")
    assert diff_scenes(scene, fewer, tolerance_m=1e-9, tolerance_deg=1e-6, other_timestamps=True).equal
    bent = a_path(np.array([0, 50, 200]))
    aside = np.array([[0, 0, 0], [0, 0.3, 0], [0, 0, 0]])
    bent = Poses(bent.timestamps_ns, bent.positions + aside, bent.quaternions_xyzw)
    other = replace(scene, sensors=(*scene.sensors[:2], OdometrySensor(7, bent)))
    assert only(scene, other, tolerance_m=0.2, other_timestamps=True).amount == pytest.approx(0.3)


def test_paths_of_other_times_are_reported_by_their_timestamps():
    scene = a_scene()
    shorter = replace(scene, sensors=(*scene.sensors[:2], OdometrySensor(7, a_path(np.array([0, 100])))))
    paths = {f.path for f in diff_scenes(scene, shorter, tolerance_m=9.0, other_timestamps=True).differences}
    assert "sensors[7].poses.timestamps_ns" in paths


def test_a_simplified_scene_is_the_same_within_its_tolerances():
    scene = sceneloom.simulate_street(1, frames=3, lidar=COARSE, cameras=(), traffic=TrafficSpec()).scene
    simple = simplify_scene(scene, tolerance_m=0.05, tolerance_deg=0.5)
    assert not diff_scenes(scene, simple).equal
    within = {"tolerance_m": 0.05, "tolerance_deg": 0.5, "other_timestamps": True}
    assert diff_scenes(scene, simple, **within).differences == ()
    assert not diff_scenes(scene, simple, **{**within, "tolerance_m": 0.01}).equal


def test_annotations_are_the_same_by_their_ids():
    scene = a_scene()
    changed = replace(scene, annotations=(a_cuboid("truck", label="truck"), scene.annotations[1]))
    found = diff_scenes(scene, changed).differences
    assert [(f.path, f.change, f.message) for f in found] == [
        ("annotations['car']", Change.REMOVED, "cuboid"),
        ("annotations['truck']", Change.ADDED, "cuboid 'truck'"),
    ]


def test_an_id_that_is_a_number_is_not_its_text():
    found = diff_scenes(a_scene(annotations=(a_cuboid(1),)), a_scene(annotations=(a_cuboid("1"),))).differences
    assert {f.path for f in found} == {"annotations[1]", "annotations['1']"}


def test_another_order_of_sensors_is_reported():
    scene = a_scene()
    found = only(scene, replace(scene, sensors=scene.sensors[::-1]))
    assert (found.path, found.message) == ("sensors", "in another order")


def test_what_changed_of_a_cuboid_is_reported_in_metres_and_degrees():
    found = diff_scenes(a_scene(), a_scene(annotations=(a_cuboid(yaw=32.0, x=5.5), a_scene().annotations[1])))
    assert {(f.path, round(f.amount, 6), f.unit) for f in found.differences} == {
        ("annotations['car'].path.values.position", 0.5, "m"),
        ("annotations['car'].path.values.rotation", 2.0, "deg"),
    }


def test_cuboids_reported_in_radians_and_another_order_are_the_same_cuboids():
    first = a_cuboid()
    values = first.path.values.copy()
    values[:, 6:] = [20.0, -10.0, 200.0]
    degrees = replace(first, path=CuboidPath(TIMESTAMPS, values))
    rotated = CuboidAngles().quaternions(values[:, 6:])
    radians = values.copy()
    matrices = np.stack([RigidTransform.from_quaternion(np.zeros(3), q).rotation for q in rotated])
    radians[:, 6:] = cuboid_angles_from_rotation(matrices, unit="radians", order="zyx")
    other = replace(first, path=CuboidPath(TIMESTAMPS, radians))
    ours = {"euler_unit": "radians", "euler_order": "zyx"}
    found = diff_scenes(Scene((), (degrees,)), Scene((), (other,), metadata={"sceneloom": ours}), tolerance_deg=1e-9)
    assert [f.path for f in found.differences] == ["metadata['sceneloom']"]


def test_nan_is_equal_to_nan_and_far_from_numbers():
    boxes = np.array([[np.nan] * 4, [1.0, 2.0, 3.0, 4.0]])
    first = a_cuboid(projections=(Projection("camera", TIMESTAMPS[:2], boxes),))
    second = a_cuboid(projections=(Projection("camera", TIMESTAMPS[:2], boxes[::-1].copy()),))
    copied = replace(first, projections=(Projection("camera", TIMESTAMPS[:2], boxes.copy()),))
    assert diff_scenes(Scene((), (first,)), Scene((), (copied,))).equal
    found = only(Scene((), (first,)), Scene((), (second,)), tolerance_px=1e9)
    assert (found.path, found.amount) == ("annotations['car'].projections['camera'].boxes", np.inf)


def test_paths_and_points_without_timestamps_are_compared():
    nothing = np.zeros(0, np.int64)
    empty = PointsAnnotation("p", (PointPath(nothing, np.zeros((0, 3))),))
    labelled = LabeledPointsAnnotation("l", (LabeledPoints("top", np.zeros(0, np.uint32)),))
    first, second = Scene((), (empty, labelled)), Scene((), (replace(empty), replace(labelled)))
    copied = replace(empty, paths=(PointPath(nothing.copy(), np.zeros((0, 3))),))
    assert diff_scenes(first, second).equal
    assert diff_scenes(first, Scene((), (copied, labelled))).equal
    assert diff_scenes(first, Scene((), (copied, labelled)), other_timestamps=True, tolerance_m=1.0).equal
    reported = replace(empty, paths=(PointPath(TIMESTAMPS, np.zeros((3, 3))),))
    assert not diff_scenes(first, Scene((), (reported, labelled)), other_timestamps=True).equal


def test_a_unit_of_times_that_is_not_stated_is_the_usual_one():
    stated = Scene((), extras={"time_unit": "microseconds"})
    assert diff_scenes(Scene(()), stated).equal
    assert not diff_scenes(Scene(()), replace(stated, extras={"time_unit": "nanoseconds"})).equal


def test_attributes_are_the_same_by_name_and_sensor():
    reported = (AttributePath("colour", ("red",)), AttributePath("points", (3,), TIMESTAMPS[:1], sensor_id="lidar"))
    other = (AttributePath("points", (4,), TIMESTAMPS[:1], sensor_id="lidar"), AttributePath("colour", ("red",)))
    found = only(Scene((), (a_cuboid(attributes=reported),)), Scene((), (a_cuboid(attributes=other),)))
    assert found.path == "annotations['car'].attributes['points', 'lidar'].values[0]"
    assert (found.message, found.amount) == ("3; then 4", 1.0)


def test_vertices_are_counted_in_pixels_or_metres():
    def line(kind, vertices):
        path = VertexPath(np.array([0]), (np.array(vertices, float),))
        return Scene((), (ShapeAnnotation("s", kind, path, sensor_id="camera"),))

    flat = only(line(ShapeType.POLYLINE_2D, [[0, 0], [3, 4]]), line(ShapeType.POLYLINE_2D, [[0, 0], [3, 6]]))
    deep = only(line(ShapeType.POLYLINE, [[0, 0, 0]]), line(ShapeType.POLYLINE, [[3, 4, 0]]))
    assert (flat.amount, flat.unit, deep.amount, deep.unit) == (2.0, "px", 5.0, "m")


def test_metadata_are_compared_key_by_key():
    changed = a_scene(metadata={"location": "there", "weather": {"rain": 0.5, "words": ["wet"]}, "new": 1})
    found = {(f.path, f.change) for f in diff_scenes(a_scene(), changed).differences}
    assert found == {
        ("metadata['location']", Change.CHANGED),
        ("metadata['weather']['words']", Change.CHANGED),
        ("metadata['new']", Change.ADDED),
    }


def test_true_is_not_one_and_text_no_number():
    for first, second in ((True, 1), ("1", 1), (None, 0), ([], {})):
        assert not diff_scenes(a_scene(metadata={"x": first}), a_scene(metadata={"x": second})).equal
    assert diff_scenes(a_scene(metadata={"x": float("nan")}), a_scene(metadata={"x": float("nan")})).equal


def test_a_sensor_of_another_kind_is_reported():
    scene = a_scene()
    found = only(scene, replace(scene, sensors=(*scene.sensors[:2], LidarSensor(7, sweeps()))))
    assert found.message == "OdometrySensor; then LidarSensor"


def test_tolerances_that_are_none_are_refused():
    with pytest.raises(OptionError, match="tolerance -1"):
        diff_scenes(a_scene(), a_scene(), tolerance_m=-1.0)


def test_frames_are_read_in_pairs_and_progress_is_reported():
    read, reported = [], []
    frames = sweeps()

    class Reading:
        def __call__(self, k):
            read.append(k)
            return frames[k]

    lazy = with_lidar(LazyFrames(TIMESTAMPS, Reading()))
    diff_scenes(lazy, lazy, progress=lambda done, total: reported.append((done, total)))
    assert read == [0, 0, 1, 1, 2, 2]
    assert reported[-1] == (6, 6)


def test_a_written_scene_is_equal_to_what_was_written(tmp_path):
    drive = sceneloom.simulate_street(1, frames=2, cameras=()).scene
    sceneloom.write(drive, tmp_path / "a.sfs", time_unit="nanoseconds")
    with sceneloom.open(tmp_path / "a.sfs") as first:
        sceneloom.write(first, tmp_path / "b.sfs", time_unit="nanoseconds")
        with sceneloom.open(tmp_path / "b.sfs") as second:
            assert diff_scenes(first, second).differences == ()


def test_values_of_closed_sets_are_reported_by_their_words():
    scene = Scene((LidarSensor("top", sweeps()),))
    other = Scene((replace(scene.lidars[0], points_frame=PointsFrame.WORLD),))
    messages = [d.message for d in diff_scenes(scene, other).differences]
    assert messages == ["'sensor'; then 'world'"]


def test_what_is_no_scene_is_refused_with_what_to_do():
    with pytest.raises(OptionError, match=r"'a\.sfs'; expected a scene: `sceneloom\.open`"):
        diff_scenes("a.sfs", Scene(()))
