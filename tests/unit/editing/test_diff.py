"""What is reported two scenes that differ in one known thing, and that nothing is reported equal ones."""

from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.editing import simplify_scene
from sceneloom.editing.diff import Change, apart, diff_scenes, pairs
from sceneloom.errors import OptionError
from sceneloom.geometry.euler import cuboid_angles_from_rotation
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.simulate import LidarSpec, TrafficSpec

CAMERA_MODEL = Camera("pinhole", 8, 6, 5.0, 5.0, 3.5, 2.5)
TIMESTAMPS = np.array([0, 100, 200])
NO_TIMES = np.zeros(0, np.int64)


def a_path(timestamps=TIMESTAMPS, *, aside=0.0, sign=1):
    times = np.array(timestamps)
    positions = np.column_stack([0.01 * times, 0.0 * times + aside, 0.0 * times])
    return sc.Poses(times, positions, sign * np.tile([0.0, 0.0, 0.6, 0.8], (len(times), 1)))


def sweeps(count=3, *, moved=None, extra=0, late_ns=0):
    frames = []
    for k in range(count):
        positions = np.arange(30, dtype=np.float32).reshape(10, 3) + k
        if moved and k in moved:
            positions[4] += np.float32(moved[k])
            positions = np.concatenate([positions, positions[:extra]])
        points = sc.LidarPoints(positions, intensities=np.full(len(positions), 9, np.uint8))
        frames.append(sc.LidarFrame(int(TIMESTAMPS[k]) + late_ns, points))
    return sc.LazyFrames.of(frames, [frame.timestamp_ns for frame in frames])


def a_camera(encoded=b"jpeg", values=(7, 7, 7), other=None):
    """A camera of three images, of which the bytes of the middle one may be others."""
    images = []
    for k, value in enumerate(values):
        image = sc.CameraImage.of(int(TIMESTAMPS[k]), CAMERA_MODEL, np.full((6, 8, 3), value, np.uint8))
        content = other if other and k == 1 else encoded
        images.append(replace(image, encoded=None if content is None else (lambda content=content: content)))
    return sc.CameraSensor("camera", CAMERA_MODEL, sc.LazyFrames.of(images, TIMESTAMPS.tolist()), poses=a_path())


def a_cuboid(identifier="car", *, yaw=30.0, x=5.0, **more):
    values = np.tile([4.0, 2.0, 1.5, x, 0.0, 0.0, 0.0, 0.0, yaw], (3, 1))
    return sc.CuboidAnnotation(identifier, sc.CuboidPath(TIMESTAMPS, values), **more)


def ego(*timestamps, **fields):
    return sc.OdometrySensor(7, a_path(timestamps or TIMESTAMPS, **fields))


LIDAR = sc.LidarSensor("lidar", sweeps(), mount=RigidTransform(np.eye(3), np.array([0.0, 0.0, 2.0])))
ROTATED = RigidTransform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.0, 3.0, 6.0]))
CAMERA = a_camera()
EVENT = sc.EventAnnotation("event", 50, label="stop")
METADATA = {"location": "here", "weather": {"rain": 0.5, "words": ["wet", "dark"]}}


def a_scene(lidar=LIDAR, camera=CAMERA, odometry=None, annotations=None, **more):
    given = {
        "annotations": (a_cuboid(), EVENT) if annotations is None else annotations,
        "trajectories": {"trajectory": sc.Trajectory("trajectory", TIMESTAMPS, a_path().positions)},
        "metadata": METADATA,
    }
    return sc.Scene((lidar, camera, odometry or ego()), **{**given, **more})


def with_frames(frames):
    return a_scene(replace(LIDAR, frames=frames))


def drawn(*vertices):
    path = sc.VertexPath(np.array([0]), (np.array(vertices, float),))
    kind = sc.ShapeType.POLYLINE_2D if len(vertices[0]) == 2 else sc.ShapeType.POLYLINE
    return sc.Scene((), (sc.ShapeAnnotation("s", kind, path, sensor_id="camera"),))


def annotated(**fields):
    return sc.Scene((), (a_cuboid(**fields),))


def boxed(*rows):
    return annotated(projections=(sc.Projection("camera", TIMESTAMPS[:2], np.array(rows)),))


COLOUR = sc.AttributePath("colour", ("red",))


