"""Clause 5 in one process: properties; what is sent comes back fused; what goes wrong has one answer."""

import io
import threading
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sceneloom.colouring.algorithms import fuse_by_projection
from sceneloom.db34t import Boxes2d, Boxes3d
from sceneloom.db34t.interface import FusionInterface, PropertyStore, format_calibrations
from sceneloom.db34t.setting import MOST_PAIRS, MOST_PROPERTIES, PREDEFINED, CalibrationEntry, calibration_table
from sceneloom.db34t.types import Cause

from .sending import (
    FORWARD,
    HEIGHT,
    WIDTH,
    box_2d,
    box_3d,
    boxes_2d,
    boxes_3d,
    calibration,
    cloud,
    fused,
    image,
    interface,
    no_boxes_2d,
    no_boxes_3d,
    raw,
    send_all,
    timestamp,
)


@pytest.fixture(params=[True, False], ids=["inline", "threaded"])
def both(request):
    with interface(inline=request.param) as fusion:
        yield fusion


@pytest.fixture
def fusion():
    with interface(inline=True) as fusion:
        yield fusion


@pytest.fixture
def bare():
    """An interface without calibrations."""
    with FusionInterface(inline=True) as fusion:
        yield fusion


def pairs(fusion, kind=0):
    return [(record.points_seq, record.image_seq) for record in fused(fusion, kind)]


def test_a_pair_comes_back_as_a_record_of_table_9(both):
    send_all(both, image(0, 5), cloud(0, 9, [(10, 0, 0), (-10, 0, 0)]))
    both.flush()
    result = both.get(0)
    record = result.record
    assert (result.number, record.image_seq, record.points_seq) == (0, 5, 9)
    assert (record.camera_id, record.lidar_id, record.timestamp) == (1, 0, timestamp(0))
    assert record.point_fields == ("x", "y", "z", "r", "g", "b")
    np.testing.assert_array_equal(record.points, [[10, 0, 0, 7, 7, 7], [-10, 0, 0, 128, 128, 128]])
    assert record.depths[23, 31] == 10.0 or record.depths[24, 32] == 10.0  # the axis meets the corner of four pixels
    assert np.count_nonzero(record.depths) == 1
    assert result.configuration["fusion_type"] == 0
    assert both.get(0) is None


def test_what_cannot_be_taken_gets_0_and_the_reason_and_is_counted(both):
    send_all(both, cloud(0, 0), image(500, 5))
    cases = (
        (image(0, 1, sensor_id=3), Cause.NO_CALIBRATION, "no calibration of camera 3"),
        (cloud(0, 1, sensor_id=3), Cause.NO_CALIBRATION, "no calibration of lidar 3"),
        (calibration(), Cause.BAD_RECORD, "a CalibrationData; expected a record of tables 4 to 8"),
        ("text", Cause.BAD_RECORD, "a str; expected"),
        (cloud(0, 0), Cause.DUPLICATE, "seq 0 of lidar 0 came already"),
        (cloud(100, 0), Cause.DUPLICATE, "came already"),
        (image(399, 4), Cause.TIME_BACKWARDS, "101.000 ms older"),
        (image(500, 6, width=32), Cause.BAD_RECORD, "expected 64"),
        (raw(0, 1, b"", sensor_id=0), Cause.UNKNOWN_SENSOR, "whose kind and raw the property sensors says"),
    )
    for record, cause, reason in cases:
        outcome = both.send(record)
        assert (outcome.status, outcome.cause, reason in outcome.reason) == (0, cause, True), outcome.reason
    counts = {name: count for name, count in both.counters.counts().items() if name.startswith("refused.")}
    assert counts == Counter(f"refused.{cause}" for _, cause, _ in cases)
    send_all(both, image(401, 4), cloud(5000, 0))  # the lidar was started again
    assert both.set_property("sensors", '{"1": {"kind": "camera", "raw": "jpeg"}}')
    for sensor_id in (0, 1):
        assert both.send(cloud(5000, 1, sensor_id=sensor_id)).cause is Cause.UNKNOWN_SENSOR


