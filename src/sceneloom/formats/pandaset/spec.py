"""PandaSet: drives as folders of pickled sweeps and cuboids, JPEG images and JSON. Only read."""

import re
from functools import partial
from itertools import islice
from pathlib import Path

from sceneloom.formats.base.spec import FormatSpec, any_drive, drives_in

_FRAME = re.compile(r"\d+\.pkl(\.gz)?")
_MOST_LOOKED_AT = 50


def _is_drive(path: Path) -> bool:
    """Whether a folder holds a drive, be it half a one: pickled sweeps, or pickled cuboids."""
    return any(
        _FRAME.fullmatch(file.name)
        for folder in (path / "lidar", path / "annotations" / "cuboids")
        if folder.is_dir()
        for file in islice(folder.iterdir(), _MOST_LOOKED_AT)
    )


DRIVES_IN = partial(drives_in, is_drive=_is_drive)
"""The drives of a folder."""


def _near_miss(path: Path) -> str | None:
    """Report what a folder lacks that has the cameras of a drive."""
    if path.is_dir() and (path / "camera" / "front_camera" / "poses.json").is_file():
        return "it has camera/front_camera/ as PandaSet has, but no lidar/00.pkl.gz"
    return None


FORMAT = FormatSpec(
    name="pandaset",
    title="PandaSet",
    looks_like="a folder with lidar/00.pkl.gz, lidar/poses.json and camera/",
    suffixes=(".pandaset",),
    sniff=partial(any_drive, is_drive=_is_drive),
    near_miss=_near_miss,
    drives=DRIVES_IN,
    reader="sceneloom.formats.pandaset.reader:open_pandaset",
    read_options=("lenient", "sequence"),
    instead="PandaSet is only read; write a scene file (drive.sfs) or a recording (a folder) instead",
)
