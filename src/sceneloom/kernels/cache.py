"""Kernels: functions compiled at their first call, where the compiled ones are kept, and how many there are."""

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TypeVar, cast

_DECORATED = re.compile(r"^@kernel\(", re.MULTILINE)
_IMPORTED = re.compile(r"^\s*(?:from|import) (sceneloom\.[\w.]+)(?: import \(?([\w, \n]+))?", re.MULTILINE)
_PACKAGE = Path(__file__).parents[1]
_ROOMS = ("kernels", "cameras")

_Function = TypeVar("_Function", bound=Callable[..., Any])

_declared: dict[str, list[Callable[[], None]]] = {}
"""What compiles each kernel of the modules that are imported, by the module's name."""

_reports: list[Callable[[str], None]] = []
"""Who hears of kernels that are compiled."""


def kernel(signatures: Any, **options: Any) -> Callable[[_Function], _Function]:
    """Declare a function that is compiled for these types, and no others, at its first call.

    Importing a module compiles and loads nothing, so what a program never calls costs it nothing. Compiled kernels
    are kept for the next process, and used as long as the source of their module and of all that it imports here is
    the same, whenever that was installed. Threads may call a kernel for the first time at the same time.

    Args:
        signatures: one signature, or a list of them, as `numba.njit` takes them.
        **options: the same of `numba.njit`; `cache` is set.

    Source: Numba's manual, "Eager compilation": with signatures other types are converted or refused, never
    compiled for.
    """
    import numba
    from numba.core.compiler_lock import global_compiler_lock

    options["cache"] = True
    all_signatures = signatures if isinstance(signatures, list) else [signatures]

    def declare(function: _Function) -> _Function:
        dispatcher: Any = numba.njit(**options)(function)
        template = dispatcher.get_call_template

        def compile_now() -> None:
            # Numba's own lock: it is held where a kernel that is compiled asks for another one.
            with global_compiler_lock:
                if not dispatcher._can_compile:  # noqa: SLF001
                    return
                kept_as = getattr(dispatcher._cache, "_cache_file", None)  # noqa: SLF001
                if kept_as is not None:
                    kept_as._source_stamp = source_digest(Path(function.__code__.co_filename))  # noqa: SLF001
                if _reports and not _is_kept(function):
                    for report in tuple(_reports):
                        report(f"{function.__module__}.{function.__name__}")
                for signature in all_signatures:
                    dispatcher.compile(signature)
                dispatcher.disable_compile()

        def compile_for_arguments(*_: Any, **__: Any) -> Any:
            compile_now()
            return dispatcher

        def call_template(arguments: Any, named: Any) -> Any:
            compile_now()
            return template(arguments, named)

        # What Numba asks for where it knows no version yet: what to call from Python, and what a kernel calls.
        dispatcher._compile_for_args = compile_for_arguments  # noqa: SLF001
        dispatcher.get_call_template = call_template
        _declared.setdefault(function.__module__, []).append(compile_now)
        return cast("_Function", dispatcher)

    return declare


def declaring_modules() -> list[str]:
    """Name the imported modules that have kernels."""
    return list(_declared)


def compile_kernels(modules: Iterable[str]) -> None:
    """Compile, or load, all kernels of modules that are imported."""
    for module in modules:
        for compile_now in _declared.get(module, ()):
            compile_now()


@dataclass(frozen=True, slots=True)
class KernelCache:
    """The kept kernels of one Python.

    Attributes:
        folder: where those of this room are kept.
        writable: whether new ones can be kept.
        kernels: how many there are.
        compiled: how many of them are kept, compiled from their present source.
        usable: whether Numba finds any folder to keep them in; where it finds none, kernels cannot be imported.
    """

    folder: Path
    writable: bool
    kernels: int
    compiled: int
    usable: bool = True

    @property
    def is_warm(self) -> bool:
        """Whether nothing is left to be compiled."""
        return self.compiled == self.kernels


def find_kernel_cache() -> KernelCache:
    """Look for the compiled kernels of this Python.

    Source: Numba's manual, "Cache Sharing" and NUMBA_CACHE_DIR: `__pycache__` beside the source where that can be
    written, else a folder of the user's; NUMBA_CACHE_DIR comes first.
    """
    counts = {
        source: count
        for room in _ROOMS
        for source in sorted((_PACKAGE / room).glob("*.py"))
        if (count := _count_kernels(source))
    }
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    beside = Path(__file__).parent / "__pycache__"
    folder = Path(elsewhere) if elsewhere else beside
    writable = _can_write(folder)
    compiled = sum(min(count, _count_kept(source, elsewhere)) for source, count in counts.items())
    users = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    usable = writable or any(map(_can_write, (beside, users)))
    return KernelCache(folder, writable, sum(counts.values()), compiled, usable)


def _can_write(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made if it is not there: tried, as rights alone do not report."""
    there = next((one for one in (folder, *folder.parents) if one.exists()), None)
    if there is None or not there.is_dir():
        return False
    try:
        with TemporaryFile(dir=there):
            return True
    except OSError:
        return False


def lacks_kernels(module: str) -> bool:
    """Whether a module, by its whole name, has kernels that are not kept yet: calling them takes seconds then."""
    package, _, room = module.rpartition(".")[0].rpartition(".")
    source = _PACKAGE / room / f"{module.rpartition('.')[2]}.py"
    if package != _PACKAGE.name or room not in _ROOMS:
        return False
    return _count_kept(source, os.environ.get("NUMBA_CACHE_DIR")) < _count_kernels(source)


@contextmanager
def reporting_compiling(report: Callable[[str], None]) -> Iterator[None]:
    """Report each kernel that is compiled meanwhile, by its module and name, before it is."""
    _reports.append(report)
    try:
        yield
    finally:
        _reports.remove(report)


def _count_kernels(source: Path) -> int:
    if not source.is_file() or source == Path(__file__):
        return 0
    return len(_DECORATED.findall(source.read_text("utf-8")))


def _count_kept(source: Path, elsewhere: str | None, name: str = "*") -> int:
    """Count the functions of a module of which an index of versions compiled from the present source is kept."""
    if not source.is_file():
        return 0
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    pattern = f"{source.stem}.{name}-*.{python}.nbi"
    kept = (
        Path(elsewhere).glob(f"**/{pattern}") if elsewhere else source.parent.glob(f"__pycache__/{pattern}")
    )
    digest = source_digest(source).encode()
    return len({index.name for index in kept if digest in index.read_bytes()})


@cache
def source_digest(source: Path) -> str:
    """Name the content of a module and of all modules of ours that it imports, which its kernels may call."""
    known: set[Path] = set()
    waiting = [source]
    digest = blake2b(digest_size=16)
    while waiting:
        path = waiting.pop()
        if path in known or not path.is_file() or path == Path(__file__):
            continue
        known.add(path)
        text = path.read_text("utf-8")
        digest.update(text.encode())
        for module, names in _IMPORTED.findall(text):
            found = _PACKAGE.parent.joinpath(*module.split("."))
            members = (found / f"{name.split(' as ')[0].strip()}.py" for name in names.split(","))
            waiting += [found.with_suffix(".py"), *sorted(members)]
    return digest.hexdigest()


def _is_kept(function: Callable[..., Any]) -> bool:
    source = Path(function.__code__.co_filename)
    return _count_kept(source, os.environ.get("NUMBA_CACHE_DIR"), function.__qualname__) > 0
