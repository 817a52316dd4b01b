"""Packets of RoboSense's lidars with a spinning head: MSOP packets of returns, DIFOP packets with the angles.

Axes: x forward (azimuth 0), y left, z up. Rings are counted from the lowest laser up.

Source: RS-Helios-16P User Guide ("Main Data Stream Output Protocol", "Device Info Output Protocol", "Vertical Angle",
"Exact Point Time Calculation"), and the constants of the maker's driver, rs_driver 1.5, for all models.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.errors import DataError
from sceneloom.formats.packets.sweeps import Survey, angle_table, located, polar_points, utc_seconds
from sceneloom.scene.clouds import LidarPoints

LENGTH = 1248
"""Bytes of both kinds of packets."""

_MSOP, _DIFOP = b"\x55\xaa\x05", b"\xa5\xff\x00\x5a\x11\x11\x55\x55"
_NEW, _OLD = 0x5A, 0x0A  # the byte after the first three of an MSOP packet
_TIME, _TYPE, _BLOCKS = 20, 30, 42
_RETURN_MODE, _DUAL = 300, 0  # of a DIFOP packet
_ELEVATIONS, _AZIMUTHS, _RS16_ELEVATIONS = 468, 564, 1165  # of a DIFOP packet: 3 bytes for each laser
_RETURN = np.dtype([("distance", ">u2"), ("intensity", "u1")])
_BLOCK = np.dtype([("flag", ">u2"), ("azimuth", ">u2"), ("returns", _RETURN, 32)])
_FLAG = 0xFFEE
_BLIND = 100  # a step between blocks of more than 1 degree is a sector without measurements


@dataclass(frozen=True, slots=True)
class _Model:
    """What models differ by.

    Attributes:
        name: the maker's.
        lasers: how many it has; 16 fire twice in a block, or once with two returns.
        step: of distances [m].
        radius, height: how far from the axis, and above the origin, the lasers begin [m].
        block_us: from one block, or pair of blocks, to the next [µs].
        channel_us: of the 32 values of a block, when they were fired after its first one [µs].
        calendar: whether times are year, month, day, hour, minute, second, ms and µs, not seconds and µs.
    """

    name: str
    lasers: int
    step: float
    radius: float
    height: float
    block_us: float
    channel_us: tuple[float, ...]
    calendar: bool = False


_HELIOS_US = tuple(1.73 * k for k in range(32))
_BPEARL_US = tuple(2.56 * (k % 16) + 1.28 * (k // 16) + 5.2 * (k // 8 % 2) for k in range(32))
_RS16_US = tuple(2.8 * (k % 16) + 55.5 * (k // 16) for k in range(32))
_RS32_US = tuple(2.88 * (k % 16) + 1.44 * (k // 16 + (k % 16 == 15)) for k in range(32))

MODELS: Mapping[str, _Model] = MappingProxyType(
    {
        "helios-16p": _Model("Helios-16P", 16, 0.0025, 0.03498, 0.0, 55.56, _HELIOS_US),
        "helios": _Model("Helios", 32, 0.0025, 0.03498, 0.0, 55.56, _HELIOS_US),
        "bpearl-v4": _Model("Bpearl V4", 32, 0.0025, 0.01619, 0.09571, 55.56, tuple(5.0035 / 3 * k for k in range(32))),
        "bpearl": _Model("Bpearl", 32, 0.005, 0.01473, 0.09427, 55.52, _BPEARL_US, calendar=True),
        "rs-16": _Model("RS-LiDAR-16", 16, 0.005, 0.03825, 0.0, 111.0, _RS16_US, calendar=True),
        "rs-32": _Model("RS-LiDAR-32", 32, 0.005, 0.03997, 0.0, 55.52, _RS32_US, calendar=True),
    }
)
"""The models by the names that `--input-option model=` takes."""

_OLD_MODELS = {1: "rs-16", 2: "rs-32", 3: "bpearl"}  # by the type that the packet states


@dataclass(frozen=True, eq=False)
class RobosenseDecoder:
    """Decodes MSOP packets.

    Attributes:
        key: of the model in `MODELS`.
        angles_deg: (L, 2) float64, elevation and azimuth of each laser.
        dual: whether a DIFOP packet states two returns.
    """

    key: str
    angles_deg: Float64Array
    dual: bool = False

    clock_ns = 0

    @property
    def model(self) -> str:
        """The maker's name for the device."""
        return f"RoboSense {MODELS[self.key].name}"

    def _pairs(self, body: AnyArray) -> BoolArray:
        """Which packets have two returns of a firing, as pairs of blocks of one azimuth."""
        azimuths = body["azimuth"]
        return np.asarray((azimuths[:, ::2] == azimuths[:, 1::2]).all(axis=1), np.bool_)

    def _halves(self, starts_ns: Int64Array) -> bool:
        """Whether blocks hold two returns of 16 lasers: by how far apart packets are, of one by the DIFOP packet."""
        model = MODELS[self.key]
        if model.lasers > 16:
            return False
        if len(starts_ns) < 2:
            return self.dual
        return bool(np.median(np.diff(starts_ns)) < 0.75 * 12_000 * model.block_us)

    def _starts_ns(self, packets: UInt8Array) -> Int64Array:
        """Times of packets, (P,) int64 [ns]."""
        if MODELS[self.key].calendar:
            seconds = utc_seconds(packets[:, _TIME : _TIME + 6])
            milliseconds, rest = (_big_endian(packets[:, _TIME + k : _TIME + k + 2]) for k in (6, 8))
            microseconds = milliseconds * 1000 + rest
        else:
            seconds = _big_endian(packets[:, _TIME : _TIME + 6])
            microseconds = _big_endian(packets[:, _TIME + 6 : _TIME + 10])
        return np.asarray(seconds * 1_000_000_000 + microseconds * 1000)

    def _block_times_ns(self, packets: UInt8Array, pairs: BoolArray) -> tuple[Int64Array, bool]:
        """Times of blocks, (P, 12) int64 [ns], and whether they hold two returns of 16 lasers."""
        starts_ns = self._starts_ns(packets)
        halves = self._halves(starts_ns)
        number = np.where(pairs[:, None], np.arange(12) // 2, np.arange(12)) / (1 + halves)
        shifts_ns = np.rint(number * MODELS[self.key].block_us * 1000).astype(np.int64)
        return np.asarray(starts_ns[:, None] + shifts_ns), halves

    def survey(self, packets: UInt8Array) -> Survey:
        """Look at packets, (P, 1248) uint8."""
        body = _blocks(packets)
        usable = (packets[:, :3] == tuple(_MSOP)).all(axis=1) & (body["flag"] == _FLAG).all(axis=1)
        usable &= (body["azimuth"] <= 36000).all(axis=1)
        if not MODELS[self.key].calendar:
            usable &= (packets[:, _TIME : _TIME + 2] == 0).all(axis=1)
        times_ns, _ = self._block_times_ns(packets, self._pairs(body))
        return Survey(times_ns, body["azimuth"] / 36000.0, np.asarray(usable, np.bool_), states=states(packets))

    def points(self, packets: UInt8Array, shifts_ns: Int64Array, blocks: BoolArray) -> LidarPoints:
        """Decode the returns of packets, (P, 1248) uint8; of two equal returns of a firing one counts."""
        body, model = _blocks(packets), MODELS[self.key]
        raw, intensities = body["returns"]["distance"].astype(np.float32), body["returns"]["intensity"]
        kept = (raw > 0) & blocks[:, :, None]
        pairs = self._pairs(body)
        block_times_ns, halves = self._block_times_ns(packets, pairs)
        second = np.broadcast_to((pairs[:, None] & (np.arange(12) % 2 == 1))[:, :, None], raw.shape)
        if halves:
            second = np.broadcast_to(np.arange(32) >= 16, raw.shape)
            equal = (raw[:, :, 16:] == raw[:, :, :16]) & (intensities[:, :, 16:] == intensities[:, :, :16])
            kept[:, :, 16:] &= ~equal
        else:
            equal = (raw[:, 1:] == raw[:, :-1]) & (intensities[:, 1:] == intensities[:, :-1])
            kept[:, 1:] &= ~(equal & second[:, 1:])
        index, block, channel = located(kept)
        azimuths = body["azimuth"].astype(np.int64)
        laser = channel % model.lasers
        fired_us = np.array(model.channel_us)[np.arange(32) % 16 if halves else np.arange(32)]
        starts, rates = np.deg2rad(azimuths.ravel() / 100.0), np.deg2rad(self._steps(azimuths, pairs).ravel() / 100.0)
        parts = (fired_us * ((1 + halves) / model.block_us)).astype(np.float32)
        before = rates.astype(np.float32).take(block) * parts.take(channel) + starts.astype(np.float32).take(block)
        elevations, offsets = np.deg2rad(self.angles_deg).T.astype(np.float32)
        distances = raw.ravel().take(index) * np.float32(model.step)
        level, height = distances * np.cos(elevations).take(laser), distances * np.sin(elevations).take(laser)
        positions = polar_points(before + offsets.take(laser), level, height)
        positions += polar_points(before, np.float32(model.radius), np.float32(model.height))
        positions[:, 1] *= -1
        times_ns = (block_times_ns + shifts_ns[:, None]).ravel()
        order = np.argsort(np.argsort(self.angles_deg[:, 0], kind="stable"), kind="stable").astype(np.uint16)
        numbers = second.ravel().take(index).astype(np.uint8) + np.uint8(1) if second.any() else None
        return LidarPoints(
            positions,
            intensities.ravel().take(index),
            timestamps_ns=times_ns.take(block) + np.rint(fired_us * 1000).astype(np.int64).take(channel),
            rings=order.take(laser),
            extras=MappingProxyType({} if numbers is None else {"return_number": numbers}),
        )

    def _steps(self, azimuths: Int64Array, pairs: BoolArray) -> Int64Array:
        """How far the lidar turns during each block, (P, 12) int64 [0.01 degree]."""
        after = np.where(pairs[:, None], np.minimum(np.arange(12) // 2 * 2 + 2, 10), np.minimum(np.arange(12) + 1, 11))
        before = np.where(pairs[:, None], after - 2, after - 1)
        rows = np.arange(len(azimuths))[:, None]
        steps = (azimuths[rows, after] - azimuths[rows, before]) % 36000
        usual = np.median(steps, axis=1, keepdims=True).astype(np.int64)
        return np.asarray(np.where(steps > _BLIND, usual, steps))


def _blocks(packets: UInt8Array) -> AnyArray:
    """The blocks of packets, (P, 1248) uint8, as (P, 12) records."""
    stop = _BLOCKS + 12 * _BLOCK.itemsize
    found: AnyArray = np.ascontiguousarray(packets[:, _BLOCKS:stop]).view(_BLOCK)
    return found


def _sees_twice(distances: AnyArray) -> bool:
    """Whether the halves of blocks, distances (P, 12, 32), are of the same lasers.

    DIFOP packets list 32 angles in either case. Lasers that are fired again 0.1 degree on mostly see the same distance;
    of different lasers, which are degrees apart, few do. Without returns they are taken for the same.
    """
    first, again = distances[..., :16].astype(np.float64), distances[..., 16:].astype(np.float64)
    both = (first > 0) & (again > 0)
    same = np.abs(first - again)[both] < 0.05 * first[both]
    return bool(same.mean() > 0.3) if len(same) else True


def _big_endian(digits: UInt8Array) -> Int64Array:
    """Integers of (P, K) uint8, the highest first, as (P,) int64."""
    found = np.zeros(len(digits), np.int64)
    for column in digits.T:
        found = (found << 8) | column
    return found


def states(packets: UInt8Array) -> BoolArray:
    """Which of packets, (P, L) uint8, are DIFOP packets."""
    if packets.shape[1] != LENGTH:
        return np.zeros(len(packets), np.bool_)
    return np.asarray((packets[:, : len(_DIFOP)] == tuple(_DIFOP)).all(axis=1), np.bool_)


def is_state(packet: memoryview) -> bool:
    """Whether a packet is a DIFOP packet."""
    return len(packet) == LENGTH and packet[: len(_DIFOP)] == _DIFOP


def recognise(packets: UInt8Array) -> str | None:
    """The key of the model whose MSOP packets these, (P, L) uint8, are; None where they are none."""
    if packets.shape[1] != LENGTH:
        return None
    returns = packets[(packets[:, :3] == tuple(_MSOP)).all(axis=1)]
    if len(returns) <= 0.5 * len(packets):
        return None
    first = returns[0]
    if first[3] == _NEW:
        return "helios-16p" if _sees_twice(_blocks(returns)["returns"]["distance"]) else "helios"
    if first[3] != _OLD:
        return None
    key = _OLD_MODELS.get(int(first[_TYPE] or first[_TYPE + 1]))
    # the fourth version of the Bpearl states seconds since 1970
    return "bpearl-v4" if key == "bpearl" and not first[_TIME : _TIME + 2].any() and first[_TIME + 2] else key


def decoder_of(key: str, angles: Path | None, state: UInt8Array | None = None) -> RobosenseDecoder:
    """What decodes packets of a model, with a file of angles, or those of a DIFOP packet, (1248,) uint8.

    Raises:
        DataError: there is neither, or the file is none.
    """
    model = MODELS[key]
    helios = key.startswith("helios")
    found = angle_table(angles, *((16, 32) if helios else (model.lasers,))) if angles is not None else None
    if found is None and state is not None:
        found = _rs16_angles(state) if key == "rs-16" else state_angles(state, model.lasers)
    if found is None:
        problem = f"no DIFOP packet of this {model.name} has its angles; expected `--input-option angles=FILE.csv`"
        raise DataError("", "", problem)
    if helios:  # whoever gives a file knows the lidar
        key = "helios" if len(found) == MODELS["helios"].lasers else "helios-16p"
    return RobosenseDecoder(key, found, state is not None and bool(state[_RETURN_MODE] == _DUAL))


def state_angles(packet: UInt8Array, lasers: int) -> Float64Array | None:
    """Elevation and azimuth [deg] of each laser, (L, 2), by a DIFOP packet, (1248,) uint8; None where it has none."""
    found = np.empty((lasers, 2))
    for column, start in enumerate((_ELEVATIONS, _AZIMUTHS)):
        digits = packet[start : start + 3 * lasers].reshape(lasers, 3)
        if (digits[:, 0] > 1).any() or not digits[:, 1:].any():
            return None
        found[:, column] = np.where(digits[:, 0] == 1, -1, 1) * _big_endian(digits[:, 1:]) / 100.0
    return found if (np.abs(found) <= 90).all() else None


def _rs16_angles(packet: UInt8Array) -> Float64Array | None:
    """Those of an RS-LiDAR-16, in 0.0001 degree: the first eight are below the horizon, azimuths are none."""
    values = _big_endian(packet[_RS16_ELEVATIONS : _RS16_ELEVATIONS + 48].reshape(16, 3)) * 1e-4
    if not 0 < values.max() <= 90:
        return None
    return np.stack((np.where(np.arange(16) < 8, -values, values), np.zeros(16)), axis=1)
