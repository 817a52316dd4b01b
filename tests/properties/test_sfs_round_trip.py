"""Whatever the model can hold is the same after writing and reading, unknown fields included."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from tests.properties.strategies import IDS, JSON, NAMES, floats, optional, quaternions, timestamps

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.formats.sfs.clock import FileClock, chosen_offset_ns
from sceneloom.formats.sfs.schema import COEFFICIENT_COUNTS
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.scene.annotations import DIMENSIONS

START_NS = 1_700_000_000_000_000_000
NUMBERS = st.floats(-1e12, 1e12)
OF_SENSOR = st.sampled_from(["front", 7, "7"])
FLAGS = st.none() | st.booleans()
EXTRAS = st.dictionaries(NAMES.map(lambda name: f"x {name}"), JSON, max_size=2)
DURATIONS = st.integers(0, 2**40) | st.integers(0, 2**40).map(lambda n: n + 0.5)
STATED = {
    "label": st.none() | NAMES,
    "parent_id": st.none() | st.just("o"),
    "attributes": st.deferred(lambda: st.lists(attribute_paths(), max_size=2).map(tuple)),
    "extras": EXTRAS,
}
OF_OBJECT = {**STATED, "stationary": FLAGS}


def times(count):
    return timestamps(START_NS, START_NS + 10**9 - 1, count=count)


def numbers(*shape):
    return floats(*shape, within=1e12)


def extras_beside(*taken):
    known = "id type parent_id poses coordinates frames timestamp points path label stationary attributes activations "
    known += "projections images video intrinsics streams"
    return st.dictionaries(NAMES.filter(lambda name: name not in {*known.split(), *taken}), JSON, max_size=2)


@st.composite
def pose_paths(draw, start_ns):
    count = draw(st.integers(1, 4))
    steps = draw(st.lists(st.integers(1, 10**9), min_size=count, max_size=count))
    return sc.Poses(start_ns + np.cumsum(steps), draw(floats(count, 3, within=1e7)), draw(quaternions(count)))


@st.composite
def lidars(draw, start_ns):
    frames = []
    for number in range(draw(st.integers(0, 3))):
        count, start = draw(st.integers(0, 4)), start_ns + number * 10**8
        columns = hnp.arrays(np.uint8, count), hnp.arrays(np.uint8, (count, 3))
        columns += (hnp.arrays(np.int64, count, elements=st.integers(start, start + 10**8)),)
        columns += hnp.arrays(np.uint16, count), hnp.arrays(np.uint8, count)
        positions = floats(count, 3, within=9999, width=32)
        points = sc.LidarPoints(draw(positions), *(draw(optional(column)) for column in columns))
        times = points.timestamps_ns
        frames.append(sc.LidarFrame(start if times is None or count == 0 else int(times.min()), points))
    return sc.LidarSensor(
        draw(IDS),
        sc.LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]),
        draw(optional(pose_paths(start_ns))),
        coordinates=draw(st.sampled_from(sc.Coordinates)),
        points_frame=draw(st.sampled_from(sc.PointsFrame)),
        model=draw(optional(NAMES)),
        parent_id=draw(optional(IDS)),
        extras=draw(extras_beside()),
    )


@st.composite
def motion_sensors(draw, start_ns):
    count = draw(st.integers(0, 3))
    times = start_ns + np.arange(count, dtype=np.int64)
    anything = st.floats(width=64)
    seconds = draw(st.none() | hnp.arrays(np.float64, count, elements=anything))
    samples = sc.VectorSamples(times, draw(hnp.arrays(np.float64, (count, 3), elements=anything)), seconds)
    gnss = [draw(hnp.arrays(np.float64, shape, elements=anything)) for shape in ((count, 3), count, count)]
    return (
        sc.ImuSensor("imu", {draw(NAMES): samples}),
        sc.GnssSensor("gnss", times, *gnss, seconds),
        sc.OdometrySensor("odometry", draw(pose_paths(start_ns))),
    )


@st.composite
def scenes(draw):
    start_ns = draw(st.sampled_from([0, 5_000_000_000, -3_000_000_000, START_NS]))
    cloud = draw(lidars(start_ns).filter(lambda lidar: lidar.id not in {"imu", "gnss", "odometry"}))
    moving = draw(motion_sensors(start_ns))
    count = draw(st.integers(0, 3))
    path = sc.CuboidPath(start_ns + np.arange(count, dtype=np.int64) * 7, draw(floats(count, 9)))
    attributes = (sc.AttributePath(draw(NAMES), (draw(st.floats(-1e6, 1e6, width=32)),), np.array([start_ns + 1])),)
    cuboid = sc.CuboidAnnotation(draw(IDS), path, draw(optional(NAMES)), draw(FLAGS), attributes=attributes)
    other = sc.EventAnnotation("event", start_ns + 9, extras=draw(extras_beside("start", "duration", "sensor_id")))
    trajectory = sc.Trajectory("truth", np.array([start_ns]), np.ones((1, 3)), None, np.array([0.1]))
    annotations = (cuboid,) if cuboid.id == "event" else (cuboid, other)
    return sc.Scene(
        (cloud, *moving),
        annotations,
        trajectories={"truth": trajectory},
        metadata=draw(st.dictionaries(NAMES.filter(lambda name: name != "sceneloom"), JSON, max_size=2)),
        attributes=attributes,
    )


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    return tmp_path_factory.mktemp("sfs") / "scene.sfs"


def written(scene, target, **options):
    target.unlink(missing_ok=True)
    write_scene(scene, target, **options)
    return FORMAT.open(target)


def check_writing_again(scene, target, assert_same):
    """What is read and written again twice gives the same sensors and bytes."""
    again, third = target.with_name("again.sfs"), target.with_name("third.sfs")
    first = written(scene, target)
    second = written(first, again)
    written(second, third)
    assert third.read_bytes() == again.read_bytes()
    assert_same(second.sensors, first.sensors)


@given(scenes())
def test_nanosecond_files_hold_every_scene_exactly_and_writing_what_was_read_gives_the_same_bytes(
    target, assert_same, scene
):
    read = written(scene, target, time_unit="nanoseconds")
    sensors = {(type(sensor.id), sensor.id): sensor for sensor in read.sensors}
    for sensor in scene.sensors:
        assert_same(sensors[type(sensor.id), sensor.id], sensor)
    assert_same(read.annotations, scene.annotations)
    assert_same(read.attributes, scene.attributes)
    assert_same(read.trajectories["truth"], scene.trajectories["truth"])
    ours = read.metadata.pop("sceneloom")
    assert_same(read.metadata, scene.metadata)
    assert (ours["euler_unit"], ours["euler_order"]) == ("degrees", "xyz")
    check_writing_again(scene, target, assert_same)


NEAR_HALVES = st.builds(
    lambda timestamp, off: timestamp * 1000 + 500 + off, st.integers(-(2**40), 2**40), st.integers(-1, 1)
)


@given(
    st.integers(-(2**61), 2**61) | st.integers(-(2**51), 2**51) | NEAR_HALVES,
    st.sampled_from([1, 1000]),
    st.integers(-(10**9), 10**9),
)
def test_timestamps_are_the_nearest_and_of_two_nearest_the_even_and_offsets_whole_seconds(
    timestamp_ns, tick_ns, offset
):
    clock = FileClock(tick_ns, offset * tick_ns)
    exact = Fraction(timestamp_ns, tick_ns) - offset
    assert clock.timestamp(timestamp_ns) == round(exact)
    timestamps, inexact = clock.timestamp_array(np.array([timestamp_ns]))
    assert (timestamps.tolist(), inexact) == ([round(exact)], int(exact.denominator != 1))
    assert clock.absolute_array(timestamps).tolist() == [clock.absolute_ns(round(exact))]
    offset_ns = chosen_offset_ns(timestamp_ns)
    assert offset_ns % 10**9 == 0
    assert 0 <= timestamp_ns - offset_ns < 10**10


@st.composite
def with_nothing(draw, count, columns):
    rows = draw(numbers(count, columns))
    rows[draw(hnp.arrays(np.bool_, count))] = np.nan
    return rows


@st.composite
def attribute_paths(draw):
    one = NAMES | st.integers(-(2**63), 2**63 - 1) | NUMBERS | st.none() | st.booleans() | st.just(["mixed", 1])
    values = draw(
        st.lists(one | st.lists(NAMES, max_size=2).map(tuple) | st.dictionaries(NAMES, JSON, max_size=1), max_size=3)
    )
    static = draw(FLAGS)
    return sc.AttributePath(
        draw(NAMES),
        tuple(values),
        draw(optional(times(draw(st.integers(0, 3)) if static else len(values)))),
        sensor_id=draw(optional(OF_SENSOR)),
        static=static,
        point_index=draw(optional(st.integers(0, 5))),
        extras=draw(EXTRAS),
    )


@st.composite
def activations(draw):
    count = draw(st.integers(0, 3))
    return sc.Activation(
        draw(OF_SENSOR),
        draw(times(count)),
        durations_ns=draw(optional(st.tuples(*[DURATIONS] * count))),
        cuboids=draw(optional(with_nothing(count, 9))),
        extras=draw(EXTRAS),
    )


def seen(kind, columns):
    """Projections of a kind, whose arrays have so many columns."""

    @st.composite
    def build(draw):
        count = draw(st.integers(0, 3))
        arrays = {name: draw(optional(with_nothing(count, width))) for name, width in columns.items()}
        confirmed = draw(optional(st.tuples(*[FLAGS] * count)))
        return kind(draw(OF_SENSOR), draw(times(count)), confirmed=confirmed, extras=draw(EXTRAS), **arrays)

    return build()


@st.composite
def row_paths(draw, kind, columns):
    count = draw(st.integers(0, 3))
    return kind(draw(times(count)), draw(numbers(count, columns)), extras=draw(EXTRAS))


@st.composite
def shapes(draw, identifier):
    kind = draw(st.sampled_from(sc.ShapeType))
    dimensions, count = DIMENSIONS[kind], draw(st.integers(0, 3))
    vertices = tuple(draw(numbers(draw(st.integers(0, 3)), dimensions)) for _ in range(count))
    return sc.ShapeAnnotation(
        identifier,
        kind,
        sc.VertexPath(draw(times(count)), vertices, draw(EXTRAS)),
        draw(OF_SENSOR if dimensions == 2 else optional(OF_SENSOR)),
        draw(FLAGS) if kind is sc.ShapeType.POLYLINE else None,
        **{name: draw(strategy) for name, strategy in OF_OBJECT.items()},
    )


@st.composite
def keypoints(draw, identifier):
    paths = []
    for number in range(draw(st.integers(0, 2))):
        count = draw(st.integers(0, 3))
        columns = draw(st.sampled_from([3, 3, 9])) if count else 3
        values = draw(numbers(count, columns))
        paths.append(sc.PointPath(draw(times(count)), values, draw(st.sampled_from([None, number])), draw(EXTRAS)))
    projections = st.lists(seen(sc.PointProjection, {"points": 2, "positions": 3}), max_size=2).map(tuple)
    stated = {name: draw(strategy) for name, strategy in OF_OBJECT.items() if name != "label"}
    return sc.PointsAnnotation(
        identifier,
        tuple(paths),
        labels=draw(optional(st.tuples(*[NAMES] * len(paths)))),
        projections=draw(st.lists(projections, max_size=2).map(tuple)),
        sensor_id=draw(optional(OF_SENSOR)),
        **stated,
    )


@st.composite
def corrections(draw):
    """Poses of corrections; a single one holds at all times."""
    count = draw(st.integers(1, 3))
    return sc.Poses(draw(times(count)), draw(numbers(count, 3)), draw(quaternions(count)), static=count == 1)


@st.composite
def camera_models(draw):
    name = draw(st.sampled_from(["pinhole", "from-the-future", *COEFFICIENT_COUNTS]))
    count = COEFFICIENT_COUNTS.get(name, 0 if name == "pinhole" else 3)
    focal, centre = st.floats(0.5, 1e4), st.floats(-1e4, 1e4)
    coefficients = tuple(draw(numbers(count)).tolist())
    sizes = draw(st.integers(1, 5000)), draw(st.integers(1, 5000))
    return Camera(name, *sizes, draw(focal), draw(focal), draw(centre), draw(centre), coefficients)


@st.composite
def corrections_extras(draw, poses):
    unknown = draw(EXTRAS)
    return {**draw(EXTRAS), **({"poses": unknown} if unknown and poses is not None else {})}


@st.composite
def calibrations(draw, identifier):
    poses = draw(optional(corrections()))
    return sc.CameraCalibration(
        identifier,
        draw(OF_SENSOR),
        poses=poses,
        intrinsics=draw(optional(camera_models())),
        time_offset_ns=draw(optional(DURATIONS)),
        parent_id=draw(STATED["parent_id"]),
        extras=draw(corrections_extras(poses)),
    )


@st.composite
def adjustments(draw, identifier):
    poses = draw(corrections())
    stated = draw(STATED["parent_id"]), draw(corrections_extras(poses))
    return sc.LocalizationAdjustment(identifier, poses, *stated)


@st.composite
def labelled_points(draw, identifier):
    ids = hnp.arrays(np.uint32, st.integers(0, 3))
    frames = optional(st.integers(0, 10))
    parts = draw(st.lists(st.builds(sc.LabeledPoints, OF_SENSOR, ids, frames, EXTRAS), max_size=2))
    return sc.LabeledPointsAnnotation(
        identifier,
        tuple(parts),
        is_instance=draw(FLAGS),
        type=draw(st.sampled_from(["labeled_points", "point_segmentation"])),
        **{name: draw(strategy) for name, strategy in STATED.items()},
    )


def of_one(identifier):
    one, sensors, start = st.just(identifier), optional(OF_SENSOR), st.integers(START_NS, START_NS + 10**9 - 1)
    seen_by = {"activations": activations(), "projections": seen(sc.Projection, {"boxes": 4, "cuboids": 9})}
    seen_by = {name: st.lists(each, max_size=2).map(tuple) for name, each in seen_by.items()}
    return st.one_of(
        st.builds(sc.CuboidAnnotation, one, row_paths(sc.CuboidPath, 9), **OF_OBJECT | seen_by),
        st.builds(sc.Box2DAnnotation, one, OF_SENSOR, row_paths(sc.BoxPath, 4), **OF_OBJECT),
        shapes(identifier),
        keypoints(identifier),
        st.builds(sc.EventAnnotation, one, start, duration_ns=optional(DURATIONS), sensor_id=sensors, **STATED),
        labelled_points(identifier),
        adjustments(identifier),
        calibrations(identifier),
        st.builds(sc.ObjectAnnotation, one, type=st.sampled_from(["object", "attributes"]), **STATED),
        st.builds(sc.GroupAnnotation, one, **STATED),
        st.builds(sc.LinkAnnotation, one, IDS, IDS, is_bidirectional=FLAGS, sensor_id=sensors, **STATED),
        st.builds(sc.PlainAnnotation, one, NAMES.map(lambda name: f"x {name}"), EXTRAS),
    )


@st.composite
def annotated_scenes(draw):
    ids = draw(st.lists(IDS, max_size=4, unique_by=lambda i: (type(i), i)))
    annotations = tuple(draw(of_one(identifier)) for identifier in ids)
    return sc.Scene((), annotations, attributes=tuple(draw(st.lists(attribute_paths(), max_size=2))))


@given(annotated_scenes())
def test_annotations_of_every_type_come_back_as_they_were_and_give_the_same_bytes_again(target, assert_same, scene):
    read = written(scene, target, time_unit="nanoseconds", time_offset_ns=START_NS)
    assert_same(read.annotations, scene.annotations)
    assert_same(read.attributes, scene.attributes)
    check_writing_again(scene, target, assert_same)


def as_scale_holds(annotation):
    """Its library loads no camera model that it does not know; such a one becomes a pinhole, as is reported."""
    camera_model = getattr(annotation, "intrinsics", None)
    if camera_model is None or camera_model.model == "pinhole" or camera_model.model in COEFFICIENT_COUNTS:
        return annotation
    return replace(annotation, intrinsics=replace(camera_model, model="pinhole", coefficients=()))


@given(annotated_scenes())
def test_the_profile_of_scale_loses_no_annotation(target, assert_same, scene):
    """What its library cannot load stands aside, in another order; times become whole microseconds."""
    in_microseconds = written(scene, target, time_offset_ns=START_NS)
    read = written(in_microseconds, target.with_name("scale.sfs"), profile="scale")
    found = {(type(annotation.id), annotation.id): annotation for annotation in read.annotations}
    expected = {(type(one.id), one.id): as_scale_holds(one) for one in in_microseconds.annotations}
    assert_same(found, expected)
    assert len(read.attributes) == len(scene.attributes)
