"""What is there and what is not, one finding each, with what to do."""

from collections.abc import Iterable, Iterator
from enum import StrEnum
from importlib.metadata import PackageNotFoundError

import msgspec

from sceneloom.errors import how_to_install
from sceneloom.formats.processors import processors
from sceneloom.kernels.cache import find_kernel_cache
from sceneloom.pipeline.installation.machine import (
    LEAST_TEMPORARY_BYTES,
    memory_line,
    processor_line,
    programs,
    python_line,
    temporary_space,
)
from sceneloom.pipeline.installation.packages import Package, find_packages
from sceneloom.version import __version__


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
        findings=(*_versions(), *_packages(), *_machine(), *_kernels(), *_codecs(), *_programs())
    )


def _versions() -> Iterator[Finding]:
    yield Finding(group="versions", name="sceneloom", status=Status.GOOD, stated=__version__)
    yield Finding(group="versions", name="Python", status=Status.GOOD, stated=python_line())


def _packages() -> Iterator[Finding]:
    try:
        packages = find_packages()
    except PackageNotFoundError:
        stated = "is imported from a folder and not installed, so what it needs is not known"
        yield Finding(
            group="packages",
            name="sceneloom",
            status=Status.MISSING,
            stated=stated,
            remedy="pip install sceneloom",
        )
        return
    for package in packages:
        if package.extra is None:
            yield _needed(package)
    yield from _extras([package for package in packages if package.extra is not None])


def _needed(package: Package) -> Finding:
    if package.problem is None:
        return Finding(
            group="packages", name=package.name, status=Status.GOOD, stated=package.installed or "there"
        )
    bound = f">={package.least}" if package.least else ""
    remedy = f"pip uninstall {package.name}, then pip install '{package.name}{bound}'"
    return Finding(
        group="packages", name=package.name, status=Status.BROKEN, stated=package.problem, remedy=remedy
    )


def _extras(packages: Iterable[Package]) -> Iterator[Finding]:
    by_extra: dict[str, list[Package]] = {}
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
    yield Finding(group="machine", name="processors", status=Status.GOOD, stated=processor_line(processors()))
    yield Finding(group="machine", name="memory", status=Status.GOOD, stated=memory_line())
    folder, free = temporary_space()
    short = free < LEAST_TEMPORARY_BYTES
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
        from sceneloom.formats.video.codecs import NEEDED_CODECS, available_codecs

        codecs = available_codecs()
    except ImportError as error:
        yield Finding(
            group="codecs", name="video", status=Status.BROKEN, stated=f"cannot be imported: {error}"
        )
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
    for name, location in programs():
        yield Finding(
            group="programs",
            name=name,
            status=Status.MISSING if location is None else Status.GOOD,
            stated=location or "not found",
            remedy=how_to_install("view") if location is None and "rerun" in name else None,
        )
