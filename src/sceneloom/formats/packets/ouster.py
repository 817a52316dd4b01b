"""Packets of Ouster's lidars, of every UDP profile, and of their IMUs, with the sensor's metadata.

Axes: the sensor's own, x to the front of the housing, y left, z up. Rings are rows of beams from the top.

Source: Ouster Firmware User Manual 2.x and 3.x ("Lidar Data Packet Format", "IMU Data Packet Format", "Lidar Range Data
To XYZ Lidar Coordinate Frame"), and the field table of Ouster's SDK.
"""

import lzma
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.errors import DataError
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.wire_formats import varint
from sceneloom.formats.packets.sweeps import Survey
from sceneloom.scene.clouds import LidarPoints
from sceneloom.scene.motion import VectorSamples

_GRAVITY = 9.80665  # m/s² of an IMU's g. Source: ISO 80000-3
_HEADER, _FOOTER, _CRC = 32, 32, 8
_NO_CRC = (0, 0xDEADBEEF_0000C0DE)  # what stands instead of the checksum where firmware has none
_FUSA_HEADER = "FUSA"

_Fields = Mapping[str, tuple[str, int, int, int]]
"""Of a profile: type of a field, its first bit in a pixel, how many it has, and by how much it is shifted left."""


def _plain(**fields: int) -> _Fields:
    """Whole bytes, by the first one of a pixel: two of them where the name is not of a byte."""
    return {
        name: ("u1", 8 * at, 8, 0) if name.startswith(("REFLECTIVITY", "WINDOW")) else ("<u2", 8 * at, 16, 0)
        for name, at in fields.items()
    }


_SHORT: _Fields = {"RANGE": ("<u4", 0, 15, 3), "FLAGS": ("u1", 15, 1, 0), **_plain(REFLECTIVITY=2)}
_SHORT2: _Fields = {"RANGE2": ("<u4", 32, 15, 3), "FLAGS2": ("u1", 47, 1, 0), **_plain(REFLECTIVITY2=6)}
_NIR8: _Fields = {"NEAR_IR": ("<u2", 24, 8, 4)}
_LONG: _Fields = {"RANGE": ("<u4", 0, 19, 0), "FLAGS": ("u1", 19, 5, 0)}
_LONG2: _Fields = {"RANGE2": ("<u4", 32, 19, 0), "FLAGS2": ("u1", 51, 5, 0), **_plain(REFLECTIVITY=3, REFLECTIVITY2=7)}
_LOW_DUAL = {**_SHORT, **_NIR8, **_SHORT2, **_plain(WINDOW=7)}
_SINGLE = {**_LONG, **_plain(REFLECTIVITY=4, SIGNAL=6, NEAR_IR=8)}
_TWICE = {**_LONG, **_LONG2, **_plain(SIGNAL=8, SIGNAL2=10)}

PROFILES: Mapping[str, tuple[int, _Fields]] = MappingProxyType(
    {
        "LEGACY": (
            12,
            {"RANGE": ("<u4", 0, 20, 0), "FLAGS": ("u1", 28, 4, 0), **_plain(REFLECTIVITY=4, SIGNAL=6, NEAR_IR=8)},
        ),
        "RNG15_RFL8_NIR8": (4, {**_SHORT, **_NIR8}),
        "RNG15_RFL8_NIR8_DUAL": (8, _LOW_DUAL),
        "FUSA_RNG15_RFL8_NIR8_DUAL": (8, _LOW_DUAL),
        "RNG15_RFL8_NIR8_ZONE16": (8, {**_SHORT, **_NIR8, **_plain(ZONE_MASK=4, WINDOW=6)}),
        "RNG15_RFL8_WIN8": (4, {**_SHORT, **_plain(WINDOW=3)}),
        "RNG19_RFL8_SIG16_NIR16": (12, {**_SINGLE, **_plain(WINDOW=11)}),
        "RNG19_RFL8_SIG16_NIR16_DUAL": (16, {**_TWICE, **_plain(NEAR_IR=12, WINDOW=15)}),
        "RNG19_RFL8_SIG16_NIR16_ZONE16": (12, {**_SINGLE, **_plain(WINDOW=5, ZONE_MASK=10)}),
        "RNG19_RFL8_SIG16_ZONE16_DUAL": (16, {**_TWICE, **_plain(ZONE_MASK=12, WINDOW=15)}),
        "RNG19_RFL8_SIG16_NIR16_RGB16": (16, {**_LONG, **_plain(REFLECTIVITY=3, SIGNAL=4, NEAR_IR=6, R=8, G=10, B=12)}),
        "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": (20, {**_TWICE, **_plain(NEAR_IR=12, R=14, G=16, B=18)}),
        "FIVE_WORD_PIXEL": (20, {**_TWICE, **_plain(NEAR_IR=12)}),
    }
)
"""Bytes of a pixel and its fields, by the name of the profile."""


