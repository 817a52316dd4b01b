"""The exceptions that sceneloom raises.

```
SceneloomError
├── ArrayError            an array has the wrong shape, dtype or values
├── DataError             a file or folder holds something wrong: file, place, problem
│   └── UnknownFormatError    no reader, or more than one, claims a path
├── CalibrationError      a lens or a mounting cannot be used
├── PoseError             the poses that a computation needs are missing
├── OptionError           a value given by the caller is not one that can be followed
├── OutputError           an output exists already or cannot be written
└── MissingExtraError     an optional part of the package is not installed
```

Every class keeps its constructor's arguments in `args`, so instances survive pickling between processes.
"""

from typing import Any


class SceneloomError(Exception):
    """Base of everything that sceneloom raises on purpose.

    Attributes:
        notices: what was assumed, repaired or left out before of the scenes that were read.
    """

    notices: tuple[Any, ...] = ()

    def remember(self, notices: tuple[Any, ...]) -> None:
        """Keep what was noticed before, once, in the order in which it was."""
        self.notices = (*(notice for notice in notices if notice not in self.notices), *self.notices)


class ArrayError(SceneloomError):
    """An array has the wrong shape, dtype or values."""


class DataError(SceneloomError):
    """A file holds something wrong; the message names file, place, value and what was expected."""

    def __init__(self, file: object, place: str, problem: str) -> None:
        super().__init__(str(file), place, problem)
        self.file, self.place, self.problem = str(file), place, problem

    def __str__(self) -> str:
        return ": ".join(part for part in (self.file, self.place, self.problem) if part)


class UnknownFormatError(DataError):
    """No reader, or more than one, claims a path."""


class CalibrationError(SceneloomError):
    """A lens or a mounting cannot be used."""


class PoseError(SceneloomError):
    """The poses that a computation needs are missing or do not reach far enough."""


class OptionError(SceneloomError):
    """A value given by the caller is not one that can be followed."""


class OutputError(SceneloomError):
    """An output exists already or cannot be written."""


class MissingExtraError(SceneloomError):
    """An optional part of the package is not installed."""
