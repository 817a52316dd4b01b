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


def lidar(**fields):
    return {
        "id": "top",
        "type": "lidar",
        "poses": {"timestamps": [0], "values": [POSE]},
        "frames": [{"timestamp": 0, "points": {"positions": np.ones((2, 3), np.float32)}}],
        **fields,
    }


def header(*sensors, **fields):
    return {"version": "1.0", "sensors": list(sensors or [lidar()]), **fields}


@pytest.fixture
def file_of(tmp_path, encode_sfs):
    """Write a header through the independent writer; cut so many bytes off."""

    def write(content, *, cut=0):
        path = tmp_path / "scene.sfs"
        encoded = content if isinstance(content, bytes) else encode_sfs(content)
        path.write_bytes(encoded[: len(encoded) - cut])
        return path

    return write


def poses(*rows, times=None):
    return {"timestamps": list(times or range(len(rows))), "values": list(rows)}


FAULTY = {
    "file-readable": (b'{"version": "1.0", "sens', "header"),
    "version-known": (header(version="2.0"), "version"),
    "fields-valid": (header(lidar(coordinates="map")), "sensors[0].coordinates"),
    "ids-unique": (header(lidar(), lidar()), "sensors[1].id"),
    "quaternion-norm": (header(lidar(poses=poses([0, 0, 0, 0, 0, 0, 3]))), "sensors[0].poses.values[0]"),
    "pose-times-increasing": (
        header(lidar(poses=poses(POSE, POSE, times=[5, 4]))),
        "sensors[0].poses.timestamps[1]",
    ),
    "poses-finite": (
        header(lidar(poses=poses([float("nan"), *POSE[1:]]))),
        "sensors[0].poses.values[0]",
    ),
}


@pytest.mark.parametrize("rule", FAULTY)
def test_a_fault_of_a_file_is_known_by_its_rule_alone(file_of, found, rule):
    content, location = FAULTY[rule]
    path = file_of(content)
    assert [where for where, _ in found(path, rule)] == [location]
    others = [other.id for other in FAULT_RULES if other.id != rule]
    assert [hit for other in others for hit in found(path, other)] == []


def test_an_array_that_is_cut_off_is_reported(file_of, found):
    path = file_of(header(), cut=20)
    assert [where for where, _ in found(path, "arrays-whole")] == ["sensors[0].frames[0].points.positions ($items[0])"]


def test_a_sound_file_keeps_all_of_them(file_of, found):
    path = file_of(header(lidar(poses=poses(POSE, POSE))))
    assert [hit for rule in FAULT_RULES for hit in found(path, rule.id)] == []


class Broken:
    """Reads the first frame and no other."""

    def __init__(self, first):
        self.first = first

    def __call__(self, k):
        if k:
            raise DataError("drive", f"frames[{k}]", "is torn")
        return self.first


def test_a_frame_that_cannot_be_read_is_a_finding(sound, found):
    frames = LazyFrames(sound.times(3), Broken(sound.sweep(0)))
    scene = sound.scene(LidarSensor("top", frames, poses=sound.path()))
    assert found(scene, "frame-readable") == [
        ("sensors[0].frames[1]", "drive: frames[1]: is torn"),
        ("sensors[0].frames[2]", "drive: frames[2]: is torn"),
    ]
    assert found(scene, "frame-readable", frames=False) == []
    assert found(sound.scene(), "frame-readable") == []


@pytest.mark.parametrize("kind", list(WarningKind))
def test_notes_of_readers_are_hints(sound, found, kind):
    rule = f"reading-{kind}"
    note = DataWarning(kind=kind, code="lines-sorted", location="data.jsonl", message="so", count=3)
    reported_elsewhere = DataWarning(kind=kind, code="no-poses", location="sensors[0]", message="none")
    scene = sound.scene(warnings=(note, reported_elsewhere))
    assert found(scene, rule) == [("data.jsonl", "so")]
    assert found(sound.scene(), rule) == []


def test_what_was_remarked_when_a_file_was_made_is_not_remarked_again(file_of, tmp_path, found):
    path, written = file_of(header()), tmp_path / "written.sfs"
    assert [where for where, _ in found(path, "reading-assumed")] == ["sensors[0]"]
    with sceneloom.open(path) as scene:
        sceneloom.write(scene, written)
    with sceneloom.open(written) as scene:
        assert scene.warnings
    assert found(written, "reading-assumed") == []