@dataclass(frozen=True, slots=True)
class OusterMetadata:
    """What a sensor says of itself.

    Attributes:
        file: where it was read.
        profile, imu_profile: of the UDP packets, keys of `PROFILES`; "LEGACY" or "ACCEL32_GYRO32_NMEA".
        header: kind of the packet header, "STANDARD" or "FUSA".
        columns, columns_per_packet, rows: of a frame.
        altitudes_deg, azimuths_deg: (H,) of the beams.
        beam_offset: (x, z) of the beams' origin in the lidar frame [m].
        sensor_from_lidar: 16 numbers by rows, translation in metres.
        sensor_from_imu: the same.
        model, serial: the product line, and the number of the device; "" where not stated.
        ports: to which lidar and IMU packets are sent; 0 where not stated.
        imu_count: measurements of an IMU packet that has several.
        session: number of the sensor's initialisation, which packets repeat; 0 where not stated.
    """

    file: str
    profile: str
    imu_profile: str
    header: str
    columns: int
    columns_per_packet: int
    rows: int
    altitudes_deg: tuple[float, ...]
    azimuths_deg: tuple[float, ...]
    beam_offset: tuple[float, float]
    sensor_from_lidar: tuple[float, ...]
    sensor_from_imu: tuple[float, ...]
    model: str
    serial: str
    ports: tuple[int, int]
    imu_count: int
    session: int

    @property
    def length(self) -> int:
        """Bytes of a lidar packet."""
        return int(_packet_dtype(self.profile, self.rows, self.columns_per_packet).itemsize)

    @property
    def imu_length(self) -> int:
        """Bytes of an IMU packet."""
        return 48 if self.imu_profile == "LEGACY" else _imu_dtype(self.imu_count).itemsize


_IDENTITY = (1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1)
_LIDAR_FROM_SENSOR_DEFAULT = (-1.0, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1)


def read_metadata(path: Path) -> OusterMetadata:
    """Read the metadata of a sensor, as its HTTP interface or Ouster's tools save it (all versions of the firmware).

    Raises:
        DataError: it is no such file, or names a profile that is not known.
    """
    return parse_metadata(read_json(path, dict[str, Any]), str(path))


