"""From the packets of a rotating lidar to its sweeps: in order, on one clock, cut where a rotation begins.

What the bytes of a packet mean is known to decoders, one for each model; packets may come from captures or from bags.
"""

from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

import numpy as np

from sceneloom.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    Float64Array,
    Int64Array,
    UInt8Array,
    UInt16Array,
    read_only,
)
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_settings
from sceneloom.scene.clouds import LidarFrame, LidarPoints
from sceneloom.scene.frames import LazyFrames
from sceneloom.warnings import WarningKind

HOUR_NS = 3_600_000_000_000

_ABSOLUTE_NS = 100_000_000_000
"""A clock of a sensor that is nearer than this to the capturing one is kept: TAI and UTC are 37 s apart."""

_CHUNK = 2048  # packets that are looked at together
_TURN = 1 << 16
_JITTER = _TURN // 10  # a rotation goes on where its angle falls by less
_LONGEST_GAP_NS = 300_000_000  # no lidar rotates slower than 4 times a second
_JUMP_NS = 500_000_000  # a packet that came so much sooner or later than others has a wrong time
_PAUSE = 1.5  # where packets follow one another more than so many times slower than usual, some are missing


class Payloads(Protocol):
    """Where the bytes of packets come from: a capture, or the messages of a bag."""

    def payloads(self, rows: Int64Array) -> UInt8Array:
        """The packets with these numbers, (K,) int64, as (K, L) uint8."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """What is to be known of packets before they are cut into sweeps.

    Attributes:
        times_ns: (P, B) int64 [ns], by the sensor's clock, of the beginning of each block.
        phases: (P, B) float64, how much of a turn each block is away from where the sensor's rotation begins.
        frames: (P, B) int64, the sensor's own numbers of rotations, where it counts them.
        usable: (P,) bool, whether the packet is one of this sensor, and whole.
        states: (P,) bool, which packets are of this sensor's state, without returns; none where it is None.
    """

    times_ns: Int64Array
    phases: Float64Array
    usable: BoolArray
    frames: Int64Array | None = None
    states: BoolArray | None = None


class PacketDecoder(Protocol):
    """What the packets of one model of lidars mean: from bytes to arrays."""

    @property
    def model(self) -> str:
        """The maker's name for the device."""
        ...

    @property
    def clock_ns(self) -> int:
        """After how long the sensor's clock begins anew [ns]; 0 where it does not."""
        ...

    def survey(self, packets: UInt8Array) -> Survey:
        """Look at packets, (P, L) uint8, of B blocks (firings, columns) each."""
        ...

    def points(self, packets: UInt8Array, shifts_ns: Int64Array, blocks: BoolArray) -> LidarPoints:
        """Decode the returns of packets, (P, L) uint8.

        Args:
            shifts_ns: (P,) int64 [ns], what to add to the sensor's clock.
            blocks: (P, B) bool, which blocks count.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class PacketSweeps:
    """Reads sweeps out of packets; what `LazyFrames` calls.

    Attributes:
        source: the bytes.
        decoder: what they mean.
        rows: (P,) int64, numbers of the packets in the order of their times.
        shifts_ns: (P,) int64 [ns], from the sensor's clock to the scene's.
        begins: (S + 1,) int64, number of the block that each sweep begins with, and of the end.
        times_ns: (S,) int64 [ns], of these blocks.
        blocks: how many a packet has.
    """

    source: Payloads
    decoder: PacketDecoder
    rows: Int64Array
    shifts_ns: Int64Array
    begins: Int64Array
    times_ns: Int64Array
    blocks: int

    def __call__(self, number: int) -> LidarFrame:
        """Read one sweep."""
        start, stop = int(self.begins[number]), int(self.begins[number + 1])
        first, last = start // self.blocks, -(-stop // self.blocks)
        packets = self.source.payloads(self.rows[first:last])
        counted = np.zeros((last - first) * self.blocks, np.bool_)
        counted[start - first * self.blocks : stop - first * self.blocks] = True
        points = self.decoder.points(packets, self.shifts_ns[first:last], counted.reshape(-1, self.blocks))
        return LidarFrame(int(self.times_ns[number]), points)

    @property
    def frames(self) -> LazyFrames[LidarFrame]:
        """The sweeps, read when they are asked for."""
        return LazyFrames(self.times_ns, self)


@dataclass(slots=True, eq=False)
class _Surveyed:
    """What is kept of all packets: 2 bytes of each block, and 8 or 16 of each packet."""

    rows: list[Int64Array] = field(default_factory=list)
    times_ns: list[Int64Array] = field(default_factory=list)
    phases: list[UInt16Array] = field(default_factory=list)
    frames: list[Int64Array] = field(default_factory=list)


def find_sweeps(
    source: Payloads, rows: Int64Array, arrivals_ns: Int64Array, decoder: PacketDecoder, where: str, ledger: Ledger
) -> PacketSweeps | None:
    """Put the packets of a lidar in order, and cut them into sweeps; all are looked at, no point is decoded.

    Packets that are not usable, repeated or out of order are counted, and missing ones noted.

    Args:
        source: the bytes.
        rows: (P,) int64, numbers of the packets.
        arrivals_ns: (P,) int64 [ns], when they came.
        decoder: what they mean.
        where: the sensor, for messages.

    Returns:
        the sweeps, or None where no packet is usable.
    """
    kept, unusable = _Surveyed(), 0
    for start in range(0, len(rows), _CHUNK):
        chunk = rows[start : start + _CHUNK]
        survey = decoder.survey(source.payloads(chunk))
        known = survey.usable if survey.states is None else survey.usable | survey.states
        unusable += int(np.count_nonzero(~known))
        kept.rows.append(np.flatnonzero(survey.usable) + start)
        kept.times_ns.append(survey.times_ns[survey.usable, 0])
        phases = np.floor(survey.phases[survey.usable] % 1.0 * _TURN)
        kept.phases.append(np.minimum(phases, _TURN - 1).astype(np.uint16))
        if survey.frames is not None:
            kept.frames.append(survey.frames[survey.usable])
    usable = np.concatenate(kept.rows)
    if unusable:
        message = f"a packet is damaged, or none of {decoder.model}; it is left out"
        ledger.note(WarningKind.SKIPPED, "packets-unusable", where, message, count=unusable)
    if not len(usable):
        return None
    rows, arrivals_ns, raw_ns = rows[usable], arrivals_ns[usable], np.concatenate(kept.times_ns)
    phases = np.concatenate(kept.phases)
    frames = np.concatenate(kept.frames) if kept.frames else None
    times_ns = on_scene_clock(raw_ns, arrivals_ns, decoder.clock_ns, where, ledger)
    order = _in_order(times_ns, phases, rows, source, where, ledger)
    rows, times_ns, raw_ns, phases = rows[order], times_ns[order], raw_ns[order], phases[order]
    begins = _rotation_begins(times_ns, phases, None if frames is None else frames[order])
    _note_missing(times_ns, phases, where, ledger)
    blocks = phases.shape[1]
    starts, shifts_ns = np.flatnonzero(begins), times_ns - raw_ns
    first = decoder.survey(source.payloads(rows[starts // blocks])).times_ns
    starts_ns = first[np.arange(len(starts)), starts % blocks] + shifts_ns[starts // blocks]
    limits = np.append(starts, len(rows) * blocks)
    return PacketSweeps(source, decoder, rows, shifts_ns, limits, read_only(starts_ns), blocks)


def on_scene_clock(raw_ns: Int64Array, arrivals_ns: Int64Array, cycle: int, where: str, ledger: Ledger) -> Int64Array:
    """Give the times of packets: the sensor's, with hours, or shifted where its clock does not know the date.

    Args:
        raw_ns: (P,) int64 [ns], by the sensor's clock.
        arrivals_ns: (P,) int64 [ns], when they came.
        cycle: after how long the sensor's clock begins anew [ns]; 0 where it does not.
        where: the sensor, for messages.
    """
    times_ns = raw_ns
    if cycle:
        behind = (arrivals_ns - raw_ns + cycle // 2) % cycle - cycle // 2
        # packets that come at once agree, also where the clocks are half a cycle apart
        usual = int(behind[len(behind) // 2])
        behind = usual + (behind - usual + cycle // 2) % cycle - cycle // 2
        times_ns = arrivals_ns - behind
    delays = arrivals_ns - times_ns
    usual = int(np.partition(delays, len(delays) // 2)[len(delays) // 2])
    if abs(usual) > _ABSOLUTE_NS:
        # the shortest delays, but for packets whose times are wrong
        shift = int(delays[np.abs(delays - usual) < _JUMP_NS].min())
        message = f"its clock does not know the date; its times are shifted by {shift / 1e9:.6f} s to when packets came"
        ledger.note(WarningKind.ASSUMED, "clock-shifted", where, message)
        times_ns, usual = times_ns + shift, usual - shift
    jumps = np.abs(arrivals_ns - times_ns - usual) > _JUMP_NS
    if jumps.any():
        message = "the sensor's clock was set, or is wrong in a packet; when it came counts instead"
        ledger.note(WarningKind.REPAIRED, "clock-jumped", where, message, count=int(np.count_nonzero(jumps)))
        times_ns = np.where(jumps, arrivals_ns - usual, times_ns)
    return times_ns


def _in_order(
    times_ns: Int64Array, phases: AnyArray, rows: Int64Array, source: Payloads, where: str, ledger: Ledger
) -> Int64Array:
    """Which packets follow one another in time; those that were sent twice count once."""
    order = np.argsort(times_ns, kind="stable")
    late = int((np.diff(order) < 0).sum())
    if late:
        message = "a packet came out of order; it was put where it belongs"
        ledger.note(WarningKind.REPAIRED, "packets-reordered", where, message, count=late)
    same = (np.diff(times_ns[order]) == 0) & (phases[order[1:]] == phases[order[:-1]]).all(axis=1)
    repeated = [
        k + 1
        for k in np.flatnonzero(same).tolist()
        if np.array_equal(source.payloads(rows[order[k : k + 1]]), source.payloads(rows[order[k + 1 : k + 2]]))
    ]
    if repeated:
        message = "a packet is there twice; it counts once"
        ledger.note(WarningKind.REPAIRED, "packets-repeated", where, message, count=len(repeated))
    return np.delete(order, repeated)


def _rotation_begins(times_ns: Int64Array, phases: AnyArray, frames: Int64Array | None) -> BoolArray:
    """Which blocks, of all packets in one row, a rotation begins with."""
    blocks = phases.shape[1]
    gap = np.append(False, np.abs(np.diff(times_ns)) > _LONGEST_GAP_NS)
    if frames is not None:
        flat = frames.ravel()
        begins = np.append(True, flat[1:] != flat[:-1])
    else:
        steps = np.diff(phases.ravel().astype(np.int32))
        backwards = np.median(np.sign(steps[steps != 0])) < 0 if (steps != 0).any() else False
        begins = np.append(True, (-steps if backwards else steps) < -_JITTER)
    begins[::blocks] |= gap
    return np.asarray(begins, np.bool_)


def _note_missing(times_ns: Int64Array, phases: AnyArray, where: str, ledger: Ledger) -> None:
    """Note packets that are missing by the pauses between those that are there."""
    steps = np.diff(times_ns)
    usual = float(np.median(steps)) if len(steps) else 0.0
    long = np.flatnonzero((steps > _PAUSE * usual) & (steps > 0)) if usual > 0 else np.zeros(0, np.int64)
    if not len(long):
        return
    # at the same angle in each rotation there is a sector in which the lidar does not measure
    before = phases[long, -1].astype(np.int32)
    off = np.abs((before - int(np.median(before)) + _TURN // 2) % _TURN - _TURN // 2)
    if len(long) > 2 and (off < _TURN // 50).mean() > 0.8:
        return
    count = int(np.rint(steps[long] / usual - 1).clip(0, 1e9).sum())
    ledger.note(WarningKind.SKIPPED, "packets-missing", where, "a packet is missing", count=count)


def no_sweeps(path: object, problem: str) -> DataError:
    """The error of a source without any sweep."""
    return DataError(path, "", f"{problem}; expected UDP packets of Ouster, Velodyne, Hesai, RoboSense or Livox lidars")


def located(kept: BoolArray) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Where the returns that count are: numbers in the flat array, of their blocks, and of their channels, (N,) int64.

    Args:
        kept: (P, B, C) bool.
    """
    index = np.flatnonzero(kept)
    blocks = np.repeat(np.arange(kept.shape[0] * kept.shape[1]), np.count_nonzero(kept, axis=2).ravel())
    return index, blocks, index - blocks * kept.shape[2]