def test_a_broken_recording_is_checked_without_what_is_broken(tmp_path, sound, found):
    folder = tmp_path / "drive"
    sceneloom.write(sound.scene(sound.lidar(), sound.odometry()), folder)
    lines = (folder / "data.jsonl").read_text("utf-8").splitlines()
    (folder / "data.jsonl").write_text("\n".join([lines[0], "{torn", *lines[1:]]), "utf-8")
    [(location, message)] = found(folder, "broken-lines")
    assert location == "data.jsonl: line 2"
    assert "{torn" in message
    assert found(folder, "file-readable") == []
    assert found(folder, "sensor-empty") == []


POSES = {"timestamps": [0, 100_000], "values": [[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 1]]}
CAMERA_MODEL = {"fx": 9, "fy": 9, "cx": 4, "cy": 3, "width": 8, "height": 6}
ATTRIBUTE = {"name": "colour", "timestamps": [0], "values": ["red"]}


def cloud():
    return {"positions": np.ones((2, 3), np.float32)}


def path(*row):
    return {"timestamps": [0], "values": [list(row)]}


def shape(identifier, kind, *row, **fields):
    return {"id": identifier, "type": kind, **fields, "path": path(*row)}


@cache
def film():
    """A video of one image."""
    target = io.BytesIO()
    with av.open(target, "w", format="mp4") as output:
        stream = output.add_stream("mpeg4", rate=10)
        stream.width, stream.height = 16, 16
        image = av.VideoFrame.from_ndarray(np.zeros((16, 16, 3), np.uint8), format="rgb24")
        for packet in [*stream.encode(image), *stream.encode()]:
            output.mux(packet)
    return np.frombuffer(target.getvalue(), np.uint8)


def header_of_fields():
    """A scene with every type of sensor and annotation of the description."""
    return {
        "version": "1.0",
        "sensors": [
            {"id": "map", "type": "points", "points": cloud()},
            {
                "id": "top",
                "type": "lidar",
                "poses": POSES,
                "frames": [{"timestamp": 0, "points": cloud()}],
            },
            {
                "id": "front",
                "type": "radar",
                "poses": POSES,
                "frames": [{"timestamp": 0, "points": cloud()}],
            },
            {
                "id": "cam",
                "type": "camera",
                "poses": POSES,
                "intrinsics": {**CAMERA_MODEL, "distortion": {"model": "fisheye", "params": [0.1, 0, 0, 0]}},
                "images": [{"timestamp": 0, "content": np.zeros(9, np.uint8)}],
            },
            {
                "id": "film",
                "type": "camera",
                "poses": POSES,
                "intrinsics": CAMERA_MODEL,
                "video": {"timestamps": [0], "content": film(), "fps": 10},
            },
            {"id": "ego", "type": "odometry", "poses": POSES},
        ],
        "annotations": [
            {
                **shape("car", "cuboid", 4, 2, 1, 0, 0, 0, 0, 0, 0),
                "attributes": [ATTRIBUTE],
                "activations": [{"sensor_id": "top", "timestamps": [0], "durations": [5]}],
                "projections": [{"sensor_id": "cam", "timestamps": [0], "boxes": [[1, 2, 3, 4]]}],
            },
            shape("b", "box_2d", 1, 2, 3, 4, sensor_id="cam"),
            shape("l2", "polyline_2d", 1, 2, 3, 4, sensor_id="cam"),
            shape("p2", "polygon_2d", 1, 2, 3, 4, 5, 9, sensor_id="cam"),
            shape("d2", "point_2d", 1, 2, sensor_id="cam"),
            shape("p", "polygon", 0, 0, 0, 1, 0, 0, 1, 1, 0),
            shape("t", "polygon_topdown", 0, 0, 0, 1, 0, 0, 1, 1, 0),
            shape("l", "polyline", 0, 0, 0, 1, 0, 0, 1, 1, 0),
            {
                "id": "k",
                "type": "points",
                "paths": [path(1, 2, 3)],
                "projections": [[{"sensor_id": "cam", "timestamps": [0], "points": [[1, 2]]}]],
            },
            {"id": "e", "type": "event", "start": 0},
            {
                "id": "r",
                "type": "labeled_points",
                "label": "road",
                "is_instance": False,
                "labeled_points": [{"sensor_id": "top", "sensor_frame": 0, "point_ids": np.zeros(1, np.uint32)}],
            },
            {"id": "a", "type": "localization_adjustment", "poses": POSES},
            {
                "id": "c",
                "type": "camera_calibration",
                "sensor_id": "cam",
                "poses": POSES,
                "intrinsics": CAMERA_MODEL,
            },
            {"id": "o", "type": "object", "label": "thing"},
            {
                "id": "n",
                "type": "link",
                "label": "tows",
                "is_bidirectional": False,
                "from_id": "car",
                "to_id": "o",
            },
            {"id": "g", "type": "group", "label": "convoy"},
        ],
        "attributes": [ATTRIBUTE],
    }


