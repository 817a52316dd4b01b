"""Inputs that cannot be read end in one message that says what and where."""

import json
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.batch import jobs
from sceneloom.calibrate.conventions import read_extrinsics
from sceneloom.catalog.database import query
from sceneloom.db34t.transport import read_certificates, read_pair, read_token
from sceneloom.detections.settings import read_detectors
from sceneloom.errors import DataError
from sceneloom.evaluate.object_files import fused_files
from sceneloom.formats.base import files as base_files
from sceneloom.report.page import read_losses
from sceneloom.service.running import read_configuration_file


def edit_lines(edit):
    def spoil(folder):
        path = folder / "data.jsonl"
        path.write_text("\n".join(edit(path.read_text().splitlines())) + "\n")

    return spoil


def edit_calibration(edit):
    def spoil(folder):
        path = folder / "calibration.json"
        edit(calibration := json.loads(path.read_text()))
        path.write_text(json.dumps(calibration))

    return spoil


def shear(calibration):
    calibration["cameras"][0]["imuToCamera"][0][1] += 0.5


def with_nan_position(lines):
    location = next(k for k, line in enumerate(lines) if "groundTruth" in line)
    record = json.loads(lines[location])
    record["groundTruth"]["position"]["x"] = float("nan")
    return [*lines[:location], json.dumps(record), *lines[location + 1 :]]


def with_late_truth(lines):
    records = [json.loads(line) for line in lines]
    return [json.dumps(r | {"time": r["time"] + 100.0 * ("groundTruth" in r)}) for r in records]


def written(name, content):
    return lambda folder: (folder / name).write_bytes(content)


def missing(name):
    return lambda folder: (folder / name).unlink()


FAULTS: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "no such folder": (shutil.rmtree, ("no such file or folder",)),
    "an empty folder": (
        lambda f: [shutil.rmtree(f), f.mkdir()],
        ("no reader knows this", "recording", "sceneloom formats"),
    ),
    "no calibration": (missing("calibration.json"), ("calibration.json",)),
    "no video": (lambda f: shutil.rmtree(f / "frames1"), ("frames1", "data.{mkv")),
    "fewer images than lines": (missing("frames1/00000002.png"), ("2 images", "3")),
    "a lidar file missing": (missing("lidar/000001.bin"), ("000001.bin",)),
    "a torn lidar file": (
        written("lidar/000001.bin", b"x" * 50),
        ("000001.bin", "records of 23 bytes", "remainder of 4"),
    ),
    "a broken line": (edit_lines(lambda lines: [*lines[:3], lines[3][:-5], *lines[4:]]), ("data.jsonl", "line 4")),
    "a number that is not one": (edit_lines(with_nan_position), ("data.jsonl", "line")),
    "an unknown camera model": (
        edit_calibration(lambda c: c["cameras"][0].update(model="fisheye-of-mine")),
        ("fisheye-of-mine", "kannala-brandt4"),
    ),
    "a mounting that is not rigid": (edit_calibration(shear), ("cameras[0].imuToCamera", "rotation")),
    "calibration that is no JSON": (written("calibration.json", b"{"), ("calibration.json",)),
    "calibration cut in the middle of its lines": (
        written("calibration.json", b'{\n  "cameras": [\n    {\n'),
        ("calibration.json", "truncated"),
    ),
    "no lines": (written("data.jsonl", b""), ("data.jsonl",)),
    "binary lines": (written("data.jsonl", bytes(range(256)) * 20), ("data.jsonl", "line 1")),
}


@pytest.fixture
def drive(recording, tmp_path):
    """A copy of the recording that may be spoiled."""
    return shutil.copytree(recording, tmp_path / "drive")


@pytest.mark.parametrize("fault", FAULTS)
def test_one_clear_error_and_no_output(refuses, drive, tmp_path, fault):
    spoil, (word, *words) = FAULTS[fault]
    spoil(drive)
    outputs = ["-o", tmp_path / "d.sfs", "--depth", tmp_path / "depth", "--visualize", tmp_path / "look"]
    outcome = refuses(1, word, "fuse", drive, *outputs)
    assert outcome.err.startswith("sceneloom: ")
    assert [line.split(":")[0] for line in outcome.err.strip().splitlines()[1:]] in ([], ["next"])
    assert [word for word in words if word not in outcome.err] == []
    assert {path.name for path in tmp_path.iterdir()} <= {"drive"}


