"""The profile `scale` of validate against Scale's own library: what it refuses we find, what it takes we let pass."""

import json
from copy import deepcopy

import numpy as np
import pytest

from sceneloom.checks.scale import SCALE_RULES
from sceneloom.checks.validation import validate
from sceneloom.formats.sfs.container import format_keys

JUDGE = """
import contextlib, io, json, sys, warnings
warnings.simplefilter("ignore")
verdicts = {}
with contextlib.redirect_stdout(io.StringIO()):
    from scale_json_binary import read_file
    from scale_sensor_fusion_io.loaders import SFSLoader
    from scale_sensor_fusion_io.validation import parse_and_validate_scene
    for name, path in json.loads(open(sys.argv[1]).read()).items():
        try:
            SFSLoader(path).load()
            loaded = None
        except Exception as error:
            loaded = f"{type(error).__name__}: {error}"[:200]
        try:
            result = parse_and_validate_scene(read_file(path))
            validated = None if result.success else str(result.details)[:200]
        except Exception as error:
            validated = f"{type(error).__name__}: {error}"[:200]
        verdicts[name] = [loaded, validated]
print(json.dumps(verdicts))
"""

POSES = {"timestamps": [0, 100_000], "values": [[0, 0, 0, 0, 0, 0, 1], [1.5, 0, 0, 0, 0, 0, 1]]}
JPEG_STANDS_FOR = np.arange(20, dtype=np.uint8)


def a_file():
    """A scene that Scale's library loads and validates, with everything in it that it knows."""
    attribute = {"name": "state", "timestamps": [0, 50_000], "values": ["parked", 3], "static": False}
    row = [4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 0.0, 0.0, 90.0]
    path = {"timestamps": [0], "values": [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]]}
    points = {
        "positions": np.ones((4, 3), np.float32),
        "intensities": np.arange(4, dtype=np.uint8),
        "colors": np.ones((4, 3), np.uint8),
        "timestamps": np.arange(4, dtype=np.uint32) + 100_000,
    }
    echoes = {"positions": np.ones((3, 3), np.float32), "directions": np.ones((3, 3), np.float32)}
    bare = {"timestamp": 0, "points": {"positions": np.ones((5, 3), np.float32)}}
    lidar = {"id": "top", "type": "lidar", "coordinates": "world", "poses": POSES}
    intrinsics = {"fx": 100.0, "fy": 100, "cx": 4.0, "cy": 3.0, "width": 8, "height": 6}
    intrinsics["distortion"] = {"model": "fisheye", "params": [0.1, 0, 0, 0]}
    camera = {"id": "front", "type": "camera", "poses": POSES, "intrinsics": intrinsics}
    car = {"id": "car", "type": "cuboid", "label": "car", "stationary": False, "attributes": [attribute]}
    car["path"] = {"timestamps": [0, 50_000], "values": [row, row]}
    car["activations"] = [{"sensor_id": "top", "timestamps": [0], "durations": [1.5], "cuboids": [row]}]
    car["projections"] = [{"sensor_id": "front", "timestamps": [0, 1], "boxes": [[1, 1, 2, 2], None]}]
    in_image = {"sensor_id": "front", "path": {"timestamps": [0], "values": [[1, 1, 2, 2]]}}
    corners = {"timestamps": [0], "values": [[0, 0, 2, 0, 2, 2]]}
    labelled = {"sensor_id": "top", "sensor_frame": 0, "point_ids": np.arange(3, dtype=np.uint32)}
    road = {"id": "lp", "type": "labeled_points", "label": "road", "is_instance": False, "labeled_points": [labelled]}
    header = {
        "version": "1.0",
        "time_offset": 5,
        "time_unit": "microseconds",
        "metadata": {"town": "Ulm"},
        "attributes": [attribute],
        "sensors": [
            {**lidar, "frames": [bare, {"timestamp": 100_000, "points": points}]},
            {"id": 7, "type": "radar", "poses": POSES, "frames": [{"timestamp": 0, "points": echoes}]},
            {**camera, "images": [{"timestamp": k * 100_000, "content": JPEG_STANDS_FOR} for k in range(2)]},
        ],
        "annotations": [
            car,
            {"id": "b", "type": "box_2d", **in_image},
            {"id": "p2", "type": "polygon_2d", **in_image, "path": corners},
            {"id": "area", "type": "polygon_topdown", "path": path},
            {"id": "line", "type": "polyline", "path": path, "is_closed": False},
            {"id": "e", "type": "event", "start": 10, "duration": 20},
            road,
            {"id": "la", "type": "localization_adjustment", "poses": POSES},
            {"id": "o", "type": "object", "parent_id": "car"},
            {"id": "at", "type": "attributes", "attributes": [attribute]},
        ],
    }
    return own_copy(header)


