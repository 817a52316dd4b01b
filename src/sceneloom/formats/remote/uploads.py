"""Files and folders put into a store: each object appears whole or not at all, the marker of a folder comes last."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import unquote, urlsplit

from sceneloom.errors import DataError, OutputError, redacted
from sceneloom.formats.remote.stores import SIDE_BY_SIDE, Store, faults, open_store, patiently

MARKER = "_SUCCESS"
"""An empty object that is written into a folder last: while it is missing, the folder is not whole.

Source: what Hadoop and Spark leave in folders that they have written.
"""


@contextmanager
def uploading(url: str, *, overwrite: bool) -> Iterator[Path]:
    """Give a path on this machine to write a file or folder to; what was written there goes to the URL on success.

    Args:
        url: where it shall be in the end.
        overwrite: whether something there may be replaced.

    Raises:
        OutputError: something is there, or the store cannot be written to.
        MissingExtraError: what writes to such addresses is not installed.
    """
    check_remote_output(url, overwrite=overwrite)
    with TemporaryDirectory(prefix="sceneloom-") as workplace:
        draft = Path(workplace) / output_name(url)
        yield draft
        upload(draft, url)


def output_name(url: str) -> str:
    """The last part of an address, as the name of a file or folder.

    Raises:
        OutputError: there is none, or it is the address of a web server.
    """
    parts = urlsplit(url)
    if parts.scheme.lower().split("::")[-1] in {"http", "https"}:
        problem = "is a URL of a web server, which is only read from; name a store, such as s3://, gs://, az://"
        raise OutputError(f"{redacted(url)} {problem}")
    name = Path(unquote(parts.path)).name
    if not name or name in {".", ".."}:
        raise OutputError(f"{redacted(url)}: names no file or folder; expected one, as in s3://bucket/drive.sfs")
    return name


def check_remote_output(url: str, *, overwrite: bool) -> None:
    """Refuse an address that something is at, or that is not written to.

    Raises:
        OutputError: naming what to do instead.
    """
    output_name(url)
    shown = redacted(url)
    with _reported(), faults(url, "", doing="written"):
        there = patiently(lambda: _is_there(open_store(url)))
    if there and not overwrite:
        raise OutputError(f"{shown}: exists already; choose another name, or use `--overwrite`")


def upload(draft: Path, url: str) -> None:
    """Put a file or folder where a URL says; on failure nothing of it is left there.

    Raises:
        OutputError: the store cannot be written to, or the connection stays broken.
    """
    with _reported(), faults(url, "", doing="written"):
        store = open_store(url)
        if draft.is_dir():
            _upload_folder(draft, store)
        elif draft.exists():
            patiently(lambda: store.put(draft))


def put_first(url: str, content: bytes) -> bytes:
    """Put a small file where a URL says unless there is one already; give what is there then.

    Of several who do so at one time, all are given the same where the store refuses to put an object twice.

    Raises:
        OutputError: the store cannot be written to.
    """
    with _reported(), faults(url, "", doing="written"):
        return patiently(lambda: open_store(url).put_first(content))


@contextmanager
def _reported() -> Iterator[None]:
    """Faults of the store that is written to are those of an output."""
    try:
        yield
    except DataError as error:
        found = OutputError(str(error))
        found.passing = error.passing
    else:
        return
    raise found


def _is_there(store: Store) -> bool:
    try:
        store.facts()
    except FileNotFoundError:
        return False
    return True


def _upload_folder(draft: Path, store: Store) -> None:
    """Put all files of a folder, then the marker; what a folder there had before goes, its marker first."""
    root = store.path.rstrip("/")
    before = {facts.path for facts in store.walk()} if _is_there(store) else set()
    marker = store.at(f"{root}/{MARKER}")
    if marker.path in before:
        marker.remove()
    locations = {
        path: store.at(f"{root}/{path.relative_to(draft).as_posix()}")
        for path in sorted(draft.rglob("*"))
        if path.is_file()
    }
    try:
        with ThreadPoolExecutor(SIDE_BY_SIDE) as thread_pool:
            list(thread_pool.map(lambda path: patiently(lambda: locations[path].put(path)), locations))
        for path in before - {location.path for location in locations.values()} - {marker.path}:
            store.at(path).remove()
        patiently(lambda: marker.put(None))
    except BaseException:
        _take_back([location for location in locations.values() if location.path not in before])
        raise


def _take_back(locations: list[Store]) -> None:
    """Remove what was put, as far as the store still answers; without its marker the folder is not whole anyway."""
    for location in locations:
        try:
            location.remove()
        except Exception:  # noqa: BLE001, S112 - the first error is the one to report
            continue
