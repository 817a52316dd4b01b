"""The properties that every fusion system has: table 2, and the extensions that its gaps ask for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from sceneloom.detections.detector_files import DEFAULT, detector_names
from sceneloom.errors import CalibrationError, DataError
from sceneloom.fusion.calibration.axes import DeclaredAxes
from sceneloom.fusion.calibration.entries import parse_calibrations
from sceneloom.fusion.properties.sensors import parse_sensors

Check = Callable[[Any], object]
"""Raises DataError or CalibrationError for a value of the right type that the property cannot take."""


@dataclass(frozen=True, slots=True)
class PredefinedProperty:
    """A property that is there from the start.

    Attributes:
        name: of the property.
        description: what it sets, for people.
        type: as in table 1, or a tuple of such.
        default: its value at the start.
        unit: of the value, or "".
        check: what else the value has to fulfil, or None.
        source: the row of table 2, or "extension".
    """

    name: str
    description: str
    type: str
    default: Any
    unit: str = ""
    check: Check | None = None
    source: str = "extension"


def _at_least(lowest: int) -> Check:
    def check(value: int) -> None:
        if value < lowest:
            raise DataError("", "", f"{value}; expected {lowest} or more")

    return check


def _not_negative(value: float) -> None:
    if value < 0:
        raise DataError("", "", f"{value:g}; expected 0 or more")


def _one_of(*names: str) -> Check:
    def check(value: str) -> None:
        if value not in names:
            raise DataError("", "", f"{value!r}; expected one of {', '.join(names)}")

    return check


def _triple(value: tuple[int, ...]) -> None:
    DeclaredAxes.of_triple(value, left_handed=False)


def _words(value: str) -> None:
    if value:
        DeclaredAxes.of_words(value)


def _filled(value: str) -> None:
    if not value.strip():
        raise DataError("", "", "an empty name; expected the name of an algorithm")


def _detectors(value: str) -> None:
    _one_of(*detector_names())(value)


PREDEFINED: Mapping[str, PredefinedProperty] = MappingProxyType(
    {
        row.name: row
        for row in (
            PredefinedProperty(
                "fusion_type",
                "which fusion a get without a type returns and a set of fusion_algorithm concerns: "
                "0 sensor data, 1 detections; both run whenever their inputs come",
                "bool",
                0,
                source="table 2, row 1",
            ),
            PredefinedProperty(
                "chirality",
                "0: the declared frames are right-handed, 1: left-handed",
                "bool",
                0,
                source="table 2, row 2",
            ),
            PredefinedProperty(
                "camera_coordinate",
                "axes of the camera frame that point forward, right and up: 0, 1, 2 for x, y, z, negative for the "
                "opposite direction; the direction of axis 0 follows from chirality",
                "(int8, int8, int8)",
                (2, 0, -1),
                check=_triple,
                source="table 2, row 3",
            ),
            PredefinedProperty(
                "lidar_coordinate",
                "the same of the lidar frame",
                "(int8, int8, int8)",
                (0, -1, 2),
                check=_triple,
                source="table 2, row 4",
            ),
            PredefinedProperty(
                "camera_frequency",
                "images a second",
                "uint32",
                10,
                unit="Hz",
                check=_at_least(1),
                source="table 2, row 5",
            ),
            PredefinedProperty(
                "lidar_frequency",
                "sweeps a second",
                "uint32",
                10,
                unit="Hz",
                check=_at_least(1),
                source="table 2, row 6",
            ),
            PredefinedProperty(
                "fusion_algorithm",
                "name of the algorithm of the fusion that fusion_type says; each type keeps its own",
                "string",
                "projection",
                check=_filled,
                source="table 2, row 7",
            ),
            PredefinedProperty(
                "camera_axes",
                "axes of the camera frame that point forward, right and up, in plain words as +z,+x,-y; "
                "counts before camera_coordinate and chirality unless empty",
                "string",
                "",
                check=_words,
            ),
            PredefinedProperty("lidar_axes", "the same of the lidar frame", "string", "", check=_words),
            PredefinedProperty(
                "sensors",
                'what each sensor_id is and what its raw data (table 4) hold, as JSON: {"0": {"kind": "lidar", '
                '"raw": "records"}, "1": {"kind": "camera", "raw": "jpeg"}}; of a lidar also body_from_lidar, its '
                "mounting on the body whose trajectory SendMotion reports; of a camera shutter_roll_s and "
                "shutter_left_to_right, its rolling shutter; empty: reported by what is sent",
                "string",
                "",
                check=parse_sensors,
            ),
            PredefinedProperty(
                "calibration",
                "all calibrations, as a JSON list of the records of table 3, each with its camera_id and lidar_id; "
                "setting it replaces them all",
                "string",
                "",
                check=parse_calibrations,
            ),
            PredefinedProperty(
                "reference_frame",
                "frame of the points in results of table 9: 0 camera, 1 lidar",
                "bool",
                1,
            ),
            PredefinedProperty(
                "depth_kind",
                "what image_depth holds: z along the optical axis, or range along the ray",
                "string",
                "z",
                check=_one_of("z", "range"),
            ),
            PredefinedProperty(
                "motion_compensation",
                "1: the vehicle's motion is taken into account where it is known, 0: never",
                "bool",
                1,
            ),
            PredefinedProperty(
                "pairing_tolerance_ms",
                "how far an image may be from a sweep; 0: half a period of lidar_frequency and half a period of "
                "camera_frequency",
                "double",
                0.0,
                unit="ms",
                check=_not_negative,
            ),
            PredefinedProperty(
                "pairing_timeout_ms",
                "how late an image may come and still be waited for, on the clock of the data, and how long a box "
                "that came alone waits for others of its frame",
                "uint32",
                100,
                unit="ms",
            ),
            PredefinedProperty(
                "queue_length",
                "records of one kind and one sensor that may wait to be fused, and for their partners",
                "uint32",
                32,
                check=_at_least(1),
            ),
            PredefinedProperty(
                "queue_policy",
                "what happens to a record that finds its queue full: drop-oldest makes room, refuse answers 0",
                "string",
                "drop-oldest",
                check=_one_of("drop-oldest", "refuse"),
            ),
            PredefinedProperty(
                "result_queue_length",
                "results that may wait to be fetched, of each fusion type; the oldest are dropped and counted",
                "uint32",
                32,
                check=_at_least(1),
            ),
            PredefinedProperty(
                "detectors",
                "how sure and how exact the detectors are taken to be, by the name of a set that comes with the "
                "package; of the algorithm projection of detections",
                "string",
                DEFAULT,
                check=_detectors,
            ),
        )
    }
)
"""By name, those of table 2 first, in its order.

Source: DB34/T 4101-2022, table 2; defaults are its examples, but for the algorithm, which names one that is built in.
"""

FAULTS = (DataError, CalibrationError)
"""What a check raises."""
