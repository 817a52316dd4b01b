"""`sceneloom convert`: formats, folders and data sets."""

import json
import re
import shutil

import numpy as np
import pytest
from tests.unit.formats.argoverse2.test_reader import write_log
from tests.unit.formats.nuscenes.schema_folder import street
from tests.unit.formats.pandaset.test_reader import write_drive

import sceneloom
from sceneloom import convert
from sceneloom.formats.base.registry import format_named, written_formats

FILES_OF_ONE_DRIVE = ("sfs", "mcap", "ros1", "openlabel", "urdf", "kalibr")


def test_a_short_table_says_what_is_not_simply_kept_and_strict_refuses_it(call, reported, recording, tmp_path):
    outcome = call("convert", recording, tmp_path / "drive.sfs")
    headline, ending = outcome.out.splitlines()
    assert headline == f"{recording} (recording) → {tmp_path / 'drive.sfs'} (sfs)"
    assert ending.startswith(f"wrote 3 sweeps, 3 images and 1 trajectory to {tmp_path / 'drive.sfs'}, ")
    titles = [line.strip() for line in outcome.err.splitlines() if line.startswith("  ") and line[2] != " "]
    assert any(title.startswith("kept: ") for title in titles)
    assert any(title.startswith("kept aside, where other programs do not look: ") for title in titles)
    every = call("convert", recording, tmp_path / "again.sfs", "--verbose").err
    assert "sensors.lidar.frames.points.positions" in every
    assert len(every.splitlines()) > len(outcome.err.splitlines())
    assert call("convert", recording, tmp_path / "quiet.sfs", "--quiet").err == ""
    report = reported("convert", recording, tmp_path / "json.sfs", "--time-unit", "nanoseconds")
    assert b'"time_unit":"nanoseconds"' in (tmp_path / "json.sfs").read_bytes()
    supports = {row["field"]: row["support"] for row in report["fields"]}
    assert (supports["sensors.lidar.frames.points.positions"], report["written"]) == ("kept", True)
    (folder := tmp_path / "strict").mkdir()
    outcome = call("convert", recording, folder / "drive.tum", "--strict", "--loss", folder / "loss.md")
    assert (outcome.code, outcome.out) == (1, "")
    assert "is not written, since tum would not hold all: " in outcome.err
    assert "(`sceneloom formats NAME`)" in outcome.err
    assert [path.name for path in folder.iterdir()] == ["loss.md"]
    assert "## Dropped" in (folder / "loss.md").read_text()


def test_formats_and_their_options_are_named_on_the_command_line(refuses, call, succeeds, recording, tmp_path):
    assert call("info", recording, "--input-format", "kitti-raw").code != 0
    succeeds("convert", recording, tmp_path / "drive.sfs", "--input-format", "recording")
    refuses(2, "no format 'nope'", "info", recording, "--input-format", "nope")
    ply, pcd, model = (("convert", recording, tmp_path / name, "--to", name) for name in ("ply", "pcd", "colmap"))
    encoding = ("--output-option", "encoding=ascii")
    refuses(2, "option 'encoding'; writing ply takes frame, lidar", *ply, *encoding)
    assert not (tmp_path / "ply").exists()
    succeeds(*pcd, *encoding)
    for name in ("trajectory", "overwrite", "progress"):
        refuses(2, f"--output-option {name} does not count here", *model, "--output-option", f"{name}=x")
    for name in ("start", "path", "format"):
        stated = f"--input-option {name}: no format has this option"
        refuses(2, stated, "info", recording, "--input-option", f"{name}=1")
    assert "nix" in call(*model, "--trajectory", "nix").err
    succeeds(*model, "--trajectory", "groundTruth")
    assert (tmp_path / "colmap" / "sparse").is_dir()
    tables = ("convert", recording, tmp_path / "tables", "--to", "nuscenes")
    assert "the ego is taken to stand" in succeeds(*tables, "--trajectory", "identity", "--json").out
    succeeds(*tables, "--channel", "lidar=LIDAR_ROOF", "--overwrite")
    (table,) = (tmp_path / "tables").rglob("sensor.json")
    assert "LIDAR_ROOF" in {row["channel"] for row in json.loads(table.read_text())}
    refuses(2, "nix", *tables, "--channel", "nix=LIDAR_TOP", "--overwrite")


def _tree(folder):
    found = {path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}
    return {str(path.relative_to(folder)): content for path, content in found.items()}