def test_points_have_the_colours_of_the_image_in_the_result_where_there_are_several_images():
    with interface(inline=True, cameras=(1, 2)) as fusion:
        sent = [image(0, 5, level=20 * camera, sensor_id=camera) for camera in (1, 2)]
        records = fused(fusion, 0, *sent, cloud(0, 5, ((10.0, 0.0, 0.0), (10.0, 1.0, 0.5), (-10.0, 0.0, 0.0))))
    colors = {record.camera_id: record.points[:, -3:].tolist() for record in records}
    assert colors == {camera: [[20.0 * camera] * 3] * 2 + [[128.0] * 3] for camera in (1, 2)}


@pytest.mark.parametrize(
    "fields",
    [
        "x y z",
        "x y z reflectivity",
        "intensity x reflectivity y z ring",
        "b g r x y z time azimuth",  # colours first
        "x y z r echo",  # a third of a colour
    ],
)
def test_point_fields_go_by_the_names_that_were_sent_and_never_by_the_values(both, fields):
    fields = tuple(fields.split())
    others = tuple(name for name in fields if name not in ("x", "y", "z", "r", "g", "b"))
    rng, shape = np.random.default_rng(3), (4, len(fields))
    whole, shares, nothing = rng.integers(0, 100, shape), rng.random(shape), np.zeros((0, len(fields)))
    for seq, values in enumerate((whole, shares, -rng.random(shape) * 1000, rng.random(shape) * 1e6, nothing)):
        data = values.astype(np.float32)
        for axis, value in zip("xyz", (10.0, 0.0, 0.0), strict=True):
            data[:, fields.index(axis)] = value
        if "time" in fields:  # images are paired by it
            data[:, fields.index("time")] *= 1e-8
        sent = cloud(100 * seq, seq, data, fields=fields)
        (record,) = fused(both, 0, image(100 * seq, seq, level=9), sent)
        assert record.point_fields == ("x", "y", "z", *others, "r", "g", "b")
        columns = dict(zip(record.point_fields, record.points.T, strict=True))
        for name in (*"xyz", *others):
            np.testing.assert_array_equal(columns[name], data[:, fields.index(name)])
        for name in "rgb":
            np.testing.assert_array_equal(columns[name], 9.0)


def encoded(form, rgb=(9, 9, 9), **options):
    file = io.BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT), rgb).save(file, form, **options)
    return file.getvalue()


RGB_PIXEL = (200, 100, 50)
PIXELS = {"rgb8": RGB_PIXEL, "bgr8": RGB_PIXEL[::-1], "rgba8": (*RGB_PIXEL, 7), "bgra8": (*RGB_PIXEL[::-1], 7)}
PIXELS |= {"mono8": (90,), "raw": RGB_PIXEL, "jpeg": RGB_PIXEL, "png": RGB_PIXEL}


@pytest.mark.parametrize("encoding", PIXELS)
def test_an_image_comes_back_in_the_encoding_in_which_it_was_sent(encoding):
    pixel, file = PIXELS[encoding], encoding in ("jpeg", "png")
    content = encoded(encoding, pixel, quality=100) if file else bytes(pixel) * (WIDTH * HEIGHT)
    form = {"encoding": encoding, "channel": len(pixel), "data": np.frombuffer(content, np.uint8)}
    with interface(inline=True, cameras=(0, 1)) as fusion:
        sent = [replace(image(0, 1, sensor_id=camera_id), **form) for camera_id in (0, 1)]
        records = fused(fusion, 0, *sent, cloud(0, 1))
    assert [(record.encoding, record.image_channel) for record in records] == [(encoding, len(pixel))] * 2
    for record in records:
        np.testing.assert_array_equal(record.image_data, form["data"])
        expected = (90, 90, 90) if encoding == "mono8" else RGB_PIXEL
        np.testing.assert_allclose(record.points[0, 3:], expected, atol=3 if encoding == "jpeg" else 0)


def list_2d(milliseconds, seq, confidence, corners):
    count = len(corners)
    known = {"id": np.arange(count, dtype=np.int32), "class_names": ("Car",) * count}
    known |= {"confidence": np.asarray(confidence, np.float32), "corners_xyxy": np.asarray(corners, np.uint32)}
    return Boxes2d(sensor_id=1, seq=seq, timestamp=timestamp(milliseconds), **known)


def many_boxes_2d(milliseconds, seq, count):
    return list_2d(milliseconds, seq, np.full(count, 0.5), np.tile([5, 5, 15, 15], (count, 1)))


