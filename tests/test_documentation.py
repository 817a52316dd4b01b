"""What the documentation promises is there: commands, examples, links, and a row for every part."""

import ast
import pkgutil
import re
import runpy
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
from click import Command, Context, Group

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.cli.main import sceneloom as program
from sceneloom.formats import FORMATS
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

PROJECT = Path(__file__).parents[1]
PAGES = sorted([*PROJECT.glob("*.md"), *PROJECT.glob("docs/**/*.md"), *PROJECT.glob("examples/*.md")])
EXAMPLES = sorted(PROJECT.glob("examples/*.py"))
RUNNABLE = [PROJECT / "README.md", PROJECT / "docs" / "formats" / "sfs.md", PROJECT / "docs" / "samples.md"]
"""Pages whose Python runs as it stands, in a folder with a recording `drive` and a scene `drive.sfs`."""

ALONE = {"10_add_an_algorithm.py"}
"""Examples that change what Python finds, and would change it for the tests after them."""

EXAMPLE_LIMIT_S = 240

FENCE = re.compile(r"^```(?P<language>\w*)\n(?P<text>.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?<!!)\[[^\]]*\]\((?P<target>[^)\s]+)\)|!\[[^\]]*\]\((?P<image>[^)\s]+)\)")
SHELL_LANGUAGES = {"", "sh", "shell", "bash", "console", "text"}


def fenced(path: Path, languages: set[str]) -> list[str]:
    """The text of all fenced blocks of a page in one of the languages."""
    blocks = FENCE.finditer(path.read_text("utf-8"))
    return [block["text"] for block in blocks if block["language"] in languages]


def invocations(path: Path) -> list[list[str]]:
    """The words after `sceneloom` in every shell line of a page, up to a comment, pipe or next command."""
    found = []
    for block in fenced(path, SHELL_LANGUAGES):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"&&|\||;", line.split("  #")[0]):
                words = part.removeprefix("$ ").split()
                if words[:1] == ["sceneloom"]:
                    found.append(words[1:])
    return found


def command_named(words: list[str]) -> tuple[Command, list[str]]:
    """Follow the words of a line into the program's groups; give the command and the words that are left."""
    command: Command = program
    while words and isinstance(command, Group):
        inner = command.get_command(Context(command), words[0])
        if inner is None:
            break
        command, words = inner, words[1:]
    return command, words


def known_options(command: Command) -> set[str]:
    """All option names of a command."""
    own = {name for p in command.params for name in (*p.opts, *p.secondary_opts) if name.startswith("-")}
    return own | {"--help"}


def anchors(path: Path) -> set[str]:
    """The anchors that headings of a page get."""
    headings = re.findall(r"^#+ (.+)$", path.read_text("utf-8"), re.MULTILINE)
    kept = (re.sub(r"[^\w\- ]", "", heading.lower().replace("`", "")) for heading in headings)
    return {heading.strip().replace(" ", "-") for heading in kept}


@pytest.fixture(params=["here", pytest.param("alone", marks=pytest.mark.slow)])
def run(request, tmp_path, monkeypatch, capsys):
    """Run a program in a folder of its own and give what it prints.

    Here, what was imported before is there already: half of what a program takes by itself. Alone, in an interpreter of
    its own, it must import all that it needs.
    """

    def ran(program: Path) -> str:
        if request.param == "here" and program.name not in ALONE:
            runpy.run_path(str(program), run_name="__main__")
            return capsys.readouterr().out
        words = [sys.executable, "-W", "error", str(program)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=EXAMPLE_LIMIT_S, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["program"])
    return ran


@pytest.mark.parametrize("page", RUNNABLE, ids=lambda page: page.stem)
def test_python_in_the_documentation_runs(page, run, tmp_path):
    camera = CameraSpec(Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5))
    drive = simulate_street(1, frames=2, lidar=LidarSpec(beams=8, steps=90), cameras=(camera,)).scene
    sceneloom.write(drive, tmp_path / "drive", images="png")
    if page.name != "README.md":  # which makes it
        sceneloom.write(drive, tmp_path / "drive.sfs")
    for number, text in enumerate(fenced(page, {"python"})):
        program = tmp_path / f"block{number}.py"
        program.write_text(text, "utf-8")
        run(program)


