"""The pages of the documentation site that are made while it is built."""

import ast
import importlib
import json
import re
import sys
from pathlib import Path

import click
import pytest

from sceneloom.checks.validation import catalogue
from sceneloom.cli.main import sceneloom as command_line

PROJECT = Path(__file__).parents[2]


@pytest.fixture
def hook(monkeypatch):
    """Import a module of the site's hooks."""
    monkeypatch.syspath_prepend(str(PROJECT / "docs" / "hooks"))
    before = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if name in {path.stem for path in PROJECT.glob("docs/hooks/*.py")}:
            del sys.modules[name]


def test_every_command_has_a_page_with_all_of_its_options(hook):
    pages = hook("commands").command_pages(command_line, "sceneloom")
    blur = pages["commands/edit-blur.md"]
    assert blur.startswith("# sceneloom edit blur\n\nRedact faces")
    assert "sceneloom edit blur PATH [OPTIONS]" in blur
    assert "| `--fill [blur|pixelate|black]` |" in blur
    assert "[default: 0.1]" in blur
    context = click.Context(command_line)
    for name in command_line.list_commands(context):
        command = command_line.get_command(context, name)
        if not isinstance(command, click.Group):
            page = pages[f"commands/{name}.md"]
            assert all(option.opts[0] in page for option in command.params if isinstance(option, click.Option))
            assert f"({name}.md)" in pages["commands/index.md"]


def test_every_package_has_a_page_and_so_has_every_class_that_it_offers(hook):
    pages = hook("reference").reference_pages()
    assert "[`sceneloom.colouring`](sceneloom.colouring/index.md)" in pages["reference/index.md"]
    assert "| [`Scene`](Scene.md) | A drive. " in pages["reference/sceneloom.scene/index.md"]
    assert "[`Scene`](../sceneloom.scene/Scene.md)" in pages["reference/sceneloom/index.md"]
    assert "\n::: sceneloom.open\n" in pages["reference/sceneloom/index.md"]
    types = "# SensorType\n\n```python\nfrom sceneloom.scene import SensorType\n\ntype = SensorType.POINTS\n```\n"
    assert pages["reference/sceneloom.scene/SensorType.md"] == f"{types}\n::: sceneloom.scene.SensorType\n"
    assert "\n\nreport = validate(source)\n" in pages["reference/sceneloom.checks/ValidationReport.md"]
    assert "except PoseError as error:" in pages["reference/sceneloom.errors/PoseError.md"]
    assert "From [Simulation](../../simulation.md).\n" in pages["reference/sceneloom.simulate/LidarSpec.md"]
    assert "](../../examples/03_build_a_scene_from_arrays.md).\n" in pages["reference/sceneloom.scene/LidarSensor.md"]
    for location, text in pages.items():
        line = re.search(r"^from (sceneloom\S*) import (\w+)$", text, re.MULTILINE)
        if line is not None:
            assert hasattr(importlib.import_module(line[1]), line[2]), location


def test_every_rule_of_validate_is_on_its_page(hook):
    page = hook("rules").rules_page()
    both, scale = page.split("## Only with `--profile scale`")
    for rule in catalogue():
        marks = ", ".join([rule.severity, *(["fix"] if rule.fixable else [])])
        assert f"| `{rule.id}` | {marks} | {rule.summary} | {rule.remedy} |" in (scale if rule.only_in else both)


@pytest.mark.parametrize(
    ("text", "origin", "page", "expected"),
    [
        ("[a](docs/motion.md#x)", "README.md", "index.md", "[a](motion.md#x)"),
        ("[a](sfs.md)", "docs/formats/rig.md", "formats/rig.md", "[a](sfs.md)"),
        ("[a](../CONTRIBUTING.md)", "docs/ARCHITECTURE.md", "ARCHITECTURE.md", "[a](CONTRIBUTING.md)"),
        ("[a](../../README.md)", "docs/formats/rig.md", "formats/rig.md", "[a](../index.md)"),
        ("[a](../examples/02_fuse_a_drive.py)", "docs/fusion.md", "fusion.md", "[a](examples/02_fuse_a_drive.md)"),
        ("![a](docs/images/depth.jpg)", "README.md", "index.md", "![a](images/depth.jpg)"),
        ("[a](../LICENSE)", "docs/motion.md", "motion.md", "[a](files/LICENSE)"),
        ("[a](https://x.org/y.md) [b](#c)", "README.md", "index.md", "[a](https://x.org/y.md) [b](#c)"),
        ("```\n[a](docs/motion.md)\n```", "README.md", "index.md", "```\n[a](docs/motion.md)\n```"),
    ],
)
def test_links_lead_to_pages_of_the_site_and_files_outside_the_docs_are_asked_for(hook, text, origin, page, expected):
    wanted = []
    assert hook("links").with_site_links(text, origin, page, wanted.append) == expected
    assert ("LICENSE" in wanted) == ("LICENSE" in text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a\n| b |\n| - |\nc", "a\n\n| b |\n| - |\n\nc"),
        ("a\n- b\n- c\n  d\n- e", "a\n\n- b\n- c\n  d\n- e"),
        ("a\n```sh\n| no |\n- no\n```\n| b |", "a\n\n```sh\n| no |\n- no\n```\n\n| b |"),
        ("1. a\n   ```\n   b\n   ```\n2. c", "1. a\n   ```\n   b\n   ```\n\n2. c"),
    ],
)
def test_blocks_begin_after_a_blank_line(hook, text, expected):
    assert hook("layout").spaced(text) == expected


@pytest.mark.parametrize(
    ("page", "is_fetched"),
    [
        ('<script src="https://cdn.example/x.js"></script>', True),
        ('<link rel="stylesheet" href="//fonts.example/a.css">', True),
        ("@import url(https://fonts.example/a.css)", True),
        ("a { background: url('http://x.example/y.png') }", True),
        ('<a href="https://example.org">a link is fetched by those who follow it</a>', False),
        ('<script src="assets/x.js"></script><link rel="canonical" href="https://example.org/">', False),
    ],
)
def test_what_a_browser_would_fetch_from_elsewhere_is_found(hook, page, is_fetched):
    assert (hook("outside").fetched_from_elsewhere(page) is not None) is is_fetched


@pytest.mark.parametrize("notebook", sorted(PROJECT.glob("examples/notebooks/*.ipynb")), ids=lambda path: path.stem)
def test_notebooks_are_kept_with_small_outputs_that_name_no_folder_of_a_machine(notebook):
    found = json.loads(notebook.read_text("utf-8"))
    assert (found["nbformat"], found["cells"][0]["cell_type"]) == (4, "markdown")
    cells = [cell for cell in found["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert any(cell["outputs"] for cell in cells)
    for cell in cells:
        ast.parse("".join(cell["source"]))
        for output in cell["outputs"]:
            text = json.dumps(output)
            assert (output["output_type"] != "error", len(text) < 150_000) == (True, True)
            assert not re.search(r"/(tmp|home|root|work|Users)/", text)


def test_the_outputs_of_a_notebook_are_on_its_page_and_the_first_page_ends_with_sections_of_the_readme(hook):
    examples = hook("examples")
    page = examples.example_page(next(PROJECT.glob("examples/notebooks/01_*.ipynb")))
    assert "<table>" in page
    images = dict(examples.notebook_images())
    linked = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", page)
    assert linked
    assert all(images[f"examples/notebooks/{name}"].startswith(b"\x89PNG") for name in linked)
    shown = hook("front").readme_sections()
    assert [line for line in shown.splitlines() if line.startswith("## ")][:2] == ["## Formats", "## In Python"]
