"""A scene that reports neither where nor, on request, when it was."""

from sceneloom.editing.anonymise.clock import clock_from_zero
from sceneloom.editing.anonymise.fields import FieldSweep
from sceneloom.editing.anonymise.locations import positions_from_start
from sceneloom.editing.record import assumed, skipped, with_ours, with_warnings
from sceneloom.errors import OptionError
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning

_ALWAYS = frozenset({"location", "name", "file"})


def anonymised_scene(scene: Scene, *, fixes: str = "drop", dates: str = "keep") -> Scene:
    """Give the scene with positions from where the ego began, and nothing that reports where that was.

    The world's origin is the position of the ego's first pose, its x axis the trajectory it looked; z stays up.
    Satellite receivers go or are put elsewhere. Free fields that report a location, a name or a file are left out, each
    with a warning; of a recording, the lines that were kept word by word.

    Args:
        scene: as it is.
        fixes: "drop" or "shift", see `positions_from_start`.
        dates: "keep", or "shift": times begin with the drive, and fields that report a date go, too.

    Raises:
        OptionError: there is no such choice.
        DataError: a frame with labelled points cannot be read.
    """
    if dates not in DATES:
        raise OptionError(f"dates {dates!r}; expected one of {', '.join(DATES)}")
    moved = positions_from_start(scene, fixes=fixes)
    if dates == "shift":
        moved = clock_from_zero(moved)
    sweep = FieldSweep(_ALWAYS | {"date"} if dates == "shift" else _ALWAYS)
    swept = with_ours(sweep.scene(moved), relative={"fixes": fixes, "dates": dates})
    return with_warnings(swept, _reported(sweep))


DATES = ("keep", "shift")
"""What can become of the time of day."""


def _reported(sweep: FieldSweep) -> list[DataWarning]:
    gone = [
        skipped(f"reports-{one.kind}", one.location, f"a field that reports a {one.kind}: left out")
        for one in sweep.found
    ]
    what = "a field that reports a date: stays; `--dates shift` leaves it out"
    return gone + [assumed("reports-date", one.location, what) for one in sweep.left]
