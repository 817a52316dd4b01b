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
FIRST_COMMANDS = ("pip install . && sceneloom demo", "pip install '.[dev]' && pytest")

FENCE = re.compile(r"^```(?P<language>\w*)\n(?P<text>.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?<!!)\[[^\]]*\]\((?P<target>[^)\s]+)\)|!\[[^\]]*\]\((?P<image>[^)\s]+)\)")
SHELL_LANGUAGES = {"", "sh", "shell", "bash", "console", "text"}


def page_id(path: Path) -> str:
    """Name a page in the list of tests."""
    return path.relative_to(PROJECT).as_posix()


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


@pytest.fixture
def run_alone(tmp_path):
    """Run a program in an interpreter of its own, in a folder of its own, and give what it prints."""

    def started(program: Path) -> str:
        done = subprocess.run(
            [sys.executable, "-W", "error", str(program)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=EXAMPLE_LIMIT_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return started


@pytest.fixture(params=["here", pytest.param("alone", marks=pytest.mark.slow)])
def run(request, run_alone, tmp_path, monkeypatch, capsys):
    """Run a program in a folder of its own and give what it prints.

    Here, what was imported before is there already: half of what a program takes by itself. Alone, it must import all
    that it needs.
    """

    def ran(program: Path) -> str:
        runpy.run_path(str(program), run_name="__main__")
        return capsys.readouterr().out

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["program"])
    return ran if request.param == "here" else run_alone


@pytest.mark.parametrize("command", FIRST_COMMANDS)
def test_the_readme_and_the_check_script_hold_the_same_first_commands(command):
    assert command in (PROJECT / "README.md").read_text("utf-8").splitlines()
    assert f'step "{command}"' in (PROJECT / ".ci" / "run").read_text("utf-8").splitlines()


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_every_command_in_the_documentation_exists_with_its_options(page):
    for words in invocations(page):
        command, rest = command_named(words)
        assert not (isinstance(command, Group) and rest and not rest[0].startswith("-")), f"no command {words}"
        options = {word.split("=")[0] for word in rest if re.match(r"-{1,2}[a-z]", word)}
        assert options <= known_options(command), f"sceneloom {' '.join(words)}"


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_python_in_the_documentation_can_be_parsed(page):
    for text in fenced(page, {"python", "py"}):
        ast.parse(text)


@pytest.mark.parametrize("page", RUNNABLE, ids=page_id)
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


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_names_in_the_documentation_are_there(page):
    reported = set(re.findall(r"(?<![\w./\"])sceneloom(?:\.[A-Za-z_]\w*)+", page.read_text("utf-8")))
    assert not sorted(name for name in reported if not OTHER_NAMES.match(name) and not is_there(name))


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_somewhere(page):
    broken = []
    for match in LINK.finditer(page.read_text("utf-8")):
        target = match["target"] or match["image"]
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        goal = (page.parent / name).resolve() if name else page
        if not goal.exists() or (anchor and anchor not in anchors(goal)):
            broken.append(target)
    assert not broken


@pytest.mark.parametrize(
    "example",
    [pytest.param(path, marks=pytest.mark.slow if path.name[:2] in {"04", "06", "10"} else ()) for path in EXAMPLES],
    ids=page_id,
)
def test_examples_run(example, run, run_alone):
    reported = run_alone(example) if example.name in ALONE else run(example)
    assert reported.strip(), "an example says what it did"


@pytest.mark.parametrize("example", EXAMPLES, ids=page_id)
def test_examples_are_short_and_use_public_names_only(example):
    text = example.read_text("utf-8")
    tree = ast.parse(text)
    assert re.fullmatch(r"\d\d_[a-z]+_[a-z_]+", example.stem)
    assert ast.get_docstring(tree)
    assert len(text.splitlines()) < 60
    private = [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and n.attr.startswith("_")]
    assert not private


SHARED_PAGES = dict.fromkeys(("pcd", "ply", "las", "laz", "kitti-bin", "nuscenes-bin", "npz"), "clouds") | {
    "ros1": "ros",
    "ros2": "ros",
}
"""Formats that are reported on one page, and its name."""


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_has_a_page(name):
    assert (PROJECT / "docs" / "formats" / f"{SHARED_PAGES.get(name, name)}.md").is_file()


def test_every_room_of_the_house_stands_in_the_architecture_page():
    page = (PROJECT / "docs" / "ARCHITECTURE.md").read_text("utf-8")
    rooms = [path.name for path in (PROJECT / "src" / "sceneloom").iterdir() if (path / "__init__.py").exists()]
    assert not [room for room in rooms if f"`{room}/`" not in page]


def test_every_version_that_is_supported_is_announced():
    declared = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["project"]
    versions = [line.split(" :: ")[-1] for line in declared["classifiers"] if re.search(r":: 3\.\d+$", line)]
    assert declared["requires-python"] == f">={versions[0]}"
    assert all(version in (PROJECT / ".ci" / "deep").read_text("utf-8") for version in versions)


def test_the_changelog_has_the_version_that_is_built():
    version = (PROJECT / "src" / "sceneloom" / "version.py").read_text("utf-8").split('"')[-2]
    assert f"## [{version}]" in (PROJECT / "CHANGELOG.md").read_text("utf-8")
