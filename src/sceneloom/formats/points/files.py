"""Any file of points by its suffix or kind: read, written chunk by chunk, or written from one lidar frame."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, UInt8Array, finite_rows
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.formats.base.output import replacing
from sceneloom.formats.points.cloud import Cloud, CloudWriter, FieldLayout
from sceneloom.formats.points.las import LasWriter, read_las
from sceneloom.formats.points.npz import read_bin, read_npz
from sceneloom.formats.points.pcd import PcdWriter, read_pcd
from sceneloom.formats.points.ply import PlyWriter, read_ply
from sceneloom.scene.clouds import LidarFrame, grey_where_unseen


def _self_described(read: Callable[[Path], Cloud]) -> Callable[[Path, FieldLayout | None], Cloud]:
    return lambda path, _: read(path)


_READERS: Mapping[str, Callable[[Path, FieldLayout | None], Cloud]] = MappingProxyType(
    {
        ".pcd": _self_described(read_pcd),
        ".ply": _self_described(read_ply),
        ".las": _self_described(read_las),
        ".laz": _self_described(read_las),
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
    {".las": LasWriter, ".laz": LasWriter, ".ply": PlyWriter, ".pcd": PcdWriter}
)

WRITTEN_SUFFIXES = tuple(_WRITERS)
"""Endings of files that points can be written to."""


def check_cloud_suffix(path: Path) -> None:
    """Refuse a name of a file of points that says no kind of file.

    Raises:
        OptionError: naming those that can be written.
    """
    if path.suffix.lower() not in _WRITERS:
        raise OptionError(
            f"{path}: suffix {path.suffix!r}; expected one of {' '.join(WRITTEN_SUFFIXES)} for a cloud"
        )


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
        further[_OFFSET] = offsets.astype(np.int32) if small else offsets
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


def _single_columns(columns: FrameColumns) -> dict[str, AnyArray]:
    """All further columns, those of several numbers cut into single ones."""
    found: dict[str, AnyArray] = {}
    for name, values in columns.further.items():
        if values.ndim == 1:
            found[name] = values
        else:
            found.update({f"{name}_{k}": values[:, k] for k in range(values.shape[1])})
    return found


def _columns_fitted(
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


def _las_names(columns: Mapping[str, AnyArray], taken: frozenset[str]) -> dict[str, AnyArray]:
    """Columns under names that are short enough for LAS and not those of its own dimensions."""
    found: dict[str, AnyArray] = {}
    for name, values in columns.items():
        short = name.encode("ascii", "replace").decode()[:_LONGEST_LAS_NAME]
        if short in taken or short in found:
            short = f"{short[: _LONGEST_LAS_NAME - 8]}_further"[:_LONGEST_LAS_NAME]
        found[short] = values
    return found


_WHOLE = frozenset({"u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"})

_PLY_TYPES: Mapping[str, str] = MappingProxyType(
    {
        "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "u4": "uint", "i4": "int",
        "f4": "float", "f8": "double",
    }
)  # fmt: skip

_PCD_LETTERS = {"u": "U", "i": "I", "f": "F"}

_STEPS_M = (1e-5, 1e-3)
"""Steps of the locations in LAS files: fine where the points lie within 20 km, else as fine as any lidar measures."""

_LAS_REACH = 2.0**31 - 1

_FULL_SCALE = 257


def _records(columns: Mapping[str, AnyArray], count: int) -> AnyArray:
    """Lay columns side by side, packed, little-endian."""
    kinds = [(name, f"<{values.dtype.str[1:]}", values.shape[1:]) for name, values in columns.items()]
    records = np.empty(count, kinds)
    for name, values in columns.items():
        records[name] = values
    return records


def _locations(columns: FrameColumns) -> dict[str, AnyArray]:
    return {axis: columns.positions[:, k] for k, axis in enumerate("xyz")}


def _brightness(columns: FrameColumns) -> dict[str, AnyArray]:
    return {} if columns.intensities is None else {"intensity": columns.intensities}


def write_pcd(path: Path, columns: FrameColumns, location: str, notify: LossTaker, *, encoding: str) -> None:
    """Write a PCD file; colours are packed into one float, as PCL's type PointXYZRGB has them."""
    colors = {} if columns.colors is None else {"rgb": _packed(columns.colors)}
    further = {**_brightness(columns), **columns.further}
    found = {
        **_locations(columns),
        **colors,
        **_columns_fitted(further, _WHOLE | {"i8", "u8"}, location, notify),
    }
    records = _records(found, len(columns.positions))
    kinds = [values.dtype for values in found.values()]
    counts = [values.shape[1] if values.ndim == 2 else 1 for values in found.values()]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(found)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(_PCD_LETTERS[kind.kind] for kind in kinds)}",
        f"COUNT {' '.join(map(str, counts))}",
        f"WIDTH {len(records)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(records)}",
        f"DATA {encoding}",
        "",
    ]
    with path.open("xb") as file:
        file.write("\n".join(lines).encode())
        file.write(_PCD_BODIES[encoding](records))


