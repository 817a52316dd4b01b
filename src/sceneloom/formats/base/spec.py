"""What a format is: a `FormatSpec` with its options, its supported fields, and its reader and writer by name."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import structs

from sceneloom.errors import (
    DataError,
    MissingExtraError,
    OptionError,
    SceneloomError,
    check_option_names,
    how_to_install,
    redacted,
)
from sceneloom.formats.base.files import open_file, path_or_url
from sceneloom.formats.base.losses import LossReport, Supports
from sceneloom.lazy import imported

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene


def option(*, default: Any, help: str) -> Any:  # noqa: A002 - as argparse and click call it
    """A field of an options dataclass: its default, and what it is for."""
    return field(default=default, metadata={"help": help})


@dataclass(frozen=True, kw_only=True, eq=False)
class FormatSpec:
    """A format, without its code. Other packages add theirs as entry points of the group `sceneloom.formats`.

    Attributes:
        name: by which it is chosen.
        title: what messages call it, as in "opening Argoverse 2".
        looks_like: what a person recognises it by ("a file that begins with its header").
        suffixes: of its files; "" for a folder without one.
        sniff: whether the content of an existing path is of this format.
        near_miss: what a path lacks that is nearly of this format, or None.
        drives: the drives of a path that holds several: folders, or names that the option `sequence` takes.
        reader: `"module:function"` of `(path, **options) -> Scene`; "" where the format is only written.
        read_options: names of the reader's options; or a dataclass of them, which the reader takes as `options`.
        reads_urls: whether the reader takes a URL as text, too, and reads it by ranges.
        examiner: `"module:function"` as `reader`, without `lenient`: all faults with the scene of what is sound; "" if
            there is none.
        writer: `"module:function"` of `(scene, path, *, overwrite, **options) -> LossReport`; "" where only read.
        write_options: as `read_options`.
        output_check: `"module:function"` of `(path)`, which refuses harmful outputs; "" if there is none.
        supports: what becomes of each field of a scene that is written, whatever the scene, by names of `MODEL_FIELDS`
            or beginnings of them; what depends on the scene is known by the losses of `write`.
        holds_corrections: whether corrections are written as annotations.
        along_trajectory: whether `write` takes the name of the ego's trajectory as `trajectory`.
        extra: the extra that reader and writer need; "" if none.
        needs: the modules of it, which are looked for before anything is imported piece by piece.
        given: further arguments of reader and writer, which formats with the same functions differ by.
        instead: why the missing direction is missing, and what to do instead.
    """

    name: str
    title: str
    looks_like: str
    suffixes: tuple[str, ...] = ("",)
    sniff: Callable[[Path], bool] = lambda path: False  # noqa: ARG005
    near_miss: Callable[[Path], str | None] = lambda path: None  # noqa: ARG005
    drives: Callable[[Path], Sequence[Path | str]] | None = None
    reader: str = ""
    read_options: tuple[str, ...] | type[Any] = ()
    reads_urls: bool = False
    examiner: str = ""
    writer: str = ""
    write_options: tuple[str, ...] | type[Any] = ()
    output_check: str = ""
    supports: Supports = field(default_factory=dict)
    holds_corrections: bool = False
    along_trajectory: bool = False
    extra: str = ""
    needs: tuple[str, ...] = ()
    given: Mapping[str, Any] = field(default_factory=dict)
    instead: str = ""

    @property
    def reads(self) -> bool:
        """Whether files of it are read."""
        return bool(self.reader)

    @property
    def writes(self) -> bool:
        """Whether files of it are written."""
        return bool(self.writer)

    def open(self, path: Path | str, **options: Any) -> "Scene":
        """Open a path lazily, or a URL as text if `reads_urls`; the scene owns its files.

        Args:
            path: a file or folder.
            options: those of `read_options`; None for what is not stated. Of every format `rig` and `rig_names`:
                files of mountings and camera models, as of `open_scene`.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: the format is only written, or the value of an option cannot be followed.
            DataError: the content is wrong.
            MissingExtraError: what reads its files is not installed.
        """
        if not self.reader:
            raise OptionError(f"{path}: {self.instead}")
        rig, left = _rig_of(options)
        if rig is not None and isinstance(self.read_options, tuple) and "rig" in self.read_options:
            return self._read(self.reader, path, {**left, "rig": rig})  # type: ignore[no-any-return]
        scene: Scene = self._read(self.reader, path, left)
        return scene if rig is None else _rigged(scene, rig)

    def examine(self, path: Path | str, **options: Any) -> Any:
        """Give all faults of a path, and the scene of all that is sound; options as for `open`, without `lenient`.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: the value of an option cannot be followed.
        """
        rig, left = _rig_of(options)
        found = self._read(self.examiner, path, {name: value for name, value in left.items() if name != "lenient"})
        return found if rig is None or found.scene is None else replace(found, scene=_rigged(found.scene, rig))

    def write(self, scene: "Scene", path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write beside the target, then rename; report what the format could not hold.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: the format is only read, or cannot hold something.
            DataError: a frame or image cannot be read.
            OutputError: the output exists, or cannot be written.
            MissingExtraError: what writes its files is not installed.
        """
        if not self.writer:
            raise OptionError(f"{path}: {self.instead}")
        taken = _arguments(self.write_options, f"writing {self.title}", options)
        report: LossReport = self._function(self.writer)(
            scene, Path(path) if isinstance(path, str) else path, overwrite=overwrite, **self.given, **taken
        )
        return report

    def check_output(self, path: Path) -> None:
        """Refuse a location where an output would do harm.

        Raises:
            OutputError: the path is one.
        """
        if self.output_check:
            self._function(self.output_check)(path)

    def _read(self, function: str, path: Path | str, options: Mapping[str, Any]) -> Any:
        taken = _arguments(self.read_options, f"opening {self.title}", options)
        where = path
        if isinstance(path, str):
            where = path_or_url(path) if self.reads_urls else Path(path)
        read = partial(self._function(function), **self.given, **taken)
        if isinstance(where, Path) and begins(where, ZIP) and not self.sniff(where):
            return self._read_unpacked(read, where)
        return read(where)

    def _read_unpacked(self, read: Callable[[Path], Any], path: Path) -> Any:
        """Read a drive in a zip archive; what is unpacked for it goes when its scene is closed."""
        from sceneloom.formats.base.zipped import unpack

        unpacked = unpack(path)
        folder, archive = str(unpacked.folder), str(path)
        try:
            found = read(unpacked.location_of(self.sniff, self.looks_like))
        except BaseException as error:
            unpacked.remove()
            if isinstance(error, SceneloomError):
                error.rename(folder, archive)
            raise
        scene = getattr(found, "scene", found)
        if scene is None:
            unpacked.remove()
            return found
        scene = replace(
            scene,
            source=redacted(archive),
            warnings=tuple(
                structs.replace(one, **{name: getattr(one, name).replace(folder, archive) for name in _TEXTS})
                for one in scene.warnings
            ),
            on_close=partial(close_both, scene.on_close, unpacked.remove),
        )
        return replace(found, scene=scene) if hasattr(found, "scene") else scene

    def _function(self, name: str) -> Callable[..., Any]:
        try:
            for module in self.needs:
                import_module(module)
        except ImportError as missing:
            raise MissingExtraError(f"{missing}; install the extra: {how_to_install(self.extra)}") from missing
        found: Callable[..., Any] = imported(name)
        return found


