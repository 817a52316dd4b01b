"""Subscriptions whose objects are followed from sweep to sweep."""

import grpc
import pytest
from tests.unit.fusion.sending import boxes_3d, no_boxes_2d

from sceneloom.service.client import FusionClient


def send_boxes(call, seqs, *, cameras=(1,)):
    for seq in seqs:
        for camera in cameras:
            assert call.send(no_boxes_2d(100 * seq, seq, sensor_id=camera)).status == 1
        assert call.send(boxes_3d(100 * seq, seq, id=40 + seq, X=12.0 + seq)).status == 1
    assert call("Flush").status == 1


def test_a_subscriber_that_asks_for_tracks_gets_them_with_one_number_each(call):
    replies = call("Subscribe", track=True, most=5, timeout=60)
    send_boxes(call, range(5))
    reported = list(replies)
    assert [reply.number for reply in reported] == [0, 1, 2, 3, 4]
    assert [[one.id for one in reply.detections.detections] for reply in reported] == [[1]] * 5
    speed = reported[-1].detections.detections[0].velocity_vector[0]
    assert speed == pytest.approx(10.0, abs=2.0)  # 1 m in 0.1 s, after five looks


def test_the_client_asks_for_tracks(serve, connect):
    server = serve()
    call = connect(server)
    call.calibrate()
    send_boxes(call, range(3))
    with FusionClient(server.address) as client:
        reported = list(client.subscribe(1, most=3, track=True))
    assert [result.record.id.tolist() for result in reported] == [[1], [1], [1]]


def test_tracks_of_sensor_data_are_refused(call):
    with pytest.raises(grpc.RpcError) as caught:
        list(call("Subscribe", track=True, fusion_type=0))
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert "expected 1, detections" in caught.value.details()


def test_results_after_a_tracking_subscriber_has_left_are_as_they_were_sent(call):
    subscription = call("Subscribe", track=True, timeout=60)
    send_boxes(call, range(1))
    assert [one.id for one in next(subscription).detections.detections] == [1]
    subscription.cancel()
    send_boxes(call, range(1, 4))
    left = [call("Get", fusion_type=1, wait_ms=5000) for _ in range(2)]
    assert [reply.detections.detections[0].box_3d_id for reply in left][-1] in (42, 43)
    assert all(reply.detections.detections[0].id == 0 for reply in left)
