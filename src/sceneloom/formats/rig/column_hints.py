"""Lines of a manifest to begin with, for columns of points whose names do not report what they are."""

import re
from collections.abc import Mapping

from sceneloom.arrays import AnyArray
from sceneloom.formats.clouds.roles import find_roles

_LIKE_TIMES = re.compile(r"time|timestamp|offset|(^|_)dt($|_)|delta", re.IGNORECASE)
_SPEAKABLE = re.compile(r"[\w.:/ -]+")
"""Names that can stand in a text as they are; others are not worth a hint."""

_UNITS_BY_ENDING = {"ns": "nanoseconds", "us": "microseconds", "ms": "milliseconds"}


def column_hints(columns: Mapping[str, AnyArray]) -> list[str]:
    """Report how the columns that are not known by name can be named: as comments, since each would be a guess.

    Args:
        columns: of the first file, by its own names.
    """
    roles = find_roles(columns, {})
    unknown = [name for name in columns if name not in roles.values() and _SPEAKABLE.fullmatch(name)]
    locations = [] if "positions" in roles else [axis for axis in "xyz" if axis not in roles]
    times = [name for name in unknown if _LIKE_TIMES.search(name)] if "time" not in roles else []
    others = [name for name in unknown if name not in times]
    hints = []
    if locations:
        listed = ", ".join(f'{axis} = "?"' for axis in locations)
        hints.append(f"# use = {{ {listed} }}   # needed: which of {' '.join(unknown)} are these?")
    elif others and "intensity" not in roles:
        hints.append(
            f'# use = {{ intensity = "{others[0]}" }}   # if it is that; not used by name: {" ".join(others)}'
        )
    if times:
        unit = _UNITS_BY_ENDING.get(times[0].rpartition("_")[2].lower(), "seconds")
        hints.append(
            f'# point_times = {{ field = "{times[0]}", unit = "{unit}" }}   # if it is when each was measured'
        )
    return hints
