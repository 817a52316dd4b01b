"""`sceneloom formats`: the list, and manifests to fill in."""

import tomllib

from PIL import Image

from sceneloom.formats import FORMATS


def test_all_formats_are_listed_with_what_they_can_do_and_one_with_what_it_holds(call, refuses, reported):
    known = {form["name"]: form for form in reported("formats")}
    assert set(known) >= set(FORMATS)
    told = [(known[name]["suffixes"], known[name]["writes"]) for name in ("sfs", "recording", "rig")]
    assert told == [([".sfs"], True), ([""], True), ([".toml"], False)]
    assert known["tum"]["trajectory"]
    assert {"rig", "euroc"} <= set(call("formats").out.split())
    held = reported("formats tum")
    assert held["trajectories.positions"] == {"support": "kept", "how": ""}
    assert held["sensors.lidar.id"]["support"] == "dropped"
    assert "dropped (" in call("formats tum").out
    refuses(2, "no format or form 'nope'; there are sfs", "formats nope")


def test_a_template_is_written_once_and_names_what_is_in_a_folder(call, refuses, succeeds, tmp_path):
    folder, path = tmp_path / "own", tmp_path / "own" / "rig.toml"
    (folder / "front").mkdir(parents=True)
    refuses(1, "sceneloom formats --template FOLDER/rig.toml --from FOLDER", "info", folder)
    Image.new("RGB", (8, 6)).save(folder / "front" / "1532402927647951000.png")
    for option in (("--from", "."), ("--overwrite",)):
        refuses(2, "does nothing without --template", "formats", *option)
    refuses(1, "no such folder", "formats --template", path, "--from", tmp_path / "none")
    assert (call("info", tmp_path / "none").code, path.exists()) == (1, False)
    succeeds("formats --template", path)
    assert tomllib.loads(path.read_text())["sensors"]
    refuses(1, "exists already", "formats --template", path)
    succeeds("formats --template", path, "--overwrite")
    path.unlink()
    succeeds("formats --template", path, "--from", folder)
    (sensor,) = tomllib.loads(path.read_text())["sensors"]
    assert (sensor["id"], sensor["files"], sensor["camera_model"]["width"]) == ("front", "front/*.png", 8)
    refuses(1, "still to be filled in", "info", folder)
    assert tomllib.loads(succeeds("formats --template -").out)["sensors"], "it is printed"