def own_copy(node):
    """A header of which no part stands in two locations."""
    if isinstance(node, dict):
        return {key: own_copy(value) for key, value in node.items()}
    return [own_copy(value) for value in node] if isinstance(node, list) else deepcopy(node)


LIDAR, RADAR, CAMERA = (("sensors", k) for k in range(3))
CAR = ("annotations", 0)
FIRST = (*LIDAR, "frames", 0)
SECOND = (*LIDAR, "frames", 1)
GONE = object()


def shape(kind, **fields):
    path = {"timestamps": [0], "values": [[1, 2, 3] * 3]}
    return {"id": "new", "type": kind, "sensor_id": "front", "path": path, **fields}


NO_POINTS = {"positions": np.ones((0, 3), np.float32), "timestamps": np.ones(0, np.uint32)}
FOUR_LENGTHS = {"positions": np.ones((4, 3), np.float32), "lengths": np.ones(4, np.float32)}
LINK = {"id": "l", "type": "link", "label": "tows", "is_bidirectional": False, "from_id": "b", "to_id": "o"}
REFUSED = {
    "another version": (("version",), "5.1"),
    "a version with a suffix": (("version",), "1.0.1"),
    "no version": (("version",), GONE),
    "nanoseconds": (("time_unit",), "nanoseconds"),
    "no unit": (("time_unit",), None),
    "an unknown unit": (("time_unit",), "seconds"),
    "a float offset": (("time_offset",), 5.5),
    "a negative offset": (("time_offset",), -1),
    "metadata that are a list": (("metadata",), []),
    "a float attribute of the scene": (("attributes", 0, "values"), ["parked", 3.5]),
    "an attribute of the scene without times": (("attributes", 0, "timestamps"), GONE),
    "a points sensor": (RADAR, {"id": "map", "type": "points", "points": {"positions": np.ones((2, 3), np.float32)}}),
    "an odometry sensor": (RADAR, {"id": "ego", "type": "odometry", "poses": POSES}),
    "a sensor of another type": (RADAR, {"id": "s", "type": "sonar", "poses": POSES}),
    "a sensor without a type": ((*RADAR, "type"), GONE),
    "a sensor without an id": ((*RADAR, "id"), GONE),
    "a float id": ((*RADAR, "id"), 1.5),
    "an id twice": ((*RADAR, "id"), "top"),
    "no poses": ((*LIDAR, "poses"), GONE),
    "empty poses": ((*LIDAR, "poses"), {"timestamps": [], "values": []}),
    "poses of six numbers": ((*LIDAR, "poses", "values"), [[0, 0, 0, 0, 0, 1]] * 2),
    "poses as an array": ((*LIDAR, "poses", "values"), np.array(POSES["values"])),
    "poses with float times": ((*LIDAR, "poses", "timestamps"), [0.0, 100_000.5]),
    "poses that do not increase": ((*LIDAR, "poses", "timestamps"), [100_000, 100_000]),
    "more pose times than poses": ((*LIDAR, "poses", "timestamps"), [0, 100_000, 200_000]),
    "negative pose times": ((*LIDAR, "poses", "timestamps"), [-5, 100_000]),
    "poses that begin late": ((*LIDAR, "poses", "timestamps"), [100_000_001, 100_100_000]),
    "null coordinates": ((*LIDAR, "coordinates"), None),
    "unknown coordinates": ((*LIDAR, "coordinates"), "map"),
    "no frames": ((*LIDAR, "frames"), []),
    "frames at one time": ((*FIRST, "timestamp"), 100_000),
    "a float frame time": ((*FIRST, "timestamp"), 0.5),
    "a negative frame time": ((*FIRST, "timestamp"), -1),
    "too many frames a second": ((*FIRST, "timestamp"), 90_001),
    "no points": ((*FIRST, "points"), GONE),
    "no positions": ((*FIRST, "points", "positions"), GONE),
    "float64 positions": ((*FIRST, "points", "positions"), np.ones((5, 3))),
    "positions as a list": ((*FIRST, "points", "positions"), [[1.0, 2.0, 3.0]]),
    "float intensities": ((*SECOND, "points", "intensities"), np.ones(4, np.float32)),
    "too few intensities": ((*SECOND, "points", "intensities"), np.ones(3, np.uint8)),
    "uint16 colours": ((*SECOND, "points", "colors"), np.ones((4, 3), np.uint16)),
    "too few colours": ((*SECOND, "points", "colors"), np.ones((3, 3), np.uint8)),
    "uint64 point times": ((*SECOND, "points", "timestamps"), np.arange(4, dtype=np.uint64) + 100_000),
    "int64 point times": ((*SECOND, "points", "timestamps"), np.arange(4, dtype=np.int64) + 100_000),
    "too many point times": ((*SECOND, "points", "timestamps"), np.arange(5, dtype=np.uint32) + 100_000),
    "points before their frame": ((*SECOND, "points", "timestamps"), np.arange(4, dtype=np.uint32) + 99_999),
    "no points, with times": ((*SECOND, "points"), NO_POINTS),
    "directions of float64": ((*RADAR, "frames", 0, "points", "directions"), np.ones((3, 3))),
    "too few directions": ((*RADAR, "frames", 0, "points", "directions"), np.ones((2, 3), np.float32)),
    "four radar lengths": ((*RADAR, "frames", 0, "points"), FOUR_LENGTHS),
    "no intrinsics": ((*CAMERA, "intrinsics"), GONE),
    "intrinsics without cy": ((*CAMERA, "intrinsics", "cy"), GONE),
    "a float width": ((*CAMERA, "intrinsics", "width"), 8.5),
    "an unknown camera model": ((*CAMERA, "intrinsics", "distortion", "model"), "kannala-brandt18"),
    "a camera model without numbers": ((*CAMERA, "intrinsics", "distortion", "params"), GONE),
    "neither video nor images": ((*CAMERA, "images"), GONE),
    "images at one time": ((*CAMERA, "images", 1, "timestamp"), 0),
    "images that begin late": ((*CAMERA, "images", 0, "timestamp"), 200_000_000),
    "an image without content": ((*CAMERA, "images", 0, "content"), GONE),
    "an annotation without an id": ((*CAR, "id"), GONE),
    "an annotation without a path": ((*CAR, "path"), GONE),
    "a label that is a number": ((*CAR, "label"), 3),
    "stationary as a number": ((*CAR, "stationary"), 1),
    "cuboids of eight numbers": ((*CAR, "path", "values"), [[1.0] * 8] * 2),
    "cuboids as an array": ((*CAR, "path", "values"), np.ones((2, 9))),
    "a null in a cuboid": ((*CAR, "path", "values"), [[None, *[1.0] * 8]] * 2),
    "more cuboids than times": ((*CAR, "path", "values"), [[1.0] * 9] * 3),
    "float keyframe times": ((*CAR, "path", "timestamps"), [0.5, 1.5]),
    "a float attribute": ((*CAR, "attributes", 0, "values"), ["parked", 3.5]),
    "a null attribute": ((*CAR, "attributes", 0, "values"), ["parked", None]),
    "an attribute without values": ((*CAR, "attributes", 0, "values"), GONE),
    "static null": ((*CAR, "attributes", 0, "static"), None),
    "an activation without durations": ((*CAR, "activations", 0, "durations"), GONE),
    "an activation without a sensor": ((*CAR, "activations", 0, "sensor_id"), GONE),
    "a projection without boxes": ((*CAR, "projections", 0, "boxes"), GONE),
    "a box without its sensor": (("annotations", 1, "sensor_id"), GONE),
    "a line in images": (CAR, shape("polyline_2d")),
    "a point in images": (CAR, shape("point_2d")),
    "a polygon in space": (CAR, shape("polygon")),
    "a point in space": (CAR, shape("point")),
    "a point on the ground": (CAR, shape("point_topdown", stationary=True)),
    "keypoints": (CAR, {"id": "k", "type": "points", "paths": [{"timestamps": [0], "values": [[1, 2, 3]]}]}),
    "a group": (CAR, {"id": "g", "type": "group"}),
    "a link": (CAR, LINK),
    "a camera calibration": (CAR, {"id": "cc", "type": "camera_calibration", "sensor_id": "front", "time_offset": 3}),
    "an annotation of another type": (CAR, {"id": "x", "type": "spline"}),
    "an event without a start": (("annotations", 5, "start"), GONE),
    "an event of a float duration": (("annotations", 5, "duration"), 0.5),
    "labelled points without a label": (("annotations", 6, "label"), GONE),
    "an instance null": (("annotations", 6, "is_instance"), None),
    "labelled points as a list": (("annotations", 6, "labeled_points", 0, "point_ids"), [0, 1]),
    "an adjustment without poses": (("annotations", 7, "poses"), GONE),
    "an adjustment of empty poses": (("annotations", 7, "poses"), {"timestamps": [], "values": []}),
}
"""What is wrong, where, and what stands there: each is refused by the library, at loading or at validating."""

