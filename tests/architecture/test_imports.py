"""A module imports only from rows below its own, little is imported at once, and what is on first use is there."""

import ast
import re
import subprocess
import sys
import tomllib
from dataclasses import fields, is_dataclass
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from inspect import signature
from itertools import chain

import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.formats import FORMATS
from sceneloom.formats.base.registry import format_named
from sceneloom.lazy import imported
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

NAMED = re.compile(r"(sceneloom(?:\.\w+)+):(\w+)")

ROWS = (
    ("__main__",),
    ("cli",),
    ("service", "view", "report", "catalog"),
    ("batch",),
    ("pipeline", "simulate", "evaluate"),
    ("visualization",),
    ("db34t",),
    ("fusion",),
    ("tracking", "calibrate"),
    ("detections",),
    ("checks",),
    ("formats",),
    ("editing",),
    ("motion", "colouring"),
    ("scene",),
    ("cameras",),
    ("geometry", "kernels"),
    ("errors", "arrays", "lazy", "stages", "version", "warnings"),
)
"""The layers from top to bottom. Packages of one layer do not import one another, but for `NEIGHBOURS`."""

NEIGHBOURS = {("arrays", "errors"), ("lazy", "errors"), ("warnings", "errors"), ("warnings", "arrays")}
"""Pairs (importer, imported) inside one layer."""

ROW_OF = {room: number for number, row in enumerate(ROWS) for room in row}

WRAPPERS = {
    "DracoPy": {"formats"},
    "numba": {"kernels", "cameras", "colouring", "motion", "detections", "calibrate", "simulate"},
    "av": {"formats", "simulate"},
    "simplejpeg": {"formats"},
    "PIL": {"formats", "visualization", "simulate"},
    "small_gicp": {"motion", "calibrate"},
    "laspy": {"formats"},
    "lazrs": {"formats"},
    "pyarrow": {"formats", "catalog"},
    "duckdb": {"catalog"},
    "fsspec": {"formats"},
    "scipy": {"cameras", "checks", "motion", "tracking", "calibrate", "detections", "evaluate"},
    "matplotlib": {"report", "evaluate"},
    "jinja2": {"report", "batch"},
    "dask": {"batch"},
    "distributed": {"batch"},
    "google": {"formats", "db34t", "service"},
    "grpc": {"service", "db34t"},
    "grpc_health": {"service", "db34t"},
    "grpc_reflection": {"service", "db34t"},
    "mcap": {"formats", "service"},
    "lz4": {"formats"},
    "rosbags": {"formats"},
    "ruamel": {"formats"},
    "zstandard": {"formats"},
    "foxglove_schemas_protobuf": {"formats"},
    "rerun": {"view"},
    "click": {"cli"},
    "rich": {"cli"},
    "numpy": set(ROW_OF),
    "msgspec": set(ROW_OF),
}
"""Each third party and the rooms that may wrap it."""


def room_of(module_name: str) -> str:
    """The room of a module: the first name after `sceneloom`, or "" for the package's own front."""
    parts = module_name.split(".")
    return parts[1] if len(parts) > 1 else ""


def may_import(room: str, other: str) -> bool:
    """Whether a module of one room may import from another."""
    if room in ("", other):
        return True
    if other == "":
        return False
    return ROW_OF[other] > ROW_OF[room] or (room, other) in NEIGHBOURS


def test_a_module_imports_only_from_rows_below_its_own(modules):
    unknown = {room for m in modules if (room := room_of(m.name)) and room not in ROW_OF}
    assert not unknown, f"rooms without a row: {unknown}; add them to ROWS and to docs/ARCHITECTURE.md"
    wrong = [
        f"{module.name}, line {line}: {name}"
        for module in modules
        for name, line in module.imports
        if name.split(".")[0] == "sceneloom" and not may_import(room_of(module.name), room_of(name))
    ]
    assert not wrong
    # the rule reports right from wrong
    right = {("formats", "scene"), ("simulate", "formats"), ("arrays", "errors"), ("", "cli")}
    wrong = {("scene", "formats"), ("simulate", "pipeline"), ("service", "view"), ("geometry", "kernels")}
    wrong |= {("errors", "arrays"), ("scene", "")}
    assert {pair for pair in right | wrong if may_import(*pair)} == right


FORMAT_ROWS = (
    (
        *("nuscenes", "openlabel", "labelling", "kitti", "pandaset", "argoverse2", "euroc_mav", "scale_toolkit"),
        *("cloud_labelling", "waymo", "zod", "ncore"),
    ),
    ("sfs", "recording", "rig", "messages", "posed_images"),
    ("points", "packets", "rig_files"),
    ("trajectories", "video", "gnss_logs"),
    ("remote",),
    ("base",),
)
"""The packages inside `formats` from top to bottom: those of one layer do not import one another."""

FORMAT_ROW_OF = {package: number for number, row in enumerate(FORMAT_ROWS) for package in row}


