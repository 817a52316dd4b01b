"""Packets of Livox's lidars and of their IMUs, and `.lvx` and `.lvx2` files, which hold such packets.

There are packets of the first SDK (Mid-40, Mid-70, Horizon, Tele-15, Avia) and of the second one (HAP, Mid-360).

Axes: the maker's, x forward, y left, z up. What they scan has no rotation: a sweep is what 0.1 s measure, as their
drivers have it. Rings are lines, where a file names the device.

Source: Livox SDK Communication Protocol ("Point cloud data" of each model; HAP and Mid-360: livox-wiki-en), header
livox_def.h of Livox-SDK, LVX Specifications 1.1 and LVX2 Specifications 1.0.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import FileIdentity, file_faults, open_file
from sceneloom.formats.packets.sweeps import Survey, find_sweeps, located, utc_seconds
from sceneloom.geometry.euler import rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarPoints, LidarSensor
from sceneloom.scene.motion import ImuSensor, VectorSamples
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

MODELS: Mapping[str, str] = MappingProxyType({"livox": "", "livox-2": "HAP or Mid-360"})
"""Generations of packets by the names that `--input-option model=` takes, and which devices send them."""

_FIRST, _SECOND = MODELS
_SWEEP_NS = 100_000_000
_GRAVITY = 9.80665  # m/s² of an IMU's g. Source: ISO 80000-3
_UTC = 3  # type of timestamps of the first SDK: a date and the microseconds of an hour
_LARGEST_STEP_NS = 20_000  # from point to point: the slowest lidar measures 100,000 a second
_STEPS_NS = (10_000, 10_000)  # of data types 0 and 1, which Mid-40 has; others measure 240,000 a second
_USUAL_STEP_NS = 12_500 / 3

_HEADS = MappingProxyType(
    {
        _FIRST: np.dtype(
            [("version", "u1"), ("slot", "u1"), ("id", "u1"), ("reserved", "u1"), ("status", "<u4"),
             ("time_type", "u1"), ("data_type", "u1"), ("time", "<u8")]
        ),
        _SECOND: np.dtype(
            [("version", "u1"), ("length", "<u2"), ("interval", "<u2"), ("count", "<u2"), ("number", "<u2"),
             ("frame", "u1"), ("data_type", "u1"), ("time_type", "u1"), ("reserved", "V12"), ("crc", "<u4"),
             ("time", "<u8")]
        ),
    }
)  # fmt: skip
"""What stands before the points, of 18 and of 36 bytes."""

_XYZ = [("x", "<i4"), ("y", "<i4"), ("z", "<i4"), ("reflectivity", "u1")]
_TAG = [("tag", "u1")]
_ANGLES = [("theta", "<u2"), ("phi", "<u2")]
_DEPTH = [("depth", "<u4")]
_RETURN = [*_DEPTH, ("reflectivity", "u1"), *_TAG]


def _points(fields: list[Any], returns: int = 1, before: tuple[Any, ...] = ()) -> np.dtype[Any]:
    return np.dtype([*before, ("returns", np.dtype(fields), (returns,))])


_LAYOUTS: Mapping[str, Mapping[int, np.dtype[Any]]] = MappingProxyType(
    {
        _FIRST: {
            0: _points(_XYZ),
            1: _points([*_DEPTH, *_ANGLES, ("reflectivity", "u1")]),
            2: _points([*_XYZ, *_TAG]),
            3: _points([*_DEPTH, *_ANGLES, ("reflectivity", "u1"), *_TAG]),
            4: _points([*_XYZ, *_TAG], 2),
            5: _points(_RETURN, 2, tuple(_ANGLES)),
            7: _points([*_XYZ, *_TAG], 3),
            8: _points(_RETURN, 3, tuple(_ANGLES)),
        },
        _SECOND: {
            1: _points([*_XYZ, *_TAG]),
            2: _points([("x", "<i2"), ("y", "<i2"), ("z", "<i2"), ("reflectivity", "u1"), *_TAG]),
            3: _points([*_DEPTH, *_ANGLES, ("reflectivity", "u1"), *_TAG]),
        },
    }
)
"""Layouts of a point, with all returns of it, by data type."""

_COARSE = 2  # data type of the second SDK with steps of 1 cm
_IMU_TYPES = {_FIRST: 6, _SECOND: 0}
_IMU = np.dtype([("gyroscope", "<f4", 3), ("accelerometer", "<f4", 3)])
IMU_LENGTHS: Mapping[int, str] = MappingProxyType({_HEADS[key].itemsize + _IMU.itemsize: key for key in MODELS})
"""Generations by the length of their packets of IMUs [bytes]."""


@dataclass(frozen=True, eq=False)
class LivoxDecoder:
    """Decodes packets of one data type.

    Attributes:
        key: of the generation in `MODELS`.
        data_type: key in the layouts of it.
        device: the maker's name for the device, where it is known.
        lines: how many lasers take turns; 0 where it is not known.
    """

    key: str
    data_type: int
    device: str = ""
    lines: int = 0

    clock_ns = 0

    @property
    def model(self) -> str:
        """The maker's name for the device."""
        return f"Livox {self.device or MODELS[self.key]}".strip()

    def _heads(self, packets: UInt8Array) -> AnyArray:
        head = _HEADS[self.key]
        found: AnyArray = np.ascontiguousarray(packets[:, : head.itemsize]).view(head)[:, 0]
        return found

    def survey(self, packets: UInt8Array) -> Survey:
        """Look at packets, (P, L) uint8, of one block each; the sweep is the tenth of a second that it begins in."""
        heads = self._heads(packets)
        usable = heads["data_type"] == self.data_type
        if self.key == _SECOND:
            size = heads["count"].astype(np.int64) * _LAYOUTS[self.key][self.data_type].itemsize
            usable &= size <= packets.shape[1] - heads.dtype.itemsize
        times_ns = _times_ns(self.key, heads)[:, None]
        usable &= times_ns[:, 0] >= 0
        return Survey(times_ns, np.zeros(times_ns.shape), np.asarray(usable, np.bool_), times_ns // _SWEEP_NS)

    def points(self, packets: UInt8Array, shifts_ns: Int64Array, blocks: BoolArray) -> LidarPoints:
        """Decode the returns of packets, (P, L) uint8: those at the origin are none."""
        heads, layout = self._heads(packets), _LAYOUTS[self.key][self.data_type]
        body = packets[:, heads.dtype.itemsize :]
        count = body.shape[1] // layout.itemsize
        records = np.ascontiguousarray(body[:, : count * layout.itemsize]).view(layout)
        returns = records["returns"]
        kept = np.broadcast_to(blocks[:, :, None], returns.shape).copy()
        if self.key == _SECOND:
            kept &= (np.arange(count) < heads["count"][:, None])[:, :, None]
        spherical = "depth" in (layout["returns"].base.names or ())
        axes = ("depth",) if spherical else ("x", "y", "z")
        kept &= np.any([returns[axis] != 0 for axis in axes], axis=0)
        index, shot, number = located(kept)
        chosen = returns.ravel()[index]
        angles = returns if layout.names == ("returns",) else records[..., None]
        if spherical:
            angles = np.broadcast_to(angles, returns.shape).ravel()[index]
            theta, phi = (np.deg2rad(angles[name] / 100.0) for name in ("theta", "phi"))
            directions = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), axis=1)
            positions = directions * (chosen["depth"] / 1000.0)[:, None]
        else:
            unit = 0.01 if (self.key, self.data_type) == (_SECOND, _COARSE) else 0.001
            positions = np.stack([chosen[axis] * unit for axis in "xyz"], axis=1)
        times_ns = _times_ns(self.key, heads) + shifts_ns
        steps = self._steps_ns(heads, times_ns, count)
        at = np.arange(count)
        offsets = np.rint(steps[:, None] * at).astype(np.int64)
        extras = {"tag": read_only(chosen["tag"].copy())} if "tag" in (chosen.dtype.names or ()) else {}
        if returns.shape[2] > 1:
            extras["return_number"] = (number + 1).astype(np.uint8)
        return LidarPoints(
            positions.astype(np.float32),
            chosen["reflectivity"].copy(),
            timestamps_ns=(times_ns[:, None] + offsets).ravel().take(shot),
            rings=None if self.lines < 2 else (shot % count % self.lines).astype(np.uint16),
            extras=MappingProxyType(extras),
        )

    def _steps_ns(self, heads: AnyArray, times_ns: Int64Array, count: int) -> Float64Array:
        """From point to point of each packet, (P,) float64 [ns]: as stated, else by when packets follow each other."""
        usual = _STEPS_NS[self.data_type] if self.key == _FIRST and self.data_type < 2 else _USUAL_STEP_NS
        if self.key == _SECOND:
            usual = 5000.0
        between = np.diff(times_ns) / max(count, 1)
        between = between[(between > 0) & (between <= _LARGEST_STEP_NS)]
        steps = np.full(len(heads), float(np.median(between)) if len(between) else float(usual))
        if self.key == _SECOND:
            stated = heads["interval"] * 100.0 / np.maximum(heads["count"].astype(np.int64) - 1, 1)
            steps = np.where(stated > 0, stated, steps)
        return steps


