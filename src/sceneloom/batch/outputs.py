"""Where the outputs of a run are put: a folder on disk, or a location in a store.

On disk a worker writes a draft, and the run moves it to its location in one step. Into a store the worker itself sends
it, as an object that appears whole or not at all; what the run has in the store beside them is a claim, an object which
names the one record that belongs to these outputs.
"""

import os
import shutil
import socket
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import blake2b
from pathlib import Path
from typing import Protocol

import msgspec

from sceneloom.batch.jobs import Task
from sceneloom.errors import OutputError
from sceneloom.formats.output import exchange
from sceneloom.redaction import redacted

CLAIM = ".sceneloom-run"
"""Name of the object in a store that says whose outputs lie there."""

FURTHER = ".further"
"""Name of the folder beside a draft in which a verb writes its further outputs, which go to locations of their own."""

OUTCOME = ".outcome"
"""Name of the file beside a draft that says what came of the try."""


class Outputs(Protocol):
    """Where outputs are put."""

    @property
    def name(self) -> str:
        """What people call it, without secrets."""
        ...

    @property
    def location(self) -> str:
        """Its path or address."""
        ...

    @property
    def target(self) -> str:
        """The address that workers send outputs to; "" where the run moves them."""
        ...

    def has(self, name: str) -> bool:
        """Whether an output is there."""
        ...

    def accept(self, task: Task) -> None:
        """Put what a worker made in its location, unless that has sent it there."""
        ...


@dataclass(frozen=True, slots=True)
class FolderOutputs:
    """A folder on disk."""

    folder: Path
    target: str = ""

    @property
    def name(self) -> str:
        """Its path."""
        return str(self.folder)

    @property
    def location(self) -> str:
        """Its path."""
        return str(self.folder)

    def has(self, name: str) -> bool:
        """Whether an output is there."""
        return (self.folder / name).exists()

    def accept(self, task: Task) -> None:
        """Move an output to its location, after what else the verb wrote beside it.

        Raises:
            OSError: it cannot be moved.
        """
        for made in _own_last(task.draft):
            move(made, self.folder / made.name)


@dataclass(frozen=True, slots=True)
class StoreOutputs:
    """A location in a store.

    Attributes:
        target: its address.
        there: names of what was there when the run began.
    """

    target: str = field(repr=False)
    there: frozenset[str]

    @property
    def name(self) -> str:
        """Its address without secrets."""
        return redacted(self.target)

    @property
    def location(self) -> str:
        """Its address."""
        return self.target

    def has(self, name: str) -> bool:
        """Whether an output was there when the run began."""
        return name in self.there

    def accept(self, task: Task) -> None:
        """Nothing is left to do: the worker has sent it."""


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """What says in a store whose outputs lie there.

    Attributes:
        run: name of the run, which its record knows, too.
        record: where that is.
        host: on which machine.
        begun: when.
    """

    run: str
    record: str
    host: str
    begun: str


def claimed(url: str, *, run: str, record: Path) -> StoreOutputs:
    """Claim a location in a store for the run of one record.

    Two runs that begin within the same moment are distinguished where the store refuses to put an object twice, as S3,
    Cloud Storage and Azure do; where it does not, the later one may take the claim while the other one goes on.

    Args:
        url: the location.
        run: name of the run.
        record: where its record is.

    Raises:
        OutputError: the outputs of another run lie there, or the store cannot be written to.
        MissingExtraError: what writes to such addresses is not installed.
    """
    from sceneloom.formats.remote.fetching import names_below
    from sceneloom.formats.remote.uploads import check_remote_output, put_first

    location = f"{url.rstrip('/')}/{CLAIM}"
    check_remote_output(location, overwrite=True)
    begun = datetime.now(UTC).isoformat(timespec="seconds")
    ours = Claim(run=run, record=str(record.absolute()), host=socket.gethostname(), begun=begun)
    there = _claim(put_first(location, msgspec.json.encode(ours)), location)
    if there.run != run:
        raise OutputError(
            f"{redacted(url)}: holds the outputs of a run whose record is {there.record} on {there.host}, begun "
            f"{there.begun}; `--resume --record` goes on with it, or choose another location. If that record is lost, "
            f"remove {CLAIM} there"
        )
    return StoreOutputs(url, frozenset(names_below(url)))


def _claim(content: bytes, location: str) -> Claim:
    try:
        return msgspec.json.decode(content, type=Claim)
    except msgspec.MsgspecError as error:
        raise OutputError(
            f"{redacted(location)}: is not the claim of a run: {error}; choose another location"
        ) from error


def record_folder(url: str) -> Path:
    """Where the record of a run is by default whose outputs lie in a store: in a folder of the user's own state.

    Source: XDG Base Directory Specification 0.8, `XDG_STATE_HOME`.
    """
    state = os.environ.get("XDG_STATE_HOME", "")
    base = Path(state) if Path(state).is_absolute() else Path.home() / ".local" / "state"
    shown = redacted(url).rstrip("/")
    name = shown.rpartition("/")[2]
    reported = "".join(sign if sign.isalnum() or sign in "-_." else "_" for sign in name).lstrip(".")[:60]
    return base / "sceneloom" / "runs" / f"{reported}-{blake2b(shown.encode(), digest_size=4).hexdigest()}"


def send(draft: Path, target: str) -> None:
    """Send an output to a store, after what else the verb wrote beside it; each object appears whole or not at all.

    Raises:
        OutputError: the store cannot be written to.
    """
    from sceneloom.formats.remote.uploads import upload

    for made in _own_last(draft):
        upload(made, f"{target.rstrip('/')}/{made.name}")


def _own_last(draft: Path) -> list[Path]:
    made = [path for path in draft.parent.iterdir() if path.name not in {FURTHER, OUTCOME}]
    return sorted(made, key=lambda path: path == draft)


def move(made: Path, location: Path) -> None:
    """Put something in its location in one step; a folder that is there steps aside first."""
    if location.is_dir() and not location.is_symlink() and made.is_dir() and exchange(made, location):
        return
    if location.is_dir() and not location.is_symlink():
        shutil.rmtree(location) if not made.is_dir() else location.rename(
            made.with_name(f"{made.name}.before")
        )
    made.replace(location)
