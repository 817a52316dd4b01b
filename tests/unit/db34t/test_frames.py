"""Declared frames, calibrations and motion: what is given in them comes back in them, as words say."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import encode
from sceneloom.db34t.setting import CalibrationEntry, DeclaredAxes, SensorKind, calibrated_pair, calibration_data
from sceneloom.errors import CalibrationError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.poses import Poses

from .sending import HEIGHT, START_NS, WIDTH, boxes_2d, boxes_3d, calibration, cloud, fused, image
from .test_records import CALIBRATION

LIDAR_WORDS = ["+x,-y,+z", "+y,+x,+z", "+x,+y,+z", "-z,+y,+x", "-y,-x,-z"]
CAMERA_WORDS = ["+z,+x,-y", "+x,-y,+z", "+z,-x,-y"]
FORWARD_RIGHT_UP = np.array([[12.0, 0.5, -0.25], [30.0, -4.0, 1.5], [8.0, 3.0, 2.0], [-9.0, 1.0, 0.0]])
"""Points around the vehicle [m]."""

CAMERA_AT = np.array([0.5, 0.25, -0.5])  # where the camera is, forward, right and up of the lidar [m]; it looks forward


def axes_matrix(words):
    """Columns: where forward, right and up point, read off the words one by one."""
    columns = np.zeros((3, 3))
    for location, word in enumerate(words.split(",")):
        columns["xyz".index(word[1]), location] = -1.0 if word[0] == "-" else 1.0
    return columns


def handed(words):
    return np.linalg.det(axes_matrix(words)) > 0


def declared_calibration(lidar_words, camera_words):
    """Relates the declared frames, point by point: from the lidar's words to the camera's."""
    lidar, camera = axes_matrix(lidar_words), axes_matrix(camera_words)
    matrix = np.eye(4)
    matrix[:3, :3] = camera @ lidar.T
    matrix[:3, 3] = camera @ -CAMERA_AT
    return calibration(extrinsic_matrix=tuple(matrix.T.reshape(-1).tolist()))


def seen(forward_right_up):
    """The pixel (column, row) and depth of a point, or None; a camera that looks forward."""
    forward, right, up = np.asarray(forward_right_up) - CAMERA_AT
    if forward <= 0:
        return None
    column, row = 31.5 + 50.0 * right / forward, 23.5 - 50.0 * up / forward
    inside = -0.5 <= column < WIDTH - 0.5 and -0.5 <= row < HEIGHT - 0.5
    return (round(column), round(row), forward) if inside else None


def interface(lidar_words="+x,-y,+z", camera_words="+z,+x,-y"):
    fusion = FusionInterface(inline=True)
    assert fusion.set_property("lidar_axes", lidar_words)
    assert fusion.set_property("camera_axes", camera_words)
    assert fusion.set_calibration(declared_calibration(lidar_words, camera_words), camera_id=1, lidar_id=0)
    return fusion


FRAMES = [pair for pair in itertools.product(LIDAR_WORDS, CAMERA_WORDS) if handed(pair[0]) == handed(pair[1])]


@pytest.mark.parametrize(("lidar_words", "camera_words"), FRAMES)
@pytest.mark.parametrize("of_lidar", [0, 1])
def test_points_come_back_in_the_frames_that_were_declared(lidar_words, camera_words, of_lidar):
    lidar, camera = axes_matrix(lidar_words), axes_matrix(camera_words)
    with interface(lidar_words, camera_words) as fusion:
        assert fusion.set_property("reference_frame", of_lidar)
        assert fusion.send(image(0, 1))
        assert fusion.send(cloud(0, 1, FORWARD_RIGHT_UP @ lidar.T)).reason == ""
        (record,) = fused(fusion)
    expected = FORWARD_RIGHT_UP @ lidar.T if of_lidar else (FORWARD_RIGHT_UP - CAMERA_AT) @ camera.T
    np.testing.assert_allclose(record.points[:, :3], expected, atol=1e-5)  # float32 of tens of metres
    depths = np.zeros((HEIGHT, WIDTH))
    for column, row, depth in filter(None, map(seen, FORWARD_RIGHT_UP)):
        depths[row, column] = depth
    assert np.count_nonzero(depths) == 3
    np.testing.assert_allclose(record.depths, depths, atol=1e-5)


@pytest.mark.parametrize(("lidar_words", "camera_words"), FRAMES)
def test_boxes_come_back_in_the_frame_that_was_declared(lidar_words, camera_words):
    lidar, standard = axes_matrix(lidar_words), axes_matrix("+x,-y,+z")
    center, heading, vector = (20.0, 0.25, -0.5), (0.6, 0.8, 0.0), (3.0, 4.5, 0.5)
    records = []
    for frame, words, length in ((lidar, (lidar_words, camera_words), 2.0), (standard, (), 1.0)):
        where = dict(zip("XYZ", (frame @ center).tolist(), strict=True))
        going = {
            "direction": tuple(length * frame @ heading),
            "velocity_vector": tuple(frame @ vector),
            "velocity": 5.4,
        }
        sent = boxes_3d(0, 1, **where, **going), boxes_2d(0, 2, x1=25, y1=20, x2=38, y2=28)
        with interface(*words) as fusion:
            records += fused(fusion, 1, *sent)
    record, known = records
    assert len(record) == len(known) == 1
    assert (record.box_3d_ids, record.box_2d_ids) == ((4,), (6,))  # the ray through the camera model decides the pair
    rotation = lidar @ standard.T
    np.testing.assert_allclose(record.centers, known.centers @ rotation.T, atol=1e-5)
    np.testing.assert_allclose(record.directions, [lidar @ heading], atol=1e-6)
    np.testing.assert_allclose(record.velocities, [5.4], atol=1e-6)  # 0.6 * 3 + 0.8 * 4.5
    np.testing.assert_allclose(record.velocity_vectors, [lidar @ vector], atol=1e-5)
    np.testing.assert_allclose(record.center_covs, rotation @ known.center_covs @ rotation.T, atol=1e-6)
    np.testing.assert_allclose(record.size_covs, known.size_covs)
    np.testing.assert_array_equal(record.corners_xyxy, known.corners_xyxy)


SPEED, ROTATION = 20.0, 0.8  # of the vehicle along its trajectory: forward [m/s], to the left [rad/s]

WORLD_POINT = np.array([1_000_000.0 + 15.0, 2_000_000.0 - 1.0, 0.5])
"""Something that stands, x, y, z in a world far from its origin [m]."""


def pose(seconds):
    """The lidar on a circle: rotation (yaw alone) and position, in closed form."""
    yaw, radius = ROTATION * seconds, SPEED / ROTATION
    position = np.array([1e6 + radius * np.sin(yaw), 2e6 + radius * (1 - np.cos(yaw)), 0.0])
    return Rotation.from_euler("z", yaw), position


def path(first_ms, last_ms):
    times = np.arange(first_ms, last_ms + 1)
    poses = [pose(ms / 1e3) for ms in times]
    return Poses(
        START_NS + times.astype(np.int64) * 1_000_000,
        np.array([position for _, position in poses]),
        np.array([rotation.as_quat() for rotation, _ in poses]),
    )


def from_lidar(seconds):
    """The thing seen from the lidar at a time: x forward, y left, z up."""
    rotation, position = pose(seconds)
    return rotation.inv().apply(WORLD_POINT - position)


def seen_at(seconds):
    """Its pixel and depth in an image of a time."""
    return seen(from_lidar(seconds) * (1, -1, 1))


def moving_sweep(words="+x,-y,+z", seq=1):
    """The same thing measured at 0, 20, 40, 60 and 80 ms."""
    seconds = np.array([0.0, 0.02, 0.04, 0.06, 0.08])
    forward_right_up = np.array([from_lidar(s) for s in seconds]) * (1, -1, 1)
    return cloud(0, seq, forward_right_up @ axes_matrix(words).T, times=seconds)


def fused_with_motion(words, chunks, *, order="before", compensate=1):
    with interface(*words) as fusion:
        assert fusion.set_property("motion_compensation", compensate)
        sweep, later = moving_sweep(*words[:1]), image(90, 1)
        for what in [*chunks, sweep, later] if order == "before" else [sweep, *chunks, later]:
            assert fusion.send_motion(what) if isinstance(what, Poses) else fusion.send(what)
        (record,) = fused(fusion)
        return record, fusion.counters.counts()


@pytest.mark.parametrize("words", FRAMES[:4])
@pytest.mark.parametrize("order", ["before", "between"])
@pytest.mark.parametrize("cuts", [(-50, 200), (-50, 30, 200)])
def test_what_stands_is_at_one_location_whenever_it_was_measured(words, order, cuts):
    chunks = [path(first + 1, last) for first, last in itertools.pairwise(cuts)]
    record, counts = fused_with_motion(words, chunks, order=order)
    assert record.motion_compensated == 1
    expected = axes_matrix(words[0]) @ (from_lidar(0.04) * (1, -1, 1))  # the reference is the middle point's time
    # straight between poses of each millisecond: 20 m/s * 1 ms bends by less than a tenth of a millimetre
    np.testing.assert_allclose(record.points[:, :3], np.tile(expected, (5, 1)), atol=2e-4)
    column, row, depth = seen_at(0.09)
    assert record.depths[row, column] == pytest.approx(depth, abs=2e-4)
    assert "motion.beyond-reach" not in counts


@pytest.mark.parametrize(
    ("chunks", "compensate", "counted"),
    [
        ([], 1, False),
        ([path(-2000, -400)], 1, True),  # the trajectory ends 400 ms before, and is continued for 200
        ([path(-50, 200)], 0, False),
    ],
)
def test_without_a_trajectory_that_reaches_all_is_fused_as_if_stationary_and_says_so(chunks, compensate, counted):
    record, counts = fused_with_motion((), chunks, compensate=compensate)
    assert record.motion_compensated == 0
    np.testing.assert_array_equal(record.points[:, :3], moving_sweep().points[:, :3])
    column, row, depth = seen_at(0.0)
    assert record.depths[row, column] == pytest.approx(depth, abs=1e-4)
    assert ("motion.beyond-reach" in counts) is counted


def test_a_trajectory_that_ends_shortly_before_is_continued_and_a_setting_counts_for_later_sweeps():
    record, _ = fused_with_motion((), [path(-500, 0)])
    assert record.motion_compensated == 1
    # constant speed and rotating off a circle: half of a * t² = 0.5 * 16 m/s² * (0.08 s)² is the most
    np.testing.assert_allclose(record.points[:, :3], np.tile(from_lidar(0.04), (5, 1)), atol=0.06)
    with interface() as fusion:
        assert fusion.send_motion(path(-50, 400))
        assert fusion.send(moving_sweep())
        assert fusion.set_property("motion_compensation", 0)
        first, second = fused(fusion, 0, image(90, 1), cloud(200, 2, [from_lidar(0.2)]), image(200, 2))
    assert (first.motion_compensated, second.motion_compensated) == (1, 0)
    np.testing.assert_allclose(first.points[:, :3], np.tile(from_lidar(0.04), (5, 1)), atol=2e-4)


ROLL_S = 0.1  # from the first line of an image to its last: the vehicle goes 2 m meanwhile, and rotates by 5 degrees


def seen_by_line(image_s, *, over_columns):
    """Column, row and depth of the thing in an image of a rolling shutter: the line's time is looked for by halves."""
    size = WIDTH if over_columns else HEIGHT

    def look(line):
        seconds = image_s + ((line + 0.5) / size - 0.5) * ROLL_S
        forward, right, up = from_lidar(seconds) * (1, -1, 1) - CAMERA_AT
        return 31.5 + 50.0 * right / forward, 23.5 - 50.0 * up / forward, forward

    low, high = -0.5, size - 0.5
    for _ in range(50):
        line = 0.5 * (low + high)
        low, high = (line, high) if look(line)[0 if over_columns else 1] > line else (low, line)
    return look(low)


