"""Any file of points by its suffix or kind: read, written chunk by chunk, or written from one lidar frame."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, finite_rows
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.loss_list import Losses
from sceneloom.formats.base.output import replacing
from sceneloom.formats.points.cloud import (
    Cloud,
    CloudWriter,
    FieldLayout,
    RecordWriter,
    axis_columns,
    color_columns,
    pack_records,
    packed_colors,
)
from sceneloom.formats.points.las import (
    MOST_STEPS,
    LasFile,
    LasWriter,
    colors_16,
    las_dimensions,
    las_offsets,
    read_las,
)
from sceneloom.formats.points.npz import read_bin, read_npz
from sceneloom.formats.points.pcd import PcdLayout, pcd_body, pcd_head, read_pcd
from sceneloom.formats.points.ply import PlyLayout, ply_head, read_ply
from sceneloom.scene.clouds import LidarFrame, grey_where_unseen

_READERS: Mapping[str, Callable[[Path, FieldLayout | None], Cloud]] = MappingProxyType(
    {
        ".pcd": lambda path, _: read_pcd(path),
        ".ply": lambda path, _: read_ply(path),
        ".las": lambda path, _: read_las(path),
        ".laz": lambda path, _: read_las(path),
        ".bin": lambda path, layout: read_bin(path, layout=layout),
        ".npz": lambda path, layout: read_npz(path, layout=layout),
        ".npy": lambda path, layout: read_npz(path, layout=layout),
    }
)

CLOUD_SUFFIXES = tuple(_READERS)
"""Endings of files that hold points."""


def cloud_suffix(path: Path) -> str | None:
    """The ending by which a file is known to hold points, in lower case; None for other files."""
    suffix = path.suffix.lower()
    return suffix if suffix in _READERS else None


def read_cloud(path: Path, *, layout: FieldLayout | None = None) -> Cloud:
    """Read a file of points, column by column.

    Args:
        layout: the columns of files that do not state them (`.bin`, and rows of numbers in `.npz` and `.npy`).

    Raises:
        DataError: the file cannot be read, or its suffix is none of `CLOUD_SUFFIXES`.
    """
    suffix = cloud_suffix(path)
    if suffix is None:
        raise DataError(path, "", f"suffix {path.suffix!r}; expected one of {' '.join(CLOUD_SUFFIXES)}")
    return _READERS[suffix](path, layout)


_WRITERS: Mapping[str, Callable[[Path], CloudWriter]] = MappingProxyType(
    {
        ".las": LasWriter,
        ".laz": LasWriter,
        ".ply": lambda path: RecordWriter(path, PlyLayout()),
        ".pcd": lambda path: RecordWriter(path, PcdLayout()),
    }
)

WRITTEN_SUFFIXES = tuple(_WRITERS)
"""Endings of files that points can be written to."""


def check_cloud_suffix(path: Path) -> None:
    """Refuse a name of a file of points that says no kind of file.

    Raises:
        OptionError: naming those that can be written.
    """
    if path.suffix.lower() not in _WRITERS:
        raise OptionError(f"{path}: suffix {path.suffix!r}; expected one of {' '.join(WRITTEN_SUFFIXES)} for a cloud")


@contextmanager
def open_cloud_writer(path: Path, *, overwrite: bool = False) -> Iterator[CloudWriter]:
    """Give what writes points to a file; it is there, whole, when the block ends without an error.

    Raises:
        OptionError: the suffix is none of `WRITTEN_SUFFIXES`.
        OutputError: the file exists, or cannot be written.
    """
    check_cloud_suffix(path)
    with replacing(path, overwrite=overwrite) as draft:
        writer = _WRITERS[path.suffix.lower()](draft)
        try:
            yield writer
        except BaseException:
            with suppress(Exception):  # the draft goes with its folder; what went wrong first is reported
                writer.close()
            raise
        writer.close()


_OFFSET = "offset_ns"
"""Times of points from the frame's time on [ns]: 32 bits hold two seconds either way."""

_SPACES = re.compile(r"\s+")
_LONGEST_LAS_NAME = 32


