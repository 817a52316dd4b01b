"""What is to be done with many drives, and what came of each."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any
from urllib.parse import unquote, urlsplit

import msgspec

from sceneloom.formats.urls import is_url
from sceneloom.redaction import redacted

NOTHING: Mapping[str, Any] = MappingProxyType({})


class State(StrEnum):
    """Where a drive is in a run."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Input:
    """One drive of a run.

    Attributes:
        location: its path, or its URL.
        options: what counts for it alone, as the seconds at which a part of it starts and stops.
        files: what the verb reads beside it, by option, instead of what all drives have; as of `Job`.
        unread: options whose files a list names for other verbs.
    """

    location: str
    options: Mapping[str, Any] = field(default_factory=lambda: NOTHING)
    files: Mapping[str, Any] = field(default_factory=lambda: NOTHING)
    unread: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        """What the record calls it: its location without secrets, which stays the same when a URL is signed anew."""
        return redacted(self.location)


@dataclass(frozen=True, slots=True, kw_only=True)
class Further:
    """A further output that was asked for of all drives.

    Attributes:
        option: the verb's option that names it.
        location: what was stated: a folder, or a file whose name stands behind those of the drives.
        is_folder: which of both.
    """

    option: str
    location: str
    is_folder: bool

    @property
    def folder(self) -> str:
        """Where those of all drives lie."""
        if self.is_folder:
            return self.location.rstrip("/")
        return self.location.rpartition("/")[0] if is_url(self.location) else str(Path(self.location).parent)

    def of(self, drive: str) -> str:
        """The location of one drive's.

        Args:
            drive: what its output is called, without a suffix.
        """
        name = drive if self.is_folder else f"{drive}.{name_of(self.location).lstrip('.')}"
        return f"{self.folder}/{name}" if is_url(self.location) else str(Path(self.folder, name))


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One verb over many drives.

    Attributes:
        verb: its name, for people and for the record.
        call: `module:function` that does one drive: `function(location, output, options)` writes `output` and gives
            what the record keeps, or raises.
        inputs: the drives.
        options: of the verb, alike for all; they pickle.
        files: those that name files which the verb reads beside a drive, as far as all drives have the same: a path
            each, or several as a tuple; they go before `options`. A drive is done anew when one of its files changed.
        suffix: what names of outputs end in; "" for folders.
        retries: how often a drive is tried again where the cause can pass.
        modules: what workers of this machine import before they begin, once for all of them.
        further: outputs beside these, which `call` writes where its options of these names state.
    """

    verb: str
    call: str
    inputs: tuple[Input, ...]
    options: Mapping[str, Any] = field(default_factory=lambda: NOTHING)
    files: Mapping[str, Any] = field(default_factory=lambda: NOTHING)
    suffix: str = ""
    retries: int = 2
    modules: tuple[str, ...] = ()
    further: tuple[Further, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One try at one drive; it pickles, and any worker can take it.

    Attributes:
        number: of the drive in the run.
        attempt: 1 for the first try.
        call, location, options: as of `Job` and `Input`.
        draft: where the output is written; from there it is moved to its location once it is whole. Below the temporary
            folder of the worker's machine if there is a `target`.
        target: the folder of a store that the worker sends the output to once it is whole; "" for none.
        further: where further outputs belong, by the option that names each.
        files: what is read beside the drive, by option, as of `Job`.
    """

    number: int
    attempt: int
    call: str
    location: str
    draft: Path
    options: Mapping[str, Any]
    target: str = ""
    further: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, Any] = field(default_factory=dict)


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """What came of one try.

    Attributes:
        number: of the drive in the run.
        error: what went wrong, for a person; "" if nothing did.
        kind: name of the error's class, "Lost" for a worker that is gone.
        passing: whether the same may work another time.
        report: what the verb reported, as JSON values; if it is an object, with the seconds of its stages as `stages`,
            and where its further outputs are as `further`.
        fingerprint: of the drive as it was before.
        seconds: by the clock [s].
        processor_seconds: of the worker's processor [s].
        peak_bytes: the most memory that the worker ever had up to then.
        worker: who did it.
    """

    number: int
    error: str = ""
    kind: str = ""
    passing: bool = False
    report: Any = None
    fingerprint: str = ""
    seconds: float = 0.0
    processor_seconds: float = 0.0
    peak_bytes: int = 0
    worker: str = ""


def name_of(location: str) -> str:
    """The last part of a path or address."""
    return PurePosixPath(unquote(urlsplit(location).path)).name if is_url(location) else Path(location).name
