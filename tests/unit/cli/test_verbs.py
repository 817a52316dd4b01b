"""The verbs: their results for people and for machines."""

import json
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.cli.printing import seconds
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street


def test_info_names_every_sensor(succeeds, recording):
    outcome = succeeds("info", recording)
    for word in ("lidar", "camera0", "imu", "gnss", "groundTruth", "10 Hz", "pinhole 96x64"):
        assert word in outcome.out


def test_info_as_json_counts_what_is_there(call, recording):
    summary = json.loads(call("info", recording, "--json").out)
    counts = {sensor["id"]: sensor["count"] for sensor in summary["sensors"]}
    assert (counts["lidar"], counts["camera0"]) == (3, 3)
    assert summary["format"] == "recording"
    size = sum(p.stat().st_size for p in recording.rglob("*") if p.is_file())
    assert summary["size_bytes"] == size
    assert json.loads(call("info", recording / "data.jsonl", "--json").out)["size_bytes"] == size


def test_info_as_json_names_the_images_that_it_drew(call, tmp_path):
    drive = simulate_street(3, frames=2, lidar=LidarSpec(beams=8, steps=90), cameras=())
    sceneloom.write(drive.scene, tmp_path / "street.sfs")
    words = ("--visualize", tmp_path / "look", "--json")
    drawn = json.loads(call("info", tmp_path / "street.sfs", *words).out)["images"]
    assert sorted(map(Path, drawn)) == sorted((tmp_path / "look").iterdir())
    assert call("info", tmp_path / "street.sfs", *words).code == 1  # they are there already


def test_fuse_writes_and_reports(succeeds, recording, tmp_path):
    outcome = succeeds("fuse", recording, "-o", tmp_path / "d.sfs", "--depth", tmp_path / "depth", "--json")
    report = json.loads(outcome.out)
    assert (report["fused"], report["trajectory"], report["files"]) == (3, "groundTruth", {"depth images": 3})
    assert report["losses"]["losses"]
    assert (tmp_path / "d.sfs").is_file()


def test_fuse_for_people_says_frames_points_share_and_location(call, recording, tmp_path):
    outcome = call("fuse", recording, "-o", tmp_path / "d.sfs")
    assert "fused 3 of 3 sweeps by trajectory groundTruth" in outcome.out
    assert f"wrote {tmp_path / 'd.sfs'}, " in outcome.out
    assert "kept aside: " in outcome.err
    quiet = call("fuse", recording, "-o", tmp_path / "e.sfs", "--quiet")
    assert quiet.err == ""


def test_what_is_kept_aside_is_not_called_lost(call, recording, tmp_path):
    notes = call("fuse", recording, "-o", tmp_path / "d.sfs", "--verbose").err.splitlines()
    assert any(note.startswith("kept aside: sensors[imu]") for note in notes)
    assert not any(note.startswith("lost: sensors[imu]") for note in notes)


def test_a_scene_file_has_the_suffix_of_its_format(call, recording, tmp_path):
    outcome = call("fuse", recording, "-o", tmp_path / "d.txt")
    assert (outcome.code, list(tmp_path.iterdir())) == (2, [])
    assert "d.txt: fusing writes scene files; expected a name that ends in .sfs" in outcome.err


def test_fuse_without_an_output_is_bad_usage(call, recording):
    outcome = call("fuse", recording)
    assert outcome.code == 2
    assert "nothing to write" in outcome.err


def test_convert_reads_and_writes_and_reads_again(call, succeeds, recording, tmp_path):
    succeeds("convert", recording, tmp_path / "a.sfs")
    succeeds("convert", tmp_path / "a.sfs", tmp_path / "b.sfs", "--time-unit", "nanoseconds")
    first, second = (json.loads(call("info", tmp_path / name, "--json").out) for name in ("a.sfs", "b.sfs"))
    ids = [(sensor["id"], sensor["count"]) for sensor in first["sensors"]]
    assert ids == [(sensor["id"], sensor["count"]) for sensor in second["sensors"]]


