import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import Raster, Rosette, SolidStateSpec, sensor_mount
from sceneloom.simulate.lidar_radar import ScanningLidar

PERIOD_NS = 100_000_000
UPRIGHT = RigidTransform(np.eye(3), np.array([0.0, 0.0, 1.5]))
SMALL = Raster(azimuth_deg=(-50, 50), elevation_deg=(-10, 8), rows=7, columns=10, channels=4, interleave=3)
# float32 holds 150 m in steps of 1.5e-5 m.
FLOAT32 = 1e-5


@pytest.fixture(scope="module")
def lidar_before_wall(street_of, stationary_path, box):
    """A lidar 10 m before a wall that fills its view, above the ground, stationary."""
    street = street_of([box([11, 0, 30], [1, 80, 30])], stationary_path)

    def make(pattern, **options):
        spec = SolidStateSpec(pattern, mount=UPRIGHT, range_sigma=0.0, drop_rate=0.0, **options)
        starts = 70_000_000 + PERIOD_NS * np.arange(4, dtype=np.int64)
        return ScanningLidar.of(spec, street, stationary_path, seed=1, timestamps_ns=starts)

    return make


def angles(positions):
    x, y, z = np.asarray(positions, np.float64).T
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))


@pytest.mark.parametrize("pattern", [SMALL, Raster(), Rosette()], ids=["small", "M1", "rosette"])
def test_every_shot_ends_on_the_wall_or_on_the_ground(lidar_before_wall, pattern):
    frame = lidar_before_wall(pattern).frame(1)
    positions = frame.points.positions.astype(np.float64)
    from_ground, from_wall = np.abs(positions[:, 2] + 1.5), np.abs(positions[:, 0] - 10.0)
    np.testing.assert_allclose(np.minimum(from_ground, from_wall), 0.0, atol=FLOAT32)
    assert 0.02 < (from_ground < from_wall).mean() < 0.6


def test_the_default_raster_shoots_as_often_as_a_frame_of_packets_holds():
    shots = SolidStateSpec().plan_shots()(0)
    packets, moments_in_packet, channels = 630, 25, 5
    assert len(shots.moments) == packets * moments_in_packet * channels
    assert len(shots.offsets_ns) == packets * moments_in_packet
    azimuths, elevations = angles(shots.rays.spread())
    assert azimuths.max() - azimuths.min() == pytest.approx(120.0, abs=0.3)
    assert (elevations.min(), elevations.max()) == pytest.approx((-12.5, 12.5))


def test_a_raster_goes_through_its_rows_in_passes_from_the_top(lidar_before_wall):
    shots = lidar_before_wall(SMALL).shots(0)
    _, elevations = angles(shots.rays.spread())
    np.testing.assert_allclose(elevations, -10.0 + 3.0 * shots.rings, atol=1e-9)
    row_of_sweep = shots.rings.reshape(7, 40)
    assert (row_of_sweep == row_of_sweep[:, :1]).all()
    # Rows 0, 3, 6 from the top, then 1, 4, then 2, 5; counted from the lowest.
    assert row_of_sweep[:, 0].tolist() == [6, 3, 0, 5, 2, 4, 1]


def test_the_mirror_sweeps_to_and_fro_and_the_channels_lie_side_by_side(lidar_before_wall):
    shots = lidar_before_wall(SMALL).shots(0)
    azimuths = angles(shots.rays.spread())[0].reshape(7, 10, 4)
    # 40 cells of 2.5 degrees from 50 degrees left; a channel is ten wide.
    expected = 48.75 - 2.5 * (np.arange(10)[:, None] + 10 * np.arange(4))
    np.testing.assert_allclose(azimuths[0], expected, atol=1e-9)
    np.testing.assert_allclose(azimuths[1], expected[::-1], atol=1e-9)
    np.testing.assert_allclose(azimuths[6], expected, atol=1e-9)