@pytest.mark.parametrize("over_columns", [False, True])
@pytest.mark.parametrize("reported", ["before", "after"])
def test_a_shutter_that_rolls_sees_each_point_at_the_time_of_its_line(over_columns, reported):
    camera = {"kind": "camera", "shutter_roll_s": ROLL_S, "shutter_left_to_right": over_columns}
    sensors = json.dumps({"0": {"kind": "lidar"}, "1": camera})
    with interface() as fusion:
        if reported == "before":
            assert fusion.set_property("sensors", sensors)
        assert fusion.send_motion(path(-50, 200))
        assert fusion.send(moving_sweep())
        if reported == "after":  # what waits for its image goes by it as well
            assert fusion.set_property("sensors", sensors)
        (record,) = fused(fusion, 0, image(90, 1))
        assert fusion.set_property("sensors", "")  # from here on it takes all lines at once
        (at_once,) = fused(fusion, 0, moving_sweep(seq=2), image(90, 2))
    column, row, depth = seen_by_line(0.09, over_columns=over_columns)
    assert abs(depth - seen_at(0.09)[2]) > 0.05
    assert record.depths[round(row), round(column)] == pytest.approx(depth, abs=2e-4)
    column, row, depth = seen_at(0.09)
    assert at_once.depths[row, column] == pytest.approx(depth, abs=2e-4)