OPTIONAL = {
    "distortion": "stands for a pinhole camera model",
    "images": "or `video`",
    "video": "or `images`",
    "attributes": "",
    "activations": "",
    "projections": "",
    "sensor_frame": "the whole sensor",
    "sensors": "",
    "annotations": "",
}


"""Fields of the scene above that the description calls optional."""


LABELS_THAT_MAY_BE_ABSENT = {"annotations[13].label", "annotations[15].label"}
READ_WITHOUT = {"annotations[12].poses", "annotations[12].intrinsics", "annotations[9].start"}


"""Required by the text, and free by the readings of docs/CONVENTIONS.md.

Corrections of poses or of the camera model alone, and
an event without a start, which is an object."""


def fields_of(node, location=""):
    """The path of every field of a header."""
    if isinstance(node, dict):
        for name, value in node.items():
            inner = f"{location}.{name}" if location else name
            yield inner
            yield from fields_of(value, inner)
    elif isinstance(node, list):
        for k, value in enumerate(node):
            yield from fields_of(value, f"{location}[{k}]")


REQUIRED = [
    location
    for location in fields_of(header_of_fields())
    if location.rpartition(".")[2] not in OPTIONAL
    and location not in LABELS_THAT_MAY_BE_ABSENT
    and location not in READ_WITHOUT
]


def without(location):
    changed = copied(header_of_fields())
    *above, last = parse_path(location)
    node = changed
    for key in above:
        node = node[key]
    del node[last]
    return changed


@pytest.fixture
def field_findings(tmp_path, encode_sfs):
    """Write a header, and give what the rules that read no frames state of it."""

    def run(content, **options):
        file = tmp_path / "scene.sfs"
        file.write_bytes(encode_sfs(content))
        return [(f.rule, f.path.partition(" ")[0], f.message) for f in validate(file, frames=False, **options).findings]

    return run


def test_the_scene_of_these_tests_is_complete(field_findings):
    assert not {rule for rule, _, _ in field_findings(header_of_fields())} & {
        "fields-required",
        "fields-valid",
        "arrays-whole",
    }
    assert len(REQUIRED) > 120


@pytest.mark.parametrize("location", REQUIRED)
@pytest.mark.few(60)
def test_a_required_field_that_is_missing_is_found_at_its_path(field_findings, location):
    before = {entry[:2] for entry in field_findings(header_of_fields())}
    new = {path for rule, path, _ in field_findings(without(location)) if (rule, path) not in before}
    assert location in new


def test_times_of_static_attributes_may_be_absent(field_findings):
    content = header_of_fields()
    content["attributes"] = [{"name": "weather", "static": True, "values": ["dry"]}]
    assert not [path for rule, path, _ in field_findings(content) if rule == "fields-required"]


@pytest.mark.parametrize(
    ("location", "wrong", "right"),
    [
        ("sensors[1].frames[0].points.intensites", [1, 2], "intensities"),
        ("annotations[0].lable", "car", "label"),
        ("sensors[4].video.FPS", 10, None),
    ],
)
def test_a_field_with_nearly_the_name_of_one_that_is_missing_is_found(field_findings, location, wrong, right):
    content = header_of_fields()
    *above, last = parse_path(location)
    node = content
    for key in above:
        node = node[key]
    node[last] = wrong
    reported = [(path, message) for rule, path, message in field_findings(content) if rule == "fields-spelling"]
    assert [path for path, _ in reported] == ([] if right is None else [location])
    assert all(repr(right) in message for _, message in reported)