def _packed(colors: AnyArray) -> AnyArray:
    """Colours as the bytes of a float: blue, green, red, and one that is 0."""
    whole = colors.astype(np.uint32)
    return ((whole[:, 0] << 16) | (whole[:, 1] << 8) | whole[:, 2]).view(np.float32)


def _text(records: AnyArray) -> bytes:
    """Numbers with all their digits; packed colours as their float, which is what readers of text expect."""
    names = records.dtype.names or ()
    columns: list[list[str]] = []
    for name in names:
        values = records[name].reshape(len(records), -1)
        columns += [[str(value) for value in values[:, k]] for k in range(values.shape[1])]
    return "".join(" ".join(row) + "\n" for row in zip(*columns, strict=True)).encode()


def _compressed(records: AnyArray) -> bytes:
    from sceneloom.kernels.packed import fold, longest_fold

    plain = b"".join(np.ascontiguousarray(records[name]).tobytes() for name in records.dtype.names or ())
    if not plain:
        return np.zeros(2, "<u4").tobytes()
    packed = np.empty(longest_fold(len(plain)), np.uint8)
    size = fold(np.frombuffer(plain, np.uint8), packed)
    return np.array([size, len(plain)], "<u4").tobytes() + packed[:size].tobytes()


_PCD_BODIES: Mapping[str, Callable[[AnyArray], bytes]] = MappingProxyType(
    {"binary": lambda records: bytes(records.tobytes()), "ascii": _text, "binary_compressed": _compressed}
)


def write_ply(path: Path, columns: FrameColumns, location: str, notify: LossTaker) -> None:
    """Write a binary PLY file."""
    colors: dict[str, AnyArray] = {}
    if columns.colors is not None:
        colors = {name: columns.colors[:, k] for k, name in enumerate(("red", "green", "blue"))}
    further = _columns_fitted({**_brightness(columns), **_single_columns(columns)}, _WHOLE, location, notify)
    found = {**_locations(columns), **colors, **further}
    records = _records(found, len(columns.positions))
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(records)}"]
    lines += [f"property {_PLY_TYPES[values.dtype.str[1:]]} {name}" for name, values in found.items()]
    with path.open("xb") as file:
        file.write("\n".join([*lines, "end_header", ""]).encode())
        file.write(records.tobytes())


def write_las(path: Path, columns: FrameColumns, location: str, notify: LossTaker) -> None:
    """Write a LAS or LAZ file, by the ending of its name; locations are rounded to steps."""
    import laspy

    finite = _finite(columns, location, notify)
    positions = columns.positions[finite].astype(np.float64)
    offsets = np.floor(positions.mean(axis=0)) if len(positions) else np.zeros(3)
    reach = np.abs(positions - offsets).max(initial=0.0)
    step = next((step for step in _STEPS_M if reach / step < _LAS_REACH), None)
    if step is None:
        raise OptionError(
            f"{path.name}: points {reach / 1000:.0f} km apart; LAS holds 2147 km in steps of 1 mm"
        )
    header = laspy.LasHeader(version="1.4", point_format=6 if columns.colors is None else 7)
    header.generating_software, header.scales, header.offsets = "sceneloom", np.full(3, step), offsets
    own = frozenset({*header.point_format.dimension_names, "x", "y", "z"})
    further = _las_names(_single_columns(columns), own)
    found = _columns_fitted(further, _WHOLE | {"i8", "u8"}, location, notify)
    header.add_extra_dims([laspy.ExtraBytesParams(name, values.dtype) for name, values in found.items()])
    record = laspy.ScaleAwarePointRecord.zeros(len(positions), header=header)
    steps = np.rint((positions - offsets) / step)
    for axis, name in enumerate(("X", "Y", "Z")):
        record[name] = steps[:, axis].astype(np.int32)
    for name, values in {**found, **_las_values(columns, location, notify)}.items():
        record[name] = values[finite]
    with laspy.open(str(path), mode="w", header=header) as file:
        file.write_points(record)
    error = float(np.abs(steps * step + offsets - positions).max(initial=0.0))
    reported = f"rounded to steps of {step:g} m"
    notify(
        Loss(field=f"{location}.positions", what=reported, support=Support.APPROXIMATED, largest_error=error)
    )


