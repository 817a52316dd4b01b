"""The table of formats: what its rows rule out, what its page says, and what a path is reported to be."""

import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from tests.test_documentation import SHARED_PAGES

from sceneloom.errors import MissingExtraError, OptionError, UnknownFormatError, UnknownOptionError
from sceneloom.formats.base import registry
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.spec import FormatSpec
from sceneloom.formats.listing import list_formats, list_supported_fields
from sceneloom.scene import Scene
from sceneloom.scene.contents import MODEL_FIELDS

PAGE = Path(__file__).parents[3] / "docs" / "converting.md"
SPECS = {name: registry.format_named(name) for name in registry.FORMATS}


def row(form):
    """The row that the page has to have."""
    page = f"formats/{SHARED_PAGES.get(form.name, form.name)}.md"
    name = f"`{form.name}`" if form.trajectory else f"[{form.name}]({page})"
    suffixes = " ".join(f"`{suffix}`" for suffix in form.suffixes if suffix) or (
        f"`--to {form.name}`" if form.name != "recording" else "none"
    )
    both = " | ".join("yes" if can else "no" for can in (form.reads, form.writes))
    return f"| {name} | {both} | {suffixes if form.writes else ''} | {form.looks_like} |".replace("  ", " ")


def test_page_and_help_name_each_format_and_the_page_says_of_it_what_the_code_says():
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith(("| [", "| `"))]
    assert sorted(rows) == sorted(map(row, list_formats()))
    named = registry.open_scene.__doc__.split("Formats: ")[1].split("`sceneloom formats`")[0]
    words = set(re.split(r"[,;.\s]+", named))
    assert {form.name for form in list_formats() if form.reads and not form.trajectory} <= words


def test_a_format_that_is_written_says_something_of_every_field_and_one_that_is_only_read_nothing():
    for name in (name for name, form in SPECS.items() if form.writes):
        assert list(list_supported_fields(name)) == list(MODEL_FIELDS), name
    assert list_supported_fields("rig") == {}
    assert list_supported_fields("tum")["sensors.lidar.id"].support == Support.DROPPED
    with pytest.raises(OptionError, match="no format or form 'nope'"):
        list_supported_fields("nope")


def read_theirs(path: Path, *, loud: bool = False) -> Scene:
    return Scene((), source=str(path), metadata={"loud": loud})


def begins_so(path: Path) -> bool:
    return path.is_file() and path.read_bytes().startswith(b"THEIRS")


THEIRS = FormatSpec(
    name="theirs",
    title="theirs",
    looks_like="a file that begins with THEIRS",
    sniff=begins_so,
    reader=f"{__name__}:read_theirs",
    read_options=("loud",),
    instead="theirs is only read",
)


def test_a_format_of_another_package_is_asked_of_every_path_and_an_extra_that_is_missing_named(tmp_path, monkeypatch):
    monkeypatch.setattr(EntryPoint, "load", lambda self: THEIRS)
    point = EntryPoint("theirs", "theirs:FORMAT", "sceneloom.formats")
    monkeypatch.setattr(registry, "_entry_points", lambda: (point,))
    monkeypatch.setattr("sceneloom.formats.base.spec.imported", lambda name: globals()[name.partition(":")[2]])
    (tmp_path / "a.bin").write_bytes(b"THEIRS")
    assert registry.find_format(tmp_path / "a.bin") is THEIRS
    with registry.open_scene(tmp_path / "a.bin", loud=True) as scene:
        assert scene.metadata["loud"] is True
    # options that are not stated are none, and unknown ones refused
    assert THEIRS.open("a", loud=None).metadata["loud"] is False
    with pytest.raises(UnknownOptionError, match="opening theirs"):
        THEIRS.open("a", quiet=True)
    with pytest.raises(OptionError, match="theirs is only read"):
        THEIRS.write(Scene(()), tmp_path / "b")
    # before anything is imported
    about = {"name": "x", "title": "x", "looks_like": "x", "reader": "none:none", "extra": "mcap"}
    with pytest.raises(MissingExtraError, match=r"sceneloom\[mcap\]"):
        FormatSpec(**about, needs=("not_there_at_all",)).open("a")


