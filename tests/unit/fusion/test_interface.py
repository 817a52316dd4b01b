"""Clause 5 in one process: what is sent comes back fused, and what cannot be is refused with a reason."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sceneloom.db34t import CalibrationData, ImageData, PointCloudData, Timestamp
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.types import Cause
from sceneloom.errors import OptionError

WIDTH, HEIGHT = 64, 48
FORWARD = (0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)
"""extrinsic_matrix, by columns, of a camera that looks forward from where the lidar is."""


def calibration(**changed):
    return CalibrationData(
        **{
            "image_size": (WIDTH, HEIGHT),
            "intrinsic_matrix": (50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1),
            "reference_frame": 0,
            "extrinsic_matrix": FORWARD,
            **changed,
        }
    )


def timestamp(milliseconds):
    return Timestamp.of(1_595_682_678_000_000_000 + milliseconds * 1_000_000)


def image(milliseconds, seq, level=7, sensor_id=1):
    pixels = np.full(HEIGHT * WIDTH * 3, level, np.uint8)
    return ImageData(
        sensor_id=sensor_id,
        timestamp=timestamp(milliseconds),
        seq=seq,
        height=HEIGHT,
        width=WIDTH,
        encoding="rgb8",
        channel=3,
        data=pixels,
    )


def cloud(milliseconds, seq, points=((10.0, 0.0, 0.0), (-10.0, 0.0, 0.0)), sensor_id=0):
    data = np.array(points, np.float32)
    return PointCloudData(
        sensor_id=sensor_id,
        timestamp=timestamp(milliseconds),
        seq=seq,
        number=len(data),
        fields=("x", "y", "z"),
        fields_number=3,
        data=data,
    )


@pytest.fixture(params=[True, False], ids=["inline", "threaded"])
def fusion(request):
    with FusionInterface(inline=request.param) as interface:
        assert interface.set_calibration(calibration(), camera_id=1, lidar_id=0)
        yield interface


def test_a_pair_comes_back_as_a_record_of_table_9(fusion):
    assert fusion.send(image(0, 5))
    assert fusion.send(cloud(0, 9))
    fusion.flush()
    result = fusion.get(0)
    record = result.record
    assert (result.number, record.image_seq, record.points_seq) == (0, 5, 9)
    assert (record.camera_id, record.lidar_id) == (1, 0)
    assert record.timestamp == timestamp(0)
    assert record.point_fields == ("x", "y", "z", "r", "g", "b")
    np.testing.assert_array_equal(record.points, [[10, 0, 0, 7, 7, 7], [-10, 0, 0, 128, 128, 128]])
    assert (
        record.depths[23, 31] == 10.0 or record.depths[24, 32] == 10.0
    )  # the axis meets the corner of four pixels
    assert np.count_nonzero(record.depths) == 1
    assert result.configuration["fusion_type"] == 0
    assert fusion.get(0) is None


def test_axes_that_were_declared_rotate_points_on_the_way_in_and_back(fusion):
    assert fusion.set_property("lidar_coordinate", (1, 0, 2))  # y forward, x right, z up
    by_columns = (1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1)
    assert fusion.set_calibration(calibration(extrinsic_matrix=by_columns), camera_id=1, lidar_id=0)
    assert fusion.send(image(0, 1))
    assert fusion.send(cloud(0, 1, points=[(0.0, 10.0, 0.0), (10.0, 0.0, 0.0)]))
    fusion.flush()
    points = fusion.get(0).record.points
    np.testing.assert_array_equal(points, [[0, 10, 0, 7, 7, 7], [10, 0, 0, 128, 128, 128]])


def test_results_of_points_can_be_in_the_camera_frame_and_depths_ranges(fusion):
    assert fusion.set_property("reference_frame", 0)
    assert fusion.set_property("depth_kind", "range")
    assert fusion.send(image(0, 1))
    assert fusion.send(cloud(0, 1, points=[(3.0, 0.0, -1.0)]))
    fusion.flush()
    record = fusion.get(0).record
    np.testing.assert_allclose(record.points[:, :3], [[0, 1, 3]], atol=1e-6)
    assert record.depths.max() == pytest.approx(10**0.5)
    assert (record.point_frame, record.depth_kind) == ("camera", "range")


def test_a_calibration_that_is_replaced_counts_for_what_comes_after(fusion):
    longer = calibration(intrinsic_matrix=(100.0, 0, 31.5, 0, 100.0, 23.5, 0, 0, 1))
    point = [(10.0, -2.0, 0.0)]
    for seq in range(4):
        if seq == 2:
            assert fusion.set_calibration(longer, camera_id=1, lidar_id=0)
        assert fusion.send(image(100 * seq, seq))
        assert fusion.send(cloud(100 * seq, seq, points=point))
    fusion.flush()
    columns = [int(np.nonzero(result.record.depths)[1][0]) for result in fusion.results(0)]
    assert columns == [42, 42, 52, 52]  # 31.5 + f * 2 / 10, to the pixel that it falls into


@pytest.mark.parametrize(
    ("record", "cause"),
    [
        (image(0, 1, sensor_id=3), Cause.NO_CALIBRATION),
        (cloud(0, 1, sensor_id=3), Cause.NO_CALIBRATION),
        (calibration(), Cause.BAD_RECORD),
        ("text", Cause.BAD_RECORD),
    ],
)
def test_what_cannot_be_taken_gets_0_and_the_reason(fusion, record, cause):
    outcome = fusion.send(record)
    assert (outcome.status, outcome.cause) == (0, cause)
    assert outcome.reason
    assert fusion.counters.counts() == {f"refused.{cause}": 1}


def test_the_same_number_again_is_refused(fusion):
    assert fusion.send(cloud(0, 1))
    assert fusion.send(cloud(0, 1)).cause is Cause.DUPLICATE


def test_an_image_of_another_size_is_refused(fusion):
    assert fusion.set_calibration(calibration(image_size=(32, 24)), camera_id=1, lidar_id=0)
    assert fusion.send(image(0, 1)).cause is Cause.BAD_RECORD


def test_an_algorithm_that_is_not_installed_is_refused_with_what_it_needs(fusion):
    outcome = fusion.set_property("fusion_algorithm", "MV3d")
    assert (outcome.status, outcome.cause) == (0, Cause.UNKNOWN_ALGORITHM)
    assert "trained network" in outcome.reason


def test_an_unknown_fusion_type_is_an_error(fusion):
    with pytest.raises(OptionError, match="fusion type 2"):
        fusion.get(2)


def test_after_the_end_nothing_is_taken(fusion):
    fusion.close()
    assert fusion.send(cloud(0, 1)).cause is Cause.CLOSED


def test_points_have_the_colours_of_the_image_in_the_result_however_many_images_there_are():
    points = ((10.0, 0.0, 0.0), (10.0, 1.0, 0.5), (-10.0, 0.0, 0.0))
    for cameras in ((1,), (1, 2)):
        with FusionInterface(inline=True) as fusion:
            for camera in cameras:
                assert fusion.set_calibration(calibration(), camera_id=camera, lidar_id=0)
                assert fusion.send(image(0, 5, level=20 * camera, sensor_id=camera))
            assert fusion.send(cloud(0, 5, points))
            fusion.flush()
            results = {result.record.camera_id: result.record for result in fusion.results(0)}
        assert set(results) == set(cameras)
        for camera, record in results.items():
            colors = [record.point_fields.index(name) for name in "rgb"]
            seen, other = [20.0 * camera] * 3, [128.0] * 3
            assert record.points[:, colors].tolist() == [seen, seen, other]


_LAYOUTS = {
    "plain": ("x", "y", "z"),
    "reflectivity": ("x", "y", "z", "reflectivity"),
    "both": ("intensity", "x", "reflectivity", "y", "z", "ring"),
    "colours first": ("b", "g", "r", "x", "y", "z", "time", "azimuth"),
    "a third of a colour": ("x", "y", "z", "r", "echo"),
}
_VALUES = {
    "whole": lambda rng, shape: rng.integers(0, 100, shape),
    "shares": lambda rng, shape: rng.random(shape),
    "negative": lambda rng, shape: -rng.random(shape) * 1000,
    "large": lambda rng, shape: rng.random(shape) * 1e6,
    "none": lambda rng, shape: np.zeros((0, shape[1])),
}


@pytest.mark.parametrize("fields", _LAYOUTS.values(), ids=_LAYOUTS)
def test_point_fields_go_by_the_names_that_were_sent_and_never_by_the_values(fusion, fields):
    others = tuple(name for name in fields if name not in ("x", "y", "z", "r", "g", "b"))
    expected = ("x", "y", "z", *others, "r", "g", "b")
    rng = np.random.default_rng(3)
    for seq, draw in enumerate(_VALUES.values()):
        data = draw(rng, (4, len(fields))).astype(np.float32)
        for axis, value in zip("xyz", (10.0, 0.0, 0.0), strict=True):
            data[:, fields.index(axis)] = value
        if "time" in fields:  # images are paired by it
            data[:, fields.index("time")] *= 1e-8
        sent = PointCloudData(
            sensor_id=0,
            timestamp=timestamp(100 * seq),
            seq=seq,
            number=len(data),
            fields=fields,
            fields_number=len(fields),
            data=data,
        )
        assert fusion.send(image(100 * seq, seq, level=9))
        assert fusion.send(sent)
        fusion.flush()
        record = fusion.get(0).record
        assert record.point_fields == expected
        columns = dict(zip(record.point_fields, record.points.T, strict=True))
        for name in (*"xyz", *others):
            np.testing.assert_array_equal(columns[name], data[:, fields.index(name)])
        for name in "rgb":
            np.testing.assert_array_equal(columns[name], 9.0)


_PIXELS = {
    "rgb8": (200, 100, 50),
    "bgr8": (50, 100, 200),
    "rgba8": (200, 100, 50, 7),
    "bgra8": (50, 100, 200, 7),
    "mono8": (90,),
    "raw": (200, 100, 50),
}


@pytest.mark.parametrize("encoding", [*_PIXELS, "jpeg", "png"])
@pytest.mark.parametrize("cameras", [1, 2])
def test_an_image_comes_back_in_the_encoding_in_which_it_was_sent(encoding, cameras):
    pixel = _PIXELS.get(encoding, (200, 100, 50))
    pixels = np.tile(np.array(pixel, np.uint8), (HEIGHT, WIDTH, 1))
    data = pixels.reshape(-1)
    if encoding in ("jpeg", "png"):
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, encoding, **({"quality": 100} if encoding == "jpeg" else {}))
        data = np.frombuffer(file.getvalue(), np.uint8)
    with FusionInterface(inline=True) as fusion:
        for camera_id in range(cameras):
            assert fusion.set_calibration(calibration(), camera_id=camera_id, lidar_id=0)
            sent = replace(image(0, 1, sensor_id=camera_id), encoding=encoding, channel=len(pixel), data=data)
            assert fusion.send(sent)
        assert fusion.send(cloud(0, 1))
        fusion.flush()
        records = [result.record for result in fusion.results(0)]
    assert len(records) == cameras
    for record in records:
        assert (record.encoding, record.image_channel) == (encoding, len(pixel))
        np.testing.assert_array_equal(record.image_data, data)
        expected = (90, 90, 90) if encoding == "mono8" else (200, 100, 50)
        np.testing.assert_allclose(record.points[0, 3:], expected, atol=3 if encoding == "jpeg" else 0)
