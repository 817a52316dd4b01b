"""Validation: reports, fixes, profiles, the page about the checks, and injected faults."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.checks import Hit, Rule, all_rules, chosen_rules, validate
from sceneloom.checks.rule import Subject
from sceneloom.checks.validation import catalogue, find_all, findings_of
from sceneloom.errors import OptionError, OutputError, UnknownFormatError
from sceneloom.formats import open_scene
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, TrafficSpec, simulate_street

PERIOD, SECOND = 100_000_000, 1_000_000_000
POSE = [0, 0, 0, 0, 0, 0, 1]
PAGE = (Path(__file__).parents[3] / "docs" / "checks.md").read_text("utf-8")


def header(times=(100_000, 0), **fields):
    """A file with a quaternion that is too long, frames out of order, and a sensor without a type."""
    frames = [{"timestamp": t, "points": {"positions": np.full((3, 3), 1 + t / 1e6, np.float32)}} for t in times]
    poses = {"timestamps": [0, 100_000], "values": [POSE, [0, 0, 0, 0, 0, 0, 2]]}
    lidar = {"id": "top", "type": "lidar", "poses": poses, "frames": frames}
    return {"version": "1.0", "sensors": [{"id": "x"}, lidar], **fields}


@pytest.fixture
def write(tmp_path, encode_sfs):
    def run(content):
        (tmp_path / "faulty.sfs").write_bytes(encode_sfs(content))
        return tmp_path / "faulty.sfs"

    return run


@pytest.fixture
def faulty(write):
    return write(header())


@pytest.fixture
def target(tmp_path):
    return tmp_path / "repaired.sfs"


def rules_of(findings):
    return {finding.rule for finding in findings}


def test_a_sound_scene_passes_with_nothing_found_and_is_left_as_it_is_by_all_fixes(sound):
    scene = sound.scene(sound.lidar(), sound.camera(), sound.odometry())
    report = validate(scene, strict=True)
    assert report.passed
    assert [(f.rule, f.path, f.message) for f in report.findings] == []
    assert report.counts == {"error": 0, "warning": 0, "hint": 0}
    assert set(report.rules) == {rule.id for rule in chosen_rules("sfs")}
    for rule in all_rules():
        if rule.fix is not None:
            fixed = rule.fix(scene)
            assert fixed.sensors == scene.sensors, rule.id
            assert fixed.annotations == scene.annotations, rule.id
            assert find_all(Subject(fixed), [rule]) == {rule.id: []}
    # warnings count only where the caller is strict
    scene = sound.scene(sound.lidar(poses=None), sound.odometry())
    reported = [validate(scene, strict=strict) for strict in (False, True)]
    assert [(report.counts["warning"], report.passed) for report in reported] == [(1, True), (1, False)]


def test_the_worst_comes_first_and_chosen_and_ignored_rules_are_obeyed(faulty, sound, tmp_path):
    report = validate(faulty)
    order = [list(sc.Severity).index(finding.severity) for finding in report.findings]
    assert order == sorted(order)
    assert not report.passed
    assert {
        ("fields-valid", "sensors[0].type"),
        ("quaternion-norm", "sensors[1].poses.values[1]"),
        ("frame-times-increasing", "sensors[1].frames[1]"),
    } <= {(finding.rule, finding.path) for finding in report.findings}
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
    assert len(reported.findings) == 21
    assert reported.findings[-1].count == 39
    assert reported.findings[-1].path == "sensors[0].images[21]"
    assert "up to sensors[0].images[59]" in reported.findings[-1].message
    assert reported.counts["error"] == 59
    assert len(validate(scene, rules=["frame-times-unique"], locations=None).findings) == 59
    # one location more than the limit is reported and not counted
    rule, hits = Rule("x", sc.Severity.ERROR, "", ""), {"x": [Hit(f"a[{k}]", "m") for k in range(4)]}
    assert [f.path for f in findings_of(hits, [rule], locations=3)] == ["a[0]", "a[1]", "a[2]", "a[3]"]
    assert [f.count for f in findings_of(hits, [rule], locations=2)] == [1, 1, 2]


def test_fixing_writes_a_sound_scene_says_what_was_done_and_changes_no_byte_again(faulty, target, tmp_path):
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


def test_what_a_fix_leaves_is_not_reported_as_fixed_though_its_location_moves(write, target):
    path = write(header((100_000, 0, 0)))
    report = validate(path, fix=target, rules=["frame-times-increasing", "frame-times-unique", "fields-valid"])
    assert rules_of(report.fixed) == {"frame-times-increasing"}
    assert [(f.rule, f.path) for f in report.findings] == [("frame-times-unique", "sensors[0].frames[1]")]


def test_what_had_to_be_guessed_or_cannot_be_read_at_all_is_not_written(write, target):
    for fields in ({"version": "2.0"}, {"time_unit": "hours"}, {"time_offset": "yesterday"}):
        report = validate(write(header(**fields)), fix=target)
        assert (report.output, report.passed, target.exists()) == (None, False, False)
    path = write({})
    path.write_bytes(b'{"version": ')
    report = validate(path, fix=target)
    assert ([finding.rule for finding in report.findings], report.output) == (["file-readable"], None)


def test_short_distortions_epoch_timestamps_and_recordings_are_written_in_full(write, target, tmp_path, sound):
    size = {"fx": 9.0, "fy": 9.0, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24}
    camera_model = {**size, "distortion": {"model": "fisheye", "params": [0.1]}}
    poses = {"timestamps": [0], "values": [POSE]}
    camera = {"id": "c", "type": "camera", "intrinsics": camera_model, "poses": poses, "images": []}
    report = validate(write({"version": "1.0", "sensors": [camera]}), fix=target)
    assert "distortion-length" in rules_of(report.fixed)
    with sceneloom.open(target) as scene:
        assert scene.cameras[0].camera.coefficients == (0.1, 0.0, 0.0, 0.0)
    # timestamps since 1970 get an offset, and nothing moves
    start_us = 1_700_000_000_000_000
    lidar = header((start_us + 100_000, start_us))["sensors"][1]
    path = write({"version": "1.0", "sensors": [lidar | {"poses": {"timestamps": [start_us], "values": [POSE]}}]})
    report = validate(path, fix=target, overwrite=True)
    assert "epoch-times" in rules_of(report.fixed)
    with sceneloom.open(path) as before, sceneloom.open(target) as after:
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
    with open_scene(tmp_path / "repaired.sfs") as scene:
        car, road = scene.annotations
        assert car.path.timestamps_ns.tolist() == [0, PERIOD]
        assert car.path.values[:, 0].tolist() == [4.0, 4.0]
        assert car.attributes[0].values == ("vw",)
        assert road.labeled_points[0].point_ids.tolist() == [7, 3]


def test_every_rule_has_an_id_of_its_own_and_says_what_to_do():
    rules = all_rules()
    assert len({rule.id for rule in rules}) == len(rules)
    for rule in rules:
        assert rule.id == rule.id.lower().replace("_", "-")
        assert rule.summary.endswith(".")
        assert rule.remedy.endswith(".")
        assert rule.find or rule.look
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
