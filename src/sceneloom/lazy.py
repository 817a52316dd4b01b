"""Imports on first use: what a package offers, and what a table names as `"module:name"`."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def imported(name: str) -> Any:
    """Import what `"module:name"` names."""
    module, _, attribute = name.partition(":")
    return getattr(import_module(module), attribute)


def names_on_first_use(package: str, names: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Give `__getattr__` and `__dir__` of a package that imports its names when they are first asked for.

    Args:
        package: `__name__` of the package.
        names: by module, seen from the package or from `sceneloom`, the names that it defines, separated by blanks;
            `open=open_scene` for one that is called otherwise there.
    """
    locations = {}
    for module, offered in names.items():
        whole = module if module.startswith("sceneloom.") else f"{package}.{module}"
        for name, _, original in (entry.partition("=") for entry in offered.split()):
            locations[name] = f"{whole}:{original or name}"

    def first_use(name: str) -> Any:
        if name not in locations:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = imported(locations[name])
        setattr(sys.modules[package], name, value)
        return value

    def listed() -> list[str]:
        return sorted({*vars(sys.modules[package]), *locations})

    return first_use, listed
