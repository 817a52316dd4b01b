"""The exceptions that sceneloom raises, and how secrets and local folders are redacted from messages.

```
SceneloomError
├── ArrayError            an array has the wrong shape, dtype or values
├── DataError             a file or folder holds something wrong: file, location, problem
│   └── UnknownFormatError    no reader, or more than one, claims a path
├── CalibrationError      a camera model or a mounting cannot be used
├── PoseError             the poses that a computation needs are missing
├── OptionError           a value given by the caller is not one that can be followed
│   └── UnknownOptionError    an option that the format at hand does not take
├── OutputError           an output exists already or cannot be written
│   └── LossError             an output would lose something, and that was not to be
└── MissingExtraError     an optional part of the package is not installed
```

Every class keeps its constructor's arguments in `args`, so instances survive pickling between processes. Addresses in
them are without passwords and signatures: messages end in logs.
"""

import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_HIDDEN = "***"

_NAMES = (
    r"x-(?:amz|goog|oss|ms)-[a-z0-9-]+",
    r"awsaccesskeyid|googleaccessid|key-pair-id|policy|expires",
    r"sig|signature|sv|se|sp|sr|st|skoid|sktid|ske|sks|skv|spr|sip",
    r"[a-z0-9_.-]*(?:token|secret|password|passwd|credential|api[-_]?key|access[-_]?key|account[-_]?key)[a-z0-9_.-]*",
    r"auth|authorization|code|key|pwd",
)
"""Names of a query whose values are secrets, or parts of a signature.

Source: query authentication of AWS Signature 4 and of Cloud Storage, shared access signatures of Azure Storage.
"""

_USER = re.compile(r"(?P<scheme>[a-zA-Z][a-zA-Z0-9+.-]*://)[^/?#\s'\"<>]*@")

_SECRET = re.compile(rf"(?P<name>(?:[?&;]|%3F|%26)(?:{'|'.join(_NAMES)})(?:=|%3D))[^&\s'\"<>)\],;]*", re.IGNORECASE)

_HEADER = re.compile(
    r"(?P<name>\b(?:authorization|proxy-authorization|x-amz-security-token|cookie|aws_secret_access_key|"
    r"aws_session_token|accountkey|sharedaccesssignature)['\"]?\s*[:=]\s*['\"]?)"
    r"(?:(?:bearer|basic|token)\s+)?[^\s'\",;]+",
    re.IGNORECASE,
)


def redacted(text: object) -> str:
    """Give text, an address or a message with addresses in it, without its secrets."""
    plain = str(text)
    if "://" not in plain and _HEADER.search(plain) is None:
        return plain
    found = _USER.sub(rf"\g<scheme>{_HIDDEN}@", plain)
    return _HEADER.sub(rf"\g<name>{_HIDDEN}", _SECRET.sub(rf"\g<name>{_HIDDEN}", found))


def without_folders(text: str, source: str) -> str:
    """Give text about a drive without the folders above it, as it goes into files that are handed on.

    Args:
        text: a message, a location in the drive, or a whole document.
        source: the path of the drive as it was given; several are joined by " + ".
    """
    plain = text
    for each in source.split(" + "):
        if "://" in each or not ("/" in each or "\\" in each):
            continue
        path = Path(each)
        for parent in {str(path.parent), str(path.absolute().parent)}:
            if parent not in {"/", ".", ""}:
                plain = plain.replace(f"{parent}/", "").replace(f"{parent}\\", "")
    return plain


class SceneloomError(Exception):
    """Base of everything that sceneloom raises on purpose.

    Attributes:
        warnings: what was assumed, repaired or left out before of the scenes that were read.
        passing: whether the cause, a busy server or a connection that was cut, may be gone another time.
        sources: the scenes that were open when it was raised, by the addresses that they were read from.
    """

    warnings: tuple[Any, ...] = ()
    passing: bool = False
    sources: tuple[str, ...] = ()

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*(redacted(each) if isinstance(each, str) else each for each in arguments))

    def remember(self, warnings: tuple[Any, ...]) -> None:
        """Keep what was noticed before, once, in the order in which it was."""
        self.warnings = (*(warning for warning in warnings if warning not in self.warnings), *self.warnings)

    def raised_with(self, source: str) -> None:
        """Note a scene that was open."""
        if source and source not in self.sources:
            self.sources = (*self.sources, redacted(source))

    def with_sources(self) -> str:
        """The message, after the names of the scenes that were open where it names none of them."""
        text = str(self)
        if any(source in text for source in self.sources):
            return text
        return ": ".join(part for part in (", ".join(self.sources), text) if part)

    def rename(self, location: str, called: str) -> None:
        """Report what a location is called by people, where it is a copy of what they named."""
        called = redacted(called)
        self.args = tuple(_renamed(value, location, called) for value in self.args)
        for name, value in vars(self).items():
            setattr(self, name, _renamed(value, location, called))


