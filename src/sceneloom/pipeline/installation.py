"""What this installation can do and what it lacks: the machine, its packages, one finding each with a next step."""

import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import msgspec

from sceneloom.errors import how_to_install
from sceneloom.formats.base.files import processors
from sceneloom.kernels.cache import find_kernel_cache
from sceneloom.version import __version__

_GIGABYTE = 1e9
_BROWSERS = ("chromium", "google-chrome", "firefox", "open")

_LEAST_TEMPORARY_BYTES = 1_000_000_000
"""Images and clouds are spooled; less room is soon filled."""


def _python_line() -> str:
    """Which Python this is, and on what."""
    return f"{platform.python_version()} ({sys.executable}) on {platform.system()} {platform.machine()}"


def _processor_line(available: int) -> str:
    """How many processors there are, and how many of them may be used."""
    return f"{available} of {os.cpu_count() or available} to use"


def _memory_bytes() -> tuple[int, int] | None:
    """All memory and what of it is free [bytes]; None where the system does not report."""
    table = Path("/proc/meminfo")
    try:
        rows = dict(line.split(":", 1) for line in table.read_text("ascii").splitlines() if ":" in line)
        return tuple(1024 * int(rows[name].split()[0]) for name in ("MemTotal", "MemAvailable"))  # type: ignore[return-value]
    except (OSError, ValueError, KeyError):
        return None


def _memory_line() -> str:
    """The memory in words."""
    known = _memory_bytes()
    if known is None:
        return "not reported by this system"
    return f"{known[0] / _GIGABYTE:.1f} GB, {known[1] / _GIGABYTE:.1f} GB free"


def _temporary_space() -> tuple[str, int]:
    """The folder of temporary files, and the room that is left there [bytes]."""
    folder = tempfile.gettempdir()
    return folder, shutil.disk_usage(folder).free


def _machine_programs() -> Iterator[tuple[str, str | None]]:
    """Programs that show results, with their locations; None where they are not there."""
    yield "rerun viewer", shutil.which("rerun", path=_search_path())
    yield "web browser", next(filter(None, map(shutil.which, _BROWSERS)), None)


def _search_path() -> str:
    """Where programs are looked for: beside this Python first, which need not be on the path."""
    return os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))


_REQUIREMENT = re.compile(r"^(?P<name>[\w.-]+)(\[[^\]]*\])?\s*(?P<bounds>[^;]*)(;(?P<marker>.*))?$")
_LEAST = re.compile(r">=\s*(?P<least>[\w.]+)")
_EXTRA = re.compile(r"extra\s*==\s*['\"](?P<extra>[\w-]+)['\"]")

_NOT_FOR_USERS = frozenset({"dev", "bench", "fuzz", "docs"})
"""Extras for those who work on sceneloom itself."""

_MODULES = {"pillow": "PIL", "small-gicp": "small_gicp", "protobuf": "google.protobuf"}
"""What is imported of packages whose modules are called otherwise."""


@dataclass(frozen=True, slots=True)
class _Package:
    """One package that is asked for.

    Attributes:
        extra: of which extra it is; None where nothing goes without it.
        installed: its version, None where it is not there.
        problem: why it cannot be used; None where it can, as far as that was looked at.
    """

    name: str
    least: str | None
    extra: str | None
    installed: str | None
    problem: str | None


def find_packages(distribution: str = "sceneloom") -> tuple[_Package, ...]:
    """Look for all packages that a distribution asks for; those that it needs are imported.

    Raises:
        PackageNotFoundError: the distribution itself is not installed.
    """
    return tuple(_packages(requires(distribution) or []))


def _packages(requirements: list[str]) -> Iterator[_Package]:
    for requirement in requirements:
        match = _REQUIREMENT.match(requirement)
        if match is None:
            continue
        extra = _EXTRA.search(match["marker"] or "")
        of_extra = None if extra is None else extra["extra"]
        if of_extra in _NOT_FOR_USERS:
            continue
        least = _LEAST.search(match["bounds"])
        yield _examined(match["name"], None if least is None else least["least"], of_extra)


def _examined(name: str, least: str | None, extra: str | None) -> _Package:
    try:
        installed = version(name)
    except PackageNotFoundError:
        return _Package(name, least, extra, None, "is not installed")
    problem = None
    if least is not None and _numbers(installed) < _numbers(least):
        problem = f"is {installed}; expected {least} or newer"
    elif extra is None:
        problem = _import_problem(_MODULES.get(name.lower(), name.replace("-", "_")))
    return _Package(name, least, extra, installed, problem)


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


