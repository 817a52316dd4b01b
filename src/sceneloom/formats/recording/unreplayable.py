"""What of a recording the vendor's software refuses, ignores or takes for something else when it replays it.

Source: the vendor's SDK 1.54.0, run on recordings.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.vio_config import unknown_keys
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.shooting import ShootingSensor, shots_of

FIELD = "replay"
"""Under which these stand in a loss report: the recording holds the data all the same."""

_NEEDED = ("accelerometer", "gyroscope")
_MOST_CAMERAS = 2


def unreplayable(
    cameras: Sequence[ShootingSensor],
    lidars: Sequence[LidarSensor],
    imu: ImuSensor | None,
    vio_config: str | None,
) -> list[Loss]:
    """Name what will not be replayed as it was meant.

    Args:
        cameras: what is written, in the order of `cameraInd`.
        lidars: what is written.
        imu: what is written.
        vio_config: the text of `vio_config.yaml`.
    """
    return [
        *_of_missing(cameras, imu),
        *_of_cameras(cameras),
        *_of_equal_times(cameras, imu),
        *_of_lidars(lidars),
        *_of_settings(vio_config),
    ]


def _of_missing(cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    there = {name for name, samples in imu.streams.items() if len(samples)} if imu is not None else set()
    missing = [name for name in _NEEDED if name not in there]
    if missing and any(len(shots_of(camera)) for camera in cameras):
        yield _loss(f"the vendor's software gives no output without {' and '.join(missing)}")


def _of_cameras(cameras: Sequence[ShootingSensor]) -> Iterator[Loss]:
    if len(cameras) > _MOST_CAMERAS:
        names = ", ".join(str(camera.id) for camera in cameras[_MOST_CAMERAS:])
        yield _loss(
            f"the vendor's software uses the first two cameras, not {names}", len(cameras) - _MOST_CAMERAS
        )
    if cameras and isinstance(cameras[0], DepthCameraSensor):
        yield _loss(f"the vendor's software tracks in the first camera, and {cameras[0].id} measures depth")


def _of_equal_times(cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    if imu is None or not cameras:
        return
    timestamps: Int64Array = np.concatenate([shots_of(camera).timestamps_ns for camera in cameras])
    measured = [samples.timestamps_ns for name, samples in imu.streams.items() if name in _NEEDED]
    equal = int(np.isin(np.unique(timestamps), np.concatenate([*measured, np.zeros(0, np.int64)])).sum())
    if equal:
        yield _loss(
            "images have the very times of IMU samples, which makes the vendor's diagnosis suspect that their times "
            "were not measured; they are written as they are",
            equal,
        )


def _of_lidars(lidars: Sequence[LidarSensor]) -> Iterator[Loss]:
    if len(lidars) > 1:
        yield _loss("the vendor's software does not report lidars apart (`lidarInd`)", len(lidars))


def _of_settings(vio_config: str | None) -> Iterator[Loss]:
    unknown = unknown_keys(vio_config or "")
    if unknown:
        named = ", ".join(unknown)
        yield _loss(
            f"the vendor's software may stop at settings that are not publicly known: {named}", len(unknown)
        )


def _loss(what: str, count: int = 1) -> Loss:
    return Loss(field=FIELD, what=what, count=count, support=Support.KEPT)
