"""The verbs: their results for people and for machines, and what they refuse."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from tests.unit.cli.conftest import small_drive

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.cli.info import mounting_text
from sceneloom.cli.printing import Printer, seconds
from sceneloom.formats import FORMATS
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels import cache
from sceneloom.pipeline import installation
from sceneloom.pipeline.installation import Finding, InstallationReport, Status
from sceneloom.scene import CameraSensor, ImuSensor, LazyFrames, LidarSensor, Scene, Trajectory, VectorSamples
from sceneloom.scene.ego import ego_axes
from sceneloom.scene.scene import time_span
from sceneloom.simulate import LidarSpec, simulate_street
from sceneloom.version import __version__


def test_info_names_every_sensor_counts_what_is_there_and_states_the_first_time_to_the_nanosecond(
    call, refuses, succeeds, reported, recording, tmp_path
):
    outcome = succeeds("info", recording)
    for word in ("lidar", "camera0", "imu", "gnss", "groundTruth", "10 Hz", "pinhole 96x64"):
        assert word in outcome.out
    summary = reported("info", recording)
    counts = {sensor["id"]: sensor["count"] for sensor in summary["sensors"]}
    assert (counts["lidar"], counts["camera0"], summary["format"]) == (3, 3, "recording")
    size = sum(p.stat().st_size for p in recording.rglob("*") if p.is_file())
    assert summary["size_bytes"] == reported("info", recording / "data.jsonl")["size_bytes"] == size
    folder = shutil.copytree(recording, tmp_path / "drive")
    fix = {"latitude": 60.0, "longitude": 25.0, "altitude": 1.0, "accuracy": 1.0}
    lines = [json.dumps({"time": -0.25, "gps": fix}), (folder / "data.jsonl").read_text()]
    (folder / "data.jsonl").write_text("\n".join(lines))
    assert "clock starts at -0.250000000 s" in call("info", folder).out
    # seconds as float64 are off by 50 ns at such a time
    assert seconds(1_700_000_000_800_000_000) == "1700000000.800000000 s"
    refuses(2, "--visualize", "info", recording, "--at", "1")
    drawn = reported("info", folder, "--visualize", tmp_path / "look")["images"]
    assert sorted(map(Path, drawn)) == sorted((tmp_path / "look").iterdir())
    assert call("info", folder, "--visualize", tmp_path / "look").code == 1  # they are there already


def test_fuse_writes_and_reports(call, reported, recording, tmp_path):
    report = reported("fuse", recording, "-o", tmp_path / "d.sfs", "--depth", tmp_path / "depth")
    others = (("convert", recording, tmp_path / "c.sfs"), ("validate", recording), ("report", recording, "--quick"))
    timed = zip(("fusing", "writing", "checking", "fusion"), [report, *(reported(*o) for o in others)], strict=True)
    for stage, found in timed:  # it reports where the time went
        assert {"opening", stage} <= found["stages"].keys()
        assert min(found["stages"].values()) >= 0.0
    assert (report["fused"], report["trajectory"], report["files"]) == (3, "groundTruth", {"depth images": 3})
    assert report["losses"]["losses"]
    assert (tmp_path / "d.sfs").is_file()
    outcome = call("fuse", recording, "-o", tmp_path / "e.sfs", "--verbose")
    assert "fused 3 of 3 sweeps by trajectory groundTruth" in outcome.out
    assert f"wrote {tmp_path / 'e.sfs'}, " in outcome.out
    assert {note.split(":")[0] for note in outcome.err.splitlines() if "sensors[imu]" in note} == {"kept aside"}
    assert call("fuse", recording, "-o", tmp_path / "f.sfs", "--quiet").err == ""
    assert "fused 1 of 1 sweep by" in call("fuse", recording, "-o", tmp_path / "g.sfs", "--stop", "0.25").out


def test_demo_keeps_a_recording_a_scene_and_images(refuses, succeeds, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneloom.simulate.drive.demo_drive", small_drive)
    (tmp_path / "other" / "images").mkdir(parents=True)
    (tmp_path / "other" / "images" / "mine.png").write_text("mine")
    refuses(1, "--overwrite", "demo --keep", tmp_path / "other", "--frames", "2")
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["images"]
    outcome = succeeds("demo --keep", tmp_path / "kept", "--frames", "2")
    kept = {path.name for path in (tmp_path / "kept").iterdir()}
    assert kept == {"drive", "drive.sfs", "depth", "images", "first_image.png"}
    assert "sceneloom info" in outcome.out
    shown = next(line.split()[2] for line in outcome.out.splitlines() if line.startswith("look at "))
    assert Path(shown).is_file()
    assert "notes on what these files cannot hold of the drive" in outcome.err
    refuses(1, "--overwrite", "demo --keep", tmp_path / "kept", "--frames", "2")


def test_only_the_first_skipped_frames_are_listed(call, succeeds, recording, tmp_path):
    folder = shutil.copytree(recording, tmp_path / "drive")
    for image in (folder / "frames1").iterdir():
        image.write_bytes(image.read_bytes()[:120])
    arguments = ("fuse", folder, "-o", tmp_path / "d.sfs", "--lenient", "--overwrite")
    outcome = succeeds(*arguments)
    assert "3 sweeps or images skipped" in outcome.out
    assert "00000000.png" in outcome.err
    assert "(and 2 like it, to 00000002)" in outcome.err
    assert "skipped: " not in call(*arguments, "--quiet").err


@pytest.mark.slow
def test_a_terminal_that_knows_few_characters_gets_them_escaped(recording, tmp_path):
    start = "from sceneloom.cli import main; main()"
    command = [sys.executable, "-c", start, "convert", recording, tmp_path / "a.sfs"]
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252"}
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert b"\\u2192" in done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="only there names of files may be any bytes")
def test_a_folder_whose_name_is_no_unicode_is_fused_and_may_hold_what_shows_it(reported, succeeds, recording, tmp_path):
    folder = shutil.copytree(recording, tmp_path / os.fsdecode(b"dr\xffive"))
    assert reported("info", folder)["source"] == str(folder)
    succeeds("fuse", folder, "--visualize", folder / "look", "-o", folder / "fused.sfs")
    succeeds("info", folder)


URL = "https://127.0.0.1:9/b.sfs"
OPENING = "opening a recording takes --lenient, --altitude, --camera-shift, --image-index"
SCENE_FILES = "writing a scene file takes --profile, --time-unit"
TRAJECTORIES = "writing a trajectory takes --to-optical, --origin"
NOT_HERE = "{} does not count here: {}\n".format
RERUN = ("rerun", "rerun-sdk is not installed: pip install 'sceneloom[view]'")


@pytest.mark.parametrize(
    ("code", "problem", "words"),
    [
        (1, "inside the recording", "convert DRIVE DRIVE/again"),
        (1, "inside the recording", "validate DRIVE --quick --fix DRIVE/repaired"),
        (1, "inside the recording", "sync DRIVE --apply DRIVE/in-step"),
        (1, "inside the recording", "edit crop DRIVE -o DRIVE/cropped --start 0"),
        (1, "inside the recording", "edit deskew DRIVE -o DRIVE/deskewed"),
        (2, "standard output", "convert DRIVE -"),
        (2, "standard output", "fuse DRIVE -o -"),
        (2, "standard output", "info DRIVE --visualize -"),
        (2, "standard output", "validate DRIVE --fix -"),
        (2, "standard output", "edit crop DRIVE -o - --start 0"),
        (2, "d.txt: fusing writes scene files; expected a name that ends in .sfs", "fuse DRIVE -o d.txt"),
        (2, "nothing to write", "fuse DRIVE"),
        (2, "without --depth DIR", "fuse DRIVE -o d.sfs --depth-format npz"),
        (2, "without --visualize DIR", "fuse DRIVE -o d.sfs --visualize-every 2"),
        (
            2,
            NOT_HERE("--origin", "writing a scene file takes --profile, --time-unit"),
            "convert DRIVE a.sfs --origin 1 2 3",
        ),
        (2, NOT_HERE("--profile", "writing a recording takes --images"), "convert DRIVE a --profile scale"),
        (
            2,
            NOT_HERE("--images", "writing a trajectory takes --to-optical, --origin"),
            "convert DRIVE a.tum --images png",
        ),
        (2, NOT_HERE("--from-rate", OPENING), "convert DRIVE a.sfs --from-rate 10"),
        (2, "nothing to write", "colour DRIVE"),
        (2, "expected one of .las .laz .ply .pcd", "colour DRIVE -o map.xyz"),
        (2, "expected a number above 0", "colour DRIVE -o map.las --voxel 0"),
        (2, "--project-labels", "colour DRIVE -o map.las --label-radius 2"),
        (1, "no such folder", "colour DRIVE -o map.las --labels nowhere"),
        (1, "no labelled points", "colour DRIVE --project-labels back"),
        (2, "one of them", "view DRIVE --save d.rrd --web"),
        (2, ".rrd", "view DRIVE --save d.txt"),
        (2, "nobody", "view DRIVE --save d.rrd --sensors nobody"),
        (2, "nowhere", "view DRIVE --save d.rrd --trajectory nowhere"),
        (2, "no frame", "view DRIVE --save d.rrd --start 99"),
        (2, f"{URL} is a URL", f"convert a.sfs {URL}"),
        (2, f"{URL} is a URL", f"fuse a.sfs -o {URL}"),
        (2, f"{URL} is a URL", f"edit crop a.sfs -o {URL}"),
        (2, f"{URL} is a URL", f"salvage a.sfs -o {URL}"),
        (2, f"{URL} is a URL", f"validate a.sfs --fix {URL}"),
        (2, f"{URL} is a URL", f"demo --keep {URL}"),
        (1, f"{URL}: cannot be found", f"diff {URL} a.sfs"),
        (1, f"{URL}: is behind a URL", f"salvage {URL} -o c.sfs"),
        (2, "it needs --type detection", "fuse DRIVE -o out.sfs --boxes3d nothere.tum"),
        (1, "nothere", "track DRIVE -o out.sfs --boxes3d nothere.tum"),
        (1, "nothere", "track DRIVE -o out.sfs --boxes2d nothere.tum"),
        (1, "nothere", "colour DRIVE -o out.sfs --labels nothere.tum"),
        (2, "--from-times", "convert DRIVE out.sfs --from-times nothere.tum"),
        (1, "nothere", "report DRIVE --quick -o out.html --losses nothere.tum"),
        (1, "nothere", "report DRIVE --quick -o out.html --truth nothere.tum"),
        (1, "nothere", "edit blur DRIVE -o out.sfs --boxes nothere.tum"),
        (2, "nothere", "eval trajectory DRIVE DRIVE --est-times nothere.tum"),
        (2, "nothere", "eval trajectory DRIVE DRIVE --ref-times nothere.tum"),
        (2, "--boxes2d", "calibrate DRIVE --boxes2d nothere.tum"),
        (2, "nothere", "view DRIVE --save out.rrd --detections nothere.tum"),
        (1, "nothere", "formats --template out.toml --from nothere.tum"),
        (2, "--tolerance-m': -1; expected 0 or more", "edit simplify DRIVE -o out.sfs --tolerance-m -1"),
        (2, "none", "edit project DRIVE -o out.sfs --camera none"),
        (2, "none", "edit count DRIVE -o out.sfs --lidar none"),
        (2, "expected six numbers", "edit crop DRIVE -o out.sfs --box 1,2,3"),
        (2, "each minimum at most", "edit crop DRIVE -o out.sfs --box=5,0,0,-5,9,9"),
        (2, "expected boxes", "edit blur DRIVE -o out.sfs"),
        (2, "no box or outline in an image with label 'face'", "edit blur DRIVE -o out.sfs --label face"),
        (2, "expected width x height in pixels", "edit undistort DRIVE -o out.sfs --size 48"),
        (2, "no sensor 'camera9'", "edit undistort DRIVE -o out.sfs --camera camera9"),
    ],
)
def test_what_cannot_be_done_is_one_clear_error(refuses, recording, tmp_path, monkeypatch, code, problem, words):
    if words.startswith("view"):
        pytest.importorskip(RERUN[0], reason=RERUN[1])
    monkeypatch.setattr("sceneloom.formats.remote.stores.time.sleep", lambda _: None)
    monkeypatch.chdir(tmp_path)
    before = sorted(recording.rglob("*"))
    outcome = refuses(code, problem, *(word.replace("DRIVE", str(recording)) for word in words.split()))
    assert "Traceback" not in outcome.err
    assert (sorted(recording.rglob("*")), list(tmp_path.iterdir())) == (before, [])


def test_notes_that_differ_in_numbers_are_one_and_what_is_lost_comes_first(capsys):
    lines = [f"skipped: image_02/{k:06}.png: is missing" for k in range(13, 96)]
    Printer().notes([*lines, "assumed: 2 units", "assumed: 3 units"])
    folded = "skipped: image_02/000013.png: is missing (and 82 like it, to 000095)\n"
    assert capsys.readouterr().err == f"{folded}assumed: 2 units\nassumed: 3 units\n"
    Printer(verbose=True).notes(lines)
    assert capsys.readouterr().err.splitlines() == lines
    supports = {"kept": Support.KEPT, "converted": Support.CONVERTED, "approximated": Support.APPROXIMATED}
    losses = [Loss(field=name, what="so", support=support) for name, support in supports.items()]
    Printer().losses([*losses, Loss(field="aside", what="so", kept="metadata"), Loss(field="gone", what="so")])
    words = [line.partition(":")[0] for line in capsys.readouterr().err.splitlines()]
    assert words == ["lost", "approximated", "kept aside", "converted", "note"]


CAMERA_MODEL = Camera("pinhole", 8, 6, 6.0, 6.0, 3.5, 2.5)
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: the optical frame's right, down and forward on an ego of x ahead, y left, z up."""


