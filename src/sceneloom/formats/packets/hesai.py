"""Packets of Hesai's lidars: Pandar40P and 64, PandarXT-16, -32 and -32M2X, PandarQT-64, OT128, AT128.

Axes: the maker's, x right, y forward (azimuth 0), z up. Rings are channels, from 0.

Source: user manuals of the models ("Point Cloud Data Packet", "Absolute Time of Point Cloud Data", "Channel
Distribution"), and for AT128 "Angle Correction File", version 1.5.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_settings
from sceneloom.formats.packets.sweeps import Survey, angle_table, utc_seconds
from sceneloom.scene.clouds import LidarPoints

_START, _BLOCK_START = b"\xee\xff", b"\xff\xee"
_RETURNS = {0x39: 2, 0x3A: 2, 0x3B: 2, 0x3C: 2, 0x3D: 3, 0x3E: 2}
"""How many returns a firing has, by the return mode of packets; 1 in others."""

_LONG_HEADER = 12
_FINE = 256  # fine steps of AT128's azimuth in 0.01°
_AT_UNIT = np.pi / (180.0 * 100.0 * _FINE)  # radians of such a step
_ADJUSTED_EVERY = 200 * _FINE  # AT128's tables of adjustments have a value every 2°


@dataclass(frozen=True, slots=True)
class _Model:
    """What models differ by.

    Attributes:
        name: the maker's.
        blocks, channels: of a packet; how many values a block has.
        header: bytes before the first block; in 8 the distance unit is byte 5, in 12 byte 9.
        mode, time, date: offsets of the return mode, of the microseconds and of the date.
        first_us, step_us: when the last firing of a packet was, and how far firings are apart [µs]; with a negative
            step the first one is meant.
        channel_us: when channels are fired [µs].
        length: the shortest packet; sequence numbers and signatures may follow.
        angles_deg: (elevation, azimuth) of channels by the manual; () where only the sensor's own file tells.
        fine_us: `channel_us` of high resolution, which the byte before the return mode states by 0; () without.
        longest_tail: sequence number, checksum, IMU and signature at most [bytes].
    """

    name: str
    blocks: int
    channels: int
    header: int
    mode: int
    time: int
    date: int
    first_us: float
    step_us: float
    channel_us: tuple[float, ...]
    length: int
    angles_deg: tuple[tuple[float, float], ...] = ()
    fine_us: tuple[float, ...] = ()
    longest_tail: int = 40


_40P_US = (
    *(42.22, 28.47, 16.04, 3.62, 45.49, 31.74, 47.46, 54.67, 20.62, 33.71, 40.91, 8.19, 20.62, 27.16, 50.73, 8.19),
    *(14.74, 36.98, 45.49, 52.70, 23.89, 31.74, 38.95, 11.47, 18.65, 25.19, 48.76, 6.23, 12.77, 35.01, 21.92, 9.50),
    *(43.52, 29.77, 17.35, 4.92, 42.22, 28.47, 16.04, 3.62),
)
_40P_ELEVATIONS = (15.0, 11, 8, 5, 3, 2, *(round((5 - k) / 3, 2) for k in range(24)), *range(-7, -15, -1), -19, -25)
_40P_AZIMUTHS = (*(-1.042,) * 6, *(3.125, -5.208, -1.042) * 8, *(-1.042,) * 10)
_64_US = (
    *(23.18, 21.876, 20.572, 19.268, 17.964, 16.66, 11.444, 46.796, 7.532, 36.956, 50.732, 54.668, 40.892, 44.828),
    *(31.052, 34.988, 48.764, 52.7, 38.924, 42.86, 29.084, 33.02, 46.796, 25.148, 36.956, 50.732, 27.116, 40.892),
    *(44.828, 31.052, 34.988, 48.764, 25.148, 38.924, 42.86, 29.084, 33.02, 52.7, 6.228, 54.668, 15.356, 27.116),
    *(10.14, 23.18, 4.924, 21.876, 14.052, 17.964, 8.836, 19.268, 3.62, 20.572, 12.748, 16.66, 7.532, 11.444, 6.228),
    *(15.356, 10.14, 4.924, 3.62, 14.052, 8.836, 12.748),
)
_64_ELEVATIONS = (
    *(14.9, 11.05, 8.077, 5.075, 3.058, 2.046, 1.878, 1.706, 1.54, 1.369, 1.202, 1.031, 0.864, 0.693, 0.526, 0.355),
    *(0.187, 0.018, -0.151, -0.319, -0.49, -0.657, -0.827, -0.995, -1.166, -1.333, -1.504, -1.67, -1.842, -2.01),
    *(-2.18, -2.347, -2.518, -2.682, -2.855, -3.022, -3.192, -3.357, -3.53, -3.694, -3.866, -4.032, -4.203, -4.367),
    *(-4.54, -4.702, -4.874, -5.039, -5.211, -5.373, -5.547, -5.708, -5.88, -6.043, -7.045, -8.041, -9.042, -10.027),
    *(-11.014, -11.988, -12.956, -13.912, -18.871, -24.879),
)
_64_AZIMUTHS = (*(-1.042,) * 6, *(1.042, 3.125, 5.208, -5.208, -3.125, -1.042) * 8, *(-1.042,) * 10)
_QT_US = (
    *(12.31, 14.37, 16.43, 18.49, 20.54, 22.6, 24.66, 26.71, 29.16, 31.22, 33.28, 35.34, 37.39, 39.45, 41.5, 43.56),
    *(46.61, 48.67, 50.73, 52.78, 54.84, 56.9, 58.95, 61.01, 63.45, 65.52, 67.58, 69.63, 71.69, 73.74, 75.8, 77.86),
    *(80.9, 82.97, 85.02, 87.08, 89.14, 91.19, 93.25, 95.3, 97.75, 99.82, 101.87, 103.93, 105.98, 108.04, 110.1),
    *(112.15, 115.2, 117.26, 119.32, 121.38, 123.43, 125.49, 127.54, 129.6, 132.05, 134.11, 136.17, 138.22, 140.28),
    *(142.34, 144.39, 146.45),
)
_QT_ELEVATIONS = (
    *(-52.121, -49.785, -47.577, -45.477, -43.465, -41.528, -39.653, -37.831, -36.055, -34.32, -32.619, -30.95),
    *(-29.308, -27.69, -26.094, -24.517, -22.964, -21.42, -19.889, -18.372, -16.865, -15.368, -13.88, -12.399),
    *(-10.925, -9.457, -7.994, -6.535, -5.079, -3.626, -2.175, -0.725, 0.725, 2.175, 3.626, 5.079, 6.534, 7.993),
    *(9.456, 10.923, 12.397, 13.877, 15.365, 16.861, 18.368, 19.885, 21.415, 22.959, 24.524, 26.101, 27.697),
    *(29.315, 30.957, 32.627, 34.328, 36.064, 37.84, 39.662, 41.537, 43.475, 45.487, 47.587, 49.795, 52.133),
)
_QT_AZIMUTHS = (
    *(8.736, 8.314, 7.964, 7.669, 7.417, 7.198, 7.007, 6.838, 6.688, 6.554, 6.434, 6.326, 6.228, 6.14, 6.059),
    *(5.987, -5.27, -5.216, -5.167, -5.123, -5.083, -5.047, -5.016, -4.988, -4.963, -4.942, -4.924, -4.91, -4.898),
    *(-4.889, -4.884, -4.881, 5.493, 5.496, 5.502, 5.512, 5.525, 5.541, 5.561, 5.584, 5.611, 5.642, 5.676, 5.716),
    *(5.759, 5.808, 5.862, 5.921, -5.33, -5.396, -5.469, -5.55, -5.64, -5.74, -5.85, -5.974, -6.113, -6.269),
    *(-6.447, -6.651, -6.887, -7.163, -7.493, -7.892),
)
_OT_US = (
    *(49.758, 43.224, 36.69, 30.156, 21.98, 15.446, 8.912, 2.378, 49.758, 43.224, 36.69, 30.156, 2.378, 15.446),
    *(8.912, 21.98, 43.224, 30.156, 49.758, 15.446, 36.69, 2.378, 21.98, 8.912, 34.312, 45.002, 38.468, 40.846),
    *(40.846, 34.312, 51.536, 47.38, 31.934, 47.38, 31.934, 51.536, 38.468, 27.778, 27.778, 45.002, 38.468, 40.846),
    *(51.536, 45.002, 31.934, 47.38, 34.312, 27.778, 38.468, 40.846, 51.536, 45.002, 31.934, 34.312, 27.778, 38.468),
    *(40.846, 51.536, 45.002, 31.934, 47.38, 34.312, 27.778, 45.002, 45.002, 51.536, 38.468, 40.846, 47.38, 40.846),
    *(31.934, 45.002, 27.778, 38.468, 40.846, 31.934, 27.778, 38.468, 34.312, 34.312, 34.312, 47.38, 51.536, 31.934),
    *(51.536, 47.38, 27.778, 49.758, 21.98, 43.224, 15.446, 43.224, 36.69, 8.912, 30.156, 2.378, 49.758, 21.98),
    *(36.69, 15.446, 8.912, 30.156, 2.378, 49.758, 43.224, 36.69, 30.156, 21.98, 15.446, 8.912, 2.378, 43.224),
    *(49.758, 30.156, 36.69, 21.98, 15.446, 2.378, 8.912, 49.758, 43.224, 36.69, 30.156, 21.98, 15.446, 8.912, 2.378),
    *(30.156,),
)
_OT_FINE_US = (
    *(21.98, 15.446, 8.912, 2.378, 21.98, 15.446, 8.912, 2.378, 21.98, 15.446, 8.912, 2.378, 2.378, 15.446, 8.912),
    *(21.98, 8.912, 2.378, 21.98, 8.912, 6.534, 17.224, 10.69, 13.068, 13.068, 6.534, 23.758, 19.602, 4.156, 19.602),
    *(4.156, 23.758, 13.068, 13.068, 23.758, 10.69, 4.156, 19.602, 19.602, 0, 10.69, 6.534, 23.758, 17.224, 23.758),
    *(19.602, 6.534, 17.224, 4.156, 0, 6.534, 0, 17.224, 10.69, 17.224, 17.224, 23.758, 23.758, 10.69, 13.068),
    *(13.068, 13.068, 19.602, 19.602, 6.534, 13.068, 4.156, 4.156, 17.224, 17.224, 17.224, 0, 10.69, 10.69, 13.068),
    *(13.068, 4.156, 0, 10.69, 6.534, 6.534, 6.534, 19.602, 23.758, 4.156, 23.758, 19.602, 0, 21.98, 21.98, 15.446),
    *(15.446, 8.912, 8.912, 2.378, 2.378, 21.98, 15.446, 21.98, 8.912, 15.446, 8.912, 2.378, 2.378, 21.98, 15.446),
    *(8.912, 2.378, 21.98, 15.446, 8.912, 2.378, 15.446, 21.98, 2.378, 8.912, 21.98, 15.446, 2.378, 8.912, 21.98),
    *(15.446, 8.912, 2.378, 21.98, 15.446, 8.912, 2.378),
)
_AT_US = (
    *(0, 0, 8.24, 4.112, 4.144, 8.24, 0, 0, 12.424, 4.144, 4.112, 8.264, 12.376, 12.376, 8.264, 12.424),
    *(0, 0, 4.112, 8.24, 4.144, 0, 0, 4.144, 12.424, 8.264, 4.112, 12.376, 12.376, 12.424, 8.264, 0.848),
    *(2.504, 4.976, 6.616, 6.616, 9.112, 2.504, 0.848, 10.768, 13.28, 13.28, 4.976, 9.112, 14.928, 14.928),
    *(10.768, 2.504, 0.848, 6.616, 4.976, 9.112, 6.616, 0.848, 2.504, 13.28, 10.768, 4.976, 13.28, 14.928),
    *(9.112, 10.768, 14.928, 13.28, 0.848, 9.112, 13.28, 2.504, 4.976, 0.848, 2.504, 14.928, 10.768, 10.768),
    *(14.928, 4.976, 6.616, 6.616, 9.112, 0.848, 13.28, 13.28, 9.112, 4.976, 2.504, 2.504, 0.848, 10.768),
    *(14.928, 14.928, 10.768, 6.616, 4.976, 9.112, 6.616, 4.112, 12.424, 0, 4.144, 0, 0, 12.424, 0, 8.264),
    *(4.112, 4.144, 8.24, 8.24, 8.264, 12.376, 12.376, 12.424, 4.112, 4.144, 0, 0, 0, 0, 0, 12.424, 8.264),
    *(8.24, 4.144, 8.264, 8.24, 12.376, 12.376, 8.264),
)

MODELS: Mapping[str, _Model] = MappingProxyType(
    {
        "pandar40p": _Model(
            name="Pandar40P", blocks=10, channels=40, header=0, mode=1254, time=1250, date=1256,
            first_us=-28.58, step_us=55.56, channel_us=tuple(-value for value in _40P_US), length=1262,
            angles_deg=tuple(zip(_40P_ELEVATIONS, _40P_AZIMUTHS, strict=True)),
        ),
        "pandar64": _Model(
            name="Pandar64", blocks=6, channels=64, header=8, mode=1186, time=1182, date=1188,
            first_us=-42.58, step_us=55.56, channel_us=tuple(-value for value in _64_US), length=1194,
            angles_deg=tuple(zip(_64_ELEVATIONS, _64_AZIMUTHS, strict=True)),
        ),
        "xt16": _Model(
            name="PandarXT-16", blocks=8, channels=16, header=12, mode=550, time=559, date=553,
            first_us=5.632, step_us=50.0, channel_us=tuple(0.368 + 3.024 * k for k in range(16)), length=564,
            angles_deg=tuple((15.0 - 2 * k, 0.0) for k in range(16)),
        ),
        "xt32": _Model(
            name="PandarXT-32", blocks=8, channels=32, header=12, mode=1062, time=1071, date=1065,
            first_us=5.632, step_us=50.0, channel_us=tuple(0.368 + 1.512 * k for k in range(32)), length=1076,
            angles_deg=tuple((15.0 - k, 0.0) for k in range(32)),
        ),
        "xt32m": _Model(
            name="PandarXT-32M2X", blocks=6, channels=32, header=12, mode=802, time=811, date=805,
            first_us=5.632, step_us=50.0, channel_us=tuple(0.368 + 2.888 * (k % 16) for k in range(32)), length=816,
            angles_deg=tuple((round(19.5 - 1.3 * k, 1), 0.0) for k in range(32)),
        ),
        "qt64": _Model(
            name="PandarQT-64", blocks=4, channels=64, header=12, mode=1060, time=1056, date=1062,
            first_us=25.71, step_us=-500 / 3, channel_us=_QT_US, length=1068,
            angles_deg=tuple(zip(_QT_ELEVATIONS, _QT_AZIMUTHS, strict=True)),
        ),
        "ot128": _Model(
            name="OT128", blocks=2, channels=128, header=12, mode=817, time=826, date=820,
            first_us=43.346, step_us=2 * 27.778, channel_us=_OT_US, length=831, fine_us=_OT_FINE_US, longest_tail=62,
        ),
        "at128": _Model(
            name="AT128", blocks=2, channels=128, header=12, mode=1070, time=1066, date=1072,
            first_us=-9.249 - 41.666, step_us=41.666, channel_us=_AT_US, length=1078,
        ),
    }
)  # fmt: skip
"""The models by the names that `--input-option model=` takes."""


@dataclass(frozen=True, slots=True, eq=False)
class AtCorrection:
    """The file of angles of an AT128, in 1/25600 degree.

    Attributes:
        starts: (M,) int64, azimuth of the encoder at which each side of the mirror begins.
        angles: (128, 2) int64, elevation and azimuth of each channel.
        adjustments: (2, 128, 180) float32 [0.01 degree], of elevation and azimuth, every 2 degrees of the encoder.
    """

    starts: Int64Array
    angles: Int64Array
    adjustments: Float32Array


@dataclass(frozen=True, eq=False)
class HesaiDecoder:
    """Decodes packets of one model.

    Attributes:
        key: of the model in `MODELS`.
        angles_deg: (C, 2) float64, elevation and azimuth of each channel; not of AT128.
        correction: of an AT128, else None.
    """

    key: str
    angles_deg: AnyArray
    correction: AtCorrection | None = None

    clock_ns = 0

    @property
    def model(self) -> str:
        """The maker's name for the device."""
        return f"Hesai {MODELS[self.key].name}"

    def _body(self, packets: UInt8Array) -> AnyArray:
        """The blocks of packets, (P, L) uint8, as (P, B) records of flag, azimuth, fine and values."""
        model = MODELS[self.key]
        unit = [("distance", "<u2"), ("reflectivity", "u1")]
        if model.header == _LONG_HEADER and not model.fine_us:
            unit.append(("more", "u1"))
        head = [("azimuth", "<u2")] if model.header else [("flag", "<u2"), ("azimuth", "<u2")]
        if self.correction is not None:
            head.append(("fine", "u1"))
        block = np.dtype([*head, ("values", np.dtype(unit), model.channels)])
        stop = model.header + model.blocks * block.itemsize
        found: AnyArray = np.ascontiguousarray(packets[:, model.header : stop]).view(block)
        return found

    def _azimuths(self, body: AnyArray) -> Int64Array:
        """Azimuths of blocks in 0.01 degree, or 1/25600 degree of an AT128, (P, B) int64."""
        azimuths = body["azimuth"].astype(np.int64)
        if self.correction is not None:
            azimuths = azimuths * _FINE + body["fine"]
        return np.asarray(azimuths)

    def _returns(self, packets: UInt8Array) -> Int64Array:
        """How many returns a firing of each packet has, (P,) int64."""
        table = np.ones(256, np.int64)
        table[list(_RETURNS)] = list(_RETURNS.values())
        return np.asarray(table[packets[:, MODELS[self.key].mode]])

    def _block_times_ns(self, packets: UInt8Array) -> Int64Array:
        """Times of blocks, (P, B) int64 [ns], to which those of the channels are added."""
        model = MODELS[self.key]
        numbers, returns = np.arange(model.blocks), self._returns(packets)[:, None]
        steps = (model.blocks - 1 - numbers) // returns if model.step_us > 0 else numbers // returns
        offsets = np.rint((model.first_us - abs(model.step_us) * steps * np.sign(model.step_us)) * 1000)
        microseconds = np.ascontiguousarray(packets[:, model.time : model.time + 4]).view("<u4").astype(np.int64)
        seconds = utc_seconds(packets[:, model.date : model.date + 6])
        return np.asarray(seconds[:, None] * 1_000_000_000 + microseconds * 1000 + offsets.astype(np.int64))

    def survey(self, packets: UInt8Array) -> Survey:
        """Look at packets, (P, L) uint8. A rotation of an AT128 is what one side of its mirror sweeps."""
        model = MODELS[self.key]
        body = self._body(packets)
        azimuths = self._azimuths(body)
        if self.correction is None:
            phases, usable = azimuths / 36000.0, (body["azimuth"] <= 36000).all(axis=1)
        else:
            sides = len(self.correction.starts)
            phases = (azimuths - int(self.correction.starts[0])) / (36000.0 * _FINE) * sides
            usable = (body["azimuth"] <= 36000).all(axis=1)
        if model.header:
            usable &= _named(packets, model)
        else:
            usable &= (body["flag"] == int.from_bytes(_BLOCK_START, "little")).all(axis=1)
        if self.correction is None:
            usable &= packets[:, model.date + 1] <= 12
        return Survey(self._block_times_ns(packets), phases, np.asarray(usable, np.bool_))

    def points(self, packets: UInt8Array, shifts_ns: Int64Array, blocks: BoolArray) -> LidarPoints:
        """Decode the returns of packets, (P, L) uint8; of equal returns of a firing one counts."""
        from sceneloom.kernels.packed import place_polar

        model = MODELS[self.key]
        body = self._body(packets)
        raw, intensities = (np.ascontiguousarray(body["values"][name]) for name in ("distance", "reflectivity"))
        returns = self._returns(packets)[:, None]
        number = (np.arange(model.blocks) % returns).ravel()
        unit_mm = packets[:, model.header - 3] if model.header else np.full(len(packets), 4)
        unit_m = unit_mm.astype(np.float32) * np.float32(0.001)
        most = raw.size
        positions, rings = np.empty((most, 3), np.float32), np.empty(most, np.uint16)
        stamps_ns, block = np.empty(most, np.int64), np.empty(most, np.int64)
        reflected = np.empty(most, np.uint8)
        units_m = np.repeat(unit_m, model.blocks)
        times_ns = (self._block_times_ns(packets) + shifts_ns[:, None]).ravel()
        channels_ns = np.rint(np.array(model.channel_us) * 1000).astype(np.int64)
        azimuths, offsets, elevations = self._angles(self._azimuths(body).ravel())
        steps, weights = self._steps(self._azimuths(body).ravel())
        distances, reflectivities = (values.reshape(-1, model.channels) for values in (raw, intensities))
        count = place_polar(
            blocks.ravel(), number, distances, reflectivities, units_m, azimuths, offsets, elevations,
            times_ns, channels_ns, self._adjusted, steps, weights, positions, reflected, stamps_ns, rings, block,
        )  # fmt: skip
        if model.fine_us:
            sooner_ns = np.rint((np.array(model.fine_us) - np.array(model.channel_us)) * 1000).astype(np.int64)
            fine = packets[:, model.mode - 1] == 0
            stamps_ns[:count] += fine[block[:count] // model.blocks] * sooner_ns[rings[:count]]
        extras = {}
        if int(returns.max(initial=1)) > 1:
            extras["return_number"] = (number + 1).astype(np.uint8).take(block[:count])
        return LidarPoints(
            positions[:count],
            reflected[:count],
            timestamps_ns=stamps_ns[:count],
            rings=rings[:count],
            extras=MappingProxyType(extras),
        )

    def _angles(self, azimuths: Int64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Azimuths of blocks (M,), offsets and elevations of channels (C,) [rad], counter-clockwise from x (right)."""
        if self.correction is None:
            turned, angles, sign = np.deg2rad(azimuths / 100.0), np.deg2rad(self.angles_deg), -1.0
        else:
            table = self.correction
            side = (np.searchsorted(table.starts, azimuths, side="right") - 1) % len(table.starts)
            turned = (azimuths - table.starts[side]) * 2 % (36000 * _FINE) * _AT_UNIT
            angles, sign = table.angles * _AT_UNIT, 1.0
        # from x, which is right of azimuth 0
        around: Float64Array = np.pi / 2 - turned
        offsets: Float64Array = np.ascontiguousarray(angles[:, 1] * sign)
        return around, offsets, np.ascontiguousarray(angles[:, 0])

    @cached_property
    def _adjusted(self) -> Float32Array:
        """Adjustments of elevation and azimuth every 2 degrees, (2, S, C) [rad], as `_angles` counts; or (2, 0, C)."""
        if self.correction is None:
            return np.zeros((2, 0, MODELS[self.key].channels), np.float32)
        up, aside = self.correction.adjustments * np.float32(_FINE * _AT_UNIT)
        return np.ascontiguousarray(np.stack((up.T, -aside.T)))

    def _steps(self, azimuths: Int64Array) -> tuple[Int64Array, Float32Array]:
        """Which adjustment is before each block (M,), and how much of the way to the next it is (M,)."""
        at, part = np.divmod(azimuths % (36000 * _FINE), _ADJUSTED_EVERY)
        return at % max(self._adjusted.shape[1], 1), (part / _ADJUSTED_EVERY).astype(np.float32)


def _named(packets: UInt8Array, model: _Model) -> BoolArray:
    """Which packets, (P, L) uint8, have a header with this model's channels and blocks, (P,)."""
    at = model.header - 6
    found = (packets[:, :2] == tuple(_START)).all(axis=1)
    return np.asarray(found & (packets[:, at : at + 2] == (model.channels, model.blocks)).all(axis=1))


def recognise(packets: UInt8Array) -> str | None:
    """The key of the model whose packets these, (P, L) uint8, are; None where it is none of `MODELS`."""
    length = packets.shape[1]
    for key, model in MODELS.items():
        if not model.length <= length <= model.length + model.longest_tail:
            continue
        if model.header:
            found = _named(packets, model)
        else:
            found = (packets[:, :2] == tuple(_BLOCK_START)).all(axis=1)
            found &= (packets[:, 124:126] == tuple(_BLOCK_START)).all(axis=1)
        if found.mean() > 0.5:
            return key
    return None


def decoder_of(key: str, angles: Path | None, state: UInt8Array | None = None) -> HesaiDecoder:
    """What decodes packets of a model, with the sensor's file of angles, or the angles of the manual.

    Raises:
        DataError: the file is none, or an AT128 has none.
    """
    del state
    model = MODELS[key]
    if key == "at128":
        if angles is None:
            problem = "expected the angle correction file of this AT128, as `--input-option angles=FILE.dat`"
            raise DataError("", "", problem)
        return HesaiDecoder(key, np.zeros((0, 2)), read_at_correction(angles))
    if angles is None:
        if not model.angles_deg:
            raise DataError("", "", f"expected the angles of this {model.name}, as `--input-option angles=FILE.csv`")
        return HesaiDecoder(key, np.array(model.angles_deg))
    return HesaiDecoder(key, angle_table(angles, model.channels))


def read_at_correction(path: Path) -> AtCorrection:
    """Read the angle correction file of an AT128, version 1.5.

    Raises:
        DataError: it is none, or cut off.
    """
    content = read_settings(path)
    begin = max(content.find(_START), 0)
    head = content[begin : begin + 16]
    if len(head) < 16 or not head.startswith(_START) or head[3] != 5 or head[4] != 128 or not 0 < head[5] <= 8:
        raise DataError(path, f"byte {begin}", "expected EE FF 01 05, 128 channels and up to 8 sides of a mirror")
    sides, unit = head[5], head[15]
    layout = np.dtype(
        [("starts", "<u4", sides), ("ends", "<u4", sides), ("azimuths", "<i4", 128), ("elevations", "<i4", 128),
         ("azimuth_adjustments", "i1", (128, 180)), ("elevation_adjustments", "i1", (128, 180))]
    )  # fmt: skip
    if len(content) < begin + 16 + layout.itemsize:
        raise DataError(path, "", f"{len(content)} bytes; expected {begin + 16 + layout.itemsize} or more")
    record: Any = np.frombuffer(content, layout, 1, begin + 16)[0]
    starts = record["starts"].astype(np.int64) * unit
    if (np.diff(starts) <= 0).any():
        raise DataError(path, "", f"sides of the mirror begin at {starts.tolist()}; expected growing angles")
    angles = np.stack((record["elevations"], record["azimuths"]), axis=1).astype(np.int64) * unit
    adjustments = np.stack((record["elevation_adjustments"], record["azimuth_adjustments"])).astype(np.float32)
    return AtCorrection(starts, angles, adjustments * np.float32(unit))