def _times_ns(key: str, heads: AnyArray) -> Int64Array:
    """Times of packets, (P,) int64 [ns]; negative where they are none."""
    raw = heads["time"]
    found = np.where(raw < 1 << 62, raw, np.uint64(0)).astype(np.int64)
    found[raw >= 1 << 62] = -1
    if key == _FIRST and (dated := heads["time_type"] == _UTC).any():
        parts = np.ascontiguousarray(raw[dated])[:, None].view(np.uint8)
        dates = np.zeros((len(parts), 6), np.uint8)
        dates[:, :4] = parts[:, :4]
        micros = np.ascontiguousarray(parts[:, 4:]).view("<u4")[:, 0].astype(np.int64)
        seconds = utc_seconds(dates)
        found[dated] = np.where(seconds > 0, seconds * 1_000_000_000 + micros * 1000, -1)
    return found


def _generation(packets: UInt8Array) -> tuple[str, int] | None:
    """Generation and commonest data type of packets of points, (P, L) uint8; None where they are none."""
    length = packets.shape[1]
    for key in (_SECOND, _FIRST):
        head = _HEADS[key]
        if length < head.itemsize + 1:
            continue
        heads = np.ascontiguousarray(packets[:, : head.itemsize]).view(head)[:, 0]
        for data_type, layout in _LAYOUTS[key].items():
            count, rest = divmod(length - head.itemsize, layout.itemsize)
            fits = heads["data_type"] == data_type
            if key == _SECOND:
                fits &= (heads["length"] == length) & (heads["count"] == count) & (heads["time_type"] <= 2)
            else:
                fits &= (heads["version"] == 5) & (heads["time_type"] <= 4) & (count in (30, 48, 96, 100))
            if rest == 0 and fits.mean() > 0.5:
                return key, data_type
    return None