def mount(rotation):
    return RigidTransform.from_quaternion(np.array([1.5, -0.25, 2.0]), Rotation.from_matrix(rotation).as_quat())


def camera(rotation):
    return CameraSensor("c", LazyFrames.of([], []), CAMERA_MODEL, mount=mount(rotation))


def test_sensors_are_known_by_where_they_look_and_how_they_are_rotated():
    looks = {0: "ahead", 50: "ahead left", 90: "left", -90: "right", 180: "back", -140: "back right"}
    for yaw_deg, words in looks.items():
        rotated = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ OPTICAL
        assert mounting_text(camera(rotated)) == f"mounted on the ego at (1.50, -0.25, 2.00) m, looks {words}"
    # an extrinsic of the wrong way and a quaternion of the wrong order show themselves
    assert "looks right, lying on its side" in mounting_text(camera(OPTICAL.T))
    rotated = Rotation.from_euler("z", 90, degrees=True).as_matrix() @ OPTICAL
    wrong = Rotation.from_quat(np.roll(Rotation.from_matrix(rotated).as_quat(), 1)).as_matrix()
    assert "looks left" not in mounting_text(camera(wrong))
    lidars = {(0, 0, 90): "its x axis points left", (180, 0, 0): "upside down", (90, 0, 0): "lying on its side"}
    for euler_deg, words in lidars.items():
        rotation = Rotation.from_euler("xyz", euler_deg, degrees=True).as_matrix()
        assert mounting_text(LidarSensor("l", LazyFrames.of([], []), mount=mount(rotation))).endswith(f", {words}")
    sensor = LidarSensor("l", LazyFrames.of([], []), mount=RigidTransform.identity())
    assert mounting_text(sensor) == "mounted on the ego"
    assert mounting_text(LidarSensor("l", LazyFrames.of([], []))) is None


