"""Where frames of KITTI's object benchmark are: `training/`, `testing/`, or a folder with their sensors."""

from pathlib import Path

from sceneloom.errors import DataError
from sceneloom.formats.kitti.scenes.numbered import PICTURES, SWEEPS, TEXTS, has_numbered
from sceneloom.formats.ledger import Ledger
from sceneloom.scene.notices import NoticeKind

PICTURE_FOLDERS = {2: "image_2", 3: "image_3"}
"""Folders of the cameras' pictures, by number."""

PARTS = ("training", "testing")


def is_frames(folder: Path) -> bool:
    """Whether a folder has sensors of the object benchmark: files of frames, named by their numbers."""
    has_pictures = any(has_numbered(folder / name, PICTURES) for name in PICTURE_FOLDERS.values())
    has_sweeps = has_numbered(folder / "velodyne", SWEEPS)
    return has_pictures or (has_sweeps and not (folder / "times.txt").is_file()) or _has_labels(folder)


def _has_labels(folder: Path) -> bool:
    return has_numbered(folder / "label_2", TEXTS) and has_numbered(folder / "calib", TEXTS)


def recognises(path: Path) -> bool:
    """Whether a folder holds frames of the object benchmark, with the calibration of each."""
    return path.is_dir() and any(
        is_frames(folder) and has_numbered(folder / "calib", TEXTS) for folder in places(path)
    )


def near_miss(path: Path) -> str | None:
    """Say what keeps a folder from being one, where it looks like a half one."""
    if not path.is_dir() or recognises(path):
        return None
    for folder in places(path):
        if is_frames(folder) and not (folder / "times.txt").is_file():
            return f"frames of KITTI's object benchmark without calibration: {_expected(folder)}"
        if has_numbered(folder / "label_2", TEXTS):
            return f"labels of KITTI's object benchmark without calibration: {_expected(folder)}"
    return None


def _expected(folder: Path) -> str:
    return f"expected {folder.name}/calib/000000.txt for each frame"


def places(path: Path) -> tuple[Path, ...]:
    """The folder itself, then its parts."""
    return path, *(path / part for part in PARTS)


def find_frames(path: Path, ledger: Ledger) -> Path:
    """Find the folder of the frames; of both parts it is `training`, with a notice.

    Raises:
        DataError: there is none.
    """
    found = [folder for folder in places(path) if is_frames(folder)]
    if not found:
        raise DataError(
            path,
            "",
            "holds no frames; expected velodyne/000000.bin, image_2/000000.png or label_2/000000.txt",
        )
    if len(found) > 1 and found[0] != path:
        message = f"{found[0].name} is read, {found[1].name} is left aside; name its folder to read it"
        ledger.note(NoticeKind.SKIPPED, "other-part", str(path), message)
    return found[0]
