"""What of a drive is shown and how, and what was shown or saved."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.errors import OptionError
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.warnings import DataWarning


class ColourBy(StrEnum):
    """What gives the points of a cloud their colours."""

    COLOUR = "colour"
    """Those that cameras gave them."""
    INTENSITY = "intensity"
    """How much light came back."""
    HEIGHT = "height"
    """How far above the sensor they are."""
    RING = "ring"
    """Which laser measured them."""
    TIME = "time"
    """When in the sweep they were measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewSettings:
    """What of a drive is shown, and how.

    Attributes:
        colour_by: what gives points their colours; None: their own ones, else intensity, else height.
        start, stop: seconds after the drive's first timestamp; None for its beginning and end.
        every: show every Nth sweep, image, … of each sensor.
        sensors: ids of the only sensors to show; None for all.
        trajectory: name of the ego trajectory, as of `sceneloom.fuse`; None: the drive's first, or an ego that is
            stationary.
        heading: "motion" to derive orientations where a trajectory has positions only.
        as_measured: leave points where the sensor had them, though it moved during the sweep.
        findings: look for mistakes by the rules of `validate` that need no frames.
        detections: a file that `fuse --type detection` wrote.
        tracks: a file of lines of JSON that `track` wrote.
        depth: a folder of depth images that `fuse --depth` or `depth` wrote.
        map_tiles: let the viewer fetch the map behind fixes from OpenStreetMap.
    """

    colour_by: ColourBy | None = None
    start: float | None = None
    stop: float | None = None
    every: int = 1
    sensors: tuple[Identifier, ...] | None = None
    trajectory: str | None = None
    heading: str | None = None
    as_measured: bool = False
    findings: bool = True
    detections: Path | None = None
    tracks: Path | None = None
    depth: Path | None = None
    map_tiles: bool = False
    reading: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.every < 1:
            raise OptionError(f"every {self.every}; expected 1 or more")

    def check_drives(self, count: int) -> None:
        """Refuse files that belong to one drive where several are shown.

        Raises:
            OptionError: there are such files.
        """
        if count > 1 and any(path is not None for path in (self.detections, self.tracks, self.depth)):
            raise OptionError(f"detections, tracks and depth images belong to one drive; {count} drives are shown")


@dataclass(frozen=True, slots=True)
class DrivePart:
    """A drive of which a part is shown, whatever is stated for the others.

    Attributes:
        source: path of the drive, or a scene that is open.
        start, stop: seconds after its first timestamp; None where `ViewSettings` decides.
        reading: options of opening it, before those of `ViewSettings`.
    """

    source: str | Path | Scene
    start: float | None = None
    stop: float | None = None
    reading: Mapping[str, Any] = field(default_factory=dict)

    def settings(self, common: ViewSettings) -> ViewSettings:
        """What of it is shown, where `common` is stated for all."""
        if self.start is None and self.stop is None:
            return common
        return replace(common, start=self.start, stop=self.stop)

    @property
    def name(self) -> str:
        """That of the file without its suffix, and of what part it is."""
        location = self.source.source if isinstance(self.source, Scene) else str(self.source)
        words = (value if isinstance(value, str) else name for name, value in self.reading.items())
        stem = " ".join([Path(location).resolve().stem or "drive", *words])
        if self.start is None and self.stop is None:
            return stem
        return f"{stem} {self.start or 0.0:g}-{'' if self.stop is None else f'{self.stop:g} s'}"


Source = str | Path | Scene | DrivePart
"""What is shown of a drive: all of it, or a part."""


class DriveShown(msgspec.Struct, frozen=True, kw_only=True):
    """One drive in the viewer.

    Attributes:
        format: how it was read.
        root: its entity in the viewer; all of it is below.
        origin: what is taken off locations in its world, since the viewer has 32 bits a number [m].
        seconds: how long the drive, or the part shown of it, lasts.
        colours: what gives the points of each lidar their colours.
        logged: how many rows of which kind.
        findings: how many findings of `validate` are in its log, by severity.
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
    """

    output: str | None
    size_bytes: int
    drives: tuple[DriveShown, ...]
    seconds: float
