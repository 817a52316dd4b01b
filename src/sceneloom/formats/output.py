"""Writing beside the target and renaming: an output is there whole, or not at all."""

import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from sceneloom.errors import OutputError

_WRITE_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG}


def check_output(target: Path, *, overwrite: bool) -> None:
    """Refuse a target that exists or whose folder is missing.

    Raises:
        OutputError: naming what to do instead.
    """
    try:
        there = target.exists()
    except OSError as error:
        raise OutputError(f"{target}: cannot be written: {error.strerror}") from error
    if there and not overwrite:
        raise OutputError(f"{target}: exists already; choose another name or say `--overwrite`")
    if there and not (target.is_file() or target.is_dir()):
        raise OutputError(f"{target}: is neither a file nor a folder and is left alone; choose another name")
    if not target.parent.is_dir():
        if target.parent.exists():
            raise OutputError(f"{target}: {target.parent} is a file; expected a folder")
        raise OutputError(f"{target}: the folder {target.parent} does not exist; make it first")
    if not os.access(target.parent, os.W_OK):
        raise OutputError(f"{target}: the folder {target.parent} is not writable")


@contextmanager
def replacing(target: Path, *, overwrite: bool, folder: bool = False) -> Iterator[Path]:
    """Give a path beside the target to write to; on success it takes the target's place, on failure it goes.

    Args:
        target: where the output shall be in the end.
        overwrite: whether something there may be replaced.
        folder: give an empty folder in place of a file.

    Raises:
        OutputError: the target exists, or cannot be written.
    """
    check_output(target, overwrite=overwrite)
    if target.is_dir() and not folder:
        raise OutputError(f"{target}: is a folder; expected a file or a new name")
    with _workplace(target) as workplace:
        draft = workplace / target.name
        if folder:
            draft.mkdir()
        yield draft
        _check_still_free(target, overwrite=overwrite)
        if folder:
            _replace_folder(draft, target, workplace)
        else:
            draft.replace(target)


def _check_still_free(place: Path, *, overwrite: bool) -> None:
    """Look again before the output takes its place: another program may have been quicker."""
    if not overwrite and place.exists():
        raise OutputError(
            f"{place}: was made by another program meanwhile; choose another name or say `--overwrite`"
        )


@contextmanager
def _workplace(target: Path) -> Iterator[Path]:
    """Give a hidden folder beside the target, and take it away again whatever happens."""
    try:
        workplace = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        raise OutputError(f"{target}: cannot be written: {error.strerror}") from error
    try:
        yield workplace
    except OSError as error:
        if error.errno in _WRITE_FAULTS or str(error.filename or "").startswith(str(workplace)):
            raise OutputError(f"{target}: cannot be written: {error.strerror or error}") from error
        raise
    finally:
        shutil.rmtree(workplace, ignore_errors=True)


def _replace_folder(draft: Path, target: Path, workplace: Path) -> None:
    if target.exists():
        target.rename(workplace / "replaced")
    draft.rename(target)


@contextmanager
def filling(folder: Path, *, overwrite: bool) -> Iterator[Path]:
    """Give an empty folder beside `folder` to write files to; on success they move into it, on failure they go.

    Files that were in the folder before stay, but for those of the same name.

    Raises:
        OutputError: the folder has something in it and `overwrite` is not said, or it cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; expected a folder or a new name")
    check_output(folder, overwrite=overwrite or (folder.is_dir() and not any(folder.iterdir())))
    with _workplace(folder) as workplace:
        yield workplace
        drafts = sorted(path for path in workplace.rglob("*") if path.is_file())
        places = {draft: folder / draft.relative_to(workplace) for draft in drafts}
        for place in places.values():
            _check_still_free(place, overwrite=overwrite)
        for draft, place in places.items():
            place.parent.mkdir(parents=True, exist_ok=True)
            draft.replace(place)


@contextmanager
def on_trial(target: Path, *, overwrite: bool) -> Iterator[tuple[Path, Callable[[], bool]]]:
    """Give a path to write an output to that may still be refused, and what puts it in the target's place.

    The path has the target's name in a folder beside it; what else is written into that folder goes with it. The
    function says false, and does nothing, where the target is a folder: only its format knows whether that may be
    replaced, and has to write to it.

    Raises:
        OutputError: the target exists, or cannot be written.
    """
    check_output(target, overwrite=overwrite)
    with _workplace(target) as workplace:

        def accept() -> bool:
            places = {draft: target.parent / draft.name for draft in sorted(workplace.iterdir())}
            if any(place.is_dir() for place in places.values()):
                return False
            for place in places.values():
                _check_still_free(place, overwrite=overwrite)
            for draft, place in places.items():
                draft.replace(place)
            return True

        yield workplace / target.name, accept