def parse_metadata(content: Mapping[str, Any], file: str) -> OusterMetadata:
    """As `read_metadata`, of what JSON holds.

    Raises:
        DataError: a value is missing or wrong.
    """
    # firmware before 2.1 has all values side by side, later ones in groups
    flat: dict[str, Any] = {}
    for group in (content, *(value for value in content.values() if isinstance(value, dict))):
        flat.update({name: value for name, value in group.items() if not isinstance(value, dict)})
    layout = content.get("lidar_data_format") or content.get("data_format") or {}
    imu_layout = content.get("imu_data_format") or {}
    try:
        altitudes = tuple(map(float, flat["beam_altitude_angles"]))
        azimuths = tuple(map(float, flat["beam_azimuth_angles"]))
        mode_columns = int(str(flat.get("lidar_mode", "1024x10")).partition("x")[0])
        profile = str(layout.get("udp_profile_lidar", flat.get("udp_profile_lidar", "LEGACY")))
        beam = flat.get("beam_to_lidar_transform")
        aside = float(beam[3]) if beam else float(flat.get("lidar_origin_to_beam_origin_mm", 12.163))
        above = float(beam[11]) if beam else 0.0
        sensor_from_lidar = _transform(flat.get("lidar_to_sensor_transform") or _LIDAR_FROM_SENSOR_DEFAULT)
        found = OusterMetadata(
            file=file,
            profile=profile,
            imu_profile=str(layout.get("udp_profile_imu") or imu_layout.get("udp_profile_imu") or "LEGACY"),
            header=str(layout.get("header_type", _FUSA_HEADER if profile.startswith("FUSA") else "STANDARD")),
            columns=int(layout.get("columns_per_frame", mode_columns)),
            columns_per_packet=int(layout.get("columns_per_packet", 16)),
            rows=int(layout.get("pixels_per_column", len(altitudes))),
            altitudes_deg=altitudes,
            azimuths_deg=azimuths,
            beam_offset=(aside / 1000, above / 1000),
            sensor_from_lidar=sensor_from_lidar,
            sensor_from_imu=_transform(flat.get("imu_to_sensor_transform") or _IDENTITY),
            model=str(flat.get("prod_line", "")),
            serial=str(flat.get("prod_sn", "")),
            ports=(int(flat.get("udp_port_lidar") or 0), int(flat.get("udp_port_imu") or 0)),
            imu_count=int(
                layout.get("imu_measurements_per_packet") or imu_layout.get("imu_measurements_per_packet") or 1
            ),
            session=int(flat.get("initialization_id") or 0),
        )
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        raise DataError(file, "", f"is no metadata of an Ouster sensor: {error!r}") from error
    if found.profile not in PROFILES:
        raise DataError(file, "udp_profile_lidar", f"{found.profile!r}; expected one of {', '.join(PROFILES)}")
    sound = 0 < found.rows <= 1024 and 0 < found.columns <= 65536 and 0 < found.columns_per_packet <= 1024
    if not sound or not len(altitudes) == len(azimuths) == found.rows or not 0 < found.imu_count <= 1000:
        problem = f"{found.rows} rows with {len(altitudes)} altitude and {len(azimuths)} azimuth angles, "
        raise DataError(file, "", f"{problem}{found.columns} columns by {found.columns_per_packet}")
    numbers = (*altitudes, *azimuths, *found.beam_offset, *sensor_from_lidar, *found.sensor_from_imu)
    if not np.isfinite(numbers).all():
        raise DataError(file, "", "an angle or transform is not finite")
    return found


def _transform(numbers: Any) -> tuple[float, ...]:
    """16 numbers by rows with the translation in mm, as numbers in metres."""
    matrix = np.array(numbers, np.float64).reshape(4, 4)
    matrix[:3, 3] /= 1000
    return tuple(matrix.ravel().tolist())


