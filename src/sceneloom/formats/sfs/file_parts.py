"""What a scene holds on to of its file: functions that read one thing each, and work in other processes, too."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from sceneloom.errors import DataError
from sceneloom.formats.sfs.container import Container


class Indexed(Protocol):
    """A video of the file, whose list of images is worth taking along."""

    index: Any


class FileParts:
    """The functions of an open file by name.

    Where it was pickled, it opens the file again when the first of them is called, makes the same functions from it,
    and takes the lists of images of the videos along, for which they would have to be read from end to end.
    Closing it closes nothing in other processes; what is pickled after closing stays closed.

    Attributes:
        videos: the videos of the file by the position of their bytes.
    """

    def __init__(self, container: Container, reopen: "Callable[[Path | str], FileParts]") -> None:
        """Hold an open file.

        Args:
            container: the file.
            reopen: opens it again in another process and keeps the same parts; a function that can be pickled.
        """
        self._container: Container | None = container
        self._identity = container.identity
        self._reopen = reopen
        self._functions: dict[str, Callable[..., Any]] = {}
        self._indices: dict[str, Any] = {}
        self._closed = False
        self._again: FileParts | None = None
        self.videos: dict[str, Indexed] = {}

    def keep(self, name: str, function: Callable[..., Any]) -> "FilePart":
        """Keep a function of the file under a name, and give what stands for it in a scene."""
        self._functions[name] = function
        return FilePart(self, name)

    def function(self, name: str) -> Callable[..., Any]:
        """Find a function by its name; opens the file if this process has not done so.

        Raises:
            DataError: the file cannot be opened again, is another one now, or the scene was closed.
        """
        if self._container is None:
            return self._opened_again(name).function(name)
        return self._functions[name]

    def close(self) -> None:
        """Close the file in this process."""
        self._closed = True
        if self._container is not None:
            self._container.close()
        if self._again is not None:
            self._again.close()

    def __getstate__(self) -> dict[str, Any]:
        known = {location: video.index for location, video in self.videos.items() if video.index is not None}
        return {
            "_identity": self._identity,
            "_reopen": self._reopen,
            "_indices": {**self._indices, **known},
            "_closed": self._closed,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._container, self._again, self._functions, self.videos = None, None, {}, {}

    def _opened_again(self, name: str) -> "FileParts":
        if self._closed:
            raise DataError(self._identity.name, name, "the scene is closed; read its frames before that")
        if self._again is None:
            self._identity.check()
            again = self._reopen(self._identity.path)
            for location, index in self._indices.items():
                again.videos[location].index = index
            self.videos, self._again = again.videos, again
        return self._again


@dataclass(frozen=True, slots=True, eq=False)
class FilePart:
    """A function of a file, that finds the file again wherever it is called."""

    parts: FileParts
    name: str

    def __call__(self, *arguments: Any) -> Any:
        """Call it."""
        return self.parts.function(self.name)(*arguments)
