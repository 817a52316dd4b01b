"""What a file of a trajectory holds, and how its reading and writing are reported to go."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sceneloom.arrays import Float64Array
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Loss, Supports
from sceneloom.formats.trajectories.supported_fields import HOLDS, METRES
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.types import NO_FIELDS
from sceneloom.scene.warnings import DataWarning


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryFile:
    """A trajectory with all that its file says.

    Attributes:
        trajectory: the poses, device to world; positions of fixes are east, north and up of `origin_lla`.
        form: name of the form it was read from.
        fixes: what a satellite receiver reported, or None.
        origin_lla: (3,) float64: latitude [deg], longitude [deg], altitude [m] of the world's origin, or None.
        columns: (N, 3) float64 by name, what else a pose bears: "velocities" [m/s], "gyroscope_biases" [rad/s],
            "accelerometer_biases" [m/s²].
        warnings: what was assumed, repaired or left out.
    """

    trajectory: Trajectory
    form: str = "memory"
    fixes: GnssSensor | None = None
    origin_lla: Float64Array | None = None
    columns: Mapping[str, Float64Array] = field(default_factory=lambda: NO_FIELDS)
    warnings: tuple[DataWarning, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """How a file of a trajectory is to be read.

    Attributes:
        name: which one of several, or how one without a name is to be called.
        times: a text file with one time per line, for a form without times.
        rate_hz: poses per second, from time 0 on, for a form without times.
        unit: of the times in a text file; None: seconds, or what the form says.
        origin_lla: (3,) float64: where positions of fixes are seen from; None: from the first one.
    """

    name: str | None = None
    times: Path | None = None
    rate_hz: float | None = None
    unit: str | None = None
    origin_lla: Float64Array | None = None


@dataclass(frozen=True, slots=True)
class TrajectoryForm:
    """One form of files, a row of the table.

    Attributes:
        name: by which it is chosen.
        suffixes: of paths that are written in it where nothing else is stated.
        looks_like: what a person recognises it by.
        recognises: whether the beginning of a file's text looks like it.
        read: gives the content of a file.
        write: puts a content into a new file, and reports what that has no field for. It is given the path to write to
            and, for messages, the one that will be the file's in the end.
        beside: where a second file stands that is written with it, or None.
        supports: what becomes of each field of a scene out of which a trajectory is written.
        fix_supports: the same where it is what a satellite receiver reported.
    """

    name: str
    suffixes: tuple[str, ...]
    looks_like: str
    recognises: Callable[[str], bool]
    read: Callable[[Path, Reading, Ledger], TrajectoryFile]
    write: Callable[[TrajectoryFile, Path, Path], Iterable[Loss]]
    beside: Callable[[Path], Path] | None = None
    supports: Supports = field(default_factory=lambda: HOLDS)
    fix_supports: Supports = field(default_factory=lambda: METRES)