@pytest.mark.few(9)
@pytest.mark.parametrize("name", written_formats())
def test_a_folder_is_replaced_only_by_its_like_and_never_with_the_source_in_it(
    refuses, succeeds, recording, tmp_path, name
):
    drive, own = tmp_path / "drive.sfs", tmp_path / "own"
    convert(recording, drive)
    suffixes = format_named(name).suffixes
    if name in FILES_OF_ONE_DRIVE:
        own = own.with_name(f"{own.name}{suffixes[0]}")
    words = ("--to", name, "--overwrite")
    for _ in range(2):
        succeeds("convert", drive, own, *words, "--quiet")
    assert own.is_dir() is (name not in FILES_OF_ONE_DRIVE)
    if own.is_file():
        if format_named(name).reads:
            refuses(1, "is read by this very run", "convert", own, own, *words)
        return
    (own / "thesis.odt").write_text("mine")
    before = _tree(own)
    refuses(1, "thesis.odt", "convert", drive, own, *words)
    assert _tree(own) == before
    (home := tmp_path / "home").mkdir()
    drive = drive.rename(home / "drive.sfs")
    before = _tree(home)
    refuses(1, "choose another name", "convert", drive, home, *words)
    assert _tree(home) == before


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
def test_a_folder_with_a_file_of_another_drive_is_not_replaced(refuses, succeeds, recording, tmp_path, name, file):
    own = tmp_path / "own"
    succeeds("convert", recording, own, "--to", name, "--quiet")
    (own / file).parent.mkdir(parents=True, exist_ok=True)
    (own / file).write_text("mine")
    before = _tree(own)
    refuses(1, "choose another name", "convert", recording, own, "--to", name, "--overwrite")
    assert _tree(own) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ("edit", "crop", "{file}", "--start", "0.1", "-o", "{file}"),
        ("fuse", "{file}", "-o", "{file}"),
        ("convert", "{file}", "{file}"),
        ("convert", "{file}", "{out}", "--loss", "{file}"),
        ("report", "{file}", "-o", "{out}", "--numbers", "{file}"),
        ("salvage", "{file}", "-o", "{file}"),
        ("validate", "{file}", "--fix", "{file}"),
        ("edit", "merge", "{file}", "{file}", "-o", "{file}"),
        ("convert", "{folder}", "{folder}/data.jsonl", "--to", "jsonl"),
        ("convert", "{folder}", "{folder}/calibration.json", "--to", "sfs"),
        ("fuse", "{folder}", "-o", "{folder}/old.sfs"),
        ("report", "{folder}", "-o", "{folder}/page.html"),
        ("report", "{folder}", "--numbers", "{folder}/calibration.json"),
        ("edit", "crop", "{folder}", "--start", "0.1", "-o", "{folder}/lidar/000001.bin"),
    ],
    ids=" ".join,
)
def test_no_verb_replaces_the_file_or_a_file_of_the_folder_that_it_reads(refuses, recording, tmp_path, arguments):
    folder = shutil.copytree(recording, tmp_path / "drive")
    for name in ("old.sfs", "page.html"):
        (folder / name).write_text("mine")
    convert(recording, tmp_path / "first.sfs")
    names = {"file": tmp_path / ("own.json" if {"--numbers", "--loss"} & {*arguments} else "own.sfs")}
    names |= {"folder": folder, "out": tmp_path / "out.html"}
    (tmp_path / "first.sfs").rename(names["file"])
    before = _tree(tmp_path)
    refuses(1, "is read by this very run", *(text.format(**names) for text in arguments), "--overwrite")
    assert _tree(tmp_path) == before


def test_b_frames_in_mcap_are_reported_with_a_remedy_that_works(recording, succeeds, tmp_path):
    with sceneloom.open(recording) as scene:
        sceneloom.write(scene, tmp_path / "drive", images="h264")
    found = succeeds("convert", tmp_path / "drive", tmp_path / "copied.mcap")
    assert "B frames" in found.err
    remedy = re.search("`(--output-option images=.*?)`", found.err)[1].split()
    assert "B frames" not in succeeds("convert", tmp_path / "drive", tmp_path / "anew.mcap", *remedy).err
    with sceneloom.open(tmp_path / "anew.mcap") as scene:
        (camera,) = scene.cameras
        assert (camera.video, all(image.encoded is not None for image in camera.images)) == (None, True)