def test_odd_drives_are_read_with_warnings_and_broken_ones_leniently(reported, succeeds, recording, drive, tmp_path):
    (tmp_path / "again").mkdir()
    other = shutil.copytree(recording, tmp_path / "again" / "drive")
    edit_lines(lambda lines: lines[::-1])(other)
    straight, backwards = (reported("info", path) for path in (recording, other))
    counts = [[(s["id"], s["count"], s["start"], s["stop"]) for s in x["sensors"]] for x in (straight, backwards)]
    assert counts[0] == counts[1]
    assert "repaired" in {warning["kind"] for warning in backwards["warnings"]}
    points = np.fromfile(other / "lidar" / "000000.bin", np.dtype([("p", "<f4", 3), ("rest", "u1", 11)]))
    points["p"][::2] = np.nan
    points.tofile(other / "lidar" / "000000.bin")
    assert reported("fuse", other, "-o", tmp_path / "n.sfs", "--visualize", tmp_path / "look")["frames"] == 3
    FAULTS["an unknown camera model"][0](other)
    outcome = succeeds("fuse", other, "-o", tmp_path / "c.sfs", "--lenient")
    assert "fused 3 of 3 sweeps" in outcome.out
    assert ("skipped: left out: " in outcome.err, "fisheye-of-mine" in outcome.err) == (True, True)
    FAULTS["a torn lidar file"][0](drive)
    edit_lines(lambda lines: [*lines, '{"broken'])(drive)
    report = reported("fuse", drive, "-o", tmp_path / "d.sfs", "--lenient")
    skipped = [warning["location"] for warning in report["warnings"] if warning["kind"] == "skipped"]
    locations = " ".join([*skipped, *report["skipped"]])
    assert (report["fused"], report["frames"]) == (2, 2)
    assert ("000001.bin" in locations, "data.jsonl" in locations) == (True, True)


def test_outputs_that_cannot_be_written_are_named(refuses, recording, tmp_path):
    (tmp_path / "taken.sfs").write_text("mine")
    (tmp_path / "folder.sfs").mkdir()
    for target, words in (("missing/d.sfs", "not exist"), ("taken.sfs", "--overwrite"), ("folder.sfs", "--overwrite")):
        assert target.rpartition("/")[2] in refuses(1, words, "fuse", recording, "-o", tmp_path / target).err
    assert (tmp_path / "taken.sfs").read_text() == "mine"
    refuses(2, "groundTruth, gnss, lidar, identity", "fuse", recording, "-o", "nowhere.sfs", "--trajectory", "vio")


@pytest.mark.parametrize("words", [("convert",), ("edit simplify", "-o")])
def test_a_number_that_is_none_is_a_fault_of_the_file(refuses, tmp_path, encode_sfs, words):
    path = {"timestamps": [0], "values": np.array([[1.0, 1, 1, np.nan, 0, 0, 0, 0, 0]])}
    cuboid = {"id": "nowhere", "type": "cuboid", "path": path}
    source, target = tmp_path / "nan.sfs", tmp_path / "out.sfs"
    source.write_bytes(encode_sfs({"version": "1.0", "sensors": [], "annotations": [cuboid]}))
    verb, *option = words
    refuses(1, f"{source}: annotations[nowhere].path.values[0]: [1.0", verb, source, *option, target)
    assert not target.exists()


def test_what_was_left_out_before_an_error_is_reported_with_it(call, refuses, recording, drive, tmp_path):
    FAULTS["a broken line"][0](drive)
    arguments = ("fuse", drive, "--lenient", "--trajectory", "nope", "-o", tmp_path / "out.sfs")
    *left_out, error = refuses(2, "data.jsonl: line 4: left out", *arguments).err.splitlines()
    assert ("left out" in "".join(left_out), "no trajectory 'nope'" in error) == (True, True)
    assert "left out" not in call(*arguments, "--quiet").err
    # also where reading comes to no end
    FAULTS["calibration that is no JSON"][0](drive)
    *left_out, error, step = refuses(1, "data.jsonl: line 4: left out", "info", drive, "--lenient").err.splitlines()
    assert step == f"next: `sceneloom validate {drive}` lists all that is wrong"
    assert ("left out" in "".join(left_out), "calibration.json" in error) == (True, True)
    # and where sweeps could not be read, and the others could not be fused
    shutil.rmtree(drive)
    shutil.copytree(recording, drive)
    edit_lines(with_late_truth)(drive)
    (drive / "lidar" / "000001.bin").write_bytes(struct.pack("<fffBHd", 1.0, 2.0, 3.0, 4, 5, 1e300))
    *skipped, error = refuses(1, "", "fuse", drive, "--lenient", "-o", tmp_path / "out.sfs").err.splitlines()
    assert ("000001.bin" in "".join(skipped), "could be fused" in error) == (True, True)


