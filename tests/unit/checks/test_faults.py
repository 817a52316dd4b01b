"""Rules about what cannot be read, missing and misspelt fields, and clauses of the description that files break."""

import io
from functools import cache

import av
import numpy as np
import pytest

import sceneloom
from sceneloom.checks import validate
from sceneloom.checks.faults import FAULT_RULES
from sceneloom.errors import DataError
from sceneloom.formats.sfs.reader import copied, parse_path
from sceneloom.scene import DataWarning, LazyFrames, LidarSensor, WarningKind

POSE = [0, 0, 0, 0, 0, 0, 1]
POSES = {"timestamps": [0, 10**6], "values": [POSE, [9, 0, 0, 0, 0, 0, 1]]}
CAMERA_MODEL = {"fx": 9, "fy": 9, "cx": 4, "cy": 3, "width": 8, "height": 6}
ATTRIBUTE = {"name": "colour", "timestamps": [0], "values": ["red"]}
ACTIVE = {"sensor_id": "top", "timestamps": [0], "durations": [5]}


def lidar(**fields):
    frames = [{"timestamp": 0, "points": {"positions": np.ones((4, 3), np.float32)}}]
    return {"id": "top", "type": "lidar", "poses": POSES, "frames": frames, **fields}


def timed_lidar(dtype):
    """A lidar whose points have times, 1000 ticks apart."""
    sensor = lidar()
    sensor["frames"][0]["points"]["timestamps"] = np.arange(4, dtype=dtype) * dtype(1000)
    return sensor


def path(*row):
    return {"timestamps": [0], "values": [list(row)]}


def shape(identifier, kind, *row, **fields):
    return {"id": identifier, "type": kind, **fields, "path": path(*row)}


def cuboid(identifier="car", **fields):
    return shape(identifier, "cuboid", 4, 2, 1.5, 1, 2, 3, 0, 0, 0, **fields)


def seen(sensor="cam"):
    return {"sensor_id": sensor, "timestamps": [0], "boxes": [[1, 2, 3, 4]]}


def keypoints(*projections, paths=1, **fields):
    """An annotation of points; each projection is that of a point into the sensors named."""
    projected = [[{"sensor_id": s, "timestamps": [0], "points": [[1, 2]]} for s in sensors] for sensors in projections]
    return {"id": "k", "type": "points", "paths": [path(1, 2, 3)] * paths, "projections": projected, **fields}


def header(*sensors, annotations=(), **fields):
    given = {"version": "1.0", "sensors": list(sensors or [lidar()]), **fields}
    return {**given, "annotations": list(annotations)} if annotations else given


@pytest.fixture
def file(tmp_path, encode_sfs):
    """Write a header through the independent writer; items have no dtype and shape where `bare`."""

    def write(content, *, cut=0, bare=False):
        written = tmp_path / "scene.sfs"
        if not isinstance(content, bytes):
            content = encode_sfs(content, **({"dtype": None, "shape": None} if bare else {}))
        written.write_bytes(content[: len(content) - cut])
        return written

    return write


@pytest.fixture
def hits(file):
    """Rules, locations and messages of what rules that read no frames find in a header."""

    def run(content, *rules, **options):
        report = validate(file(content), rules=rules, frames=False, **options)
        return [(f.rule, f.path.partition(" ")[0], f.message) for f in report.findings]

    return run


FALLING = {"timestamps": [5, 4], "values": [POSE, POSE]}
FAULTY = [
    ("file-readable", b'{"version": "1.0", "sens', "header"),
    ("version-known", header(version="2.0"), "version"),
    ("fields-valid", header(lidar(coordinates="map")), "sensors[0].coordinates"),
    ("ids-unique", header(lidar(), lidar()), "sensors[1].id"),
    ("quaternion-norm", header(lidar(poses=path(0, 0, 0, 0, 0, 0, 3))), "sensors[0].poses.values[0]"),
    ("pose-times-increasing", header(lidar(poses=FALLING)), "sensors[0].poses.timestamps[1]"),
    ("poses-finite", header(lidar(poses=path(float("nan"), *POSE[1:]))), "sensors[0].poses.values[0]"),
    (None, header(), None),
]