def recognise(packets: UInt8Array) -> str | None:
    """The generation of packets, (P, L) uint8, by its name in `MODELS`; None where they are none of Livox's."""
    found = _generation(packets)
    return None if found is None else found[0]


def decoder_of(key: str, packets: UInt8Array) -> LivoxDecoder:
    """What decodes packets of a generation, of the data type that a sample of them, (P, L) uint8, has."""
    found = _generation(packets)
    return LivoxDecoder(key, min(_LAYOUTS[key]) if found is None or found[0] != key else found[1])


def are_imu(packets: UInt8Array) -> bool:
    """Whether packets, (P, L) uint8, are of an IMU of Livox's."""
    key = IMU_LENGTHS.get(packets.shape[1])
    if key is None:
        return False
    head = _HEADS[key]
    heads = np.ascontiguousarray(packets[:, : head.itemsize]).view(head)[:, 0]
    fits = heads["data_type"] == _IMU_TYPES[key]
    fits &= heads["length"] == packets.shape[1] if key == _SECOND else heads["version"] == 5
    return bool(fits.mean() > 0.5)


def imu_streams(packets: UInt8Array, shift_ns: int) -> dict[str, VectorSamples]:
    """Accelerations [m/s²] and angular velocities [rad/s] of packets of IMUs, (P, L) uint8, in the lidar's axes."""
    key = IMU_LENGTHS[packets.shape[1]]
    head = _HEADS[key]
    heads = np.ascontiguousarray(packets[:, : head.itemsize]).view(head)[:, 0]
    values = np.ascontiguousarray(packets[:, head.itemsize :]).view(_IMU)[:, 0]
    times_ns = _times_ns(key, heads)
    found: dict[str, VectorSamples] = {}
    for name, scale in (("accelerometer", _GRAVITY), ("gyroscope", 1.0)):
        vectors = values[name].astype(np.float64) * scale
        fits = np.isfinite(vectors).all(axis=1) & (times_ns >= 0) & (heads["data_type"] == _IMU_TYPES[key])
        sound = np.flatnonzero(fits)
        stamps_ns, first = np.unique(times_ns[sound] + shift_ns, return_index=True)
        found[name] = VectorSamples(read_only(stamps_ns), read_only(vectors[sound[first]]))
    return found


