"""Records and the objects of the scene model; objects of the fusion system as records of table 10, and as tracks."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sceneloom.cameras import Camera
from sceneloom.colouring import FusedFrame
from sceneloom.colouring.algorithms import view_points
from sceneloom.db34t import ImageData, RawData, Timestamp
from sceneloom.db34t.interface import PropertyStore, sensor_fusion_record
from sceneloom.db34t.scene_objects import (
    boxes_2d_of,
    boxes_2d_record,
    boxes_3d_of,
    boxes_3d_record,
    declared_columns,
    image_data_of,
    image_of,
    image_record_of_raw,
    lidar_frame_of,
    lidar_frame_of_raw,
    lidar_frame_of_result,
    point_cloud_of,
)
from sceneloom.db34t.setting import Setting
from sceneloom.detections.results import FusedBoxes
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.recording.contents import XYZIRT
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Boxes2D, Boxes3D, LidarFrame, LidarPoints, PointsFrame, Poses, ScoreForm
from sceneloom.service.server import TrackedResults

from . import sending
from .sending import START_NS, boxes_3d, interface, no_boxes_2d, no_boxes_3d, send_all

TIME = Timestamp(1595682678, 715705367)
CAMERA = Camera("pinhole", 4, 3, 5.0, 5.0, 1.5, 1.0)
RGB = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)


def cloud(fields, *columns, **changes):
    return replace(sending.cloud(0, 9, np.column_stack(columns), sensor_id=3, fields=fields), timestamp=TIME, **changes)


def image(pixels, encoding):
    form = {"encoding": encoding, "channel": pixels.shape[2] if pixels.ndim == 3 else 3, "data": pixels}
    return ImageData(sensor_id=1, timestamp=TIME, seq=4, height=3, width=4, **form)


def raw(content):
    return RawData(sensor_id=3, timestamp=TIME, seq=1, length=len(content), data=content)


def file_of(pixels, form):
    target = io.BytesIO()
    Image.fromarray(pixels).save(target, form)
    return np.frombuffer(target.getvalue(), np.uint8)


def sent_back(record):
    """The data of a cloud that became a frame of the model and is a cloud again."""
    return point_cloud_of(lidar_frame_of(record), sensor_id=3, seq=9).data


def test_fields_of_a_cloud_become_parts_of_the_points_or_stay_as_they_are():
    record = cloud(
        ("z", "y", "x", "reflectivity", "ring", "time"),
        *([3, 6], [2, 5], [1, 4], [0, 255], [0, 127], [0, 0.0625]),
        beam=128,
    )
    frame = lidar_frame_of(record)
    assert frame.timestamp_ns == 1595682678715705367
    assert frame.points.positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert frame.points.intensities.tolist() == [0, 255]
    assert frame.points.rings.tolist() == [0, 127]
    assert (frame.points.timestamps_ns - frame.timestamp_ns).tolist() == [0, 62_500_000]
    assert not frame.points.extras
    assert (frame.extras["seq"], frame.extras["sensor_id"]) == (9, 3)
    back = point_cloud_of(frame, sensor_id=3, seq=9)
    assert (back.fields, back.beam) == (record.fields, 128)
    np.testing.assert_array_equal(back.data, record.data)
    # fields of no known meaning and odd values stay as they are
    record = cloud(("x", "y", "z", "ring", "time", "range"), *np.zeros((3, 2)), [0.5, 1], [1e9, 0], [7, 8])
    points = lidar_frame_of(record).points
    assert (points.rings, points.timestamps_ns, sorted(points.extras)) == (None, None, ["range", "ring", "time"])
    np.testing.assert_array_equal(sent_back(record), record.data)
    empty = cloud(("x", "y", "z", "reflectivity", "r", "g", "b"), *np.zeros((7, 0)))
    assert (len(lidar_frame_of(empty).points), sent_back(empty).shape) == (0, (0,))


@pytest.mark.parametrize(
    ("values", "intensities"),
    [
        ([0.0, 0.5, 1.0], [0, 128, 255]),
        ([0.0, 1.0, 7.0], [0, 1, 7]),
        ([0.25, 254.75, 3.0], [0, 255, 3]),
        ([0.0, 65535.0, 257.0], [0, 255, 1]),
        ([-1.0, 0.0, 1.0], None),
        ([0.0, 1e9, 1.0], None),
    ],
)
def test_brightness_of_every_scale_is_kept_exactly(values, intensities):
    record = cloud(("x", "y", "z", "intensity"), *np.zeros((3, 3)), values)
    points = lidar_frame_of(record).points
    assert (None if points.intensities is None else points.intensities.tolist()) == intensities
    np.testing.assert_array_equal(sent_back(record), record.data)


def test_a_sweep_of_the_model_gives_all_that_its_points_have():
    points = LidarPoints(
        np.array([[1, 2, 3], [np.nan, 0, 0]], np.float32),
        np.array([9, 8], np.uint8),
        colors=np.array([[1, 2, 3], [4, 5, 6]], np.uint8),
        timestamps_ns=np.array([TIME.nanoseconds + 10**6, TIME.nanoseconds]),
    )
    record = point_cloud_of(LidarFrame(TIME.nanoseconds, points), sensor_id=0, seq=1)
    assert record.fields == ("x", "y", "z", "reflectivity", "time", "r", "g", "b")
    np.testing.assert_array_equal(record.points, np.float32([[1, 2, 3, 9, 0.001, 1, 2, 3]]))
    only = point_cloud_of(LidarFrame(TIME.nanoseconds, points), sensor_id=0, seq=1, fields=("x", "y", "z"))
    assert only.points.tolist() == [[1, 2, 3]]
    with pytest.raises(OptionError, match="field 'ring'; the points have x, y, z, reflectivity"):
        point_cloud_of(LidarFrame(0, points), sensor_id=0, seq=1, fields=("x", "y", "z", "ring"))


GREY = np.repeat(RGB[:, :, :1], 3, axis=2)


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[:, :, ::-1]),
        ("rgba8", np.dstack([RGB, np.full((3, 4), 255, np.uint8)])),
        ("bgra8", np.dstack([RGB[:, :, ::-1], np.full((3, 4), 255, np.uint8)])),
        ("mono8", RGB[:, :, :1]),
        ("raw", RGB),
        ("png", file_of(RGB, "PNG")),
        ("jpeg", file_of(RGB, "JPEG")),
    ],
)
def test_an_image_of_every_encoding_is_red_green_blue(encoding, pixels):
    record = image(pixels, encoding)
    camera_image = image_of(record, CAMERA)
    expected = GREY if encoding == "mono8" else RGB
    if encoding == "jpeg":
        expected = np.asarray(Image.open(io.BytesIO(record.data.tobytes())).convert("RGB"))
    # two decoders may round differently by a level or two
    np.testing.assert_allclose(camera_image.rgb.astype(int), expected, rtol=0, atol=3 if encoding == "jpeg" else 0)
    assert camera_image.timestamp_ns == TIME.nanoseconds
    assert np.shares_memory(camera_image.rgb, RGB) is (encoding in ("rgb8", "raw"))  # pixels in order are not copied
    if encoding not in ("raw", "png"):
        back = image_data_of(camera_image, sensor_id=1, seq=4, encoding=encoding)
        np.testing.assert_array_equal(back.data, record.data)


@pytest.mark.parametrize(
    ("form", "data", "problem"),
    [
        *((form, np.zeros(50, np.uint8), "data") for form in ("jpeg", "png")),  # another file
        *((form, file_of(RGB[:2], form), "data") for form in ("jpeg", "png")),  # of another size
        ("jpeg", file_of(RGB, "jpeg")[:20], "data"),
        ("png", file_of(RGB, "png")[:40], "data"),
        ("png", file_of(np.zeros((3, 4), np.uint16), "PNG"), ".*16 bits a value; expected 8 or less"),
    ],
)
def test_an_image_that_cannot_be_shown_is_a_fault_when_it_is_decoded_or_before(form, data, problem):
    camera_image = image_of(image(data, form), CAMERA)
    with pytest.raises(DataError, match=rf"image data \(table 5\): {problem}"):
        _ = camera_image.rgb
    with pytest.raises(DataError, match="width: 4; expected 8 as in the calibration"):
        image_of(image(RGB, "rgb8"), Camera("pinhole", 8, 3, 5.0, 5.0, 1.5, 1.0))
    with pytest.raises(DataError, match="channel: 2 of raw; expected 1, 3 or 4"):
        image_of(image(RGB[:, :, :2], "raw"), CAMERA)


def test_raw_bytes_are_the_records_of_the_recording_format_or_what_the_encoding_says():
    rows = np.zeros(2, XYZIRT)
    rows["x"], rows["intensity"], rows["ring"], rows["timestamp"] = [1, 2], [7, 255], [0, 300], [10.5, 1e-9]
    points = lidar_frame_of_raw(raw(rows.tobytes())).points
    found = points.positions[:, 0].tolist(), points.intensities.tolist(), points.rings.tolist()
    assert (*found, points.timestamps_ns.tolist()) == ([1, 2], [7, 255], [0, 300], [10_500_000_000, 1])
    content, png = raw(RGB.tobytes()), raw(file_of(RGB, "PNG").tobytes())
    for record, encoding, expected in ((content, "bgr8", RGB[:, :, ::-1]), (png, "png", RGB)):
        np.testing.assert_array_equal(image_of(image_record_of_raw(record, CAMERA, encoding), CAMERA).rgb, expected)
    for make, error, problem in (
        (lambda: lidar_frame_of_raw(raw(b"1" * 47)), DataError, "a remainder of 1 bytes"),
        (lambda: lidar_frame_of_raw(raw(b"~" * 46)), DataError, "times up to"),
        (lambda: image_record_of_raw(content, CAMERA, "mono8"), DataError, "length: 36; expected 12, as 4x3 pixels of"),
        (lambda: image_record_of_raw(content, CAMERA, "raw"), OptionError, "expected one of rgb8"),
    ):
        with pytest.raises(error, match=problem):
            make()


def box_list(direction, velocity, **changes):
    return sending.box_3d(0, 2, X=1.0, Y=2.0, Z=3.0, id=5, direction=direction, velocity=velocity, **changes).alone(0)


def test_the_speed_along_a_direction_of_any_length_becomes_a_velocity_and_what_is_missing_is_made_up():
    record = box_list((0, -3, 0), -2)
    boxes = boxes_3d_of(record, sensor_id="roof")
    np.testing.assert_allclose(boxes.yaws, [-np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(boxes.velocities, [[0, 2, 0]], atol=1e-12)
    assert (boxes.sensor_id, boxes.timestamp_ns, boxes.frame) == ("roof", sending.START_NS, PointsFrame.SENSOR)
    back = boxes_3d_record(boxes, sensor_id=0, seq=2)
    np.testing.assert_allclose(back.directions, [[0, -1, 0]], atol=1e-7)
    np.testing.assert_allclose(back.velocities, [-2], atol=1e-6)
    np.testing.assert_array_equal(back.centers, record.centers)
    np.testing.assert_array_equal(back.sizes_lwh, record.sizes_lwh)
    assert (back.id.tolist(), back.class_names) == ([5], ("Car",))
    own = boxes_3d_of(box_list((1, 0, 0), 1, velocity_vector=(1, 2, 3)))  # a velocity of its own wins
    assert own.velocities.tolist() == [[1, 2, 3]]
    scores = {"scores": np.array([0.0, 2.0]), "labels": ("Car", "车"), "score_form": ScoreForm.LOGIT}
    bare = boxes_3d_record(Boxes3D(7, np.zeros((2, 3)), np.ones((2, 3)), np.zeros(2), **scores), sensor_id=1, seq=3)
    assert (bare.id.tolist(), bare.velocities.tolist(), bare.velocity_vectors) == ([0, 1], [0, 0], None)
    np.testing.assert_allclose(bare.confidence, [0.5, 0.880797078], rtol=1e-7)  # 1 / (1 + e^-2), to 32 bits
    with pytest.raises(OptionError, match="boxes in the ego frame"):
        boxes_3d_record(Boxes3D.empty(0, frame=PointsFrame.EGO), sensor_id=0, seq=0)


def test_edges_of_boxes_are_the_whole_pixels_that_they_touch():
    corners = np.array([[-3.5, 1.25, 10.0, 19.5], [2.0, 3.0, 4.0, 5.0], [30.0, 40.0, 50.0, 60.0]])
    boxes = Boxes2D(5, corners, np.ones(3), ("a", "b", "c"))
    record = boxes_2d_record(boxes, sensor_id=0, seq=1, size_wh=(16, 12))
    assert record.corners_xyxy.tolist() == [[0, 1, 10, 12], [2, 3, 4, 5]]  # the third is beside the image
    assert record.class_names == ("a", "b")
    unbounded = boxes_2d_record(boxes, sensor_id=0, seq=1)
    assert unbounded.corners_xyxy.tolist() == [[0, 1, 10, 20], [2, 3, 4, 5], [30, 40, 50, 60]]
    whole = sending.boxes_2d(0, 1, sensor_id=2, id=-4, x1=103, y1=103, x2=204, y2=205)
    assert boxes_2d_record(boxes_2d_of(whole), sensor_id=2, seq=1, size_wh=(640, 480))[0] == whole[0]


@pytest.mark.parametrize(("depth_kind", "farthest"), [("z", 10.0), ("range", np.sqrt(9 + 4 + 100))])
def test_a_result_holds_image_depths_and_points(depth_kind, farthest):
    """Three points before a camera, one of them hidden behind another, in an image of 4x3."""
    camera_points = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 10.0], [3.0, 2.0, 10.0]])
    world_from_camera = RigidTransform.from_quaternion(np.array([10.0, 0, 0]), np.array([0.0, 0, 0, 1]))
    points_world = world_from_camera.apply(camera_points)
    view = view_points(points_world, CAMERA, world_from_camera, RGB, camera_id="front", timestamp_ns=2_000)
    points = LidarPoints(points_world.astype(np.float32), np.array([1, 2, 3], np.uint8))
    properties = PropertyStore()
    assert properties.set("depth_kind", depth_kind)
    record = sensor_fusion_record(
        FusedFrame("roof", 0, 1_000, 1_000, points, views=(view,)),
        view,
        RigidTransform.identity(),
        Setting.of(properties.snapshot(), {}),
        sent=LidarFrame(1_000, points, extras={"fields": ("x", "y", "z", "reflectivity")}),
        image=image(RGB, "rgb8"),
        numbers={"camera_id": 1, "lidar_id": 2, "image_seq": 3, "points_seq": 4},
        motion_compensated=True,
    )
    assert (record.timestamp, record.image_timestamp) == (Timestamp(0, 1_000), Timestamp(0, 2_000))
    assert (record.camera_id, record.lidar_id, record.image_seq, record.points_seq) == (1, 2, 3, 4)
    np.testing.assert_array_equal(record.pixels, RGB)
    assert record.point_fields == ("x", "y", "z", "reflectivity", "r", "g", "b")
    assert record.points[0].tolist() == [10, 0, 5, 1, *RGB[1, 2]]
    assert record.points[1, 4:].tolist() == [128, 128, 128]  # hidden
    assert (record.depth_kind, record.point_frame, record.motion_compensated) == (depth_kind, "lidar", 1)
    # u = 5 x / z + 1.5, v = 5 y / z + 1
    expected = np.zeros((3, 4), np.float32)
    expected[1, 2], expected[2, 3] = 5.0, farthest
    np.testing.assert_allclose(record.depths, expected, rtol=1e-6)
    assert lidar_frame_of_result(record).points.intensities.tolist() == [1, 2, 3]


ROTATION = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
LARGE_CAMERA = Camera("pinhole", 640, 480, 500.0, 500.0, 319.5, 239.5)


def objects(count=7, seed=0):
    random = np.random.default_rng(seed)
    covariances = random.normal(size=(2, count, 3, 3))
    covariances = covariances @ covariances.transpose(0, 1, 3, 2)
    return {
        "scores": random.uniform(-0.2, 1.2, count),
        "centers": random.normal(scale=30.0, size=(count, 3)),
        "center_covariances": covariances[0],
        "sizes_lwh": random.uniform(0.5, 5.0, (count, 3)),
        "size_covariances": covariances[1],
        "yaws": random.uniform(-3.0, 3.0, count),
        "velocities": random.normal(size=(count, 3)),
        "corners_xyxy": np.sort(random.uniform(-50, 700, (count, 2, 2)), axis=1).reshape(count, 4),
        "rows_3d": np.arange(count) - 1,
    }


def declared(found):
    count = len(found["scores"])
    known = {"labels": ("car",) * count, "ids": np.arange(count), "rows_2d": np.full(count, -1)}
    columns, sound = declared_columns(FusedBoxes(timestamp_ns=0, **found, **known), ROTATION, LARGE_CAMERA)
    pixels = columns.pop("corners_xyxy")
    return *columns.values(), pixels, sound


def test_objects_are_rotated_and_rounded_as_numpy_does_it():
    found = objects()
    headings = np.column_stack([np.cos(found["yaws"]), np.sin(found["yaws"]), np.zeros(7)])
    both = ROTATION @ found["center_covariances"] @ ROTATION.T
    expected = (
        np.clip(found["scores"], 0, 1),
        found["centers"] @ ROTATION.T,
        both,
        found["sizes_lwh"],
        found["size_covariances"],
        headings @ ROTATION.T,
        (found["velocities"] * headings).sum(axis=1),
        found["velocities"] @ ROTATION.T,
    )
    *columns, pixels, sound = declared(found)
    assert sound
    for column, values in zip(columns, expected, strict=True):
        # one rounding to 32 bits
        np.testing.assert_allclose(column, values.astype(np.float32), rtol=2e-7, atol=1e-7)
    whole = np.column_stack([np.floor(found["corners_xyxy"][:, :2]), np.ceil(found["corners_xyxy"][:, 2:])])
    cut = np.clip(whole, 0, [640, 480, 640, 480])
    cut[~(cut[:, 2:] > cut[:, :2]).all(axis=1)] = 0
    np.testing.assert_array_equal(pixels, cut)
    for covariances in (columns[2], columns[4]):
        np.testing.assert_array_equal(covariances, covariances.transpose(0, 2, 1))
    found["corners_xyxy"][2:4] = (np.nan, 10, 20, 30), (0, 10, np.inf, 30)  # outlines that are not finite
    *_, pixels, sound = declared(found)
    assert (sound, pixels[2:4].tolist()) == (True, [[0] * 4] * 2)
    *columns, sound = declared(objects(0))
    assert (sound, {len(column) for column in columns}) == (True, {0})


@pytest.mark.parametrize("name", [name for name in objects() if name not in ("corners_xyxy", "rows_3d")])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_not_sound(name, value):
    found = objects()
    found[name].reshape(7, -1)[3, -1] = value
    cut = name == "scores" and np.isinf(value)
    assert declared(found)[-1] == cut


@pytest.mark.parametrize(
    ("name", "location", "value", "row", "expected"),
    [
        ("sizes_lwh", 1, -1.0, -1, False),
        ("sizes_lwh", 1, 0.0, -1, True),
        ("sizes_lwh", 1, 0.0, 4, False),
        ("center_covariances", (2, 2), -1e-3, -1, False),
        ("size_covariances", (0, 0), -1e-3, -1, False),
        ("corners_xyxy", slice(None), (50, 100, -5, 200), -1, False),
    ],
)
def test_what_makes_no_sense_is_not_sound(name, location, value, row, expected):
    found = objects()
    found["corners_xyxy"][3] = 100, 100, 200, 200
    found[name][3][location], found["rows_3d"][3] = value, row
    assert declared(found)[-1] == expected


PERIOD_MS, COUNT, SPEED = 100, 12, 10.0


def boxes_at(k, x):
    return boxes_3d(PERIOD_MS * k, k, X=x, confidence=0.9, velocity=0.0)


def results_of(positions, *, cameras=(1,), path=None, detectors="simulated"):
    """Results of a box at each of some distances, one sweep each; the ego goes along a path, piece by piece."""
    found = []
    with interface(inline=True, cameras=cameras) as fusion:
        assert fusion.set_property("detectors", detectors)
        for k, x in enumerate(positions):
            assert path is None or fusion.send_motion(path(k))
            images = [no_boxes_2d(PERIOD_MS * k, k, sensor_id=camera) for camera in cameras]
            send_all(fusion, *images, boxes_at(k, x) if x is not None else no_boxes_3d(PERIOD_MS * k, k))
            found += fusion.results(1)
        fusion.flush()
        found += fusion.results(1)
    return found


def tracked(results):
    tracker = TrackedResults()
    return [reported for result in results for reported in tracker.take(result)]


def test_a_box_of_every_sweep_is_one_track_whose_velocity_is_found():
    results = results_of(12.0 + SPEED * PERIOD_MS / 1e3 * np.arange(COUNT))
    reported = tracked(results)
    assert [result.number for result in reported] == list(range(COUNT))
    assert {number for result in reported for number in result.record.id.tolist()} == {1}
    last = reported[-1].record
    np.testing.assert_allclose(last.velocity_vectors[0], [SPEED, 0.0, 0.0], atol=1.0)
    assert last.velocities[0] == pytest.approx(SPEED, abs=1.0)
    assert last.centers[0, 0] == pytest.approx(12.0 + SPEED * PERIOD_MS / 1e3 * (COUNT - 1), abs=0.3)
    assert last.points_seq == COUNT - 1
    assert last.center_covs[0, 0, 0] < results[-1].record.center_covs[0, 0, 0]
    reported = tracked(results_of([*[15.0] * 6, None, 15.0]))  # a missed box does not end it
    assert reported[7].record.id.tolist() == reported[5].record.id.tolist() == [1]
    # what is known of the detectors is that of the property
    other = tracked(results_of([15.0] * 6, detectors="independent"))
    assert not np.allclose(other[5].record.center_covs, reported[5].record.center_covs)


def test_every_image_of_a_sweep_gets_the_tracks_of_all_of_them():
    results = results_of(np.full(COUNT, 15.0), cameras=(1, 2))
    reported = [(result.record.camera_id, result.record.id.tolist()) for result in tracked(results)]
    assert reported == [(1, [1]), (2, [1])] * COUNT
    # a sweep whose last result was dropped is reported with the next one
    numbers = [result.number for result in tracked([result for result in results if result.number != 3])]
    assert numbers == [number for number in range(2 * COUNT) if number != 3]


def test_what_is_stationary_is_stationary_in_a_world_that_the_vehicle_drives_through():
    """Poses come piece by piece, and positions count from the newest one: the world must not jump with them."""

    def piece(k):
        times = START_NS + (np.array([PERIOD_MS * k - 50, PERIOD_MS * k]) * 1_000_000).astype(np.int64)
        positions = np.zeros((2, 3))
        positions[:, 0] = 5000.0 + SPEED * (times - START_NS) / 1e9
        return Poses(times, positions, np.tile([0.0, 0, 0, 1], (2, 1)))

    reported = tracked(results_of(40.0 - SPEED * PERIOD_MS / 1e3 * np.arange(COUNT), path=piece))
    assert all(result.record.motion_compensated == 1 for result in reported)
    np.testing.assert_allclose(reported[-1].record.velocity_vectors[0], 0.0, atol=0.5)
    assert {number for result in reported for number in result.record.id.tolist()} == {1}
