"""A page for every package that offers names, for the reference made from docstrings."""

import ast
from pathlib import Path

from links import PROJECT

_SOURCES = PROJECT / "src"
_OFFERED = (
    "sceneloom",
    "sceneloom.scene",
    "sceneloom.formats",
    "sceneloom.cameras",
    "sceneloom.geometry",
    "sceneloom.motion",
    "sceneloom.editing",
    "sceneloom.checks",
    "sceneloom.colouring",
    "sceneloom.detections",
    "sceneloom.tracking",
    "sceneloom.calibrate",
    "sceneloom.fusion",
    "sceneloom.db34t",
    "sceneloom.visualization",
    "sceneloom.pipeline",
    "sceneloom.simulate",
    "sceneloom.evaluate",
    "sceneloom.view",
    "sceneloom.report",
    "sceneloom.service",
    "sceneloom.errors",
)
"""In the order from what one meets first to what stands on top."""


def reference_pages() -> dict[str, str]:
    """The text of each page, by its location on the site: what mkdocstrings fills in."""
    pages, rows = {}, []
    for name in _OFFERED:
        tree = _tree(name)
        if tree is None:
            continue
        location = f"reference/{name}.md"
        pages[location] = f"# {name}\n\n::: {name}\n"
        first = (ast.get_docstring(tree) or "").split("\n")[0]
        rows.append(f"| [`{name}`]({name}.md) | {first} |")
    listing = "\n".join(["| package | what is in it |", "| --- | --- |", *rows])
    pages["reference/index.md"] = f"# Reference\n\nWhat each package offers, from its docstrings.\n\n{listing}\n"
    return pages


def _tree(name: str) -> ast.Module | None:
    """The syntax of a package's front, or of a module."""
    location = _SOURCES / Path(*name.split("."))
    file = next((path for path in (location / "__init__.py", location.with_suffix(".py")) if path.is_file()), None)
    return None if file is None else ast.parse(file.read_text("utf-8"))