def test_fuse_depth_and_colour_note_a_camera_that_sees_no_point(call, recording, tmp_path):
    drive = shutil.copytree(recording, tmp_path / "drive")
    calibration = json.loads((drive / "calibration.json").read_text())
    matrix = calibration["cameras"][0]["imuToCamera"]
    matrix[1], matrix[2] = matrix[2], [-number for number in matrix[1]]  # so that it looks at the sky
    (drive / "calibration.json").write_text(json.dumps(calibration))
    assert "looks ahead" in call("info", recording).out
    assert "looks up" in call("info", drive).out
    for verb, output in (("fuse", "a.sfs"), ("depth", "depth"), ("colour", "a.ply")):
        outcome = call(verb, drive, "-o", tmp_path / output)
        assert "no point falls into the images of camera0" in outcome.err
    assert "no point falls" not in call("fuse", recording, "-o", tmp_path / "b.sfs").err


def drive_of(rotation, *, format="recording", metres=20.0, **fields):
    """A vehicle that goes east on a level road; `rotation` takes its body into the ego's frame."""
    times, positions = np.arange(11, dtype=np.int64) * 10**8, np.linspace([0.0, 0, 0], [metres, 0, 0], 11)
    world_from_ego = np.tile(rotation.inv().as_quat(), (11, 1))
    trajectories = {"groundTruth": Trajectory("groundTruth", times, positions, world_from_ego)}
    return Scene((), trajectories=trajectories, format=format, **fields)


