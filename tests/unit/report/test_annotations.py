"""Statistics of annotations, held against boxes and points that were put there."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.report.annotations import NO_CLASS, Labels, Spread
from sceneloom.scene import (
    AttributePath,
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    Poses,
    Scene,
)
from sceneloom.simulate import camera_mount

STILL = Poses(np.array([0, 10**9]), np.zeros((2, 3)), np.array([[0.0, 0.0, 0.0, 1.0]] * 2))
OURS = {"sceneloom": {"euler_unit": "degrees", "euler_order": "xyz"}}


def cuboid(name, size, location, *, label="car", times=(0, 10**9), stationary=None):
    rows = np.tile([*size, *location, 0.0, 0.0, 0.0], (len(times), 1)).astype(np.float64)
    speed = (AttributePath("speed", (1.0,), np.array([0])),) if name == "far" else ()
    return CuboidAnnotation(
        name, CuboidPath(np.array(times, np.int64), rows), label=label, stationary=stationary, attributes=speed
    )


@pytest.fixture(scope="module")
def scene():
    """A near car with three points, a far one without any, half hidden behind it, and a box without a class."""
    points = np.array([[10.0, 0.0, 0.0], [10.5, 0.2, 0.1], [9.5, -0.3, 0.3], [5.0, 5.0, 0.0]], np.float32)
    frames = LazyFrames.of([LidarFrame(t, LidarPoints(points)) for t in (0, 10**9)], [0, 10**9])
    camera_model = Camera("pinhole", 200, 100, 100.0, 100.0, 99.5, 49.5)
    black = np.zeros((100, 200, 3), np.uint8)
    images = LazyFrames.of([CameraImage.of(t, camera_model, black) for t in (0, 10**9)], [0, 10**9])
    rotation = camera_mount(position=(0.0, 0.0, 0.0))
    looks = Poses(STILL.timestamps_ns, np.zeros((2, 3)), np.tile(rotation.quaternion_xyzw, (2, 1)))
    boxes = (
        cuboid("near", (4.0, 2.0, 2.0), (10.0, 0.0, 0.0)),
        cuboid("far", (4.0, 2.0, 1.5), (30.0, 0.0, 0.0)),
        cuboid("thing", (1.0, 1.0, 1.0), (-20.0, 0.0, 0.0), label=None, times=(0,), stationary=True),
    )
    event = EventAnnotation("event", 0, 5)
    return Scene(
        (LidarSensor("lidar", frames, poses=STILL), CameraSensor("camera", camera_model, images, poses=looks)),
        annotations=(*boxes, event),
        metadata=OURS,
    )


@pytest.fixture(scope="module")
def labels(scene):
    return Labels.measured(scene, start_ns=0)


def test_classes_sizes_times_ranges_and_points_are_those_of_the_boxes(labels):
    cars, things = labels.classes
    assert (labels.types, labels.attributes) == ({"cuboid": 3, "event": 1}, {"speed": 1})
    assert [(c.label, c.objects) for c in labels.classes] == [("car", 2), (NO_CLASS, 1)]
    assert (cars.length.median, cars.height.low, cars.seconds.median) == (4.0, pytest.approx(1.525), 1.0)
    assert (things.stationary, things.seconds, cars.key_frames) == (1, None, 4)
    assert (labels.over_time[0], labels.over_time[-1]) == ((0.0, 3), (1.0, 3))
    cars, things = labels.classes
    assert things.ranges.median == pytest.approx(20.0)
    assert (cars.ranges.count, cars.ranges.median) == (4, pytest.approx(20.0))  # 10 and 30 m at two moments
    assert dict(zip(labels.range_edges, labels.range_counts, strict=True))[10.0] == 2
    assert cars.points.median == pytest.approx(1.5)  # 3 in one, 0 in the other
    assert (cars.empty_share, things.empty_share, labels.point_counts[:2]) == (0.5, 1.0, (4, 2))
    assert (cars.in_images_share, things.in_images_share) == (1.0, 0.0)
    # the far car lies wholly behind the near one, which nothing hides
    assert (cars.hidden.low, cars.hidden.high) == (pytest.approx(0.0, abs=1e-9), pytest.approx(1.0, abs=0.01))


def test_annotations_are_counted_without_sensors_and_in_days_of_today():
    assert Labels.measured(Scene(()), start_ns=0) is None
    found = Labels.measured(Scene((), annotations=(cuboid("a", (1, 1, 1), (0, 0, 0)),), metadata=OURS), start_ns=0)
    assert (found.classes[0].objects, found.moments) == (1, 0)
    assert (Spread.of([np.nan, 1.0, 3.0]).median, Spread.of([np.nan])) == (2.0, None)
    times = (1_700_000_000_000_000_001, 1_700_000_020_000_000_003)
    path = Poses(np.array(times), np.zeros((2, 3)), STILL.quaternions_xyzw)
    frames = LazyFrames.of([LidarFrame(t, LidarPoints(np.ones((1, 3), np.float32))) for t in times], list(times))
    boxes = (cuboid("near", (4.0, 2.0, 2.0), (10.0, 0.0, 0.0), times=times),)
    found = Labels.measured(Scene((LidarSensor("lidar", frames, poses=path),), boxes, metadata=OURS), start_ns=times[0])
    assert {count for _, count in found.over_time} == {1}