def seen_points(count):
    return sc.AttributePath("points", (count,), TIMESTAMPS[:1], sensor_id="lidar")


def with_words(value):
    return a_scene(metadata={"x": value})


def of_points(*paths):
    labelled = sc.LabeledPointsAnnotation("l", (sc.LabeledPoints("top", np.zeros(0, np.uint32)),))
    return sc.Scene((), (sc.PointsAnnotation("p", paths), labelled))


def empty_path():
    return sc.PointPath(NO_TIMES.copy(), np.zeros((0, 3)))


BARE, OTHER_BARE = (a_scene(camera=a_camera(None, [value] * 3)) for value in (7, 8))
GONE, BOX = [np.nan] * 4, [1.0, 2.0, 3.0, 4.0]
OTHER_TIMES = {"other_timestamps": True}
MOVED = with_frames(sweeps(moved={1: (0, 0, 0.5)}))
MORE_POINTS = with_frames(sweeps(moved={1: (0, 0, 0)}, extra=3))
OTHER_BYTES = a_scene(camera=a_camera(other=b"other"))
IN_WORLD = a_scene(replace(LIDAR, points_frame=sc.PointsFrame.WORLD))
NOTE = sc.DataWarning(kind=sc.WarningKind.ASSUMED, code="x", location="y", message="z")


OTHER_POSES = a_scene(replace(LIDAR, mount=ROTATED), replace(CAMERA, camera=replace(CAMERA_MODEL, fx=5.5)))
TRUCK = a_scene(annotations=(a_cuboid("truck", label="truck"), EVENT))
MOVED_CAR = a_scene(annotations=(a_cuboid(yaw=32.0, x=5.5), EVENT))
OTHER_METADATA = a_scene(metadata={"location": "there", "weather": {"rain": 0.5, "words": ["wet"]}, "new": 1})
THREE, FOUR = (annotated(attributes=given) for given in ((COLOUR, seen_points(3)), (seen_points(4), COLOUR)))


@pytest.mark.parametrize(
    ("equal", "first", "second", "options"),
    [
        (True, a_scene(), a_scene(), {}),
        # where a scene comes from does not count
        (True, a_scene(), a_scene(source="elsewhere", format="sfs", warnings=(NOTE,)), {}),
        *((within > 0.5, a_scene(), MOVED, {"tolerance_m": within}) for within in (0.51, 0.49)),
        (True, a_scene(), with_frames(sweeps(late_ns=3)), {"tolerance_ns": 3}),
        (True, a_scene(), OTHER_BYTES, {"pixels": True}),
        # a quaternion and its negative are one rotation
        (True, a_scene(), a_scene(odometry=ego(sign=-1)), {}),
        (True, a_scene(), a_scene(odometry=ego(0, 200)), {"tolerance_m": 1e-9, "tolerance_deg": 1e-6, **OTHER_TIMES}),
        (True, boxed(GONE, BOX), boxed(GONE, BOX), {}),
        (False, boxed(GONE, BOX), boxed(BOX, GONE), {"tolerance_px": 1e9}),
        # true is not one, text no number, and not a number itself
        (True, with_words(float("nan")), with_words(float("nan")), {}),
        *((False, with_words(one), with_words(other), {}) for one, other in ((True, 1), ("1", 1), (None, 0), ([], {}))),
        # paths and points without timestamps
        (True, of_points(empty_path()), of_points(empty_path()), {}),
        (True, of_points(empty_path()), of_points(empty_path()), {"tolerance_m": 1.0, **OTHER_TIMES}),
        (False, of_points(empty_path()), of_points(sc.PointPath(TIMESTAMPS, np.zeros((3, 3)))), OTHER_TIMES),
        # a unit of times that is not stated is the usual one
        (True, sc.Scene(()), sc.Scene((), extras={"time_unit": "microseconds"}), {}),
        (False, sc.Scene(()), sc.Scene((), extras={"time_unit": "nanoseconds"}), {}),
    ],
)
def test_what_is_the_same_is_equal_and_nothing_else(equal, first, second, options):
    assert (diff_scenes(first, second, **options).differences == ()) is equal


