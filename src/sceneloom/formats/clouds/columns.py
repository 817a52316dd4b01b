"""The points of a lidar frame as named columns, and what each kind of file can hold of them."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array
from sceneloom.formats.loss import Loss, Support
from sceneloom.scene.clouds import LidarFrame, grey_where_unseen

OFFSET = "offset_ns"
"""Times of points from the frame's time on [ns]: 32 bits hold two seconds either way."""

_LOCATIONS = ("x", "y", "z")
_COLORS = ("red", "green", "blue")
_SPACES = re.compile(r"\s+")
_LONGEST_LAS_NAME = 32

LossTaker = Callable[[Loss], None]


@dataclass(frozen=True, slots=True, eq=False)
class FrameColumns:
    """The columns of one frame.

    Attributes:
        positions: (N, 3) float32 [m].
        colors: (N, 3) uint8, or None.
        intensities: (N,) of any dtype, on the scale of `brightest`; or None.
        brightest: the value that is the full brightness.
        further: (N,) or (N, K) each, by name.
    """

    positions: Float32Array
    colors: AnyArray | None
    intensities: AnyArray | None
    brightest: float
    further: Mapping[str, AnyArray] = field(default_factory=lambda: MappingProxyType({}))


def frame_columns(frame: LidarFrame, intensity_max: float | None) -> FrameColumns:
    """Lay out a frame; brightness as its source had it is taken before that of 0 to 255.

    Args:
        frame: the frame.
        intensity_max: the full brightness in the source, where it is known.
    """
    points = frame.points
    extras = {name: values for name, values in points.extras.items() if _is_column(values, len(points))}
    intensities, brightest = points.intensities, 255.0
    if intensities is not None and intensity_max and extras.get("intensity", np.zeros((0, 0))).ndim == 1:
        intensities, brightest = extras.pop("intensity"), intensity_max
    further: dict[str, AnyArray] = {}
    if points.timestamps_ns is not None:
        offsets = points.timestamps_ns - frame.timestamp_ns
        small = not len(offsets) or bool(np.abs(offsets).max() < 2**31)
        further[OFFSET] = offsets.astype(np.int32) if small else offsets
    if points.rings is not None:
        further["ring"] = points.rings
    if points.camera_index is not None:
        further["camera_index"] = points.camera_index
    taken = {*_LOCATIONS, *_COLORS, "intensity", "rgb", *further}
    for name, values in extras.items():
        plain = _SPACES.sub("_", name) or "_"
        while plain in taken:
            plain += "_further"
        taken.add(plain)
        further[plain] = values
    colors = None if points.colors is None else grey_where_unseen(points.colors, points.camera_index)
    return FrameColumns(points.positions, colors, intensities, brightest, further)


def _is_column(values: AnyArray, count: int) -> bool:
    return values.ndim in {1, 2} and len(values) == count and values.dtype.kind in "iufb" and values.size > 0


def left_out(frame: LidarFrame, sensor: str, notify: LossTaker) -> None:
    """Report what of a frame no file of points has a location for."""
    count = len(frame.points)
    for name, values in frame.points.extras.items():
        if count and not _is_column(values, count):
            what = "left out: no column of numbers with a row per point"
            notify(Loss(field=f"sensors[{sensor}].frames.points.extras.{name}", what=what))
        elif _SPACES.search(name):
            what = "spaces in its name written as `_`"
            notify(
                Loss(
                    field=f"sensors[{sensor}].frames.points.extras.{name}",
                    what=what,
                    support=Support.CONVERTED,
                )
            )
    if frame.extras:
        what = "left out: a file of points has no further fields"
        notify(Loss(field=f"sensors[{sensor}].frames.extras", what=what, count=len(frame.extras)))


def single_columns(columns: FrameColumns) -> dict[str, AnyArray]:
    """All further columns, those of several numbers cut into single ones."""
    found: dict[str, AnyArray] = {}
    for name, values in columns.further.items():
        if values.ndim == 1:
            found[name] = values
        else:
            found.update({f"{name}_{k}": values[:, k] for k in range(values.shape[1])})
    return found


def fitted(
    columns: Mapping[str, AnyArray], held: frozenset[str], location: str, notify: LossTaker
) -> dict[str, AnyArray]:
    """Bring columns to the types that a kind of file has; what this changes is reported.

    Args:
        columns: by name.
        held: types of the kind, as "u1" or "f8".
        location: of the points, for the losses.
        notify: takes the losses.
    """
    return {name: _fitted(name, values, held, location, notify) for name, values in columns.items()}


_WIDER: Mapping[str, str] = MappingProxyType({"b1": "u1", "f2": "f4", "i8": "f8", "u8": "f8"})


def _fitted(name: str, values: AnyArray, held: frozenset[str], location: str, notify: LossTaker) -> AnyArray:
    kind = values.dtype.str[1:]
    if kind in held:
        return values
    wider = values.astype(_WIDER.get(kind, "f8"))
    error = 0.0
    if values.dtype.kind in "iu" and len(values):
        # what float64 makes of large integers, compared as integers
        inside = np.abs(wider) < 2.0**63
        error = float(np.abs(wider[inside].astype(np.int64) - values[inside].astype(np.int64)).max(initial=0))
    reported = f"{values.dtype.name} written as {wider.dtype.name}"
    support = Support.APPROXIMATED if error else Support.CONVERTED
    notify(
        Loss(
            field=f"{location}.extras.{name}",
            what=reported,
            count=1,
            support=support,
            largest_error=error or None,
        )
    )
    return wider


def las_names(columns: Mapping[str, AnyArray], taken: frozenset[str]) -> dict[str, AnyArray]:
    """Columns under names that are short enough for LAS and not those of its own dimensions."""
    found: dict[str, AnyArray] = {}
    for name, values in columns.items():
        short = name.encode("ascii", "replace").decode()[:_LONGEST_LAS_NAME]
        if short in taken or short in found:
            short = f"{short[: _LONGEST_LAS_NAME - 8]}_further"[:_LONGEST_LAS_NAME]
        found[short] = values
    return found
