"""The shapes of the lines in `data.jsonl`, as the JSON decoder checks them.

Each shape comes twice. The exact one knows all keys that it may have, and nearly all lines fit one; decoding into it
is fastest. The open one takes further keys, for lines whose text is then kept beside what is read from it.

Source: "JSONL format" of the recording format's description; the key names are the format's own.
"""

from collections.abc import Sequence
from typing import Annotated

import msgspec
from msgspec import Meta, Raw, Struct

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
    orientation: ExactQuaternion | None = None


class NamedPose(Pose, gc=False):
    """`pose`: the output of the method that it names."""

    name: str | None = None


class ExactNamedPose(NamedPose, forbid_unknown_fields=True, gc=False):
    """A named pose and nothing else."""

    position: ExactPoint
    orientation: ExactQuaternion | None = None


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


class Sweep(Struct, gc=False):
    """`lidar`: one file of points."""

    model: str
    dataFile: str  # noqa: N815 - the format's own word
    lidarInd: SensorIndex = 0  # noqa: N815 - as `cameraInd`; our extension for several lidars


class ExactSweep(Sweep, forbid_unknown_fields=True, gc=False):
    """A sweep and nothing else."""


class FrameEntry(Struct, gc=False):
    """One camera's part of a `frames` line."""

    cameraInd: SensorIndex  # noqa: N815 - the format's own word
    time: Seconds | None = None
    cameraParameters: Raw = Raw()  # noqa: N815 - the format's own word
    imuToCamera: Raw = Raw()  # noqa: N815 - the format's own word
    missingBitmap: bool = False  # noqa: N815 - the format's own word


class ExactFrameEntry(FrameEntry, forbid_unknown_fields=True, gc=False):
    """An entry and nothing else."""


class Line(Struct, kw_only=True, gc=False):
    """A line, whatever else may be in it."""

    time: Seconds | None = None
    sensor: SensorSample | None = None
    gps: GnssFix | None = None
    groundTruth: Pose | None = None  # noqa: N815 - the format's own word
    pose: NamedPose | None = None
    lidar: Sweep | None = None
    frames: Sequence[FrameEntry] | None = None
    number: FrameNumber | None = None


class ExactLine(Line, kw_only=True, forbid_unknown_fields=True, gc=False):
    """A line that the columns can hold."""

    time: Seconds
    sensor: ExactSensorSample | None = None
    gps: ExactGnssFix | None = None
    groundTruth: ExactPose | None = None  # noqa: N815 - the format's own word
    pose: ExactNamedPose | None = None
    lidar: ExactSweep | None = None
    frames: Sequence[ExactFrameEntry] | None = None


ROOT_KEYS = frozenset(field.name for field in msgspec.structs.fields(Line))
"""The keys at the root of a line that have a shape of their own."""

RECORD_KEYS = ROOT_KEYS - {"time", "number"}
"""Those of them that say what a line is about."""
