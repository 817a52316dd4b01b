"""What a `lidar` line may state of the file of its sweep."""

from pathlib import PurePosixPath, PureWindowsPath

LIDAR_MODELS = ("RoboSense M1 XYZIRT",)
"""The layouts of files that the format describes."""


def problem_of_name(name: str) -> str | None:
    """Report what is wrong with a `dataFile`: empty, absolute, leading up, or no file name at all; None for nothing."""
    windows = PureWindowsPath(name)
    leads_out = PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts
    if leads_out or not name.strip() or "\0" in name:
        return f"lidar.dataFile: {name!r}; expected a path inside the recording's folder"
    return None
