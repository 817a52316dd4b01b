"""OpenLABEL documents as the schema of version 1.0.0 allows them: they come back as they were."""

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from tests.properties.strategies import JSON, optional

from sceneloom.formats.base.registry import open_scene, write_scene

TEXTS = st.text("abc DE_-0é/", max_size=5)
NUMBERS = st.floats(-1e4, 1e4, allow_subnormal=False) | st.integers(-10_000, 10_000)
SIZES = st.floats(0.01, 100.0)
SYSTEMS = ("map", "vehicle", "CAM", "LIDAR", "spare")
UIDS = st.integers(-3, 12).map(str) | st.uuids(version=4).map(str)
KEPT = {"1": 1, "custom": [None, {"a": True}], "": "x"}


def record(required, **further):
    """JSON objects with some members always and others sometimes, and with members that nobody knows."""
    always, sometimes = st.fixed_dictionaries(required), st.fixed_dictionaries({}, optional=further)
    return st.builds(lambda a, b, c: {**c, **b, **a}, always, sometimes, st.sampled_from([{}, {}, KEPT]))


def exactly(required, **further):
    return st.fixed_dictionaries(required, optional=further)


def numbers(count, elements=NUMBERS):
    return st.lists(elements, min_size=count, max_size=count)


def joined(parts):
    return [value for part in parts for value in part]


def unit(count):
    """Quaternions."""
    parts = numbers(count, st.floats(-1, 1)).filter(lambda found: np.linalg.norm(found) > 0.1)
    return parts.map(lambda found: (np.array(found) / np.linalg.norm(found)).tolist())


def matrix(parts):
    (x, y, z, w), moved = parts
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), moved[0]],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), moved[1]],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), moved[2]],
        [0.0, 0.0, 0.0, 1.0],
    ]
    return {"matrix4x4": [value for row in rows for value in row]}


ANGLES = numbers(3, st.floats(-3, 3))
POSES = (
    st.tuples(unit(4), numbers(3)).map(matrix)
    | exactly({"quaternion": unit(4), "translation": numbers(3)})
    | exactly(
        {"euler_angles": ANGLES, "translation": numbers(3)}, sequence=st.sampled_from(["ZYX", "XYZ", "ZXZ", "yxz"])
    )
)
PLAIN = {
    "text": (TEXTS, st.just("value")),
    "num": (NUMBERS, st.sampled_from(["value", "min", "max"])),
    "boolean": (st.booleans(), st.just("value")),
    "vec": (st.lists(NUMBERS | TEXTS, max_size=3), st.sampled_from(["values", "range"])),
}


def plain(kind, **further):
    value, types = PLAIN[kind]
    return record({"name": TEXTS, "val": value}, type=types, **further)


def listed(element, most=2):
    return st.lists(element, min_size=1, max_size=most, unique_by=lambda one: one["name"])


ATTRIBUTES = exactly({}, **{kind: listed(plain(kind)) for kind in PLAIN})


def located(**values):
    return record({"name": TEXTS, **values}, coordinate_system=st.sampled_from(SYSTEMS), attributes=ATTRIBUTES)


PIXELS = st.integers(-50, 500).map(str)
CODES = st.text("ABCIJwx9+/", max_size=6)
PADDED = CODES.flatmap(lambda codes: st.tuples(st.integers(0, min(1, len(codes))).map(str), st.just(codes)))
SHORT = st.tuples(PIXELS, PIXELS, PADDED).map(lambda found: [found[0], found[1], *found[2]])
RUNS = st.sampled_from([("-1", "-1"), ("2", "5"), ("7", "-1")])
LONG = st.tuples(PIXELS, PIXELS, RUNS, PADDED).map(lambda found: [found[0], found[1], *found[2], *found[3]])
PAIRS = st.integers(1, 4).flatmap(lambda count: numbers(2 * count))
TRIPLES = st.integers(1, 4).flatmap(lambda count: numbers(3 * count))
HIERARCHY = numbers(4, st.integers(-1, 5))
POLYGONS = st.sampled_from([
    ("MODE_POLY2D_ABSOLUTE", PAIRS), ("MODE_POLY2D_RELATIVE", PAIRS), ("MODE_POLY2D_SRF6DCC", SHORT),
    ("MODE_POLY2D_RS6FCC", LONG), ("MODE_POLY2D_OF_SOMEBODY", st.lists(TEXTS, max_size=2)),
]).flatmap(
    lambda found: located(val=found[1], mode=st.just(found[0]), closed=st.booleans(), hierarchy=HIERARCHY)
)  # fmt: skip
CUBOIDS = st.tuples(numbers(3), ANGLES | unit(4), numbers(3, SIZES)).map(joined) | st.none()
FLAT = st.tuples(numbers(2), numbers(2, SIZES)).map(joined)
SHAPES = {
    "cuboid": located(val=CUBOIDS),
    "bbox": located(val=FLAT),
    "rbbox": located(val=st.tuples(FLAT, numbers(1, st.floats(-3, 3))).map(joined)),
    "poly2d": POLYGONS,
    "poly3d": located(val=TRIPLES, closed=st.booleans()),
    "point2d": located(val=numbers(2)),
    "point3d": located(val=numbers(3), id=st.integers(0, 9)),
}
SIDE = st.integers(1, 3)
WHOLE = {
    "mat": located(
        val=numbers(2), width=SIDE, height=SIDE, channels=SIDE, data_type=st.sampled_from(["float", "uint8"])
    ),
    "image": located(val=TEXTS, mime_type=st.just("image/png"), encoding=st.just("base64")),
    "binary": located(val=TEXTS, encoding=st.just("rle"), data_type=st.just("")),
    "mesh": exactly({"name": TEXTS, "point3d": exactly({"0": located(val=numbers(3))})}),
    "line_reference": exactly({"name": TEXTS, "reference_type": st.just("point3d"), "val": numbers(2, SIDE)}),
    "area_reference": exactly({"name": TEXTS, "val": numbers(3, SIDE)}),
}
VALUES = {kind: listed(plain(kind, attributes=ATTRIBUTES)) for kind in PLAIN}
OBJECT_DATA = exactly({}, **VALUES, **{kind: listed(one) for kind, one in (SHAPES | WHOLE).items()})
OTHER_DATA = exactly({}, **VALUES)
DATA = {"object": OBJECT_DATA, "action": OTHER_DATA, "event": OTHER_DATA, "context": OTHER_DATA}

