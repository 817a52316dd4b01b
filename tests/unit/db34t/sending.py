"""Records as sensors and detectors would send them, for tests of the fusion interface."""

import numpy as np

from sceneloom.db34t import (
    Box2d,
    Box3d,
    Boxes2d,
    Boxes3d,
    CalibrationData,
    ImageData,
    PointCloudData,
    RawData,
    Timestamp,
)
from sceneloom.db34t.interface import FusionInterface

WIDTH, HEIGHT = 64, 48
START_NS = 1_595_682_678_000_000_000
FORWARD = (0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)
"""extrinsic_matrix, by columns, of a camera that looks forward from where the lidar is."""

INTRINSICS = (50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1)


def calibration(**changed):
    frames = {"reference_frame": 0, "extrinsic_matrix": FORWARD}
    return CalibrationData(**{"image_size": (WIDTH, HEIGHT), "intrinsic_matrix": INTRINSICS, **frames, **changed})


def timestamp(milliseconds):
    return Timestamp.of(START_NS + round(milliseconds * 1_000_000))


def image(milliseconds, seq, level=7, *, sensor_id=1, width=WIDTH, height=HEIGHT):
    data = np.full(height * width * 3, level, np.uint8)
    form = {"height": height, "width": width, "encoding": "rgb8", "channel": 3, "data": data}
    return ImageData(sensor_id=sensor_id, timestamp=timestamp(milliseconds), seq=seq, **form)


def cloud(milliseconds, seq, points=((10.0, 0.0, 0.0),), *, sensor_id=0, times=None, fields=("x", "y", "z")):
    data = np.array(points, np.float32).reshape(-1, len(fields))
    if times is not None:
        data, fields = np.column_stack([data, np.array(times, np.float32)]), (*fields, "time")
    form = {"number": len(data), "fields": fields, "fields_number": len(fields), "data": data}
    return PointCloudData(sensor_id=sensor_id, timestamp=timestamp(milliseconds), seq=seq, **form)


def raw(milliseconds, seq, data, *, sensor_id):
    return RawData(sensor_id=sensor_id, timestamp=timestamp(milliseconds), seq=seq, length=len(data), data=data)


def box_3d(milliseconds, seq, **changed):
    center, size = {"X": 20.0, "Y": 0.0, "Z": 0.0}, {"length": 4.0, "width": 2.0, "height": 1.5}
    fields = {"id": 4, "class_name": "Car", "confidence": 0.8, "direction": (1.0, 0.0, 0.0), "velocity": 5.0}
    return Box3d(**{"points_seq": seq, "timestamp": timestamp(milliseconds), **fields, **center, **size, **changed})


def box_2d(milliseconds, seq, **changed):
    fields = {"id": 6, "class_name": "Car", "confidence": 0.9, "x1": 28, "y1": 21, "x2": 35, "y2": 26}
    return Box2d(**{"image_seq": seq, "timestamp": timestamp(milliseconds), **fields, **changed})


def boxes_3d(milliseconds, seq, *, sensor_id=0, **changed):
    return box_3d(milliseconds, seq, **changed).alone(sensor_id)


def boxes_2d(milliseconds, seq, *, sensor_id=1, **changed):
    return box_2d(milliseconds, seq, **changed).alone(sensor_id)


def no_boxes_3d(milliseconds, seq, *, sensor_id=0):
    return Boxes3d.empty(sensor_id, seq, timestamp(milliseconds))


def no_boxes_2d(milliseconds, seq, *, sensor_id=1):
    return Boxes2d.empty(sensor_id, seq, timestamp(milliseconds))


def interface(*, cameras=(1,), lidars=(0,), **options):
    """A fusion interface with calibrations of some cameras and lidars."""
    fusion = FusionInterface(**options)
    for camera_id in cameras:
        for lidar_id in lidars:
            assert fusion.set_calibration(calibration(), camera_id=camera_id, lidar_id=lidar_id)
    return fusion


def send_all(fusion, *records):
    """Send records that all have to be taken."""
    for record in records:
        assert fusion.send(record), record


def fused(fusion, kind=0, *records):
    """The records of all results, after sending some more that have to be taken."""
    send_all(fusion, *records)
    fusion.flush()
    return [result.record for result in fusion.results(kind)]
