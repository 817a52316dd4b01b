"""Rules about magnetometers, barometers and thermometers, and about sensors that hang."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sceneloom.checks.recordings.imu_values import magnitudes
from sceneloom.checks.recordings.streams import Kind, Stream, location, streams_of_kind
from sceneloom.checks.rule import Find, Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene.findings import Severity


@dataclass(frozen=True, slots=True)
class _Range:
    """What a sensor measures.

    Attributes:
        lowest, highest: of every sample.
        unit: of the format.
        others: for the usual sample, ranges that report another unit.
    """

    lowest: float
    highest: float
    unit: str
    others: tuple[tuple[float, float, str], ...]


_RANGES: Mapping[Kind, _Range] = MappingProxyType(
    {
        Kind.MAGNETOMETER: _Range(
            0.0,
            1000.0,
            "µT",
            (
                (5000.0, 500_000.0, "nanotesla"),
                (1000.0, 5000.0, "milligauss, or is there a magnet beside it"),
            ),
        ),
        Kind.BAROMETER: _Range(
            800.0,
            1200.0,
            "hPa",
            (
                (30_000.0, 120_000.0, "pascal"),
                (30.0, 120.0, "kilopascal"),
                (0.3, 1.2, "bar"),
                (225.0, 799.9, "millimetres of mercury, or was it higher than 1900 m"),
            ),
        ),
        Kind.TEMPERATURE: _Range(
            200.0, 400.0, "K", ((-60.0, 130.0, "degrees Celsius"), (130.0, 200.0, "degrees Fahrenheit"))
        ),
    }
)
_WEAKEST_FIELD = 5.0
"""The earth's field is 22 to 67 µT; a magnetometer far below it counts in another unit."""

_UNITS_OF_WEAK_FIELDS = ((0.1, 2.0, "gauss"), (1e-6, 1e-3, "tesla"))

REPEATED_SHARE = 0.01
REPEATED_SHARE_OF_PRESSURE = 0.2
"""A barometer's steps are coarse beside what changes from sample to sample."""

_FEWEST_FOR_A_SHARE = 20
_REPEATING: Mapping[Kind, float] = MappingProxyType(
    {
        Kind.ACCELEROMETER: REPEATED_SHARE,
        Kind.GYROSCOPE: REPEATED_SHARE,
        Kind.MAGNETOMETER: REPEATED_SHARE,
        Kind.GNSS: REPEATED_SHARE,
        Kind.BAROMETER: REPEATED_SHARE_OF_PRESSURE,
    }
)


def _out_of_range(kind: Kind) -> Find:
    def find(subject: Subject) -> Iterator[Hit]:
        limits = _RANGES[kind]
        for stream in streams_of_kind(subject, kind):
            values = magnitudes(stream) if kind is Kind.MAGNETOMETER else stream.values[:, 0]
            wrong = np.flatnonzero(~((values >= limits.lowest) & (values <= limits.highest)))
            if len(wrong):
                row = int(wrong[0])
                problem = (
                    f"{stream.at(row)} is {values[row]:.6g}; expected "
                    f"{limits.lowest:g} to {limits.highest:g} {limits.unit}"
                )
                guess = _other_unit(float(np.median(values)), limits.others)
                yield Hit(location(stream, row), f"{problem}{guess}", len(wrong))

    return find


def _other_unit(usual: float, others: tuple[tuple[float, float, str], ...]) -> str:
    return next((f": is it in {unit}?" for low, high, unit in others if low <= usual <= high), "")


def _weak_field(subject: Subject) -> Iterator[Hit]:
    yield from _out_of_range(Kind.MAGNETOMETER)(subject)
    for stream in streams_of_kind(subject, Kind.MAGNETOMETER):
        usual = float(np.median(magnitudes(stream)))
        if usual < _WEAKEST_FIELD:
            problem = f"the median length is {usual:.4g}; the earth's field is 22 to 67 µT"
            yield Hit(stream.whole, f"{problem}{_other_unit(usual, _UNITS_OF_WEAK_FIELDS)}")


def _hanging(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, *_REPEATING):
        if len(stream) < _FEWEST_FOR_A_SHARE:
            continue
        same = _repeated(stream)
        share = same.size / (len(stream) - 1)
        if share > _REPEATING[stream.kind]:
            row = int(same[0]) + 1
            problem = (
                f"{stream.at(row)} has the very values of the sample before, as have {share:.1%} of all; "
                f"expected at most {_REPEATING[stream.kind]:.0%}"
            )
            yield Hit(location(stream, row), problem)


def _repeated(stream: Stream) -> np.ndarray:
    """Which samples the next one repeats; of fixes the location counts."""
    values = stream.values[:, :3]
    return np.flatnonzero((values[1:] == values[:-1]).all(axis=1))


RULES: tuple[Rule, ...] = (
    Rule(
        "magnetometer-unit",
        Severity.WARNING,
        "The magnetic field is in µT: at most 1000, and its median at least 5.",
        "Write µT: 1000 nanotesla, 10 milligauss or 0.01 gauss each.",
        find=_weak_field,
    ),
    Rule(
        "barometer-unit",
        Severity.WARNING,
        "The pressure of the air is 800 to 1200 hPa.",
        "Write hPa: 100 pascal each.",
        find=_out_of_range(Kind.BAROMETER),
    ),
    Rule(
        "temperature-unit",
        Severity.WARNING,
        "The temperature of the IMU is 200 to 400 K.",
        "Write kelvin: degrees Celsius and 273.15.",
        find=_out_of_range(Kind.TEMPERATURE),
    ),
    Rule(
        "values-repeated",
        Severity.WARNING,
        "At most 1 % of samples of a sensor, and of fixes, have the very values of the one before; "
        "of a barometer's, 20 %.",
        "See whether the sensor hung, or samples were filled in to reach a rate that it does not have.",
        find=_hanging,
    ),
)
