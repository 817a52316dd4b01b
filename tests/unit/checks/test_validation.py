"""Validation: reports, fixes, profiles, the page about the checks, and injected faults."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.checks import Hit, Rule, all_rules, chosen_rules, validate
from sceneloom.checks.rule import Subject
from sceneloom.checks.validation import catalogue, find_all, findings_of
from sceneloom.errors import OptionError, OutputError, UnknownFormatError
from sceneloom.formats import open_scene
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.scene import (
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    LabeledPoints,
    LabeledPointsAnnotation,
    LazyFrames,
    Severity,
)
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, TrafficSpec, simulate_street

PERIOD, SECOND = 100_000_000, 1_000_000_000
POSE = [0, 0, 0, 0, 0, 0, 1]


def header(**fields):
    """A file with a quaternion that is too long, frames out of order, and a sensor without a type."""
    frames = [{"timestamp": t, "points": {"positions": np.full((3, 3), 1 + t / 1e6, np.float32)}} for t in (100_000, 0)]
    poses = {"timestamps": [0, 100_000], "values": [POSE, [0, 0, 0, 0, 0, 0, 2]]}
    lidar = {"id": "top", "type": "lidar", "poses": poses, "frames": frames}
    return {"version": "1.0", "sensors": [{"id": "x"}, lidar], **fields}


@pytest.fixture
def faulty(tmp_path, encode_sfs):
    path = tmp_path / "faulty.sfs"
    path.write_bytes(encode_sfs(header()))
    return path


@pytest.fixture
def target(tmp_path):
    return tmp_path / "repaired.sfs"


def rules_of(findings):
    return {finding.rule for finding in findings}


def test_a_sound_scene_passes_with_nothing_found(sound):
    report = validate(sound.scene(sound.lidar(), sound.camera(), sound.odometry()), strict=True)
    assert report.passed
    assert [(f.rule, f.path, f.message) for f in report.findings] == []
    assert report.counts == {"error": 0, "warning": 0, "hint": 0}
    assert set(report.rules) == {rule.id for rule in chosen_rules("sfs")}


def test_warnings_count_only_where_the_caller_is_strict(sound):
    scene = sound.scene(sound.lidar(poses=None), sound.odometry())
    assert validate(scene).counts["warning"] == 1
    assert validate(scene).passed
    assert not validate(scene, strict=True).passed


def test_the_worst_comes_first_and_paths_are_those_of_the_file(faulty):
    report = validate(faulty)
    order = [list(Severity).index(finding.severity) for finding in report.findings]
    assert order == sorted(order)
    assert not report.passed
    locations = {(finding.rule, finding.path) for finding in report.findings}
    assert {
        ("fields-valid", "sensors[0].type"),
        ("quaternion-norm", "sensors[1].poses.values[1]"),
        ("frame-times-increasing", "sensors[1].frames[1]"),
    } <= locations


def test_chosen_and_ignored_rules_are_obeyed(faulty):
    assert rules_of(validate(faulty, rules=["quaternion-norm"]).findings) == {"quaternion-norm"}
    assert "quaternion-norm" not in rules_of(validate(faulty, ignore=["quaternion-norm"]).findings)


@pytest.mark.parametrize("options", [{"rules": ["no-such"]}, {"ignore": ["no-such"]}, {"profile": "bs5"}])
def test_unknown_rules_and_profiles_are_refused(sound, options):
    with pytest.raises(OptionError):
        validate(sound.scene(), **options)


def test_an_unknown_path_is_refused(tmp_path):
    with pytest.raises(UnknownFormatError):
        validate(tmp_path / "nothing.sfs")


def test_each_frame_is_read_once_for_all_rules_and_not_at_all_where_not_asked(sound):
    read = []
    lidar = sound.lidar()
    frames = LazyFrames(lidar.frames.timestamps_ns, lambda k: read.append(k) or lidar.frames[k])
    scene = sound.scene(replace(lidar, frames=frames))
    assert validate(scene).frames_read
    assert read == [0, 1, 2, 3, 4, 5]
    assert not validate(scene, frames=False).frames_read
    assert len(read) == 6


def test_progress_counts_frames_of_all_sensors(sound):
    calls = []
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
    everything = validate(scene, rules=["frame-times-unique"], locations=None)
    assert len(everything.findings) == 59


def test_one_location_more_than_the_limit_is_reported_and_not_counted():
    rule = Rule("x", Severity.ERROR, "", "")
    hits = {"x": [Hit(f"a[{k}]", "m") for k in range(4)]}
    assert [f.path for f in findings_of(hits, [rule], locations=3)] == ["a[0]", "a[1]", "a[2]", "a[3]"]
    assert [f.count for f in findings_of(hits, [rule], locations=2)] == [1, 1, 2]


def test_fixing_writes_a_sound_scene_and_says_what_was_done(faulty, target):
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
        assert [
            (warning.code, warning.location) for warning in scene.warnings if warning.code in ("repaired", "at-fault")
        ] == [("at-fault", "sensors[0].type"), ("repaired", "sensors[1].poses.values[1]")]


def test_what_a_fix_leaves_is_not_reported_as_fixed_though_its_location_moves(tmp_path, encode_sfs, target):
    frames = [{"timestamp": t, "points": {"positions": np.ones((1, 3), np.float32)}} for t in (100_000, 0, 0)]
    content = header()
    content["sensors"][1]["frames"] = frames
    path = tmp_path / "faulty.sfs"
    path.write_bytes(encode_sfs(content))
    report = validate(path, fix=target, rules=["frame-times-increasing", "frame-times-unique", "fields-valid"])
    assert rules_of(report.fixed) == {"frame-times-increasing"}
    assert [(f.rule, f.path) for f in report.findings] == [("frame-times-unique", "sensors[0].frames[1]")]


def test_fixing_what_was_fixed_changes_no_byte(faulty, target, tmp_path):
    validate(faulty, fix=target)
    again = tmp_path / "again.sfs"
    report = validate(target, fix=again)
    assert report.fixed == report.left_out == ()
    assert again.read_bytes() == target.read_bytes()


def test_only_the_rules_that_are_run_repair(faulty, target):
    report = validate(faulty, fix=target, ignore=["frame-times-increasing"])
    assert rules_of(report.fixed) == {"quaternion-norm"}
    with sceneloom.open(target) as scene:
        assert scene.sensors[0].frames.timestamps_ns.tolist() == [PERIOD, 0]


def test_a_target_that_exists_is_kept(faulty, target):
    target.write_bytes(b"mine")
    with pytest.raises(OutputError):
        validate(faulty, fix=target)
    assert target.read_bytes() == b"mine"
    assert validate(faulty, fix=target, overwrite=True).output == str(target)


def test_a_file_may_be_repaired_in_its_own_location(faulty):
    assert validate(faulty, fix=faulty, overwrite=True).passed


@pytest.mark.parametrize("fields", [{"version": "2.0"}, {"time_unit": "hours"}, {"time_offset": "yesterday"}])
def test_a_file_whose_meaning_had_to_be_guessed_is_not_written(tmp_path, encode_sfs, target, fields):
    path = tmp_path / "guess.sfs"
    path.write_bytes(encode_sfs(header(**fields)))
    report = validate(path, fix=target)
    assert report.output is None
    assert not report.passed
    assert not target.exists()


def test_a_file_that_cannot_be_read_at_all_gives_one_finding(tmp_path, target):
    path = tmp_path / "torn.sfs"
    path.write_bytes(b'{"version": ')
    report = validate(path, fix=target)
    assert [finding.rule for finding in report.findings] == ["file-readable"]
    assert report.output is None


def test_short_distortions_are_written_in_full(tmp_path, encode_sfs, target):
    path = tmp_path / "short.sfs"
    distortion = {"model": "fisheye", "params": [0.1]}
    camera_model = {"fx": 9.0, "fy": 9.0, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24, "distortion": distortion}
    poses = {"timestamps": [0], "values": [POSE]}
    camera = {"id": "c", "type": "camera", "intrinsics": camera_model, "poses": poses, "images": []}
    path.write_bytes(encode_sfs({"version": "1.0", "sensors": [camera]}))
    report = validate(path, fix=target)
    assert "distortion-length" in rules_of(report.fixed)
    with sceneloom.open(target) as scene:
        assert scene.cameras[0].camera.coefficients == (0.1, 0.0, 0.0, 0.0)


def test_epoch_timestamps_are_repaired_without_moving_anything(tmp_path, encode_sfs, target):
    start_us = 1_700_000_000_000_000
    path = tmp_path / "epoch.sfs"
    lidar = header()["sensors"][1]
    for frame in lidar["frames"]:
        frame["timestamp"] += start_us
    lidar["poses"] = {"timestamps": [start_us], "values": [POSE]}
    path.write_bytes(encode_sfs({"version": "1.0", "sensors": [lidar]}))
    report = validate(path, fix=target)
    assert "epoch-times" in rules_of(report.fixed)
    with sceneloom.open(path) as before, sceneloom.open(target) as after:
        assert after.time_offset_ns == start_us * 1000
        assert sorted(before.sensors[0].frames.timestamps_ns) == list(after.sensors[0].frames.timestamps_ns)


def test_a_recording_can_be_checked_and_fixed(tmp_path, sound):
    folder, repaired = tmp_path / "drive", tmp_path / "drive.sfs"
    sceneloom.write(sound.scene(sound.lidar(), sound.odometry()), folder)
    report = validate(folder, fix=repaired)
    assert report.format == "recording"
    assert report.output == str(repaired)
    assert repaired.exists()


def test_every_rule_has_an_id_of_its_own_and_says_what_to_do():
    rules = all_rules()
    assert len({rule.id for rule in rules}) == len(rules)
    for rule in rules:
        assert rule.id == rule.id.lower().replace("_", "-")
        assert rule.summary.endswith(".")
        assert rule.remedy.endswith(".")
        assert rule.find or rule.look
    assert [row.id for row in catalogue()] == [rule.id for rule in rules]


def test_fixes_leave_a_sound_scene_as_it_is(sound):
    scene = sound.scene(sound.lidar(), sound.camera(), sound.odometry())
    for rule in all_rules():
        if rule.fix is not None:
            fixed = rule.fix(scene)
            assert fixed.sensors == scene.sensors, rule.id
            assert fixed.annotations == scene.annotations, rule.id
            assert find_all(Subject(fixed), [rule]) == {rule.id: []}


REPAIRED = {"annotation-times-increasing", "cuboid-negative-size", "labelled-point-twice", "attribute-static-repeats"}


def test_a_file_with_everything_that_can_be_repaired_is_repaired(sound, tmp_path):
    rows = np.tile([-4.0, 2, 1.5, 1, 2, 0, 0, 0, 30], (3, 1))
    repeated = AttributePath("make", ("vw", "vw"), np.array([0, PERIOD]), static=True)
    annotations = (
        CuboidAnnotation("car", CuboidPath(np.array([PERIOD, 0, PERIOD]), rows), label="car", attributes=(repeated,)),
        LabeledPointsAnnotation("road", (LabeledPoints("top", np.array([7, 7, 3], np.uint32), 0),), label="road"),
    )
    write_scene(sound.scene(annotations=annotations), tmp_path / "drive.sfs")
    before = validate(tmp_path / "drive.sfs")
    assert {f.rule for f in before.findings if f.fixable} == REPAIRED
    report = validate(tmp_path / "drive.sfs", fix=tmp_path / "repaired.sfs")
    assert {finding.rule for finding in report.fixed} == REPAIRED
    assert not {finding.rule for finding in report.findings} & REPAIRED
    with open_scene(tmp_path / "repaired.sfs") as scene:
        car, road = scene.annotations
        assert car.path.timestamps_ns.tolist() == [0, PERIOD]
        assert car.path.values[:, 0].tolist() == [4.0, 4.0]
        assert car.attributes[0].values == ("vw",)
        assert road.labeled_points[0].point_ids.tolist() == [7, 3]


PAGE = Path(__file__).parents[3] / "docs" / "checks.md"


def test_rules_that_the_page_names_for_a_check_of_scales_are_there():
    text = PAGE.read_text("utf-8").split("## What Scale's validator checks")[1].split("\n## ")[0]
    known = {rule.id for rule in catalogue()}
    lines = [line for line in text.splitlines() if line.startswith("| ")][1:]
    cells = [cell for line in lines for cell in line.split("|")[2:4]]
    named = {name.strip("` ") for cell in cells for name in cell.split(",") if "`" in name}
    assert named
    assert named <= known


def test_rules_that_the_page_names_for_recordings_are_there():
    text = PAGE.read_text("utf-8").split("\n## Recordings")[1].split("\n## ")[0]
    known = {rule.id for rule in catalogue()}
    lines = [line for line in text.splitlines() if line.startswith("| ") and "`" in line]
    named = {name for line in lines for name in re.findall(r"`([a-z0-9-]+)`", line.split("|")[3])}
    assert named > {"lines-in-order", "fixes-jump"}
    assert named <= known


START = 1_000_000_000
PERIOD_OF_INJECTED = 100_000_000
BLIND = ((START, START + 2 * PERIOD_OF_INJECTED),)
STUCK = ((START + 4 * PERIOD_OF_INJECTED, START + 7 * PERIOD_OF_INJECTED),)
CAMERA_MODEL = Camera("pinhole", 48, 32, 40.0, 40.0, 23.5, 15.5)


def drive(**faults):
    sensors = {name: SensorFaults(**injected) for name, injected in faults.items()}
    return simulate_street(
        2,
        frames=8,
        lidar=LidarSpec(beams=16, steps=300),
        cameras=(CameraSpec(CAMERA_MODEL),),
        traffic=TrafficSpec(),
        faults=Faults(sensors=sensors) if sensors else None,
    ).scene


def found_in(scene):
    """Rules that found something, with the sensor or part of the scene that they found it in."""
    findings = validate(scene).findings
    usual = {"annotation-beyond-scene"}
    return {(f.rule, f.path.split(".")[0]) for f in findings if f.rule not in usual}


def test_a_clean_drive_has_no_fault():
    assert found_in(drive()) == set()


def test_injected_faults_are_found_where_they_are_and_nowhere_else():
    injected = {"blind": BLIND, "stuck": STUCK}
    scene = drive(lidar={**injected, "intensity_scale": 0.005}, camera0=injected)
    locations = {sensor.id: f"sensors[{k}]" for k, sensor in enumerate(scene.sensors)}
    assert found_in(scene) == {
        ("frame-without-points", locations["lidar"]),
        ("frame-repeated", locations["lidar"]),
        ("intensity-scale", locations["lidar"]),
        ("image-plain", locations["camera0"]),
        ("image-repeated", locations["camera0"]),
    }
