"""Rules take whatever can be read, however odd: they find, or they find nothing, and never fail."""

from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.checks import all_rules, validate
from sceneloom.scene import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointPath,
    PointProjection,
    PointsAnnotation,
    PointsFrame,
    Poses,
    Projection,
    RadarFrame,
    RadarPoints,
    RadarSensor,
    Scene,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)

ODD_NUMBERS = st.sampled_from([0.0, 1.0, -1.0, 4.5, 1e-300, 1e200, 1.7e308, np.nan, np.inf, -np.inf])
TIMES = st.sampled_from([0, 1, -1, 50_000_000, 100_000_000, 2**62, -(2**62)])
IDS = st.sampled_from(["top", "front", "a", "1", 1, ""])
PERIOD = 100_000_000


def rows(draw, count, columns):
    return np.array([draw(ODD_NUMBERS) for _ in range(count * columns)]).reshape(count, columns)


@st.composite
def odd_annotations(draw):
    """One annotation of each type that has numbers, all of them odd."""
    count = draw(st.integers(0, 4))
    times = np.array([draw(TIMES) for _ in range(count)], np.int64)
    flags = tuple(draw(st.sampled_from([True, False, None])) for _ in range(count))
    names = [draw(IDS) for _ in range(4)]
    values = tuple(draw(st.sampled_from(["a", 1, 2.5, True, None, ("x",), (1,), {}])) for _ in range(count))
    outlines = tuple(rows(draw, draw(st.integers(0, 5)), 3) for _ in range(count))
    attributes = (
        AttributePath("n", values, times, sensor_id=names[0], static=draw(st.booleans())),
        AttributePath("m", values, None, point_index=draw(st.integers(-1, 2))),
    )
    duration = draw(ODD_NUMBERS)
    return (
        CuboidAnnotation(
            "cuboid",
            CuboidPath(times, rows(draw, count, 9)),
            label=draw(st.sampled_from([None, "", "Car", "car"])),
            stationary=draw(st.booleans()),
            parent_id=names[1],
            attributes=attributes,
            activations=(Activation(names[2], times, tuple(duration for _ in range(count))),),
            projections=(Projection(names[3], times, rows(draw, count, 4), flags),),
        ),
        Box2DAnnotation("box", names[0], BoxPath(times, rows(draw, count, 4)), parent_id="cuboid"),
        ShapeAnnotation(
            "s3", draw(st.sampled_from([ShapeType.POLYGON, ShapeType.POLYGON_TOPDOWN])), VertexPath(times, outlines)
        ),
        ShapeAnnotation(
            "s2", ShapeType.POLYGON_2D, VertexPath(times, tuple(o[:, :2] for o in outlines)), sensor_id=names[1]
        ),
        PointsAnnotation(
            "points",
            (PointPath(times, rows(draw, count, draw(st.sampled_from([2, 3, 6]))), id=names[2]),),
            labels=("a", "b"),
            projections=((PointProjection(names[3], times, rows(draw, count, 2), flags),),),
        ),
        EventAnnotation("event", draw(TIMES), duration),
        LabeledPointsAnnotation(
            "lp",
            (LabeledPoints(names[0], np.array([0, 0, 2**32 - 1], np.uint32), draw(st.integers(-2, 2))),),
            is_instance=True,
        ),
    )