def polar_points(
    azimuths: Float32Array, level: Float32Array | np.float32, height: Float32Array | np.float32
) -> Float32Array:
    """Positions of returns, (N, 3) float32 [m]: x along azimuth 0, y where the azimuth grows, z up.

    Args:
        azimuths: (N,) [rad].
        level, height: (N,) [m], or one for all, distance from the axis, and above the centre.
    """
    found = np.empty((len(azimuths), 3), np.float32)
    np.multiply(np.cos(azimuths), level, out=found[:, 0])
    np.multiply(np.sin(azimuths), level, out=found[:, 1])
    found[:, 2] = height
    return found


def utc_seconds(dates: UInt8Array) -> Int64Array:
    """Seconds since 1970 of dates, (P, 6) uint8: year since 1900 or 2000, month, day, h, min, s; or 0 and seconds.

    What is no date is 0.
    """
    words = np.zeros((len(dates), 8), np.uint8)
    words[:, :6] = dates
    distinct, which = np.unique(words.view(np.int64), return_inverse=True)
    return np.array([_second(date) for date in distinct.view(np.uint8).reshape(-1, 8)[:, :6].tolist()], np.int64)[
        which.ravel()
    ]


def _second(date: list[int]) -> int:
    year, month, day, *clock = date
    if year == 0:
        return int.from_bytes(bytes(date[1:]), "big")
    try:
        return int(datetime(year + (2000 if year < 70 else 1900), month, day, tzinfo=UTC).timestamp()) + (
            clock[0] * 3600 + clock[1] * 60 + clock[2]
        )
    except ValueError:
        return 0


def angle_table(path: Path, *channels: int) -> Float64Array:
    """Read a file of angles, (C, 2) float64 [deg]: lines of elevation and azimuth, maybe after the channel's number.

    Args:
        path: the file.
        channels: how many the lidar has, or may have.

    Raises:
        DataError: it cannot be read, or has not a line for each channel.
    """
    rows: dict[int, list[float]] = {}
    for number, line in enumerate(read_settings(path).decode("utf-8-sig", "replace").splitlines(), 1):
        try:
            row = [float(part) for part in line.replace(";", ",").split(",") if part.strip()]
        except ValueError:
            continue  # the head
        if len(row) in (2, 3):
            rows[number] = row[-2:]
    if len(rows) not in channels:
        expected = " or ".join(map(str, channels))
        raise DataError(path, "", f"{len(rows)} lines of elevation and azimuth; expected {expected}")
    for number, row in rows.items():
        for angle in row:
            if not abs(angle) <= 360:  # NaN, too
                raise DataError(path, f"line {number}", f"angle {angle}; expected 360 degrees at most")
    return np.array(list(rows.values()))
