"""Opening a file imports what reads it and nothing of other formats; what is imported by its name is there."""

import ast
import re
import subprocess
import sys
from dataclasses import fields, is_dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path

import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.formats import FORMATS
from sceneloom.formats.base.registry import format_named
from sceneloom.lazy import imported
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

NAMED = re.compile(r"(sceneloom(?:\.\w+)+):(\w+)")

COUNT = """
import sys
{statement}
modules = [name for name in sys.modules if name.partition(".")[0] == "sceneloom"]
print(len(modules), *sorted({{name.partition(".")[0] for name in sys.modules}} - set(sys.stdlib_module_names)))
"""


def run(statement: str) -> tuple[int, set[str]]:
    """How many of our modules a statement imports in a fresh interpreter, and the third parties."""
    done = subprocess.run(
        [sys.executable, "-c", COUNT.format(statement=statement)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    count, *names = done.stdout.split()
    return int(count), set(names) - {"sceneloom"}


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene file and a recording."""
    folder = tmp_path_factory.mktemp("drives")
    camera = CameraSpec(Camera("pinhole", 32, 24, 20.0, 20.0, 15.5, 11.5))
    scene = simulate_street(1, frames=2, lidar=LidarSpec(beams=4, steps=40), cameras=(camera,)).scene
    sceneloom.write(scene, folder / "drive.sfs")
    sceneloom.write(scene, folder / "drive")
    return folder


@pytest.mark.parametrize(("name", "most"), [("drive.sfs", 110), ("drive", 130)])
def test_opening_a_drive_imports_nothing_of_other_formats(name: str, most: int, drives: Path) -> None:
    count, _ = run(f"import sceneloom; sceneloom.open({str(drives / name)!r})")
    assert count <= most


def test_specs_are_light() -> None:
    count, others = run("from sceneloom.formats.base.registry import all_formats; all_formats()")
    assert count <= 90
    assert others <= run("import numpy, msgspec")[1]


def test_what_is_named_to_be_imported_on_first_use_is_there(modules) -> None:
    named = {
        match.groups()
        for module in modules
        for node in module.nodes
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        if (match := NAMED.fullmatch(node.value))
    }
    assert len(named) > 100
    absent = [f"{module}:{name}" for module, name in named if not hasattr(import_module(module), name)]
    assert not absent


@pytest.mark.parametrize("name", FORMATS)
def test_a_format_of_the_table_is_what_its_row_says(name: str) -> None:
    spec, row = format_named(name), FORMATS[name]
    assert spec.name == name
    assert spec.suffixes
    assert spec.reads or spec.writes
    assert spec.reads == bool(row.file or row.folder)
    assert spec.instead or (spec.reads and spec.writes)


@pytest.mark.parametrize("name", FORMATS)
def test_readers_and_writers_take_what_their_formats_state(name: str) -> None:
    spec = format_named(name)
    for function, options, first in (
        (spec.reader, spec.read_options, ("path",)),
        (spec.writer, spec.write_options, ("scene", "path", "overwrite")),
    ):
        if not function:
            continue
        taken = signature(imported(function)).parameters
        expected = {*first, *spec.given, *(("options",) if is_dataclass(options) else options)}
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in taken.values()):
            assert expected <= set(taken), function
        needed = {key for key, one in taken.items() if one.default is one.empty and one.kind < one.VAR_KEYWORD}
        assert needed <= expected, function
        if is_dataclass(options):
            assert all(field.metadata.get("help") for field in fields(options))
