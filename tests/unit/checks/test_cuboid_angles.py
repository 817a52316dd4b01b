"""Rules about how the angles of cuboids are read, on objects whose orientation is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.scene import (
    CuboidAnnotation,
    CuboidPath,
    DataWarning,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsFrame,
    Scene,
    WarningKind,
)

PERIOD = 100_000_000
TIMES = np.arange(4, dtype=np.int64) * PERIOD
SIZE = np.array([4.5, 1.8, 1.5])
BY_MOTION, BY_POINTS = "cuboid-heading-off-motion", "cuboid-angles-off-points"


def rotations(count=24, *, tilted=False):
    """Orientations as scipy has them: all around, and where asked for up and down and sideways, too."""
    yaw = np.linspace(-170, 175, count)
    tilt = 40 * np.sin(np.arange(count)) if tilted else np.zeros(count)
    return Rotation.from_euler("ZYX", np.column_stack([yaw, tilt, -0.7 * tilt]), degrees=True)


def angles_of(orientation, unit, order):
    """Roll, pitch and yaw of the product of matrices in an order, by scipy's intrinsic rotations."""
    found = orientation.as_euler(order.upper(), degrees=unit == "degrees")
    return np.column_stack([found[:, order.index(axis)] for axis in "xyz"])


def scene_of(written, stated, *, tilted=False, speed=10.0, points=True):
    """Objects that move along their x axis; points on their faces, seen by a lidar whose points are in the world."""
    orientation = rotations(tilted=tilted)
    angles, forward = angles_of(orientation, *written), orientation.apply([1.0, 0, 0])
    start = np.column_stack([*np.divmod(np.arange(len(angles)), 6)[::-1], np.zeros(len(angles))]) * 12.0
    annotations = []
    for k in range(len(angles)):
        centers = start[k] + speed * (TIMES / 1e9)[:, None] * forward[k]
        rows = np.hstack([np.tile(SIZE, (4, 1)), centers, np.tile(angles[k], (4, 1))])
        annotations.append(CuboidAnnotation(k, CuboidPath(TIMES, rows), label="car"))
    rng = np.random.default_rng(0)
    frames = []
    for time_ns in TIMES:
        centers = start + speed * time_ns / 1e9 * forward
        inside = rng.uniform(-0.49, 0.49, (len(angles), 60, 3)) * SIZE
        cloud = np.concatenate([o.apply(p) + c for o, p, c in zip(orientation, inside, centers, strict=True)])
        frames.append(
            LidarFrame(int(time_ns), LidarPoints(cloud[: len(cloud) if points else 0].astype(np.float32)))
        )
    lidar = LidarSensor("top", LazyFrames.of(frames, TIMES), points_frame=PointsFrame.WORLD)
    ours = {"euler_unit": stated[0], "euler_order": stated[1]}
    return Scene((lidar,), tuple(annotations), metadata={"sceneloom": ours})


@pytest.mark.parametrize(
    "reading", [("degrees", "xyz"), ("radians", "xyz"), ("degrees", "zyx"), ("radians", "zxy")]
)
@pytest.mark.parametrize("tilted", [False, True])
def test_the_right_reading_is_left_alone(found, reading, tilted):
    scene = scene_of(reading, reading, tilted=tilted)
    assert found(scene, BY_MOTION) == []
    assert found(scene, BY_POINTS) == []


@pytest.mark.parametrize(
    ("written", "stated"),
    [(("degrees", "xyz"), ("radians", "xyz")), (("radians", "zyx"), ("degrees", "zyx"))],
)
def test_another_unit_is_known_by_motion_and_by_points(found, written, stated):
    scene = scene_of(written, stated)
    for rule in (BY_MOTION, BY_POINTS):
        [(path, message)] = found(scene, rule)
        assert path == "annotations"
        assert f"read as {stated[0]} in the order {stated[1]}" in message
        assert f"read as {written[0]} in the order {written[1]}" in message


def test_another_order_is_known_by_points_where_objects_are_tilted(found):
    scene = scene_of(("degrees", "zyx"), ("degrees", "xyz"), tilted=True)
    [(_, message)] = found(scene, BY_POINTS)
    assert "read as degrees in the order zyx" in message


def test_the_order_plays_no_part_where_objects_only_rotate(found):
    scene = scene_of(("degrees", "zyx"), ("degrees", "xyz"))
    assert found(scene, BY_MOTION) == []
    assert found(scene, BY_POINTS) == []


def test_stationary_objects_are_reported_by_points_alone(found):
    scene = scene_of(("degrees", "xyz"), ("radians", "xyz"), speed=0.0)
    assert found(scene, BY_MOTION) == []
    assert len(found(scene, BY_POINTS)) == 1


def test_without_points_motion_reports(found):
    scene = scene_of(("degrees", "xyz"), ("radians", "xyz"), points=False)
    assert found(scene, BY_POINTS) == []
    assert len(found(scene, BY_MOTION, frames=False)) == 1


def test_where_nothing_is_stated_the_evidence_is_reported(found):
    assumed = DataWarning(
        kind=WarningKind.ASSUMED, code="euler-unit", location="annotations", message="taken to be degrees"
    )
    scene = scene_of(("degrees", "xyz"), ("degrees", "xyz"))
    assert found(scene, "cuboid-angles-unsaid") == []
    [(path, message)] = found(replace(scene, warnings=(assumed,)), "cuboid-angles-unsaid")
    assert path == "annotations"
    assert message.startswith(
        "not stated; taken to be degrees in the order xyz: headings are 0° off the motion"
    )
    blind = replace(
        scene_of(("degrees", "xyz"), ("degrees", "xyz"), speed=0.0, points=False), warnings=(assumed,)
    )
    [(_, message)] = found(blind, "cuboid-angles-unsaid")
    assert message.endswith("neither motion nor points in the boxes report")


def test_objects_that_drive_backwards_are_along_their_motion(found):
    scene = scene_of(("degrees", "xyz"), ("degrees", "xyz"), speed=-10.0)
    assert found(scene, BY_MOTION) == []
