"""Where outputs of a run go: a folder on disk or a place in a store, and further outputs beside a verb's own."""

import os
import shutil
import socket
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import blake2b
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import unquote

import msgspec

from sceneloom.batch.jobs import Further, Task, name_of
from sceneloom.errors import OptionError, OutputError, redacted
from sceneloom.formats.base.files import is_url
from sceneloom.formats.base.output import exchange

CLAIM = ".sceneloom-run"
"""Name of the object in a store that says whose outputs lie there."""

_FURTHER = ".further"
"""Name of the folder beside a draft in which a verb writes its further outputs, which go to locations of their own."""

OUTCOME = ".outcome"
"""Name of the file beside a draft that says what came of the try."""


@dataclass(frozen=True, slots=True)
class Outputs:
    """Where outputs are put: a folder on disk, or a location in a store.

    Attributes:
        location: its path or address.
        there: names of what was there when the run began; None for a folder on disk.
    """

    location: str = field(repr=False)
    there: frozenset[str] | None = None

    @property
    def name(self) -> str:
        """Its path, or its address without secrets."""
        return redacted(self.location)

    @property
    def target(self) -> str:
        """The address that workers send outputs to; "" where the run moves them."""
        return "" if self.there is None else self.location

    def has(self, name: str) -> bool:
        """Whether an output is there; in a store, whether it was when the run began."""
        return Path(self.location, name).exists() if self.there is None else name in self.there

    def accept(self, task: Task) -> None:
        """Move an output to its folder, after what else the verb wrote beside it; to a store the worker has sent it.

        Raises:
            OSError: it cannot be moved.
        """
        for made in _own_last(task.draft) if self.there is None else ():
            _move_in_place(made, Path(self.location, made.name))


class _Claim(msgspec.Struct, frozen=True, kw_only=True):
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


def claimed(url: str, *, run: str, record: Path) -> Outputs:
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
    from sceneloom.formats.remote.mirror import names_below
    from sceneloom.formats.remote.uploads import check_remote_output, put_first

    location = f"{url.rstrip('/')}/{CLAIM}"
    check_remote_output(location, overwrite=True)
    begun = datetime.now(UTC).isoformat(timespec="seconds")
    ours = _Claim(run=run, record=str(record.absolute()), host=socket.gethostname(), begun=begun)
    there = _claim(put_first(location, msgspec.json.encode(ours)), location)
    if there.run != run:
        raise OutputError(
            f"{redacted(url)}: holds the outputs of a run whose record is {there.record} on {there.host}, begun "
            f"{there.begun}; `--resume --record` goes on with it, or choose another location. If that record is lost, "
            f"remove {CLAIM} there"
        )
    return Outputs(url, frozenset(names_below(url)))


def _claim(content: bytes, location: str) -> _Claim:
    try:
        return msgspec.json.decode(content, type=_Claim)
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
    made = [path for path in draft.parent.iterdir() if path.name not in {_FURTHER, OUTCOME}]
    return sorted(made, key=lambda path: path == draft)


def _move_in_place(made: Path, location: Path) -> None:
    """Put something in its location in one step; a folder that is there steps aside first."""
    if location.is_dir() and not location.is_symlink():
        if not made.is_dir():
            shutil.rmtree(location)
        elif exchange(made, location):
            return
        else:
            location.rename(made.with_name(f"{made.name}.before"))
    made.replace(location)


def check_further(wanted: Iterable[Further], store: str) -> None:
    """Refuse locations that are not where the outputs go, on disk or in a store, or that cannot be folders.

    Raises:
        OptionError: one is in a store and the outputs are not, or the other way round.
        OutputError: a file lies where a folder is to be.
    """
    for one in wanted:
        if is_url(one.location) != bool(store):
            asked, others = ("on disk", "into a store") if store else ("in a store", "on disk")
            raise OptionError(
                f"--{one.option}: {redacted(one.location)} is {asked}, and outputs go {others}; expected both in one"
            )
        if not store and Path(one.folder).exists() and not Path(one.folder).is_dir():
            raise OutputError(f"{one.folder}: is a file; expected a folder or a new name")


def check_locations(locations: Sequence[str]) -> None:
    """Refuse locations of which two are one.

    Raises:
        OptionError: the same location twice.
    """
    seen: set[str] = set()
    for location in locations:
        known = location if is_url(location) else str(Path(location).absolute())
        if known in seen:
            raise OptionError(
                f"{redacted(location)}: two outputs of one drive would go there; name other locations"
            )
        seen.add(known)


class Locations:
    """What is there already, in folders each of which is looked at once."""

    def __init__(self) -> None:
        self._names: dict[str, frozenset[str]] = {}

    def has(self, location: str) -> bool:
        """Whether there is a file or folder.

        Raises:
            DataError: a store cannot be read.
        """
        if not is_url(location):
            return Path(location).exists()
        folder, _, name = location.rstrip("/").rpartition("/")
        if folder not in self._names:
            from sceneloom.formats.remote.mirror import names_below

            self._names[folder] = frozenset(names_below(folder))
        return unquote(name) in self._names[folder]


def drafts_of(draft: Path, locations: Mapping[str, str]) -> dict[str, Path]:
    """Where a verb writes its further outputs, by option.

    Args:
        draft: of its own output.
        locations: where they belong, by option.
    """
    return {
        option: draft.parent / _FURTHER / option / name_of(location) for option, location in locations.items()
    }


def bring(draft: Path, locations: Mapping[str, str]) -> None:
    """Put what was written into its locations: each appears whole or not at all.

    Raises:
        OSError: it cannot be moved.
        OutputError: a store cannot be written to.
    """
    for option, made in drafts_of(draft, locations).items():
        if not made.exists():
            continue
        if is_url(locations[option]):
            from sceneloom.formats.remote.uploads import upload

            upload(made, locations[option])
        else:
            _move(made, Path(locations[option]))


def _move(made: Path, location: Path) -> None:
    """Move something in one step, onto another disk, too."""
    location.parent.mkdir(parents=True, exist_ok=True)
    if made.stat().st_dev == location.parent.stat().st_dev:
        _move_in_place(made, location)
        return
    with TemporaryDirectory(prefix=f".{location.name}-", dir=location.parent) as workplace:
        copy = Path(workplace, location.name)
        shutil.copytree(made, copy) if made.is_dir() else shutil.copy2(made, copy)
        _move_in_place(copy, location)