CAR, SENSORS = "annotations['car']", "sensors['{}'].{}".format


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (a_scene(), MORE_POINTS, [SENSORS("lidar", "frames[].points 3 points: 10 points; then 13")]),
        (a_scene(), OTHER_BYTES, [SENSORS("camera", "images[].content: other bytes")]),
        (
            a_scene(),
            OTHER_POSES,
            [
                *(SENSORS("lidar", f"mount.{away}") for away in ("rotation 90 deg", "translation 4 m")),
                SENSORS("camera", "camera.fx 0.5"),
            ],
        ),
        (a_scene(), TRUCK, [f"removed {CAR}: cuboid", "added annotations['truck']: cuboid 'truck'"]),
        # an id that is a number is not its text
        (annotated(identifier=1), annotated(identifier="1"), ["removed annotations[1]", "added annotations['1']"]),
        (a_scene(), MOVED_CAR, [f"{CAR}.path.values.position 0.5 m", f"{CAR}.path.values.rotation 2 deg"]),
        (boxed(GONE, BOX), boxed(BOX, GONE), [f"{CAR}.projections['camera'].boxes inf px"]),
        (THREE, FOUR, [f"{CAR}.attributes['points', 'lidar'].values[0] 1: 3; then 4"]),
        (drawn([0, 0], [3, 4]), drawn([0, 0], [3, 6]), ["annotations['s'].path.vertices[0] 2 px"]),
        (drawn([0, 0, 0]), drawn([3, 4, 0]), ["annotations['s'].path.vertices[0] 5 m"]),
        (a_scene(), OTHER_METADATA, ["metadata['location']", "metadata['weather']['words']", "added metadata['new']"]),
        (a_scene(), a_scene(odometry=sc.LidarSensor(7, sweeps())), ["sensors[7]: OdometrySensor; then LidarSensor"]),
        (a_scene(), IN_WORLD, [SENSORS("lidar", "points_frame: 'sensor'; then 'world'")]),
        (a_scene(), replace(a_scene(), sensors=a_scene().sensors[::-1]), ["sensors: in another order"]),
    ],
)
def test_what_differs_is_reported_by_its_path(first, second, expected):
    found = diff_scenes(first, second).differences
    assert len(found) == len(expected)
    for difference, line in zip(found, expected, strict=True):
        change = "" if difference.change == "changed" else f"{difference.change} "
        amount = "" if difference.amount is None else f" {round(difference.amount, 6):g} {difference.unit}".rstrip()
        assert f"{change}{difference.path}{amount}: {difference.message}".startswith(line)


def only(first, second, **tolerances):
    (difference,) = diff_scenes(first, second, **tolerances).differences
    return difference


def test_moved_points_are_reported_once_and_pixels_compared_on_request():
    found = only(a_scene(), with_frames(sweeps(moved={0: (0, 0, 0.5), 2: (0.3, 0.4, 1.2)})))
    assert found.path == "sensors['lidar'].frames[].points.positions"
    assert (found.change, found.unit, found.count, found.frame) == (Change.CHANGED, "m", 2, 2)
    assert found.amount == pytest.approx(1.3, abs=1e-5)  # float32 coordinates
    assert "1 of 10 rows differ, row 4 most" in found.message
    # images without bytes are reported to be left out
    passed = diff_scenes(BARE, OTHER_BARE)
    assert passed.equal
    assert len(passed.not_compared) == 1
    assert only(BARE, OTHER_BARE, pixels=True).count == 3
    assert only(a_scene(), OTHER_BYTES).frame == 1
    found = only(a_scene(), a_scene(camera=a_camera(values=(7, 9, 7), other=b"other")), pixels=True)
    assert (found.path, found.amount, found.unit) == ("sensors['camera'].images[].rgb", 2.0, "of 255")


def test_frames_are_the_same_by_their_timestamps_and_paired_in_order():
    for first, second, tolerance, expected in (
        ([0, 10], [0, 10], 0, [(0, 0), (1, 1)]),
        ([0, 10, 20], [10, 30], 0, [(0, None), (1, 0), (2, None), (None, 1)]),
        ([0, 10], [3, 12], 2, [(0, None), (None, 0), (1, 1)]),
        ([0, 10], [3, 12], 3, [(0, 0), (1, 1)]),
        ([], [5], 0, [(None, 0)]),
    ):
        assert list(pairs(np.array(first, np.int64), np.array(second, np.int64), tolerance)) == expected
    fewer = with_frames(sweeps(2))
    assert (only(a_scene(), fewer).change, only(a_scene(), fewer).frame) == (Change.REMOVED, 2)
    assert only(fewer, a_scene()).change is Change.ADDED
    changes = diff_scenes(a_scene(), with_frames(sweeps(late_ns=3)), tolerance_ns=2).differences
    assert {(c.change, c.count) for c in changes} == {(Change.REMOVED, 3), (Change.ADDED, 3)}
    today = np.array([1_700_000_000_000_000_001], np.int64)
    assert apart(today, today + 1, "ns").tolist() == [1.0]


