"""Who fuses: the sender or the thread, whichever it is, in the order in which records came, and each counted."""

import threading

import numpy as np

from sceneloom.db34t import Boxes2d, Boxes3d
from sceneloom.db34t.interface import FusionInterface

from .sending import calibration, cloud, image, timestamp


def boxes_2d(milliseconds, seq, count=0):
    return Boxes2d(
        sensor_id=1,
        seq=seq,
        timestamp=timestamp(milliseconds),
        id=np.arange(count, dtype=np.int32),
        class_names=("car",) * count,
        confidence=np.full(count, 0.5, np.float32),
        corners_xyxy=np.tile(np.array([5, 5, 15, 15], np.uint32), (count, 1)),
    )


def boxes_3d(milliseconds, seq):
    return Boxes3d.empty(0, seq, timestamp(milliseconds))


def test_boxes_that_wait_are_fused_after_a_while_though_nothing_more_comes():
    with FusionInterface() as fusion:
        assert fusion.set_calibration(calibration(), camera_id=1, lidar_id=0)
        for seq in range(3):
            # an image shortly before the sweep: one after it could be nearer
            assert fusion.send(boxes_2d(1000 * seq, seq))
            assert fusion.send(boxes_3d(1000 * seq + 10, seq))
            result = fusion.get(1, timeout_s=30.0)
            assert result is not None
            assert (result.number, result.record.image_seq, result.record.points_seq) == (seq, seq, seq)


def test_results_keep_the_order_of_what_came_whoever_fuses_it():
    count = 150
    with FusionInterface() as fusion:
        assert fusion.set_property("queue_length", 1000)
        assert fusion.set_property("result_queue_length", 1000)
        assert fusion.set_calibration(calibration(), camera_id=1, lidar_id=0)

        def send_frames():
            for seq in range(20):
                assert fusion.send(image(100 * seq, seq))
                assert fusion.send(cloud(100 * seq, seq))

        other = threading.Thread(target=send_frames)
        for seq in range(count):
            if seq == count // 2:
                other.start()
            # a long list goes to the thread, and so do those after it
            assert fusion.send(boxes_2d(100 * seq, seq, 120 if seq == count // 4 else 1))
            assert fusion.send(boxes_3d(100 * seq, seq))
        other.join()
        fusion.flush()
        for fusion_type, number in ((1, count), (0, 20)):
            results = list(fusion.results(fusion_type))
            assert [result.number for result in results] == list(range(number))
            assert [result.record.points_seq for result in results] == list(range(number))
    counts = fusion.counters.counts()
    for kind, number in (("boxes_2d", count), ("boxes_3d", count), ("image", 20), ("points", 20)):
        assert counts[f"received.{kind}"] == counts[f"fused.{kind}"] == number
