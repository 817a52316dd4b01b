"""What is told of the conventions of a calibration and a drive."""

import msgspec

from sceneloom.calibrate.conventions.deciding import Decision
from sceneloom.scene import Notice


class ExtrinsicFound(msgspec.Struct, frozen=True, kw_only=True):
    """What one extrinsic means.

    Attributes:
        place: where it stands in its file, or which sensors it relates.
        camera, lidar: the sensors of the drive that it was judged by; None where there was no drive.
        possible: of direction, layout, order, unit and axes, whichever the extrinsic leaves open, all values that are
            possible.
        decided: whether the transform is known.
        as_read: whether it is what the drive was read with; None where that is not known, or it was no drive's own.
        camera_from_lidar: (4, 4) by rows, from the points' frame into x right, y down, z forward; None: not decided.
        reason: why it was decided so, or why not.
    """

    place: str
    camera: str | int | None
    lidar: str | int | None
    possible: dict[str, tuple[str, ...]]
    decided: bool
    as_read: bool | None
    camera_from_lidar: list[list[float]] | None
    reason: str


class PointsFound(msgspec.Struct, frozen=True, kw_only=True):
    """In which frames the points of a lidar can be.

    Attributes:
        lidar: the sensor.
        stated: the frame that they were read in.
        possible: all that the drive does not rule out; none where nothing tells.
    """

    lidar: str | int
    stated: str
    possible: tuple[str, ...]


class TimesFound(msgspec.Struct, frozen=True, kw_only=True):
    """In which units the stamps of a sensor, as seconds, can be.

    Attributes:
        sensor: the sensor.
        kind: lidar, camera, radar, imu or gnss.
        possible: units in which such a sensor measures at a rate that there is; ("seconds",) where all is well.
    """

    sensor: str | int
    kind: str
    possible: tuple[str, ...]


class ConventionsReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a calibration file and a drive tell of their conventions.

    Attributes:
        source: the file or drive.
        extrinsics: what each one means.
        points: the frames of the points, of a drive.
        times: the units of the stamps, of a drive.
        corrections: what was made of the drive's corrections before.
    """

    source: str
    extrinsics: tuple[ExtrinsicFound, ...]
    points: tuple[PointsFound, ...] = ()
    times: tuple[TimesFound, ...] = ()
    corrections: tuple[Notice, ...] = ()

    @property
    def wrong(self) -> bool:
        """Whether something of the drive is not what it was read as."""
        return (
            any(found.as_read is False for found in self.extrinsics)
            or any(found.possible and found.stated not in found.possible for found in self.points)
            or any(found.possible and "seconds" not in found.possible for found in self.times)
        )


def extrinsic_found(
    decision: Decision,
    *,
    camera: str | int | None = None,
    lidar: str | int | None = None,
    as_read: bool | None = None,
) -> ExtrinsicFound:
    """Put a decision into the report."""
    matrix = decision.camera_from_points
    return ExtrinsicFound(
        place=decision.place,
        camera=camera,
        lidar=lidar,
        possible=dict(decision.possible),
        decided=decision.decided,
        as_read=as_read,
        camera_from_lidar=None if matrix is None else matrix.tolist(),
        reason=decision.reason,
    )
