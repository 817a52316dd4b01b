"""Packets of RoboSense's Helios-16P: MSOP packets of returns, DIFOP packets with the angles.

Axes: x forward (azimuth 0), y left, z up. Rings are counted from the lowest laser up.

Source: RS-Helios-16P User Guide ("Main Data Stream Output Protocol", "Device Info Output Protocol", "Vertical Angle",
"Exact Point Time Calculation"), and the constants of the maker's driver.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.errors import DataError
from sceneloom.formats.packets.sweeps import Survey, angle_table, located, polar_points
from sceneloom.scene.clouds import LidarPoints

LENGTH = 1248
"""Bytes of both kinds of packets."""

_MSOP, _DIFOP = b"\x55\xaa\x05\x5a", b"\xa5\xff\x00\x5a\x11\x11\x55\x55"
_SECONDS, _MICROSECONDS, _BLOCKS = 20, 26, 42
_ELEVATIONS, _AZIMUTHS = 468, 564  # of a DIFOP packet: 3 bytes for each laser, a sign and 0.01 degree
_RETURN = np.dtype([("distance", ">u2"), ("intensity", "u1")])
_BLOCK = np.dtype([("flag", ">u2"), ("azimuth", ">u2"), ("returns", _RETURN, 32)])
_FLAG = 0xFFEE
_LASERS = 16
_STEP = 0.0025  # of distances [m]
_RADIUS = 0.03498  # how far from the axis the lasers begin [m]
_BLOCK_US, _CHANNEL_US = 55.56, 1.73
_BLIND = 100  # a step between blocks of more than 1 degree is a sector without measurements

MODELS: Mapping[str, str] = MappingProxyType({"helios-16p": "Helios-16P"})
"""The models by the names that `--input-option model=` takes."""


@dataclass(frozen=True, eq=False)
class RobosenseDecoder:
    """Decodes MSOP packets.

    Attributes:
        angles_deg: (16, 2) float64, elevation and azimuth of each laser.
    """

    angles_deg: Float64Array

    clock_ns = 0
    model = "RoboSense Helios-16P"

    def _body(self, packets: UInt8Array) -> AnyArray:
        """The blocks of packets, (P, 1248) uint8, as (P, 12) records."""
        stop = _BLOCKS + 12 * _BLOCK.itemsize
        found: AnyArray = np.ascontiguousarray(packets[:, _BLOCKS:stop]).view(_BLOCK)
        return found

    def _pairs(self, body: AnyArray) -> BoolArray:
        """Which packets have two returns of a firing, as pairs of blocks of one azimuth."""
        azimuths = body["azimuth"]
        return np.asarray((azimuths[:, ::2] == azimuths[:, 1::2]).all(axis=1), np.bool_)

    def _block_times_ns(self, packets: UInt8Array, pairs: BoolArray) -> Int64Array:
        """Times of blocks, (P, 12) int64 [ns]."""
        seconds = _big_endian(packets[:, _SECONDS:_MICROSECONDS])
        microseconds = _big_endian(packets[:, _MICROSECONDS : _MICROSECONDS + 4])
        number = np.where(pairs[:, None], np.arange(12) // 2, np.arange(12))
        offsets = np.rint(number * _BLOCK_US * 1000).astype(np.int64)
        return np.asarray((seconds * 1_000_000_000 + microseconds * 1000)[:, None] + offsets)

    def survey(self, packets: UInt8Array) -> Survey:
        """Look at packets, (P, 1248) uint8."""
        body = self._body(packets)
        usable = (packets[:, :4] == tuple(_MSOP)).all(axis=1) & (body["flag"] == _FLAG).all(axis=1)
        usable &= (body["azimuth"] <= 36000).all(axis=1) & (packets[:, _SECONDS : _SECONDS + 2] == 0).all(axis=1)
        times_ns = self._block_times_ns(packets, self._pairs(body))
        return Survey(times_ns, body["azimuth"] / 36000.0, np.asarray(usable, np.bool_))

    def points(self, packets: UInt8Array, shifts_ns: Int64Array, blocks: BoolArray) -> LidarPoints:
        """Decode the returns of packets, (P, 1248) uint8; of two equal returns of a firing one counts."""
        body = self._body(packets)
        pairs = self._pairs(body)
        raw, intensities = body["returns"]["distance"].astype(np.float32), body["returns"]["intensity"]
        second = pairs[:, None] & (np.arange(12) % 2 == 1)
        kept = (raw > 0) & blocks[:, :, None]
        equal = (raw[:, 1:] == raw[:, :-1]) & (intensities[:, 1:] == intensities[:, :-1])
        kept[:, 1:] &= ~(equal & second[:, 1:, None])
        index, block, channel = located(kept)
        azimuths = body["azimuth"].astype(np.int64)
        laser = channel % _LASERS
        starts, rates = np.deg2rad(azimuths.ravel() / 100.0), np.deg2rad(self._steps(azimuths, pairs).ravel() / 100.0)
        parts = (np.arange(32) * (_CHANNEL_US / _BLOCK_US)).astype(np.float32)
        before = rates.astype(np.float32).take(block) * parts.take(channel) + starts.astype(np.float32).take(block)
        elevations, offsets = np.deg2rad(self.angles_deg).T.astype(np.float32)
        distances = raw.ravel().take(index) * np.float32(_STEP)
        level, height = distances * np.cos(elevations).take(laser), distances * np.sin(elevations).take(laser)
        positions = polar_points(before + offsets.take(laser), level, height)
        positions[:, 0] += np.float32(_RADIUS) * np.cos(before)
        positions[:, 1] += np.float32(_RADIUS) * np.sin(before)
        positions[:, 1] *= -1
        times_ns = (self._block_times_ns(packets, pairs) + shifts_ns[:, None]).ravel()
        order = np.argsort(np.argsort(self.angles_deg[:, 0], kind="stable"), kind="stable").astype(np.uint16)
        numbers = second.ravel()[block].astype(np.uint8) + np.uint8(1) if pairs.any() else None
        return LidarPoints(
            positions,
            intensities.ravel().take(index),
            timestamps_ns=times_ns.take(block)
            + np.rint(np.arange(32) * _CHANNEL_US * 1000).astype(np.int64).take(channel),
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
    if packets.shape[1] != LENGTH or (packets[:, :4] == tuple(_MSOP)).all(axis=1).mean() <= 0.5:
        return None
    return "helios-16p"


def decoder_of(key: str, angles: Path | None, state: UInt8Array | None = None) -> RobosenseDecoder:
    """What decodes packets of a model, with a file of angles, or those of a DIFOP packet, (1248,) uint8.

    Raises:
        DataError: there is neither, or the file is none.
    """
    if angles is not None:
        return RobosenseDecoder(angle_table(angles, _LASERS))
    found = None if state is None else state_angles(state)
    if found is None:
        problem = f"no DIFOP packet of this {MODELS[key]} has its angles; expected `--input-option angles=FILE.csv`"
        raise DataError("", "", problem)
    return RobosenseDecoder(found)


def state_angles(packet: UInt8Array) -> Float64Array | None:
    """Elevation and azimuth [deg] of each laser, (16, 2), by a DIFOP packet, (1248,) uint8; None where it has none."""
    found = np.empty((_LASERS, 2))
    for column, start in enumerate((_ELEVATIONS, _AZIMUTHS)):
        digits = packet[start : start + 3 * _LASERS].reshape(_LASERS, 3)
        if (digits[:, 0] > 1).any() or not digits[:, 1:].any():
            return None
        found[:, column] = np.where(digits[:, 0] == 1, -1, 1) * _big_endian(digits[:, 1:]) / 100.0
    return found if (np.abs(found) <= 90).all() else None
