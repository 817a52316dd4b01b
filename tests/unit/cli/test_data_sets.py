"""Data sets of several drives on the command line: one is chosen, and every verb takes it."""

import json

import numpy as np
import pytest
from tests.unit.formats.argoverse2.test_reader import write_log
from tests.unit.formats.nuscenes.schema_folder import street
from tests.unit.formats.pandaset.test_reader import write_drive


@pytest.fixture
def nuscenes(tmp_path):
    return street(tmp_path / "nu", scenes=("scene-0001", "scene-0002")).write()


def test_the_scenes_of_a_data_set_are_listed_where_none_is_chosen(call, nuscenes):
    reported = call("info", nuscenes)
    assert reported.code == 2
    assert "choose one with `--sequence NAME`: scene-0001, scene-0002" in reported.err


def test_one_scene_is_reported_about(call, nuscenes):
    reported = json.loads(call("info", nuscenes, "--sequence", "scene-0002", "--json").out)
    assert (reported["format"], reported["source"]) == ("nuscenes", f"{nuscenes}/scene-0002")
    assert {sensor["id"]: sensor["count"] for sensor in reported["sensors"]} == {
        "LIDAR_TOP": 5,
        "RADAR_FRONT": 5,
        "CAM_FRONT": 5,
    }
    keys = json.loads(call("info", nuscenes, "--sequence", "scene-0002", "--keyframes", "--json").out)
    assert [sensor["count"] for sensor in keys["sensors"]] == [3, 3, 3]


def test_a_scene_is_converted_and_back_without_loss(call, nuscenes, tmp_path):
    for source, target, further in (
        (nuscenes, tmp_path / "out", ("--to", "nuscenes", "--sequence", "scene-0001", "--strict")),
        (tmp_path / "out", tmp_path / "fast", ("--to", "nuscenes", "--output-option", "keyframe_rate_hz=4")),
    ):
        reported = call("convert", source, target, *further)
        assert reported.code == 0, reported.err
    samples = json.loads((tmp_path / "fast" / "v1.0-mini" / "sample.json").read_text("utf-8"))
    assert len(samples) == 5


def test_fusing_takes_one_scene_at_a_time(call, nuscenes, tmp_path):
    two = call(
        "fuse", nuscenes, "--sequence", "scene-0001", "--sequence", "scene-0002", "-o", tmp_path / "a.sfs"
    )
    assert two.code == 2
    assert "one drive is opened at a time; state one" in two.err
    one = call("fuse", nuscenes, "--sequence", "scene-0001", "-o", tmp_path / "a.sfs")
    assert one.code == 0, one.err
    assert "fused 5 of 5 sweeps" in one.out


def test_one_drive_is_stated_once(call, nuscenes):
    two = call("info", nuscenes, "--sequence", "scene-0001", "--sequence", "scene-0002")
    assert (two.code, "one drive is opened at a time; state one" in two.err) == (2, True)


def test_of_two_drives_those_take_a_sequence_that_have_several(call, nuscenes, tmp_path):
    copy, trajectory, chosen = (
        tmp_path / "copy.sfs",
        tmp_path / "trajectory.tum",
        ("--sequence", "scene-0002"),
    )
    assert call("convert", nuscenes, copy, *chosen).code == 0
    assert call("convert", copy, trajectory).code == 0
    reported = call("diff", nuscenes, copy, *chosen)
    assert reported.out.splitlines()[-1] == "1 difference", (
        reported.out + reported.err
    )  # the file counts from its first time
    merged = call("edit", "merge", copy, nuscenes, "--rename", "-o", tmp_path / "both.sfs", *chosen)
    assert merged.code == 0, merged.err
    assert call("eval", "trajectory", copy, nuscenes, *chosen).code == 0
    assert call("eval", "trajectory", trajectory, nuscenes, *chosen).code == 0
    assert call("eval", "tracking", copy, nuscenes, *chosen).code == 0
    fused = ("fuse", copy, "-o", tmp_path / "fused.sfs")
    for none in (
        ("diff", copy, copy),
        ("eval", "trajectory", trajectory, copy),
        ("eval", "tracking", copy, copy),
        fused,
    ):
        refused = call(*none, *chosen)
        assert (refused.code, "--sequence does not count here" in refused.err) == (2, True)


def test_what_to_do_next_is_stated_for_the_same_drive(call, tmp_path):
    broken = write_drive(tmp_path / "my set" / "002")
    write_drive(tmp_path / "my set" / "003")
    (broken / "lidar" / "poses.json").write_text("[")
    reported = call("info", tmp_path / "my set", "--sequence", "002")
    assert f"`sceneloom validate '{tmp_path / 'my set'}' --sequence 002`" in reported.err