CAMERA, AN_OBJECT = {"kind": "camera"}, "expected an object with position"


@pytest.mark.parametrize(
    ("entry", "location", "problem"),
    [
        *(
            (CAMERA | {"shutter_roll_s": value}, "shutter_roll_s", "expected seconds, 0 to 1")
            for value in (33, -0.01, True, "0.03")
        ),
        (CAMERA | {"shutter_left_to_right": 1}, "shutter_left_to_right", "expected true or false"),
        ({"kind": "lidar", "shutter_roll_s": 0.03}, "shutter_roll_s", "of a lidar; expected of cameras"),
        (CAMERA | {"shutter": 0.03}, "shutter", "expected kind and perhaps raw, shutter_roll_s"),
        ([1, 2, 3], "body_from_lidar", AN_OBJECT),
        ({"quaternion_xyzw": [0, 0, 0, 1]}, "body_from_lidar", AN_OBJECT),
        ({"position": [1, 2]}, "body_from_lidar", "expected 3 finite numbers"),
        ({"position": [1, 2, True]}, "body_from_lidar", "expected 3 finite numbers"),
        ({"position": [1, 2, 3], "quaternion_xyzw": [0, 0, 0, 2]}, "body_from_lidar", "norm 2.0000; expected a unit"),
        ({"position": [1, 2, 3], "yaw": 1}, "body_from_lidar", AN_OBJECT),
        (CAMERA | {"body_from_lidar": {"position": [0, 0, 0]}}, "body_from_lidar", "expected of lidars"),
        (CAMERA | {"body_from_lidar": [1, 2, 3]}, "body_from_lidar", ""),
    ],
)
def test_a_shutter_or_a_mounting_that_is_none_is_refused(entry, location, problem):
    sensor = entry if "kind" in entry else {"kind": "lidar", "body_from_lidar": entry}
    with FusionInterface(inline=True) as fusion:
        outcome = fusion.set_property("sensors", json.dumps({"1": sensor}))
        assert outcome.status == 0
        assert f"1.{location}" in outcome.reason
        assert problem in outcome.reason


