"""`sceneloom formats`: the list, and manifests to fill in."""

import json
import tomllib

import pytest
from PIL import Image

from sceneloom.formats import FORMATS


def test_all_formats_are_listed(call):
    listed = {form["name"] for form in json.loads(call("formats --json").out)}
    assert listed >= set(FORMATS)
    assert "rig" in call("formats").out
    assert "euroc" in call("formats").out


def test_a_template_is_written_once(refuses, succeeds, tmp_path):
    path = tmp_path / "rig.toml"
    succeeds("formats --template", path)
    assert tomllib.loads(path.read_text())["sensors"]
    refuses(1, "exists already", "formats --template", path)
    succeeds("formats --template", path, "--overwrite")


def test_whoever_has_a_folder_that_nothing_reads_is_reported_the_template(refuses, tmp_path):
    refuses(1, "sceneloom formats --template FOLDER/rig.toml --from FOLDER", "info", tmp_path)


def test_a_template_is_printed(call):
    assert tomllib.loads(call("formats --template -").out)["sensors"]


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