_TEXTS = ("location", "message")  # of warnings


def close_both(close: Callable[[], None], remove: Callable[[], None]) -> None:
    """Close what a scene holds open, then remove what was put on the disk for it."""
    close()
    remove()


def _rig_of(options: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Read the files of a rig that options name; give it, or None, and the other options."""
    left = dict(options)
    files, names = left.pop("rig", None), left.pop("rig_names", None)
    if not files and names:
        raise OptionError("rig_names without rig; expected the files of the rig")
    return (imported("sceneloom.formats.rig_files.reader:read_rig")(files, names) if files else None), left


def _rigged(scene: "Scene", rig: Any) -> "Scene":
    """Give the scene with the mountings and camera models of a rig; where that cannot be, it is closed."""
    try:
        changed: Scene = imported("sceneloom.formats.rig_files.matching:with_rig")(scene, rig)
    except BaseException:
        scene.close()
        raise
    return changed


def _arguments(known: tuple[str, ...] | type[Any], doing: str, options: Mapping[str, Any]) -> dict[str, Any]:
    given = {name: value for name, value in options.items() if value is not None}
    if isinstance(known, tuple):
        check_option_names(doing, given, known)
        return given
    check_option_names(doing, given, tuple(one.name for one in fields(known)))
    return {"options": known(**given)}


# What the specs and readers of several formats share.

ZIP = b"PK\x03\x04"
"""What zip archives begin with."""

_LOOKED_AT = 50
_MOST_NAMES = 20


def begins(path: Path, magic: bytes) -> bool:
    """Whether a path is a file that begins with some bytes."""
    return first_bytes(path, len(magic)) == magic


def first_bytes(path: Path, count: int) -> bytes:
    """The first bytes of a file; none of what is no file, or cannot be read."""
    try:
        if not path.is_file():
            return b""
        with open_file(path) as file:
            return file.read(count)
    except OSError:
        return b""


def any_drive(path: Path, is_drive: Callable[[Path], bool]) -> bool:
    """Whether a path is a drive, or a folder among whose first entries is one."""
    return path.is_dir() and (is_drive(path) or any(map(is_drive, islice(path.iterdir(), _LOOKED_AT))))


def drives_in(path: Path, is_drive: Callable[[Path], bool]) -> list[Path]:
    """The drive that a folder is, or the drives in it; each by a path that ends in its name."""
    if not path.is_dir():
        return []
    if is_drive(path):
        return [path if path.name else path.resolve()]  # `.` has no name
    return [child for child in sorted(path.iterdir()) if is_drive(child)]


def choose_drive(path: Path, drives: Sequence[Path], sequence: str | None, *, called: str, expected: str) -> Path:
    """Choose one of the drives of a folder.

    Args:
        path: the folder, for messages.
        drives: those in it.
        sequence: name of the one that is wanted, or None where there is only one.
        called: what the data set calls a drive ("log").
        expected: what a folder with a drive looks like.

    Raises:
        DataError: there is none.
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    if not drives:
        problem = f"no {called}" if path.is_dir() else "no such folder"
        raise DataError(path, "", f"{problem}; expected a folder with {expected}")
    names = [drive.name for drive in drives]
    shown = ", ".join(names[:_MOST_NAMES])
    shown += f", … ({len(names)} in all)" if len(names) > _MOST_NAMES else ""
    if sequence is not None:
        if sequence not in names:
            raise OptionError(f"{path}: no {called} {sequence!r}; it has {shown}")
        return drives[names.index(sequence)]
    if len(drives) > 1:
        raise OptionError(f"{path}: {len(drives)} {called}s; choose one with `--sequence NAME`: {shown}")
    return drives[0]


_YES, _NO = ("true", "yes", "on", "1"), ("false", "no", "off", "0")


def as_flag(name: str, value: object) -> bool:
    """Take a value as true or false.

    Raises:
        OptionError: it is neither.
    """
    text = str(value).lower()
    if text not in (*_YES, *_NO):
        raise OptionError(f"{name} {value!r}; expected true or false")
    return text in _YES


def as_positive(name: str, value: float | str) -> float:
    """Take a value as a finite number above 0.

    Raises:
        OptionError: it is none.
    """
    try:
        number = float(value)
    except ValueError:
        number = 0.0
    if not 0.0 < number < float("inf"):
        raise OptionError(f"{name} {value}; expected a number above 0")
    return number