def test_boxes_that_wait_in_lists_or_alone_are_fused_after_a_while_though_nothing_more_comes():
    with interface() as fusion:
        for seq in range(3):
            # an image shortly before the sweep: one after it could be nearer
            send_all(fusion, no_boxes_2d(1000 * seq, seq), no_boxes_3d(1000 * seq + 10, seq))
            result = fusion.get(1, timeout_s=30.0)
            assert (result.number, result.record.image_seq, result.record.points_seq) == (seq, seq, seq)
        assert fusion.set_property("pairing_timeout_ms", 5)
        send_all(fusion, box_3d(5000, 3), box_2d(5000, 4))
        result = fusion.get(1, timeout_s=30)
    assert (result.record.points_seq, result.record.image_seq) == (3, 4)


def test_results_keep_the_order_of_what_came_whoever_fuses_it():
    count = 150
    with interface() as fusion:
        assert fusion.set_property("queue_length", 1000)
        assert fusion.set_property("result_queue_length", 1000)

        def send_frames():
            for seq in range(20):
                send_all(fusion, image(100 * seq, seq), cloud(100 * seq, seq))

        other = threading.Thread(target=send_frames)
        for seq in range(count):
            if seq == count // 2:
                other.start()
            # a long list goes to the thread, and so do those after it
            boxes = many_boxes_2d(100 * seq, seq, 120 if seq == count // 4 else 1)
            send_all(fusion, boxes, no_boxes_3d(100 * seq, seq))
        other.join()
        fusion.flush()
        for fusion_type, number in ((1, count), (0, 20)):
            results = list(fusion.results(fusion_type))
            assert [result.number for result in results] == list(range(number))
            assert [result.record.points_seq for result in results] == list(range(number))
    counts = fusion.counters.counts()
    for kind, number in (("boxes_2d", count), ("boxes_3d", count), ("image", 20), ("points", 20)):
        assert counts[f"received.{kind}"] == counts[f"fused.{kind}"] == number


def test_without_a_calibration_nothing_is_taken(bare):
    for seq in range(2):
        for send in (cloud, image, boxes_3d, boxes_2d, box_3d, box_2d):
            outcome = bare.send(send(0, seq))
            assert (outcome.status, outcome.cause) == (0, Cause.NO_CALIBRATION)
        if not seq:
            assert bare.set_calibration(calibration(), camera_id=1)
            assert '"extrinsic_matrix"' in bare.get_property("calibration")
            assert bare.set_property("calibration", "")


def test_a_calibration_that_looks_wrong_is_reported_at_the_first_send_and_stops_no_other_sensor(fusion):
    mirrored = calibration(extrinsic_matrix=(0, 0, 1, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0.5, 1))
    backward = calibration(extrinsic_matrix=(0, 0, -1, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 1))
    assert fusion.set_calibration(mirrored, camera_id=2, lidar_id=3)
    outcome = fusion.send(cloud(0, 1, sensor_id=3))
    assert (outcome.status, outcome.cause, "mirrors" in outcome.reason) == (0, Cause.BAD_CALIBRATION, True)
    send_all(fusion, cloud(0, 1), image(0, 1))
    assert pairs(fusion) == [(1, 1)]
    assert fusion.set_calibration(backward, camera_id=1, lidar_id=0)
    first, second = fusion.send(cloud(100, 2)), fusion.send(image(100, 2))
    assert (first.status, "mirrored or transposed?" in first.reason) == (1, True)
    assert (second.status, second.reason) == (1, "")
    assert fusion.counters.counts()["notes.calibration"] == 1


def test_clouds_without_points_or_with_very_many_fields_and_images_of_one_pixel_are_fused(bare):
    one = calibration(image_size=(1, 1), intrinsic_matrix=(1, 0, 0, 0, 1, 0, 0, 0, 1))
    assert bare.set_calibration(one, camera_id=1, lidar_id=0)
    for seq, points in enumerate([(), ((5.0, 0.0, 0.0),)]):
        send_all(bare, image(100 * seq, seq, width=1, height=1), cloud(100 * seq, seq, points))
    empty, full = fused(bare)
    assert (empty.point_num, empty.depths.tolist()) == (0, [[0.0]])
    np.testing.assert_array_equal(full.points, [[5, 0, 0, 7, 7, 7]])
    assert full.depths.tolist() == [[5.0]]
    for count, status in ((252, 1), (253, 0)):  # there has to be room for colours in the result
        fields = ("x", "y", "z", *(f"f{k}" for k in range(count - 3)))
        assert bare.send(cloud(1000 + count, count, np.ones(count), fields=fields)).status == status
    (record,) = fused(bare, 0, image(1252, 252, width=1, height=1))
    assert record.fields_number == 255


def records_of_a_recording(milliseconds, seq, *points, seconds):
    """A record of table 4 with points of reflectivity 30 and ring 5, `seconds` after the start."""
    rows = np.zeros(len(points), [("xyz", "<f4", 3), ("i", "u1"), ("r", "<u2"), ("t", "<f8")])
    rows["xyz"], rows["i"], rows["r"], rows["t"] = points, 30, 5, timestamp(0).nanoseconds / 1e9 + np.array(seconds)
    assert rows.itemsize == 23
    return raw(milliseconds, seq, rows.tobytes(), sensor_id=0)


def test_points_that_are_not_finite_are_left_out_and_counted(fusion):
    assert fusion.set_property("sensors", '{"0": {"kind": "lidar", "raw": "records"}, "1": {"kind": "camera"}}')
    gone = (np.nan, np.nan, np.nan)
    for seq, points in enumerate(([gone, (10, 0, 0), (0, np.inf, 0), (10, 1, 0)], [gone, gone], [gone])):
        send_all(fusion, image(100 * seq, seq), cloud(100 * seq, seq, points))
    seconds = (0.3, 0.3, np.nan)
    raw_points = records_of_a_recording(300, 3, (np.nan, 0, 0), (10, 0, 0), (10, 1, 0), seconds=seconds)
    *_, record = records = fused(fusion, 0, image(300, 3), raw_points)
    found = [record.points[:, :3].tolist() for record in records]
    assert found == [[[10, 0, 0], [10, 1, 0]], [], [], [[10, 0, 0]]]
    assert record.point_fields == ("x", "y", "z", "reflectivity", "ring", "time", "r", "g", "b")
    assert fusion.counters.counts()["left-out.points"] == 7
    assert fusion.send(raw(300, 4, b"x" * 24, sensor_id=0)).cause is Cause.BAD_RECORD


def test_a_box_that_heads_straight_up_in_its_own_axes_is_refused_for_it_does_not_state_how_it_lies(fusion):
    assert fusion.set_property("lidar_axes", "+z,+x,-y")
    optical = tuple(np.eye(4).reshape(-1).tolist())
    assert fusion.set_calibration(calibration(extrinsic_matrix=optical), camera_id=1, lidar_id=0)
    for send in (boxes_3d, box_3d):
        outcome = fusion.send(send(0, 1, direction=(0.0, -2.0, 0.0)))
        assert (outcome.cause, "is vertical" in outcome.reason) == (Cause.BAD_RECORD, True)
    assert fusion.counters.counts() == {"refused.bad-record": 2}


def test_every_box_that_was_taken_is_in_a_result_or_counted(fusion):
    rng = np.random.default_rng(5)
    known = {"id": np.arange(6, dtype=np.int32), "class_names": ("Car",) * 6, "velocities": np.zeros(6, np.float32)}
    for seq in range(40):
        corners = rng.integers(0, 200, (6, 4))
        two = list_2d(100 * seq, seq, rng.random(6), np.hstack([corners[:, :2], corners[:, :2] + 1 + corners[:, 2:]]))
        drawn = {"confidence": rng.random(6), "centers": rng.normal(0, 30, (6, 3))}
        drawn |= {"sizes_lwh": rng.uniform(0.1, 5, (6, 3)), "directions": rng.normal(0, 1, (6, 3))}
        columns = known | {name: values.astype(np.float32) for name, values in drawn.items()}
        (record,) = fused(fusion, 1, Boxes3d(sensor_id=0, seq=seq, timestamp=timestamp(100 * seq), **columns), two)
        counts = fusion.counters.counts()
        for kind, ids in (("boxes_3d", record.box_3d_ids), ("boxes_2d", record.box_2d_ids)):
            left_out = counts.get(f"left-out.{kind}", 0)
            assert len({number for number in ids if number is not None}) + left_out == 6
            fusion.counters.add(f"left-out.{kind}", -left_out)


def test_objects_that_the_image_does_not_show_have_an_empty_outline_and_frames_without_boxes_are_fused_to_none(fusion):
    for seq, center in enumerate(({"X": -20.0}, {"X": 5.0, "Y": 60.0}, {"X": 20.0})):
        send_all(fusion, no_boxes_2d(100 * seq, seq), boxes_3d(100 * seq, seq, **center))
    *hidden, ahead, none = fused(fusion, 1, no_boxes_3d(300, 3), no_boxes_2d(300, 4))
    for record in hidden:  # behind and beside
        assert record.corners_xyxy.tolist() == [[0, 0, 0, 0]]
        assert record.in_image.tolist() == [False]
    assert ahead.in_image.tolist() == [True]
    assert (len(none), none.points_seq, none.image_seq) == (0, 3, 4)
    (record,) = fused(fusion, 1, boxes_2d(400, 5), boxes_3d(400, 5, direction=(3.0, 0.0, 4.0), velocity=-2.0))
    (found,) = record  # goes uphill
    assert found.direction == pytest.approx((0.6, 0.0, 0.8)) or found.direction == pytest.approx((-0.6, 0.0, -0.8))
    assert found.velocity == pytest.approx(-2.0 if found.direction[0] > 0 else 2.0)


@pytest.mark.parametrize("form", ["jpeg", "png", "rgb8"])
def test_raw_data_of_each_declared_form_are_fused(fusion, form):
    sensors = '{"0": {"kind": "lidar", "raw": "records"}, "1": {"kind": "camera", "raw": "%s"}}'
    assert fusion.set_property("sensors", sensors % form)
    data = bytes([9]) * (WIDTH * HEIGHT * 3) if form == "rgb8" else encoded(form)
    sweep = records_of_a_recording(0, 9, (10, 0, 0), (-10, 0, 0), seconds=(0, 0))
    (record,) = fused(fusion, 0, raw(0, 8, data, sensor_id=1), sweep)
    assert (record.points_seq, record.image_seq) == (9, 8)
    columns = {name: column.tolist() for name, column in zip(record.point_fields, record.points.T, strict=True)}
    assert (columns["reflectivity"], columns["ring"], columns["r"]) == ([30, 30], [5, 5], [9, 128])


@pytest.mark.parametrize(
    ("hours", "jumping", "lost", "counted"),
    [
        (-30, range(5, 10), [], "clock.set-back"),
        (30, range(5, 10), [], "clock.set-forward"),
        (1, [4], [4], None),  # one wrong timestamp costs one record
    ],
)
def test_after_all_clocks_were_set_pairs_go_on(fusion, hours, jumping, lost, counted):
    for seq in range(10):
        jump = hours * 3_600_000 * (seq in jumping)
        image_jump = 0 if lost else jump
        send_all(fusion, image(100 * seq + image_jump, seq), cloud(100 * seq + 3 + jump, seq))
    assert pairs(fusion) == [(seq, seq) for seq in range(10) if seq not in lost]
    assert counted is None or fusion.counters.counts()[counted] >= 1


def failing(*_, **__):
    raise ZeroDivisionError("an algorithm of somebody")


def test_an_algorithm_that_fails_is_counted_and_leaves_other_lidars_and_pairs_their_images(monkeypatch):
    def fails_near(points, *given, **options):
        return failing() if points[0, 0] < 15 else fuse_by_projection(points, *given, **options)

    monkeypatch.setattr("sceneloom.fusion.system.algorithm", lambda kind, name: failing if kind else fails_near)
    with interface(inline=True, lidars=(0, 2)) as fusion:
        send_all(fusion, cloud(0, 1), cloud(0, 5, [(20.0, 0, 0)], sensor_id=2), image(0, 1))
        assert pairs(fusion) == [(5, 1)]
        assert fused(fusion, 1, boxes_2d(0, 1), boxes_3d(0, 1)) == []
        monkeypatch.undo()
        assert fusion.set_property("fusion_algorithm", "blending")  # the other one is known by its name
        send_all(fusion, image(100, 2), cloud(100, 2))
        assert pairs(fusion) == [(2, 2)]
        counts = fusion.counters.counts()
    assert (counts["errors.ZeroDivisionError"], counts["failed.points"], counts["failed.boxes_3d"]) == (2, 1, 1)


def test_queues_are_as_long_as_the_properties_say(fusion):
    assert fusion.set_property("queue_policy", "refuse")
    assert fusion.set_property("queue_length", 2)
    outcomes = [fusion.send(cloud(100 * seq, seq)) for seq in range(4)]
    assert [outcome.cause for outcome in outcomes] == ["", "", Cause.QUEUE_FULL, Cause.QUEUE_FULL]
    send_all(fusion, image(0, 0), image(100, 1))
    assert fusion.send(cloud(200, 2))  # the same number again is no duplicate: it was not taken before
    assert pairs(fusion) == [(0, 0), (1, 1), (2, 1)]
    for name, value in (("queue_policy", "drop-oldest"), ("queue_length", 32), ("result_queue_length", 3)):
        assert fusion.set_property(name, value)
    for seq in range(10, 20):
        send_all(fusion, image(100 * seq, seq), cloud(100 * seq, seq))
    fusion.flush()
    assert (fusion.waiting_results, fusion.counters.counts()["dropped.results"]) == (3, 7)
    assert [result.number for result in fusion.results(0)] == [10, 11, 12]


def test_boxes_alone_are_closed_by_the_next_number_and_by_flush(fusion):
    send_all(fusion, *(box_2d(100 * seq, seq, id=number) for seq in (0, 1) for number in range(3)))
    send_all(fusion, *(box_3d(100 * seq, seq, id=k, X=20.0 + 10 * k) for seq in (0, 1) for k in range(2)))
    assert fusion.waiting_boxes == 5
    assert fusion.send(box_3d(0, 0)).cause is Cause.DUPLICATE  # of a frame that is closed already
    assert fusion.waiting_boxes == 5
    assert pairs(fusion, 1) == [(0, 0), (1, 1)]
    assert fusion.waiting_boxes == 0
    fusion.close()
    counts = fusion.counters.counts()
    assert (counts["received.box_2d"], counts["gathered.boxes_2d"], counts["fused.boxes_2d"]) == (6, 2, 2)
    with interface(inline=True, lidars=(0, 2)) as fusion:  # one belongs to the sensor that sent its frame
        assert fusion.send(box_3d(0, 7)).cause is Cause.UNKNOWN_SENSOR
        sent = cloud(0, 6, sensor_id=0), cloud(0, 7, sensor_id=2), box_3d(0, 7), box_2d(0, 1)
        record = fused(fusion, 1, *sent)[0]
    assert (record.lidar_id, record.points_seq) == (2, 7)


def test_without_images_sweeps_are_not_kept_waiting():
    with interface() as fusion:
        assert fusion.set_property("pairing_timeout_ms", 0)
        assert fusion.set_property("pairing_tolerance_ms", 1.0)
        assert fusion.send(cloud(0, 1))
        done = threading.Event()
        while not done.wait(0.001) and fusion.counters.counts().get("unpaired.points") != 1:
            pass
        assert fusion.waiting_records == 0


def test_all_who_wait_are_let_go_at_the_end_and_each_result_goes_to_one():
    fusion = interface()
    found, guard = [], threading.Lock()

    def fetch():
        while (result := fusion.get(0, timeout_s=float("inf"))) is not None:
            with guard:
                found.append(result.number)

    threads = [threading.Thread(target=fetch) for _ in range(4)]
    for thread in threads:
        thread.start()
    for seq in range(20):
        send_all(fusion, image(100 * seq, seq), cloud(100 * seq, seq))
        fusion.flush()
    fusion.close()
    for thread in threads:
        thread.join(30)
    assert not any(thread.is_alive() for thread in threads)
    assert sorted(found) == list(range(20))


def test_a_pair_of_another_setting_than_its_sweep_is_fused(fusion):
    assert fusion.send(boxes_3d(0, 1))
    assert fusion.set_calibration(calibration(extrinsic_matrix=FORWARD), camera_id=2, lidar_id=0)
    send_all(fusion, boxes_2d(0, 1), boxes_2d(0, 2, sensor_id=2))
    assert pairs(fusion, 1) == [(1, 1), (1, 2)]


def keep_cameras(fusion, *cameras):
    entries = tuple(CalibrationEntry(camera_id, 0, calibration()) for camera_id in cameras)
    assert fusion.set_property("calibration", format_calibrations(entries))


def test_a_camera_whose_calibration_was_taken_away_is_not_waited_for_any_more():
    fusion = interface(inline=True, cameras=(1, 2))
    send_all(fusion, image(0, 0, sensor_id=1), image(0, 0, sensor_id=2), cloud(0, 0))
    assert len(list(fusion.results(0))) == 2
    send_all(fusion, cloud(150, 1), image(150, 1))  # that of camera 2 never comes
    keep_cameras(fusion, 1)
    assert not list(fusion.results(0))
    assert fusion.send(cloud(300, 2))  # from here on the other calibrations count
    assert [found.record.points_seq for found in fusion.results(0)] == [1]
    assert fusion.send(image(300, 2))
    assert [found.record.points_seq for found in fusion.results(0)] == [2]
    assert fusion.send(image(300, 2, sensor_id=2)).cause is Cause.NO_CALIBRATION
    fusion.close()
    # what it sent before is for the sweeps of that time alone
    with interface(inline=True, cameras=(1, 2)) as fusion:
        send_all(fusion, image(0, 0, sensor_id=2), boxes_2d(0, 0, sensor_id=2), cloud(0, 0), boxes_3d(0, 0))
        keep_cameras(fusion, 1)
        send_all(fusion, cloud(20, 1), boxes_3d(20, 1), image(0, 0), boxes_2d(0, 0))
        for kind in (0, 1):
            found = [(record.points_seq, record.camera_id) for record in fused(fusion, kind)]
            assert found == [(0, 1), (0, 2), (1, 1)]
    assert fusion.waiting_records == 0


def test_a_camera_that_comes_back_is_waited_for_again(fusion):
    for seq, cameras in enumerate(((1,), (2,), (1, 2))):
        keep_cameras(fusion, *cameras)
        assert fusion.send(cloud(100 * seq, seq))
    for sensor_id in (2, 1):
        assert not list(fusion.results(0))
        send_all(fusion, *(image(100 * seq, seq, sensor_id=sensor_id) for seq in range(3)))
    found = {(r.record.points_seq, r.record.camera_id) for r in fusion.results(0)}
    assert {(2, 1), (2, 2)} <= found


def test_so_many_calibrations_may_be_there_and_cameras_may_have_so_many_pixels_together(bare):
    with FusionInterface(inline=True, most_bytes=7 * 2 * 64 * 48) as fusion:
        too_large = calibration(image_size=(64, 97))
        assert fusion.set_calibration(too_large, camera_id=0).cause is Cause.TOO_MANY
        for camera_id, status in ((0, 1), (1, 1), (2, 0)):
            assert fusion.set_calibration(calibration(), camera_id=camera_id)
            assert fusion.send(cloud(100 * camera_id, camera_id)).status == status
    entries = [CalibrationEntry(k % 256, k // 256, calibration()) for k in range(MOST_PAIRS + 1)]
    bare._table = calibration_table(entries[:-1])
    assert bare.set_calibration(calibration(), camera_id=3, lidar_id=0)
    assert bare.set_calibration(calibration(), camera_id=3, lidar_id=200).cause is Cause.TOO_MANY
    assert bare.set_property("calibration", format_calibrations(tuple(entries))).cause is Cause.OUT_OF_RANGE


TABLE_2 = {
    "fusion_type": 0,
    "chirality": 0,
    "camera_coordinate": (2, 0, -1),
    "lidar_coordinate": (0, -1, 2),
    "camera_frequency": 10,
    "lidar_frequency": 10,
}
"""Names and examples of table 2, less the algorithm, whose example is not built in."""


def test_the_properties_of_table_2_stand_first_with_its_examples_and_every_default_can_be_set():
    store = PropertyStore()
    before = store.snapshot()
    assert list(before.properties)[:7] == [*TABLE_2, "fusion_algorithm"]
    assert {name: before[name] for name in TABLE_2} == TABLE_2
    assert all(found.predefined for found in before.properties.values())
    for row in PREDEFINED.values():
        assert store.set(row.name, row.default).status == 1, row.name
    assert store.set("lidar_frequency", 20)
    assert (before["lidar_frequency"], store.snapshot()["lidar_frequency"]) == (10, 20)  # a snapshot stays as it was
    assert store.snapshot().revision > before.revision


REFUSED = {
    Cause.ILL_TYPED: [
        *(("camera_frequency", value) for value in (-1, 2**32, 2**32 + 20, 20.0, "20", True)),  # it does not wrap to 0
        *(("camera_coordinate", value) for value in ((2, 0), (2, 0, 200))),
        *(("fusion_type", 2), ("pairing_tolerance_ms", float("nan"))),
    ],
    Cause.OUT_OF_RANGE: [
        *(("camera_frequency", 0), ("camera_coordinate", (2, 0, 0)), ("pairing_tolerance_ms", -1.0)),
        *(("depth_kind", "y"), ("sensors", "[]"), ("calibration", '[{"camera_id": 300}]'), ("lidar_axes", "up")),
    ],
    Cause.UNKNOWN_NAME: [("no_such", 1)],
}


@pytest.mark.parametrize(("name", "value", "cause"), [(*row, cause) for cause, rows in REFUSED.items() for row in rows])
def test_what_is_refused_leaves_the_property_as_it_was(name, value, cause):
    store = PropertyStore()
    before = store.snapshot()
    outcome = store.set(name, value)
    assert (outcome.status, outcome.cause) == (0, cause)
    assert outcome.reason
    assert store.snapshot() is before


def test_each_fusion_type_keeps_its_own_algorithm():
    asked = []
    store = PropertyStore(check_algorithm=lambda fusion_type, name: asked.append((fusion_type, name)))
    assert store.set("fusion_algorithm", "of_points")
    assert store.set("fusion_type", 1)
    assert store.get("fusion_algorithm").value == "projection"
    assert store.set("fusion_algorithm", "of_boxes")
    assert store.snapshot().algorithms == ("of_points", "of_boxes")
    assert store.set("fusion_type", 0)
    assert store.get("fusion_algorithm").value == "of_points"
    assert asked == [(0, "of_points"), (1, "of_boxes")]


def test_an_enum_takes_the_names_and_numbers_of_its_description_and_truth_values_of_two():
    store = PropertyStore()
    for value in (0, 1, False, True, np.uint8(1)):
        assert store.set("chirality", value)
        found = store.get("chirality").value
        assert (type(found), found) == (int, int(value))
    assert store.add("weather", "what it is like: dry=0, rain=1, snow=-1", "enum")
    assert store.set("weather", "snow")
    assert store.get("weather").value == -1
    assert [store.set("weather", value).status for value in (1, 2, "fog")] == [1, 0, 0]
    assert store.get("weather").value == 1
    assert not store.add("mood", "without values", "enum")


def test_what_is_wrong_with_a_property_that_is_added_is_named_and_who_adds_for_ever_is_stopped():
    store = PropertyStore()
    for name in ("", " ", "a b", "\n", "x" * 257):
        assert store.add(name, "", "bool").cause is Cause.ILL_TYPED
    for name, description, wrong, sound in (
        ("frequency", "x" * 100_001, "description", "name"),
        ("a name", "", "name", "description"),
    ):
        outcome = store.add(name, description, "uint32")
        assert (outcome.status, wrong in outcome.reason, sound in outcome.reason) == (0, True, False)
    outcomes = [store.add(f"p{k}", "", "bool") for k in range(MOST_PROPERTIES)]
    assert (outcomes[0].status, outcomes[-1].cause) == (1, Cause.TOO_MANY)
    assert store.add("p0", "", "bool").cause is Cause.KNOWN_NAME
    assert len(store.snapshot().properties) == MOST_PROPERTIES


def test_callers_at_once_lose_no_change():
    store = PropertyStore()
    start = threading.Barrier(4)

    def add(caller):
        start.wait()
        for k in range(100):
            assert store.add(f"p{caller}_{k}", "", "uint32")
            assert store.set(f"p{caller}_{k}", k)

    threads = [threading.Thread(target=add, args=(caller,)) for caller in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    found = store.snapshot()
    assert found.revision == 800
    assert all(found[f"p{caller}_{k}"] == k for caller in range(4) for k in range(100))
