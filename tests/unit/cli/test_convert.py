"""`sceneloom convert` reports people and programs what became of every field."""

import json
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import sceneloom
from sceneloom import convert
from sceneloom import open as open_drive
from sceneloom.formats.base.registry import format_named, written_formats

if TYPE_CHECKING:
    from tests.unit.cli.conftest import Call

FILES_OF_ONE_DRIVE = ("sfs", "mcap", "ros1", "openlabel")


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
    reported = json.loads(call("convert", recording, tmp_path / "drive.sfs", "--json").out)
    supports = {row["field"]: row["support"] for row in reported["fields"]}
    assert supports["sensors.lidar.frames.points.positions"] == "kept"
    assert reported["written"] is True


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
    refused = call("info", recording, "--input-format", "kitti-raw")
    assert refused.code != 0
    assert call("convert", recording, tmp_path / "drive.sfs", "--input-format", "recording").code == 0
    unknown = call("info", recording, "--input-format", "nope")
    assert (unknown.code, "no format 'nope'" in unknown.err) == (2, True)


def test_an_option_of_another_kind_of_clouds_is_refused(
    call: "Call", recording: Path, tmp_path: Path
) -> None:
    reported = call(
        "convert", recording, tmp_path / "ply", "--to", "ply", "--output-option", "encoding=ascii"
    )
    assert (reported.code, "option 'encoding'; writing ply takes frame, lidar" in reported.err) == (2, True)
    assert not (tmp_path / "ply").exists()
    assert (
        call("convert", recording, tmp_path / "pcd", "--to", "pcd", "--output-option", "encoding=ascii").code
        == 0
    )


def test_images_are_placed_along_the_trajectory_that_is_named(
    call: "Call", recording: Path, tmp_path: Path
) -> None:
    done = call("convert", recording, tmp_path / "model", "--to", "colmap", "--trajectory", "groundTruth")
    assert (done.code, (tmp_path / "model" / "sparse").is_dir()) == (0, True), done.err
    stands = call(
        "convert", recording, tmp_path / "tables", "--to", "nuscenes", "--trajectory", "identity", "--json"
    )
    assert "the ego is taken to stand" in stands.out, stands.err
    unknown = call("convert", recording, tmp_path / "none", "--to", "colmap", "--trajectory", "nix")
    assert (unknown.code == 0, "nix" in unknown.err) == (False, True)


def test_what_the_verb_itself_takes_is_no_option_of_a_format(
    call: "Call", recording: Path, tmp_path: Path
) -> None:
    for name in ("trajectory", "overwrite", "progress"):
        reported = call(
            "convert", recording, tmp_path / "model", "--to", "colmap", "--output-option", f"{name}=x"
        )
        assert (reported.code, f"--output-option {name} does not count here" in reported.err) == (2, True)
    for name in ("start", "path", "format"):
        reported = call("info", recording, "--input-option", f"{name}=1")
        assert (reported.code, f"--input-option {name}: no format has this option" in reported.err) == (
            2,
            True,
        )


def _tree(folder: Path) -> dict[str, bytes | None]:
    found = {path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}
    return {str(path.relative_to(folder)): content for path, content in found.items()}


@pytest.mark.few(9)
@pytest.mark.parametrize("name", written_formats())
def test_a_folder_is_replaced_only_by_its_like_and_never_with_the_source_in_it(
    call: "Call", recording: Path, tmp_path: Path, name: str
) -> None:
    drive, own = tmp_path / "drive.sfs", tmp_path / "own"
    convert(recording, drive)
    suffixes = format_named(name).suffixes
    if name in FILES_OF_ONE_DRIVE:
        own = own.with_suffix(suffixes[0])
    for _ in range(2):
        outcome = call("convert", drive, own, "--to", name, "--overwrite", "--quiet")
        assert outcome.code == 0, outcome.err
    assert own.is_dir() is (name not in FILES_OF_ONE_DRIVE)
    if own.is_file():
        outcome = call("convert", own, own, "--to", name, "--overwrite")
        assert (outcome.code, "is read by this very run" in outcome.err) == (1, True)
        return
    (own / "thesis.odt").write_text("mine")
    before = _tree(own)
    outcome = call("convert", drive, own, "--to", name, "--overwrite")
    assert (outcome.code, "thesis.odt" in outcome.err) == (1, True)
    assert _tree(own) == before
    home = tmp_path / "home"
    home.mkdir()
    drive = drive.rename(home / "drive.sfs")
    before = _tree(home)
    outcome = call("convert", drive, home, "--to", name, "--overwrite")
    assert (outcome.code, _tree(home)) == (1, before)
    assert "choose another name" in outcome.err


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("kitti-odometry", "poses/05.txt"),  # the downloaded trajectory of another sequence
        ("recording", "lidar/notes.txt"),
        ("ros2", "yesterday.mcap"),
        ("kitti-raw", "2011_09_26/2011_09_26_drive_0099_sync/oxts/data/0000000000.txt"),
        ("kitti-tracking", "training/label_02/0007.txt"),
        ("nuscenes", "v1.0-own/sample.json"),
        ("nerfstudio", "images/sketch.png"),
        ("pcd", "notes.pcd"),
    ],
)
def test_a_folder_with_one_more_file_of_another_drive_is_not_replaced(
    call: "Call", recording: Path, tmp_path: Path, name: str, file: str
) -> None:
    own = tmp_path / "own"
    assert call("convert", recording, own, "--to", name, "--quiet").code == 0
    (own / file).parent.mkdir(parents=True, exist_ok=True)
    (own / file).write_text("mine")
    before = _tree(own)
    outcome = call("convert", recording, own, "--to", name, "--overwrite")
    assert (outcome.code, _tree(own)) == (1, before)
    assert "choose another name" in outcome.err


