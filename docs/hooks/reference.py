"""Pages for every package that offers names, and for every public class, for the reference made from docstrings."""

import ast
import re
import textwrap
from collections.abc import Iterator
from functools import cache
from inspect import cleandoc
from pathlib import Path
from typing import Any

from links import PROJECT, page_of

_SOURCES, _DOCS = PROJECT / "src", PROJECT / "docs"
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

_OPTIONS = "    options: {show_root_heading: true, show_root_full_path: false, show_root_toc_entry: true}"
_MOST_STEPS = 5
"""How often a name may be imported from one module into the next."""


def reference_pages() -> dict[str, str]:
    """The text of each page, by its location on the site: what mkdocstrings fills in."""
    pages: dict[str, str] = {}
    homes = _homes()
    rows = []
    for package in _OFFERED:
        if not _file(package):
            continue
        classes, others = _offered(package)
        pages[f"reference/{package}/index.md"] = _package_page(package, classes, others, homes)
        for name, definition in classes.items():
            if homes[definition] == package:
                pages[f"reference/{package}/{name}.md"] = _class_page(package, name, definition)
        rows.append(f"| [`{package}`]({package}/index.md) | {_first_line(_tree(package))} |")
    listing = "\n".join(["| package | content |", "| --- | --- |", *rows])
    start = "What each package offers, from its docstrings; a page for each class."
    pages["reference/index.md"] = f"# Packages\n\n{start}\n\n{listing}\n"
    return pages


def _package_page(package: str, classes: dict[str, str], others: list[str], homes: dict[str, str]) -> str:
    parts = [f"# {package}", cleandoc(ast.get_docstring(_tree(package)) or "")]
    if classes:
        rows = []
        for name, definition in sorted(classes.items()):
            home = homes[definition]
            location = f"{name}.md" if home == package else f"../{home}/{name}.md"
            rows.append(f"| [`{name}`]({location}) | {_first_line(_definition(definition))} |")
        parts += ["## Classes", "\n".join(["| class | purpose |", "| --- | --- |", *rows])]
    parts += [f"::: {name}\n{_OPTIONS}" for name in sorted(others)]
    return "\n\n".join(parts) + "\n"


def _class_page(package: str, name: str, definition: str) -> str:
    if name not in _public(_tree(package)):
        package = definition.split(":", maxsplit=1)[0]
    code, page = _example(name) or (_use(package, name, definition), None)
    source = f"\n\nFrom [{_titles().get(page, page)}](../../{page_of(page)})." if page else ""
    return f"# {name}\n\n```python\n{code}\n```{source}\n\n::: {package}.{name}\n"


def _example(name: str) -> tuple[str, str] | None:
    """The shortest code of a page that uses a class, and the page; else how an example uses it."""
    uses = re.compile(rf"\b{name}\b(?!,? import)")
    fitting = [(code, page) for code, page in _blocks() if uses.search(re.sub(r"#.*", "", code))]
    return min(fitting or _statements(name), key=lambda found: len(found[0]), default=None)


def _use(package: str, name: str, definition: str) -> str:
    """How one gets an object of a class that no page uses: what gives it, else how it is made."""
    node: Any = _definition(definition)
    stated = [ast.unparse(part) for part in (*node.bases, *node.keywords, *node.decorator_list)]
    start, variable = f"from {package} import {name}\n\n", re.findall("[A-Z][a-z0-9]*", name)[-1].lower()
    if any(base.endswith("Error") or base == "Exception" for base in stated):
        return f"{start}try:\n    ...\nexcept {name} as error:\n    print(error)"
    members = [s.targets[0].id for s in node.body if isinstance(s, ast.Assign) and isinstance(s.targets[0], ast.Name)]
    if members and any("Enum" in base for base in stated):
        return f"{start}{variable} = {name}.{members[0]}"
    if name in _givers():
        giver, function, node = _givers()[name]
        return f"from {giver} import {function}\n\n{variable} = {function}({', '.join(_needed(node.args))})"
    made = [s for s in node.body if isinstance(s, ast.FunctionDef) and s.name == "__init__"]
    unset = (s.target for s in node.body if isinstance(s, ast.AnnAssign) and s.value is None)
    fields = [target.id for target in unset if isinstance(target, ast.Name) and not target.id.startswith("_")]
    if any("kw_only=True" in part for part in stated):
        fields = [f"{field}={field}" for field in fields]
    return f"{start}{variable} = {name}({', '.join(_needed(made[0].args)[1:] if made else fields)})"


def _needed(arguments: ast.arguments) -> list[str]:
    """The arguments that have to be given."""
    positional = [a.arg for a in [*arguments.posonlyargs, *arguments.args]]
    named = zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    given = positional[: len(positional) - len(arguments.defaults)]
    return given + [f"{a.arg}={a.arg}" for a, default in named if default is None]