BODY_FROM_LIDAR = (Rotation.from_euler("zyx", [0.4, -0.1, 0.2]), np.array([1.5, -0.7, 2.0]))
"""How the lidar is mounted on a vehicle whose trajectory is reported."""


def trajectory_of_the_vehicle(first_ms, last_ms):
    """That of `path`, which is the lidar's, as the vehicle has it: `world_from_lidar ∘ lidar_from_body`."""
    of_lidar, (rotation, location) = path(first_ms, last_ms), BODY_FROM_LIDAR
    rotations = Rotation.from_quat(of_lidar.quaternions_xyzw) * rotation.inv()
    return Poses(of_lidar.timestamps_ns, of_lidar.positions - rotations.apply(location), rotations.as_quat())


@pytest.mark.parametrize("words", ["+x,-y,+z", "+y,+x,+z"])
def test_poses_of_the_vehicle_do_where_the_mounting_of_the_lidar_is_known(words):
    rotation, location = BODY_FROM_LIDAR
    mounting = {"position": location.tolist(), "quaternion_xyzw": rotation.as_quat().tolist()}
    sensors = {"0": {"kind": "lidar", "body_from_lidar": mounting}, "1": {"kind": "camera"}}
    found = []
    for reported in (json.dumps(sensors), ""):
        with interface(words, "+z,+x,-y" if handed(words) == handed("+z,+x,-y") else "+x,-y,+z") as fusion:
            assert fusion.set_property("sensors", reported)
            assert fusion.send_motion(trajectory_of_the_vehicle(-50, 200))
            found += fused(fusion, 0, moving_sweep(words), image(90, 1))
    mounted, alone = found
    expected = axes_matrix(words) @ (from_lidar(0.04) * (1, -1, 1))
    np.testing.assert_allclose(mounted.points[:, :3], np.tile(expected, (5, 1)), atol=2e-4)
    column, row, depth = seen_at(0.09)
    assert mounted.depths[row, column] == pytest.approx(depth, abs=2e-4)
    assert not np.allclose(alone.points[:, :3], expected, atol=0.01)  # taken for the lidar's own trajectory


