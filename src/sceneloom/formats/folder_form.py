"""What a data set, a folder of a known layout, offers to the table of formats."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError, check_option_names
from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import Holding, LossReport
from sceneloom.scene.scene import Scene

NOTHING_HELD: Mapping[str, Holding] = MappingProxyType({})


@dataclass(frozen=True, kw_only=True, eq=False)
class FolderFormat:
    """A format whose drives are folders; it is only read if it has no writer.

    Attributes:
        name, suffixes, looks_like, holds, along_trajectory: as of `Format`.
        called: what messages call it, as in "opening PandaSet".
        recogniser: says whether an existing path is such a folder.
        missing: says what keeps a folder from being one, where that can be guessed.
        reader: opens a path with the options of `reading_options`, which it describes.
        drives: gives the drives of such a folder: a folder of its own, or the name that the reader's `sequence` takes;
            None where a folder is always one drive.
        writer: writes a scene to a path with those of `writing_options`; None where the format is only read.
        refusal: what is only read, and what can be written in its place; of formats without a writer.
    """

    name: str
    called: str
    looks_like: str
    recogniser: Callable[[Path], bool]
    missing: Callable[[Path], str | None]
    reader: Callable[..., Scene]
    reading_options: tuple[str, ...]
    drives: Callable[[Path], Sequence[Path | str]] | None = None
    writer: Callable[..., LossReport] | None = None
    writing_options: tuple[str, ...] = ()
    refusal: str = ""
    along_trajectory: bool = False
    suffixes: tuple[str, ...] = ("",)
    holds: Holds = field(default_factory=lambda: NOTHING_HELD)

    @property
    def writes(self) -> bool:
        """Whether scenes can be written so."""
        return self.writer is not None

    def recognises(self, path: Path) -> bool:
        """Say whether the path is such a folder."""
        return self.recogniser(path)

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder from being one, where it looks like a half one."""
        return self.missing(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a folder.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: there are several drives in it, and none was chosen.
            DataError: something is missing or wrong.
            MissingExtraError: what reads its files is not installed.
        """
        check_option_names(f"opening {self.called}", options, self.reading_options)
        return self.reader(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene so.

        Raises:
            UnknownOptionError: an option is unknown.
            OutputError: the folder exists, or cannot be written.
            OptionError: the format is only read.
        """
        if self.writer is None:
            raise OptionError(f"{path}: {self.refusal}")
        check_option_names(f"writing {self.called}", options, self.writing_options)
        return self.writer(scene, path, overwrite=overwrite, **options)