@pytest.mark.parametrize(
    ("rule", "made", "fits"),
    [
        ({"file": (b"{",)}, {"": "\ufeff \n {"}, True),
        ({"file": (b'{"a":',)}, {"": '{ "a" : 1}'}, True),
        ({"file": (b'{"a":',)}, {"": '{"b": 1}'}, False),
        ({"file": (".txt",)}, {"": "x"}, True),
        ({"folder": (".txt",)}, {"": "x"}, False),
        ({"folder": ("b.csv",)}, {"b.csv": ""}, True),
        ({"folder": ("a/b.csv",)}, {"a/b.csv": ""}, True),
        ({"folder": ("a/b.csv",)}, {"b.csv": ""}, False),
        ({"folder": ("*.pcd",)}, {"1.PCD": ""}, True),
        ({"folder": ("*.pcd",)}, {"a/1.pcd": ""}, False),
        ({"folder": ("*/*.pcd",)}, {"a/1.pcd": "", "b.txt": ""}, True),
        ({"folder": ("v[0-9]*",)}, {"v1.0-mini/sample.json": ""}, True),
        ({"file": (b"x",)}, {"b.csv": "x"}, False),
    ],
)
def test_rows_look_at_beginnings_endings_and_members(rule, made, fits, tmp_path):
    path = tmp_path / "drive.txt"
    for name, text in made.items():
        file = path / name if name else path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, "utf-8")
    assert registry.FormatRow("", **rule).fits(registry._LookedAt(path)) is fits


def test_two_formats_in_one_folder_are_both_named_and_one_can_be_chosen_and_a_folder_of_drives_names_them(tmp_path):
    monday = tmp_path / "monday"
    monday.mkdir()
    (monday / "data.jsonl").write_text('{"time":1.0,"groundTruth":{"position":{"x":0,"y":0,"z":0}}}\n')
    with pytest.raises(UnknownFormatError, match=r"no reader knows this; inside are .*monday \(recording\)"):
        registry.find_format(tmp_path)
    (monday / "rig.toml").write_text("[sensors.top]\n")
    problem = r"more than one reader claims this: recording, .*; rig, .*--input-format"
    with pytest.raises(UnknownFormatError, match=problem):
        registry.find_format(monday)
    with registry.open_scene(monday, format="recording") as scene:
        assert scene.format == "recording"


def test_a_path_that_nothing_knows_lists_all_formats_that_are_read_and_what_is_empty_is_reported_to_be(tmp_path):
    (tmp_path / "notes.doc").write_text("hello")
    (tmp_path / "noise").write_bytes(bytes(range(256)) * 9)
    (tmp_path / "nothing.sfs").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    named = ", ".join(name for name, form in SPECS.items() if form.reads)
    claims = [(n, path.name) for n, form in SPECS.items() for path in tmp_path.iterdir() if form.sniff(path)]
    assert claims == registry.formats_that_may_be(tmp_path / "notes.doc") == []
    # a file is asked of those formats only that begin so, and what is only written of no path
    (tmp_path / "drive.sfs").write_bytes(b'{"version": "1.0", "$items": []}\0')
    assert [spec.name for spec in registry.formats_that_may_be(tmp_path / "drive.sfs")] == ["sfs", "recording"]
    assert not any(registry.FORMATS[name].file or registry.FORMATS[name].folder for name in ("colmap", "nerfstudio"))
    for name, problem in (
        ("notes.doc", f"expected one of: {named}$"),
        ("nothing.sfs", r"no reader knows this; it is empty; expected one of"),
        ("folder", r"no reader knows this; it is empty; expected one of"),
    ):
        with pytest.raises(UnknownFormatError, match=problem):
            registry.find_format(tmp_path / name)


def test_every_suffix_names_one_format_that_is_written_and_none_a_recording(tmp_path, monkeypatch):
    for name, form in SPECS.items():
        for suffix in filter(None, form.suffixes if form.writes else ()):
            assert registry.format_for_output(tmp_path / f"drive{suffix}").name == name, suffix
    assert registry.format_for_output(tmp_path / "drive").name == "recording"
    twin = FormatSpec(name="twin", title="a twin", suffixes=(".sfs",), looks_like="its twin", writer="twins:write")
    monkeypatch.setattr(registry, "_all_formats", lambda: [*SPECS.values(), twin])
    with pytest.raises(OptionError, match=r"belongs to several formats; use `--to sfs` or `--to twin`"):
        registry.format_for_output(tmp_path / "drive.sfs")