def test_paths_and_cuboids_stated_otherwise_are_the_same():
    # paths at other timestamps
    found = only(a_scene(), a_scene(odometry=ego(0, 200)))
    assert (found.path, found.unit) == ("sensors[7].poses", "m")
    assert found.amount == pytest.approx(0.0, abs=1e-12)
    assert found.message.startswith("3 timestamps; then 2; as paths up to")
    bent = a_scene(odometry=ego(0, 50, 200, aside=[0, 0.3, 0]))
    assert only(a_scene(), bent, tolerance_m=0.2, other_timestamps=True).amount == pytest.approx(0.3)
    shorter = diff_scenes(a_scene(), a_scene(odometry=ego(0, 100)), tolerance_m=9.0, other_timestamps=True)
    assert "sensors[7].poses.timestamps_ns" in {f.path for f in shorter.differences}
    # cuboids in radians and another order
    values = a_cuboid().path.values.copy()
    values[:, 6:] = [20.0, -10.0, 200.0]
    radians = values.copy()
    rotations = CuboidAngles().quaternions(values[:, 6:])
    matrices = np.stack([RigidTransform.from_quaternion(np.zeros(3), q).rotation for q in rotations])
    radians[:, 6:] = cuboid_angles_from_rotation(matrices, unit="radians", order="zyx")
    degrees, other = (replace(a_cuboid(), path=sc.CuboidPath(TIMESTAMPS, rows)) for rows in (values, radians))
    ours = {"euler_unit": "radians", "euler_order": "zyx"}
    found = diff_scenes(
        sc.Scene((), (degrees,)), sc.Scene((), (other,), metadata={"sceneloom": ours}), tolerance_deg=1e-9
    )
    assert [f.path for f in found.differences] == ["metadata['sceneloom']"]


def test_frames_are_read_in_pairs_and_what_is_no_scene_or_tolerance_is_refused():
    read, reported = [], []
    frames = sweeps()
    lazy = with_frames(sc.LazyFrames(TIMESTAMPS, lambda k: read.append(k) or frames[k]))
    diff_scenes(lazy, lazy, progress=lambda done, total: reported.append((done, total)))
    assert read == [0, 0, 1, 1, 2, 2]
    assert reported[-1] == (6, 6)
    with pytest.raises(OptionError, match=r"'a\.sfs'; expected a scene: `sceneloom\.open`"):
        diff_scenes("a.sfs", sc.Scene(()))
    with pytest.raises(OptionError, match="tolerance -1"):
        diff_scenes(a_scene(), a_scene(), tolerance_m=-1.0)


def test_a_written_scene_is_equal_to_what_was_written_and_a_simplified_one_within_its_tolerances(tmp_path):
    drive = sceneloom.simulate_street(1, frames=2, cameras=()).scene
    sceneloom.write(drive, tmp_path / "a.sfs", time_unit="nanoseconds")
    with sceneloom.open(tmp_path / "a.sfs") as first:
        sceneloom.write(first, tmp_path / "b.sfs", time_unit="nanoseconds")
        with sceneloom.open(tmp_path / "b.sfs") as second:
            assert diff_scenes(first, second).differences == ()
    lidar = LidarSpec(beams=8, steps=90)
    scene = sceneloom.simulate_street(1, frames=3, lidar=lidar, cameras=(), traffic=TrafficSpec()).scene
    simple = simplify_scene(scene, tolerance_m=0.05, tolerance_deg=0.5)
    assert not diff_scenes(scene, simple).equal
    within = {"tolerance_m": 0.05, "tolerance_deg": 0.5, "other_timestamps": True}
    assert diff_scenes(scene, simple, **within).differences == ()
    assert not diff_scenes(scene, simple, **{**within, "tolerance_m": 0.01}).equal
