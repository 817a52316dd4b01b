"""A scene that tells neither where nor, on request, when it was."""

from sceneloom.editing.record import assumed, skipped, with_notices, with_ours
from sceneloom.editing.relative.clock import clock_from_zero
from sceneloom.editing.relative.fields import FieldSweep
from sceneloom.editing.relative.places import places_from_start
from sceneloom.errors import OptionError
from sceneloom.scene.notices import Notice
from sceneloom.scene.scene import Scene

_ALWAYS = frozenset({"place", "name", "file"})


def relative_scene(scene: Scene, *, fixes: str = "drop", dates: str = "keep") -> Scene:
    """Give the scene with positions from where the ego began, and nothing that tells where that was.

    The world's origin is the place of the ego's first pose, its x axis the way it looked; z stays up. Satellite
    receivers go or are put elsewhere. Free fields that tell a place, a name or a file are left out, each with a notice;
    of a recording, the lines that were kept word by word.

    Args:
        scene: as it is.
        fixes: "drop" or "shift", see `places_from_start`.
        dates: "keep", or "shift": times begin with the drive, and fields that tell a date go, too.

    Raises:
        OptionError: there is no such choice.
        DataError: a frame with labelled points cannot be read.
    """
    if dates not in DATES:
        raise OptionError(f"dates {dates!r}; expected one of {', '.join(DATES)}")
    moved = places_from_start(scene, fixes=fixes)
    if dates == "shift":
        moved = clock_from_zero(moved)
    sweep = FieldSweep(_ALWAYS | {"date"} if dates == "shift" else _ALWAYS)
    swept = with_ours(sweep.scene(moved), relative={"fixes": fixes, "dates": dates})
    return with_notices(swept, _told(sweep))


DATES = ("keep", "shift")
"""What can become of the time of day."""


def _told(sweep: FieldSweep) -> list[Notice]:
    gone = [
        skipped(f"tells-{one.kind}", one.place, f"a field that tells a {one.kind}: left out")
        for one in sweep.found
    ]
    what = "a field that tells a date: stays; `--dates shift` leaves it out"
    return gone + [assumed("tells-date", one.place, what) for one in sweep.left]