@pytest.mark.parametrize("kind", ["cubiod", "Cuboid", "labelled_points", ""])
def test_of_an_annotation_of_an_unknown_type_nothing_is_required(field_findings, kind):
    content = header_of_fields()
    content["annotations"] = [{"id": "a", "type": kind, "path": path(1, 1, 1, 0, 0, 0, 0, 0, 0)}]
    about = [rule for rule, location, _ in field_findings(content) if location.startswith("annotations")]
    assert about == ["annotation-type-known"]


@pytest.mark.parametrize("kind", ["polygon", "polygon_topdown"])
def test_an_outline_of_six_numbers_is_reported_to_be_of_pairs(field_findings, kind):
    content = header_of_fields()
    content["annotations"] = [shape("a", kind, 10, 10, 14, 10, 12, 13)]
    stated = [
        (location, message) for rule, location, message in field_findings(content) if rule == "shape-vertices-pairs"
    ]
    read = "6 numbers, read as 2 x, y, z triples; they may be 3 x, y pairs"
    assert stated == [("annotations[0].path.values", f"{read}, as triples they are too few for a {kind}")]


POSES_OF_DESCRIPTION = {"timestamps": [0, 10**6], "values": [[0, 0, 0, 0, 0, 0, 1], [9, 0, 0, 0, 0, 0, 1]]}
BOX = [4, 2, 1.5, 1, 2, 3, 0, 0, 0]
ROAD = [[0.0, 10.0], [5.0, 12.0], [10.0, 14.0], [15.0, 16.0], [20.0, 18.0], [25.0, 20.0]]


def lidar_of_description(times=None, **fields):
    points = {"positions": np.ones((4, 3), np.float32)}
    if times is not None:
        points["timestamps"] = times
    return {
        "id": "top",
        "type": "lidar",
        "poses": POSES_OF_DESCRIPTION,
        "frames": [{"timestamp": 0, "points": points}],
        **fields,
    }


def scene(*annotations, sensors=None, **fields):
    return {
        "version": "1.0",
        "sensors": [lidar_of_description()] if sensors is None else sensors,
        "annotations": list(annotations),
        **fields,
    }


def cuboid(**fields):
    return {"id": "car", "type": "cuboid", "path": {"timestamps": [0], "values": [BOX]}, **fields}


@pytest.fixture
def file(tmp_path, encode_sfs):
    """Write a header as a file; items have no dtype and shape where `bare`."""

    def write(content, *, bare=False):
        path = tmp_path / "scene.sfs"
        path.write_bytes(encode_sfs(content, **({"dtype": None, "shape": None} if bare else {})))
        return path

    return write


def found_of_description(path, *rules, **options):
    report = validate(path, rules=rules, frames=False, **options)
    return [(finding.path, finding.message) for finding in report.findings]


@pytest.mark.parametrize(("unit", "dtype"), [("nanoseconds", np.uint64), ("microseconds", np.uint32)])
def test_times_without_a_dtype_are_as_wide_as_the_unit_says(file, unit, dtype):
    times = np.arange(4, dtype=dtype) * 1000
    with sceneloom.open(file(scene(sensors=[lidar_of_description(times)], time_unit=unit), bare=True)) as opened:
        ticks = 1 if unit == "nanoseconds" else 1000
        points = opened.sensors[0].frames[0].points
        assert points.timestamps_ns.tolist() == (np.arange(4) * 1000 * ticks).tolist()


@pytest.mark.parametrize(
    ("unit", "dtype", "fits"),
    [("nanoseconds", np.uint32, "uint32"), ("microseconds", np.uint64, "uint64")],
)
def test_times_without_a_dtype_of_another_width_are_refused_and_named(file, unit, dtype, fits):
    content = scene(sensors=[lidar_of_description(np.arange(4, dtype=dtype))], time_unit=unit)
    with pytest.raises(DataError, match=f"the bytes fit {fits}"):
        sceneloom.open(file(content, bare=True))


