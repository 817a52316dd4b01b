"""Which column of a file is what: names that files use for x, intensity, ring, time and colour."""

from collections.abc import Mapping
from types import MappingProxyType

from sceneloom.arrays import AnyArray

ALIASES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "x": ("x",),
        "y": ("y",),
        "z": ("z",),
        "intensity": (
            "intensity", "intensities", "i", "reflectivity", "reflectance", "remission", "scalar_intensity",
        ),
        "ring": ("ring", "rings", "laser_id", "laser_number", "channel", "line", "beam", "ring_id"),
        "time": (
            "time", "t", "timestamp", "timestamps", "timestamps_ns", "offset_time", "time_offset", "offset_ns",
            "time_stamp", "point_time",
        ),
        "red": ("red", "r"),
        "green": ("green", "g"),
        "blue": ("blue", "b"),
    }
)  # fmt: skip
"""The roles that a single column can have, and the names by which each is known, the likeliest first."""

ROW_ALIASES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "positions": ("points", "positions", "xyz", "pos", "pts"),
        "colors": ("colors", "colours", "rgb", "color"),
    }
)
"""The roles that rows of three numbers can have."""

PACKED_COLORS = ("rgb", "rgba")
"""Single columns that hold a colour in four bytes: blue, green, red, and one that is not used.

Source: "PointXYZRGB" of the Point Cloud Library.
"""


def find_roles(columns: Mapping[str, AnyArray], named: Mapping[str, str]) -> dict[str, str]:
    """Find the column of each role.

    Args:
        columns: of the file, by its own names.
        named: column by role, where somebody stated it; it may be one that the file does not have.

    Returns:
        Column by role, for the roles that the file has; `packed` stands for a packed colour.
    """
    single = {name.lower(): name for name in reversed([*columns]) if columns[name].ndim == 1}
    rows = {
        name.lower(): name
        for name in reversed([*columns])
        if columns[name].ndim == 2 and columns[name].shape[1] == 3
    }
    roles = {}
    tables = ((ALIASES, single), (ROW_ALIASES, rows), ({"packed": PACKED_COLORS}, single))
    for aliases, known in tables:
        for role, names in aliases.items():
            found = next((known[name] for name in names if name in known), None)
            if found is not None:
                roles[role] = found
    return {**roles, **named}
