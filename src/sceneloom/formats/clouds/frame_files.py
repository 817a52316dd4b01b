"""One frame written to a file of each kind.

Sources: as in the modules that read the kinds; "PCDWriter" of the Point Cloud Library for compressed PCD files, whose
columns stand one after another behind the lengths of what follows and of what it unfolds to.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, UInt8Array, finite_rows
from sceneloom.errors import OptionError
from sceneloom.formats.clouds.columns import FrameColumns, LossTaker, fitted, las_names, single_columns
from sceneloom.formats.loss import Loss, Support

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
    found = {**_locations(columns), **colors, **fitted(further, _WHOLE | {"i8", "u8"}, location, notify)}
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
    from sceneloom.kernels.lzf import fold, longest_fold

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
    further = fitted({**_brightness(columns), **single_columns(columns)}, _WHOLE, location, notify)
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
    further = las_names(single_columns(columns), own)
    found = fitted(further, _WHOLE | {"i8", "u8"}, location, notify)
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