@pytest.mark.parametrize(
    ("unit", "dtype", "wrong"),
    [
        ("nanoseconds", np.uint32, True),
        ("nanoseconds", np.uint64, False),
        ("microseconds", np.uint64, True),
        (None, np.uint64, True),
        (None, np.uint32, False),
        (None, np.int32, True),
    ],
)
def test_times_of_another_width_than_the_unit_says_are_found_and_fixed(tmp_path, file, unit, dtype, wrong):
    fields = {} if unit is None else {"time_unit": unit}
    path = file(scene(sensors=[lidar_of_description(np.arange(4, dtype=dtype))], **fields))
    locations = [location for location, _ in found_of_description(path, "point-times-width")]
    assert locations == (["sensors[0].frames[0].points.timestamps"] if wrong else [])
    report = validate(path, fix=tmp_path / "fixed.sfs")
    assert "point-times-width" not in {finding.rule for finding in report.findings}


@pytest.mark.parametrize("unit", ["nanosecond", "microsecond", "nanoseconds", "microseconds"])
def test_the_unit_of_time_is_written_back_as_it_was_read(tmp_path, file, decode_sfs, unit):
    dtype = np.uint64 if unit.startswith("nano") else np.uint32
    path = file(scene(sensors=[lidar_of_description(np.arange(4, dtype=dtype))], time_unit=unit))
    with sceneloom.open(path) as opened:
        sceneloom.write(opened, tmp_path / "again.sfs")
        sceneloom.write(opened, tmp_path / "asked.sfs", time_unit="nanoseconds")
    assert decode_sfs((tmp_path / "again.sfs").read_bytes())["time_unit"] == unit
    assert decode_sfs((tmp_path / "asked.sfs").read_bytes())["time_unit"] == "nanoseconds"


@pytest.mark.parametrize(
    ("kind", "near"), [("cubiod", "cuboid"), ("Cuboid", "cuboid"), ("box2d", "box_2d"), ("xyzzy", None)]
)
def test_a_misspelt_type_of_annotation_is_found_with_the_nearest_one(file, kind, near):
    ((location, message),) = found_of_description(file(scene({"id": 1, "type": kind})), "annotation-type-known")
    assert location == "annotations[0].type"
    assert (f"which is like {near!r}" in message) if near else "which is like" not in message


def test_a_misspelt_type_of_sensor_is_found_with_the_nearest_one(file):
    path = file(scene(sensors=[{"id": 1, "type": "lidr"}]))
    ((_, message),) = found_of_description(path, "sensor-type-known")
    assert "which is like 'lidar'" in message


def test_attributes_of_the_scene_name_sensors_of_it_and_have_rising_times(tmp_path, file):
    attributes = [
        {"name": "state", "sensor_id": "nowhere", "timestamps": [0], "values": ["dirty"]},
        {"name": "weather", "timestamps": [20, 10], "values": ["dry", "wet"]},
    ]
    path = file(scene(attributes=attributes))
    assert [location for location, _ in found_of_description(path, "annotation-sensor-unknown")] == [
        "attributes[0].sensor_id"
    ]
    assert [location for location, _ in found_of_description(path, "annotation-times-increasing")] == [
        "attributes[1].timestamps[1]"
    ]
    validate(path, fix=tmp_path / "fixed.sfs")
    with sceneloom.open(tmp_path / "fixed.sfs") as opened:
        assert opened.attributes[1].timestamps_ns.tolist() == [10_000, 20_000]
        assert opened.attributes[1].values == ("wet", "dry")


def test_a_second_activation_or_projection_of_one_sensor_is_found(file):
    active = {"sensor_id": "top", "timestamps": [0], "durations": [5]}
    seen = {"sensor_id": "top", "timestamps": [0], "boxes": [[1, 2, 3, 4]]}
    point = {"sensor_id": "top", "timestamps": [0], "points": [[1, 2]]}
    keypoints = {
        "id": "k",
        "type": "points",
        "paths": [{"timestamps": [0], "values": [[1, 2, 3]]}] * 2,
        "projections": [[point], [point, point]],
    }
    content = scene(cuboid(activations=[active, active], projections=[seen, seen]), keypoints)
    assert [location for location, _ in found_of_description(file(content), "part-of-sensor-once")] == [
        "annotations[0].activations[1].sensor_id",
        "annotations[0].projections[1].sensor_id",
        "annotations[1].projections[1][1].sensor_id",
    ]
    assert not found_of_description(
        file(scene(cuboid(activations=[active], projections=[seen]))), "part-of-sensor-once"
    )


