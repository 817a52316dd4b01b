"""Several drives opened with the same options: each option counts for those whose format takes it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from sceneloom.errors import UnknownOptionError
from sceneloom.formats.table import open_scene
from sceneloom.scene.scene import Scene

Read = TypeVar("Read")


@dataclass(slots=True)
class SharedOptions:
    """Reading options of several drives.

    Attributes:
        options: by name.
    """

    options: Mapping[str, Any]
    _taken: set[str] = field(default_factory=set)
    _refused: dict[str, UnknownOptionError] = field(default_factory=dict)

    def read(self, reader: Callable[..., Read]) -> Read:
        """Call what reads a drive, with those of the options that it takes."""
        left = dict(self.options)
        while True:
            try:
                found = reader(**left)
            except UnknownOptionError as error:
                if error.option not in left:
                    raise
                self._refused[error.option] = error
                del left[error.option]
            else:
                self._taken.update(left)
                return found

    def check(self) -> None:
        """Refuse an option that no drive took.

        Raises:
            UnknownOptionError: there is one.
        """
        for name, error in self._refused.items():
            if name not in self._taken:
                raise error


@contextmanager
def open_scenes(paths: Sequence[str | Path], options: Mapping[str, Any]) -> Iterator[list[Scene]]:
    """Open several drives, as `open_scene` opens one, and close them all.

    Args:
        paths: files, folders or URLs.
        options: of reading; each for the drives whose format takes it.

    Raises:
        UnknownOptionError: none of them takes an option.
        SceneloomError: one cannot be opened.
    """
    shared = SharedOptions(options)
    with ExitStack() as stack:
        scenes = [stack.enter_context(shared.read(partial(open_scene, path))) for path in paths]
        shared.check()
        yield scenes
