"""The verbs: their results for people and for machines."""

import json
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.cli.printing import Printer, seconds
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street


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


def test_fuse_writes_and_reports(call, refuses, reported, recording, tmp_path):
    stated = "d.txt: fusing writes scene files; expected a name that ends in .sfs"
    refuses(2, stated, "fuse", recording, "-o", tmp_path / "d.txt")
    refuses(2, "nothing to write", "fuse", recording)
    for option, value, needed in (("--depth-format", "npz", "--depth"), ("--visualize-every", "2", "--visualize")):
        refuses(2, f"without {needed} DIR", "fuse", recording, "-o", tmp_path / "d.sfs", option, value)
    assert list(tmp_path.iterdir()) == []
    report = reported("fuse", recording, "-o", tmp_path / "d.sfs", "--depth", tmp_path / "depth")
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
    camera = CameraSpec(Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5))
    street = partial(simulate_street, lidar=LidarSpec(beams=8, steps=90), cameras=(camera,))
    monkeypatch.setattr("sceneloom.simulate.drive.demo_drive", street)
    (tmp_path / "other" / "images").mkdir(parents=True)
    (tmp_path / "other" / "images" / "mine.png").write_text("mine")
    refuses(1, "--overwrite", "demo --keep", tmp_path / "other", "--frames", "2")
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["images"]
    outcome = succeeds("demo --keep", tmp_path / "kept", "--frames", "2")
    kept = {path.name for path in (tmp_path / "kept").iterdir()}
    assert kept == {"drive", "drive.sfs", "depth", "images"}
    assert "sceneloom info" in outcome.out
    shown = next(line.split()[2] for line in outcome.out.splitlines() if line.startswith("look at "))
    assert Path(shown).is_file()
    assert "notes on what these files cannot hold of the drive" in outcome.err
    refuses(1, "--overwrite", "demo --keep", tmp_path / "kept", "--frames", "2")


OPENING = "opening a recording takes --lenient, --altitude, --camera-shift, --image-index"


@pytest.mark.parametrize(
    ("target", "option", "takes"),
    [
        ("a.sfs", ("--origin", "1", "2", "3"), "writing a scene file takes --profile, --time-unit"),
        ("a", ("--profile", "scale"), "writing a recording takes --images"),
        ("a.tum", ("--images", "png"), "writing a trajectory takes --to-optical, --origin"),
        ("a.sfs", ("--from-rate", "10"), OPENING),
    ],
)
def test_an_option_that_the_format_does_not_take_is_named_as_it_was_stated(
    call, recording, tmp_path, target, option, takes
):
    outcome = call("convert", recording, tmp_path / target, *option)
    assert (outcome.code, outcome.err) == (2, f"sceneloom: {option[0]} does not count here: {takes}\n")
    assert not (tmp_path / target).exists()


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


@pytest.mark.parametrize(
    ("code", "problem", "arguments"),
    [
        (1, "inside the recording", ("convert", "DRIVE", "DRIVE/again")),
        (1, "inside the recording", ("validate", "DRIVE", "--quick", "--fix", "DRIVE/repaired")),
        (1, "inside the recording", ("sync", "DRIVE", "--apply", "DRIVE/in-step")),
        (1, "inside the recording", ("edit", "crop", "DRIVE", "-o", "DRIVE/cropped", "--start", "0")),
        (1, "inside the recording", ("edit", "deskew", "DRIVE", "-o", "DRIVE/deskewed")),
        (2, "standard output", ("convert", "DRIVE", "-")),
        (2, "standard output", ("fuse", "DRIVE", "-o", "-")),
        (2, "standard output", ("info", "DRIVE", "--visualize", "-")),
        (2, "standard output", ("validate", "DRIVE", "--fix", "-")),
        (2, "standard output", ("edit", "crop", "DRIVE", "-o", "-", "--start", "0")),
    ],
)
def test_an_output_is_no_dash_and_not_inside_the_recording(
    refuses, recording, tmp_path, monkeypatch, code, problem, arguments
):
    monkeypatch.chdir(tmp_path)
    before = sorted(recording.rglob("*"))
    refuses(code, problem, *(word.replace("DRIVE", str(recording)) for word in arguments))
    assert (sorted(recording.rglob("*")), list(tmp_path.iterdir())) == (before, [])


@pytest.mark.parametrize(
    ("verb", "words", "stage"),
    [
        ("convert", ("OUT.sfs",), "writing"),
        ("validate", (), "checking"),
        ("report", ("--quick",), "fusion"),
        ("fuse", ("-o", "OUT.sfs"), "fusing"),
    ],
)
def test_json_reports_where_the_time_went(reported, recording, tmp_path, verb, words, stage):
    stages = reported(verb, recording, *(word.replace("OUT", str(tmp_path / "out")) for word in words))["stages"]
    assert {"opening", stage} <= stages.keys()
    assert all(seconds >= 0.0 for seconds in stages.values())


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