OTHER_NAMES = re.compile(r"sceneloom\.(db34t4101\..*|Sample|sensor_data_fusion|detection_fusion|(sfs|toml|html|prom)$)")
"""Names that look like ours in Python and are of services, schemas, entry points and files."""


def is_there(name: str) -> bool:
    """Whether a dotted name is a module, or leads from one to what it has."""
    module, _, attribute = name.rpartition(".")
    try:
        return bool(import_module(name))
    except ModuleNotFoundError:
        return bool(module) and is_there(module) and hasattr(pkgutil.resolve_name(module), attribute)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(PROJECT).as_posix())
def test_commands_python_names_and_links_of_a_page_are_there(page):
    for words in invocations(page):
        command, rest = command_named(words)
        assert not (isinstance(command, Group) and rest and not rest[0].startswith("-")), f"no command {words}"
        options = {word.split("=")[0] for word in rest if re.match(r"-{1,2}[a-z]", word)}
        assert options <= known_options(command), f"sceneloom {' '.join(words)}"
    for block in fenced(page, {"python", "py"}):
        ast.parse(block)
    text = page.read_text("utf-8")
    reported = set(re.findall(r"(?<![\w./\"])sceneloom(?:\.[A-Za-z_]\w*)+", text))
    assert not sorted(name for name in reported if not OTHER_NAMES.match(name) and not is_there(name))
    for match in LINK.finditer(text):
        target = match["target"] or match["image"]
        if not re.match(r"[a-z]+:", target):
            name, _, anchor = target.partition("#")
            goal = (page.parent / name).resolve() if name else page
            assert goal.exists(), target
            assert not anchor or anchor in anchors(goal), target


@pytest.mark.parametrize(
    "example",
    [pytest.param(path, marks=pytest.mark.slow if path.name[:2] in {"04", "06", "10"} else ()) for path in EXAMPLES],
    ids=lambda path: path.stem,
)
def test_examples_run(example, run):
    assert run(example).strip(), "an example says what it did"


def test_examples_are_short_and_use_public_names_only():
    for example in EXAMPLES:
        text = example.read_text("utf-8")
        tree = ast.parse(text)
        assert re.fullmatch(r"\d\d_[a-z]+_[a-z_]+", example.stem)
        assert ast.get_docstring(tree), example
        assert len(text.splitlines()) < 60, example
        private = [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and n.attr.startswith("_")]
        assert not private, example


SHARED_PAGES = dict.fromkeys(("pcd", "ply", "las", "laz", "kitti-bin", "nuscenes-bin", "npz"), "clouds") | {
    **dict.fromkeys(("pcap", "lvx"), "packets"),
    **dict.fromkeys(("nmea", "ubx", "rtklib"), "gnss-logs"),
    **dict.fromkeys(("waymo", "kitti-360", "zod"), "driving-sets"),
    "ros1": "ros",
    "ros2": "ros",
    **dict.fromkeys(("urdf", "kalibr", "camera-info"), "rig"),
    **dict.fromkeys(("cvat", "tracklets", "coco", "datumaro", "yolo", "label-studio"), "labelling"),
    **dict.fromkeys(("supervisely", "segments", "scale-task", "sustechpoints"), "cloud-labelling"),
}
"""Formats that are reported on one page, and its name."""


def test_formats_rooms_versions_and_first_commands_stand_in_their_pages():
    def text(*path: str) -> str:
        return PROJECT.joinpath(*path).read_text("utf-8")

    pages = (PROJECT / "docs" / "formats" / f"{SHARED_PAGES.get(name, name)}.md" for name in FORMATS)
    assert [page for page in pages if not page.is_file()] == []
    rooms = [path.name for path in (PROJECT / "src" / "sceneloom").iterdir() if (path / "__init__.py").exists()]
    assert [room for room in rooms if f"`{room}/`" not in text("docs", "ARCHITECTURE.md")] == []
    declared = tomllib.loads(text("pyproject.toml"))["project"]
    versions = [line.split(" :: ")[-1] for line in declared["classifiers"] if re.search(r":: 3\.\d+$", line)]
    assert declared["requires-python"] == f">={versions[0]}"
    assert all(version in text(".ci", "deep") for version in versions)
    assert f"## [{sceneloom.__version__}]" in text("CHANGELOG.md")
    for command in ("pip install . && sceneloom demo", "pip install '.[dev]' && pytest"):
        assert command in text("README.md").splitlines()
        assert f'step "{command}"' in text(".ci", "run").splitlines()