def test_moments_are_spread_evenly_over_the_frame_and_channels_share_them(lidar_before_wall):
    lidar = lidar_before_wall(SMALL)
    frame = lidar.frame(2)
    times = frame.points.timestamps_ns - frame.timestamp_ns
    assert frame.timestamp_ns == 70_000_000 + 2 * PERIOD_NS
    assert times.dtype == np.int64
    np.testing.assert_array_equal(times, np.repeat([k * PERIOD_NS // 70 for k in range(70)], 4))
    assert lidar.frame(0).points.rings.dtype == np.uint16


def test_the_rosette_adds_the_bends_of_two_prisms(lidar_before_wall):
    pattern = Rosette(
        fov_deg=40.0, shots_per_second=20_000.0, rotations_per_minute=(6000.0, -1700.0), share=0.6
    )
    lidar = lidar_before_wall(pattern)
    for k in (0, 3):
        shots = lidar.shots(k)
        directions = shots.rays.spread()
        for shot in (0, 1, 17, 999, 1999):
            seconds = k * 0.1 + shot / 20_000.0
            bend = math.radians(20.0) * (
                0.6 * cmath.exp(2j * math.pi * 100.0 * seconds)
                + 0.4 * cmath.exp(-2j * math.pi * 1700.0 / 60.0 * seconds)
            )
            off_axis, around = abs(bend), cmath.phase(bend)
            expected = [
                math.cos(off_axis),
                math.sin(off_axis) * math.cos(around),
                math.sin(off_axis) * math.sin(around),
            ]
            # Times are whole nanoseconds: 6e-7 rad of the faster prism.
            np.testing.assert_allclose(directions[shot], expected, atol=1e-6)


def test_the_rosette_stays_in_its_round_field_and_reaches_its_rim_and_its_middle():
    directions = Rosette().plan_shots(PERIOD_NS)(0).rays.spread()
    off_axis = np.degrees(np.arccos(directions[:, 0]))
    assert off_axis.max() == pytest.approx(19.2, abs=0.01)
    assert off_axis.min() < 0.2
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)


def test_the_rosette_never_repeats_and_closes_its_gaps_over_time():
    plan = Rosette().plan_shots(PERIOD_NS)

    def seen(frames):
        cells = set()
        for k in range(frames):
            directions = plan(k * PERIOD_NS).rays.spread()
            cells |= set(map(tuple, np.floor(directions[:, 1:] * 100).astype(int).tolist()))
        return cells

    one, four, twelve = (len(seen(frames)) for frames in (1, 4, 12))
    assert one < 0.75 * four
    # A disc of radius sin 19.2° holds 3400 cells of 0.01 x 0.01.
    assert twelve > 0.95 * 3400 > four


def test_the_rosette_has_times_of_its_own_and_no_rings(lidar_before_wall):
    points = lidar_before_wall(Rosette()).frame(1).points
    assert points.rings is None
    times = points.timestamps_ns - (70_000_000 + PERIOD_NS)
    np.testing.assert_array_equal(times, 10_000 * np.arange(10_000))


@pytest.mark.parametrize("pattern", [SMALL, Rosette(shots_per_second=5000.0)], ids=["raster", "rosette"])
def test_frames_are_the_same_in_whatever_order_they_are_asked_for(lidar_before_wall, pattern):
    lidar, again = (
        replace(lidar_before_wall(pattern), spec=SolidStateSpec(pattern, mount=UPRIGHT)) for _ in range(2)
    )
    later = lidar.frame(3).points.positions
    assert not np.array_equal(lidar.frame(0).points.positions[:100], later[:100])
    np.testing.assert_array_equal(again.frame(3).points.positions, later)
    np.testing.assert_array_equal(lidar.frame(3).points.positions, later)


def test_mounts_of_lidars_and_radars_look_along_x_rotated_left_and_down():
    mount = sensor_mount(position=(1.0, 2.0, 3.0), yaw_deg=90.0)
    np.testing.assert_allclose(mount.apply([1.0, 0.0, 0.0]), [1.0, 3.0, 3.0], atol=1e-15)
    down = sensor_mount(position=(0.0, 0.0, 0.0), pitch_deg=30.0)
    np.testing.assert_allclose(down.rotate([1.0, 0.0, 0.0]), [math.sqrt(0.75), 0.0, -0.5], atol=1e-15)


@pytest.mark.parametrize(
    ("make", "wrong"),
    [
        (Raster, {"rows": 0}),
        (Raster, {"interleave": 0}),
        (Raster, {"azimuth_deg": (10.0, -10.0)}),
        (Raster, {"elevation_deg": (0.0, 91.0)}),
        (Rosette, {"fov_deg": 0.0}),
        (Rosette, {"shots_per_second": float("nan")}),
        (Rosette, {"share": 1.5}),
        (SolidStateSpec, {"offset_ns": PERIOD_NS}),
        (SolidStateSpec, {"drop_rate": -0.1}),
        (SolidStateSpec, {"min_range": 200.0}),
    ],
)
def test_devices_that_cannot_be_are_refused_by_name(make, wrong):
    with pytest.raises(OptionError, match="|".join(wrong)):
        make(**wrong)