@lru_cache(maxsize=16)
def _packet_dtype(profile: str, rows: int, columns: int) -> np.dtype[Any]:
    """The layout of a packet: header, columns with their pixels, footer."""
    size, legacy = PROFILES[profile][0], profile == "LEGACY"
    head = 16 if legacy else 12
    words = (("<u4", (rows, size // 4)), head)
    parts = {"TIMESTAMP": ("<u8", 0), "MEASUREMENT_ID": ("<u2", 8), "words": words}
    if legacy:
        more = {"FRAME_ID": ("<u2", 10), "ENCODER_COUNT": ("<u4", 12), "STATUS": ("<u4", head + rows * size)}
        column = _laid_out({**parts, **more}, head + rows * size + 4)
        return _laid_out({"columns": ((column, columns), 0)}, column.itemsize * columns)
    column = _laid_out({**parts, "STATUS": ("<u2", 10)}, head + rows * size)
    length = _HEADER + column.itemsize * columns + _FOOTER
    whole = {"PACKET_TYPE": ("<u2", 0), "FRAME_ID": ("<u2", 2), "FUSA_FRAME_ID": ("<u4", 4), "SESSION": ("<u4", 4)}
    return _laid_out({**whole, "columns": ((column, columns), _HEADER)}, length)


def _laid_out(fields: Mapping[str, tuple[Any, int]], length: int) -> np.dtype[Any]:
    formats, offsets = zip(*fields.values(), strict=True)
    layout: Any = {"names": list(fields), "formats": list(formats), "offsets": list(offsets), "itemsize": length}
    found: np.dtype[Any] = np.dtype(layout)
    return found


@lru_cache(maxsize=4)
def _directions(metadata: OusterMetadata) -> tuple[Float32Array, Float32Array]:
    """Of each column and row, (W * H, 3): direction of the beam, and where it begins [m], in the sensor's frame.

    Source: Firmware User Manual, "Lidar Range Data To XYZ Lidar Coordinate Frame", then `lidar_to_sensor_transform`.
    """
    turned = 2 * np.pi * (1 - np.arange(metadata.columns) / metadata.columns)[:, None]
    azimuths = turned - np.deg2rad(metadata.azimuths_deg)
    altitudes = np.broadcast_to(np.deg2rad(metadata.altitudes_deg), azimuths.shape)
    level = np.cos(altitudes)
    directions = np.stack((np.cos(azimuths) * level, np.sin(azimuths) * level, np.sin(altitudes)), axis=-1)
    aside, above = metadata.beam_offset
    ones = np.ones_like(azimuths)
    origins = np.stack((aside * np.cos(turned) * ones, aside * np.sin(turned) * ones, above * ones), axis=-1)
    origins -= np.hypot(aside, above) * directions
    pose = np.array(metadata.sensor_from_lidar).reshape(4, 4)
    found = directions @ pose[:3, :3].T, origins @ pose[:3, :3].T + pose[:3, 3]
    return found[0].reshape(-1, 3).astype(np.float32), found[1].reshape(-1, 3).astype(np.float32)


@dataclass(frozen=True, eq=False)
class OusterDecoder:
    """Decodes lidar packets of the sensor that the metadata are of."""

    metadata: OusterMetadata

    clock_ns = 0

    @property
    def model(self) -> str:
        """The maker's name for the device."""
        return f"Ouster {self.metadata.model}".strip()

    @cached_property
    def _fields(self) -> _Fields:
        return PROFILES[self.metadata.profile][1]

    def columns(self, packets: UInt8Array) -> AnyArray:
        """The columns of packets, (P, L) uint8, as (P, W) records of TIMESTAMP, MEASUREMENT_ID, STATUS and words."""
        found: AnyArray = self._records(packets)["columns"]
        return found

    def _records(self, packets: UInt8Array) -> AnyArray:
        data = self.metadata
        found: AnyArray = packets.view(_packet_dtype(data.profile, data.rows, data.columns_per_packet))[:, 0]
        return found

    def field(self, packets: UInt8Array, name: str) -> AnyArray:
        """A field of all pixels by its name in `PROFILES`, or `RAW32_WORD1`…, as (P, W, H) of the profile's type."""
        return self._value(self.columns(packets)["words"], name)

    def _value(self, words: AnyArray, name: str) -> AnyArray:
        """A field of pixels, (..., size // 4) uint32."""
        if name.startswith("RAW32_WORD"):
            return np.asarray(words[..., int(name[10:]) - 1])
        word, bit, mask, left = self._bits(name)
        values = (words[..., word] >> np.uint32(bit) & np.uint32(mask)) << np.uint32(left)
        return np.asarray(values.astype(self._fields[name][0], copy=False))

    def _bits(self, name: str) -> tuple[int, int, int, int]:
        """Where a field is in the words of a pixel: which word, its lowest bit, its mask, and how far it goes left."""
        _, bit, bits, left = self._fields[name]
        return bit // 32, bit % 32, (1 << bits) - 1, left

    def frame_numbers(self, packets: UInt8Array) -> Int64Array:
        """The sensor's number of the frame of each column, (P, W) int64."""
        if self.metadata.profile == "LEGACY":
            return np.asarray(self.columns(packets)["FRAME_ID"].astype(np.int64))
        name = "FUSA_FRAME_ID" if self.metadata.header == _FUSA_HEADER else "FRAME_ID"
        numbers = self._records(packets)[name].astype(np.int64)
        return np.repeat(numbers[:, None], self.metadata.columns_per_packet, axis=1)

    def _valid(self, columns: AnyArray) -> BoolArray:
        """Which columns were measured."""
        status = columns["STATUS"]
        valid = status == 0xFFFFFFFF if self.metadata.profile == "LEGACY" else status & 1 == 1
        return np.asarray(valid & (columns["MEASUREMENT_ID"] < self.metadata.columns), np.bool_)

    def survey(self, packets: UInt8Array) -> Survey:
        """Look at packets, (P, L) uint8: not usable are those without columns, or with a wrong checksum."""
        columns = self.columns(packets)
        valid, times_ns = self._valid(columns), columns["TIMESTAMP"].astype(np.int64)
        usable: BoolArray = np.asarray(valid.any(axis=1), np.bool_)
        # columns that were not measured may have no time
        first = np.arange(len(valid)), valid.argmax(axis=1)
        times_ns = np.where(valid, times_ns, times_ns[first][:, None])
        frames = self.frame_numbers(packets)
        frames = np.where(valid, frames, frames[first][:, None])
        if self.metadata.profile != "LEGACY":
            usable &= self._records(packets)["PACKET_TYPE"] & 0xFF == 1
            usable &= crc_holds(packets)
        phases = columns["MEASUREMENT_ID"] / float(self.metadata.columns)
        return Survey(times_ns, phases, usable, frames)

    def points(self, packets: UInt8Array, shifts_ns: Int64Array, blocks: BoolArray) -> LidarPoints:
        """Decode the returns of packets, (P, L) uint8: all first returns, then all second ones of dual profiles."""
        from sceneloom.kernels.packed import pick_bits, place_ranges

        columns, rows = self.columns(packets), self.metadata.rows
        valid = (self._valid(columns) & blocks).ravel()
        beams = (columns["MEASUREMENT_ID"].astype(np.int64) * rows).ravel()
        times_ns = (columns["TIMESTAMP"].astype(np.int64) + shifts_ns[:, None]).ravel()
        words = np.ascontiguousarray(columns["words"])
        words = words.reshape(-1, words.shape[-1])
        names = [name for name in self._fields if not name.startswith(("RANGE", "REFLECTIVITY")) and name[-1] != "2"]
        suffixes = ("", "2") if "RANGE2" in self._fields else ("",)
        most = len(suffixes) * len(words)
        positions, rings = np.empty((most, 3), np.float32), np.empty(most, np.uint16)
        stamps_ns, pixels = np.empty(most, np.int64), np.empty(most, np.int64)
        directions, origins = _directions(self.metadata)
        stops = [0]
        for suffix in suffixes:
            rest = slice(stops[-1], None)
            count = place_ranges(
                words, *self._bits(f"RANGE{suffix}"), valid, beams, times_ns, directions, origins,
                positions[rest], stamps_ns[rest], rings[rest], pixels[rest],
            )  # fmt: skip
            stops.append(stops[-1] + count)
        found: dict[str, AnyArray] = {}
        for name in ("REFLECTIVITY", *names):
            found[name.lower()] = np.empty(stops[-1], self._fields[name][0])
            for suffix, start, stop in zip(suffixes, stops, stops[1:], strict=False):
                bits = self._bits(f"{name}{suffix}" if f"{name}{suffix}" in self._fields else name)
                pick_bits(words, *bits, pixels[start:stop], found[name.lower()][start:stop])
        intensities = found.pop("reflectivity")
        if len(suffixes) > 1:
            found["return_number"] = np.repeat(np.array([1, 2], np.uint8), np.diff(stops))
        return LidarPoints(
            positions[: stops[-1]],
            intensities,
            timestamps_ns=stamps_ns[: stops[-1]],
            rings=rings[: stops[-1]],
            extras=MappingProxyType(found),
        )


def session_of(packets: UInt8Array, metadata: OusterMetadata) -> int:
    """The number of the sensor's start that the first of packets, (P, L) uint8, states; 0 where there is none."""
    if metadata.profile == "LEGACY" or metadata.header == _FUSA_HEADER:
        return 0
    return (
        int(packets.view(_packet_dtype(metadata.profile, metadata.rows, metadata.columns_per_packet))["SESSION"][0, 0])
        & 0xFFFFFF
    )


# The checksum of packets is the one of .xz files (CRC-64 of ECMA-182), which liblzma checks as it unpacks: a packet is
# laid into such a file, as bytes that are not compressed. In Python the same takes a hundred times as long.


@lru_cache(maxsize=16)
def _xz_frame(length: int) -> tuple[bytes, bytes]:
    """What stands before and after the bytes of a packet and their checksum in an `.xz` file.

    Source: The .xz File Format 1.1, and the LZMA2 chunk "uncompressed, dictionary reset".
    """

    def checked(content: bytes) -> bytes:
        return content + zlib.crc32(content).to_bytes(4, "little")

    flags = b"\x00\x04"  # CRC64
    chunk = b"\x01" + (length - 1).to_bytes(2, "big")
    before = b"\xfd7zXZ\x00" + checked(flags) + checked(b"\x02\x00\x21\x01\x00\x00\x00\x00") + chunk
    unpadded = 12 + 3 + length + 1 + 8
    sizes = b"".join(varint(value) for value in (1, unpadded, length))
    index = b"\x00" + sizes
    index = checked(index + bytes(-len(index) % 4))
    tail = (len(index) // 4 - 1).to_bytes(4, "little") + flags
    return before, index + zlib.crc32(tail).to_bytes(4, "little") + tail + b"YZ"


def crc_holds(packets: UInt8Array) -> BoolArray:
    """Whether the checksum in the last 8 bytes of each packet, (P, L) uint8, is right, or it has none."""
    length = packets.shape[1] - _CRC
    before, after = _xz_frame(length)
    padding = b"\0" + bytes(-(3 + length + 1) % 4)
    found = packets[:, length:].copy().view("<u8")[:, 0]
    right = np.isin(found, _NO_CRC)
    for k in np.flatnonzero(~right).tolist():
        packet = packets[k].tobytes()
        try:
            lzma.decompress(b"".join((before, packet[:length], padding, packet[length:], after)), lzma.FORMAT_XZ)
        except lzma.LZMAError:
            continue
        right[k] = True
    return np.asarray(right, np.bool_)


# IMU packets

_LEGACY_IMU = np.dtype([("system", "<u8"), ("acceleration_time", "<u8"), ("gyro_time", "<u8"), ("values", "<f4", 6)])


@lru_cache(maxsize=4)
def _imu_dtype(count: int) -> np.dtype[Any]:
    """The layout of an IMU packet with several measurements, and one NMEA sentence."""
    measured = _laid_out({"time": ("<u8", 0), "status": ("u1", 10), "values": (("<f4", 6), 12)}, 36)
    parts = {"NMEA_TIME": ("<u8", 32), "NMEA": ("S85", 40), "measured": ((measured, count), 132)}
    return _laid_out(parts, 132 + 36 * count + _FOOTER)


def imu_streams(metadata: OusterMetadata, packets: UInt8Array, shift_ns: int) -> dict[str, VectorSamples]:
    """Accelerations [m/s²] and angular velocities [rad/s] of IMU packets, (P, L) uint8, in the sensor's axes."""
    if metadata.imu_profile == "LEGACY":
        records = packets.view(_LEGACY_IMU)[:, 0]
        values = records["values"].astype(np.float64)
        times = records["acceleration_time"], records["gyro_time"]
    else:
        measured = packets.view(_imu_dtype(metadata.imu_count))[:, 0]["measured"].ravel()
        measured = measured[measured["status"] & 1 == 1]
        values, times = measured["values"].astype(np.float64), (measured["time"], measured["time"])
    rotation = np.array(metadata.sensor_from_imu).reshape(4, 4)[:3, :3]
    parts = {"accelerometer": (times[0], values[:, :3] * _GRAVITY), "gyroscope": (times[1], np.deg2rad(values[:, 3:]))}
    found: dict[str, VectorSamples] = {}
    for name, (stamps, vectors) in parts.items():
        stamps_ns, first = np.unique(stamps.astype(np.int64) + shift_ns, return_index=True)
        rotated: Float64Array = vectors[first] @ rotation.T
        finite = np.isfinite(rotated).all(axis=1)
        found[name] = VectorSamples(stamps_ns[finite], rotated[finite])
    return found


def imu_sentences(metadata: OusterMetadata, packets: UInt8Array) -> list[str]:
    """The NMEA sentences of IMU packets that carry any, (P, L) uint8; "" where there is none."""
    if metadata.imu_profile == "LEGACY":
        return []
    texts = packets.view(_imu_dtype(metadata.imu_count))[:, 0]["NMEA"]
    return [text.decode("ascii", "replace").strip() if text.startswith(b"$") else "" for text in texts.tolist()]