ROTATIONS = {
    "x ahead": Rotation.identity(),
    "y ahead": Rotation.from_euler("z", 90, degrees=True),
    "back": Rotation.from_euler("z", 180, degrees=True),
    "camera axes": Rotation.from_matrix(OPTICAL.T),
    "odd": Rotation.from_euler("zyx", [40, -70, 130], degrees=True),
}


def worded(scene, rotation, yaw_deg):
    body_from_camera = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ OPTICAL
    return mounting_text(camera(rotation.as_matrix() @ body_from_camera), ego_axes(scene))


def test_in_a_recording_motion_and_the_world_s_up_state_where_a_camera_looks():
    for rotation in ROTATIONS.values():
        for yaw_deg, words in {0: "ahead", 90: "left", -90: "right", 180: "back", 45: "ahead left"}.items():
            assert str(worded(drive_of(rotation), rotation, yaw_deg)).endswith(f"m, looks {words}")
    for metres in (0.0, 0.3):  # of its axes it says nothing
        scene = drive_of(ROTATIONS["x ahead"], metres=metres)
        assert str(worded(scene, ROTATIONS["x ahead"], 0)).endswith("looks ahead if the ego's x axis is ahead")
    # axes are those of the accelerometer or of the format, whatever the motion
    rotation = ROTATIONS["odd"]
    gravity = rotation.apply([0.0, 0.0, 9.81])
    imu = ImuSensor("imu", {"accelerometer": VectorSamples([0, 1], [gravity, gravity])})
    reported = {"recording": {"calibration": {"imuForward": rotation.apply([1.0, 0, 0]).tolist()}}}
    scene = Scene((imu,), metadata=reported, format="recording")
    assert str(worded(scene, rotation, 90)).endswith("looks left")
    assert str(worded(scene, rotation, 0)).endswith("looks ahead")
    for degrees in (180, 20):
        rotation = Rotation.from_euler("z", degrees, degrees=True)
        axes = ego_axes(drive_of(rotation, format="nuscenes"))
        np.testing.assert_allclose(axes.body_from_ego, np.eye(3), atol=1e-12)
        assert axes.known
    rotation = ROTATIONS["y ahead"]
    assert str(worded(drive_of(rotation, format="pandaset"), rotation, 90)).endswith("looks left")
    imu = ImuSensor("imu", {"accelerometer": VectorSamples([0, 1], [[np.nan] * 3, [1e300] * 3])})
    for scene in (drive_of(ROTATIONS["x ahead"], metres=1e300), Scene((imu,), format="recording")):
        assert not ego_axes(scene).known


def test_all_formats_are_listed_with_what_they_can_do_and_one_with_what_it_holds(call, refuses, reported):
    known = {form["name"]: form for form in reported("formats")}
    assert set(known) >= set(FORMATS)
    told = [(known[name]["suffixes"], known[name]["writes"]) for name in ("sfs", "recording", "rig")]
    assert told == [([".sfs"], True), ([""], True), ([".toml"], False)]
    assert known["tum"]["trajectory"]
    assert {"rig", "euroc"} <= set(call("formats").out.split())
    held = reported("formats tum")
    assert held["trajectories.positions"] == {"support": "kept", "how": ""}
    assert held["sensors.lidar.id"]["support"] == "dropped"
    assert "dropped (" in call("formats tum").out
    refuses(2, "no format or form 'nope'; there are sfs", "formats nope")


