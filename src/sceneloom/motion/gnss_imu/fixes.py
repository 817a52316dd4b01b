"""Fixes of satellite receivers in metres east, north and up of the first, as the smoother wants them."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.geometry.geodesy import ecef_from_geodetic, enu_from_geodetic
from sceneloom.motion.gnss_imu.settings import SmootherSettings
from sceneloom.motion.gnss_receivers import gnss_receivers, usable_fixes
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning, WarningKind

_FARTHEST = 100_000.0
"""Fixes farther than this from the one in the middle of all [m] are no locations of one drive."""
_VERTICAL = 1.7
"""Heights are worse by so much where the receiver does not report. Source: usual ratio of VDOP to HDOP."""
_UNKNOWN_HEIGHT = 1e5
_LEAST_SIGMA, _LARGEST_SIGMA = 1e-3, 1e4


@dataclass(frozen=True, slots=True, eq=False)
class GnssFixes:
    """All fixes of a drive.

    Attributes:
        timestamps_ns: (F,) int64 [ns], ascending.
        positions: (F, 3) [m] east, north, up of the origin.
        sigmas: (F, 3) [m], as reported or assumed.
        reported: (F,) bool, whether the receiver reported its accuracy.
        levers: (F, 3) [m], the antenna in the ego.
        receivers: (F,) int64, number of the receiver.
        origin_lla: (3,) latitude, longitude [deg], height [m].
        warnings: what was left out.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    sigmas: Float64Array
    reported: BoolArray
    levers: Float64Array
    receivers: Int64Array
    origin_lla: Float64Array
    warnings: tuple[DataWarning, ...]

    def __len__(self) -> int:
        return len(self.timestamps_ns)


def gnss_fixes(scene: Scene, settings: SmootherSettings) -> GnssFixes:
    """Gather the fixes of all receivers; there is at least one."""
    receivers = gnss_receivers(scene)
    rows = [_chosen(receiver) for receiver in receivers]
    times = np.concatenate([r.timestamps_ns[k] for r, k in zip(receivers, rows, strict=True)])
    locations = np.vstack([r.positions_lla[k] for r, k in zip(receivers, rows, strict=True)])
    sigmas = np.vstack([_sigmas(r, k, settings) for r, k in zip(receivers, rows, strict=True)])
    reported = np.concatenate([_is_reported(r.accuracies[k]) for r, k in zip(receivers, rows, strict=True)])
    levers = np.vstack([np.tile(_lever(r), (len(k), 1)) for r, k in zip(receivers, rows, strict=True)])
    number = np.repeat(np.arange(len(receivers)), [len(k) for k in rows])
    flat = np.where(np.isfinite(locations[:, 2]), locations[:, 2], 0.0)
    locations = np.column_stack([locations[:, :2], flat])
    ecef = ecef_from_geodetic(locations)
    # the median itself may lie where there is no fix, between two locations that have as many each
    middle = ecef[np.linalg.norm(ecef - np.median(ecef, axis=0), axis=1).argmin()]
    near = np.linalg.norm(ecef - middle, axis=1) <= _FARTHEST
    order = np.flatnonzero(near)[np.argsort(times[near], kind="stable")]
    origin = locations[order[0]]
    warnings = [
        warning
        for receiver, kept in zip(receivers, rows, strict=True)
        for warning in _left_out(scene, receiver, len(kept))
    ]
    if not near.all():
        message = f"fixes more than {_FARTHEST / 1000:.0f} km from the others were left out"
        warnings.append(_skipped("gnss-fixes-elsewhere", scene.source, message, int((~near).sum())))
    return GnssFixes(
        times[order], enu_from_geodetic(locations[order], origin), sigmas[order], reported[order], levers[order],
        number[order], origin, tuple(warnings),
    )  # fmt: skip


def _chosen(receiver: GnssSensor) -> Int64Array:
    """Rows of usable fixes, one per time; a fix that only says the one before again is none."""
    rows = np.flatnonzero(usable_fixes(receiver))
    _, first = np.unique(receiver.timestamps_ns[rows], return_index=True)
    rows = rows[first]
    same = (np.diff(receiver.positions_lla[rows, :2], axis=0) == 0).all(axis=1)
    chosen: Int64Array = rows[np.concatenate([[True], ~same])]
    return chosen


def _left_out(scene: Scene, receiver: GnssSensor, kept: int) -> list[DataWarning]:
    lost = len(receiver.timestamps_ns) - kept
    if lost == 0:
        return []
    message = (
        "fixes that are no location, of a time that was there before, or the same as before were left out"
    )
    return [_skipped("gnss-fixes-left-out", f"{scene.source}: sensors[{receiver.id}]", message, lost)]


def _skipped(code: str, location: str, message: str, count: int) -> DataWarning:
    return DataWarning(kind=WarningKind.SKIPPED, code=code, location=location, message=message, count=count)


def _is_reported(accuracies: Float64Array) -> BoolArray:
    reported: BoolArray = np.isfinite(accuracies) & (accuracies > 0)
    return reported


def _sigmas(receiver: GnssSensor, rows: Int64Array, settings: SmootherSettings) -> Float64Array:
    across, along_up = receiver.accuracies[rows], receiver.vertical_accuracies[rows]
    flat = np.where(_is_reported(across), across, settings.fix_noise)
    up = np.where(_is_reported(along_up), along_up, _VERTICAL * flat)
    sigmas: Float64Array = np.clip(np.stack([flat, flat, up], axis=1), _LEAST_SIGMA, _LARGEST_SIGMA)
    sigmas[~np.isfinite(receiver.positions_lla[rows, 2]), 2] = _UNKNOWN_HEIGHT
    return sigmas


def _lever(receiver: GnssSensor) -> Float64Array:
    return np.zeros(3) if receiver.mount is None else receiver.mount.translation.copy()
