"""Required fields: each that the description requires is missed, with its path, whether or not the reader needs it."""

import io
from functools import cache

import av
import numpy as np
import pytest

from sceneloom.checks import validate
from sceneloom.formats.sfs.reader import copied, parse_path

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


def header():
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
                "labeled_points": [
                    {"sensor_id": "top", "sensor_frame": 0, "point_ids": np.zeros(1, np.uint32)}
                ],
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
    for location in fields_of(header())
    if location.rpartition(".")[2] not in OPTIONAL
    and location not in LABELS_THAT_MAY_BE_ABSENT
    and location not in READ_WITHOUT
]


def without(location):
    changed = copied(header())
    *above, last = parse_path(location)
    node = changed
    for key in above:
        node = node[key]
    del node[last]
    return changed


@pytest.fixture
def found(tmp_path, encode_sfs):
    """Write a header, and give what the rules that read no frames state of it."""

    def run(content, **options):
        file = tmp_path / "scene.sfs"
        file.write_bytes(encode_sfs(content))
        return [
            (f.rule, f.path.partition(" ")[0], f.message)
            for f in validate(file, frames=False, **options).findings
        ]

    return run


def test_the_scene_of_these_tests_is_complete(found):
    assert not {rule for rule, _, _ in found(header())} & {"fields-required", "fields-valid", "arrays-whole"}
    assert len(REQUIRED) > 120


@pytest.mark.parametrize("location", REQUIRED)
@pytest.mark.few(60)
def test_a_required_field_that_is_missing_is_found_at_its_path(found, location):
    before = {entry[:2] for entry in found(header())}
    new = {path for rule, path, _ in found(without(location)) if (rule, path) not in before}
    assert location in new


def test_times_of_static_attributes_may_be_absent(found):
    content = header()
    content["attributes"] = [{"name": "weather", "static": True, "values": ["dry"]}]
    assert not [path for rule, path, _ in found(content) if rule == "fields-required"]


@pytest.mark.parametrize(
    ("location", "wrong", "right"),
    [
        ("sensors[1].frames[0].points.intensites", [1, 2], "intensities"),
        ("annotations[0].lable", "car", "label"),
        ("sensors[4].video.FPS", 10, None),
    ],
)
def test_a_field_with_nearly_the_name_of_one_that_is_missing_is_found(found, location, wrong, right):
    content = header()
    *above, last = parse_path(location)
    node = content
    for key in above:
        node = node[key]
    node[last] = wrong
    reported = [(path, message) for rule, path, message in found(content) if rule == "fields-spelling"]
    assert [path for path, _ in reported] == ([] if right is None else [location])
    assert all(repr(right) in message for _, message in reported)


@pytest.mark.parametrize("kind", ["cubiod", "Cuboid", "labelled_points", ""])
def test_of_an_annotation_of_an_unknown_type_nothing_is_required(found, kind):
    content = header()
    content["annotations"] = [{"id": "a", "type": kind, "path": path(1, 1, 1, 0, 0, 0, 0, 0, 0)}]
    about = [rule for rule, location, _ in found(content) if location.startswith("annotations")]
    assert about == ["annotation-type-known"]


@pytest.mark.parametrize("kind", ["polygon", "polygon_topdown"])
def test_an_outline_of_six_numbers_is_reported_to_be_of_pairs(found, kind):
    content = header()
    content["annotations"] = [shape("a", kind, 10, 10, 14, 10, 12, 13)]
    stated = [
        (location, message) for rule, location, message in found(content) if rule == "shape-vertices-pairs"
    ]
    read = "6 numbers, read as 2 x, y, z triples; they may be 3 x, y pairs"
    assert stated == [("annotations[0].path.values", f"{read}, as triples they are too few for a {kind}")]