class Status(StrEnum):
    """How a finding is meant."""

    GOOD = "good"
    MISSING = "missing"
    BROKEN = "broken"


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that was looked at.

    Attributes:
        group: "versions", "packages", "extras", "machine", "kernels", "codecs" or "programs".
        name: what was looked at.
        status: "missing" is something that one can do without, "broken" something that is needed.
        stated: what was found.
        remedy: what to do, where there is something.
    """

    group: str
    name: str
    status: Status
    stated: str
    remedy: str | None = None


class InstallationReport(msgspec.Struct, frozen=True, kw_only=True):
    """This installation.

    Attributes:
        findings: group by group.
    """

    findings: tuple[Finding, ...]

    @property
    def is_sound(self) -> bool:
        """Whether nothing is broken that the main job needs."""
        return all(finding.status is not Status.BROKEN for finding in self.findings)


def examine_installation() -> InstallationReport:
    """Look at versions, packages, extras, machine, compiled kernels, codecs and programs; nothing is changed."""
    return InstallationReport(
        findings=(*_versions(), *_report_packages(), *_machine(), *_kernels(), *_codecs(), *_programs())
    )


def _versions() -> Iterator[Finding]:
    yield Finding(group="versions", name="sceneloom", status=Status.GOOD, stated=__version__)
    yield Finding(group="versions", name="Python", status=Status.GOOD, stated=_python_line())


def _report_packages() -> Iterator[Finding]:
    try:
        packages = find_packages()
    except PackageNotFoundError:
        stated = "is imported from a folder and not installed, so what it needs is not known"
        yield Finding(
            group="packages", name="sceneloom", status=Status.MISSING, stated=stated, remedy="pip install sceneloom"
        )
        return
    for package in packages:
        if package.extra is None:
            yield _needed(package)
    yield from _extras([package for package in packages if package.extra is not None])


def _needed(package: _Package) -> Finding:
    if package.problem is None:
        return Finding(group="packages", name=package.name, status=Status.GOOD, stated=package.installed or "there")
    bound = f">={package.least}" if package.least else ""
    remedy = f"pip uninstall {package.name}, then pip install '{package.name}{bound}'"
    return Finding(group="packages", name=package.name, status=Status.BROKEN, stated=package.problem, remedy=remedy)


def _extras(packages: Iterable[_Package]) -> Iterator[Finding]:
    by_extra: dict[str, list[_Package]] = {}
    for package in packages:
        by_extra.setdefault(str(package.extra), []).append(package)
    for extra, members in by_extra.items():
        lacking = [f"{one.name} {one.problem}" for one in members if one.problem is not None]
        there = ", ".join(f"{one.name} {one.installed}" for one in members)
        yield Finding(
            group="extras",
            name=extra,
            status=Status.MISSING if lacking else Status.GOOD,
            stated="; ".join(lacking) if lacking else there,
            remedy=how_to_install(extra) if lacking else None,
        )


def _machine() -> Iterator[Finding]:
    yield Finding(group="machine", name="processors", status=Status.GOOD, stated=_processor_line(processors()))
    yield Finding(group="machine", name="memory", status=Status.GOOD, stated=_memory_line())
    folder, free = _temporary_space()
    short = free < _LEAST_TEMPORARY_BYTES
    yield Finding(
        group="machine",
        name="temporary files",
        status=Status.MISSING if short else Status.GOOD,
        stated=f"{folder}, {free / 1e9:.1f} GB free",
        remedy="set TMPDIR to a folder with more room" if short else None,
    )


def _kernels() -> Iterator[Finding]:
    cache = find_kernel_cache()
    location = f"{cache.folder}{'' if cache.writable else ' (not writable)'}"
    yield Finding(
        group="kernels",
        name="compiled kernels",
        status=Status.GOOD if cache.writable else Status.MISSING if cache.usable else Status.BROKEN,
        stated=f"{cache.compiled} of {cache.kernels} compiled, kept in {location}",
        remedy=_kernel_remedy(warm=cache.is_warm, writable=cache.writable),
    )


def _kernel_remedy(*, warm: bool, writable: bool) -> str | None:
    if warm and writable:
        return None
    if warm:
        return "nothing new can be kept; set NUMBA_CACHE_DIR to a folder that can be written"
    if not writable:
        return "set NUMBA_CACHE_DIR to a folder that can be written, else each run compiles them anew"
    return "the others are compiled when first used, which takes some seconds each"


def _codecs() -> Iterator[Finding]:
    try:
        from sceneloom.formats.video.writer import NEEDED_CODECS, available_codecs

        codecs = available_codecs()
    except ImportError as error:
        yield Finding(group="codecs", name="video", status=Status.BROKEN, stated=f"cannot be imported: {error}")
        return
    for name, there in codecs.items():
        lacking = Status.BROKEN if name in NEEDED_CODECS else Status.MISSING
        yield Finding(
            group="codecs",
            name=name,
            status=Status.GOOD if there else lacking,
            stated="there" if there else "not in the video library",
            remedy=None if there else "pip uninstall av, then pip install av: a wheel brings its own codecs",
        )


def _programs() -> Iterator[Finding]:
    for name, location in _machine_programs():
        yield Finding(
            group="programs",
            name=name,
            status=Status.MISSING if location is None else Status.GOOD,
            stated=location or "not found",
            remedy=how_to_install("view") if location is None and "rerun" in name else None,
        )