PINHOLE = st.tuples(SIZES, SIZES, numbers(3)).map(
    lambda found: [found[0], 0.0, 32.0, found[2][0], 0.0, found[1], 24.0, found[2][1], 0.0, 0.0, 1.0, found[2][2]]
)
SMALL = st.floats(-0.01, 0.01)
DISTORTION = st.just([]) | st.integers(5, 14).flatmap(lambda count: numbers(count, SMALL))
SIZE = {"width_px": st.just(64), "height_px": st.just(48)}
FISHEYE = dict.fromkeys(("center_x", "center_y", "focal_length_x", "focal_length_y"), SIZES)
PROPERTIES = st.one_of(
    record({}),
    record({"intrinsics_pinhole": record({**SIZE, "camera_matrix_3x4": PINHOLE}, distortion_coeffs_1xN=DISTORTION)}),
    record({"intrinsics_pinhole": record({**SIZE, "camera_matrix": PINHOLE, "distortion_coeffs": DISTORTION})}),
    record({"intrinsics_fisheye": record({**SIZE, **FISHEYE, "lens_coeffs_1xN": numbers(4, SMALL)})}),
    record({"intrinsics_fisheye": record(SIZE, center_x_px=NUMBERS, lens_coeffs=numbers(4))}),
    record({"intrinsics_custom": st.dictionaries(TEXTS, JSON, max_size=2)}),
    record({"intrinsics_cylindrical": record(SIZE, fov_horz_rad=SIZES)}),
    record({"sync": exactly({"frame_shift": st.integers(-3, 3)})}),
)
STREAM = exactly(
    {}, type=st.sampled_from(["camera", "lidar", "radar", "gps_imu", "other"]), uri=TEXTS, description=TEXTS,
    stream_properties=PROPERTIES,
)  # fmt: skip