# Files

MAGIC = b"livox_tech\0\0\0\0\0\0"
"""How `.lvx` and `.lvx2` files begin."""

_CODE = 0xAC0EA767
_FRAME = struct.Struct("<3Q")
_PACKAGES = {1: struct.Struct("<BBBBBIBBQ"), 2: struct.Struct("<BIBBQHBIB4x")}
"""What stands before the data of a package, by the version of the file."""
_DEVICES = {
    1: np.dtype(
        [("serial", "S16"), ("hub", "S16"), ("number", "u1"), ("type", "u1"), ("enabled", "u1"), ("pose", "<f4", 6)]
    ),
    2: np.dtype(
        [("serial", "S16"), ("hub", "S16"), ("number", "<u4"), ("lidar", "u1"), ("type", "u1"), ("enabled", "u1"),
         ("pose", "<f4", 6)]
    ),
}  # fmt: skip
_NAMES = {1: ("Mid-40", 1), 2: ("Tele-15", 6), 3: ("Horizon", 6), 6: ("Mid-70", 1), 7: ("Avia", 6), 9: ("Mid-360", 4),
          10: ("HAP", 6), 15: ("HAP", 6)}  # fmt: skip
"""Names of devices and how many lines they have, by their type. Source: livox_def.h, LVX2 Specifications 1.0."""
_COUNTS = {0: 100, 1: 100, 2: 96, 3: 96, 4: 48, 5: 48, 7: 30, 8: 30}
"""Points of a packet of the first SDK by data type."""
_MOST_DEVICES = 64
_LARGEST_DATA = 1 << 16  # bytes of a package: those of a datagram


@dataclass(slots=True)
class _Packages:
    """The packages of one device and data type: where their data lie, and what stands before them."""

    offsets: list[int] = field(default_factory=list)
    heads: list[tuple[int, ...]] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class _FilePackets:
    """Packages as the packets that they were; what `find_sweeps` reads."""

    file: FileIdentity
    version: int
    size: int  # of the data
    offsets: Int64Array
    heads: Int64Array  # (P, 4): type of timestamp, timestamp, data type, number

    def stated(self, rows: Int64Array | None = None) -> AnyArray:
        """What packets begin with; of these numbers, or of all."""
        key = _FIRST if self.version == 1 else _SECOND
        stated = self.heads if rows is None else self.heads[rows]
        head = np.zeros(len(stated), _HEADS[key])
        head["time_type"], head["time"] = stated[:, 0], np.ascontiguousarray(stated[:, 1]).view(np.uint64)
        head["data_type"] = stated[:, 2]
        if key == _FIRST:
            head["version"] = 5
        elif len(stated):
            layout = _LAYOUTS[key].get(int(stated[0, 2]), _IMU)
            head["length"], head["count"] = head.dtype.itemsize + self.size, self.size // layout.itemsize
        return head

    def payloads(self, rows: Int64Array) -> UInt8Array:
        """The packets with these numbers, (K,) int64, as (K, L) uint8."""
        head = self.stated(rows)
        found = np.empty((len(rows), head.dtype.itemsize + self.size), np.uint8)
        found[:, : head.dtype.itemsize] = head.view(np.uint8).reshape(len(rows), -1)
        with file_faults(self.file.path), open_file(self.file.path) as file:
            self.file.check()
            for row, offset in enumerate(self.offsets[rows].tolist()):
                file.seek(offset)
                content = file.read(self.size)
                if len(content) < self.size:
                    raise DataError(self.file.name, f"byte {offset}", "the file ends within a package")
                found[row, head.dtype.itemsize :] = np.frombuffer(content, np.uint8)
        return found