@dataclass(frozen=True, slots=True, eq=False)
class FrameColumns:
    """The columns of one frame.

    Attributes:
        positions: (N, 3) float32 [m].
        colors: (N, 3) uint8, or None.
        intensities: (N,) of any dtype, on the scale of `brightest`; or None.
        brightest: the value of full intensity.
        further: (N,) or (N, K) each, by name.
    """

    positions: Float32Array
    colors: AnyArray | None
    intensities: AnyArray | None
    brightest: float
    further: Mapping[str, AnyArray] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def named(self) -> dict[str, AnyArray]:
        """Intensities, if any, and the further columns."""
        return {**({} if self.intensities is None else {"intensity": self.intensities}), **self.further}


def frame_columns(frame: LidarFrame, intensity_max: float | None) -> FrameColumns:
    """Lay out a frame; intensities as its source had them are preferred to those of 0 to 255.

    Args:
        frame: the frame.
        intensity_max: the full intensity in the source, where it is known.
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
        further[_OFFSET] = offsets.astype(np.int32) if small else offsets
    known = {"ring": points.rings, "camera_index": points.camera_index}
    further |= {name: values for name, values in known.items() if values is not None}
    taken = {"x", "y", "z", "red", "green", "blue", "intensity", "rgb", *further}
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


def left_out(frame: LidarFrame, sensor: str, losses: Losses) -> None:
    """Report what of a frame no file of points has a field for."""
    count = len(frame.points)
    for name, values in frame.points.extras.items():
        field = f"sensors[{sensor}].frames.points.extras.{name}"
        if count and not _is_column(values, count):
            losses.dropped(field, "left out: no column of numbers with a row per point")
        elif _SPACES.search(name):
            losses.converted(field, "spaces in its name written as `_`")
    what = "left out: a file of points has no other fields"
    losses.dropped(f"sensors[{sensor}].frames.extras", what, count=len(frame.extras))


def _single_columns(columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Columns, those of several values split into single ones."""
    found: dict[str, AnyArray] = {}
    for name, values in columns.items():
        if values.ndim == 1:
            found[name] = values
        else:
            found.update({f"{name}_{k}": values[:, k] for k in range(values.shape[1])})
    return found


_WHOLE = frozenset({"u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"})
_WIDER: Mapping[str, str] = {"b1": "u1", "f2": "f4", "i8": "f8", "u8": "f8"}


def _fitted(
    columns: Mapping[str, AnyArray], held: frozenset[str], location: str, losses: Losses
) -> dict[str, AnyArray]:
    """Bring columns to the types that a kind of file holds, as "u1" or "f8"; what this changes is reported."""
    found: dict[str, AnyArray] = {}
    for name, values in columns.items():
        kind = values.dtype.str[1:]
        found[name] = values if kind in held else values.astype(_WIDER.get(kind, "f8"))
        if kind in held:
            continue
        error = 0.0
        if values.dtype.kind in "iu" and len(values):
            # what float64 makes of large integers, compared as integers
            inside = np.abs(found[name]) < 2.0**63
            error = float(np.abs(found[name][inside].astype(np.int64) - values[inside].astype(np.int64)).max(initial=0))
        report = losses.approximated if error else losses.converted
        what = f"{values.dtype.name} written as {found[name].dtype.name}"
        report(f"{location}.extras.{name}", what, error=error or None)
    return found


def _finite(columns: FrameColumns, location: str, losses: Losses) -> BoolArray:
    """Which points are finite, (N,) bool: the others are left out, which is reported."""
    finite = finite_rows(columns.positions)
    losses.dropped(f"{location}.positions", "points that are not finite are left out", count=int((~finite).sum()))
    return finite


def _write_pcd(path: Path, columns: FrameColumns, location: str, losses: Losses, *, encoding: str) -> None:
    """Write a PCD file; colours are packed into one float, as PCL's type PointXYZRGB has them."""
    further = _fitted(columns.named, _WHOLE | {"i8", "u8"}, location, losses)
    records = pack_records(
        {**axis_columns(columns.positions), **packed_colors(columns.colors), **further}, len(columns.positions)
    )
    with path.open("xb") as file:
        file.write(pcd_head(records.dtype, str(len(records)), encoding))
        file.write(pcd_body(records, encoding))


def write_ply(path: Path, columns: FrameColumns, location: str, losses: Losses) -> None:
    """Write a binary PLY file."""
    further = _fitted(_single_columns(columns.named), _WHOLE, location, losses)
    records = pack_records(
        {**axis_columns(columns.positions), **color_columns(columns.colors), **further}, len(columns.positions)
    )
    with path.open("xb") as file:
        file.write(ply_head(records.dtype, str(len(records))))
        file.write(records.tobytes())


