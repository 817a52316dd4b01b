"""The sources of the package and the files of the project, as the guards of the house look at them."""

import ast
import os
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
SOURCES = PROJECT / "src"
UNTRACKED_FOLDERS = {".git", ".hypothesis", ".venv", "__pycache__", "build", "dist", "sceneloom-demo"}


@dataclass(frozen=True)
class SourceModule:
    """One module of the package with its dotted name, that of the package for an `__init__`, and its syntax tree."""

    name: str
    path: Path
    is_package: bool
    tree: ast.Module

    @cached_property
    def nodes(self) -> tuple[ast.AST, ...]:
        return tuple(ast.walk(self.tree))

    @cached_property
    def imports(self) -> list[tuple[str, int]]:
        """Dotted names of everything that is imported anywhere in the module, with the line."""
        return [found for node in self.nodes for found in self._imports_of(node)]

    def _imports_of(self, node: ast.AST) -> Iterator[tuple[str, int]]:
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            here = self.name.split(".")
            parents = here[: len(here) - node.level + self.is_package] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            yield from ((self._imported(base, alias.name), node.lineno) for alias in node.names)

    @staticmethod
    @cache
    def _imported(base: str, name: str) -> str:
        """Give the module that `from base import name` reaches: `base` itself, or a module inside it."""
        location = SOURCES / base.replace(".", "/") / name
        return f"{base}.{name}" if location.is_dir() or location.with_suffix(".py").is_file() else base


@cache
def source_modules() -> tuple[SourceModule, ...]:
    """All modules of the package, read from the checkout and not from where it is installed."""
    modules = []
    for path in sorted((SOURCES / "sceneloom").rglob("*.py")):
        parts = path.relative_to(SOURCES).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        name = ".".join(parts[:-1] if is_package else parts)
        modules.append(SourceModule(name, path, is_package, ast.parse(path.read_text("utf-8"))))
    return tuple(modules)


@pytest.fixture(scope="session")
def modules() -> tuple[SourceModule, ...]:
    return source_modules()


@pytest.fixture(scope="session")
def packages() -> list[SourceModule]:
    return [module for module in source_modules() if module.is_package]


@pytest.fixture(scope="session")
def project_files() -> list[Path]:
    """The files under version control; in a copy without it, every file but litter."""
    git = shutil.which("git")
    if git is not None and (PROJECT / ".git").exists():
        listed = subprocess.run([git, "ls-files", "-z"], cwd=PROJECT, capture_output=True, check=True, text=True)
        return [PROJECT / name for name in listed.stdout.split("\0") if name and (PROJECT / name).is_file()]
    files = []
    for folder, folders, names in os.walk(PROJECT):
        folders[:] = [name for name in folders if name not in UNTRACKED_FOLDERS and not name.endswith("cache__")]
        files += [Path(folder, name) for name in names]
    return files


@pytest.fixture(scope="session")
def project() -> Path:
    return PROJECT
