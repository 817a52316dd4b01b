"""`sceneloom formats`: the list, and manifests to fill in."""

import tomllib

import pytest
from PIL import Image

from sceneloom.formats import FORMATS


def test_all_formats_are_listed_with_what_they_can_do(call, reported):
    known = {form["name"]: form for form in reported("formats")}
    assert set(known) >= set(FORMATS)
    assert [known[name]["suffixes"] for name in ("sfs", "recording", "rig")] == [[".sfs"], [""], [".toml"]]
    assert [known[name]["writes"] for name in ("sfs", "recording", "rig")] == [True, True, False]
    assert known["tum"]["trajectory"]
    assert {"rig", "euroc"} <= set(call("formats").out.split())


def test_formats_says_what_one_of_them_holds(call, refuses, reported):
    held = reported("formats tum")
    assert held["trajectories.positions"] == {"support": "kept", "how": ""}
    assert held["sensors.lidar.id"]["support"] == "dropped"
    assert "dropped (" in call("formats tum").out
    refuses(2, "no format or form 'nope'; there are sfs", "formats nope")


def test_a_template_is_written_once(refuses, succeeds, tmp_path):
    path = tmp_path / "rig.toml"
    succeeds("formats --template", path)
    assert tomllib.loads(path.read_text())["sensors"]
    refuses(1, "exists already", "formats --template", path)
    succeeds("formats --template", path, "--overwrite")
    assert tomllib.loads(succeeds("formats --template -").out)["sensors"], "it is printed"


def test_whoever_has_a_folder_that_nothing_reads_is_reported_the_template(refuses, tmp_path):
    refuses(1, "sceneloom formats --template FOLDER/rig.toml --from FOLDER", "info", tmp_path)


def test_a_look_into_a_folder_names_what_is_in_it(refuses, succeeds, tmp_path):
    (tmp_path / "front").mkdir()
    Image.new("RGB", (8, 6)).save(tmp_path / "front" / "1532402927647951000.png")
    succeeds("formats --template", tmp_path / "rig.toml", "--from", tmp_path)
    (sensor,) = tomllib.loads((tmp_path / "rig.toml").read_text())["sensors"]
    assert (sensor["id"], sensor["files"], sensor["camera_model"]["width"]) == ("front", "front/*.png", 8)
    refuses(1, "still to be filled in", "info", tmp_path)


@pytest.mark.parametrize("option", [("--from", "."), ("--overwrite",)])
def test_options_that_would_do_nothing_are_refused(refuses, option):
    refuses(2, "does nothing without --template", "formats", *option)


def test_a_folder_that_is_not_there_is_bad_data_as_for_every_verb(call, tmp_path):
    outcome = call("formats --template", tmp_path / "rig.toml", "--from", tmp_path / "none")
    assert outcome.code == call("info", tmp_path / "none").code == 1
    assert "no such folder" in outcome.err
    assert not (tmp_path / "rig.toml").exists()
