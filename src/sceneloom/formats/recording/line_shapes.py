"""The shapes of the lines in `data.jsonl`, as the JSON decoder checks them.

Each shape comes twice. The exact one knows all keys that it may have and takes none as `null`, so that what it holds
can be written again as it was; nearly all lines fit one, and decoding into it is fastest. The open one takes further
keys, for lines whose text is then kept beside what is read from it.

Source: "JSONL format" of the recording format's description; the key names are the format's own.
"""

from collections.abc import Sequence
from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, Raw, Struct, UnsetType

from sceneloom.formats.recording.columns import FARTHEST_TIME

Seconds = Annotated[float, Meta(ge=-FARTHEST_TIME, le=FARTHEST_TIME)]
Metres = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""A position; the bounds keep the arithmetic with it from overflowing."""

SensorIndex = Annotated[int, Meta(ge=0, le=254)]
FrameNumber = Annotated[int, Meta(ge=-(2**60), le=2**60)]


class Point(Struct, gc=False):
    """`position`."""

    x: Metres
    y: Metres
    z: Metres


class ExactPoint(Point, forbid_unknown_fields=True, gc=False):
    """`position` and nothing else."""


class Quaternion(Struct, gc=False):
    """`orientation`."""

    x: float
    y: float
    z: float
    w: float


class ExactQuaternion(Quaternion, forbid_unknown_fields=True, gc=False):
    """`orientation` and nothing else."""


class Pose(Struct, gc=False):
    """Where the device was: `groundTruth` or the output of a method."""

    position: Point
    orientation: Quaternion | None = None


class ExactPose(Pose, forbid_unknown_fields=True, gc=False):
    """A pose and nothing else."""

    position: ExactPoint
    orientation: ExactQuaternion | UnsetType = UNSET  # type: ignore[assignment]


class NamedPose(Pose, gc=False):
    """`pose`: the output of the method that it names."""

    name: str | None = None


class ExactNamedPose(NamedPose, forbid_unknown_fields=True, gc=False):
    """A named pose and nothing else."""

    position: ExactPoint
    orientation: ExactQuaternion | UnsetType = UNSET  # type: ignore[assignment]
    name: str | UnsetType = UNSET  # type: ignore[assignment]


class SensorSample(Struct, gc=False):
    """`sensor`: one sample of an N-axis sensor."""

    type: str
    values: list[float]


class ExactSensorSample(SensorSample, forbid_unknown_fields=True, gc=False):
    """A sample and nothing else."""


class GnssFix(Struct, gc=False):
    """`gps`: degrees and metres."""

    latitude: float
    longitude: float
    altitude: float
    accuracy: float | None = None
    verticalAccuracy: float | None = None  # noqa: N815 - the format's own word


class ExactGnssFix(GnssFix, forbid_unknown_fields=True, gc=False):
    """A fix and nothing else."""

    accuracy: float | UnsetType = UNSET  # type: ignore[assignment]
    verticalAccuracy: float | UnsetType = UNSET  # type: ignore[assignment]  # noqa: N815 - the format's own word


class Pressure(Struct, gc=False):
    """`barometer`: the pressure of the air."""

    pressureHectopascals: float  # noqa: N815 - the format's own word


class ExactPressure(Pressure, forbid_unknown_fields=True, gc=False):
    """A pressure and nothing else."""


class Sweep(Struct, gc=False):
    """`lidar`: one file of points."""

    model: str
    dataFile: str  # noqa: N815 - the format's own word
    lidarInd: SensorIndex = 0  # noqa: N815 - as `cameraInd`; our extension for several lidars


class ExactSweep(Sweep, forbid_unknown_fields=True, gc=False):
    """A sweep and nothing else; the first lidar's index is not written."""

    lidarInd: Annotated[int, Meta(ge=1, le=254)] | UnsetType = UNSET  # type: ignore[assignment]  # noqa: N815


class FrameEntry(Struct, gc=False):
    """One camera's part of a `frames` line."""

    cameraInd: SensorIndex  # noqa: N815 - the format's own word
    time: Seconds | None = None
    cameraParameters: Raw = Raw()  # noqa: N815 - the format's own word
    imuToCamera: Raw = Raw()  # noqa: N815 - the format's own word
    missingBitmap: bool = False  # noqa: N815 - the format's own word


class ExactFrameEntry(FrameEntry, forbid_unknown_fields=True, gc=False):
    """An entry and nothing else."""

    time: Seconds | UnsetType = UNSET  # type: ignore[assignment]
    missingBitmap: bool | UnsetType = UNSET  # type: ignore[assignment]  # noqa: N815 - the format's own word


class Line(Struct, kw_only=True, gc=False):
    """A line, whatever else may be in it."""

    time: Seconds | None = None
    sensor: SensorSample | None = None
    gps: GnssFix | None = None
    groundTruth: Pose | None = None  # noqa: N815 - the format's own word
    pose: NamedPose | None = None
    lidar: Sweep | None = None
    barometer: Pressure | None = None
    frames: Sequence[FrameEntry] | None = None
    number: FrameNumber | None = None


class FrequentLine(Struct, kw_only=True, forbid_unknown_fields=True, gc=False):
    """What most lines are: the fewer fields a shape has, the sooner it is clear that a line has none but one."""

    time: Seconds
    sensor: ExactSensorSample | UnsetType = UNSET
    groundTruth: ExactPose | UnsetType = UNSET  # noqa: N815 - the format's own word
    frames: Sequence[ExactFrameEntry] | UnsetType = UNSET
    number: FrameNumber | UnsetType = UNSET


class ExactLine(FrequentLine, kw_only=True, forbid_unknown_fields=True, gc=False):
    """A line that the columns can hold."""

    gps: ExactGnssFix | UnsetType = UNSET
    pose: ExactNamedPose | UnsetType = UNSET
    lidar: ExactSweep | UnsetType = UNSET
    barometer: ExactPressure | UnsetType = UNSET


ROOT_KEYS = frozenset(field.name for field in msgspec.structs.fields(Line))
"""The keys at the root of a line that have a shape of their own."""

RECORD_KEYS = ROOT_KEYS - {"time", "number"}
"""Those of them that state what a line is about."""
