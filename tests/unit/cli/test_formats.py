"""`sceneloom formats`: the list, and manifests to fill in."""

import json
import tomllib

import pytest
from PIL import Image

from sceneloom.formats import FORMATS


def test_all_formats_are_listed(call):
    listed = {form["name"] for form in json.loads(call("formats", "--json").out)}
    assert listed >= set(FORMATS)
    assert "rig" in call("formats").out
    assert "euroc" in call("formats").out


def test_a_template_is_written_once(call, tmp_path):
    path = tmp_path / "rig.toml"
    assert call("formats", "--template", path).code == 0
    assert tomllib.loads(path.read_text())["sensors"]
    again = call("formats", "--template", path)
    assert (again.code, "exists already" in again.err) == (1, True)
    assert call("formats", "--template", path, "--overwrite").code == 0


def test_whoever_has_a_folder_that_nothing_reads_is_reported_the_template(call, tmp_path):
    outcome = call("info", tmp_path)
    assert (outcome.code, "sceneloom formats --template FOLDER/rig.toml --from FOLDER" in outcome.err) == (1, True)


def test_a_template_is_printed(call):
    assert tomllib.loads(call("formats", "--template", "-").out)["sensors"]


def test_a_look_into_a_folder_names_what_is_in_it(call, tmp_path):
    (tmp_path / "front").mkdir()
    Image.new("RGB", (8, 6)).save(tmp_path / "front" / "1532402927647951000.png")
    outcome = call("formats", "--template", tmp_path / "rig.toml", "--from", tmp_path)
    assert outcome.code == 0
    (sensor,) = tomllib.loads((tmp_path / "rig.toml").read_text())["sensors"]
    assert (sensor["id"], sensor["files"], sensor["camera_model"]["width"]) == ("front", "front/*.png", 8)
    reported = call("info", tmp_path)
    assert (reported.code, "still to be filled in" in reported.err) == (1, True)


@pytest.mark.parametrize("option", [("--from", "."), ("--overwrite",)])
def test_options_that_would_do_nothing_are_refused(call, option):
    outcome = call("formats", *option)
    assert (outcome.code, "does nothing without --template" in outcome.err) == (2, True)


def test_a_folder_that_is_not_there_is_bad_data_as_for_every_verb(call, tmp_path):
    outcome = call("formats", "--template", tmp_path / "rig.toml", "--from", tmp_path / "none")
    assert outcome.code == call("info", tmp_path / "none").code == 1
    assert "no such folder" in outcome.err
    assert not (tmp_path / "rig.toml").exists()