def odd_sensors(draw):
    positions = rows(draw, 6, 3)
    with np.errstate(over="ignore"):
        positions = positions.astype(np.float32)
    times = np.array([0, PERIOD])
    lidar = LidarFrame(0, LidarPoints(positions, np.zeros(6, np.uint8), np.zeros((6, 3), np.uint8)))
    radar = RadarFrame(0, RadarPoints(positions, positions, positions[:, 0].copy()))
    path = Poses(times, np.array([[0.0, 0, 0], [5, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    stated = draw(st.sampled_from(list(PointsFrame)))
    return (
        LidarSensor("top", LazyFrames.of([lidar] * 2, times), path, points_frame=stated),
        RadarSensor("front", LazyFrames.of([radar] * 2, times), path, points_frame=stated),
    )


@given(st.data())
def test_odd_numbers_are_found_and_fixes_settle(data):
    ours = {"euler_unit": data.draw(st.sampled_from(["degrees", "radians"])), "euler_order": "zyx"}
    scene = Scene(odd_sensors(data.draw), data.draw(odd_annotations()), metadata={"sceneloom": ours})
    assert validate(scene, locations=None).findings
    for rule in all_rules():
        if rule.fix is not None:
            once = rule.fix(scene)
            again = rule.fix(once)
            assert again.annotations is once.annotations or all(
                a is b for a, b in zip(again.annotations, once.annotations, strict=True)
            )


ROW = [4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 0.0, 0.0, 90.0]
POSES = {"timestamps": [0, 100_000], "values": [[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 1]]}
HEADER = {
    "version": "1.0",
    "time_offset": 0,
    "time_unit": "microseconds",
    "attributes": [{"name": "a", "timestamps": [0], "values": [1], "static": True}],
    "sensors": [
        {
            "id": "top",
            "type": "lidar",
            "coordinates": "ego",
            "parent_id": "p",
            "poses": POSES,
            "frames": [
                {
                    "timestamp": 0,
                    "points": {"positions": np.ones((2, 3), np.float32), "timestamps": np.ones(2, np.uint32)},
                }
            ],
        },
        {
            "id": "r",
            "type": "radar",
            "poses": POSES,
            "frames": [
                {
                    "timestamp": 0,
                    "points": {"positions": np.ones((2, 3), np.float32), "lengths": np.ones(2, np.float32)},
                }
            ],
        },
        {
            "id": "front",
            "type": "camera",
            "poses": POSES,
            "intrinsics": {
                "fx": 1,
                "fy": 1,
                "cx": 1,
                "cy": 1,
                "width": 2,
                "height": 2,
                "distortion": {"model": "fisheye", "params": [0]},
            },
            "images": [{"timestamp": 0, "content": np.zeros(4, np.uint8)}],
        },
    ],
    "annotations": [
        {
            "id": "c",
            "type": "cuboid",
            "path": {"timestamps": [0], "values": [ROW]},
            "attributes": [{"name": "a", "timestamps": [0], "values": [1], "static": True}],
            "activations": [{"sensor_id": "top", "timestamps": [0], "durations": [1], "cuboids": [ROW]}],
            "projections": [{"sensor_id": "front", "timestamps": [0], "boxes": [None]}],
        },
        {
            "id": "l",
            "type": "labeled_points",
            "label": "a",
            "labeled_points": [{"sensor_id": "top", "point_ids": np.ones(1, np.uint32)}],
        },
        {"id": "la", "type": "localization_adjustment", "poses": POSES},
    ],
}


def locations_of(node, location=()):
    """All locations of the header."""
    if isinstance(node, dict | list):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            yield (*location, key)
            yield from locations_of(value, (*location, key))


ODD_VALUES = [None, -1, 2**70, "world", [[]], {"type": "lidar"}, np.ones((0, 3), np.float32)]


@pytest.mark.parametrize("share", [1, pytest.param(len(ODD_VALUES), marks=pytest.mark.slow)])
@pytest.mark.parametrize("rotation", range(len(ODD_VALUES)))
@pytest.mark.few(3)
def test_odd_values_anywhere_in_a_file_are_reported_or_let_pass(rotation, share, tmp_path, encode_sfs):
    """Each location gets a share of the values: one of them, or all."""
    for number, location in enumerate(locations_of(HEADER)):
        if (number - rotation) % len(ODD_VALUES) >= share:
            continue
        value = ODD_VALUES[rotation]
        header = deepcopy(HEADER)
        node = header
        for key in location[:-1]:
            node = node[key]
        node[location[-1]] = value
        path = tmp_path / f"{number}.sfs"
        path.write_bytes(encode_sfs(header))
        validate(path, profile="scale", locations=None)
