"""What a package offers is written down, complete and explained."""

import ast
import re
from importlib import import_module

import pytest

from sceneloom.formats import FORMATS
from sceneloom.formats.table import format_named


def public_bindings(tree: ast.Module) -> set[str]:
    """Public names that a package binds: imported out of its own rooms, assigned or defined."""
    names: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.level or str(node.module).startswith("sceneloom")):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return {name for name in names if not name.startswith("_")}


def offered_names(tree: ast.Module) -> list[str] | None:
    """The literal `__all__` of a module, or None."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(
            isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets
        ):
            return list(ast.literal_eval(node.value))
    return None


def by_kind_and_name(name: str) -> tuple[int, list[tuple[bool, int, str]]]:
    """Order of `__all__`: constants, classes, functions, each by name, digits as numbers."""
    kind = 0 if name.isupper() and len(name) > 1 else 1 if name[:1].isupper() else 2
    digits = re.findall(r"\d+|\D+", name)
    return kind, [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in digits]


def test_a_package_offers_exactly_what_it_binds(packages_of_room):
    for package in packages_of_room:
        offered, bound = offered_names(package.tree), public_bindings(package.tree)
        lazy = {"__getattr__"} <= {n.name for n in package.tree.body if isinstance(n, ast.FunctionDef)}
        missing = bound - set(offered or ())
        assert not missing, f"{package.name}.__all__ lacks {sorted(missing)}"
        ghosts = {name for name in set(offered or ()) - bound if not name.startswith("__")}
        assert lazy or not ghosts, f"{package.name}.__all__ names {sorted(ghosts)}, which it does not bind"


def test_every_offered_name_exists(packages_of_room):
    for package in packages_of_room:
        offered = offered_names(package.tree) or []
        loaded = import_module(package.name)
        absent = [name for name in offered if not hasattr(loaded, name)]
        assert not absent, f"{package.name}.__all__ names {absent}, which are not there"
        assert len(offered) == len(set(offered)), package.name


def test_offered_names_are_in_order(packages_of_room):
    for package in packages_of_room:
        offered = offered_names(package.tree) or []
        assert offered == sorted(offered, key=by_kind_and_name), package.name


def test_a_package_has_only_a_docstring_imports_and_its_names(packages_of_room):
    for package in packages_of_room:
        allowed: tuple[type[ast.stmt], ...] = (ast.Import, ast.ImportFrom, ast.Assign, ast.Expr)
        lazy = {"sceneloom", "sceneloom.pipeline", "sceneloom.catalog", "sceneloom.formats.recording"}
        if package.name in lazy:  # they fetch their heavier names on first use
            allowed = (*allowed, ast.FunctionDef, ast.If)
        strange = [f"line {node.lineno}" for node in package.tree.body if not isinstance(node, allowed)]
        assert not strange, f"{package.name} defines things in its __init__: {strange}"


def public_classes(tree: ast.Module) -> list[ast.ClassDef]:
    """The classes of a module whose methods are there for others."""
    return [node for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]


def test_public_things_are_explained(modules_of_room):
    for module in modules_of_room:
        explained = ast.get_docstring(module.tree)
        assert explained, f"{module.name} has no docstring"
        silent = [
            f"{node.name} (line {node.lineno})"
            for scope in (module.tree, *public_classes(module.tree))
            for node in scope.body
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
            and not node.name.startswith("_")
            and not ast.get_docstring(node)
            and not any(ast.unparse(mark).endswith("overload") for mark in node.decorator_list)
        ]
        assert not silent, f"{module.name}: without docstring: {silent}"


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_of_the_table_is_there(name):
    form = format_named(name)
    assert form.name == name
    assert form.suffixes
    assert all(callable(getattr(form, verb)) for verb in ("recognises", "open", "write"))