@st.composite
def documents(draw):
    """Documents that the schema accepts, and whose references lead somewhere."""
    found = {"metadata": {**draw(record({})), "schema_version": "1.0.0"}}
    if draw(st.booleans()):
        found["coordinate_systems"] = systems = {}
        for name, parent in (("map", ""), ("vehicle", "map"), ("CAM", "vehicle"), ("LIDAR", "vehicle")):
            system = {"type": "sensor_cs", "parent": parent, "children": []}
            pose = draw(optional(POSES))
            systems[name] = system if pose is None else {**system, "pose_wrt_parent": pose}
    if draw(st.booleans()):
        found["streams"] = draw(st.dictionaries(st.sampled_from(["CAM", "LIDAR", "other"]), STREAM, max_size=3))
    numbers_of_frames = draw(st.lists(st.integers(0, 300), unique=True, max_size=4))
    clock = draw(st.sampled_from([None, 0.0, 1.7e9]))
    frames = {}
    for number in numbers_of_frames:
        frames[str(number)] = frame = draw(st.sampled_from([{}, {"frame_properties": {"odd": [1]}}]))
        properties = dict(frame.get("frame_properties", {}))
        if clock is not None:
            time = clock + number / 8
            properties["timestamp"] = draw(st.sampled_from([time, f"{time:.4f}"]))
        if draw(st.booleans()):
            pose = draw(record({"src": st.just("vehicle"), "dst": st.just("map"), "transform_src_to_dst": POSES}))
            properties["transforms"] = {"vehicle_to_map": pose}
        if draw(st.booleans()):
            properties["streams"] = {"CAM": draw(STREAM)}
        frames[str(number)] = {"frame_properties": properties} if properties else {}
    elements = []
    interval = exactly({"frame_start": st.integers(0, 9), "frame_end": st.integers(9, 20)})
    for kind, data in DATA.items():
        for uid in draw(st.lists(UIDS, unique=True, max_size=2)):
            head = draw(exactly(
                {"name": TEXTS, "type": TEXTS}, ontology_uid=st.just("0"), resource_uid=st.just({"0": "1"}),
                frame_intervals=st.lists(interval, max_size=2), **{f"{kind}_data": data},
                **({"coordinate_system": st.sampled_from(SYSTEMS)} if kind == "object" else {}),
                **{f"{kind}_data_pointers": st.just({"x": {"type": "num", "frame_intervals": []}})},
            ))  # fmt: skip
            found.setdefault(f"{kind}s", {})[uid] = head
            elements.append({"type": kind, "uid": uid})
            for frame in frames.values():
                if draw(st.booleans()):
                    stated = draw(exactly({}, **{f"{kind}_data": data}))
                    frame.setdefault(f"{kind}s", {})[uid] = stated
    if elements and draw(st.booleans()):
        ends = st.lists(st.sampled_from(elements), max_size=2, unique_by=str)
        relation = exactly(
            {"name": TEXTS, "type": TEXTS, "rdf_subjects": ends, "rdf_objects": ends},
            frame_intervals=st.lists(interval, max_size=1),
        )
        found["relations"] = draw(st.dictionaries(UIDS, relation, max_size=2))
        for frame in frames.values():
            frame["relations"] = {uid: {} for uid in found["relations"]}
    found |= {"frames": frames} if frames or draw(st.booleans()) else {}
    if draw(st.booleans()):
        found |= {
            "ontologies": {"0": "http://a.b", "1": {"uri": "x", "boundary_list": ["a"], "boundary_mode": "include"}},
            "resources": {"0": "map.xodr"},
            "tags": {"0": {"type": "x", "ontology_uid": "0", "tag_data": draw(OTHER_DATA)}},
            "frame_intervals": [{"frame_start": 0, "frame_end": 3}],
        }
    return {"openlabel": found}


def read(folder, content):
    path = Path(folder, "read.json")
    path.write_text(json.dumps(content), "utf-8")
    return open_scene(path)


def written(folder, scene):
    write_scene(scene, Path(folder, "written.json"), overwrite=True)
    return json.loads(Path(folder, "written.json").read_text("utf-8"))


SETTINGS = settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


@SETTINGS
@given(documents())
def test_a_document_comes_back_with_all_that_it_states(content):
    with tempfile.TemporaryDirectory() as folder:
        assert written(folder, read(folder, content)) == content


@SETTINGS
@given(documents(), st.randoms(use_true_random=False))
def test_without_one_annotation_all_other_elements_come_back_as_they_were(content, random):
    with tempfile.TemporaryDirectory() as folder:
        scene = read(folder, content)
        links = {one.id for one in scene.annotations if one.type == "link"}
        others = [one for one in scene.annotations if one.id not in links]
        if not others:
            return
        gone = random.choice(others)
        left = tuple(one for one in scene.annotations if one is not gone and one.id not in links)
        report = write_scene(replace(scene, annotations=left), Path(folder, "written.json"))
        if any(loss.field == "metadata.openlabel.document" for loss in report.losses):
            event("what only the document states cannot be kept")
            return
        again = json.loads(Path(folder, "written.json").read_text("utf-8"))["openlabel"]
        stated = content["openlabel"]
        for kind in DATA:
            for uid, head in stated.get(f"{kind}s", {}).items():
                if uid in str(gone.id):
                    continue
                assert again[f"{kind}s"][uid] == head
                for number, frame in stated.get("frames", {}).items():
                    here = frame.get(f"{kind}s", {})
                    there = again["frames"][number].get(f"{kind}s", {})
                    assert (uid in here, here.get(uid)) == (uid in there, there.get(uid))
        for name in ("coordinate_systems", "streams", "ontologies", "resources", "tags", "frame_intervals"):
            assert again.get(name) == stated.get(name)


@SETTINGS
@given(documents())
def test_written_anew_a_document_states_the_same_locations_labels_and_links(content):
    with tempfile.TemporaryDirectory() as folder:
        scene = read(folder, content)
        anew = replace(scene, metadata={**scene.metadata, "openlabel": {}})
        again = read(folder, written(folder, anew))
        found = {one.id: one for one in again.annotations}
        assert sorted(map(str, found)) == sorted(str(one.id) for one in scene.annotations)
        for one in scene.annotations:
            other = found[one.id]
            assert (type(other), getattr(other, "label", 0)) == (type(one), getattr(one, "label", 0))
            if hasattr(one, "path"):
                assert other.path.timestamps_ns.tolist() == one.path.timestamps_ns.tolist()
                for values, expected in zip(rows_of(other), rows_of(one), strict=True):
                    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-6)
            if one.type == "link":
                assert (other.from_id, other.to_id) == (one.from_id, one.to_id)


def rows_of(annotation):
    """Locations without angles, which are not unique."""
    path = annotation.path
    return path.vertices if hasattr(path, "vertices") else [path.values[:, :6]]