def test_formats_lists_what_can_be_read_and_written(call):
    known = {form["name"]: form for form in json.loads(call("formats --json").out)}
    assert [known[name]["suffixes"] for name in ("sfs", "recording", "rig")] == [[".sfs"], [""], [".toml"]]
    assert [known[name]["writes"] for name in ("sfs", "recording", "rig")] == [True, True, False]
    assert known["tum"]["trajectory"]


def test_formats_says_what_one_of_them_holds(call, refuses):
    held = json.loads(call("formats tum --json").out)
    assert held["trajectories.positions"] == {"support": "kept", "how": ""}
    assert held["sensors.lidar.id"]["support"] == "dropped"
    assert "dropped (" in call("formats tum").out
    refuses(2, "no format or form 'nope'; there are sfs", "formats nope")


def test_demo_keeps_a_recording_a_scene_and_images(refuses, succeeds, tmp_path, monkeypatch):
    camera = CameraSpec(Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5))
    street = partial(simulate_street, lidar=LidarSpec(beams=8, steps=90), cameras=(camera,))
    monkeypatch.setattr("sceneloom.simulate.drive.demo_drive", street)
    outcome = succeeds("demo --keep", tmp_path / "kept", "--frames", "2")
    kept = {path.name for path in (tmp_path / "kept").iterdir()}
    assert kept == {"drive", "drive.sfs", "depth", "images"}
    assert "sceneloom info" in outcome.out
    shown = next(line.split()[2] for line in outcome.out.splitlines() if line.startswith("look at "))
    assert Path(shown).is_file()
    assert "notes on what these files cannot hold of the drive" in outcome.err
    refuses(1, "--overwrite", "demo --keep", tmp_path / "kept", "--frames", "2")


def test_demo_looks_at_all_its_outputs_before_it_makes_one(refuses, tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "mine.png").write_text("mine")
    refuses(1, "--overwrite", "demo --keep", tmp_path, "--frames", "2")
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


@pytest.mark.parametrize(
    ("target", "option", "takes"),
    [
        ("a.sfs", ("--origin", "1", "2", "3"), "writing a scene file takes --profile, --time-unit"),
        ("a", ("--profile", "scale"), "writing a recording takes --images"),
        ("a.tum", ("--images", "png"), "writing a trajectory takes --to-optical, --origin"),
        (
            "a.sfs",
            ("--from-rate", "10"),
            "opening a recording takes --lenient, --altitude, --camera-shift, --image-index",
        ),
    ],
)
def test_an_option_that_the_format_does_not_take_is_named_as_it_was_stated(
    call, recording, tmp_path, target, option, takes
):
    outcome = call("convert", recording, tmp_path / target, *option)
    assert outcome.code == 2
    assert outcome.err == f"sceneloom: {option[0]} does not count here: {takes}\n"
    assert not (tmp_path / target).exists()


@pytest.mark.parametrize(
    ("option", "value", "needed"), [("--depth-format", "npz", "--depth"), ("--visualize-every", "2", "--visualize")]
)
def test_an_option_that_would_do_nothing_is_bad_usage(call, recording, tmp_path, option, value, needed):
    outcome = call("fuse", recording, "-o", tmp_path / "d.sfs", option, value)
    assert outcome.code == 2
    assert f"without {needed} DIR" in outcome.err


@pytest.mark.parametrize("verb", ["demo", "info", "fuse", "convert", "formats"])
def test_every_verb_explains_itself(succeeds, verb):
    outcome = succeeds(verb, "--help")
    assert "--json" in outcome.out


def test_info_reports_the_first_time_to_the_nanosecond(call, recording, tmp_path):
    folder = tmp_path / "drive"
    shutil.copytree(recording, folder)
    lines = [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]
    fix = {"latitude": 60.0, "longitude": 25.0, "altitude": 1.0, "accuracy": 1.0}
    lines = [{"time": -0.25, "gps": fix}, *lines]
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert "clock starts at -0.250000000 s" in call("info", folder).out
    # seconds as float64 are off by 50 ns at such a time
    assert seconds(1_700_000_000_800_000_000) == "1700000000.800000000 s"


