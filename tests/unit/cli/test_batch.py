"""`sceneloom batch`: a verb over many drives."""

import json
import shutil

import click
import pytest

import sceneloom
from sceneloom.cli.batch import BATCHED, verb_named
from sceneloom.scene.scene import time_span


def test_drives_are_checked_side_by_side_and_those_that_fail_are_named(call, recording, tmp_path):
    missing = tmp_path / "missing"
    outcome = call("batch", "validate", recording, missing, "-o", tmp_path / "out", "--workers", 1, "--quick")
    assert outcome.code == 1
    assert "validate: 2 drives" in outcome.out
    assert "1 done, 1 failed" in outcome.out
    assert f"failed: {missing}: no such file or folder" in outcome.err
    report = json.loads((tmp_path / "out" / f"{recording.name}.json").read_text())
    assert (report["source"], "stages" in report) == (str(recording), False)
    reported = call("batch", "status", tmp_path / "out", "--json")
    assert [row["state"] for row in json.loads(reported.out)["drives"]] == ["done", "failed"]
    stages = json.loads(reported.out)["stages"]
    assert set(stages) == {"opening", "checking", "everything else"}
    shown = call("batch", "status", tmp_path / "out", "--html", tmp_path / "run.html").out
    assert "checking 0." in shown
    assert f"page: {tmp_path / 'run.html'}" in shown
    again = call("batch", "validate", recording, "-o", tmp_path / "out", "--quick", "--resume", "--json")
    assert json.loads(again.out)["skipped"] == 1


@pytest.mark.usefixtures("inline")
def test_parts_of_drives_are_those_of_a_list_or_of_the_options(call, recording, tmp_path):
    parts = tmp_path / "parts.jsonl"
    with sceneloom.open(recording) as scene:
        times = scene.lidars[0].frames.timestamps_ns
        start = round(int(times[1] - time_span(scene)[0]) / 1e9, 3)
    parts.write_text(json.dumps({"path": str(recording), "start": start, "stop": start + 0.1}))
    done = call("batch", "convert", "-o", tmp_path / "out", "--list", parts, "--workers", 1)
    assert done.code == 0, done.err
    with sceneloom.open(
        tmp_path / "out" / f"{recording.name}_start{start:g}_stop{start + 0.1:g}.sfs"
    ) as part:
        assert part.lidars[0].frames.timestamps_ns.tolist() == [times[1]]
    words = ("--start", start, "--stop", start + 0.1, "--quick", "--json")
    numbers = json.loads(call("report", recording, *words).out)
    assert [sensor["count"] for sensor in numbers["summary"]["sensors"] if sensor["type"] == "lidar"] == [1]
    checked = json.loads(call("validate", recording, *words).out)
    assert (checked["passed"], checked["profile"]) == (True, "sfs")


@pytest.mark.usefixtures("inline")
def test_what_is_written_beside_the_output_is_of_each_drive_its_own(call, recording, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(recording, other)
    depth = ("--depth", tmp_path / "depth")
    done = call("batch", "fuse", recording, other, "-o", tmp_path / "out", *depth, "--workers", 1)
    assert done.code == 0, done.err
    alone = call("fuse", recording, "--depth", tmp_path / "alone")
    assert alone.code == 0

    def files(folder):
        return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    assert sorted(path.name for path in (tmp_path / "depth").iterdir()) == [recording.name, "other"]
    for name in (recording.name, "other"):
        assert files(tmp_path / "depth" / name) == files(tmp_path / "alone")


@pytest.mark.usefixtures("inline")
def test_each_drive_has_its_own_files(call, tmp_path):
    poses = "1 0 0 {0} 0 1 0 0 0 0 1 0\n1 0 0 {0} 0 1 0 1 0 0 1 0\n"
    for k, name in enumerate(("a", "b")):
        (tmp_path / f"{name}.kitti").write_text(poses.format(k))
        (tmp_path / f"{name}.times").write_text(f"{k}.5\n{k}.75\n")
    words = ("-o", tmp_path / "out", "--suffix", ".tum", "--to", "tum", "--json")
    times = ("--from-times", "{folder}/{name}.times")
    done = call("batch", "convert", tmp_path / "*.kitti", *times, *words)
    assert done.code == 0, done.err

    def beginning(name):
        lines = (tmp_path / "out" / f"{name}.tum").read_text().splitlines()
        return next([float(word) for word in line.split()[:2]] for line in lines if line[0] != "#")

    assert [beginning("a"), beginning("b")] == [[0.5, 0.0], [1.5, 1.0]]
    (tmp_path / "list").write_text('{"path": "a.kitti", "from_times": "b.times"}\n{"path": "b.kitti"}\n')
    listed = call("batch", "convert", "--list", tmp_path / "list", *times, *words, "--resume")
    assert [json.loads(listed.out)[name] for name in ("done", "skipped")] == [2, 1]
    assert beginning("a") == [1.5, 0.0]
    (tmp_path / "b.times").unlink()
    refused = call("batch", "convert", tmp_path / "*.kitti", *times, *words, "--resume")
    assert (refused.code, f"--from-times of {tmp_path}/b.kitti" in refused.err) == (1, True)


def test_every_file_that_a_verb_reads_beside_a_drive_is_known_to_batches():
    for name, batched in BATCHED.items():
        read = {option.name for option in verb_named(name).params if isinstance(option.type, click.Path)}
        assert read | ({"detectors"} & {o.name for o in verb_named(name).params}) == {*batched.beside}, name


def test_every_output_of_a_verb_is_known_to_batches():
    for name, batched in BATCHED.items():
        written = {option.name for option in verb_named(name).params if option.type.name == "target"}
        assert written - {batched.output} == {*batched.folders, *batched.files}, name


def test_options_of_the_verb_are_those_of_the_run(call, tmp_path):
    reported = call("batch", "convert", "--help").out
    assert "--images" in reported
    assert "--overwrite" not in reported
    refused = call("batch", "convert", tmp_path, "-o", tmp_path / "out", "--images", "aligned")
    assert (refused.code, "aligned" in refused.err) == (2, True)
    nothing = call("batch", "fuse", tmp_path / "*.sfs", "-o", tmp_path / "out")
    assert (nothing.code, "fits this pattern" in nothing.err) == (2, True)


def test_the_verb_finds_its_record_by_the_address(call, recording, tmp_path, monkeypatch):
    (tmp_path / "run1").mkdir()
    store = f"local://{tmp_path}/run1"
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    done = call("batch", "validate", recording, "-o", store, "--workers", 1, "--quick")
    assert done.code == 0, done.err
    assert f"outputs: {store}" in done.out
    assert f"record: {tmp_path}/state/sceneloom/runs/run1-" in done.out
    assert {path.name for path in (tmp_path / "run1").iterdir()} == {
        ".sceneloom-run",
        f"{recording.name}.json",
    }
    reported = call("batch", "status", store, "--json")
    assert [row["state"] for row in json.loads(reported.out)["drives"]] == ["done"]
    refused = call("batch", "validate", recording, "-o", "https://host/run", "--quick")
    assert (refused.code, "web server" in refused.err) == (1, True)
