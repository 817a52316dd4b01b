"""What sensors see around the ego, held against clouds and camera models that are known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.report.coverage import RANGE_EDGES, CloudStatistics, Coverage
from sceneloom.scene import CameraSensor, LazyFrames, LidarFrame, LidarPoints, LidarSensor, PointsFrame, Scene
from sceneloom.simulate import camera_mount


def on_circle(degrees, radius, height=0.0):
    angles = np.radians(degrees)
    columns = [radius * np.cos(angles), radius * np.sin(angles), np.full(len(angles), height)]
    return np.column_stack(columns).astype(np.float32)


def lidar(points, *, rings=None, **more):
    frame = LidarFrame(0, LidarPoints(points, rings=rings))
    return LidarSensor("lidar", LazyFrames.of([frame, frame], [0, 100_000_000]), **more)


def counted(points):
    statistics = CloudStatistics()
    statistics.add(points)
    assert statistics.non_finite == np.isnan(points).any(axis=1).sum()
    return statistics.coverage("lidar", "lidar", of=1)


def test_points_are_counted_by_range_sector_and_ring():
    ahead_left, behind = on_circle(np.arange(1.0, 44.0), 12.0), on_circle(np.full(7, 181.0), 60.0)
    found = counted(np.concatenate([ahead_left, behind, np.full((3, 3), np.nan, np.float32)]))
    by_range = dict(zip(RANGE_EDGES, found.range_counts, strict=True))
    assert (by_range[10.0], by_range[50.0], sum(found.range_counts)) == (43, 7, 50)
    # 1 to 43 degrees are nine sectors of five degrees, 181 degrees one more
    assert found.horizon_share == pytest.approx(10 / 72)
    assert [k for k, count in enumerate(found.sectors) if count] == [*range(9), 36]
    assert found.reaches[0] == pytest.approx(12.0, abs=0.5)
    assert found.non_finite_share == pytest.approx(3 / 53)
    flat, raised = on_circle(np.arange(360.0), 10.0), on_circle(np.arange(360.0), 10.0, height=10.0)
    found = counted(np.concatenate([flat, raised]))
    assert (found.lowest_deg, found.highest_deg) == pytest.approx((0.0, 45.0), abs=0.2)
    statistics = CloudStatistics()
    for rings in ([0, 0, 0, 2, 2, 2, 2, 2, 2, 2], [0, 2, 2, 2, 2, 2, 2, 2, 2, 2]):
        points = on_circle(np.arange(10.0), 5.0)
        statistics.add(points, LidarPoints(points, rings=np.array(rings, np.uint16)))
    assert statistics.coverage("lidar", "lidar", of=2).rings == (2.0, 0.0, 8.0)
    for far in (1e9, 1e15, 1e19, 1e30, np.finfo(np.float32).max, np.finfo(np.float32).min):
        found = counted(np.array([[1, 0, 0], [0, 2, 0], [far, far, 0]], np.float32))
        assert (sum(found.range_counts), found.range_counts[-1]) == (3, 1)
        assert found.range_max == pytest.approx(np.hypot(float(far), float(far)), rel=1e-6)
        assert np.isfinite(found.range_95)


@pytest.mark.parametrize("yaw_deg", [0.0, 62.0, -120.0])
def test_a_camera_sees_what_its_camera_model_and_mounting_state(yaw_deg):
    camera_model = Camera("pinhole", 800, 400, 400.0, 400.0, 399.5, 199.5)
    ahead = CameraSensor("front", camera_model, LazyFrames.of([], []), mount=camera_mount())
    side = CameraSensor("side", camera_model, LazyFrames.of([], []), mount=camera_mount(yaw_deg=yaw_deg, pitch_deg=3.0))
    _, found = Coverage.of(Scene((ahead, side))).cameras
    half = math.degrees(math.atan(400.0 / 400.0))
    assert found.across_deg == pytest.approx(2 * half, abs=0.01)
    assert found.upright_deg == pytest.approx(2 * math.degrees(math.atan(0.5)), abs=0.01)
    assert (found.heading_deg - yaw_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=0.2)
    # a camera that looks up by 3 degrees sees a little more than 90 degrees of the horizon
    assert found.left_deg - found.right_deg == pytest.approx(2 * half, abs=0.2)


def test_shares_of_the_horizon_join_what_sensors_see_also_rotated_ones():
    camera_model = Camera("pinhole", 800, 400, 400.0, 400.0, 399.5, 199.5)
    front = CameraSensor("front", camera_model, LazyFrames.of([], []), mount=camera_mount())
    half = lidar(on_circle(np.arange(0.5, 180.0), 10.0), mount=RigidTransform.identity())
    found = Coverage.of(Scene((front, half)))
    assert found.lidar_share == pytest.approx(0.5)
    assert found.camera_share == pytest.approx(0.25, abs=0.01)
    assert found.both_share == pytest.approx(0.125, abs=0.01)
    # mounted upside down and looking back: a rotation of half a circle about its y axis
    rotated = RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.array([1.0, 0.0, 2.0]))
    ahead_in_ego = on_circle(np.array([2.0, 3.0]), 10.0, height=1.0)
    sensor = lidar(rotated.inverse().rotate(ahead_in_ego).astype(np.float32), mount=rotated)
    found = Coverage.of(Scene((sensor,))).clouds[0]
    assert [k for k, count in enumerate(found.sectors) if count] == [0]
    assert found.lowest_deg == pytest.approx(math.degrees(math.atan2(1.0, 10.0)), abs=0.2)


def test_sweeps_without_a_location_and_those_that_cannot_be_read_are_reported_not_counted(short):
    def broken(k):
        raise DataError("file", f"frames[{k}]", "cut off")

    found = Coverage.of(Scene((lidar(on_circle(np.arange(9.0), 4.0), points_frame=PointsFrame.WORLD),)))
    assert (found.clouds[0].sweeps, "not known" in found.skipped[0]) == (0, True)
    first = short.lidars[0]
    torn = replace(first, frames=LazyFrames(first.frames.timestamps_ns[:2], broken))
    found = Coverage.of(replace(short, sensors=(torn,)))
    assert (found.clouds[0].sweeps, len(found.skipped)) == (0, 2)