def fused_by_cameras(images_ms):
    """Records of cameras that stand at one location, whose images come at these times, by camera."""
    with interface() as fusion:
        for camera_id in images_ms:
            assert fusion.set_calibration(declared_calibration("+x,-y,+z", "+z,+x,-y"), camera_id=camera_id)
        assert fusion.set_property("pairing_tolerance_ms", 600.0)
        assert fusion.send_motion(path(-50, 100))  # continued to 300 ms
        images = [image(image_ms, 1, sensor_id=camera_id) for camera_id, image_ms in images_ms.items()]
        found = {record.camera_id: record for record in fused(fusion, 0, moving_sweep(), *images)}
        return found, fusion.counters.counts().get("motion.beyond-reach", 0)


def test_an_image_beyond_the_trajectory_leaves_those_of_other_cameras_as_they_are():
    both, counted = fused_by_cameras({1: 90, 2: 500})
    near, _ = fused_by_cameras({1: 90})
    far, _ = fused_by_cameras({2: 500})
    assert {camera_id: record.motion_compensated for camera_id, record in both.items()} == {1: 1, 2: 0}
    assert counted == 1
    assert encode(both[1]) == encode(near[1])
    assert encode(both[2]) == encode(far[2])
    np.testing.assert_allclose(both[1].points[:, :3], np.tile(from_lidar(0.04), (5, 1)), atol=2e-4)
    np.testing.assert_array_equal(both[2].points[:, :3], moving_sweep().points[:, :3])


def test_boxes_are_put_where_they_are_at_the_time_of_the_image():
    """A car that stands, seen 90 ms later: by then the vehicle is 1.8 m nearer and rotated by 4°."""
    center = dict(zip("XYZ", from_lidar(0.0), strict=True))
    column, row, _ = seen_at(0.09)
    box = boxes_3d(0, 1, **center, length=0.5, width=0.5, height=0.5, velocity=0.0)
    outline = boxes_2d(90, 2, x1=column - 1, y1=row - 1, x2=column + 2, y2=row + 2)
    matched = []
    for chunks in ([path(-50, 200)], []):
        with interface() as fusion:
            assert all(map(fusion.send_motion, chunks))
            (record,) = fused(fusion, 1, box, outline)
            matched.append((record.motion_compensated, record.box_2d_ids[0]))
    assert matched == [(1, 6), (0, None)]


