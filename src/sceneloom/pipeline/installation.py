"""What this installation can do and what it lacks: the machine, its packages, one finding each with a next step."""

import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
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

_BROWSERS = ("chromium", "google-chrome", "firefox", "open")
_LEAST_TEMPORARY_BYTES = 1_000_000_000  # images and clouds are spooled; less room is soon filled
_REQUIREMENT = re.compile(r"^(?P<name>[\w.-]+)(\[[^\]]*\])?\s*(?P<bounds>[^;]*)(;(?P<marker>.*))?$")
_LEAST = re.compile(r">=\s*(?P<least>[\w.]+)")
_EXTRA = re.compile(r"extra\s*==\s*['\"](?P<extra>[\w-]+)['\"]")
_NOT_FOR_USERS = frozenset({"dev", "bench", "fuzz", "docs"})  # extras for those who work on sceneloom itself
_MODULES = {"pillow": "PIL", "small-gicp": "small_gicp", "protobuf": "google.protobuf"}
"""What is imported of packages whose modules are called otherwise."""


class Status(StrEnum):
    """How a finding is meant."""

    GOOD = "good"
    MISSING = "missing"
    BROKEN = "broken"


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that was looked at.

    Attributes:
        group: "versions", "packages", "extras", "machine", "kernels", "codecs" or "programs".
        status: "missing" is something that one can do without, "broken" something that is needed.
        stated: what was found.
    """

    group: str
    name: str
    status: Status
    stated: str
    remedy: str | None = None


class InstallationReport(msgspec.Struct, frozen=True, kw_only=True):
    """This installation."""

    findings: tuple[Finding, ...]

    @property
    def is_sound(self) -> bool:
        """Whether nothing is broken that the main job needs."""
        return all(finding.status is not Status.BROKEN for finding in self.findings)


def examine_installation() -> InstallationReport:
    """Look at versions, packages, extras, machine, compiled kernels, codecs and programs; nothing is changed."""
    examined = {
        "versions": _versions(),
        "packages": _packages(),
        "extras": _extras(),
        "machine": _machine(),
        "kernels": _kernels(),
        "codecs": _codecs(),
        "programs": _programs(),
    }
    return InstallationReport(
        findings=tuple(
            Finding(group=group, name=name, status=status, stated=stated, remedy=remedy)
            for group, rows in examined.items()
            for name, status, stated, remedy in rows
        )
    )


_Row = tuple[str, Status, str, str | None]  # name, status, what was found and remedy of a finding


def _versions() -> Iterator[_Row]:
    python = f"{platform.python_version()} ({sys.executable}) on {platform.system()} {platform.machine()}"
    yield "sceneloom", Status.GOOD, __version__, None
    yield "Python", Status.GOOD, python, None


@dataclass(frozen=True, slots=True)
class _Package:
    """One package that is asked for."""

    name: str
    least: str | None
    extra: str | None  # None where nothing goes without it
    installed: str | None  # its version
    problem: str | None  # why it cannot be used; None where it can, as far as that was looked at


def find_packages() -> tuple[_Package, ...]:
    """Look for all packages that this one asks for; those that it needs are imported.

    Raises:
        PackageNotFoundError: this package itself is not installed.
    """
    found = []
    for match in filter(None, map(_REQUIREMENT.match, requires("sceneloom") or [])):
        extra, least = _EXTRA.search(match["marker"] or ""), _LEAST.search(match["bounds"])
        if extra is None or extra["extra"] not in _NOT_FOR_USERS:
            found.append(_examined(match["name"], least and least["least"], extra and extra["extra"]))
    return tuple(found)


def _examined(name: str, least: str | None, extra: str | None) -> _Package:
    try:
        installed = version(name)
    except PackageNotFoundError:
        return _Package(name, least, extra, None, "is not installed")
    problem = None
    if least is not None and _numbers(installed) < _numbers(least):
        problem = f"is {installed}; expected {least} or newer"
    elif extra is None:
        try:
            import_module(_MODULES.get(name.lower(), name.replace("-", "_")))
        except Exception as error:  # noqa: BLE001 - a broken wheel raises anything
            problem = f"cannot be imported: {error}"
    return _Package(name, least, extra, installed, problem)


def _numbers(text: str) -> tuple[int, ...]:
    """The numbers of a version, for comparison; what is not a number ends it."""
    found = []
    for part in text.split("."):
        digits = re.match(r"\d+", part)
        if digits is None:
            break
        found.append(int(digits[0]))
    return tuple(found)


def _packages() -> Iterator[_Row]:
    try:
        packages = find_packages()
    except PackageNotFoundError:
        stated = "is imported from a folder and not installed, so what it needs is not known"
        yield "sceneloom", Status.MISSING, stated, "pip install sceneloom"
        return
    for one in packages:
        if one.extra is None and one.problem is None:
            yield one.name, Status.GOOD, one.installed or "there", None
        elif one.extra is None and one.problem is not None:
            bound = f">={one.least}" if one.least else ""
            remedy = f"pip uninstall {one.name}, then pip install '{one.name}{bound}'"
            yield one.name, Status.BROKEN, one.problem, remedy


def _extras() -> Iterator[_Row]:
    by_extra: dict[str, list[_Package]] = {}
    try:
        for package in find_packages():
            if package.extra is not None:
                by_extra.setdefault(package.extra, []).append(package)
    except PackageNotFoundError:
        return
    for extra, members in by_extra.items():
        lacking = "; ".join(f"{one.name} {one.problem}" for one in members if one.problem is not None)
        there = ", ".join(f"{one.name} {one.installed}" for one in members)
        if lacking:
            yield extra, Status.MISSING, lacking, how_to_install(extra)
        else:
            yield extra, Status.GOOD, there, None


def _machine() -> Iterator[_Row]:
    available = processors()
    yield "processors", Status.GOOD, f"{available} of {os.cpu_count() or available} to use", None
    memory = "not reported by this system"
    try:
        lines = Path("/proc/meminfo").read_text("ascii").splitlines()
        rows = dict(line.split(":", 1) for line in lines if ":" in line)
        total, free = (1024e-9 * int(rows[name].split()[0]) for name in ("MemTotal", "MemAvailable"))
        memory = f"{total:.1f} GB, {free:.1f} GB free"
    except (OSError, ValueError, KeyError):
        pass
    yield "memory", Status.GOOD, memory, None
    folder = tempfile.gettempdir()
    free_bytes = shutil.disk_usage(folder).free
    stated = f"{folder}, {free_bytes / 1e9:.1f} GB free"
    if free_bytes < _LEAST_TEMPORARY_BYTES:
        yield "temporary files", Status.MISSING, stated, "set TMPDIR to a folder with more room"
    else:
        yield "temporary files", Status.GOOD, stated, None


def _kernels() -> Iterator[_Row]:
    cache = find_kernel_cache()
    location = f"{cache.folder}{'' if cache.writable else ' (not writable)'}"
    status = Status.GOOD if cache.writable else Status.MISSING if cache.usable else Status.BROKEN
    stated = f"{cache.compiled} of {cache.kernels} compiled, kept in {location}"
    yield "compiled kernels", status, stated, _KERNEL_REMEDIES[cache.is_warm, cache.writable]


_KERNEL_REMEDIES = {
    (True, True): None,
    (True, False): "nothing new can be kept; set NUMBA_CACHE_DIR to a folder that can be written",
    (False, True): "the others are compiled when first used, which takes some seconds each",
    (False, False): "set NUMBA_CACHE_DIR to a folder that can be written, else each run compiles them anew",
}  # what to do where all kernels are compiled or not, and the cache can be written or not


def _codecs() -> Iterator[_Row]:
    try:
        from sceneloom.formats.video.writer import NEEDED_CODECS, available_codecs

        codecs = available_codecs()
    except ImportError as error:
        yield "video", Status.BROKEN, f"cannot be imported: {error}", None
        return
    remedy = "pip uninstall av, then pip install av: a wheel brings its own codecs"
    for name, there in codecs.items():
        if there:
            yield name, Status.GOOD, "there", None
        else:
            lacking = Status.BROKEN if name in NEEDED_CODECS else Status.MISSING
            yield name, lacking, "not in the video library", remedy


def _programs() -> Iterator[_Row]:
    """Programs that show results; they are looked for beside this Python first, which need not be on the path."""
    search_path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    viewer = shutil.which("rerun", path=search_path)
    yield _found("rerun viewer", viewer, how_to_install("view"))
    yield _found("web browser", next(filter(None, map(shutil.which, _BROWSERS)), None), None)


def _found(name: str, location: str | None, remedy: str | None) -> _Row:
    return (name, Status.MISSING, "not found", remedy) if location is None else (name, Status.GOOD, location, None)