def test_a_template_is_written_once_and_names_what_is_in_a_folder(call, refuses, succeeds, tmp_path):
    folder, path = tmp_path / "own", tmp_path / "own" / "rig.toml"
    (folder / "front").mkdir(parents=True)
    refuses(1, "sceneloom formats --template FOLDER/rig.toml --from FOLDER", "info", folder)
    Image.new("RGB", (8, 6)).save(folder / "front" / "1532402927647951000.png")
    for option in (("--from", "."), ("--overwrite",)):
        refuses(2, "does nothing without --template", "formats", *option)
    refuses(1, "no such folder", "formats --template", path, "--from", tmp_path / "none")
    assert (call("info", tmp_path / "none").code, path.exists()) == (1, False)
    succeeds("formats --template", path)
    assert tomllib.loads(path.read_text())["sensors"]
    refuses(1, "exists already", "formats --template", path)
    succeeds("formats --template", path, "--overwrite")
    path.unlink()
    succeeds("formats --template", path, "--from", folder)
    (sensor,) = tomllib.loads(path.read_text())["sensors"]
    assert (sensor["id"], sensor["files"], sensor["camera_model"]["width"]) == ("front", "front/*.png", 8)
    refuses(1, "still to be filled in", "info", folder)
    assert tomllib.loads(succeeds("formats --template -").out)["sensors"], "it is printed"


def test_doctor_says_what_is_there_and_ends_with_1_where_something_needed_is_broken(call, monkeypatch):
    outcome = call("doctor")
    assert (outcome.code, outcome.err) == (0, "")
    for word in (__version__, "numpy", "processors", "compiled kernels", "H.264, read", "web browser"):
        assert word in outcome.out
    broken = Finding(group="packages", name="av", status=Status.BROKEN, stated="is gone", remedy="pip install av")
    good = Finding(group="packages", name="numpy", status=Status.GOOD, stated="2.0")
    monkeypatch.setattr(installation, "examine_installation", lambda: InstallationReport(findings=(broken, good)))
    outcome = call("doctor --quiet")
    assert (outcome.code, "BROKEN" in outcome.out, "pip install av" in outcome.out) == (1, True, True)
    assert "numpy" not in outcome.out
    assert "something that is needed is broken" in outcome.err
    reported = call("doctor --json")
    assert (reported.code, json.loads(reported.out)["sound"]) == (1, False)


def test_doctor_compiles_all_kernels_that_it_counts_when_asked_to(call, monkeypatch):
    compiled = []
    monkeypatch.setattr(cache, "compile_ahead", lambda names: compiled.append(set(names)))
    monkeypatch.setattr(cache, "compile_kernels", lambda names: compiled.append(set(names)))
    outcome = call("doctor --compile")
    assert (outcome.code, len(compiled), compiled[0]) == (0, 2, compiled[1])
    own = [name for name in compiled[0] if name.startswith("sceneloom.")]
    assert re.search(rf"\d+ of {len(own)} compiled", outcome.out)