def test_motion_that_is_none_or_older_is_refused():
    with interface() as fusion:
        assert fusion.send_motion(path(0, 10))
        for motion, reason in ((path(5, 20), "expected newer ones"), (Poses.identity(), "no poses with times")):
            outcome = fusion.send_motion(motion)
            assert (outcome.cause, reason in outcome.reason) == ("bad-motion", True)
        for motion in (path(11, 20), path(-100_000, -99_990)):  # the latter after a clock was set back
            assert fusion.send_motion(motion)


CAMERA_AXES = DeclaredAxes.of_triple((2, 0, -1), left_handed=False)
LIDAR_AXES = DeclaredAxes.of_triple((0, -1, 2), left_handed=False)


@pytest.mark.parametrize(
    ("triple", "left_handed", "words"),
    [
        ((2, 0, -1), False, "+z,+x,-y"),  # table 2's example of a camera
        ((0, -1, 2), False, "+x,-y,+z"),  # and of a lidar
        ((2, 0, -1), True, "+z,-x,-y"),
        ((0, -1, 2), True, "-x,-y,+z"),
        ((1, 0, 2), False, "+y,+x,+z"),  # y forward, x right, z up, as of nuScenes' lidar
        ((0, 1, 2), False, "-x,+y,+z"),
    ],
)
def test_a_triple_says_what_its_words_state(triple, left_handed, words):
    by_triple = DeclaredAxes.of_triple(triple, left_handed=left_handed)
    assert by_triple.words == words
    assert by_triple.left_handed is left_handed
    np.testing.assert_array_equal(DeclaredAxes.of_words(words).forward_right_up, by_triple.forward_right_up)
    mirrored = DeclaredAxes.of_words("+x,+y,+z").standard_from_declared(SensorKind.LIDAR)
    np.testing.assert_array_equal(mirrored, np.diag([1, -1, 1]))  # a left-handed frame, on the way in
    for axes, kind in ((CAMERA_AXES, SensorKind.CAMERA), (LIDAR_AXES, SensorKind.LIDAR)):  # those of the examples
        np.testing.assert_array_equal(axes.standard_from_declared(kind), np.eye(3))


@pytest.mark.parametrize(
    "axes", [(0, 1), (0, 1, 1), (0, -1, 3), (0, 1, 2, 0), "", "+x", "+x,+y", "+x,+x,+z", "a,b,c", "+x,-y,+z,+x"]
)
def test_triples_and_words_that_are_no_axes_are_refused(axes):
    with pytest.raises(CalibrationError, match="axes"):
        DeclaredAxes.of_words(axes) if isinstance(axes, str) else DeclaredAxes.of_triple(axes, left_handed=False)


FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
PINHOLE = Camera("pinhole", 640, 480, 500.0, 500.0, 319.5, 239.5)


def declared_record(rotation, translation, *, by_rows=False, reference_frame=0):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    numbers = (matrix if by_rows else matrix.T).reshape(-1).tolist()
    return replace(CALIBRATION, extrinsic_matrix=numbers, reference_frame=reference_frame)


def test_the_example_of_the_standard_looks_forward_from_beside_the_lidar():
    pair = calibrated_pair(CALIBRATION, CAMERA_AXES, LIDAR_AXES)
    np.testing.assert_allclose(pair.camera_from_lidar.rotation, FORWARD, atol=0.008)  # it is rotated by 0.4°
    np.testing.assert_allclose(pair.camera_from_lidar.translation, (-0.0062, 0.0756, 0.0337))
    assert pair.notes == ()
    assert (pair.camera.fx, pair.camera.cy, pair.camera.coefficients[4]) == (468.3708, 235.6143, 0.0429)
    for rotation_deg in (44, 46, 90, 180):  # far off forward, which is remarked
        rotation = FORWARD @ Rotation.from_euler("z", rotation_deg, degrees=True).as_matrix()
        pair = calibrated_pair(declared_record(rotation, (0, 0, 1)), CAMERA_AXES, LIDAR_AXES)
        assert ["mirrored or transposed?" in note for note in pair.notes] == [True] * (rotation_deg > 45)


