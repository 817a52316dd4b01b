"""Where sequences of KITTI's odometry benchmark are: `sequences/00`, with `poses/00.txt` beside the former."""

import re
from dataclasses import dataclass
from pathlib import Path

from sceneloom.errors import DataError
from sceneloom.formats.kitti.chosen_sequence import choose_sequence
from sceneloom.formats.kitti.scenes.numbered import LABELS, PICTURES, SWEEPS, has_numbered

CAMERAS = {number: f"image_{number}" for number in range(4)}
"""Folders of the cameras' pictures, by number."""

_SEQUENCE = re.compile(r"\d{2}")


@dataclass(frozen=True, slots=True)
class OdometrySequence:
    """One sequence.

    Attributes:
        name: "00".
        folder: of its sensors.
        poses: where its poses would be.
    """

    name: str
    folder: Path
    poses: Path


def is_sequence(folder: Path) -> bool:
    """Whether a folder has sensors of the odometry benchmark, beside the calibration or the times of all."""
    has_text = (folder / "calib.txt").is_file() or (folder / "times.txt").is_file()
    return has_text and (
        any(has_numbered(folder / name, PICTURES) for name in CAMERAS.values())
        or has_numbered(folder / "velodyne", SWEEPS)
        or has_numbered(folder / "labels", LABELS)
    )


def sequences_of(path: Path) -> dict[str, Path]:
    """The sequences of a folder by name: itself, those in it, or those in its `sequences`."""
    if is_sequence(path):
        return {path.resolve().name: path}
    for folder in (path / "sequences", path):
        if folder.is_dir():
            found = {
                child.name: child
                for child in sorted(folder.iterdir())
                if _SEQUENCE.fullmatch(child.name) and is_sequence(child)
            }
            if found:
                return found
    return {}


def recognises(path: Path) -> bool:
    """Whether a folder is a sequence of the odometry benchmark, or has such."""
    try:
        return path.is_dir() and bool(sequences_of(path))
    except OSError:
        return False


def near_miss(path: Path) -> str | None:
    """Say what keeps a folder from being one, where it looks like a half one."""
    if not path.is_dir() or recognises(path):
        return None
    if (path / "sequences").is_dir():
        return (
            "a folder `sequences` as of KITTI's odometry benchmark, but no sequence in it: expected sequences/00 with "
            "calib.txt, times.txt and velodyne or image_0 to image_3"
        )
    return None


def find_sequence(path: Path, wanted: str | None) -> OdometrySequence:
    """Find the only sequence, or the wanted one.

    Raises:
        DataError: there is none.
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    found = sequences_of(path)
    if not found:
        raise DataError(path, "", "holds no sequence; expected sequences/00 with calib.txt and times.txt")
    name = choose_sequence(path, tuple(found), wanted)
    folder = found[name]
    return OdometrySequence(name, folder, folder.resolve().parent.parent / "poses" / f"{name}.txt")
