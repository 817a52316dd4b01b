"""Kernels: functions compiled at their first call, where the compiled ones are kept, and how many there are."""

import gc
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache, partial
from hashlib import blake2b
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

if TYPE_CHECKING:
    from subprocess import Popen

_MAKERS: Mapping[re.Pattern[str], int] = {
    re.compile(r"^@kernel\(", re.MULTILINE): 1,
    re.compile(r"^\w+ = compiled_model\(", re.MULTILINE): 3,
    re.compile(r"^\w+ = compiled_fold\(", re.MULTILINE): 1,
}
"""How many kernels each place that matches declares; the latter two are factories of `cameras.compiled`."""

_IMPORTED = re.compile(r"^\s*(?:from|import) (sceneloom\.[\w.]+)(?: import (?:\(([^)]*)|([\w, ]+)))?", re.MULTILINE)
_PACKAGE = Path(__file__).parents[1]
PACKAGES = ("kernels", "cameras", "colouring", "motion", "detections", "tracking", "calibrate", "simulate")
"""Those with kernels."""

_Function = TypeVar("_Function", bound=Callable[..., Any])

OPTIONS: Mapping[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
"""Of all kernels: the interpreter is let go, dividing by zero gives infinity or NaN, and C does not call them."""

PART_OPTIONS: Mapping[str, Any] = {**OPTIONS, "no_cpython_wrapper": True}
"""Of what only kernels call."""

_declared: dict[str, dict[str, Callable[[], None]]] = {}
"""What compiles each kernel of the modules that are imported, by the names of module and kernel."""

_reports: list[Callable[[str, int], None]] = []
"""Who hears of kernels that are compiled."""

_open: list[str] = []
"""The kernels that are being compiled, under Numba's lock: the first is called from Python, and calls the others."""


def kernel(signatures: Any, **options: Any) -> Callable[[_Function], _Function]:
    """Declare a function that is compiled for these types, and no others, at its first call.

    Importing a module compiles and loads nothing, so what a program never calls costs it nothing. Compiled kernels
    are kept for the next process, and used as long as the source of their module and of the modules with kernels that
    it imports is the same, whenever that was installed. Threads may call a kernel for the first time at the same time.

    Args:
        signatures: one signature, or a list of them, as `numba.njit` takes them.
        **options: the same of `numba.njit`, beside `OPTIONS`; `cache` is set.

    Source: Numba's manual, "Eager compilation": with signatures other types are converted or refused, never
    compiled for.
    """
    import numba
    from numba.core.compiler_lock import global_compiler_lock

    options = {**OPTIONS, **options, "cache": True}
    all_signatures = signatures if isinstance(signatures, list) else [signatures]

    def declare(function: _Function) -> _Function:
        dispatcher: Any = numba.njit(**options)(function)
        template = dispatcher.get_call_template

        def compile_now() -> None:
            # Numba's own lock: it is held where a kernel that is compiled asks for another one.
            with global_compiler_lock:
                if not dispatcher._can_compile:
                    return
                kept_as = getattr(dispatcher._cache, "_cache_file", None)
                if kept_as is not None:
                    kept_as._source_stamp = source_digest(_source_of(function))
                    dispatcher._cache.load_overload = partial(_load_kept, dispatcher._cache)
                if _reports and not _open and not _is_kept(function):
                    _report(f"{function.__module__}:{function.__qualname__}", 1)
                _open.append(function.__qualname__)
                try:
                    with _machine_code_late() if len(_open) == 1 else nullcontext():
                        for signature in all_signatures:
                            dispatcher.compile(signature)
                finally:
                    _open.pop()
                dispatcher.disable_compile()

        def compile_for_arguments(*_: Any, **__: Any) -> Any:
            compile_now()
            return dispatcher

        def call_template(arguments: Any, named: Any) -> Any:
            compile_now()
            return template(arguments, named)

        # What Numba asks for where it knows no version yet: what to call from Python, and what a kernel calls.
        dispatcher._compile_for_args = compile_for_arguments
        dispatcher.get_call_template = call_template
        _declared.setdefault(function.__module__, {})[function.__qualname__] = compile_now
        return cast("_Function", dispatcher)

    return declare


@contextmanager
def _machine_code_late() -> Iterator[None]:
    """Let Numba make machine code only of what is kept or called from Python: a sixth of compiling is spared.

    Without it the machine code of each part is made as well, and thrown away: kernels link the parts' LLVM code.
    """
    from numba.core import codegen

    of_library: Any = codegen.JITCodeLibrary
    of_target: Any = codegen.JITCPUCodegen
    try:
        make, point, keep = (
            getattr(of_library, name)
            for name in ("_finalize_final_module", "get_pointer_to_function", "serialize_using_object_code")
        )
        set_environment = of_target.set_env
    except AttributeError:  # a version of Numba that is made otherwise
        yield
        return
    late = set()

    def put_off(library: Any) -> None:
        if library._object_caching_enabled and library._compiled_object:  # a kept kernel
            make(library)
            return
        late.add(library)
        library._finalized = True

    def make_now(library: Any) -> None:
        if library in late:
            late.remove(library)
            make(library)

    def point_to(library: Any, name: str) -> Any:
        library._ensure_finalized()
        if any(function.name == name for function in library.get_defined_functions()):
            make_now(library)
        return point(library, name)

    def keep_made(library: Any) -> Any:
        make_now(library)
        return keep(library)

    def set_if_made(target: Any, name: str, environment: Any) -> None:
        if target._engine.is_symbol_defined(name):
            set_environment(target, name, environment)

    of_library._finalize_final_module, of_library.get_pointer_to_function = put_off, point_to
    of_library.serialize_using_object_code, of_target.set_env = keep_made, set_if_made
    try:
        yield
    finally:
        of_library._finalize_final_module, of_library.get_pointer_to_function = make, point
        of_library.serialize_using_object_code, of_target.set_env = keep, set_environment


def _load_kept(versions: Any, signature: Any, context: Any) -> Any:
    """Load a version of a kernel; None where it is not kept.

    Numba's own loading first brings in all that it can compile, which takes most of a second, and imports SciPy's
    linear algebra. A kept kernel is machine code: it needs Numba's runtime, and what `reload_init` asks for. Where
    nothing is kept, the compiler brings in the rest.

    Args:
        versions: `numba.core.caching.FunctionCache`, whose `load_overload` this is.
        signature: of the version.
        context: `numba.core.cpu.CPUContext`, which it is loaded into.
    """
    try:
        from numba.core.runtime.nrt import rtsys

        rtsys.initialize(context)
        with versions._guard_against_spurious_io_errors(), _linear_algebra_later():
            content = versions._cache_file.load(versions._index_key(signature, context.codegen()))
            if content is None:
                return None
            (_, _, (machine_code, *_)), *_ = content
            if b"_numba_hashsecret" in machine_code:
                context.refresh()  # these symbols alone are defined where Numba's implementations are imported
            return versions._impl.rebuild(context, content)
    except (AttributeError, ImportError, TypeError, ValueError):  # a version of Numba that is made otherwise
        return type(versions).load_overload(versions, signature, context)
    return None


@contextmanager
def _linear_algebra_later() -> Iterator[None]:
    """Let Numba's module of sums and the like, which kept kernels may name, not import SciPy to see if it is there.

    Compiled linear algebra asks for SciPy again, where it is called.
    """
    if "numba.np.arraymath" in sys.modules:
        yield
        return
    from numba.np import linalg

    asked = linalg.ensure_blas
    linalg.ensure_blas = _nothing
    try:
        yield
    finally:
        linalg.ensure_blas = asked
        if "numba.np.arraymath" in sys.modules:
            sys.modules["numba.np.arraymath"].ensure_blas = asked  # type: ignore[attr-defined]


def _nothing() -> None:
    """Import nothing."""


def declared_kernels(module: str = "") -> list[str]:
    """Name the kernels of the modules that are imported, or of one of them: `"module:qualified name"`."""
    return [f"{owner}:{name}" for owner, own in _declared.items() for name in own if module in {"", owner}]


def compile_kernels(names: Iterable[str]) -> None:
    """Compile, or load, kernels of modules that are imported."""
    for name in names:
        module, _, kernel_name = name.partition(":")
        _declared[module][kernel_name]()


@dataclass(frozen=True, slots=True)
class KernelCache:
    """The kept kernels of one Python.

    Attributes:
        folder: where they are kept.
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
    counts = _counts_of_kernels()
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    beside = Path(__file__).parent / "__pycache__"
    folder = Path(elsewhere) if elsewhere else beside
    writable = _can_write(folder)
    kept = _count_kept(counts)
    compiled = sum(min(count, kept[source]) for source, count in counts.items())
    users = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    usable = writable or any(map(_can_write, (beside, users)))
    return KernelCache(folder, writable, sum(counts.values()), compiled, usable)


def _counts_of_kernels() -> dict[Path, int]:
    """How many kernels each module has that has some."""
    sources = [source for package in PACKAGES for source in sorted((_PACKAGE / package).glob("*.py"))]
    return {source: count for source in sources if (count := _count_kernels(source))}


def _can_write(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made if it is not there: tried, as rights alone do not report."""
    there = next((one for one in (folder, *folder.parents) if one.exists()), None)
    if there is None or not there.is_dir():
        return False
    from tempfile import TemporaryFile

    try:
        with TemporaryFile(dir=there):
            return True
    except OSError:
        return False


def lacks_kernels(module: str) -> bool:
    """Whether a module, by its whole name, has kernels that are not kept yet: calling them takes seconds then."""
    source = _file_of(module)
    return source is not None and _count_kept([source])[source] < _count_kernels(source)


def _file_of(module: str) -> Path | None:
    """The file of a module that may have kernels; None for any other."""
    parts = module.split(".")
    if len(parts) != 3 or parts[0] != _PACKAGE.name or parts[1] not in PACKAGES:
        return None
    return _PACKAGE.parent.joinpath(*parts).with_suffix(".py")


def compile_all() -> None:
    """Compile all kernels that there are and that are not kept yet."""
    for source in _counts_of_kernels():
        import_module(".".join(source.relative_to(_PACKAGE.parent).with_suffix("").parts))
    compile_ahead(declared_kernels())
    compile_kernels(declared_kernels())


def compile_ahead(names: Iterable[str], *, started: Callable[["Popen[str]"], object] = id) -> None:
    """Compile kernels as `compiling_ahead` does, and return when all of them are kept."""
    with compiling_ahead(names, started=started):
        pass


@contextmanager
def compiling_ahead(
    names: Iterable[str], *, started: Callable[["Popen[str]"], object] = id
) -> Iterator[Callable[[Iterable[str]], None]]:
    """Compile those of some kernels that are not kept yet, in as many processes as there are processors.

    The compiler takes one processor, and a job meets its kernels one after another: this way they are ready in a
    fraction of the time. They are kept, and loaded where they are called. Nothing is done where that would not help:
    with one processor, or where kernels cannot be kept. What fails here fails again, and is reported, where it is
    called.

    Args:
        names: `"module:qualified name"`, in the order in which they are needed, then those that take longest first.
        started: receives each process that compiles; it may be killed.

    Yields:
        what waits for some of the kernels; leaving the block waits for all.
    """
    names = list(dict.fromkeys(names))
    sources = {module: _file_of(module) for module in dict.fromkeys(name.partition(":")[0] for name in names)}
    indices = _indices({source.parent for source in sources.values() if source is not None})
    kept = {
        f"{module}:{name}"
        for module, source in sources.items()
        if source is not None and source.is_file()
        for name in _kept_names(source, indices)
    }
    missing = [name for name in names if name not in kept]
    count = min(os.cpu_count() or 1, len(missing))
    if count < 2 or not find_kernel_cache().writable:
        yield lambda _: None
        return
    # what only compiling needs
    from concurrent.futures import ThreadPoolExecutor
    from queue import SimpleQueue
    from subprocess import DEVNULL, PIPE, Popen

    idle, processes, ended = SimpleQueue[Popen[str]](), list[Popen[str]](), list[Popen[str]]()

    def compile_one(name: str, left: int) -> None:
        process: Any = idle.get()
        _report(name, left)
        with suppress(BrokenPipeError):
            print(name, file=process.stdin, flush=True)
            if process.stdout.readline():
                idle.put(process)
                return
        ended.append(process)
        for each in processes if len(ended) >= count else ():  # nobody is left who could be waited for
            idle.put(each)

    with ThreadPoolExecutor(count) as pool:
        for _ in range(count):
            command = [sys.executable, "-c", f"from {__name__} import _compile_asked; _compile_asked()"]
            processes.append(Popen(command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL, text=True))  # noqa: S603 - our own
            started(processes[-1])
            idle.put(processes[-1])
        done = {name: pool.submit(compile_one, name, len(missing) - k) for k, name in enumerate(missing)}

        def wait(some: Iterable[str]) -> None:
            for name in some:
                if name in done:
                    done[name].result()

        try:
            yield wait
            wait(done)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.kill()
            raise
    for process in processes:
        process.communicate()


def _compile_asked() -> None:
    """Compile the kernels that standard input names, and print each once it is kept; whoever waits less comes first."""
    if hasattr(os, "nice"):
        os.nice(5)
    # the compiler makes many objects and few cycles: looking for these takes 7 % of its time, this way 3 %
    gc.set_threshold(100_000, 20, 20)
    for line in sys.stdin:
        module, _, name = line.strip().partition(":")
        with suppress(ImportError, KeyError):
            import_module(module)
            _declared[module][name]()
        sys.stdout.write(line)
        sys.stdout.flush()


@contextmanager
def reporting_compiling(report: Callable[[str, int], None]) -> Iterator[None]:
    """Report each kernel before it is compiled: its module and name, and how many are left with it."""
    _reports.append(report)
    try:
        yield
    finally:
        _reports.remove(report)


def _report(name: str, left: int) -> None:
    for report in tuple(_reports):
        report(name, left)


def _count_kernels(source: Path) -> int:
    if not source.is_file() or source == Path(__file__):
        return 0
    text = source.read_text("utf-8")
    return sum(count * len(pattern.findall(text)) for pattern, count in _MAKERS.items())


def _count_kept(sources: Collection[Path]) -> dict[Path, int]:
    """Count, for each module, the functions of which an index of versions compiled from the present source is kept."""
    digests = {source: source_digest(source).encode() for source in sources if source.is_file()}
    contents = _indices({s.parent for s in digests})
    counts = {s: sum(digest in content for content in contents.values()) for s, digest in digests.items()}
    return {source: counts.get(source, 0) for source in sources}


def _is_kept(function: Callable[..., Any]) -> bool:
    """Whether versions of a kernel are kept that fit the present source of its module."""
    source = _source_of(function)
    return function.__qualname__ in _kept_names(source, _indices({source.parent}))


def _kept_names(source: Path, indices: Mapping[str, bytes]) -> set[str]:
    """The qualified names of the kernels whose indices are of the present source of a module."""
    digest = source_digest(source).encode()
    return {name.partition(".")[2].rpartition("-")[0] for name, content in indices.items() if digest in content}


def _indices(folders: Iterable[Path]) -> dict[str, bytes]:
    """The indices of kept kernels by their names, as Numba writes them: `FILE.FUNCTION-LINE.py311.nbi`."""
    pattern = f"*.*-*.py{sys.version_info.major}{sys.version_info.minor}.nbi"
    if elsewhere := os.environ.get("NUMBA_CACHE_DIR"):
        found = list(Path(elsewhere).glob(f"**/{pattern}"))
    else:
        found = [index for folder in folders for index in folder.glob(f"__pycache__/{pattern}")]
    return {index.name: index.read_bytes() for index in found}


@cache
def source_digest(source: Path) -> str:
    """Name the content of a module and of all that its kernels may be made of.

    These are the modules that it imports from `PACKAGES` and from the top of the project: nothing else is compiled.
    """
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
        for module, several, one_line in _IMPORTED.findall(text):
            if module.count(".") > 1 and module.split(".")[1] not in PACKAGES:
                continue
            found = _PACKAGE.parent.joinpath(*module.split("."))
            names = (several or one_line).split(",")
            members = (found / f"{name.split(' as ')[0].strip()}.py" for name in names)
            waiting += [found.with_suffix(".py"), *sorted(members)]
    return digest.hexdigest()


def _source_of(function: Callable[..., Any]) -> Path:
    """The file of a function's module, where a change makes it another function."""
    module = sys.modules.get(function.__module__)
    return Path(getattr(module, "__file__", None) or function.__code__.co_filename)
