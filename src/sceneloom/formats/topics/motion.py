"""What a log reports the ego's own motion: ways, satellite fixes, inertial measurements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.formats.topics.locations import Locations
from sceneloom.formats.topics.records import FixRecord, PoseRecord, SampleRecord
from sceneloom.formats.topics.survey import Survey
from sceneloom.formats.topics.timestamps import in_order
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, rotate_vectors
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.warnings import WarningKind

_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Messages have covariances of location, then rotate; trajectories of rotation, then location."""

_VECTORS = frozenset({"accelerometer", "gyroscope", "magnetometer"})


@dataclass(frozen=True, slots=True, eq=False)
class PoseRows:
    """The poses of a topic, in order.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64, or None where some are not stated.
        covariances: (N, 6, 6) float64 as trajectories have them, or None.
        frame_id, body: the frames that the first one names.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array | None
    covariances: Float64Array | None
    frame_id: str
    body: str


def pose_rows(survey: Survey, name: str, records: Sequence[PoseRecord]) -> PoseRows | None:
    """Bring the poses of a topic into order; None where there are none.

    Raises:
        DataError: one of them is none.
    """
    location = f"{survey.log.name}: {name}"
    kept = []
    for k, record in enumerate(records):
        fault = _pose_fault(record)
        if fault is None:
            kept.append(record)
        else:
            survey.ledger.fault("poses-at-fault", DataError(survey.log.name, f"{name}[{k}]", fault))
    if not kept:
        return None
    rows = in_order(np.array([record.timestamp_ns for record in kept], np.int64), location, survey.ledger)
    chosen = [kept[row] for row in rows.tolist()]
    rotations = [record.quaternion_xyzw for record in chosen]
    spreads = [record.covariance for record in chosen]
    quaternions = [rotation for rotation in rotations if rotation is not None]
    covariances = [spread for spread in spreads if spread is not None]
    if 0 < len(quaternions) < len(chosen):
        message = "poses with and without orientation; none of the orientations is used"
        survey.ledger.note(
            WarningKind.SKIPPED, "orientations-missing", location, message, count=len(quaternions)
        )
    return PoseRows(
        np.array([record.timestamp_ns for record in chosen], np.int64),
        np.array([record.position for record in chosen]),
        np.array(quaternions) if len(quaternions) == len(chosen) else None,
        np.array(covariances)[:, _ROTATION_FIRST][:, :, _ROTATION_FIRST]
        if len(covariances) == len(chosen)
        else None,
        chosen[0].frame_id,
        chosen[0].body,
    )


def _pose_fault(record: PoseRecord) -> str | None:
    if not np.isfinite(record.position).all():
        return f"position {record.position.tolist()}; expected finite numbers"
    if record.quaternion_xyzw is None:
        return None
    norms, wrong = lengths_of(record.quaternion_xyzw[None])
    if wrong[0]:
        return (
            f"orientation {record.quaternion_xyzw.tolist()} of length {norms[0]:.4g}; expected 1 within 0.01"
        )
    return None


def trajectory(name: str, rows: PoseRows, locations: Locations, survey: Survey) -> Trajectory:
    """The ego trajectory that a topic reports, if need be through the frame of the body that it is of."""
    location = f"{survey.log.name}: {name}"
    ego = locations.roles.ego
    body_from_ego = None
    if rows.body and ego is not None and rows.body != ego:
        mount = locations.mount(rows.body)
        if mount is None:
            message = (
                f"poses of frame {rows.body!r}, which is not connected with {ego!r}, are taken for the ego's"
            )
            survey.ledger.note(WarningKind.ASSUMED, "pose-of-other-body", location, message)
        else:
            body_from_ego = mount.inverse()
    positions, quaternions = rows.positions, rows.quaternions_xyzw
    if body_from_ego is not None and quaternions is not None:
        positions = rotate_vectors(quaternions, body_from_ego.translation) + positions
        quaternions = multiply_quaternions(quaternions, body_from_ego.quaternion_xyzw)
    return Trajectory(
        name,
        read_only(rows.timestamps_ns),
        read_only(positions),
        None if quaternions is None else read_only(quaternions),
        covariances=None if rows.covariances is None else read_only(rows.covariances),
    )


def gnss_sensor(
    sensor_id: str | int, records: Sequence[FixRecord], survey: Survey, location: str, **fields: Any
) -> GnssSensor:
    """A satellite receiver from its fixes; those without reception are left out."""
    received = [record for record in records if record.received]
    if len(received) < len(records):
        count = len(records) - len(received)
        survey.ledger.note(
            WarningKind.SKIPPED, "no-reception", location, "fixes without reception", count=count
        )
    rows = in_order(np.array([record.timestamp_ns for record in received], np.int64), location, survey.ledger)
    chosen = [received[row] for row in rows.tolist()]
    unknown = (np.nan, np.nan, np.nan)
    variances = np.array([record.variances or unknown for record in chosen]).reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        deviations = np.sqrt(np.where(variances >= 0, variances, np.nan))
        equal = deviations[:, 0] == deviations[:, 1]
        level = np.where(equal, deviations[:, 0], np.sqrt((variances[:, 0] + variances[:, 1]) / 2))
    return GnssSensor(
        sensor_id,
        read_only(np.array([record.timestamp_ns for record in chosen], np.int64)),
        read_only(np.array([record.lla for record in chosen], np.float64).reshape(-1, 3)),
        read_only(level),
        read_only(deviations[:, 2]),
        **fields,
    )


def imu_sensor(
    sensor_id: str | int,
    records: Sequence[SampleRecord],
    survey: Survey,
    location: str,
    ego_from_imu: RigidTransform | None = None,
    **fields: Any,
) -> ImuSensor:
    """An inertial unit from its samples, in the axes of the ego where these are known."""
    by_stream: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
    for record in records:
        for name, values in record.values.items():
            by_stream.setdefault(name, []).append((record.timestamp_ns, values))
    rotation = None if ego_from_imu is None else ego_from_imu.rotation
    if rotation is not None and np.array_equal(rotation, np.eye(3)):
        rotation = None
    if rotation is not None:
        message = "measurements were converted to the axes of the ego; that the unit sits elsewhere is not accounted for"
        survey.ledger.note(WarningKind.ASSUMED, "imu-rotated", location, message)
    streams: Mapping[str, VectorSamples] = MappingProxyType(
        {name: _stream(name, rows, rotation, survey, location) for name, rows in by_stream.items()}
    )
    return ImuSensor(sensor_id, streams, **fields)


def _stream(
    name: str,
    rows: Sequence[tuple[int, tuple[float, ...]]],
    rotation: Float64Array | None,
    survey: Survey,
    location: str,
) -> VectorSamples:
    widths = {len(values) for _, values in rows}
    if len(widths) > 1:
        raise DataError(
            survey.log.name, location, f"{name} of {sorted(widths)} values; expected as many each time"
        )
    order = in_order(np.array([time for time, _ in rows], np.int64), f"{location}.{name}", survey.ledger)
    values = np.array([rows[row][1] for row in order.tolist()], np.float64).reshape(len(order), -1)
    if rotation is not None and name in _VECTORS and values.shape[1] == 3:
        values = values @ rotation.T
    return VectorSamples(
        read_only(np.array([rows[row][0] for row in order.tolist()], np.int64)), read_only(values)
    )