@cache
def _givers() -> dict[str, tuple[str, str, ast.FunctionDef]]:
    """For each class the first public function whose result is one: the package that offers it, its name there."""
    found: dict[str, tuple[str, str, ast.FunctionDef]] = {}
    for package in _OFFERED:
        for whole in _offered(package)[1] if _file(package) else ():
            home, name = whole.rsplit(".", maxsplit=1)
            definition = _defined(home, name)
            node = definition and _definition(definition)
            if isinstance(node, ast.FunctionDef) and isinstance(node.returns, ast.Name):
                found.setdefault(node.returns.id, (home, name, node))
    return found


def _statements(name: str) -> Iterator[tuple[str, str]]:
    """Of each example that imports a class, the import and the first statement that uses it."""
    for path in sorted((PROJECT / "examples").glob("*.py")):
        text = path.read_text("utf-8")
        tree = ast.parse(text)
        imports = [s for s in tree.body if isinstance(s, ast.ImportFrom) and name in [a.name for a in s.names]]
        uses = (s for s in ast.walk(tree) if isinstance(s, ast.stmt) and not hasattr(s, "body") and _names(s, name))
        first = next(uses, None)
        if imports and first is not None:
            used = textwrap.dedent(" " * first.col_offset + (ast.get_source_segment(text, first) or ""))
            yield f"from {imports[0].module} import {name}\n\n{used}", f"examples/{path.name}"


def _names(statement: ast.stmt, name: str) -> bool:
    return any(isinstance(part, ast.Name) and part.id == name for part in ast.walk(statement))


@cache
def _blocks() -> tuple[tuple[str, str], ...]:
    """The Python of all pages, with the page."""
    return tuple(
        (block.strip("\n"), page)
        for page in _titles()
        for block in re.findall(r"^```py(?:thon)?\n(.*?)^```", _page(page), re.MULTILINE | re.DOTALL)
    )


@cache
def _titles() -> dict[str, str]:
    """The heading of each page in `docs/`."""
    pages = [path.relative_to(_DOCS).as_posix() for path in sorted(_DOCS.rglob("*.md"))]
    return {page: _page(page).removeprefix("# ").split("\n", maxsplit=1)[0] for page in pages}


def _page(page: str) -> str:
    return (_DOCS / page).read_text("utf-8")


def _homes() -> dict[str, str]:
    """The package under which each class has its page: the first that offers it, and `sceneloom` itself last."""
    homes: dict[str, str] = {}
    for package in (*_OFFERED[1:], _OFFERED[0]):
        for definition in _offered(package)[0].values() if _file(package) else ():
            homes.setdefault(definition, package)
    return homes


@cache
def _offered(package: str) -> tuple[dict[str, str], list[str]]:
    """The public classes of a package with where they are defined, and its other public names."""
    classes, others = {}, []
    public = [(package, name) for name in _public(_tree(package))]
    folder = _SOURCES / Path(*package.split("."))
    if not public and folder.is_dir():
        modules = [f"{package}.{path.stem}" for path in sorted(folder.glob("[!_]*.py"))]
        public = [(module, name) for module in modules for name in _public(_tree(module))]
    for module, name in public:
        definition = _defined(module, name)
        if definition is not None and isinstance(_definition(definition), ast.ClassDef):
            classes[name] = definition
        elif not _file(f"{module}.{name}"):
            others.append(f"{module}.{name}")
    return classes, others


def _public(tree: ast.Module) -> list[str]:
    """The names of `__all__`, else those of the public classes and functions that the module defines."""
    for statement in tree.body:
        if isinstance(statement, ast.Assign) and getattr(statement.targets[0], "id", "") == "__all__":
            return list(ast.literal_eval(statement.value))
    defined = [s.name for s in tree.body if isinstance(s, ast.ClassDef | ast.FunctionDef)]
    return [name for name in defined if not name.startswith("_")]


def _defined(module: str, name: str) -> str | None:
    """The module and name that a name leads to, joined by a colon; None of names that no statement defines."""
    for _ in range(_MOST_STEPS):
        if not _file(module):
            return None
        if any(getattr(statement, "name", None) == name for statement in _tree(module).body):
            return f"{module}:{name}"
        imports = [s for s in ast.walk(_tree(module)) if isinstance(s, ast.ImportFrom) and s.module]
        found = [(s.module, a.name) for s in imports for a in s.names if (a.asname or a.name) == name]
        if not found:
            return None
        module, name = found[0]
    return None


def _definition(location: str) -> ast.AST:
    module, name = location.split(":")
    return next(s for s in _tree(module).body if getattr(s, "name", None) == name)


def _first_line(node: ast.AST) -> str:
    return (ast.get_docstring(node) or "").split("\n")[0].replace("|", "\\|")


def _file(name: str) -> Path | None:
    """The file of a package's front, or of a module."""
    location = _SOURCES / Path(*name.split("."))
    return next((path for path in (location / "__init__.py", location.with_suffix(".py")) if path.is_file()), None)


@cache
def _tree(name: str) -> ast.Module:
    file = _file(name)
    return ast.parse(file.read_text("utf-8")) if file else ast.Module([], [])