def _finite(columns: FrameColumns, location: str, notify: LossTaker) -> BoolArray:
    """Which points are finite, (N,) bool: the others are left out, which is reported."""
    finite = finite_rows(columns.positions)
    if not finite.all():
        what = "points that are not finite are left out"
        notify(Loss(field=f"{location}.positions", what=what, count=int((~finite).sum())))
    return finite


def _las_values(columns: FrameColumns, location: str, notify: LossTaker) -> dict[str, AnyArray]:
    """The dimensions that LAS has names for: brightness and colours of 16 bits, 0 to the full scale."""
    found: dict[str, AnyArray] = {}
    if columns.colors is not None:
        found = {
            name: columns.colors[:, k].astype(np.uint16) * _FULL_SCALE
            for k, name in enumerate(("red", "green", "blue"))
        }
    if columns.intensities is not None:
        scaled = columns.intensities.astype(np.float64) * (65535.0 / columns.brightest)
        whole = np.clip(np.rint(np.nan_to_num(scaled)), 0, 65535)
        error = float(np.abs(whole - scaled).max(initial=0.0)) * columns.brightest / 65535.0
        if error > 1e-9 * columns.brightest:
            reported = f"brightness of 0 to {columns.brightest:g} rounded to 65536 steps"
            field = f"{location}.intensities"
            notify(Loss(field=field, what=reported, support=Support.APPROXIMATED, largest_error=error))
        found["intensity"] = whole.astype(np.uint16)
    return found


def write_npz(path: Path, columns: FrameColumns, location: str, notify: LossTaker) -> None:
    """Write an NPZ file, one array per column."""
    del location, notify
    found: dict[str, Any] = {"positions": columns.positions, **_brightness(columns), **columns.further}
    if columns.colors is not None:
        found["colors"] = columns.colors
    with path.open("xb") as file:
        np.savez(file, **found)


def _write_bin(
    path: Path,
    columns: FrameColumns,
    location: str,
    notify: LossTaker,
    *,
    brightest: float,
    further: tuple[str, ...],
) -> None:
    """Write packed float32: x, y, z, brightness on a scale, then some further columns, 0 where they are missing."""
    count = len(columns.positions)
    found: dict[str, UInt8Array | AnyArray] = {**_locations(columns)}
    values = np.zeros(count, np.float32) if columns.intensities is None else columns.intensities
    found["intensity"] = (values * (brightest / columns.brightest)).astype(np.float32)
    for name in further:
        found[name] = columns.further.get(name, np.zeros(count)).astype(np.float32)
    if columns.intensities is None:
        reported = "there are none; written as 0"
        notify(Loss(field=f"{location}.intensities", what=reported, support=Support.CONVERTED))
    for name in columns.further:
        if name not in further:
            reported = f"left out: such files have x y z {' '.join(['intensity', *further])} only"
            notify(Loss(field=f"{location}.{_MODEL_NAMES.get(name, f'extras.{name}')}", what=reported))
    if columns.colors is not None:
        notify(Loss(field=f"{location}.colors", what="left out: such files have none"))
    path.write_bytes(_records(found, count)[_finite(columns, location, notify)].tobytes())


_MODEL_NAMES = {"offset_ns": "timestamps_ns", "ring": "rings", "camera_index": "camera_index"}


def write_kitti_bin(path: Path, columns: FrameColumns, location: str, notify: LossTaker) -> None:
    """Write a file as KITTI has them: brightness from 0 to 1."""
    _write_bin(path, columns, location, notify, brightest=1.0, further=())


def write_nuscenes_bin(path: Path, columns: FrameColumns, location: str, notify: LossTaker) -> None:
    """Write a file as nuScenes has them: brightness from 0 to 255, and the number of the laser."""
    _write_bin(path, columns, location, notify, brightest=255.0, further=("ring",))


FRAME_WRITERS: Mapping[str, Callable[..., None]] = MappingProxyType(
    {
        "pcd": write_pcd,
        "ply": write_ply,
        "las": write_las,
        "laz": write_las,
        "kitti-bin": write_kitti_bin,
        "nuscenes-bin": write_nuscenes_bin,
        "npz": write_npz,
    }
)
"""What writes a frame, by the name of the kind; that of `pcd` takes an encoding."""