@pytest.mark.parametrize(("rule", "content", "location"), FAULTY)
def test_a_fault_of_a_file_is_known_by_its_rule_alone(hits, rule, content, location):
    faults = hits(content, *(fault.id for fault in FAULT_RULES))
    assert [hit[:2] for hit in faults] == ([(rule, location)] if rule else [])


class Broken:
    def __init__(self, first):
        self.first = first

    def __call__(self, k):
        if k:
            raise DataError("drive", f"frames[{k}]", "is torn")
        return self.first


def test_what_cannot_be_read_is_a_finding_and_the_rest_is_checked_without(tmp_path, file, sound, found):
    cut = file(header(), cut=20)
    assert [where for where, _ in found(cut, "arrays-whole")] == ["sensors[0].frames[0].points.positions ($items[0])"]
    frames = LazyFrames(sound.times(3), Broken(sound.sweep(0)))
    scene = sound.scene(LidarSensor("top", frames, poses=sound.path()))
    torn = [(f"sensors[0].frames[{k}]", f"drive: frames[{k}]: is torn") for k in (1, 2)]
    assert found(scene, "frame-readable") == torn
    assert found(scene, "frame-readable", frames=False) == found(sound.scene(), "frame-readable") == []
    folder = tmp_path / "drive"
    sceneloom.write(sound.scene(sound.lidar(), sound.odometry()), folder)
    lines = (folder / "data.jsonl").read_text("utf-8").splitlines()
    (folder / "data.jsonl").write_text("\n".join([lines[0], "{torn", *lines[1:]]), "utf-8")
    [(location, message)] = found(folder, "broken-lines")
    assert location == "data.jsonl: line 2"
    assert "{torn" in message
    assert found(folder, "file-readable") == found(folder, "sensor-empty") == []


def test_notes_of_readers_are_hints_and_those_of_when_a_file_was_made_are_not_repeated(sound, file, tmp_path, found):
    for kind in WarningKind:
        note = DataWarning(kind=kind, code="lines-sorted", location="data.jsonl", message="so", count=3)
        elsewhere = DataWarning(kind=kind, code="no-poses", location="sensors[0]", message="none")
        assert found(sound.scene(warnings=(note, elsewhere)), f"reading-{kind}") == [("data.jsonl", "so")]
        assert found(sound.scene(), f"reading-{kind}") == []
    made, written = file(header()), tmp_path / "written.sfs"
    assert [where for where, _ in found(made, "reading-assumed")] == ["sensors[0]"]
    with sceneloom.open(made) as scene:
        sceneloom.write(scene, written)
    with sceneloom.open(written) as scene:
        assert scene.warnings
    assert found(written, "reading-assumed") == []


@cache
def film():
    target = io.BytesIO()
    with av.open(target, "w", format="mp4") as output:
        stream = output.add_stream("mpeg4", rate=10)
        stream.width, stream.height = 16, 16
        image = av.VideoFrame.from_ndarray(np.zeros((16, 16, 3), np.uint8), format="rgb24")
        output.mux([*stream.encode(image), *stream.encode()])
    return np.frombuffer(target.getvalue(), np.uint8)


