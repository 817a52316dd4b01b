"""What a report is asked for."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from sceneloom.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportSettings:
    """How a report is made.

    Attributes:
        trajectory: name of the ego trajectory; "lidar" or "gnss" to find it; None for the drive's first, else one that
            is found where that takes no long time.
        heading: "motion" to derive orientations where the trajectory has positions only.
        truth: a trajectory, a scene with cuboids, or KITTI's text that the drive is held against.
        compare: ways to be found and held against the drive's own: "lidar", "gnss".
        losses: a loss report as `sceneloom convert --loss` writes it.
        quick: read no more than a few frames: no validation of frames, no calibration check.
        images: how many the page may hold.
        title: of the page; None for the drive's name.
    """

    trajectory: str | None = None
    heading: str | None = None
    truth: str | Path | None = None
    compare: tuple[str, ...] = ()
    losses: Path | None = None
    quick: bool = False
    images: int = 24
    title: str | None = None

    def __post_init__(self) -> None:
        if self.images < 0:
            raise OptionError(f"images {self.images}; expected 0 or more")
        unknown = [name for name in self.compare if name not in {"lidar", "gnss"}]
        if unknown:
            raise OptionError(f"compare {unknown[0]!r}; expected lidar or gnss")

    @property
    def stated(self) -> dict[str, Any]:
        """Those that are not the usual ones, by name."""
        usual = _USUAL
        return {
            name: getattr(self, name)
            for name in (each.name for each in fields(self))
            if getattr(self, name) != getattr(usual, name)
        }


_USUAL = ReportSettings()