def test_completion_is_of_the_shell_and_bash_completes_verbs(call, refuses, succeeds, tmp_path, monkeypatch):
    for shell, mark in {"bash": "complete -o", "zsh": "#compdef sceneloom", "fish": "complete"}.items():
        out = succeeds("completion", shell).out
        assert (mark in out, "_SCENELOOM_COMPLETE" in out) == (True, True)
    monkeypatch.setenv("SHELL", "/usr/bin/fish")
    assert "function" in call("completion").out
    monkeypatch.setenv("SHELL", "/bin/ksh")
    refuses(2, "expected one of bash, zsh, fish", "completion")
    words = {"COMP_WORDS": "sceneloom edit bl", "COMP_CWORD": "2", "_SCENELOOM_COMPLETE": "bash_complete"}
    command, environment = [sys.executable, "-m", "sceneloom"], {**words, "PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.stdout.split() == ["plain,blur"], done.stderr


POSE = [0, 0, 0, 0, 0, 0, 1]


@pytest.fixture
def faulty(tmp_path, encode_sfs):
    """A file with a quaternion that is too long."""
    poses = {"timestamps": [0, 100_000], "values": [POSE, [0, 0, 0, 0, 0, 0, 2]]}
    frames = [{"timestamp": 0, "points": {"positions": np.ones((2, 3), np.float32)}}]
    lidar = {"id": "top", "type": "lidar", "poses": poses, "frames": frames}
    path = tmp_path / "faulty.sfs"
    path.write_bytes(encode_sfs({"version": "1.0", "sensors": [lidar]}))
    return path


def test_findings_stand_under_their_rule_with_the_remedy_once_or_as_json(call, succeeds, faulty):
    done = call("validate", faulty)
    assert done.code == 1
    lines = done.out.splitlines()
    assert lines[0].startswith(f"{faulty}: sfs, profile sfs: not passed, 1 error")
    start = lines.index("errors")
    assert lines[start + 1] == "  quaternion-norm: 1 time, --fix repairs it"
    assert lines[start + 2].startswith("    sensors[0].poses.values[1]: a quaternion of norm 2; expected 1")
    assert lines[start + 3].startswith("    → Normalise")
    done = call("validate", faulty, "--json", "--rule", "quaternion-norm")
    report = json.loads(done.out)
    assert (done.code, report["counts"]) == (1, {"error": 1, "warning": 0, "hint": 0})
    finding = report["findings"][0]
    assert (finding["path"], finding["fixable"]) == ("sensors[0].poses.values[1]", True)
    hints = ("validate", faulty, "--rule", "reading-assumed")
    assert ["reading-assumed" in call(*hints, *words).out for words in ((), ("--quiet",))] == [True, False]
    assert "quaternion-norm (error, fix)\n" in succeeds("validate --rules").out
    rows = json.loads(call("validate --rules --json").out)
    assert {"id", "severity", "summary", "remedy", "fixable", "only_in"} == set(rows[0])


def test_fixing_writes_and_passes_or_says_why_nothing_was_written(call, refuses, succeeds, faulty, tmp_path):
    target = tmp_path / "repaired.sfs"
    done = succeeds("validate", faulty, "--fix", target)
    assert "fixed\n  quaternion-norm: sensors[0].poses.values[1]" in done.out
    assert f"wrote {target}, " in done.out
    succeeds("validate", target)
    assert call("validate", faulty, "--fix", target).code == 1
    succeeds("validate", faulty, "--fix", target, "--overwrite")
    (tmp_path / "torn.sfs").write_bytes(b'{"version": ')
    refuses(1, "nothing was written", "validate", tmp_path / "torn.sfs", "--fix", tmp_path / "again.sfs")
    (drive := tmp_path / "drive").mkdir()
    (drive / "data.jsonl").write_text('[{"groundTruth":{"position":{"x":0,"y":0,"z":0}},"time":0}\n')
    done = refuses(1, "nothing was written: ", "validate", drive, "--fix", tmp_path / "again")
    assert "broken-lines: 1 time\n    data.jsonl: line 1: " in done.out
    assert not (tmp_path / "again").exists()


def test_strict_lets_warnings_fail_and_bad_usage_is_refused(call, succeeds, recording, refuses, faulty, tmp_path):
    succeeds("validate", recording, "--quick")
    without_trajectory = call("validate", recording, "--strict", "--ignore", "image-plain")
    assert without_trajectory.code in (0, 1)
    assert without_trajectory.code == ("warning" in without_trajectory.out.splitlines()[0])
    refuses(2, "", "validate")
    refuses(2, "", "validate", "x.sfs", "--profile", "bs5")
    refuses(2, "--rules", "validate", faulty, "--rule", "no-such")
    stated = "repaired.xyz: suffix '.xyz' belongs to no format; expected one of: sfs (.sfs)"
    for source in (recording, faulty):
        refuses(2, stated, "validate", source, "--fix", tmp_path / "repaired.xyz")
        assert not (tmp_path / "repaired.xyz").exists()
    # what is written is not called by the form that it was made from, nor lost what is kept aside
    repaired = call("validate", recording, "--fix", tmp_path / "repaired.sfs").out
    assert repaired.startswith(f"{tmp_path / 'repaired.sfs'}: profile sfs: passed")
    lost, _, aside = repaired.partition("\nkept aside\n")
    assert "trajectories[]: " not in lost
    assert "  trajectories[]: the format knows odometry sensors only; it is in metadata.sceneloom." in aside
    back = call("validate", tmp_path / "repaired.sfs", "--fix", tmp_path / "back")
    assert back.out.startswith(f"{tmp_path / 'back'}: recording: passed")


def raised(scene, metres):
    """The scene with the points of its second sweep raised."""
    lidar = scene.lidars[0]
    frames = list(lidar.frames)
    points = frames[1].points
    higher = replace(points, positions=points.positions + np.float32([0, 0, metres]))
    frames[1] = replace(frames[1], points=higher)
    moved = replace(lidar, frames=LazyFrames.of(frames, lidar.frames.timestamps_ns.tolist()))
    return replace(scene, sensors=tuple(moved if s is lidar else s for s in scene.sensors))


def test_equal_drives_exit_with_zero_and_drives_that_differ_with_one_and_state_where(call, refuses, succeeds, tmp_path):
    scene = small_drive(frames=2).scene
    drives = tmp_path / "a.sfs", tmp_path / "b.sfs"
    for path, other in zip(drives, (scene, raised(scene, 0.25)), strict=True):
        sceneloom.write(other, path)
    assert succeeds("diff", drives[0], drives[0]).out == "equal\n"
    assert succeeds("diff", *drives, "--tolerance-m", "0.3")
    outcome = call("diff", *drives)
    first, *_, last = outcome.out.splitlines()
    assert first.startswith("~ sensors['lidar'].frames[].points.positions: changed by 0.25 m in 1 frame, most in")
    assert (outcome.code, last) == (1, "1 difference")
    outcome = call("diff", *drives, "--json")
    report = json.loads(outcome.out)
    assert (outcome.code, report["equal"], len(report["differences"])) == (1, False, 1)
    assert report["differences"][0]["amount"] == pytest.approx(0.25, abs=1e-5)
    refuses(2, "", "diff", *drives, "--tolerance-m", "-1")
    refuses(2, "", "diff", drives[0])
    refuses(1, "", "diff", drives[0], drives[0].with_name("none.sfs"))


def test_sync_reports_and_writes_a_drive_in_step(succeeds, reported, tmp_path, call, refuses):
    # twenty seconds whose trajectory is 30 ms late
    late = tmp_path / "late"
    blind = LidarSpec(beams=1, steps=4, elevations_deg=(-1.0, 1.0))
    scene = simulate_street(4, frames=200, lidar=blind, cameras=()).scene
    trajectory = scene.trajectories["groundTruth"]
    moved = replace(trajectory, timestamps_ns=trajectory.timestamps_ns + 30_000_000)
    sensors = tuple(s for s in scene.sensors if s.id == "imu")
    sceneloom.write(replace(scene, sensors=sensors, annotations=(), trajectories={"groundTruth": moved}), late)
    outcome = succeeds("sync", late)
    assert "1 stream against imu: 1 off; tolerance 5 ms" in outcome.out
    row = next(line for line in outcome.out.splitlines() if "groundTruth" in line).split()
    assert (*row[1:3], row[-1]) == ("imu", "rotation", "off")
    out = succeeds("sync", late, "--tolerance", "0.03").out
    assert re.search(r"\+2\d\.\d to \+3\d\.\d .* cannot tell, up to 3\d\.\d ms\n", out)
    assert "1 cannot tell; tolerance 30 ms" in out
    report = reported("sync", late, "--reference", "groundTruth")
    estimate = report["comparisons"][0]["estimate"]
    assert (report["off"], estimate["verdict"]) == (["imu"], "off")
    assert abs(estimate["offset_ns"] + 3e7) < 2e6
    assert "corrected: groundTruth: -" in succeeds("sync", late, "--apply", tmp_path / "right").out
    assert reported("sync", tmp_path / "right")["off"] == []
    (tmp_path / "there").mkdir()
    refuses(1, "", "sync", late, "--apply", tmp_path / "there")
    assert "groundTruth" in refuses(2, "sonar", "sync", late, "--streams", "imu,sonar").err
    refuses(2, "", "sync", late, "--lever", "nan")
    for reach in ("-1", "0", "nan", "inf", "far"):
        for limit in ("--reach", "--tolerance"):
            refuses(2, limit, "sync", late, limit, reach)
    assert call("sync", late, "--start", "3", "--stop", "3.5").code in {0, 2}, "of so little nothing may be known"


def test_a_page_and_its_numbers_also_of_a_broken_drive(succeeds, reported, recording, tmp_path, monkeypatch):
    page, numbers = tmp_path / "r.html", tmp_path / "r.json"
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    outcome = succeeds("report", recording, "-o", page, "--numbers", numbers)
    assert outcome.out.startswith("drive: ")
    assert f"page: {page}" in outcome.out
    found = json.loads(numbers.read_text("utf-8"))
    assert (found["validation"]["frames_read"], found["provenance"]["hashed"]) == (True, "folder")
    assert "</html>" in page.read_text("utf-8")
    assert reported("report", recording, "--quick")["verdict"]["state"] in {"sound", "look", "faulty"}
    assert list((tmp_path / "here").iterdir()) == []
    broken = shutil.copytree(recording, tmp_path / "drive")
    with (broken / "data.jsonl").open("a") as lines:
        lines.write('{"time": 1.0, "sens\n')
    outcome = succeeds("report", broken, "--quick", "-o", page, "--overwrite")
    assert "that will break downstream tools" in outcome.out


def test_what_is_not_there_and_a_truth_of_another_time_or_kind_are_errors_that_say_why(refuses, recording, tmp_path):
    page, truth = tmp_path / "page.html", tmp_path / "truth.tum"
    refuses(1, "no such file", "report", tmp_path / "nothing", "-o", page)
    words = ("report", recording, "--quick", "-o", page, "--truth", truth)
    refuses(1, "truth.tum: no such file or folder", *words)
    for text in ("".join(f"{9e8 + k} {k} 0 0 0 0 0 1\n" for k in range(5)), "a letter to somebody\n"):
        truth.write_text(text)
        assert "leave `--truth` out" in refuses(1, f"{truth}: cannot be compared with the drive: ", *words).err
    assert not page.exists()


def test_a_map_and_sweeps_are_written_and_missing_label_images_counted(succeeds, reported, recording, tmp_path):
    done = succeeds("colour", recording, "-o", tmp_path / "map.laz", "--voxel", "0.2", "--visualize", tmp_path / "look")
    assert ("coloured 3 of 3 sweeps" in done.out, "map.laz" in done.out) == (True, True)
    assert len(laspy.read(tmp_path / "map.laz")) > 50
    assert len(list((tmp_path / "look").glob("*.png"))) == 2
    report = reported("colour", recording, "--per-sweep", tmp_path / "sweeps", "--remove-moving")
    assert (report["files"], report["exposure"]["seam_before"]) == ({"sweeps": 3}, None)
    assert report["removed_by_rays"] + report["removed_in_boxes"] < 0.1 * report["points"]
    assert sorted(path.name for path in (tmp_path / "sweeps").iterdir()) == [f"00000{k}.ply" for k in range(3)]
    (tmp_path / "labels").mkdir()
    Image.fromarray(np.full((64, 96), 9, np.uint8)).save(tmp_path / "labels" / "1.png")
    done = succeeds("colour", recording, "-o", tmp_path / "map.las", "--labels", tmp_path / "labels")
    assert "labels: 1 image painted onto" in done.out
    assert "no label image of 2 images" in done.out
    assert set(np.unique(laspy.read(tmp_path / "map.las").label).tolist()) == {9, 65535}


@pytest.mark.parametrize("method", ["sparse", "dense"])
def test_each_sweep_and_image_gets_a_depth_image(reported, recording, tmp_path, method):
    words = ("--method", method, "--visualize", tmp_path / "look", *(("--confidence",) if method != "sparse" else ()))
    (camera,) = reported("depth", recording, "-o", tmp_path / "out", *words)["cameras"]
    folder = tmp_path / "out" / "camera0"
    names = ["000000.png", "000001.png", "000002.png"]
    assert (camera["images"], sorted(path.name for path in folder.glob("*.png"))) == (3, names)
    lines = (tmp_path / "out" / "index.jsonl").read_text().splitlines()
    assert [json.loads(line)["file"] for line in lines] == [f"camera0/{name}" for name in names]
    assert len(list((tmp_path / "look" / "camera0").iterdir())) == 3
    steps = np.array(Image.open(folder / "000001.png"))
    assert (steps.shape, steps.dtype, steps.any()) == ((64, 96), np.uint16, True)
    if method != "sparse":
        grey = np.array(Image.open(folder / "confidence" / "000000.png"))
        assert (grey.dtype, grey.shape, 0 < camera["confidence"] <= 1) == (np.uint8, (64, 96), True)


def test_dense_images_keep_the_pixels_of_sparse_ones_nearly(refuses, succeeds, recording, tmp_path):
    for method in ("sparse", "dense"):
        succeeds("depth", recording, "-o", tmp_path / method, "--method", method, "--form", "npz")
    sparse = np.load(tmp_path / "sparse" / "camera0" / "000000.npz")["depth"]
    with np.load(tmp_path / "dense" / "camera0" / "000000.npz") as arrays:
        dense, confidence = arrays["depth"], arrays["confidence"]
    assert dense.dtype == confidence.dtype == np.float32
    assert ((confidence > 0) == (dense > 0)).all()
    measured = sparse > 0
    assert (dense > 0).sum() > 2 * measured.sum()
    differences = np.abs(dense[measured] / sparse[measured] - 1)
    assert np.median(differences) < 0.03  # points lie beside the centres of pixels, which are large here
    succeeds("depth", recording, "-o", tmp_path / "png", "--confidence")
    grey = np.array(Image.open(tmp_path / "png" / "camera0" / "confidence" / "000000.png"))
    assert (grey.dtype, grey.tolist()) == (np.uint8, np.rint(confidence * 255).tolist())
    assert "camera0" in refuses(2, "'roof'", "depth", recording, "-o", tmp_path / "out", "--camera", "roof").err


def test_a_view_is_saved_and_summed_up_also_of_a_list_of_parts_as_many_as_can_be_looked_at(
    refuses, succeeds, reported, recording, tmp_path
):
    pytest.importorskip(RERUN[0], reason=RERUN[1])
    target, parts = tmp_path / "drive.rrd", tmp_path / "parts.jsonl"
    outcome = succeeds("view", recording, "--save", target, "--no-findings", "--every", "2")
    assert [text for text in ("2 images", "2 sweeps", f"rerun {target}") if text not in outcome.out] == []
    assert target.read_bytes()[:3] == b"RRF"  # what files of Rerun begin with
    refuses(1, "--overwrite", "view", recording, "--save", target)
    words = ("--save", tmp_path / "d.rrd", "--colour-by", "height", "--sensors", "lidar", "--no-findings")
    report = reported("view", recording, *words)
    (drive,) = report["drives"]
    assert (drive["colours"], drive["logged"]["sweeps"]) == ({"lidar": "height"}, 3)
    assert report["size_bytes"] == (tmp_path / "d.rrd").stat().st_size
    with sceneloom.open(recording) as scene:
        sweeps_ns, first_ns = scene.lidars[0].frames.timestamps_ns, time_span(scene)[0]
    between = round(float(sweeps_ns[:2].mean() - first_ns) / 1e9, 3)
    lines = [{"path": str(recording), "stop": between}, {"path": str(recording), "start": between}]
    parts.write_text("\n".join(map(json.dumps, lines)))
    words = ("--save", tmp_path / "l.rrd", "--no-findings", "--start", "99")
    first, second = reported("view --list", parts, *words)["drives"]
    assert first["source"] == second["source"]
    assert (first["logged"]["sweeps"], second["logged"]["sweeps"]) == (1, len(sweeps_ns) - 1)
    roots = [shown["root"].replace("\\", "") for shown in (first, second)]
    assert roots == [f"/{recording.name} 0-{between:g} s", f"/{recording.name} {between:g}-"]
    parts.write_text("\n".join(json.dumps({"path": str(recording), "start": 0.01 * k}) for k in range(33)))
    assert "33 drives" in refuses(2, "--limit 32", "view --list", parts, "--save", tmp_path / "e.rrd").err
    refuses(2, "", "view --save", tmp_path / "e.rrd")
    assert not (tmp_path / "e.rrd").exists()
