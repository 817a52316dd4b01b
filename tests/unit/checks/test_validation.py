"""Validation of files: reports, fixes, profiles, the page about the checks, injected faults, and what files break."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.unit.checks.conftest import film

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.checks import Hit, Rule, all_rules, chosen_rules, validate
from sceneloom.checks.faults import FAULT_RULES
from sceneloom.checks.rule import Subject
from sceneloom.checks.validation import catalogue, find_all, findings_of
from sceneloom.errors import DataError, OptionError, OutputError, UnknownFormatError
from sceneloom.formats.sfs.reader import copied, parse_path
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, TrafficSpec, simulate_street

PERIOD, SECOND = 100_000_000, 1_000_000_000
POSE = [0, 0, 0, 0, 0, 0, 1]
PAGE = (Path(__file__).parents[3] / "docs" / "checks.md").read_text("utf-8")


def faulty_header(times=(100_000, 0), **fields):
    """A file with a quaternion that is too long, frames out of order, and a sensor without a type."""
    frames = [{"timestamp": t, "points": {"positions": np.full((3, 3), 1 + t / 1e6, np.float32)}} for t in times]
    poses = {"timestamps": [0, 100_000], "values": [POSE, [0, 0, 0, 0, 0, 0, 2]]}
    return header({"id": "x"}, lidar(poses=poses, frames=frames), **fields)


@pytest.fixture
def faulty(file):
    return file(faulty_header())


def rules_of(findings):
    return {finding.rule for finding in findings}


def test_a_sound_scene_passes_with_nothing_found_and_is_left_as_it_is_by_all_fixes(sound):
    scene = sound.scene(sound.lidar(), sound.camera(), sound.odometry())
    report = validate(scene, strict=True)
    assert [(f.rule, f.path, f.message) for f in report.findings] == []
    assert (report.passed, report.counts) == (True, {"error": 0, "warning": 0, "hint": 0})
    assert set(report.rules) == {rule.id for rule in chosen_rules("sfs")}
    for rule in all_rules():
        if rule.fix is not None:
            fixed = rule.fix(scene)
            assert (fixed.sensors, fixed.annotations) == (scene.sensors, scene.annotations), rule.id
            assert find_all(Subject(fixed), [rule]) == {rule.id: []}
    # warnings count only where the caller is strict
    scene = sound.scene(sound.lidar(poses=None), sound.odometry())
    reported = [validate(scene, strict=strict) for strict in (False, True)]
    assert [(report.counts["warning"], report.passed) for report in reported] == [(1, True), (1, False)]


def test_the_worst_comes_first_and_chosen_and_ignored_rules_are_obeyed(faulty, sound, tmp_path):
    report = validate(faulty)
    order = [list(sc.Severity).index(finding.severity) for finding in report.findings]
    assert (order, report.passed) == (sorted(order), False)
    where = {"fields-valid": "sensors[0].type", "quaternion-norm": "sensors[1].poses.values[1]"}
    where["frame-times-increasing"] = "sensors[1].frames[1]"
    assert where.items() <= {(finding.rule, finding.path) for finding in report.findings}
    assert rules_of(validate(faulty, rules=["quaternion-norm"]).findings) == {"quaternion-norm"}
    assert "quaternion-norm" not in rules_of(validate(faulty, ignore=["quaternion-norm"]).findings)
    for options in ({"rules": ["no-such"]}, {"ignore": ["no-such"]}, {"profile": "bs5"}):
        with pytest.raises(OptionError):
            validate(sound.scene(), **options)
    with pytest.raises(UnknownFormatError):
        validate(tmp_path / "nothing.sfs")


def test_each_frame_is_read_once_for_all_rules_and_not_at_all_where_not_asked(sound):
    read, calls = [], []
    lidar = sound.lidar()
    frames = sc.LazyFrames(lidar.frames.timestamps_ns, lambda k: read.append(k) or lidar.frames[k])
    scene = sound.scene(replace(lidar, frames=frames))
    assert validate(scene).frames_read
    assert read == [0, 1, 2, 3, 4, 5]
    assert not validate(scene, frames=False).frames_read
    assert len(read) == 6
    validate(sound.scene(), progress=lambda done, total: calls.append((done, total)))
    assert calls == [(k, 12) for k in range(1, 13)]


def test_of_many_locations_the_first_are_reported_and_the_others_counted(sound):
    scene = sound.scene(sound.camera(np.zeros(60, np.int64)))
    reported = validate(scene, rules=["frame-times-unique"])
    last = reported.findings[-1]
    assert (len(reported.findings), last.count, last.path) == (21, 39, "sensors[0].images[21]")
    assert ("up to sensors[0].images[59]" in last.message, reported.counts["error"]) == (True, 59)
    assert len(validate(scene, rules=["frame-times-unique"], locations=None).findings) == 59
    # one location more than the limit is reported and not counted
    rule, hits = Rule("x", sc.Severity.ERROR, "", ""), {"x": [Hit(f"a[{k}]", "m") for k in range(4)]}
    assert [f.path for f in findings_of(hits, [rule], locations=3)] == ["a[0]", "a[1]", "a[2]", "a[3]"]
    assert [f.count for f in findings_of(hits, [rule], locations=2)] == [1, 1, 2]


def test_fixing_writes_a_sound_scene_says_what_was_done_and_changes_no_byte_again(faulty, tmp_path):
    target = tmp_path / "repaired.sfs"
    report = validate(faulty, fix=target)
    assert report.output == str(target)
    assert rules_of(report.fixed) == {"quaternion-norm", "frame-times-increasing"}
    assert [finding.path for finding in report.left_out] == ["sensors[0].type"]
    assert report.passed
    with sceneloom.open(target) as scene:
        [lidar] = scene.sensors
        assert lidar.frames.timestamps_ns.tolist() == [0, PERIOD]
        assert [float(frame.points.positions[0, 0]) for frame in lidar.frames] == [1.0, pytest.approx(1.1)]
        assert lidar.poses.quaternions_xyzw.tolist() == [[0, 0, 0, 1]] * 2
        notes = [(w.code, w.location) for w in scene.warnings if w.code in ("repaired", "at-fault")]
        assert notes == [("at-fault", "sensors[0].type"), ("repaired", "sensors[1].poses.values[1]")]
    again = validate(target, fix=tmp_path / "again.sfs")
    assert again.fixed == again.left_out == ()
    assert (tmp_path / "again.sfs").read_bytes() == target.read_bytes()
    # only the rules that are run repair; a target that exists is kept, and a file may be repaired in its own location
    with pytest.raises(OutputError):
        validate(faulty, fix=target)
    report = validate(faulty, fix=target, ignore=["frame-times-increasing"], overwrite=True)
    assert (rules_of(report.fixed), report.output) == ({"quaternion-norm"}, str(target))
    with sceneloom.open(target) as scene:
        assert scene.sensors[0].frames.timestamps_ns.tolist() == [PERIOD, 0]
    assert validate(faulty, fix=faulty, overwrite=True).passed


def test_what_a_fix_leaves_is_not_reported_as_fixed_and_what_was_guessed_or_unreadable_not_written(file, tmp_path):
    target = tmp_path / "repaired.sfs"
    for fields in ({"version": "2.0"}, {"time_unit": "hours"}, {"time_offset": "yesterday"}):
        report = validate(file(faulty_header(**fields)), fix=target)
        assert (report.output, report.passed, target.exists()) == (None, False, False)
    report = validate(file(b'{"version": '), fix=target)
    assert ([finding.rule for finding in report.findings], report.output) == (["file-readable"], None)
    # the location of what is left moves
    path = file(faulty_header((100_000, 0, 0)))
    report = validate(path, fix=target, rules=["frame-times-increasing", "frame-times-unique", "fields-valid"])
    assert rules_of(report.fixed) == {"frame-times-increasing"}
    assert [(f.rule, f.path) for f in report.findings] == [("frame-times-unique", "sensors[0].frames[1]")]


def test_short_distortions_epoch_timestamps_and_recordings_are_written_in_full(file, tmp_path, sound):
    target = tmp_path / "repaired.sfs"
    size = {"fx": 9.0, "fy": 9.0, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24}
    camera_model = {**size, "distortion": {"model": "fisheye", "params": [0.1]}}
    camera = {"id": "c", "type": "camera", "intrinsics": camera_model, "poses": path(*POSE), "images": []}
    report = validate(file(header(camera)), fix=target)
    assert "distortion-length" in rules_of(report.fixed)
    with sceneloom.open(target) as scene:
        assert scene.cameras[0].camera.coefficients == (0.1, 0.0, 0.0, 0.0)
    # timestamps since 1970 get an offset, and nothing moves
    start_us = 1_700_000_000_000_000
    late = faulty_header((start_us + 100_000, start_us))["sensors"][1]
    written = file(header(late | {"poses": {"timestamps": [start_us], "values": [POSE]}}))
    report = validate(written, fix=target, overwrite=True)
    assert "epoch-times" in rules_of(report.fixed)
    with sceneloom.open(written) as before, sceneloom.open(target) as after:
        assert after.time_offset_ns == start_us * 1000
        assert sorted(before.sensors[0].frames.timestamps_ns) == list(after.sensors[0].frames.timestamps_ns)
    sceneloom.write(sound.scene(sound.lidar(), sound.odometry()), tmp_path / "drive")
    report = validate(tmp_path / "drive", fix=tmp_path / "drive.sfs")
    assert (report.format, report.output) == ("recording", str(tmp_path / "drive.sfs"))
    assert (tmp_path / "drive.sfs").exists()


REPAIRED = {"annotation-times-increasing", "cuboid-negative-size", "labelled-point-twice", "attribute-static-repeats"}


def test_a_file_with_everything_that_can_be_repaired_is_repaired(sound, tmp_path):
    rows = np.tile([-4.0, 2, 1.5, 1, 2, 0, 0, 0, 30], (3, 1))
    repeated = sc.AttributePath("make", ("vw", "vw"), np.array([0, PERIOD]), static=True)
    annotations = (
        sc.CuboidAnnotation(
            "car", sc.CuboidPath(np.array([PERIOD, 0, PERIOD]), rows), label="car", attributes=(repeated,)
        ),
        sc.LabeledPointsAnnotation("road", (sc.LabeledPoints("top", np.array([7, 7, 3], np.uint32), 0),), label="road"),
    )
    write_scene(sound.scene(*annotations), tmp_path / "drive.sfs")
    before = validate(tmp_path / "drive.sfs")
    assert {f.rule for f in before.findings if f.fixable} == REPAIRED
    report = validate(tmp_path / "drive.sfs", fix=tmp_path / "repaired.sfs")
    assert rules_of(report.fixed) == REPAIRED
    assert not rules_of(report.findings) & REPAIRED
    with sceneloom.open(tmp_path / "repaired.sfs") as scene:
        car, road = scene.annotations
        assert (car.path.timestamps_ns.tolist(), car.path.values[:, 0].tolist()) == ([0, PERIOD], [4.0, 4.0])
        assert (car.attributes[0].values, road.labeled_points[0].point_ids.tolist()) == (("vw",), [7, 3])


def test_every_rule_has_an_id_of_its_own_and_says_what_to_do():
    rules = all_rules()
    assert len({rule.id for rule in rules}) == len(rules)
    for rule in rules:
        assert rule.id == rule.id.lower().replace("_", "-")
        assert (rule.summary[-1], rule.remedy[-1], bool(rule.find or rule.look)) == (".", ".", True), rule.id
    assert [row.id for row in catalogue()] == [rule.id for rule in rules]
    # those that the page names are there
    for section, cells, some in (
        ("What Scale's validator checks", slice(2, 4), set()),
        ("Recordings", slice(3, 4), {"lines-in-order", "fixes-jump"}),
    ):
        text = PAGE.split(f"\n## {section}")[1].split("\n## ")[0]
        rows = [line.split("|")[cells] for line in text.splitlines() if line.startswith("| ")][1:]
        named = {name for row in rows for cell in row for name in re.findall(r"`([a-z0-9-]+)`", cell)}
        assert some < named <= {rule.id for rule in rules}


def drive(**faults):
    return simulate_street(
        2,
        frames=8,
        lidar=LidarSpec(beams=16, steps=300),
        cameras=(CameraSpec(Camera("pinhole", 48, 32, 40.0, 40.0, 23.5, 15.5)),),
        traffic=TrafficSpec(),
        faults=Faults(sensors={k: SensorFaults(**v) for k, v in faults.items()}) if faults else None,
    ).scene


def found_in(scene):
    """Rules that found something, with the sensor or part of the scene that they found it in."""
    usual = {"annotation-beyond-scene"}
    return {(f.rule, f.path.split(".")[0]) for f in validate(scene).findings if f.rule not in usual}


def test_injected_faults_are_found_where_they_are_and_nowhere_else():
    assert found_in(drive()) == set()
    blind = (SECOND, SECOND + 2 * PERIOD)
    injected = {"blind": (blind,), "stuck": ((SECOND + 4 * PERIOD, SECOND + 7 * PERIOD),)}
    scene = drive(lidar={**injected, "intensity_scale": 0.005}, camera0=injected)
    rules = {
        "lidar": ("frame-without-points", "frame-repeated", "intensity-scale"),
        "camera0": ("image-plain", "image-repeated"),
    }
    locations = {sensor.id: f"sensors[{k}]" for k, sensor in enumerate(scene.sensors)}
    assert found_in(scene) == {(rule, locations[name]) for name, of_sensor in rules.items() for rule in of_sensor}


RULES = [rule.id for rule in all_rules() if rule.id.startswith("scale-")]
ONE = np.ones((1, 3), np.float32)


def everything(sound):
    """A scene with what Scale's library refuses in it, at today's date."""
    late = 1_700_000_000 * SECOND

    def moved(sensor):
        times = sensor.frames.timestamps_ns + late
        frames = [sound.sweep(int(t)) for t in times]
        return replace(sensor, frames=sc.LazyFrames.of(frames, times), poses=sound.path(times))

    radar = sc.RadarFrame(late, sc.RadarPoints(ONE, ONE, np.ones(1, np.float32)))
    path = sound.path(sound.times() + late)
    attributes = (
        sc.AttributePath("speed", (1.5,), np.array([late])),
        sc.AttributePath("make", ("vw", "vw"), np.array([late, late + 1000]), static=True),
    )
    row = np.array([[4.0, 2, 1.5, 1, 2, 0, 0, 0, 30]])
    cuboid = sc.CuboidAnnotation("car", sc.CuboidPath(np.array([late]), row), label="car", attributes=attributes)
    return sound.scene(
        moved(sound.lidar()),
        sc.RadarSensor("radar", sc.LazyFrames.of([radar], [late]), path),
        replace(sound.odometry(), poses=path),
        sc.PointsSensor("map", ONE),
        cuboid,
        sc.GroupAnnotation("all"),
    )


def test_what_the_text_alone_allows_is_found_where_the_profile_asks_for_it(sound, tmp_path, encode_sfs):
    def findings(source):
        return {(finding.rule, finding.path) for finding in validate(source, profile="scale", rules=RULES).findings}

    scene, ours, text = everything(sound), tmp_path / "scale.sfs", tmp_path / "text.sfs"
    write_scene(scene, ours, profile="scale")
    write_scene(scene, text, time_unit="nanoseconds")
    kinds = ("annotation-type", "field", "points", "radar-lengths", "scene", "sensor-type", "static-attribute")
    assert {rule for rule, _ in findings(text)} == {f"scale-{kind}" for kind in kinds}
    assert not set(validate(text).rules) & set(RULES)
    # nor is a scene that is no file of the format refused anything
    assert findings(ours) == findings(scene) == set()
    # what the library drops in silence is reported
    text.write_bytes(encode_sfs(header(lidar(coordinates="ego", parent_id="rack"))))
    assert findings(text) == {("scale-dropped", f"sensors[0].{field}") for field in ("coordinates", "parent_id")}


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


def test_what_cannot_be_read_is_a_finding_and_the_rest_is_checked_without(tmp_path, file, sound, found):
    def frame(k):
        if k:
            raise DataError("drive", f"frames[{k}]", "is torn")
        return sound.sweep(0)

    cut = file(header(), cut=20)
    assert [where for where, _ in found(cut, "arrays-whole")] == ["sensors[0].frames[0].points.positions ($items[0])"]
    scene = sound.scene(sc.LidarSensor("top", sc.LazyFrames(sound.times(3), frame), poses=sound.path()))
    torn = [(f"sensors[0].frames[{k}]", f"drive: frames[{k}]: is torn") for k in (1, 2)]
    assert found(scene, "frame-readable") == torn
    assert found(scene, "frame-readable", frames=False) == found(sound.scene(), "frame-readable") == []
    folder = tmp_path / "drive"
    sceneloom.write(sound.scene(sound.lidar(), sound.odometry()), folder)
    lines = (folder / "data.jsonl").read_text("utf-8").splitlines()
    (folder / "data.jsonl").write_text("\n".join([lines[0], "{torn", *lines[1:]]), "utf-8")
    [(location, message)] = found(folder, "broken-lines")
    assert (location, "{torn" in message) == ("data.jsonl: line 2", True)
    assert found(folder, "file-readable") == found(folder, "sensor-empty") == []


def test_notes_of_readers_are_hints_and_those_of_when_a_file_was_made_are_not_repeated(sound, file, tmp_path, found):
    for kind in sc.WarningKind:
        note = sc.DataWarning(kind=kind, code="lines-sorted", location="data.jsonl", message="so", count=3)
        elsewhere = sc.DataWarning(kind=kind, code="no-poses", location="sensors[0]", message="none")
        assert found(sound.scene(warnings=(note, elsewhere)), f"reading-{kind}") == [("data.jsonl", "so")]
        assert found(sound.scene(), f"reading-{kind}") == []
    made, written = file(header()), tmp_path / "written.sfs"
    assert [where for where, _ in found(made, "reading-assumed")] == ["sensors[0]"]
    with sceneloom.open(made) as scene:
        sceneloom.write(scene, written)
    with sceneloom.open(written) as scene:
        assert scene.warnings
    assert found(written, "reading-assumed") == []


def whole():
    """A scene with every type of sensor and annotation of the description."""
    cloud = {"positions": np.ones((2, 3), np.float32)}
    sweeps = {"poses": POSES, "frames": [{"timestamp": 0, "points": cloud}]}
    fisheye = {**CAMERA_MODEL, "distortion": {"model": "fisheye", "params": [0.1, 0, 0, 0]}}
    camera = {"type": "camera", "poses": POSES}
    video = {"timestamps": [0], "content": np.frombuffer(film(16, 16, 0.0), np.uint8), "fps": 10}
    triangle = (0, 0, 0, 1, 0, 0, 1, 1, 0)
    labeled = {"sensor_id": "top", "sensor_frame": 0, "point_ids": np.zeros(1, np.uint32)}
    sensors = [
        {"id": "map", "type": "points", "points": cloud},
        {"id": "top", "type": "lidar", **sweeps},
        {"id": "front", "type": "radar", **sweeps},
        {"id": "cam", **camera, "intrinsics": fisheye, "images": [{"timestamp": 0, "content": np.zeros(9, np.uint8)}]},
        {**camera, "id": "film", "intrinsics": CAMERA_MODEL, "video": video},
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


def test_attributes_of_the_scene_parts_named_twice_and_units_that_are_written_back(tmp_path, file, hits, decode_sfs):
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
    # the unit of time is written back as it was read, and attributes without times and unseen points are kept
    for unit in ("nanosecond", "microsecond", NANO, MICRO):
        dtype = np.uint64 if unit.startswith("nano") else np.uint32
        again, asked = tmp_path / f"{unit}.sfs", tmp_path / f"asked {unit}.sfs"
        with sceneloom.open(file(header(timed_lidar(dtype), time_unit=unit))) as opened:
            sceneloom.write(opened, again)
            sceneloom.write(opened, asked, time_unit=NANO)
        assert [decode_sfs(path.read_bytes())["time_unit"] for path in (again, asked)] == [unit, NANO]
    empty = {"name": "colour", "timestamps": [], "values": []}
    hand = keypoints([], ["top"], paths=2, stationary=True, attributes=[empty])
    written = file(header(annotations=[hand], attributes=[empty]))
    sceneloom.convert(written, tmp_path / "whole.sfs")
    with sceneloom.open(written) as opened:
        part = sceneloom.crop_scene(opened, stop=0.5)
    assert [one.name for one in (*part.attributes, *part.annotations[0].attributes)] == ["colour"] * 2


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

    # triples are not taken for pairs, and rows that fit both are questioned beside pairs
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