def open_lvx(path: Path, *, lenient: bool = False) -> Scene:
    """Open a `.lvx` file of version 1.1 or a `.lvx2` file: heads of packages are read, no point is decoded.

    Raises:
        DataError: the file is none, of another version, cut off or damaged; where lenient, what is whole is read.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        with file_faults(path), open_file(path) as file:
            identity = FileIdentity.of(path, descriptor=file.fileno())
            version, devices, start = _read_head(path, file.read(24 + 5 + _MOST_DEVICES * 63))
            packages = _read_packages(path, file, version, start, identity.size, ledger)
        sensors = list(_sensors(identity, version, devices, packages, ledger))
        if not any(isinstance(sensor, LidarSensor) for sensor in sensors):
            raise DataError(path, "", "no packages of points; expected those of a Livox lidar")
    return Scene(tuple(sensors), source=str(path), format="lvx", warnings=ledger.warnings)


def _read_head(path: Path, content: bytes) -> tuple[int, AnyArray, int]:
    """Version, devices, and where frames begin."""
    if len(content) < 29 or not content.startswith(MAGIC) or int.from_bytes(content[20:24], "little") != _CODE:
        raise DataError(path, "byte 0", "expected the header of a .lvx or .lvx2 file")
    version, minor, count = content[16], content[17], content[28]
    if (version, minor) not in ((1, 1), (2, 0)):
        stated = ".".join(map(str, content[16:20]))
        raise DataError(path, "byte 16", f"version {stated}; expected 1.1 (.lvx) or 2.0 (.lvx2)")
    layout = _DEVICES[version]
    if not 0 < count <= _MOST_DEVICES or len(content) < 29 + count * layout.itemsize:
        raise DataError(path, "byte 28", f"{count} devices; expected 1 to {_MOST_DEVICES}, and all of them")
    return version, np.frombuffer(content, layout, count, 29), 29 + count * layout.itemsize


def _read_packages(
    path: Path, file: Any, version: int, start: int, size: int, ledger: Ledger
) -> dict[tuple[int, int, int], _Packages]:
    """The packages of all frames by device, data type and size of their data."""
    found: dict[tuple[int, int, int], _Packages] = {}
    head = _PACKAGES[version]
    at = start
    while at < size:
        file.seek(at)
        content = file.read(_FRAME.size)
        current, following = _FRAME.unpack(content)[:2] if len(content) == _FRAME.size else (-1, 0)
        if current != at or not at + _FRAME.size <= following <= size:
            # recorders leave the last frame without an end
            cut = current == at and following == 0
            if not cut:
                problem = f"a frame from {current} to {following}; expected one from {at}, in {size} bytes"
                ledger.fault("frames-damaged", DataError(path, f"byte {at}", problem))
                return found
            following = size
        for offset, length, device, stated in _frame_packages(file, version, head, at + _FRAME.size, following):
            if length is None:
                problem = f"a package of data type {stated[2]} that is not known or goes beyond its frame"
                ledger.fault("packages-damaged", DataError(path, f"byte {offset}", problem))
                break
            one = found.setdefault((device, stated[2], length), _Packages())
            one.offsets.append(offset)
            one.heads.append(stated)
        at = following
    return found


def _frame_packages(
    file: Any, version: int, head: struct.Struct, at: int, stop: int
) -> Iterator[tuple[int, int | None, int, tuple[int, ...]]]:
    """Where the data of packages lie, how long they are (None where that cannot be), their device, and their heads."""
    while at < stop:
        file.seek(at)
        content = file.read(min(head.size, stop - at))
        if len(content) < head.size:
            yield at, None, 0, (0, 0, -1, 0)
            return
        length: int | None
        if version == 1:
            device, _, _, _, _, _, time_type, data_type, time = head.unpack(content)
            number = 0
            layout = _LAYOUTS[_FIRST].get(data_type)
            length = None if layout is None else layout.itemsize * _COUNTS[data_type]
            length = _IMU.itemsize if data_type == _IMU_TYPES[_FIRST] else length
        else:
            _, device, _, time_type, time, number, data_type, length, _ = head.unpack(content)
            known = data_type in _LAYOUTS[_SECOND] or data_type == _IMU_TYPES[_SECOND]
            length = length if known and 0 < length <= _LARGEST_DATA else None
        stated = (time_type, time - (time >> 63 << 64), data_type, number)
        if length is None or at + head.size + length > stop:
            yield at, None, device, stated
            return
        yield at + head.size, length, device, stated
        at += head.size + length


def _sensors(
    file: FileIdentity,
    version: int,
    devices: AnyArray,
    packages: Mapping[tuple[int, int, int], _Packages],
    ledger: Ledger,
) -> Iterator[Sensor]:
    """The lidars of a file, each with its IMU."""
    key = _FIRST if version == 1 else _SECOND
    sources = {
        one: _FilePackets(
            file, version, one[2], np.array(rows.offsets, np.int64), np.array(rows.heads, np.int64).reshape(-1, 4)
        )
        for one, rows in packages.items()
    }
    numbers = list(dict.fromkeys(device for device, _, _ in sources))
    for place, device in enumerate(numbers, 1):
        mark = "" if len(numbers) == 1 else f"_{place}"
        row = next((one for one in devices if int(one["number"]) == device), None)
        name, lines = ("", 0) if row is None else _NAMES.get(int(row["type"]), ("", 0))
        serial = "" if row is None else row["serial"].decode("ascii", "replace")
        own = {one: source for one, source in sources.items() if one[0] == device}
        where = f"{file.name}: device {device}"
        points = [one for one in own if one[1] != _IMU_TYPES[key]]
        for number, one in enumerate(points, 1):
            source = own[one]
            rows = np.arange(len(source.offsets))
            decoder = LivoxDecoder(key, one[1], name, lines)
            sweeps = find_sweeps(source, rows, _times_ns(key, source.stated()), decoder, where, ledger)
            if sweeps is None:
                continue
            if not source.heads[:, 0].any():
                message = "its clock is not synchronised: times count from when the lidar was switched on"
                ledger.note(WarningKind.ASSUMED, "clock-of-lidar", where, message)
            identifier = f"lidar{mark}" if number == 1 else f"lidar{mark}~{number}"
            mount = RigidTransform.identity() if row is None or not row["enabled"] else _mount(row["pose"])
            if row is None or not row["enabled"]:
                message = "where the lidar sits on the ego is not known; it is put at its origin"
                ledger.note(WarningKind.ASSUMED, "extrinsics-unknown", where, message)
            extras = MappingProxyType({"serial": serial} if serial else {})
            yield LidarSensor(identifier, sweeps.frames, mount=mount, model=decoder.model, extras=extras)
        for one, source in own.items():
            if one[1] == _IMU_TYPES[key] and one[2] == _IMU.itemsize:
                streams = imu_streams(source.payloads(np.arange(len(source.offsets))), 0)
                yield ImuSensor(f"imu{mark}", MappingProxyType(streams))


def _mount(pose: AnyArray) -> RigidTransform:
    """Where a device is: roll, pitch, yaw [deg] about fixed axes, then x, y, z [m]."""
    with np.errstate(invalid="ignore"):  # NaN of any bits
        numbers = pose.astype(np.float64)
    if not np.isfinite(numbers).all():
        return RigidTransform.identity()
    return RigidTransform(rotation_from_cuboid_angles(numbers[:3], order="zyx"), numbers[3:])
