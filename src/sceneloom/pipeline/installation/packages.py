"""The packages that sceneloom needs or can make use of, as its own metadata name them."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version

_REQUIREMENT = re.compile(r"^(?P<name>[\w.-]+)(\[[^\]]*\])?\s*(?P<bounds>[^;]*)(;(?P<marker>.*))?$")
_LEAST = re.compile(r">=\s*(?P<least>[\w.]+)")
_EXTRA = re.compile(r"extra\s*==\s*['\"](?P<extra>[\w-]+)['\"]")

NOT_FOR_USERS = frozenset({"dev", "bench", "fuzz", "docs"})
"""Extras for those who work on sceneloom itself."""

_MODULES = {"pillow": "PIL", "small-gicp": "small_gicp", "protobuf": "google.protobuf"}
"""What is imported of packages whose modules are called otherwise."""


@dataclass(frozen=True, slots=True)
class Package:
    """One package that is asked for.

    Attributes:
        name: as pip calls it.
        least: the lowest version that will do, or None.
        extra: of which extra it is; None where nothing goes without it.
        installed: its version, None where it is not there.
        problem: why it cannot be used; None where it can, as far as that was looked at.
    """

    name: str
    least: str | None
    extra: str | None
    installed: str | None
    problem: str | None


def find_packages(distribution: str = "sceneloom") -> tuple[Package, ...]:
    """Look for all packages that a distribution asks for; those that it needs are imported.

    Raises:
        PackageNotFoundError: the distribution itself is not installed.
    """
    return tuple(_packages(requires(distribution) or []))


def _packages(requirements: list[str]) -> Iterator[Package]:
    for requirement in requirements:
        match = _REQUIREMENT.match(requirement)
        if match is None:
            continue
        extra = _EXTRA.search(match["marker"] or "")
        of_extra = None if extra is None else extra["extra"]
        if of_extra in NOT_FOR_USERS:
            continue
        least = _LEAST.search(match["bounds"])
        yield _examined(match["name"], None if least is None else least["least"], of_extra)


def _examined(name: str, least: str | None, extra: str | None) -> Package:
    try:
        installed = version(name)
    except PackageNotFoundError:
        return Package(name, least, extra, None, "is not installed")
    problem = None
    if least is not None and _numbers(installed) < _numbers(least):
        problem = f"is {installed}; expected {least} or newer"
    elif extra is None:
        problem = _import_problem(_MODULES.get(name.lower(), name.replace("-", "_")))
    return Package(name, least, extra, installed, problem)


def _import_problem(module: str) -> str | None:
    """Why a module cannot be imported, None where it can."""
    try:
        import_module(module)
    except Exception as error:  # noqa: BLE001 - a broken wheel raises anything
        return f"cannot be imported: {error}"
    return None


def _numbers(text: str) -> tuple[int, ...]:
    """The numbers of a version, for comparison; what is not a number ends it."""
    found = []
    for part in text.split("."):
        digits = re.match(r"\d+", part)
        if digits is None:
            break
        found.append(int(digits[0]))
    return tuple(found)
