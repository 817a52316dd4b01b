"""Modules have names of the field, no file is large or of one machine, and what a package offers is explained."""

import ast
import re
from importlib import import_module
from importlib.util import find_spec

REFUSED_NAMES = {"util", "utils", "common", "core", "helper", "helpers", "misc", "manager", "managers", "tools"}
LARGEST_FILE = 1_000_000

MACHINE_PATHS = re.compile(r"(?<![\w.~$}-])/(?:root|work|home|Users|mnt|data(?!/local-files/)|scratch)/\w")
"""`/data/local-files/` begins addresses of Label Studio."""
HOSTS = ("pypi.org", "pythonhosted.org", "conda.anaconda.org", "index-url", "find-links", "artifactory", "nexus")
QUOTES_THE_HOSTS = "tests/architecture/test_shape.py"


def test_a_module_is_named_after_what_it_is_about_and_stands_in_a_package(modules):
    for module in modules:
        refused = REFUSED_NAMES & set(module.name.split("."))
        assert not refused, f"{module.name}: {refused} says nothing about its content"
        assert (module.path.parent / "__init__.py").is_file(), module.name


def test_no_file_is_large_or_holds_a_path_of_one_machine_or_the_host_of_a_registry(project_files, project):
    found = []
    for path in project_files:
        name, content = path.relative_to(project).as_posix(), path.read_bytes()
        assert len(content) <= LARGEST_FILE, name
        text = content.decode("utf-8", "replace")
        if name == QUOTES_THE_HOSTS or "\0" in text:
            continue
        found += [f"{name}: {match.group()}" for match in MACHINE_PATHS.finditer(text)]
        found += [f"{name}: {host}" for host in HOSTS if host in text]
    assert not found
    # relative paths are distinguished from those of a machine
    assert all(map(MACHINE_PATHS.search, ["see /root/x", "'/work/main/a'", "at /home/someone", "file:///Users/a"]))
    relative = ["a/work/b", "$HOME/work/x", "../shared/data/x", "/tmp/x", "rows/data"]
    assert not any(map(MACHINE_PATHS.search, relative))


def names_on_first_use(package: str, tree: ast.Module) -> tuple[dict[str, str], dict[str, str]]:
    """What a package imports when it is first asked for, as type checkers see it, and as its table says it.

    Both give `"module:name"` by the name here.
    """
    seen, stated = {}, {}
    for node in tree.body:
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            continue
        for line in node.body:
            assert isinstance(line, ast.ImportFrom)
            seen |= {alias.asname or alias.name: f"{line.module}:{alias.name}" for alias in line.names}
        for table in (found for line in node.orelse for found in ast.walk(line) if isinstance(found, ast.Dict)):
            for module, names in ast.literal_eval(table).items():
                whole = module if module.startswith("sceneloom.") else f"{package}.{module}"
                for name, _, original in (entry.partition("=") for entry in names.split()):
                    stated[name] = f"{whole}:{original or name}"
    return seen, stated


def public_bindings(package: str, tree: ast.Module) -> set[str]:
    """Public names that a package offers: imported at once, but for what it needs itself, or on first use."""
    imports = [
        node
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        and str(node.module).startswith("sceneloom")
        and node.module != "sceneloom.lazy"
    ]
    names = {alias.asname or alias.name for node in imports for alias in node.names}
    return {name for name in names if not name.startswith("_")} | set(names_on_first_use(package, tree)[0])


def test_a_package_has_only_a_docstring_imports_and_its_names_in_order_and_all_of_it_is_there(packages):
    for package in packages:
        seen, stated = names_on_first_use(package.name, package.tree)
        assert seen == stated, f"{package.name}: not the same for type checkers and at run time"
        taken = [name for name in stated if find_spec(f"{package.name}.{name}")]
        assert not taken, f"{package.name}: modules have these names, and would take their locations: {taken}"
        allowed = (ast.Import, ast.ImportFrom, ast.Assign, ast.Expr, *((ast.If,) if seen else ()))
        strange = [f"line {node.lineno}" for node in package.tree.body if not isinstance(node, allowed)]
        assert not strange, f"{package.name} defines things in its __init__: {strange}"
        loaded = import_module(package.name)
        offered = list(getattr(loaded, "__all__", ()))
        assert {name for name in offered if not name.startswith("__")} == public_bindings(package.name, package.tree), (
            package.name
        )
        assert len(offered) == len(set(offered)), package.name
        assert offered == sorted(offered, key=by_kind_and_name), package.name
        absent = [name for name in offered if not hasattr(loaded, name)]
        assert not absent, f"{package.name}.__all__ names {absent}, which are not there"


def by_kind_and_name(name: str) -> tuple[int, list[tuple[bool, int, str]]]:
    """Order of `__all__`: constants, classes, functions, each by name, digits as numbers."""
    kind = 0 if name.isupper() and len(name) > 1 else 1 if name[:1].isupper() else 2
    digits = re.findall(r"\d+|\D+", name)
    return kind, [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in digits]


def test_public_things_are_explained(modules):
    for module in modules:
        assert ast.get_docstring(module.tree), f"{module.name} has no docstring"
        classes = [
            node for node in module.tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
        ]
        silent = [
            f"{node.name} (line {node.lineno})"
            for scope in (module.tree, *classes)
            for node in scope.body
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
            and not node.name.startswith("_")
            and not ast.get_docstring(node)
            and not any(ast.unparse(mark).endswith("overload") for mark in node.decorator_list)
        ]
        assert not silent, f"{module.name}: without docstring: {silent}"
