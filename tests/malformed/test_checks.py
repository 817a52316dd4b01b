"""Rules take whatever can be read, however odd: they find, or they find nothing, and never fail."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.malformed.damage import header, locations, replaced

from sceneloom import scene as sc
from sceneloom.checks import all_rules, validate

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
        sc.AttributePath("n", values, times, sensor_id=names[0], static=draw(st.booleans())),
        sc.AttributePath("m", values, None, point_index=draw(st.integers(-1, 2))),
    )
    duration = draw(ODD_NUMBERS)
    return (
        sc.CuboidAnnotation(
            "cuboid",
            sc.CuboidPath(times, rows(draw, count, 9)),
            label=draw(st.sampled_from([None, "", "Car", "car"])),
            stationary=draw(st.booleans()),
            parent_id=names[1],
            attributes=attributes,
            activations=(sc.Activation(names[2], times, tuple(duration for _ in range(count))),),
            projections=(sc.Projection(names[3], times, rows(draw, count, 4), flags),),
        ),
        sc.Box2DAnnotation("box", names[0], sc.BoxPath(times, rows(draw, count, 4)), parent_id="cuboid"),
        sc.ShapeAnnotation(
            "s3",
            draw(st.sampled_from([sc.ShapeType.POLYGON, sc.ShapeType.POLYGON_TOPDOWN])),
            sc.VertexPath(times, outlines),
        ),
        sc.ShapeAnnotation(
            "s2", sc.ShapeType.POLYGON_2D, sc.VertexPath(times, tuple(o[:, :2] for o in outlines)), sensor_id=names[1]
        ),
        sc.PointsAnnotation(
            "points",
            (sc.PointPath(times, rows(draw, count, draw(st.sampled_from([2, 3, 6]))), id=names[2]),),
            labels=("a", "b"),
            projections=((sc.PointProjection(names[3], times, rows(draw, count, 2), flags),),),
        ),
        sc.EventAnnotation("event", draw(TIMES), duration),
        sc.LabeledPointsAnnotation(
            "lp",
            (sc.LabeledPoints(names[0], np.array([0, 0, 2**32 - 1], np.uint32), draw(st.integers(-2, 2))),),
            is_instance=True,
        ),
    )


def odd_sensors(draw):
    positions = rows(draw, 6, 3)
    with np.errstate(over="ignore"):
        positions = positions.astype(np.float32)
    times = np.array([0, PERIOD])
    lidar = sc.LidarFrame(0, sc.LidarPoints(positions, np.zeros(6, np.uint8), np.zeros((6, 3), np.uint8)))
    radar = sc.RadarFrame(0, sc.RadarPoints(positions, positions, positions[:, 0].copy()))
    path = sc.Poses(times, np.array([[0.0, 0, 0], [5, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    stated = draw(st.sampled_from(list(sc.PointsFrame)))
    return (
        sc.LidarSensor("top", sc.LazyFrames.of([lidar] * 2, times), path, points_frame=stated),
        sc.RadarSensor("front", sc.LazyFrames.of([radar] * 2, times), path, points_frame=stated),
    )


@given(st.data())
def test_odd_numbers_are_found_and_fixes_settle(data):
    ours = {"euler_unit": data.draw(st.sampled_from(["degrees", "radians"])), "euler_order": "zyx"}
    scene = sc.Scene(odd_sensors(data.draw), data.draw(odd_annotations()), metadata={"sceneloom": ours})
    assert validate(scene, locations=None).findings
    for rule in all_rules():
        if rule.fix is not None:
            once = rule.fix(scene)
            again = rule.fix(once)
            assert again.annotations is once.annotations or all(
                a is b for a, b in zip(again.annotations, once.annotations, strict=True)
            )


HEADER = header(
    ["lidar", "radar", "camera"],
    ["cuboid", "labeled_points", "localization_adjustment"],
    time_unit="microseconds",
    attributes=[{"name": "a", "timestamps": [0], "values": [1], "static": True}],
)
ODD_VALUES = [None, -1, 2**70, "world", [[]], {"type": "lidar"}, np.ones((0, 3), np.float32)]


@pytest.mark.parametrize("share", [1, pytest.param(len(ODD_VALUES), marks=pytest.mark.slow)])
@pytest.mark.parametrize("rotation", range(len(ODD_VALUES)))
@pytest.mark.few(3)
def test_odd_values_anywhere_in_a_file_are_reported_or_let_pass(rotation, share, tmp_path, encode_sfs):
    """Each location gets a share of the values: one of them, or all."""
    for number, location in enumerate(locations(HEADER)):
        if (number - rotation) % len(ODD_VALUES) >= share:
            continue
        path = tmp_path / f"{number}.sfs"
        path.write_bytes(encode_sfs(replaced(HEADER, location, ODD_VALUES[rotation])))
        validate(path, profile="scale", locations=None)
