"""Loads what the first results need before anybody waits for them."""

from typing import Any

import numpy as np

from sceneloom.fusion.interface import FusionInterface
from sceneloom.fusion.messages import (
    Boxes2d,
    Boxes3d,
    CalibrationData,
    ImageData,
    PointCloudData,
    SentRecord,
    Timestamp,
)

_FORWARD = (0.0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)
_WIDTH, _HEIGHT = 64, 48


def warm_up() -> int:
    """Fuse a small pair of each type, so that kernels are compiled and loaded; gives how many results came."""
    with FusionInterface(inline=True) as fusion:
        fusion.set_calibration(
            CalibrationData(
                image_size=(_WIDTH, _HEIGHT),
                intrinsic_matrix=(50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1),
                reference_frame=0,
                extrinsic_matrix=_FORWARD,
            )
        )
        for record in _records():
            fusion.send(record)
        fusion.flush()
        return fusion.waiting_results


def _records() -> list[SentRecord]:
    common: dict[str, Any] = {"sensor_id": 0, "seq": 0, "timestamp": Timestamp(1, 0)}
    of_one: dict[str, Any] = {
        "id": np.zeros(1, np.int32),
        "class_names": ("car",),
        "confidence": np.full(1, 0.5, np.float32),
    }
    point = np.array([[10.0, 0, 0]], np.float32)
    return [
        ImageData(
            **common,
            height=_HEIGHT,
            width=_WIDTH,
            encoding="rgb8",
            channel=3,
            data=np.zeros(_HEIGHT * _WIDTH * 3, np.uint8),
        ),
        PointCloudData(**common, number=1, fields=("x", "y", "z"), fields_number=3, data=point),
        Boxes2d(**common, **of_one, corners_xyxy=np.array([[25, 18, 38, 30]], np.uint32)),
        Boxes3d(
            **common,
            **of_one,
            centers=point,
            sizes_lwh=np.full((1, 3), 2.0, np.float32),
            directions=np.array([[1, 0, 0]], np.float32),
            velocities=np.zeros(1, np.float32),
        ),
    ]