def _renamed(value: Any, location: str, called: str) -> Any:
    return value.replace(location, called) if isinstance(value, str) else value


class ArrayError(SceneloomError):
    """An array has the wrong shape, dtype or values."""


class DataError(SceneloomError):
    """A file holds something wrong; the message names file, location, value and what was expected."""

    def __init__(self, file: object, location: str, problem: str) -> None:
        super().__init__(str(file), location, problem)
        self.file: str = self.args[0]
        self.location: str = self.args[1]
        self.problem: str = self.args[2]

    def __str__(self) -> str:
        return ": ".join(part for part in (self.file, self.location, self.problem) if part)


class UnknownFormatError(DataError):
    """No reader, or more than one, claims a path."""


class CalibrationError(SceneloomError):
    """A camera model or a mounting cannot be used."""


class PoseError(SceneloomError):
    """The poses that a computation needs are missing or do not reach far enough."""


class OptionError(SceneloomError):
    """A value given by the caller is not one that can be followed."""


class UnknownOptionError(OptionError):
    """An option that the format at hand does not take; the message names those that it does."""

    def __init__(self, option: str, doing: str, known: tuple[str, ...]) -> None:
        super().__init__(option, doing, known)
        self.option, self.doing, self.known = option, doing, known

    def __str__(self) -> str:
        return f"option {self.option!r}; {self.doing} takes {', '.join(self.known) or 'no options'}"


def check_choice(name: str, value: object, known: Iterable[str]) -> None:
    """Check that an option is one of those known.

    Raises:
        OptionError: it is none of them.
    """
    choices = tuple(known)
    if value not in choices:
        stated = str(value) if isinstance(value, str) else value  # members of other enumerations, too
        raise OptionError(f"{name} {stated!r}; expected one of {', '.join(choices)}")


def check_option_names(doing: str, given: Iterable[str], known: tuple[str, ...]) -> None:
    """Refuse options that are not among the known ones; `doing` is what takes them, as in "writing a recording".

    Raises:
        UnknownOptionError: there is one.
    """
    for name in given:
        if name not in known:
            raise UnknownOptionError(name, doing, known)


class OutputError(SceneloomError):
    """An output exists already or cannot be written."""


class LossError(OutputError):
    """A target would not hold all of its source, and was to hold it; `report` says of every field what would be."""

    def __init__(self, target: object, problem: str, report: Any) -> None:
        super().__init__(str(target), problem, report)
        self.target: str = self.args[0]
        self.problem: str = self.args[1]
        self.report = report

    def __str__(self) -> str:
        return f"{self.target}: {self.problem}"


class MissingExtraError(SceneloomError):
    """An optional part of the package is not installed."""


def how_to_install(extra: str) -> str:
    """Report how an extra of this package is installed, from an index or from a checkout of it."""
    return f"pip install 'sceneloom[{extra}]' (in a checkout: pip install '.[{extra}]')"


def ignore_warnings_of_extreme_numbers() -> None:
    """Let programs, but not users of the library, compute with the extreme numbers of files without NumPy's warnings.

    Called by `cli.main.main` and the workers of batches only, never on import: users of the library keep the filters
    and `numpy.seterr` of their own process, and the tests, in which warnings are errors, those of theirs. Filters are
    used instead of `numpy.seterr`, whose state is that of one thread, while threads decode what is read.

    What overflows becomes infinite or no number, and is judged by whoever uses it. Casts of such numbers to integers,
    and sums of integers that overflow, which would give any number, are still warned of. The filter
    holds for all threads of the process.
    """
    for message in (
        "(overflow|divide by zero) encountered in (?!scalar (add|subtract))",
        "invalid value encountered in (?!cast)",
        "All-NaN ",
        "Mean of empty slice",
    ):
        warnings.filterwarnings("ignore", message, RuntimeWarning)