def whole():
    """A scene with every type of sensor and annotation of the description."""
    cloud = {"positions": np.ones((2, 3), np.float32)}
    sweeps = {"poses": POSES, "frames": [{"timestamp": 0, "points": cloud}]}
    fisheye = {**CAMERA_MODEL, "distortion": {"model": "fisheye", "params": [0.1, 0, 0, 0]}}
    camera = {"type": "camera", "poses": POSES}
    video = {"timestamps": [0], "content": film(), "fps": 10}
    triangle = (0, 0, 0, 1, 0, 0, 1, 1, 0)
    labeled = {"sensor_id": "top", "sensor_frame": 0, "point_ids": np.zeros(1, np.uint32)}
    sensors = [
        {"id": "map", "type": "points", "points": cloud},
        {"id": "top", "type": "lidar", **sweeps},
        {"id": "front", "type": "radar", **sweeps},
        {"id": "cam", **camera, "intrinsics": fisheye, "images": [{"timestamp": 0, "content": np.zeros(9, np.uint8)}]},
        {"id": "film", **camera, "intrinsics": CAMERA_MODEL, "video": video},
        {"id": "ego", "type": "odometry", "poses": POSES},
    ]
    annotations = [
        cuboid(attributes=[ATTRIBUTE], activations=[ACTIVE], projections=[seen()]),
        shape("b", "box_2d", 1, 2, 3, 4, sensor_id="cam"),
        shape("l2", "polyline_2d", 1, 2, 3, 4, sensor_id="cam"),
        shape("p2", "polygon_2d", 1, 2, 3, 4, 5, 9, sensor_id="cam"),
        shape("d2", "point_2d", 1, 2, sensor_id="cam"),
        shape("p", "polygon", *triangle),
        shape("t", "polygon_topdown", *triangle),
        shape("l", "polyline", *triangle),
        keypoints(["cam"]),
        {"id": "e", "type": "event", "start": 0},
        {"id": "r", "type": "labeled_points", "label": "road", "is_instance": False, "labeled_points": [labeled]},
        {"id": "a", "type": "localization_adjustment", "poses": POSES},
        {"id": "c", "type": "camera_calibration", "sensor_id": "cam", "poses": POSES, "intrinsics": CAMERA_MODEL},
        {"id": "o", "type": "object", "label": "thing"},
        {"id": "n", "type": "link", "label": "tows", "is_bidirectional": False, "from_id": "car", "to_id": "o"},
        {"id": "g", "type": "group", "label": "convoy"},
    ]
    return copied(header(*sensors, annotations=annotations, attributes=[ATTRIBUTE]))


# `distortion` absent stands for a pinhole, one of `images` and `video` suffices, no `sensor_frame` is the whole sensor
OPTIONAL = {"distortion", "images", "video", "attributes", "activations", "projections", "sensor_frame"}
OPTIONAL |= {"sensors", "annotations"}
# labels that may be absent; and what the text requires and the readings of docs/CONVENTIONS.md leave free:
# corrections of poses or of the camera model alone, and an event without a start, which is an object
READ_WITHOUT = {"annotations[13].label", "annotations[15].label"}
READ_WITHOUT |= {"annotations[12].poses", "annotations[12].intrinsics", "annotations[9].start"}


def fields_of(node, location=""):
    if isinstance(node, dict):
        for name, value in node.items():
            inner = f"{location}.{name}" if location else name
            yield inner
            yield from fields_of(value, inner)
    elif isinstance(node, list):
        for k, value in enumerate(node):
            yield from fields_of(value, f"{location}[{k}]")


REQUIRED = [f for f in fields_of(whole()) if f.rpartition(".")[2] not in OPTIONAL and f not in READ_WITHOUT]


def changed(location, *value):
    """The whole scene with another value at a path, or without what is there."""
    content = node = whole()
    *above, last = parse_path(location)
    for key in above:
        node = node[key]
    if value:
        [node[last]] = value
    else:
        del node[last]
    return content


def test_the_scene_of_these_tests_is_complete_and_times_of_static_attributes_may_be_absent(hits):
    assert hits(whole(), "fields-required", "fields-valid", "arrays-whole") == []
    assert len(REQUIRED) > 120
    content = changed("attributes", [{"name": "weather", "static": True, "values": ["dry"]}])
    assert hits(content, "fields-required") == []


@pytest.mark.parametrize("location", REQUIRED)
@pytest.mark.few(60)
def test_a_required_field_that_is_missing_is_found_at_its_path(hits, location):
    before = {hit[:2] for hit in hits(whole())}
    assert location in {hit[1] for hit in hits(changed(location)) if hit[:2] not in before}