@pytest.mark.parametrize("translation", [(1, 2, 3), (0, 0, 0)])
@pytest.mark.parametrize("by_rows", [False, True])
def test_the_layout_is_known_by_the_translation_or_else_by_which_looks_forward(by_rows, translation):
    pair = calibrated_pair(declared_record(FORWARD, translation, by_rows=by_rows), CAMERA_AXES, LIDAR_AXES)
    np.testing.assert_allclose(pair.camera_from_lidar.rotation, FORWARD, atol=1e-12)
    np.testing.assert_array_equal(pair.camera_from_lidar.translation, translation)
    back = (-FORWARD.T @ translation).tolist()
    data = declared_record(FORWARD.T, back, by_rows=by_rows, reference_frame=1)  # which maps into the lidar
    into_lidar = calibrated_pair(data, CAMERA_AXES, LIDAR_AXES)
    np.testing.assert_allclose(into_lidar.camera_from_lidar.matrix, pair.camera_from_lidar.matrix, atol=1e-12)


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize(
    "triple", [t for order in itertools.permutations(range(3)) for t in itertools.product(*[{a, -a} for a in order])]
)
def test_axes_of_any_frame_lead_to_the_same_mounting(triple, left_handed):
    axes = DeclaredAxes.of_triple(triple, left_handed=left_handed)
    assert axes.left_handed is left_handed
    camera_axes = DeclaredAxes.of_triple((2, 0, -1), left_handed=left_handed)
    inside = RigidTransform(FORWARD, np.array([0.1, -0.2, 0.3]))
    data = calibration_data(PINHOLE, inside, camera_axes, axes)
    declared = np.reshape(data.extrinsic_matrix, (4, 4)).T
    # a point 5 m before, 1 m left of and 2 m above the lidar, in the declared frame by the triple's own words
    point = axes.forward_right_up @ (5.0, -1.0, 2.0)
    seen = declared[:3, :3] @ point + declared[:3, 3]
    right, down, forward = FORWARD @ (5.0, 1.0, 2.0) + (0.1, -0.2, 0.3)
    np.testing.assert_allclose(camera_axes.forward_right_up.T @ seen, (forward, right, -down), atol=1e-12)
    again = calibrated_pair(data, camera_axes, axes)
    np.testing.assert_allclose(again.camera_from_lidar.matrix, inside.matrix, atol=1e-12)
    assert np.linalg.det(declared[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"extrinsic_matrix": (1.0,) * 16}, "0 0 0 1"),
        ({"extrinsic_matrix": (2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 1)}, "rotation is off"),
        ({"intrinsic_matrix": (500, 0, 0, 0, 500, 0, 320, 240, 1)}, "row after row"),
        ({"intrinsic_matrix": (-500, 0, 320, 0, 500, 240, 0, 0, 1)}, "focal lengths"),
    ],
)
def test_numbers_that_are_no_calibration_are_refused(changed, problem):
    with pytest.raises(CalibrationError, match=problem):
        CalibrationEntry(1, 0, replace(CALIBRATION, **changed))


def test_a_camera_model_without_distortion_is_a_pinhole_and_one_that_table_3_lacks_is_refused_by_name():
    assert (
        calibrated_pair(replace(CALIBRATION, distortion_coeffs=(0,) * 5), CAMERA_AXES, LIDAR_AXES).camera.model
        == "pinhole"
    )
    fisheye = Camera("fisheye", 640, 480, 300.0, 300.0, 319.5, 239.5, (0.1, 0.0, 0.0, 0.0))
    with pytest.raises(CalibrationError, match="fisheye"):
        calibration_data(fisheye, RigidTransform.identity(), CAMERA_AXES, LIDAR_AXES)
    with pytest.raises(CalibrationError, match="mirrors"):
        calibrated_pair(declared_record(np.diag([-1.0, 1.0, 1.0]) @ FORWARD, (0, 0, 1)), CAMERA_AXES, LIDAR_AXES)
