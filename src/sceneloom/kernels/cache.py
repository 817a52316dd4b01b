"""Where compiled kernels are kept, and how many of them are there: found without compiling or loading any."""

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from tempfile import TemporaryFile
from types import ModuleType

_DECORATED = re.compile(r"cache=True|\*\*_?(KERNEL|COMPILED)\b")
_PACKAGE = Path(__file__).parents[1]
_ROOMS = ("kernels", "cameras")


@dataclass(frozen=True, slots=True)
class KernelCache:
    """The kept kernels of one Python.

    Attributes:
        folder: where those of this room are kept.
        writable: whether new ones can be kept.
        modules: how many modules hold kernels.
        compiled: of how many of them there are compiled ones, not older than their source.
        usable: whether Numba finds any folder to keep them in; where it finds none, kernels cannot be imported.
    """

    folder: Path
    writable: bool
    modules: int
    compiled: int
    usable: bool = True

    @property
    def is_warm(self) -> bool:
        """Whether nothing is left to be compiled."""
        return self.compiled == self.modules


def find_kernel_cache() -> KernelCache:
    """Look for the compiled kernels of this Python.

    Source: Numba's manual, "Cache Sharing" and NUMBA_CACHE_DIR: `__pycache__` beside the source where that can be
    written, else a folder of the user's; NUMBA_CACHE_DIR comes first.
    """
    sources = [path for room in _ROOMS for path in sorted((_PACKAGE / room).glob("*.py"))]
    kernels = [path for path in sources if _holds_kernels(path)]
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    beside = Path(__file__).parent / "__pycache__"
    folder = Path(elsewhere) if elsewhere else beside
    writable = _can_write(folder)
    compiled = sum(_is_compiled(source, Path(elsewhere) if elsewhere else None) for source in kernels)
    users = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    usable = writable or any(map(_can_write, (beside, users)))
    return KernelCache(folder, writable, len(kernels), compiled, usable)


def _can_write(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made if it is not there: tried, as rights alone do not tell."""
    there = next((one for one in (folder, *folder.parents) if one.exists()), None)
    if there is None or not there.is_dir():
        return False
    try:
        with TemporaryFile(dir=there):
            return True
    except OSError:
        return False


def will_compile(module: str) -> bool:
    """Whether a module, by its whole name, has kernels of which none is kept: importing it takes seconds then."""
    package, _, room = module.rpartition(".")[0].rpartition(".")
    source = _PACKAGE / room / f"{module.rpartition('.')[2]}.py"
    if package != _PACKAGE.name or room not in _ROOMS or not _holds_kernels(source):
        return False
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    return not _is_compiled(source, Path(elsewhere) if elsewhere else None)


@contextmanager
def reporting_compiling(report: Callable[[str], None]) -> Iterator[None]:
    """Report each module whose kernels are compiled meanwhile, by its name, before it is imported."""
    watch = _Watch(report)
    sys.meta_path.insert(0, watch)
    try:
        yield
    finally:
        sys.meta_path.remove(watch)


@dataclass(frozen=True, slots=True, eq=False)
class _Watch(MetaPathFinder):
    """Finds no module, but sees which ones are asked for."""

    report: Callable[[str], None]

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,  # noqa: ARG002 - as importlib calls it
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        if will_compile(fullname):
            self.report(fullname)
        return None


def _holds_kernels(source: Path) -> bool:
    return (
        source.is_file() and source != Path(__file__) and bool(_DECORATED.search(source.read_text("utf-8")))
    )


def _is_compiled(source: Path, elsewhere: Path | None) -> bool:
    """Whether there is an index of compiled functions of a module that is not older than the module."""
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    pattern = f"{source.stem}.*.{python}.nbi"
    kept = (
        source.parent.joinpath("__pycache__").glob(pattern)
        if elsewhere is None
        else elsewhere.glob(f"**/{pattern}")
    )
    written = source.stat().st_mtime
    return any(index.stat().st_mtime >= written for index in kept)
