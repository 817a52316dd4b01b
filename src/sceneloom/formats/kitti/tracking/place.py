"""Where sequences of KITTI's tracking benchmark are: `training/`, `testing/`, or a folder with their sensors."""

import re
from pathlib import Path

from sceneloom.errors import DataError
from sceneloom.formats.kitti.chosen_sequence import choose_sequence
from sceneloom.formats.ledger import Ledger
from sceneloom.scene.notices import NoticeKind

PICTURE_FOLDERS = {2: "image_02", 3: "image_03"}
"""Folders of the cameras' pictures, by number: a folder for each sequence in them."""

PARTS = ("training", "testing")
_SEQUENCE = re.compile(r"\d{4}")
_FOLDERS = ("velodyne", *PICTURE_FOLDERS.values())
_TEXTS = ("label_02", "oxts", "calib")


def sequences_of(folder: Path) -> tuple[str, ...]:
    """Names of the sequences of which anything is there but a calibration; of those alone, where there is no more."""
    told = {name for kind in (*_FOLDERS, *_TEXTS[:2]) for name in _names(folder / kind)}
    return tuple(sorted(told or _names(folder / "calib")))


def _names(folder: Path) -> set[str]:
    if not folder.is_dir():
        return set()
    wants_folders = folder.name in _FOLDERS
    try:
        return {
            path.stem
            for path in folder.iterdir()
            if _SEQUENCE.fullmatch(path.stem) and (path.is_dir() if wants_folders else path.suffix == ".txt")
        }
    except OSError:
        return set()


def is_sequences(folder: Path) -> bool:
    """Whether a folder has sequences of which more than a calibration is there."""
    return any(_names(folder / kind) for kind in (*_FOLDERS, *_TEXTS[:2]))


def recognises(path: Path) -> bool:
    """Whether a folder holds sequences of the tracking benchmark, with their calibrations."""
    return path.is_dir() and any(is_sequences(folder) and _names(folder / "calib") for folder in places(path))


def near_miss(path: Path) -> str | None:
    """Say what keeps a folder from being one, where it looks like a half one."""
    if not path.is_dir() or recognises(path):
        return None
    for folder in places(path):
        if is_sequences(folder):
            return (
                "sequences of KITTI's tracking benchmark without calibration: expected "
                f"{folder.name}/calib/0000.txt for each"
            )
    return None


def places(path: Path) -> tuple[Path, ...]:
    """The folder itself, then its parts."""
    return path, *(path / part for part in PARTS)


def find_sequence(path: Path, wanted: str | None, ledger: Ledger) -> tuple[Path, str]:
    """Find the folder of the sequences, and the only one of them or the wanted one.

    Raises:
        DataError: there is none.
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    found = [folder for folder in places(path) if is_sequences(folder)]
    if not found:
        expected = "velodyne/0000, image_02/0000, label_02/0000.txt or oxts/0000.txt"
        raise DataError(path, "", f"holds no sequences; expected {expected}")
    if len(found) > 1 and found[0] != path:
        message = f"{found[0].name} is read, {found[1].name} is left aside; name its folder to read it"
        ledger.note(NoticeKind.SKIPPED, "other-part", str(path), message)
    return found[0], choose_sequence(path, sequences_of(found[0]), wanted)


def drives_of(path: Path) -> tuple[str, ...]:
    """Names of the sequences that a path gives to choose from."""
    return next((sequences_of(folder) for folder in places(path) if is_sequences(folder)), ())
