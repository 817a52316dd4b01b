"""What a path is reported to be where no format claims it, or more than one does."""

from pathlib import Path

import pytest

from sceneloom.errors import OptionError, UnknownFormatError
from sceneloom.formats.base import registry
from sceneloom.formats.base.registry import FORMATS, find_format, format_for_output, format_named, open_scene
from sceneloom.formats.base.spec import FormatSpec


def log_line(folder: Path) -> None:
    (folder / "data.jsonl").write_text('{"time":1.0,"groundTruth":{"position":{"x":0,"y":0,"z":0}}}\n')


def test_two_formats_in_one_folder_are_both_named_and_one_can_be_chosen(tmp_path):
    log_line(tmp_path)
    (tmp_path / "rig.toml").write_text("[sensors.top]\n")
    with pytest.raises(
        UnknownFormatError, match=r"more than one reader claims this: recording, .*; rig, .*--input-format"
    ):
        find_format(tmp_path)
    with open_scene(tmp_path, format="recording") as scene:
        assert scene.format == "recording"


def test_a_folder_of_drives_names_what_is_inside(tmp_path):
    (tmp_path / "monday").mkdir()
    log_line(tmp_path / "monday")
    with pytest.raises(UnknownFormatError, match=r"no reader knows this; inside are .*monday \(recording\)"):
        find_format(tmp_path)


def test_a_path_that_nothing_knows_lists_all_formats_that_are_read(tmp_path):
    (tmp_path / "notes.doc").write_text("hello")
    with pytest.raises(UnknownFormatError) as caught:
        find_format(tmp_path / "notes.doc")
    named = [name for name in FORMATS if format_named(name).reads]
    assert str(caught.value).endswith(f"expected one of: {', '.join(named)}")


def test_what_is_empty_is_reported_to_be(tmp_path):
    (tmp_path / "nothing.sfs").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    for name in ("nothing.sfs", "folder"):
        with pytest.raises(UnknownFormatError, match=r"no reader knows this; it is empty; expected one of"):
            find_format(tmp_path / name)


@pytest.mark.parametrize("name", FORMATS)
def test_no_format_claims_an_empty_folder_or_a_file_of_noise(name, tmp_path):
    (tmp_path / "noise").write_bytes(bytes(range(256)) * 9)
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    form = format_named(name)
    claimed = [entry.name for entry in tmp_path.iterdir() if form.reads and form.sniff(entry)]
    assert claimed == []


TWIN = FormatSpec(name="twin", title="a twin", suffixes=(".sfs",), looks_like="its twin", writer="twins:write")
"""A format with the suffix of another."""


def test_a_suffix_of_two_formats_asks_for_a_name(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "all_formats", lambda: [*map(format_named, FORMATS), TWIN])
    with pytest.raises(OptionError, match=r"belongs to several formats; state `--to sfs` or `--to twin`"):
        format_for_output(tmp_path / "drive.sfs")


def test_every_suffix_names_one_format_that_is_written(tmp_path):
    for name in FORMATS:
        form = format_named(name)
        for suffix in form.suffixes if form.writes else ():
            if suffix:
                assert format_for_output(tmp_path / f"drive{suffix}").name == name, suffix


def test_a_name_without_a_suffix_is_a_recording(tmp_path):
    assert format_for_output(tmp_path / "drive").name == "recording"