def test_fields_and_types_with_nearly_a_known_name_are_found(hits):
    for location, wrong, right in (
        ("sensors[1].frames[0].points.intensites", [1, 2], "intensities"),
        ("annotations[0].lable", "car", "label"),
        ("sensors[4].video.FPS", 10, None),
    ):
        reported = hits(changed(location, wrong), "fields-spelling")
        assert [path for _, path, _ in reported] == ([] if right is None else [location])
        assert all(repr(right) in message for *_, message in reported)
    nearest = {"cubiod": "cuboid", "Cuboid": "cuboid", "box2d": "box_2d", "xyzzy": None, "lidr": "lidar"}
    for kind, near in nearest.items():
        misspelt = {"id": 1, "type": kind}
        group, content = "annotation", header(annotations=[misspelt])
        if kind == "lidr":
            group, content = "sensor", header(misspelt)
        ((_, location, message),) = hits(content, f"{group}-type-known")
        assert location == f"{group}s[0].type"
        assert (f"which is like {near!r}" in message) if near else "which is like" not in message
    # of an annotation of an unknown type nothing is required
    for kind in ("cubiod", "Cuboid", "labelled_points", ""):
        content = changed("annotations", [{**cuboid(), "type": kind}])
        about = [rule for rule, location, _ in hits(content) if location.startswith("annotations")]
        assert about == ["annotation-type-known"]


NANO, MICRO = "nanoseconds", "microseconds"


@pytest.mark.parametrize(
    ("unit", "dtype", "wrong"),
    [
        *((NANO, np.uint32, True), (NANO, np.uint64, False), (MICRO, np.uint64, True), (MICRO, np.uint32, False)),
        *((None, np.uint64, True), (None, np.uint32, False), (None, np.int32, True)),
    ],
)
def test_times_of_another_width_than_the_unit_says_are_found_and_fixed(tmp_path, file, hits, unit, dtype, wrong):
    content = header(timed_lidar(dtype), **({} if unit is None else {"time_unit": unit}))
    expected = ["sensors[0].frames[0].points.timestamps"] * wrong
    assert [location for _, location, _ in hits(content, "point-times-width")] == expected
    report = validate(file(content), fix=tmp_path / "fixed.sfs")
    assert "point-times-width" not in {finding.rule for finding in report.findings}
    if unit is None:
        return
    # times without a dtype
    bare = file(content, bare=True)
    if wrong:
        with pytest.raises(DataError, match=f"the bytes fit {np.dtype(dtype).name}"):
            sceneloom.open(bare)
        return
    with sceneloom.open(bare) as opened:
        times = opened.sensors[0].frames[0].points.timestamps_ns
        assert times.tolist() == [k * (10**3 if unit == NANO else 10**6) for k in range(4)]


def test_the_unit_of_time_is_written_back_as_it_was_read(tmp_path, file, decode_sfs):
    for unit in ("nanosecond", "microsecond", NANO, MICRO):
        dtype = np.uint64 if unit.startswith("nano") else np.uint32
        again, asked = tmp_path / f"{unit}.sfs", tmp_path / f"asked {unit}.sfs"
        with sceneloom.open(file(header(timed_lidar(dtype), time_unit=unit))) as opened:
            sceneloom.write(opened, again)
            sceneloom.write(opened, asked, time_unit=NANO)
        assert [decode_sfs(path.read_bytes())["time_unit"] for path in (again, asked)] == [unit, NANO]


def test_attributes_of_the_scene_and_parts_named_twice(tmp_path, file, hits):
    attributes = [
        {"name": "state", "sensor_id": "nowhere", "timestamps": [0], "values": ["dirty"]},
        {"name": "weather", "timestamps": [20, 10], "values": ["dry", "wet"]},
    ]
    content = header(attributes=attributes)
    found = hits(content, "annotation-sensor-unknown", "annotation-times-increasing")
    assert {hit[:2] for hit in found} == {
        ("annotation-sensor-unknown", "attributes[0].sensor_id"),
        ("annotation-times-increasing", "attributes[1].timestamps[1]"),
    }
    validate(file(content), fix=tmp_path / "fixed.sfs")
    with sceneloom.open(tmp_path / "fixed.sfs") as opened:
        weather = opened.attributes[1]
        assert (weather.timestamps_ns.tolist(), weather.values) == ([10_000, 20_000], ("wet", "dry"))
    twice = cuboid(activations=[ACTIVE] * 2, projections=[seen("top")] * 2)
    content = header(annotations=[twice, keypoints(["top"], ["top", "top"], paths=2)])
    assert [location for _, location, _ in hits(content, "part-of-sensor-once")] == [
        "annotations[0].activations[1].sensor_id",
        "annotations[0].projections[1].sensor_id",
        "annotations[1].projections[1][1].sensor_id",
    ]
    once = cuboid(activations=[ACTIVE], projections=[seen("top")])
    assert hits(header(annotations=[once]), "part-of-sensor-once") == []