_STEPS_M = (1e-5, 1e-3)
"""Steps of the positions in LAS files: fine where the points lie within 20 km, else as fine as any lidar measures."""


def _write_las(path: Path, columns: FrameColumns, location: str, losses: Losses) -> None:
    """Write a LAS or LAZ file, by the ending of its name; positions are rounded to steps."""
    finite = _finite(columns, location, losses)
    positions = columns.positions[finite].astype(np.float64)
    distance = np.abs(positions - las_offsets(positions)).max(initial=0.0)
    step = next((step for step in _STEPS_M if distance / step < MOST_STEPS), None)
    if step is None:
        raise OptionError(f"{path.name}: points {distance / 1000:.0f} km apart; LAS holds 2147 km in steps of 1 mm")
    dimensions: dict[str, AnyArray] = {}
    if columns.intensities is not None:
        scaled = columns.intensities.astype(np.float64) * (65535.0 / columns.brightest)
        whole = np.clip(np.rint(np.nan_to_num(scaled)), 0, 65535)
        error = float(np.abs(whole - scaled).max(initial=0.0)) * columns.brightest / 65535.0
        if error > 1e-9 * columns.brightest:
            what = f"intensities of 0 to {columns.brightest:g} rounded to 65536 steps"
            losses.approximated(f"{location}.intensities", what, error=error)
        dimensions["intensity"] = whole.astype(np.uint16)
    # names that are short enough, and not those of LAS's own dimensions
    taken, named = las_dimensions(columns.colors), dict[str, AnyArray]()
    for name, values in _single_columns(columns.further).items():
        short = name.encode("ascii", "replace").decode()[:_LONGEST_LAS_NAME]
        if short in taken or short in named:
            short = f"{short[: _LONGEST_LAS_NAME - 8]}_further"[:_LONGEST_LAS_NAME]
        named[short] = values
    further = _fitted(named, _WHOLE | {"i8", "u8"}, location, losses)
    with LasFile(path, positions, step, further, colored=columns.colors is not None) as file:
        dimensions = {**further, **colors_16(columns.colors), **dimensions}
        error = file.add(positions, {name: values[finite] for name, values in dimensions.items()})
    losses.approximated(f"{location}.positions", f"rounded to steps of {step:g} m", error=error)


def _write_npz(path: Path, columns: FrameColumns, _: str, __: Losses) -> None:
    """Write an NPZ file, one array per column."""
    found: dict[str, Any] = {"positions": columns.positions, **columns.named}
    if columns.colors is not None:
        found["colors"] = columns.colors
    with path.open("xb") as file:
        np.savez(file, **found)


_MODEL_NAMES = {"offset_ns": "timestamps_ns", "ring": "rings", "camera_index": "camera_index"}


def _write_bin(
    path: Path, columns: FrameColumns, location: str, losses: Losses, *, brightest: float, further: tuple[str, ...]
) -> None:
    """Write packed float32: x, y, z, intensity on a scale, then some further columns, 0 where they are missing."""
    count = len(columns.positions)
    found = axis_columns(columns.positions)
    if columns.intensities is None:
        losses.converted(f"{location}.intensities", "there are none; written as 0")
    values = np.zeros(count, np.float32) if columns.intensities is None else columns.intensities
    found["intensity"] = (values * (brightest / columns.brightest)).astype(np.float32)
    for name in further:
        found[name] = columns.further.get(name, np.zeros(count)).astype(np.float32)
    for name in columns.further:
        if name not in further:
            what = f"left out: such files have x y z {' '.join(['intensity', *further])} only"
            losses.dropped(f"{location}.{_MODEL_NAMES.get(name, f'extras.{name}')}", what)
    if columns.colors is not None:
        losses.dropped(f"{location}.colors", "left out: such files have none")
    path.write_bytes(pack_records(found, count)[_finite(columns, location, losses)].tobytes())


FRAME_WRITERS: Mapping[str, Callable[..., None]] = MappingProxyType(
    {
        "pcd": _write_pcd,
        "ply": write_ply,
        "las": _write_las,
        "laz": _write_las,
        "kitti-bin": partial(_write_bin, brightest=1.0, further=()),
        "nuscenes-bin": partial(_write_bin, brightest=255.0, further=("ring",)),
        "npz": _write_npz,
    }
)
"""What writes a frame, by the name of the kind; that of `pcd` takes an encoding."""