def test_a_stray_point_beyond_what_the_file_can_hold_is_reported_as_a_fault_of_the_data(
    refuses, succeeds, reported, drive, tmp_path
):
    file = drive / "lidar" / "000001.bin"
    records = bytearray(file.read_bytes())
    records[23 * 5 : 23 * 5 + 12] = struct.pack("<fff", 2e4, 3.0, 1.0)
    file.write_bytes(records)
    words = ("fuse", drive, "-o", tmp_path / "out.sfs")
    outcome = refuses(1, "sensors[lidar].frames[1].points.positions[5]", *words)
    assert str(drive) in outcome.err
    assert "m from the origin" in outcome.err
    report = reported(*words, "--lenient")
    (skipped,) = report["skipped"]
    assert "frames[1].points.positions[5]" in skipped
    assert (report["frames"], report["fused"]) == (3, 2)
    summary = succeeds(*words, "--lenient", "--overwrite").out
    assert summary.startswith("fused 2 of 3 sweeps by trajectory groundTruth")
    assert "\n1 sweep or image skipped\n" in summary
    with sceneloom.open(tmp_path / "out.sfs") as scene:
        assert len(scene.lidars[0].frames) == 2


def test_a_scene_file_says_how_to_go_on_where_it_was_cut_off_or_is_held_against_kittis_text(
    refuses, recording, tmp_path
):
    drive, truth, out = tmp_path / "drive.sfs", tmp_path / "0000.txt", tmp_path / "out.sfs"
    sceneloom.convert(recording, drive)
    truth.write_text("0 1 Car 0 0 0 10 10 50 50 1.5 1.6 4 1 1 10 0\n")
    refuses(2, "sceneloom convert SCENE OUT --to kitti-tracking", "eval tracking", drive, truth)
    content = drive.read_bytes()
    for length in (300, len(content) // 2):
        drive.write_bytes(content[:length])
        refuses(1, f"sceneloom salvage {drive} -o ", "info", drive)
    refuses(1, "drive.sfs", "fuse", drive, "-o", out)
    assert not out.exists()


READERS = {
    "a list of drives": lambda path: list(jobs._listed(path, {}, frozenset())),
    "extrinsics": read_extrinsics,
    "detectors": read_detectors,
    "a configuration": read_configuration_file,
    "certificates": read_certificates,
    "a key": lambda path: read_pair(path, path),
    "a token": read_token,
    "losses": read_losses,
    "fused detections": fused_files,
}


def test_an_input_that_is_a_pipe_or_very_long_is_named_and_not_waited_for(refuses, drive, tmp_path, monkeypatch):
    pipe, sweep = tmp_path / "input.jsonl", drive / "lidar" / "000001.bin"
    sweep.unlink()
    for path in (pipe, sweep, tmp_path / "catalog.json"):
        os.mkfifo(path)
    for read in READERS.values():
        with pytest.raises(DataError, match=r"input\.jsonl.*is a named pipe; expected a regular file"):
            read(pipe)
    named = "'lidar/000001.bin': is a named pipe; expected a regular file"
    refuses(1, named, "convert", drive, tmp_path / "drive.sfs")
    with pytest.raises(DataError, match=r"catalog\.json: cannot be read: is a named pipe"):
        query(tmp_path, "SELECT 1")
    monkeypatch.setattr(base_files, "LARGEST_SETTINGS", 1000)
    path = tmp_path / "input.toml"
    path.write_bytes(b"#" * 1001)
    for what in READERS.keys() - {"losses", "fused detections"}:
        with pytest.raises(DataError, match="1001 bytes; expected 1000 at most"):
            READERS[what](path)