TAKEN = {
    "nothing wrong": (("metadata", "more"), 1),
    "the latest first timestamp": ((*LIDAR, "poses", "timestamps"), [100_000_000, 100_100_000]),
    "the highest rate": ((*FIRST, "timestamp"), 90_000),
    "no offset": (("time_offset",), GONE),
    "a unit by default": (("time_unit",), GONE),
    "an offset of zero": (("time_offset",), 0),
    "points at the frame's time": ((*SECOND, "points", "timestamps"), np.full(4, 100_000, np.uint32)),
    "flat positions": ((*FIRST, "points", "positions"), np.ones(15, np.float32)),
    "an integer pose": ((*LIDAR, "poses", "values"), [[0, 0, 0, 0, 0, 0, 1]] * 2),
    "a camera model without distortion": ((*CAMERA, "intrinsics", "distortion"), None),
    "a list attribute": ((*CAR, "attributes", 0, "values"), ["parked", ["a", "b"]]),
    "a cuboid without keyframes": ((*CAR, "path"), {"timestamps": [], "values": []}),
    "null boxes": ((*CAR, "projections", 0, "boxes"), [None, None]),
    "an unknown field": ((*CAR, "mood"), "glad"),
    "a parent": (("annotations", 3, "parent_id"), "o"),
    "no annotations": (("annotations",), GONE),
    "stationary null": ((*CAR, "stationary"), None),
}
"""What is unusual, and still taken."""


