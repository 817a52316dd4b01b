"""Every annotation that the model can hold is the same after writing and reading, unknown fields included."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sceneloom.cameras.camera import Camera
from sceneloom.formats.sfs.schema import COEFFICIENT_COUNTS
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.scene import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PlainAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Poses,
    Projection,
    Scene,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
from sceneloom.scene.annotations import DIMENSIONS

START_NS = 1_700_000_000_000_000_000
NUMBERS = st.floats(-1e12, 1e12)
NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
IDS = st.integers(-(2**53), 2**53) | NAMES
OF_SENSOR = st.sampled_from(["front", 7, "7"])
FLAGS = st.none() | st.booleans()
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | NUMBERS | NAMES,
    lambda children: st.lists(children, max_size=2) | st.dictionaries(NAMES, children, max_size=2),
    max_leaves=5,
)
EXTRAS = st.dictionaries(NAMES.map(lambda name: f"x {name}"), JSON, max_size=2)
DURATIONS = st.integers(0, 2**40) | st.integers(0, 2**40).map(lambda n: n + 0.5)
STATED = {
    "label": st.none() | NAMES,
    "parent_id": st.none() | st.just("o"),
    "attributes": st.deferred(lambda: st.lists(attribute_paths(), max_size=2).map(tuple)),
    "extras": EXTRAS,
}
OF_OBJECT = {**STATED, "stationary": FLAGS}


def optional(strategy):
    return st.none() | strategy


def timestamps(count):
    within = st.integers(START_NS, START_NS + 10**9 - 1)
    return st.lists(within, min_size=count, max_size=count, unique=True).map(
        lambda times: np.array(sorted(times), np.int64)
    )


def numbers(*shape):
    return hnp.arrays(np.float64, shape, elements=NUMBERS)


@st.composite
def with_nothing(draw, count, columns):
    """Rows of numbers, some of them NaN for none."""
    rows = draw(numbers(count, columns))
    rows[draw(hnp.arrays(np.bool_, count))] = np.nan
    return rows


@st.composite
def attribute_paths(draw):
    values = draw(
        st.lists(
            NAMES
            | st.integers(-(2**63), 2**63 - 1)
            | NUMBERS
            | st.lists(NAMES, max_size=2).map(tuple)
            | st.none()
            | st.booleans()
            | st.dictionaries(NAMES, JSON, max_size=1)
            | st.just(["mixed", 1]),
            max_size=3,
        )
    )
    static = draw(FLAGS)
    count = draw(st.integers(0, 3)) if static else len(values)
    times = draw(optional(timestamps(count)))
    return AttributePath(
        draw(NAMES),
        tuple(values),
        times,
        sensor_id=draw(optional(OF_SENSOR)),
        static=static,
        point_index=draw(optional(st.integers(0, 5))),
        extras=draw(EXTRAS),
    )


@st.composite
def activations(draw):
    count = draw(st.integers(0, 3))
    return Activation(
        draw(OF_SENSOR),
        draw(timestamps(count)),
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
        return kind(draw(OF_SENSOR), draw(timestamps(count)), confirmed=confirmed, extras=draw(EXTRAS), **arrays)

    return build()


@st.composite
def row_paths(draw, kind, columns):
    count = draw(st.integers(0, 3))
    return kind(draw(timestamps(count)), draw(numbers(count, columns)), extras=draw(EXTRAS))


@st.composite
def shapes(draw, identifier):
    kind = draw(st.sampled_from(ShapeType))
    dimensions, count = DIMENSIONS[kind], draw(st.integers(0, 3))
    vertices = tuple(draw(numbers(draw(st.integers(0, 3)), dimensions)) for _ in range(count))
    return ShapeAnnotation(
        identifier,
        kind,
        VertexPath(draw(timestamps(count)), vertices, draw(EXTRAS)),
        draw(OF_SENSOR if dimensions == 2 else optional(OF_SENSOR)),
        draw(FLAGS) if kind is ShapeType.POLYLINE else None,
        **{name: draw(strategy) for name, strategy in OF_OBJECT.items()},
    )


@st.composite
def keypoints(draw, identifier):
    paths = []
    for number in range(draw(st.integers(0, 2))):
        count = draw(st.integers(0, 3))
        columns = draw(st.sampled_from([3, 3, 9])) if count else 3
        values = draw(numbers(count, columns))
        paths.append(PointPath(draw(timestamps(count)), values, draw(st.sampled_from([None, number])), draw(EXTRAS)))
    projections = st.lists(seen(PointProjection, {"points": 2, "positions": 3}), max_size=2).map(tuple)
    stated = {name: draw(strategy) for name, strategy in OF_OBJECT.items() if name != "label"}
    return PointsAnnotation(
        identifier,
        tuple(paths),
        labels=draw(optional(st.tuples(*[NAMES] * len(paths)))),
        projections=draw(st.lists(projections, max_size=2).map(tuple)),
        sensor_id=draw(optional(OF_SENSOR)),
        **stated,
    )


@st.composite
def pose_paths(draw):
    """Poses of corrections; a single one holds at all times."""
    count = draw(st.integers(1, 3))
    quaternions = draw(hnp.arrays(np.float64, (count, 4), elements=st.floats(0.1, 1.0)))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Poses(draw(timestamps(count)), draw(numbers(count, 3)), quaternions, static=count == 1)


@st.composite
def camera_models(draw):
    model = draw(st.sampled_from(["pinhole", "from-the-future", *COEFFICIENT_COUNTS]))
    count = COEFFICIENT_COUNTS.get(model, 0 if model == "pinhole" else 3)
    focal, centre = st.floats(0.5, 1e4), st.floats(-1e4, 1e4)
    coefficients = tuple(draw(numbers(count)).tolist())
    sizes = draw(st.integers(1, 5000)), draw(st.integers(1, 5000))
    return Camera(model, *sizes, draw(focal), draw(focal), draw(centre), draw(centre), coefficients)


@st.composite
def corrections_extras(draw, poses):
    """Unknown fields of a correction and of its poses."""
    unknown = draw(EXTRAS)
    return {**draw(EXTRAS), **({"poses": unknown} if unknown and poses is not None else {})}


@st.composite
def calibrations(draw, identifier):
    poses = draw(optional(pose_paths()))
    return CameraCalibration(
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
    poses = draw(pose_paths())
    parent = draw(STATED["parent_id"])
    return LocalizationAdjustment(identifier, poses, parent, extras=draw(corrections_extras(poses)))


@st.composite
def labelled_points(draw, identifier):
    ids = hnp.arrays(np.uint32, st.integers(0, 3))
    frames = optional(st.integers(0, 10))
    parts = draw(st.lists(st.builds(LabeledPoints, OF_SENSOR, ids, frames, EXTRAS), max_size=2))
    return LabeledPointsAnnotation(
        identifier,
        tuple(parts),
        is_instance=draw(FLAGS),
        type=draw(st.sampled_from(["labeled_points", "point_segmentation"])),
        **{name: draw(strategy) for name, strategy in STATED.items()},
    )


def of_one(identifier):
    """Annotations of any type with an id."""
    one, sensors = st.just(identifier), optional(OF_SENSOR)
    projections = st.lists(seen(Projection, {"boxes": 4, "cuboids": 9}), max_size=2).map(tuple)
    return st.one_of(
        st.builds(
            CuboidAnnotation,
            one,
            row_paths(CuboidPath, 9),
            activations=st.lists(activations(), max_size=2).map(tuple),
            projections=projections,
            **OF_OBJECT,
        ),
        st.builds(Box2DAnnotation, one, OF_SENSOR, row_paths(BoxPath, 4), **OF_OBJECT),
        shapes(identifier),
        keypoints(identifier),
        st.builds(
            EventAnnotation,
            one,
            st.integers(START_NS, START_NS + 10**9 - 1),
            duration_ns=optional(DURATIONS),
            sensor_id=sensors,
            **STATED,
        ),
        labelled_points(identifier),
        adjustments(identifier),
        calibrations(identifier),
        st.builds(ObjectAnnotation, one, type=st.sampled_from(["object", "attributes"]), **STATED),
        st.builds(GroupAnnotation, one, **STATED),
        st.builds(LinkAnnotation, one, IDS, IDS, is_bidirectional=FLAGS, sensor_id=sensors, **STATED),
        st.builds(PlainAnnotation, one, NAMES.map(lambda name: f"x {name}"), EXTRAS),
    )


@st.composite
def scenes(draw):
    ids = draw(st.lists(IDS, max_size=4, unique_by=lambda i: (type(i), i)))
    annotations = tuple(draw(of_one(identifier)) for identifier in ids)
    return Scene((), annotations, attributes=tuple(draw(st.lists(attribute_paths(), max_size=2))))


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    return tmp_path_factory.mktemp("sfs") / "scene.sfs"


def written(scene, target, **options):
    target.unlink(missing_ok=True)
    write_scene(scene, target, **options)
    return FORMAT.open(target)


@given(scenes())
def test_annotations_of_every_type_come_back_as_they_were(target, assert_same, scene):
    read = written(scene, target, time_unit="nanoseconds", time_offset_ns=START_NS)
    assert_same(read.annotations, scene.annotations)
    assert_same(read.attributes, scene.attributes)


@given(scenes())
def test_what_is_read_gives_the_same_bytes_when_it_is_written_again(target, scene):
    again = target.with_name("again.sfs")
    third = target.with_name("third.sfs")
    second = written(written(scene, target), again)
    written(second, third)
    assert third.read_bytes() == again.read_bytes()


def everything(annotations):
    return {(type(annotation.id), annotation.id): annotation for annotation in annotations}


def as_scale_holds(annotation):
    """Its library loads no camera model of a model that it does not know; such a one becomes a pinhole.

    As the report reports.
    """
    camera_model = getattr(annotation, "intrinsics", None)
    if camera_model is None or camera_model.model == "pinhole" or camera_model.model in COEFFICIENT_COUNTS:
        return annotation
    return replace(annotation, intrinsics=replace(camera_model, model="pinhole", coefficients=()))


@given(scenes())
def test_the_profile_of_scale_loses_no_annotation(target, assert_same, scene):
    """What its library cannot load stands aside, in another order; times become whole microseconds."""
    in_microseconds = written(scene, target, time_offset_ns=START_NS)
    read = written(in_microseconds, target.with_name("scale.sfs"), profile="scale")
    expected = {key: as_scale_holds(a) for key, a in everything(in_microseconds.annotations).items()}
    assert_same(everything(read.annotations), expected)
    assert len(read.attributes) == len(scene.attributes)