@pytest.mark.parametrize(
    "arguments",
    [
        ("edit", "crop", "{0}", "--start", "0.1", "-o", "{0}"),
        ("fuse", "{0}", "-o", "{0}"),
        ("convert", "{0}", "{0}"),
        ("convert", "{0}", "{1}", "--loss", "{0}"),
        ("report", "{0}", "-o", "{1}", "--numbers", "{0}"),
        ("salvage", "{0}", "-o", "{0}"),
        ("validate", "{0}", "--fix", "{0}"),
        ("edit", "merge", "{0}", "{0}", "-o", "{0}"),
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_no_verb_replaces_the_file_that_it_reads(
    call: "Call", recording: Path, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    drive = tmp_path / ("drive.json" if {"--numbers", "--loss"} & {*arguments} else "drive.sfs")
    convert(recording, tmp_path / "first.sfs")
    (tmp_path / "first.sfs").rename(drive)
    before = drive.read_bytes()
    outcome = call(*(text.format(drive, tmp_path / "out.html") for text in arguments), "--overwrite")
    assert (outcome.code, "is read by this very run" in outcome.err) == (1, True), outcome.err
    assert drive.read_bytes() == before


@pytest.mark.parametrize(
    "arguments",
    [
        ("convert", "{0}", "{0}/data.jsonl", "--to", "jsonl"),
        ("convert", "{0}", "{0}/calibration.json", "--to", "sfs"),
        ("fuse", "{0}", "-o", "{0}/old.sfs"),
        ("report", "{0}", "-o", "{0}/page.html"),
        ("report", "{0}", "--numbers", "{0}/calibration.json"),
        ("edit", "crop", "{0}", "--start", "0.1", "-o", "{0}/lidar/000001.bin"),
    ],
    ids=lambda arguments: arguments[-1],
)
def test_no_verb_replaces_a_file_of_the_folder_that_it_reads(
    call: "Call", recording: Path, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    for name in ("old.sfs", "page.html"):
        (recording / name).write_text("mine")
    before = _tree(recording)
    outcome = call(*(text.format(recording) for text in arguments), "--overwrite")
    assert (outcome.code, "which is read by this very run" in outcome.err) == (1, True), outcome.err
    assert _tree(recording) == before


def test_channels_of_nuscenes_are_named_on_the_command_line(call, recording, tmp_path):
    with open_drive(recording) as scene:
        lidar = scene.lidars[0].id
    words = ("convert", recording, tmp_path / "out", "--to", "nuscenes", "--channel")
    assert call(*words, f"{lidar}=LIDAR_ROOF").code == 0
    (table,) = (tmp_path / "out").rglob("sensor.json")
    assert "LIDAR_ROOF" in {row["channel"] for row in json.loads(table.read_text())}
    unknown = call(*words, "nix=LIDAR_TOP", "--overwrite")
    assert unknown.code == 2
    assert "nix" in unknown.err


def test_b_frames_in_mcap_are_reported_with_a_remedy_that_works(recording, call, tmp_path):
    drive = tmp_path / "drive"
    with sceneloom.open(recording) as scene:
        sceneloom.write(scene, drive, images="h264")
    found = call("convert", drive, tmp_path / "copied.mcap")
    assert found.code == 0
    assert "B frames" in found.err
    remedy = re.search("`(--output-option images=.*?)`", found.err)[1].split()
    again = call("convert", drive, tmp_path / "anew.mcap", *remedy)
    assert (again.code, "B frames" in again.err) == (0, False)
    with sceneloom.open(tmp_path / "anew.mcap") as scene:
        (camera,) = scene.cameras
        assert camera.video is None
        assert all(image.encoded is not None for image in camera.images)


def test_info_shows_the_intrinsics_of_single_images(recording, call, tmp_path):
    drive = tmp_path / "drive"
    shutil.copytree(recording, drive)
    lines = [json.loads(line) for line in (drive / "data.jsonl").read_text().splitlines()]
    entries = [entry for line in lines for entry in line.get("frames", ())]
    for k, entry in enumerate(entries):
        entry["cameraParameters"] = {"focalLengthX": 60.0 + k, "focalLengthY": 61.0}
    (drive / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert (
        f"{len(entries)} camera models among {len(entries)} images: fx 60 to {59 + len(entries)} px"
        in call("info", drive).out
    )
    (camera,) = [s for s in json.loads(call("info", drive, "--json").out)["sensors"] if s["type"] == "camera"]
    assert camera["intrinsics"]["fx"] == [60.0, 59.0 + len(entries)]
    assert camera["intrinsics"]["fy"] == [61.0, 61.0]
