"""Sending a drive: a session that gets its records fuses what the drive's own fusion fuses."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.cuboid_projection import project_cuboids
from sceneloom.db34t import Boxes2d, Boxes3d, ImageData, PointCloudData, Timestamp
from sceneloom.db34t.events import Dropped
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import encode
from sceneloom.db34t.types import DONE, Cause, refused
from sceneloom.editing.retime import ClockCorrection, retimed_scene
from sceneloom.errors import DataError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline import iter_fused
from sceneloom.scene import PointsFrame
from sceneloom.scene.types import key_of
from sceneloom.service.sending import PATIENCE_MS, Pace, Statistics, send_log, send_scene
from sceneloom.service.session_log import SessionLog, compare
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

CAMERA = Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5)


def street(frames=4, camera=CAMERA, **changed):
    lidar, cameras = LidarSpec(beams=8, steps=90), (CameraSpec(camera, **changed),)
    return simulate_street(1, frames=frames, lidar=lidar, cameras=cameras).scene


class Kept:
    """A fusion interface that keeps what it was sent."""

    def __init__(self, fusion):
        self.fusion, self.records, self.paths = fusion, [], []

    def __getattr__(self, name):
        return getattr(self.fusion, name)

    def send(self, record):
        self.records.append(record)
        return self.fusion.send(record)

    def send_motion(self, path):
        self.paths.append((len(self.records), path.stop_ns))
        return self.fusion.send_motion(path)


@pytest.fixture
def receiver():
    with FusionInterface(inline=True) as fusion:
        fusion.set_property("result_queue_length", 1000)
        yield Kept(fusion)


def test_a_session_that_gets_the_records_of_a_drive_fuses_as_the_drive_is_fused(receiver):
    scene = street()
    expected = [view for frame in iter_fused(scene) for view in frame.views]
    report = send_scene(scene, receiver, rate=0)
    results = [result.record for result in receiver.results(0)]
    assert report.refused == {}
    assert report.sensors == {str(scene.lidars[0].id): 0, str(scene.cameras[0].id): 1}
    assert (report.sent["points"], report.sent["image"]) == (4, 4)
    assert len(results) == len(expected) > 0
    for record, view in zip(results, expected, strict=True):
        assert record.motion_compensated == 1
        assert record.image_timestamp.nanoseconds == view.timestamp_ns
        ours, theirs = record.depths, view.depth_image
        both = (ours > 0) & (theirs > 0)
        # a point at the edge of a pixel may fall into the one beside it
        assert both.sum() > 0.97 * max((ours > 0).sum(), (theirs > 0).sum())
        # points of 32 bits seen from the world's origin and from the lidar
        assert np.quantile(np.abs(ours[both] - theirs[both]), 0.95) < 2e-3
    times = [record.timestamp.nanoseconds for record in receiver.records]
    assert times == sorted(times)
    for kind, sensor_id in ((PointCloudData, 0), (ImageData, 1)):
        found = [(record.sensor_id, record.seq) for record in receiver.records if isinstance(record, kind)]
        assert found == [(sensor_id, seq) for seq in range(4)]
    last = next(iter(scene.trajectories.values())).timestamps_ns[-1]
    for k, time_ns in enumerate(times):  # poses are there before
        assert max(stop for before, stop in receiver.paths if before <= k) >= min(time_ns + 100_000_000, last)
    assert receiver.get_property("pairing_timeout_ms") == PATIENCE_MS


def test_a_rolling_shutter_is_sent_along_and_every_row_goes_by_its_own_time(receiver):
    scene = street(readout_ns=80_000_000)
    cameras = tuple(replace(camera, extras={}) for camera in scene.cameras)
    at_once = replace(scene, sensors=(*scene.lidars, *cameras))
    depths = [[view.depth_image for frame in iter_fused(drive) for view in frame.views] for drive in (scene, at_once)]
    send_scene(scene, receiver, rate=0)
    results = [result.record.depths for result in receiver.results(0)]
    assert len(results) == len(depths[0]) > 0
    off = [
        np.concatenate([np.abs(ours - one)[(ours > 0) & (one > 0)] for ours, one in zip(results, each, strict=True)])
        for each in depths
    ]
    # As where all lines are taken at once, above; a vehicle that goes 0.5 m while rows are taken makes it centimetres.
    assert np.quantile(off[0], 0.95) < 2e-3
    assert np.quantile(off[1], 0.95) > 0.02


def test_boxes_of_a_scene_are_sent_as_a_detector_would_see_them(receiver):
    scene = project_cuboids(street())
    report = send_scene(scene, receiver, rate=0)
    boxes = [record for record in receiver.records if isinstance(record, Boxes3d)]
    flat = [record for record in receiver.records if isinstance(record, Boxes2d)]
    assert report.sent["boxes_3d"] == report.sent["boxes_2d"] == 4
    assert sum(map(len, boxes)) > 0 < sum(map(len, flat))
    pairs = [
        pair
        for result in receiver.results(1)
        for pair in zip(result.record.box_3d_ids, result.record.box_2d_ids, strict=True)
        if None not in pair
    ]
    cuboids = [row for row, annotation in enumerate(scene.annotations) if annotation.type == "cuboid"]
    # far objects are a pixel wide and look alike; by chance one pair of many would agree
    assert np.mean([cuboids[solid] == flat_number for solid, flat_number in pairs]) > 0.6


def test_a_camera_model_that_table_3_cannot_hold_is_sent_as_a_property_and_reported_with_its_error(receiver):
    fisheye = Camera("fisheye", 96, 64, 40.0, 40.0, 47.5, 31.5, (0.02, -0.01, 0.0, 0.0))
    report = send_scene(street(camera=fisheye), receiver, rate=0)
    warning = next(warning for warning in report.warnings if warning.code == "camera-model-beyond-table-3")
    assert "px" in warning.message
    assert "fisheye" in receiver.get_property("camera_models")
    assert receiver.get(0) is not None
    assert receiver.fusion._setting.camera(1) == fisheye


def test_points_in_the_world_go_back_into_their_sensor(receiver, tmp_path):
    scene = street()
    sceneloom.fuse(scene, tmp_path / "drive.sfs")
    with sceneloom.open(tmp_path / "drive.sfs") as fused:
        assert fused.lidars[0].points_frame is PointsFrame.WORLD
        report = send_scene(fused, receiver, rate=0)
        world = fused.lidars[0].frames[1]
        pose = fused.lidars[0].poses.interpolate(np.array([world.timestamp_ns]))
        world_from_lidar = RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])
        cloud = next(r for r in receiver.records if isinstance(r, PointCloudData) and r.seq == 1)
    assert report.refused == {}
    assert "time" not in cloud.fields  # each point stands where it was at its own time
    back = world_from_lidar.apply(cloud.points[:, :3].astype(np.float64))
    np.testing.assert_allclose(back, world.points.positions, atol=1e-4)  # 32 bits at 100 m


def moved_in_time(scene, offset_ns):
    """The same drive on a clock that is ahead or behind."""
    clock = ClockCorrection(-offset_ns)
    drive = replace(scene, sensors=(*scene.lidars, *scene.cameras), annotations=())
    sensors, trajectories = (key_of(sensor.id) for sensor in drive.sensors), drive.trajectories
    return retimed_scene(drive, sensors=dict.fromkeys(sensors, clock), trajectories=dict.fromkeys(trajectories, clock))


def test_times_before_zero_are_moved_by_whole_seconds_and_a_longer_wait_stays(receiver):
    scene = street()
    assert receiver.set_property("pairing_timeout_ms", 60_000)
    send_scene(moved_in_time(scene, -1_500_000_000), receiver, rate=0)
    first = receiver.records[0].timestamp.nanoseconds
    original = min(scene.lidars[0].frames[0].timestamp_ns, scene.cameras[0].images[0].timestamp_ns)
    assert first >= 0
    assert (first - (original - 1_500_000_000)) % 1_000_000_000 == 0
    assert receiver.get_property("pairing_timeout_ms") == 60_000


def test_records_are_held_back_until_they_are_due(receiver):
    now, waits = [100.0], []

    def wait(seconds):
        waits.append(seconds)
        now[0] += seconds

    send_scene(street(), receiver, pace=Pace(2.0, clock=lambda: now[0], wait=wait))
    times = [record.timestamp.nanoseconds for record in receiver.records]
    assert sum(waits) == pytest.approx((times[-1] - times[0]) / 1e9 / 2.0)
    assert all(seconds > 0 for seconds in waits)


def test_as_fast_as_possible_loses_nothing_and_waits_longer_and_longer_where_there_is_no_room():
    events = []
    with FusionInterface(observer=events.append) as fusion:
        fusion.set_property("result_queue_length", 1000)
        report = send_scene(street(frames=8), fusion, rate=0)
        assert fusion.get_property("queue_policy") == "drop-oldest"
        assert len(list(fusion.results(0))) == 8
    assert report.refused == {}
    assert not any(isinstance(event, Dropped) for event in events)
    for full, flushes, refused_count in ((3, 0, 0), (8, 0, 0), (9, 1, 0), (99, 1, 1)):
        waits, flushed, answers = [], [], iter([refused(Cause.QUEUE_FULL, "full")] * full + [DONE] * 9)
        receiver = SimpleNamespace(send=lambda _, found=answers: next(found), flush=partial(flushed.append, 1))
        statistics = Statistics(receiver, Pace(0.0, wait=waits.append))
        statistics.send(Boxes2d.empty(0, 1, Timestamp(1)))
        assert waits == sorted(waits)
        assert (len(waits), len(flushed)) == (min(full, 8), flushes)
        assert (statistics.sent["boxes_2d"], statistics.refused[Cause.QUEUE_FULL]) == (1, refused_count)


def test_what_is_refused_is_counted_by_cause_and_without_calibration_or_camera_nothing_is_sent(receiver):
    scene = street(frames=2)
    receiver.send = lambda record: refused(Cause.BAD_RECORD, "no")
    report = send_scene(scene, receiver, rate=0)
    assert report.refused == {"bad-record": report.sent["image"] + report.sent["points"] + report.sent["boxes_3d"]}
    receiver.set_calibration = lambda data, **ids: refused(Cause.BAD_CALIBRATION, "not today")
    with pytest.raises(OptionError, match="calibration of camera 1 and lidar 0: bad-calibration: not today"):
        send_scene(scene, receiver, rate=0)
    with pytest.raises(DataError, match="0 cameras"):
        send_scene(replace(scene, sensors=scene.lidars, annotations=()), receiver, rate=0)


def test_a_log_sent_again_gives_the_same_results(tmp_path):
    path, again = tmp_path / "session.mcap", tmp_path / "again.mcap"
    scene = project_cuboids(street())
    with SessionLog(path) as log, FusionInterface(inline=True, observer=log.session("rig")) as fusion:
        fusion.add_property("site", "where", "string")
        fusion.set_property("site", "A1")
        fusion.set_property("result_queue_length", 1000)
        send_scene(scene, fusion, rate=0)
        expected = [encode(result.record) for kind in (0, 1) for result in fusion.results(kind)]
    opened = {}
    with SessionLog(again) as log:

        def open_session(name):
            opened[name] = FusionInterface(inline=True, observer=log.session(name))
            return opened[name]

        report = send_log(path, open_session, rate=0)
        found = [encode(result.record) for kind in (0, 1) for result in opened["rig"].results(kind)]
        assert opened["rig"].get_property("site") == "A1"
        opened["rig"].close()
    assert report.refused == {}
    assert report.sent["points"] == 4
    assert found == expected
    assert expected
    assert compare(path)
    assert compare(again)
