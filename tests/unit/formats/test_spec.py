"""Specs and rows of the table: what they rule out, what they import, and what other packages add."""

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from sceneloom.errors import MissingExtraError, OptionError, UnknownOptionError
from sceneloom.formats.base import registry
from sceneloom.formats.base.registry import FORMATS, FormatRow, find_format, formats_that_may_be
from sceneloom.formats.base.spec import FormatSpec
from sceneloom.scene import Scene


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


@pytest.fixture
def theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another package's format is installed."""

    class Point(EntryPoint):
        def load(self) -> FormatSpec:
            return THEIRS

    point = Point("theirs", "theirs:FORMAT", "sceneloom.formats")
    monkeypatch.setattr(registry, "_entry_points", lambda: (point,))


@pytest.mark.usefixtures("theirs")
def test_a_format_of_another_package_is_asked_of_every_path(tmp_path, monkeypatch):
    (tmp_path / "a.bin").write_bytes(b"THEIRS")
    assert find_format(tmp_path / "a.bin") is THEIRS
    monkeypatch.setattr("sceneloom.formats.base.spec.imported", lambda name: globals()[name.partition(":")[2]])
    with registry.open_scene(tmp_path / "a.bin", loud=True) as scene:
        assert scene.metadata["loud"] is True


def test_options_that_are_not_stated_are_none_and_unknown_ones_are_refused(monkeypatch):
    monkeypatch.setattr("sceneloom.formats.base.spec.imported", lambda name: globals()[name.partition(":")[2]])
    assert THEIRS.open("a", loud=None).metadata["loud"] is False
    with pytest.raises(UnknownOptionError, match="opening theirs"):
        THEIRS.open("a", quiet=True)


def test_the_missing_direction_says_what_to_do_instead(tmp_path):
    with pytest.raises(OptionError, match="theirs is only read"):
        THEIRS.write(Scene(()), tmp_path / "a")


def test_an_extra_that_is_missing_is_named_before_anything_is_imported():
    spec = FormatSpec(
        name="x", title="x", looks_like="x", reader="none:none", extra="mcap", needs=("not_there_at_all",)
    )
    with pytest.raises(MissingExtraError, match=r"sceneloom\[mcap\]"):
        spec.open("a")


@pytest.mark.parametrize(
    ("row", "made", "fits"),
    [
        (FormatRow("", file=(b"{",)), {"": "\ufeff \n {"}, True),
        (FormatRow("", file=(b'{"a":',)), {"": '{ "a" : 1}'}, True),
        (FormatRow("", file=(b'{"a":',)), {"": '{"b": 1}'}, False),
        (FormatRow("", file=(".txt",)), {"": "x"}, True),
        (FormatRow("", folder=(".txt",)), {"": "x"}, False),
        (FormatRow("", folder=("b.csv",)), {"b.csv": ""}, True),
        (FormatRow("", folder=("a/b.csv",)), {"a/b.csv": ""}, True),
        (FormatRow("", folder=("a/b.csv",)), {"b.csv": ""}, False),
        (FormatRow("", folder=("*.pcd",)), {"1.PCD": ""}, True),
        (FormatRow("", folder=("*.pcd",)), {"a/1.pcd": ""}, False),
        (FormatRow("", folder=("*/*.pcd",)), {"a/1.pcd": "", "b.txt": ""}, True),
        (FormatRow("", folder=("v[0-9]*",)), {"v1.0-mini/sample.json": ""}, True),
        (FormatRow("", file=(b"x",)), {"b.csv": "x"}, False),
    ],
)
def test_rows_look_at_beginnings_endings_and_members(row, made, fits, tmp_path):
    path = tmp_path / "drive.txt"
    for name, text in made.items():
        file = path / name if name else path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, "utf-8")
    assert row.fits(registry._LookedAt(path)) is fits


def test_a_file_is_asked_of_those_formats_only_that_begin_so(tmp_path):
    (tmp_path / "drive.sfs").write_bytes(b'{"version": "1.0", "$items": []}\0')
    assert [spec.name for spec in formats_that_may_be(tmp_path / "drive.sfs")] == ["sfs", "recording"]
    (tmp_path / "notes.doc").write_text("hello")
    assert formats_that_may_be(tmp_path / "notes.doc") == []


def test_what_is_only_written_is_asked_of_no_path():
    assert not any(FORMATS[name].file or FORMATS[name].folder for name in ("colmap", "nerfstudio"))