def test_only_the_first_skipped_frames_are_listed(call, succeeds, recording, tmp_path):
    folder = tmp_path / "drive"
    shutil.copytree(recording, folder)
    for image in (folder / "frames1").iterdir():
        image.write_bytes(image.read_bytes()[:120])
    arguments = ("fuse", folder, "-o", tmp_path / "d.sfs", "--lenient", "--overwrite")
    outcome = succeeds(*arguments)
    assert "3 sweeps or images skipped" in outcome.out
    assert outcome.err.count("skipped: ") == 3
    assert "skipped: " not in call(*arguments, "--quiet").err


def test_one_thing_is_not_called_several(call, recording, tmp_path):
    outcome = call("fuse", recording, "-o", tmp_path / "d.sfs", "--stop", "0.25")
    assert "fused 1 of 1 sweep by" in outcome.out


@pytest.mark.slow
def test_a_terminal_that_knows_few_characters_gets_them_escaped(recording, tmp_path):
    start = "from sceneloom.cli import main; main()"
    command = [sys.executable, "-c", start, "convert", recording, tmp_path / "a.sfs"]
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252"}
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert b"\\u2192" in done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="only there names of files may be any bytes")
def test_a_folder_whose_name_is_no_unicode_is_read_and_fused(call, succeeds, recording, tmp_path):
    folder = tmp_path / os.fsdecode(b"dr\xffive")
    shutil.copytree(recording, folder)
    succeeds("info", folder)
    assert json.loads(call("info", folder, "--json").out)["source"] == str(folder)
    succeeds("fuse", folder, "-o", tmp_path / "d.sfs")


def test_info_refuses_a_time_to_draw_where_nothing_is_drawn(call, recording):
    refused = call("info", recording, "--at", "1")
    assert refused.code == 2
    assert "--visualize" in refused.err


@pytest.mark.parametrize(
    "arguments",
    [
        ("convert", "DRIVE", "DRIVE/again"),
        ("validate", "DRIVE", "--quick", "--fix", "DRIVE/repaired"),
        ("sync", "DRIVE", "--apply", "DRIVE/in-step"),
        ("edit", "crop", "DRIVE", "-o", "DRIVE/cropped", "--start", "0"),
        ("edit", "deskew", "DRIVE", "-o", "DRIVE/deskewed"),
    ],
    ids=" ".join,
)
def test_no_recording_is_made_inside_the_one_that_is_read(call, recording, arguments):
    before = sorted(recording.rglob("*"))
    outcome = call(*(argument.replace("DRIVE", str(recording)) for argument in arguments))
    assert outcome.code == 1
    assert "inside the recording" in outcome.err
    assert sorted(recording.rglob("*")) == before


def test_images_may_lie_in_the_recording_that_they_show(succeeds, recording, tmp_path):
    drive = tmp_path / "drive"
    shutil.copytree(recording, drive)
    succeeds("fuse", drive, "--visualize", drive / "look", "-o", drive / "fused.sfs")
    succeeds("info", drive)


@pytest.mark.parametrize(
    "arguments",
    [
        ("convert", "DRIVE", "-"),
        ("fuse", "DRIVE", "-o", "-"),
        ("info", "DRIVE", "--visualize", "-"),
        ("validate", "DRIVE", "--fix", "-"),
        ("edit", "crop", "DRIVE", "-o", "-", "--start", "0"),
    ],
    ids=" ".join,
)
def test_a_dash_is_no_name_of_an_output(call, recording, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    outcome = call(*(argument.replace("DRIVE", str(recording)) for argument in arguments))
    assert outcome.code == 2
    assert "standard output" in outcome.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("verb", "words", "stage"),
    [
        ("convert", ("OUT.sfs",), "writing"),
        ("validate", (), "checking"),
        ("report", ("--quick",), "fusion"),
        ("fuse", ("-o", "OUT.sfs"), "fusing"),
    ],
)
def test_json_reports_where_the_time_went(call, recording, tmp_path, verb, words, stage):
    reported = call(verb, recording, *(word.replace("OUT", str(tmp_path / "out")) for word in words), "--json")
    stages = json.loads(reported.out)["stages"]
    assert {"opening", stage} <= stages.keys()
    assert all(seconds >= 0.0 for seconds in stages.values())
