"""Whatever the model can hold is the same after writing and reading."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sceneloom.formats.sfs.clock import FileClock, chosen_offset_ns
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.scene import (
    AttributePath,
    Coordinates,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    GnssSensor,
    ImuSensor,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    OdometrySensor,
    PointsFrame,
    Poses,
    Scene,
    Trajectory,
    VectorSamples,
)

EPOCH_NS = 1_700_000_000_000_000_000
NUMBERS = st.floats(-1e6, 1e6, width=32)
NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
IDS = st.integers(-(2**53), 2**53) | NAMES
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | NAMES,
    lambda children: st.lists(children, max_size=3) | st.dictionaries(NAMES, children, max_size=3),
    max_leaves=8,
)


def extras_beside(*taken):
    known = {
        "id",
        "type",
        "parent_id",
        "poses",
        "coordinates",
        "frames",
        "timestamp",
        "points",
        "path",
        "label",
        *taken,
    }
    known |= {"stationary", "attributes", "activations", "projections", "images", "video", "intrinsics", "streams"}
    return st.dictionaries(NAMES.filter(lambda name: name not in known), JSON, max_size=2)


@st.composite
def pose_paths(draw, start_ns):
    count = draw(st.integers(1, 4))
    steps = draw(st.lists(st.integers(1, 10**9), min_size=count, max_size=count))
    quaternions = draw(hnp.arrays(np.float64, (count, 4), elements=st.floats(0.1, 1.0)))
    return Poses(
        start_ns + np.cumsum(steps),
        draw(hnp.arrays(np.float64, (count, 3), elements=st.floats(-1e7, 1e7))),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
    )


@st.composite
def lidars(draw, start_ns):
    frames = []
    for number in range(draw(st.integers(0, 3))):
        count = draw(st.integers(0, 4))
        start = start_ns + number * 10**8

        def optional(dtype, shape):
            return draw(st.none() | hnp.arrays(dtype, shape))

        points = LidarPoints(
            draw(hnp.arrays(np.float32, (count, 3), elements=st.floats(-9999, 9999, width=32))),
            optional(np.uint8, count),
            optional(np.uint8, (count, 3)),
            draw(st.none() | hnp.arrays(np.int64, count, elements=st.integers(start, start + 10**8))),
            optional(np.uint16, count),
            optional(np.uint8, count),
        )
        times = points.timestamps_ns
        frames.append(LidarFrame(start if times is None or count == 0 else int(times.min()), points))
    return LidarSensor(
        draw(IDS),
        LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]),
        draw(st.none() | pose_paths(start_ns)),
        coordinates=draw(st.sampled_from(Coordinates)),
        points_frame=draw(st.sampled_from(PointsFrame)),
        model=draw(st.none() | NAMES),
        parent_id=draw(st.none() | IDS),
        extras=draw(extras_beside()),
    )


@st.composite
def motion_sensors(draw, start_ns):
    count = draw(st.integers(0, 3))
    times = start_ns + np.arange(count, dtype=np.int64)
    anything = st.floats(width=64)
    seconds = draw(st.none() | hnp.arrays(np.float64, count, elements=anything))
    samples = VectorSamples(times, draw(hnp.arrays(np.float64, (count, 3), elements=anything)), seconds)
    gnss = [draw(hnp.arrays(np.float64, shape, elements=anything)) for shape in ((count, 3), count, count)]
    return (
        ImuSensor("imu", {draw(NAMES): samples}),
        GnssSensor("gnss", times, *gnss, seconds),
        OdometrySensor("odometry", draw(pose_paths(start_ns))),
    )


@st.composite
def scenes(draw):
    start_ns = draw(st.sampled_from([0, 5_000_000_000, -3_000_000_000, EPOCH_NS]))
    cloud = draw(lidars(start_ns).filter(lambda lidar: lidar.id not in {"imu", "gnss", "odometry"}))
    moving = draw(motion_sensors(start_ns))
    count = draw(st.integers(0, 3))
    path = CuboidPath(
        start_ns + np.arange(count, dtype=np.int64) * 7,
        draw(hnp.arrays(np.float64, (count, 9), elements=st.floats(-1e9, 1e9))),
    )
    attributes = (AttributePath(draw(NAMES), (draw(NUMBERS),), np.array([start_ns + 1])),)
    cuboid = CuboidAnnotation(
        draw(IDS), path, draw(st.none() | NAMES), draw(st.none() | st.booleans()), attributes=attributes
    )
    other = EventAnnotation("event", start_ns + 9, extras=draw(extras_beside("start", "duration", "sensor_id")))
    trajectory = Trajectory("truth", np.array([start_ns]), np.ones((1, 3)), None, np.array([0.1]))
    annotations = (cuboid,) if cuboid.id == "event" else (cuboid, other)
    return Scene(
        (cloud, *moving),
        annotations,
        trajectories={"truth": trajectory},
        metadata=draw(st.dictionaries(NAMES.filter(lambda name: name != "sceneloom"), JSON, max_size=2)),
        attributes=attributes,
    )


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    return tmp_path_factory.mktemp("sfs") / "scene.sfs"


@given(scenes())
def test_nanosecond_files_hold_every_scene_exactly(target, assert_same, scene):
    target.unlink(missing_ok=True)
    write_scene(scene, target, time_unit="nanoseconds")
    read = FORMAT.open(target)
    sensors = {(type(sensor.id), sensor.id): sensor for sensor in read.sensors}
    for sensor in scene.sensors:
        assert_same(sensors[type(sensor.id), sensor.id], sensor)
    assert_same(read.annotations, scene.annotations)
    assert_same(read.attributes, scene.attributes)
    assert_same(read.trajectories["truth"], scene.trajectories["truth"])
    ours = read.metadata.pop("sceneloom")
    assert_same(read.metadata, scene.metadata)
    assert (ours["euler_unit"], ours["euler_order"]) == ("degrees", "xyz")


@given(scenes())
def test_writing_what_was_read_gives_the_same_bytes(target, assert_same, scene):
    again = target.with_name("again.sfs")
    for path in (target, again):
        path.unlink(missing_ok=True)
    write_scene(scene, target)
    write_scene(FORMAT.open(target), again)
    first, second = FORMAT.open(target), FORMAT.open(again)
    assert_same(second.sensors, first.sensors)
    third = target.with_name("third.sfs")
    third.unlink(missing_ok=True)
    write_scene(second, third)
    assert third.read_bytes() == again.read_bytes()


NEAR_HALVES = st.builds(
    lambda timestamp, off: timestamp * 1000 + 500 + off, st.integers(-(2**40), 2**40), st.integers(-1, 1)
)


@given(
    st.integers(-(2**61), 2**61) | st.integers(-(2**51), 2**51) | NEAR_HALVES,
    st.sampled_from([1, 1000]),
    st.integers(-(10**9), 10**9),
)
def test_timestamps_are_the_nearest_and_of_two_nearest_the_even(timestamp_ns, tick_ns, offset):
    from fractions import Fraction

    clock = FileClock(tick_ns, offset * tick_ns)
    exact = Fraction(timestamp_ns, tick_ns) - offset
    assert clock.timestamp(timestamp_ns) == round(exact)
    timestamps, inexact = clock.timestamp_array(np.array([timestamp_ns]))
    assert (timestamps.tolist(), inexact) == ([round(exact)], int(exact.denominator != 1))
    assert clock.absolute_array(timestamps).tolist() == [clock.absolute_ns(round(exact))]


@given(st.integers(-(2**62), 2**62))
def test_the_chosen_offset_is_whole_seconds_and_leaves_a_small_start(first_ns):
    offset_ns = chosen_offset_ns(first_ns)
    assert offset_ns % 10**9 == 0
    assert 0 <= first_ns - offset_ns < 10**10