def test_formats_import_only_formats_of_layers_below_their_own(modules):
    wrong = set()
    for module in modules:
        package = module.name.split(".")[2:3]
        if not module.name.startswith("sceneloom.formats.") or package[0] not in FORMAT_ROW_OF:
            continue
        for name, line in module.imports:
            other = name.split(".")[2] if name.startswith("sceneloom.formats.") else ""
            if other in FORMAT_ROW_OF and other != package[0] and FORMAT_ROW_OF[other] <= FORMAT_ROW_OF[package[0]]:
                wrong.add(f"{module.name}, line {line}: {name}")
    assert not wrong


def test_no_modules_import_one_another_in_a_circle(modules):
    """Imports at the top of modules; those inside functions come later."""
    known = {module.name for module in modules}
    graph = {}
    for module in modules:
        top = {node.lineno for node in module.tree.body if isinstance(node, ast.ImportFrom)}
        graph[module.name] = {name for name, line in module.imports if line in top and name in known}
    with pytest.raises(CycleError):
        TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()
    TopologicalSorter(graph).prepare()


def test_a_third_party_is_declared_and_imported_only_in_the_rooms_that_wrap_it(modules, project):
    own = {*sys.stdlib_module_names, "sceneloom"}
    found = [(module, name.split(".")[0], line) for module in modules for name, line in module.imports]
    foreign = [row for row in found if row[1] not in own]
    wrong = [
        f"{module.name}, line {line}: {name}"
        for module, name, line in foreign
        if room_of(module.name) not in WRAPPERS.get(name, set())
    ]
    assert not wrong, "WRAPPERS says who wraps what"
    declared = tomllib.loads((project / "pyproject.toml").read_text("utf-8"))["project"]
    requirements = [*declared["dependencies"], *chain(*declared["optional-dependencies"].values())]
    names = {requirement.split(">")[0].split("=")[0].split("[")[0] for requirement in requirements}
    distributions = {
        "PIL": "pillow", "distributed": "dask", "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
        "google": "protobuf", "rerun": "rerun-sdk", "ruamel": "ruamel.yaml", "grpc": "grpcio",
        "grpc_health": "grpcio-health-checking", "grpc_reflection": "grpcio-reflection", "small_gicp": "small-gicp",
    }  # fmt: skip
    assert {distributions.get(name, name) for _, name, _ in foreign} <= names


def test_benchmarks_and_examples_import_what_is_there(project, modules):
    names = {module.name for module in modules}
    for path in chain(project.glob("benchmarks/*.py"), project.glob("examples/*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "sceneloom":
                assert node.module in names, f"{path.name}:{node.lineno}"


OPENED = """
import sys
import numpy, msgspec
opened = []
watching = True
sys.addaudithook(lambda event, args: opened.append(str(args[0])) if event == "open" and watching else None)
import sceneloom
watching = False
code = (".py", ".pyc", ".so")
print(*(name for name in opened if not name.endswith(code) and ".pyc." not in name), sep="\\n")
"""


def imported_by(statement: str) -> tuple[int, set[str]]:
    """How many of our modules a statement imports in a fresh interpreter, and the third parties."""
    names = run_python(f"import sys; {statement}; print(*sys.modules)")
    foreign = {name.partition(".")[0] for name in names} - set(sys.stdlib_module_names) - {"sceneloom"}
    return sum(name.partition(".")[0] == "sceneloom" for name in names), foreign


def test_the_package_its_model_and_specs_load_only_numpy_and_msgspec():
    assert run_python(OPENED) == [], "no file but modules"
    _, light = imported_by("import numpy, msgspec")
    for statement in (
        "import sceneloom",
        "from sceneloom import Poses, Scene, SceneloomError, open, write",
        "import sceneloom.scene, sceneloom.formats, sceneloom.cameras, sceneloom.geometry",
        "from sceneloom.formats.base.registry import format_named, format_names; [*map(format_named, format_names())]",
    ):
        count, others = imported_by(statement)
        assert others <= light, statement
    assert count <= 90


def run_python(program: str) -> list[str]:
    """Run a program in a fresh interpreter outside the checkout and give the words that it prints."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_opening_a_drive_imports_nothing_of_other_formats(tmp_path):
    camera = CameraSpec(Camera("pinhole", 32, 24, 20.0, 20.0, 15.5, 11.5))
    scene = simulate_street(1, frames=2, lidar=LidarSpec(beams=4, steps=40), cameras=(camera,)).scene
    for name, most in (("drive.sfs", 110), ("drive", 130)):
        sceneloom.write(scene, tmp_path / name)
        count, _ = imported_by(f"import sceneloom; sceneloom.open({str(tmp_path / name)!r})")
        assert count <= most


def test_what_is_named_to_be_imported_on_first_use_is_there(modules):
    named = {
        match.groups()
        for module in modules
        for node in module.nodes
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        if (match := NAMED.fullmatch(node.value))
    }
    assert len(named) > 50
    absent = [f"{module}:{name}" for module, name in named if not hasattr(import_module(module), name)]
    assert not absent


@pytest.mark.parametrize("name", FORMATS)
def test_a_format_is_what_its_row_says_and_its_reader_and_writer_take_what_it_states(name):
    spec, row = format_named(name), FORMATS[name]
    assert spec.name == name
    assert spec.suffixes
    assert spec.reads or spec.writes
    assert spec.reads == bool(row.file or row.folder)
    assert spec.instead or (spec.reads and spec.writes)
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