def test_info_shows_the_intrinsics_of_single_images(recording, succeeds, reported, tmp_path):
    drive = shutil.copytree(recording, tmp_path / "drive")
    lines = [json.loads(line) for line in (drive / "data.jsonl").read_text().splitlines()]
    entries = [entry for line in lines for entry in line.get("frames", ())]
    for k, entry in enumerate(entries):
        entry["cameraParameters"] = {"focalLengthX": 60.0 + k, "focalLengthY": 61.0}
    (drive / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    count = len(entries)
    assert f"{count} camera models among {count} images: fx 60 to {59 + count} px" in succeeds("info", drive).out
    (camera,) = [s for s in reported("info", drive)["sensors"] if s["type"] == "camera"]
    assert [camera["intrinsics"][name] for name in ("fx", "fy")] == [[60.0, 59.0 + count], [61.0, 61.0]]


@pytest.fixture
def nuscenes(tmp_path):
    return street(tmp_path / "nu", scenes=("scene-0001", "scene-0002")).write()


def test_one_scene_is_chosen_fused_and_converted_without_loss(refuses, reported, succeeds, nuscenes, tmp_path):
    one, two, to = ("--sequence", "scene-0001"), ("--sequence", "scene-0002"), ("--to", "nuscenes")
    refuses(2, "choose one with `--sequence NAME`: scene-0001, scene-0002", "info", nuscenes)
    report = reported("info", nuscenes, *two)
    assert (report["format"], report["source"]) == ("nuscenes", f"{nuscenes}/scene-0002")
    counts = {sensor["id"]: sensor["count"] for sensor in report["sensors"]}
    assert counts == {"LIDAR_TOP": 5, "RADAR_FRONT": 5, "CAM_FRONT": 5}
    assert [sensor["count"] for sensor in reported("info", nuscenes, *two, "--keyframes")["sensors"]] == [3, 3, 3]
    fuse = ("fuse", nuscenes, "-o", tmp_path / "a.sfs", *one)
    for words in (("info", nuscenes, *one), fuse):
        refuses(2, "one drive is opened at a time; give one", *words, *two)
    assert "fused 5 of 5 sweeps" in succeeds(*fuse).out
    succeeds("convert", nuscenes, tmp_path / "out", *to, *one, "--strict")
    succeeds("convert", tmp_path / "out", tmp_path / "fast", *to, "--output-option", "keyframe_rate_hz=4")
    assert len(json.loads((tmp_path / "fast" / "v1.0-mini" / "sample.json").read_text("utf-8"))) == 5


def test_of_two_drives_those_take_a_sequence_that_have_several(call, refuses, succeeds, nuscenes, tmp_path):
    copy, trajectory, chosen = (tmp_path / "copy.sfs", tmp_path / "trajectory.tum", ("--sequence", "scene-0002"))
    succeeds("convert", nuscenes, copy, *chosen)
    succeeds("convert", copy, trajectory)
    found = call("diff", nuscenes, copy, *chosen)
    assert found.out.splitlines()[-1] == "1 difference", found  # the file counts from its first time
    succeeds("edit merge", copy, nuscenes, "--rename", "-o", tmp_path / "both.sfs", *chosen)
    succeeds("eval trajectory", copy, nuscenes, *chosen)
    succeeds("eval trajectory", trajectory, nuscenes, *chosen)
    succeeds("eval tracking", copy, nuscenes, *chosen)
    fused = ("fuse", copy, "-o", tmp_path / "fused.sfs")
    for words in (("diff", copy, copy), ("eval trajectory", trajectory, copy), ("eval tracking", copy, copy), fused):
        refuses(2, "--sequence does not count here", *words, *chosen)


def test_a_data_set_that_is_only_read_passes_and_where_it_is_broken_the_next_step_is_for_the_same_drive(
    call, reported, succeeds, tmp_path, monkeypatch
):
    folder, drive = tmp_path / "my set", write_drive(tmp_path / "my set" / "002")
    monkeypatch.chdir(drive)
    report = reported("info . --sequence 002")
    monkeypatch.chdir(tmp_path)
    assert report["source"] == reported("info", folder)["source"]
    done = call("convert", drive, tmp_path / "out", "--to", "pandaset")
    assert (done.code, "pandaset" in done.err.lower()) == (2, True)
    succeeds("convert", drive, tmp_path / "out.sfs")
    succeeds("validate", drive)
    write_drive(folder / "003")
    (drive / "lidar" / "poses.json").write_text("[")
    assert f"`sceneloom validate '{folder}' --sequence 002`" in call("info", folder, "--sequence", "002").err


def test_a_catalogue_and_errors_behind_a_url_name_the_drive_of_the_data_set(call, succeeds, nuscenes, tmp_path):
    fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed")
    store = fsspec.filesystem("memory")
    store.put(f"{nuscenes}/", "/two_scenes/", recursive=True)
    reported = call("info memory://two_scenes")
    assert (reported.code, reported.err.split()[1]) == (2, "memory://two_scenes/v1.0-mini:"), reported.err
    store.pipe("/two_scenes/v1.0-mini/scene.json", b"[")
    broken = call("info memory://two_scenes --sequence scene-0001")
    store.rm("/two_scenes", recursive=True)
    assert "memory://two_scenes/v1.0-mini/scene.json" in broken.err, broken.err
    fleet, table = tmp_path / "fleet", nuscenes / "v1.0-mini" / "scene.json"
    succeeds("catalog build", nuscenes, "-o", fleet, "--workers", 1)
    table.write_text(json.dumps(json.loads(table.read_text("utf-8"))[:1]), "utf-8")
    reported = call("catalog update", fleet, "--workers", 1)
    assert f"not there any more: {nuscenes} (sequence scene-0002); `--prune`" in reported.out + reported.err
    assert "1 scene: 1 unchanged, 1 taken out" in call("catalog update", fleet, "--prune").out


@pytest.mark.usefixtures("inline")
def test_a_batch_says_which_drive_of_a_data_set_failed(call, nuscenes, tmp_path):
    tables = nuscenes / "v1.0-mini"
    rows = json.loads((tables / "scene.json").read_text("utf-8"))
    rows[1]["nbr_samples"] += 1
    (tables / "scene.json").write_text(json.dumps(rows), "utf-8")
    reported = call("batch convert", nuscenes, "-o", tmp_path / "out", "--workers", 1, "--retries", 0)
    assert f"failed: {nuscenes} (sequence scene-0002): " in reported.err, reported.err
    assert f"{nuscenes} (sequence scene-0002)" in call("batch status", tmp_path / "out").out


def test_options_of_one_format_are_a_number_or_true_or_false(call, refuses, reported, succeeds, tmp_path):
    labels, clouds = tmp_path / "labels.json", tmp_path / "clouds"
    frames = {str(number): {} for number in range(3)}
    labels.write_text(json.dumps({"openlabel": {"metadata": {"schema_version": "1.0.0"}, "frames": frames}}))
    clouds.mkdir()
    for number in range(3):
        np.savez(clouds / f"{number}.npz", points=np.ones((4, 3), np.float32))
    for drive in (labels, clouds):
        assert succeeds("info", drive, "--input-option", "rate_hz=4", "--json").err == ""
        refuses(2, "rate_hz often; expected a number above 0", "info", drive, "--input-option", "rate_hz=often")
    assert reported("info", clouds, "--input-option", "rate_hz=4")["duration"] == 0.5
    (clouds / "0.npz").write_bytes(b"no such thing")
    succeeds("info", clouds, "--input-option", "lenient=true")
    assert call("info", clouds, "--input-option", "lenient=false").code == 1
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    report = reported("info", write_log(tmp_path / "log"), "--input-option", "one_lidar=true")
    assert [sensor["id"] for sensor in report["sensors"]] == ["lidar", "ring_front_center"]


def test_a_rig_is_taken_beside_a_drive_and_written_and_what_is_wrong_with_it_is_named(
    succeeds, refuses, recording, tmp_path
):
    succeeds("convert", recording, tmp_path / "car.urdf")
    out = succeeds("info", recording, "--rig", tmp_path / "car.urdf", "--json").out
    assert json.loads(out)["sensors"] == json.loads(succeeds("info", recording, "--json").out)["sensors"]
    moved = (tmp_path / "car.urdf").read_text().replace('"lidar"', '"roof"').replace('xyz="', 'xyz="1')
    (tmp_path / "car.urdf").write_text(moved)
    words = ("info", recording, "--rig", tmp_path / "car.urdf", "--rig-name", "lidar=roof")
    assert "the rig replaces the mounting of sensor 'lidar'" in succeeds(*words, "-v").err
    refuses(2, "rig name top=roof: no sensor 'top'", *words[:-1], "top=roof")
    refuses(2, "none.urdf", "info", recording, "--rig", tmp_path / "none.urdf")
    (tmp_path / "car.urdf").write_text(moved.replace("fixed", "welded"))
    refuses(1, "car.urdf: joint 'lidar_joint': type 'welded'; expected one of fixed", *words)
