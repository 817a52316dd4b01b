"""`sceneloom convert` tells people and programs what became of every field."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.unit.cli.conftest import Call


def test_a_short_table_says_what_is_not_simply_kept(call: "Call", recording: Path, tmp_path: Path) -> None:
    outcome = call("convert", recording, tmp_path / "drive.sfs")
    assert outcome.out.strip() == f"{recording} (recording) → {tmp_path / 'drive.sfs'} (sfs)"
    titles = [line.strip() for line in outcome.err.splitlines() if line.startswith("  ") and line[2] != " "]
    assert any(title.startswith("kept: ") for title in titles)
    assert any(title.startswith("kept aside, where other programs do not look: ") for title in titles)
    every = call("convert", recording, tmp_path / "again.sfs", "--verbose").err
    assert "sensors.lidar.frames.points.positions" in every
    assert len(every.splitlines()) > len(outcome.err.splitlines())
    assert call("convert", recording, tmp_path / "quiet.sfs", "--quiet").err == ""


def test_json_lists_every_field(call: "Call", recording: Path, tmp_path: Path) -> None:
    told = json.loads(call("convert", recording, tmp_path / "drive.sfs", "--json").out)
    fates = {row["field"]: row["fate"] for row in told["fields"]}
    assert fates["sensors.lidar.frames.points.positions"] == "kept"
    assert told["written"] is True


def test_strict_refuses_with_the_fields_and_the_next_step(
    call: "Call", recording: Path, tmp_path: Path
) -> None:
    loss = tmp_path / "loss.md"
    outcome = call("convert", recording, tmp_path / "drive.tum", "--strict", "--loss", loss)
    assert (outcome.code, outcome.out) == (1, "")
    assert "is not written, since tum would not hold all: " in outcome.err
    assert "(`sceneloom formats NAME`)" in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["loss.md"]
    assert "## Dropped" in loss.read_text()


def test_a_drive_is_read_as_the_format_that_is_named(call: "Call", recording: Path, tmp_path: Path) -> None:
    refused = call("info", recording, "--read-as", "kitti-raw")
    assert refused.code != 0
    assert call("convert", recording, tmp_path / "drive.sfs", "--read-as", "recording").code == 0
    unknown = call("info", recording, "--read-as", "nope")
    assert (unknown.code, "no format 'nope'" in unknown.err) == (2, True)


def test_an_option_of_another_kind_of_clouds_is_refused(
    call: "Call", recording: Path, tmp_path: Path
) -> None:
    told = call("convert", recording, tmp_path / "ply", "--to", "ply", "--set", "encoding=ascii")
    assert (told.code, "option 'encoding'; writing ply takes frame, lidar" in told.err) == (2, True)
    assert not (tmp_path / "ply").exists()
    assert call("convert", recording, tmp_path / "pcd", "--to", "pcd", "--set", "encoding=ascii").code == 0


def test_pictures_are_placed_along_the_way_that_is_named(
    call: "Call", recording: Path, tmp_path: Path
) -> None:
    done = call("convert", recording, tmp_path / "model", "--to", "colmap", "--trajectory", "groundTruth")
    assert (done.code, (tmp_path / "model" / "sparse").is_dir()) == (0, True), done.err
    unknown = call("convert", recording, tmp_path / "none", "--to", "colmap", "--trajectory", "nix")
    assert (unknown.code == 0, "nix" in unknown.err) == (False, True)


def test_what_the_verb_itself_takes_is_no_option_of_a_format(
    call: "Call", recording: Path, tmp_path: Path
) -> None:
    for name in ("trajectory", "overwrite", "progress"):
        told = call("convert", recording, tmp_path / "model", "--to", "colmap", "--set", f"{name}=x")
        assert (told.code, f"--set {name} does not count here" in told.err) == (2, True)
    for name in ("start", "path", "format"):
        told = call("info", recording, "--read-with", f"{name}=1")
        assert (told.code, f"--read-with {name}: no format has this option" in told.err) == (2, True)