ROAD = [[0.0, 10.0], [5.0, 12.0], [10.0, 14.0], [15.0, 16.0], [20.0, 18.0], [25.0, 20.0]]


def test_pairs_that_are_read_as_triples_are_found_and_read_as_pairs_on_request(file, hits):
    for kind in ("polyline", "polygon", "polygon_topdown"):
        content = header(annotations=[shape(1, kind, *np.ravel(ROAD).tolist())])
        ((_, location, message),) = hits(content, "shape-vertices-pairs")
        assert location == "annotations[0].path.values"
        assert "12 numbers, read as 4 x, y, z triples" in message
        assert not hits(content, "shape-vertices-pairs", vertices="pairs")
        with sceneloom.open(file(content), vertices="pairs") as opened:
            assert opened.annotations[0].path.vertices[0].tolist() == [[x, y, 0.0] for x, y in ROAD]
        with sceneloom.open(file(content)) as opened:
            assert len(opened.annotations[0].path.vertices[0]) == 4
        if kind != "polyline":
            content = header(annotations=[shape("a", kind, 10, 10, 14, 10, 12, 13)])
            read = "6 numbers, read as 2 x, y, z triples; they may be 3 x, y pairs"
            too_few = f"{read}, as triples they are too few for a {kind}"
            expected = [("shape-vertices-pairs", "annotations[0].path.values", too_few)]
            assert hits(content, "shape-vertices-pairs") == expected


def test_triples_are_not_taken_for_pairs_and_rows_that_fit_both_are_questioned_beside_pairs(file, hits):
    for offset in (0.0, 1.0, 40.0, -300.0):
        triples = [value for x, y in ROAD for value in (x + offset, y, 0.1 * x)]
        assert not hits(header(annotations=[shape(1, "polyline", *triples)]), "shape-vertices-pairs")
    both, pairs = shape(1, "polyline", 0, 0, 1, 1, 0, 2), shape(2, "polyline", 0, 0, 1, 1)
    assert not hits(header(annotations=[both]), "shape-vertices-pairs")
    ((_, location, message),) = hits(header(annotations=[both, pairs]), "shape-vertices-pairs")
    assert location == "annotations[0].path.values"
    assert "as in other annotations of the file" in message
    with pytest.raises(DataError, match="8 numbers; expected a multiple of 3"):
        sceneloom.open(file(header(annotations=[shape(1, "polyline", *[0] * 8)])), vertices="triples")


def test_one_bad_sensor_is_reported_once_and_not_by_all_that_name_it(hits):
    bad = {"id": "cam", "type": "camera", "poses": POSES, "intrinsics": {"fx": "wide"}}
    child = {"id": "ego", "type": "odometry", "parent_id": "cam", "poses": POSES}
    link = {"id": "l", "type": "link", "label": "x", "is_bidirectional": True, "from_id": 0, "to_id": "gone"}
    gone = {"id": "gone", "type": "cuboid", "parent_id": "cam"}
    content = header(
        *(lidar(), bad, child), annotations=[*(cuboid(k, projections=[seen()]) for k in range(20)), link, gone]
    )
    reported = hits(content)
    assert not [m for *_, m in reported if "is no sensor" in m or "is no annotation" in m]
    assert ("fields-valid", "sensors[1].intrinsics.fx") in [hit[:2] for hit in reported]


def test_a_part_keeps_attributes_without_times_and_points_that_no_camera_sees(tmp_path, file):
    empty = {"name": "colour", "timestamps": [], "values": []}
    hand = keypoints([], ["top"], paths=2, stationary=True, attributes=[empty])
    written = file(header(annotations=[hand], attributes=[empty]))
    sceneloom.convert(written, tmp_path / "whole.sfs")
    with sceneloom.open(written) as opened:
        part = sceneloom.crop_scene(opened, stop=0.5)
        assert [attribute.name for attribute in part.attributes] == ["colour"]
        assert [attribute.name for attribute in part.annotations[0].attributes] == ["colour"]