ODD_VALUES = [
    *(None, True, -1, 0, 7, 0.5, 1.0, "", "world", "x", [], [[]], [None], [1], [0.5], ["a"], [[1.0] * 9], {}),
    *({"type": "lidar"}, np.ones(3), np.ones((0, 3), np.float32), np.ones(4, np.uint8), GONE),
]


def locations_of(node, location=()):
    """All locations of a header."""
    if isinstance(node, dict | list):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            yield (*location, key)
            yield from locations_of(value, (*location, key))


def drawn(count=80):
    """Some of all pairs of a location and an odd value."""
    rng = np.random.default_rng(4)
    locations = list(locations_of(a_file()))
    pairs = [(int(rng.integers(len(locations))), int(rng.integers(len(ODD_VALUES)))) for _ in range(count)]
    return {f"drawn {location} {value}": (locations[location], ODD_VALUES[value]) for location, value in pairs}


def injected(location, value):
    """The sound scene with one thing changed."""
    header = a_file()
    node = header
    for key in location[:-1]:
        node = node[key]
    if value is GONE:
        del node[location[-1]]
    else:
        node[location[-1]] = deepcopy(value)
    return header


@pytest.fixture(scope="module")
def verdicts(scale, encode_sfs, tmp_path_factory):
    """What Scale's library says of every file, and where the file is; its interpreter is started once."""
    folder = tmp_path_factory.mktemp("injected")
    paths = {}
    for number, (name, (location, value)) in enumerate({**REFUSED, **TAKEN, **drawn()}.items()):
        paths[name] = str(folder / f"{number}.sfs")
        (folder / f"{number}.sfs").write_bytes(encode_sfs(injected(location, value)))
    (folder / "files.json").write_text(json.dumps(paths))
    stated = scale(JUDGE, folder / "files.json")
    return {name: (stated[name], paths[name]) for name in paths}


RULE_IDS = [rule.id for rule in SCALE_RULES]


def errors_of(path):
    """What the rules of the profile find; images are not looked into, since the library does not either."""
    report = validate(path, profile="scale", frames=False, rules=RULE_IDS)
    return {found.path: found.message for found in report.findings if found.severity == "error"}


@pytest.mark.parametrize("name", [*REFUSED, *TAKEN])
def test_what_the_library_refuses_is_found_at_its_location_and_what_it_takes_passes(verdicts, name):
    verdict, path = verdicts[name]
    assert (verdict == [None, None]) == (name in TAKEN)
    errors = errors_of(path)
    if name in TAKEN:
        assert errors == {}
    else:
        part = format_keys(REFUSED[name][0][:2])
        assert any(location.startswith(part) for location in errors)


def test_odd_values_anywhere_are_found_if_the_library_refuses_them(verdicts):
    """It takes some that the description of the format refuses: a type left out, rows that pandas fills up."""
    refusals = 0
    for name in drawn():
        verdict, path = verdicts[name]
        errors = [f for f in validate(path, profile="scale", frames=False).findings if f.severity == "error"]
        refused = verdict != [None, None]
        refusals += refused
        assert bool(errors) >= refused, (name, verdict)
        assert refused or not errors or any(not finding.rule.startswith("scale-") for finding in errors), name
    assert 20 < refusals < 80
