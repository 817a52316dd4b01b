"""What was shown, or saved to be shown."""

import msgspec

from sceneloom.scene.warnings import DataWarning


class DriveShown(msgspec.Struct, frozen=True, kw_only=True):
    """One drive in the viewer.

    Attributes:
        source: what was read.
        format: how it was read.
        root: its entity in the viewer; all of it is below.
        origin: what is taken off locations in its world, since the viewer has 32 bits a number [m].
        seconds: how long the drive, or the part shown of it, lasts.
        colours: what gives the points of each lidar their colours.
        logged: how many rows of which kind.
        findings: how many findings of `validate` are in its log, by severity.
        warnings: what was assumed, changed or left out.
    """

    source: str
    format: str
    root: str
    origin: tuple[float, float, float]
    seconds: float
    colours: dict[str, str]
    logged: dict[str, int]
    findings: dict[str, int]
    warnings: tuple[DataWarning, ...]


class ViewReport(msgspec.Struct, frozen=True, kw_only=True):
    """A saved view, or one that was shown.

    Attributes:
        output: the file, or None.
        size_bytes: of the file.
        drives: what was shown.
        seconds: how long it took.
    """

    output: str | None
    size_bytes: int
    drives: tuple[DriveShown, ...]
    seconds: float