@pytest.mark.parametrize("kind", ["polyline", "polygon", "polygon_topdown"])
def test_pairs_that_are_read_as_triples_are_found_and_read_as_pairs_on_request(file, kind):
    pairs = [value for vertex in ROAD for value in vertex]
    path = file(scene({"id": 1, "type": kind, "path": {"timestamps": [0], "values": [pairs]}}))
    ((location, message),) = found_of_description(path, "shape-vertices-pairs")
    assert location == "annotations[0].path.values"
    assert "12 numbers, read as 4 x, y, z triples" in message
    assert not found_of_description(path, "shape-vertices-pairs", vertices="pairs")
    with sceneloom.open(path, vertices="pairs") as opened:
        assert opened.annotations[0].path.vertices[0].tolist() == [[x, y, 0.0] for x, y in ROAD]
    with sceneloom.open(path) as opened:
        assert len(opened.annotations[0].path.vertices[0]) == 4


@pytest.mark.parametrize("offset", [0.0, 1.0, 40.0, -300.0])
def test_triples_are_not_taken_for_pairs(file, offset):
    triples = [value for x, y in ROAD for value in (x + offset, y, 0.1 * x)]
    path = file(scene({"id": 1, "type": "polyline", "path": {"timestamps": [0], "values": [triples]}}))
    assert not found_of_description(path, "shape-vertices-pairs")


def test_rows_that_fit_both_are_questioned_beside_rows_that_are_pairs(file):
    both = {"id": 1, "type": "polyline", "path": {"timestamps": [0], "values": [[0, 0, 1, 1, 0, 2]]}}
    pairs = {"id": 2, "type": "polyline", "path": {"timestamps": [0], "values": [[0, 0, 1, 1]]}}
    assert not found_of_description(file(scene(both)), "shape-vertices-pairs")
    ((location, message),) = found_of_description(file(scene(both, pairs)), "shape-vertices-pairs")
    assert location == "annotations[0].path.values"
    assert "as in other annotations of the file" in message


def test_vertices_that_are_not_what_was_stated_are_refused(file):
    path = file(scene({"id": 1, "type": "polyline", "path": {"timestamps": [0], "values": [[0] * 8]}}))
    with pytest.raises(DataError, match="8 numbers; expected a multiple of 3"):
        sceneloom.open(path, vertices="triples")


def test_one_bad_sensor_is_reported_once_and_not_by_all_that_name_it(file):
    seen = [
        cuboid(id=k, projections=[{"sensor_id": "cam", "timestamps": [0], "boxes": [[1, 2, 3, 4]]}]) for k in range(20)
    ]
    bad = {"id": "cam", "type": "camera", "poses": POSES_OF_DESCRIPTION, "intrinsics": {"fx": "wide"}}
    child = {"id": "ego", "type": "odometry", "parent_id": "cam", "poses": POSES_OF_DESCRIPTION}
    link = {"id": "l", "type": "link", "label": "x", "is_bidirectional": True, "from_id": 0, "to_id": "gone"}
    gone = {"id": "gone", "type": "cuboid", "parent_id": "cam"}
    path = file(scene(*seen, link, gone, sensors=[lidar_of_description(), bad, child]))
    stated = [message for _, message in found_of_description(path)]
    assert not [message for message in stated if "is no sensor" in message or "is no annotation" in message]
    assert "sensors[1].intrinsics.fx" in [location for location, _ in found_of_description(path, "fields-valid")]


def test_a_part_keeps_attributes_without_times_and_points_that_no_camera_sees(tmp_path, file):
    empty = {"name": "colour", "timestamps": [], "values": []}
    point = {"sensor_id": "top", "timestamps": [0], "points": [[1, 2]]}
    keypoints = {
        "id": "k",
        "type": "points",
        "stationary": True,
        "attributes": [empty],
        "paths": [{"timestamps": [0], "values": [[1, 2, 3]]}] * 2,
        "projections": [[], [point]],
    }
    path = file(scene(keypoints, attributes=[empty]))
    sceneloom.convert(path, tmp_path / "whole.sfs")
    with sceneloom.open(path) as opened:
        part = sceneloom.crop_scene(opened, stop=0.5)
        assert [attribute.name for attribute in part.attributes] == ["colour"]
        assert [attribute.name for attribute in part.annotations[0].attributes] == ["colour"]
