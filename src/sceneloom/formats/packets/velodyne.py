"""Packets of Velodyne's lidars: VLP-16 (Puck, Puck LITE), Puck Hi-Res, HDL-32E, VLP-32C, VLS-128 and HDL-64E.

Axes: x forward (azimuth 0), y left, z up, as the ROS drivers have them; the manuals have x right and y forward. Rings
are counted from the lowest laser up.

Source: VLP-16 User Manual 63-9243 Rev. E, HDL-32E Application Note 63-9277 Rev. D, VLP-32C User Manual 63-9325 Rev. B,
HDL-64E S2 and S3 User's Manuals: packet formats, firing timings, vertical angles, appendix "two-point correction". For
VLS-128 (Alpha Prime) VeloView's calibration, and banks and timings of velodyne-decoder 3.1 (57.8, 2.89, 7 µs); those of
the ROS driver (53.3, 2.665, 8.7 µs) are another 9 µs at most.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_settings
from sceneloom.formats.packets.sweeps import HOUR_NS, Survey, located, polar_points
from sceneloom.scene.clouds import LidarPoints

LENGTH = 1206
"""Bytes of a packet of returns."""
POSITION_LENGTH = 512
"""Bytes of a position packet, which carries an NMEA sentence."""

_RETURN = np.dtype([("distance", "<u2"), ("intensity", "u1")])
_BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", _RETURN, 32)])
_PACKET = np.dtype([("blocks", _BLOCK, 12), ("time", "<u4"), ("mode", "u1"), ("product", "u1")])
_UPPER, _LOWER = 0xEEFF, 0xDDFF
_BANKS = (_UPPER, _LOWER, 0xCCFF, 0xBBFF)
"""Flags of blocks, by which 32 lasers they are of."""
_DUAL = 0x39
_NMEA = 206  # where the sentence of a position packet begins


@dataclass(frozen=True, slots=True)
class _Model:
    """What models differ by.

    Attributes:
        name: the maker's.
        product: as packets state it; None where they do not.
        elevations_deg, azimuths_deg: of each laser; what is added to the azimuth of a block.
        radius: how far from the axis the lasers cross [m]: they begin so much times the tangent above the centre.
        step: of distances [m].
        laser_us: of the values of a block, or of all lasers of a firing, when they were fired after the first one [µs].
        cycle_us: from one firing of all lasers to the next [µs].
        banks: how many blocks, of 32 lasers each, are one firing.
    """

    name: str
    product: int | None
    elevations_deg: tuple[float, ...]
    azimuths_deg: tuple[float, ...]
    radius: float
    step: float
    laser_us: tuple[float, ...]
    cycle_us: float
    banks: int = 1


def _fan(lowest: float, middle: float, step: float, lasers: int) -> tuple[float, ...]:
    """Elevations where lasers are fired from the lower and the upper half in turn."""
    return tuple(round((lowest, middle)[k % 2] + k // 2 * step, 2) for k in range(lasers))


_PAIR_US = tuple(55.296 * (k // 16) + 2.304 * (k % 16) for k in range(32))
_VLP32_ELEVATIONS = (
    *(-25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333, 0.667, -4),
    *(-4.667, 1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667, -3, 7, 4.667, -2.333, -2, 15, 10.333, -1.333),
)
_VLP32_AZIMUTHS = (
    *(1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4),
    *(1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4),
)
_S2_US = tuple(6.0 * (k // 4) + (0.0, 1.26, 2.46, 3.66)[k % 4] for k in range(32))
_S3_US = tuple(7.2 * (k // 4) + (0.0, 1.3, 2.5, 3.7)[k % 4] for k in range(32))

_VLS_ELEVATIONS = (
    *(-11.742, -1.99, 3.4, -5.29, -0.78, 4.61, -4.08, 1.31, -6.5, -1.11, 4.28, -4.41, 0.1, 6.48, -3.2, 2.19, -3.86),
    *(1.53, -9.244, -1.77, 2.74, -5.95, -0.56, 4.83, -2.98, 2.41, -6.28, -0.89, 3.62, -5.07, 0.32, 7.58, -0.34, 5.18),
    *(-3.64, 1.75, -25.0, -2.43, 2.96, -5.73, 0.54, 9.7, -2.76, 2.63, -7.65, -1.55, 3.84, -4.85, 3.18, -5.51, -0.12),
    *(5.73, -4.3, 1.09, -16.042, -2.21, 4.06, -4.63, 0.76, 15.0, -3.42, 1.97, -6.85, -1.33, -5.62, -0.23, 5.43, -3.53),
    *(0.98, -19.582, -2.32, 3.07, -4.74, 0.65, 11.75, -2.65, 1.86, -7.15, -1.44, 3.95, -2.1, 3.29, -5.4, -0.01, 4.5),
    *(-4.19, 1.2, -13.565, -1.22, 4.17, -4.52, 0.87, 6.08, -3.31, 2.08, -6.65, 1.42, -10.346, -1.88, 3.51, -6.06),
    *(-0.67, 4.72, -3.97, 2.3, -6.39, -1.0, 4.39, -5.18, 0.21, 6.98, -3.09, 4.98, -3.75, 1.64, -8.352, -2.54, 2.85),
    *(-5.84, -0.45, 8.43, -2.87, 2.52, -6.17, -1.66, 3.73, -4.96, 0.43),
)
_VLS_AZIMUTHS = (6.354, 4.548, 2.732, 0.911, -0.911, -2.732, -4.548, -6.354) * 16
_VLS_US = tuple(2.89 * (k // 8 + 2 * (k // 64)) - 7.0 for k in range(128))  # eight at a time, with a pause after 64

MODELS: Mapping[str, _Model] = MappingProxyType(
    {
        "vlp-16": _Model("VLP-16", 0x22, _fan(-15, 1, 2, 16), (0.0,) * 16, 0.04191, 0.002, _PAIR_US, 110.592),
        "puck-hi-res": _Model(
            "Puck Hi-Res", 0x24, _fan(-10, 2 / 3, 4 / 3, 16), (0.0,) * 16, 0.04191, 0.002, _PAIR_US, 110.592
        ),
        "hdl-32e": _Model(
            "HDL-32E", 0x21, _fan(-92 / 3, -28 / 3, 4 / 3, 32), (0.0,) * 32, 0.02895, 0.002,
            tuple(1.152 * k for k in range(32)), 46.08,
        ),
        "vlp-32c": _Model(
            "VLP-32C", 0x28, _VLP32_ELEVATIONS, _VLP32_AZIMUTHS, 0.0424, 0.004,
            tuple(2.304 * (k // 2) for k in range(32)), 55.296,
        ),
        "vls-128": _Model("VLS-128", 0xA1, _VLS_ELEVATIONS, _VLS_AZIMUTHS, 0.05863, 0.004, _VLS_US, 57.8, banks=4),
        "hdl-64e-s2": _Model("HDL-64E S2", None, (), (), 0.0, 0.002, _S2_US, 48.0, banks=2),
        "hdl-64e-s3": _Model("HDL-64E S3", None, (), (), 0.0, 0.002, _S3_US, 57.6, banks=2),
    }
)  # fmt: skip
"""The models by the names that `--input-option model=` takes."""

_CORRECTIONS = (
    *("rot_correction", "vert_correction", "dist_correction", "dist_correction_x", "dist_correction_y"),
    *("horiz_offset_correction", "vert_offset_correction"),
)


@dataclass(frozen=True, eq=False)
class VelodyneDecoder:
    """Decodes packets of one model.

    Attributes:
        key: of the model in `MODELS`.
        corrections: (L, 7) float64 of a calibration file: `_CORRECTIONS` in radians and metres; None for the manual's
            angles.
    """

    key: str
    corrections: Float64Array | None = None

    clock_ns = HOUR_NS

    @property
    def model(self) -> str:
        """The maker's name for the device."""
        return f"Velodyne {MODELS[self.key].name}"

    def _banks(self, records: AnyArray) -> Int64Array:
        """Which 32 lasers blocks are of, (P, 12) int64; -1 where they are of none."""
        flags = records["blocks"]["flag"]
        found = np.full(flags.shape, -1, np.int64)
        for bank, flag in enumerate(_BANKS[: MODELS[self.key].banks]):
            found[flags == flag] = bank
        return found

    @cached_property
    def _lasers(self) -> Float64Array:
        """Corrections of the lasers, (L, 7)."""
        if self.corrections is not None:
            return self.corrections
        model = MODELS[self.key]
        found = np.zeros((len(model.elevations_deg), len(_CORRECTIONS)))
        found[:, 0], found[:, 1] = -np.deg2rad(model.azimuths_deg), np.deg2rad(model.elevations_deg)
        found[:, 6] = -model.radius * np.tan(found[:, 1])
        return found

    @cached_property
    def _rings(self) -> AnyArray:
        return np.argsort(np.argsort(self._lasers[:, 1], kind="stable"), kind="stable").astype(np.uint16)

    def survey(self, packets: UInt8Array) -> Survey:
        """Look at packets, (P, 1206) uint8."""
        records, model = packets.view(_PACKET)[:, 0], MODELS[self.key]
        azimuths, known = records["blocks"]["azimuth"], self._banks(records) >= 0
        if model.banks == 4:
            # with two returns the last blocks hold nothing: they are where the last one is that does
            last = np.maximum.accumulate(np.where(known, np.arange(12), 0), axis=1)
            azimuths, known = np.take_along_axis(azimuths, last, axis=1), known[:, :8]
        usable = known.all(axis=1) & (azimuths <= 36000).all(axis=1) & (records["time"] < 3_600_000_000)
        if model.product is not None:
            usable &= records["product"] == model.product
        starts_ns = np.rint(self._firing_starts_us(records) * 1000).astype(np.int64)
        times_ns = records["time"].astype(np.int64)[:, None] * 1000 + starts_ns
        return Survey(times_ns, azimuths / 36000.0, np.asarray(usable, np.bool_))

    def _dual(self, records: AnyArray) -> BoolArray:
        """Which packets hold two returns of each firing; HDL-64E show it by azimuths that repeat."""
        if MODELS[self.key].product is None:
            azimuths = records["blocks"]["azimuth"]
            return np.asarray(azimuths[:, 0] == azimuths[:, 2], np.bool_)
        return np.asarray(records["mode"] == _DUAL, np.bool_)

    def _firing_starts_us(self, records: AnyArray) -> Float64Array:
        """When the first laser of each block's firing was fired after the packet's time [µs], (P, 12)."""
        number, model = np.arange(12), MODELS[self.key]
        if model.banks == 4:
            first = self._banks(records) == 0
            first[:, 1:] &= ~first[:, :-1]  # of two returns the first
            return np.asarray(np.maximum(np.cumsum(first, axis=1) - 1, 0) * model.cycle_us)
        single, dual = number // model.banks, number // (2 * model.banks)
        return np.where(self._dual(records)[:, None], dual, single) * model.cycle_us

    def _rates(self, records: AnyArray, starts_us: Float64Array) -> Float64Array:
        """How fast the azimuth grows in each packet, (P,) [0.01 degree / µs]."""
        azimuths = records["blocks"]["azimuth"].astype(np.float64)
        if MODELS[self.key].banks < 4:
            return np.asarray((azimuths[:, -1] - azimuths[:, 0]) % 36000.0 / starts_us[:, -1])
        # two returns of one firing fill a packet: the speed is that from one packet to the next
        starts, times = azimuths[:, 0], records["time"].astype(np.float64)
        within = (azimuths[:, 8] - starts) % 36000.0 / np.maximum(starts_us[:, 8], 1.0)
        across = np.diff(starts) % 36000.0 / np.maximum(np.diff(times), 1.0)
        speed = np.median(within if len(starts) == 1 else across)
        return np.full(len(starts), speed)

    def points(self, packets: UInt8Array, shifts_ns: Int64Array, blocks: BoolArray) -> LidarPoints:
        """Decode the returns of packets, (P, 1206) uint8; of two equal returns of a firing one counts.

        The azimuth of each laser is interpolated by when it was fired and how fast the packet's azimuths grow.
        """
        records, model = packets.view(_PACKET)[:, 0], MODELS[self.key]
        body = records["blocks"]
        values, azimuths = body["returns"], body["azimuth"].astype(np.float64)
        raw, intensities = values["distance"], values["intensity"]
        starts_us, dual = self._firing_starts_us(records), self._dual(records)
        banks = self._banks(records)
        kept = (raw > 0) & blocks[:, :, None]
        again = 2 if model.banks == 2 else 1
        second = dual[:, None] & (np.arange(12) // again % 2 == 1)
        if model.banks == 4:
            kept &= (banks >= 0)[:, :, None]
        equal = (raw[:, again:] == raw[:, :-again]) & (intensities[:, again:] == intensities[:, :-again])
        kept[:, again:] &= ~(equal & second[:, again:, None])
        index, block, channel = located(kept)
        rate = self._rates(records, starts_us)
        lasers = channel % len(self._lasers) if len(self._lasers) < 32 else channel
        if model.banks > 1:
            lasers = channel + 32 * banks.ravel()[block]
        # float32 from here on: a turn in steps of 5e-7 rad is 0.05 mm at 100 m
        starts, rates = np.deg2rad(azimuths.ravel() / 100.0), np.deg2rad(np.repeat(rate, 12) / 100.0)
        after_us = np.array(model.laser_us)
        fired = lasers if len(after_us) > 32 else channel
        turned_us = after_us - after_us[0]
        if model.banks == 4 and (azimuths[:, 0] != azimuths[:, 2]).any():
            turned_us = after_us - np.repeat(after_us[::32], 32)  # each bank states the azimuth of its own start
        angles = rates.astype(np.float32).take(block) * turned_us.astype(np.float32).take(fired)
        angles += starts.astype(np.float32).take(block)
        angles -= self._lasers[:, 0].astype(np.float32).take(lasers)
        distances = raw.ravel().take(index) * np.float32(model.step)
        if self.corrections is None:
            tilt, above = self._lasers[:, 1], self._lasers[:, 6].astype(np.float32)
            level = distances * np.cos(tilt).astype(np.float32).take(lasers)
            height = distances * np.sin(tilt).astype(np.float32).take(lasers)
            positions = polar_points(angles, level, height + above.take(lasers))
        else:
            positions = self._corrected(angles, distances, self._lasers[lasers])
        positions[:, 1] *= -1
        blocks_ns = np.rint(starts_us * 1000).astype(np.int64)
        blocks_ns += (records["time"].astype(np.int64) * 1000 + shifts_ns)[:, None]
        numbers = second.ravel()[block].astype(np.uint8) + np.uint8(1) if dual.any() else None
        return LidarPoints(
            positions,
            intensities.ravel().take(index),
            timestamps_ns=blocks_ns.ravel().take(block) + np.rint(after_us * 1000).astype(np.int64).take(fired),
            rings=self._rings.take(lasers),
            extras=MappingProxyType({} if numbers is None else {"return_number": numbers}),
        )

    def _corrected(self, angles: Float32Array, distances: Float32Array, lasers: Float64Array) -> Float32Array:
        """Positions by a calibration with offsets and distances of each laser, x forward and y right."""
        _, tilt, distance_all, distance_x, distance_y, aside, above = lasers.T
        cosine, sine = np.cos(angles.astype(np.float64)), np.sin(angles.astype(np.float64))
        distance = distances + distance_all
        level = distance * np.cos(tilt)
        # of the two-point correction: between walls at 2.4 m and 1.93 m, and one at 25.04 m
        right, ahead = np.abs(level * sine - aside * cosine), np.abs(level * cosine + aside * sine)
        has_two = (distance_x != 0) | (distance_y != 0)
        more_x = (distance_all - distance_x) * (right - 25.04) / 22.64 * has_two
        more_y = (distance_all - distance_y) * (ahead - 25.04) / 23.11 * has_two
        forward = (level + more_y * np.cos(tilt)) * cosine + aside * sine
        sideways = (level + more_x * np.cos(tilt)) * sine - aside * cosine
        return np.stack((forward, sideways, distance * np.sin(tilt) + above), axis=1).astype(np.float32)


def read_corrections(path: Path) -> Float64Array:
    """Read the YAML of the ROS driver's calibration, `lasers:` with an entry for each, as (L, 7) float64.

    Raises:
        DataError: it cannot be read, or has no such entries.
    """
    text = read_settings(path).decode("utf-8", "replace")
    entries: dict[int, dict[str, float]] = {}
    for part in re.split(r"(?m)^\s*-\s", text)[1:]:
        values = dict(re.findall(r"(\w+)\s*:\s*([-+.\deE]+)", part))
        try:
            entries[int(values["laser_id"])] = {name: float(values.get(name, 0.0)) for name in _CORRECTIONS}
        except (KeyError, ValueError) as error:
            raise DataError(path, f"lasers[{len(entries)}]", f"{error}; expected laser_id and numbers") from error
    if sorted(entries) != list(range(len(entries))) or len(entries) not in (16, 32, 64, 128):
        raise DataError(path, "lasers", f"{len(entries)} lasers; expected 16, 32, 64 or 128 with laser_id from 0")
    found = np.array([[entries[k][name] for name in _CORRECTIONS] for k in range(len(entries))])
    if not np.isfinite(found).all():
        raise DataError(path, "lasers", "a number is not finite")
    return np.asarray(read_only(found))


def recognise(packets: UInt8Array) -> str | None:
    """The key of the model whose packets of returns these, (P, L) uint8, are; None where it is none of `MODELS`."""
    if packets.shape[1] != LENGTH:
        return None
    records = packets.view(_PACKET)[:, 0]
    products, flags = records["product"], records["blocks"]["flag"]
    if (flags == _LOWER).any() and (products != MODELS["vls-128"].product).mean() > 0.5:
        return "hdl-64e-s3" if np.isin(flags, (_UPPER, _LOWER)).mean() > 0.5 else None
    return next((key for key, model in MODELS.items() if (products == model.product).mean() > 0.5), None)


def decoder_of(key: str, angles: Path | None, state: UInt8Array | None = None) -> VelodyneDecoder:
    """What decodes packets of a model; its calibration file is needed for HDL-64E only.

    Raises:
        DataError: there is none, or it is of other lasers.
    """
    del state
    lasers = len(MODELS[key].elevations_deg) or 64
    if angles is None or angles.suffix.lower() not in (".yaml", ".yml"):
        if lasers == 64:
            problem = "expected the calibration of this HDL-64E, as `--input-option angles=FILE.yaml`"
            raise DataError(angles or "", "", problem)
        return VelodyneDecoder(key)
    corrections = read_corrections(angles)
    if len(corrections) != lasers:
        raise DataError(angles, "lasers", f"{len(corrections)} lasers; expected {lasers} of {MODELS[key].name}")
    return VelodyneDecoder(key, corrections)


def position_sentences(packets: UInt8Array) -> list[str]:
    """The NMEA sentences of position packets, (P, 512) uint8; "" where there is none."""
    found: list[str] = []
    for packet in packets:
        text = bytes(packet[_NMEA:]).split(b"\0", 1)[0].decode("ascii", "replace").strip()
        found.append(text if text.startswith("$") else "")
    return found
