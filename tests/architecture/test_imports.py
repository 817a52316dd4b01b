"""A module imports only from rows below its own, and `import sceneloom` stays light."""

import ast
import subprocess
import sys
import tomllib
from itertools import chain

import pytest

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
    "numba": {"kernels", "cameras", "colouring", "simulate"},
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


def test_every_room_has_its_row(modules):
    unknown = {room for m in modules if (room := room_of(m.name)) and room not in ROW_OF}
    assert not unknown, f"rooms without a row: {unknown}; add them to ROWS and to docs/ARCHITECTURE.md"


def test_a_module_imports_only_from_rows_below_its_own(modules_of_room):
    for module in modules_of_room:
        room = room_of(module.name)
        wrong = [
            f"line {line}: {name}"
            for name, line in module.imports
            if name.split(".")[0] == "sceneloom" and not may_import(room, room_of(name))
        ]
        assert not wrong, f"{module.name} imports from its own row or above: {wrong}"


FORMAT_ROWS = (
    ("nuscenes", "openlabel", "colmap", "nerfstudio", "kitti", "pandaset", "argoverse2", "euroc_mav", "scale_toolkit"),
    ("sfs", "recording", "rig", "messages", "posed_images"),
    ("points",),
    ("trajectories", "video"),
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
    circles = [name for name in graph if name in _reached(graph, name)]
    assert not circles


def _reached(graph, start):
    """All modules that one imports, directly or through others."""
    seen, todo = set(), list(graph[start])
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            todo += graph[name]
    return seen


def test_a_third_party_is_imported_only_in_the_rooms_that_wrap_it(modules_of_room):
    for module in modules_of_room:
        room = room_of(module.name)
        foreign = [
            (name.split(".")[0], line)
            for name, line in module.imports
            if name.split(".")[0] not in sys.stdlib_module_names and name.split(".")[0] != "sceneloom"
        ]
        wrong = [f"line {line}: {name}" for name, line in foreign if room not in WRAPPERS.get(name, set())]
        assert not wrong, f"{module.name}: {wrong}; WRAPPERS says who wraps what"


def test_every_third_party_that_is_imported_is_declared(modules, project):
    declared = tomllib.loads((project / "pyproject.toml").read_text("utf-8"))["project"]
    requirements = [*declared["dependencies"], *chain(*declared["optional-dependencies"].values())]
    names = {requirement.split(">")[0].split("=")[0].split("[")[0] for requirement in requirements}
    distributions = {
        "PIL": "pillow",
        "distributed": "dask",
        "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
        "google": "protobuf",
        "rerun": "rerun-sdk",
        "ruamel": "ruamel.yaml",
        "grpc": "grpcio",
        "grpc_health": "grpcio-health-checking",
        "grpc_reflection": "grpcio-reflection",
        "small_gicp": "small-gicp",
    }
    imported = {name.split(".")[0] for m in modules for name, _ in m.imports}
    foreign = imported - set(sys.stdlib_module_names) - {"sceneloom"}
    assert {distributions.get(name, name) for name in foreign} <= names


def test_benchmarks_and_examples_import_what_is_there(project, modules):
    names = {module.name for module in modules}
    for path in chain(project.glob("benchmarks/*.py"), project.glob("examples/*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "sceneloom":
                assert node.module in names, f"{path.name}:{node.lineno}"


@pytest.mark.parametrize(
    ("importer", "imported", "allowed"),
    [
        ("formats", "scene", True),
        ("scene", "formats", False),
        ("simulate", "formats", True),
        ("simulate", "pipeline", False),
        ("service", "view", False),
        ("geometry", "kernels", False),
        ("arrays", "errors", True),
        ("errors", "arrays", False),
        ("scene", "", False),
        ("", "cli", True),
    ],
)
def test_the_rule_of_rows_reports_right_from_wrong(importer, imported, allowed):
    assert may_import(importer, imported) is allowed


LOADED = """
import sys
{statement}
print(*sorted({{name.split(".")[0] for name in sys.modules}} - set(sys.stdlib_module_names)))
"""

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


def run_python(program: str) -> str:
    """Run a program in a fresh interpreter outside the checkout and give what it prints."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


LIGHT_STATEMENTS = (
    "import sceneloom",
    "from sceneloom import Poses, Scene, SceneloomError, open, write",
    "import sceneloom.scene, sceneloom.formats, sceneloom.cameras, sceneloom.geometry",
)


@pytest.mark.parametrize("statement", LIGHT_STATEMENTS)
def test_the_package_and_its_model_load_only_numpy_and_msgspec(statement):
    before = set(run_python(LOADED.format(statement="import numpy, msgspec")).split())
    after = set(run_python(LOADED.format(statement=statement)).split())
    assert after - before == {"sceneloom"}


def test_importing_the_package_opens_no_file_but_modules():
    assert run_python(OPENED).split() == []