def test_the_folder_of_a_drive_has_its_name_from_inside(call, tmp_path, monkeypatch):
    monkeypatch.chdir(write_drive(tmp_path / "set" / "002"))
    reported = json.loads(call("info", ".", "--sequence", "002", "--json").out)
    monkeypatch.chdir(tmp_path)
    assert reported["source"] == json.loads(call("info", tmp_path / "set", "--json").out)["source"]


def test_a_drive_that_its_data_set_lacks_now_is_taken_out_of_a_catalogue(call, nuscenes, tmp_path):
    fleet, table = tmp_path / "fleet", nuscenes / "v1.0-mini" / "scene.json"
    assert call("catalog", "build", nuscenes, "-o", fleet, "--workers", 1).code == 0
    table.write_text(json.dumps(json.loads(table.read_text("utf-8"))[:1]), "utf-8")
    reported = call("catalog", "update", fleet, "--workers", 1)
    assert f"not there any more: {nuscenes} (sequence scene-0002); `--prune`" in reported.out + reported.err
    assert "1 scene: 1 unchanged, 1 taken out" in call("catalog", "update", fleet, "--prune").out


def test_errors_of_a_data_set_behind_a_url_name_the_url(call, nuscenes):
    fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed")
    store = fsspec.filesystem("memory")
    store.put(f"{nuscenes}/", "/two_scenes/", recursive=True)
    reported = call("info", "memory://two_scenes")
    assert (reported.code, reported.err.split()[1]) == (2, "memory://two_scenes/v1.0-mini:"), reported.err
    store.pipe("/two_scenes/v1.0-mini/scene.json", b"[")
    broken = call("info", "memory://two_scenes", "--sequence", "scene-0001")
    store.rm("/two_scenes", recursive=True)
    assert "memory://two_scenes/v1.0-mini/scene.json" in broken.err, broken.err


@pytest.mark.usefixtures("inline")
def test_a_batch_says_which_drive_of_a_data_set_failed(call, nuscenes, tmp_path):
    tables = nuscenes / "v1.0-mini"
    rows = json.loads((tables / "scene.json").read_text("utf-8"))
    rows[1]["nbr_samples"] += 1
    (tables / "scene.json").write_text(json.dumps(rows), "utf-8")
    reported = call("batch", "convert", nuscenes, "-o", tmp_path / "out", "--workers", 1, "--retries", 0)
    assert f"failed: {nuscenes} (sequence scene-0002): " in reported.err, reported.err
    assert f"{nuscenes} (sequence scene-0002)" in call("batch", "status", tmp_path / "out").out


def test_options_of_one_format_go_by_read_with(call, tmp_path):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    log = write_log(tmp_path / "log")
    reported = json.loads(call("info", log, "--input-option", "one_lidar=true", "--json").out)
    assert [sensor["id"] for sensor in reported["sensors"]] == ["lidar", "ring_front_center"]


@pytest.mark.parametrize("kind", ["openlabel", "npz"])
def test_a_rate_stated_by_read_with_is_a_number(call, tmp_path, kind):
    if kind == "openlabel":
        frames = {str(number): {} for number in range(3)}
        drive = tmp_path / "labels.json"
        drive.write_text(
            json.dumps({"openlabel": {"metadata": {"schema_version": "1.0.0"}, "frames": frames}})
        )
    else:
        (drive := tmp_path / "clouds").mkdir()
        for number in range(3):
            np.savez(drive / f"{number}.npz", points=np.ones((4, 3), np.float32))
    reported = call("info", drive, "--input-option", "rate_hz=4", "--json")
    assert (reported.code, reported.err) == (0, "")
    assert kind == "openlabel" or json.loads(reported.out)["duration"] == 0.5
    wrong = call("info", drive, "--input-option", "rate_hz=often")
    assert (wrong.code, "rate_hz often; expected a number above 0" in wrong.err) == (2, True)


def test_a_flag_stated_by_read_with_is_true_or_false(call, tmp_path):
    drive = tmp_path / "clouds"
    drive.mkdir()
    (drive / "1.npz").write_bytes(b"no such thing")
    np.savez(drive / "2.npz", points=np.ones((4, 3), np.float32))
    assert call("info", drive, "--input-option", "lenient=true").code == 0
    assert call("info", drive, "--input-option", "lenient=false").code == 1


def test_data_sets_that_are_only_read_state_what_can_be_written(call, tmp_path):
    drive = write_drive(tmp_path / "002")
    reported = call("convert", drive, tmp_path / "out", "--to", "pandaset")
    assert reported.code == 2
    assert "pandaset" in reported.err.lower()
    done = call("convert", drive, tmp_path / "out.sfs")
    assert done.code == 0, done.err


@pytest.mark.parametrize("verb", ["validate", "info"])
def test_drives_of_pandaset_pass_the_checks(call, tmp_path, verb):
    reported = call(verb, write_drive(tmp_path / "002"))
    assert reported.code == 0, reported.out + reported.err
