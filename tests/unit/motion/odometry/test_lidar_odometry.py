"""Lidar odometry, sweep by sweep, on good and on bad input; the truth is that of the simulated drive."""

import numpy as np
import pytest

from sceneloom.errors import ArrayError, OptionError
from sceneloom.motion.odometry import LidarOdometry, OdometryConfiguration, Outcome, PoseEstimate
from sceneloom.simulate import LidarSpec, PathSpec, Stop, TrafficSpec, simulate_street

SPEC = LidarSpec(beams=24, elevations_deg=(-24.0, 10.0), steps=900)
FRAMES = 16
GAP = 10

Cloud = tuple[int, np.ndarray, np.ndarray | None]


@pytest.fixture(scope="module")
def drive():
    return simulate_street(3, frames=FRAMES + GAP, lidar=SPEC, cameras=())


@pytest.fixture(scope="module")
def clouds(drive) -> list[Cloud]:
    """Sweeps in the ego frame."""
    return [
        (frame.timestamp_ns, SPEC.mount.apply(frame.points.positions), frame.points.timestamps_ns)
        for frame in drive.scene.lidars[0].frames
    ]


def follow(clouds: list[Cloud]) -> list[PoseEstimate]:
    odometry = LidarOdometry()
    estimates = [odometry.add(*cloud) for cloud in clouds]
    return [estimate for estimate in estimates if estimate is not None]


def miss(estimate: PoseEstimate, first: PoseEstimate, drive) -> float:
    """How far an estimate is from the truth [m], as seen from the first."""
    states = drive.truth.path.at(np.array([first.state.timestamp_ns, estimate.state.timestamp_ns]))
    expected = states.rotations[0].T @ (states.positions[1] - states.positions[0])
    return float(np.linalg.norm(estimate.state.position - first.state.position - expected))


def test_equal_sweeps_give_equal_bits(clouds):
    first, second = follow(clouds[:6]), follow(clouds[:6])
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.state.rotation, b.state.rotation)
        np.testing.assert_array_equal(a.state.position, b.state.position)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def spoilt(kind: str, cloud: Cloud) -> Cloud:
    timestamp, points, times = cloud
    if kind == "empty":
        return timestamp, np.zeros((0, 3)), np.zeros(0, np.int64)
    if kind == "nan":
        return timestamp, np.full_like(points, np.nan), times
    if kind == "few":
        return timestamp, points[:100], times[:100]
    generator = np.random.default_rng(0)
    return (
        timestamp,
        generator.uniform(-20, 20, (4000, 3)),
        np.linspace(times[0], times[-1], 4000).astype(np.int64),
    )


@pytest.mark.parametrize(
    ("kind", "outcome"),
    [
        ("empty", Outcome.TOO_FEW),
        ("nan", Outcome.TOO_FEW),
        ("few", Outcome.TOO_FEW),
        ("noise", Outcome.MISFIT),
    ],
)
def test_a_sweep_that_states_nothing_is_predicted_with_a_larger_covariance_and_the_next_one_finds_back(
    clouds, drive, kind, outcome
):
    estimates = follow([spoilt(kind, cloud) if k == 6 else cloud for k, cloud in enumerate(clouds[:10])])
    assert [estimate.outcome for estimate in estimates[5:8]] == [Outcome.FITTED, outcome, Outcome.FITTED]
    # a car accelerates by some m/s², so 0.1 s of prediction miss by centimetres
    assert miss(estimates[6], estimates[0], drive) < 0.1
    assert np.trace(estimates[6].covariance) > 2 * np.trace(estimates[5].covariance)
    assert miss(estimates[9], estimates[0], drive) < 0.03


def test_points_that_are_no_numbers_or_absurdly_far_change_nothing(clouds):
    timestamp, points, times = clouds[3]
    strange = np.array([[np.nan, 0, 0], [np.inf, 1, 1], [1e30, 0, 0], [0, 0, 0]])
    dirty = [
        *clouds[:3],
        (timestamp, np.vstack([points, strange]), np.concatenate([times, times[-4:]])),
        clouds[4],
    ]
    for clean, found in zip(follow(clouds[:5]), follow(dirty), strict=True):
        np.testing.assert_array_equal(clean.state.position, found.state.position)


def test_after_a_gap_in_time_a_new_map_begins_where_the_motion_before_leads(clouds, drive):
    estimates = follow([*clouds[:8], *clouds[8 + GAP :]])
    assert [k for k, e in enumerate(estimates) if e.outcome is Outcome.RESTARTED] == [8]
    deviation = np.sqrt(np.diag(estimates[8].covariance)[3:])
    assert deviation.min() > 0.5
    assert miss(estimates[8], estimates[0], drive) < 3 * np.linalg.norm(deviation)
    after = miss(estimates[-1], estimates[8], drive)
    assert (
        after < 0.5
    )  # the heading is as uncertain as the rotating during a second, but the trajectory goes on


def test_the_same_sweep_over_and_over_is_a_stationary_ego(clouds):
    timestamp, points, times = clouds[0]
    period = 100_000_000
    estimates = follow([(timestamp + k * period, points, times + k * period) for k in range(20)])
    assert max(np.abs(estimate.state.position).max() for estimate in estimates) < 0.005


def test_a_sweep_that_is_not_later_than_the_one_before_changes_nothing(clouds):
    odometry = LidarOdometry()
    for cloud in clouds[:4]:
        odometry.add(*cloud)
    assert odometry.add(*clouds[1]) is None
    after = odometry.add(*clouds[4])
    np.testing.assert_array_equal(after.state.position, follow(clouds[:5])[4].state.position)


def test_sweeps_before_the_first_with_points_stand_at_its_pose(clouds):
    estimates = follow([spoilt("empty", clouds[0]), spoilt("nan", clouds[1]), *clouds[2:5]])
    outcomes = [Outcome.TOO_FEW, Outcome.TOO_FEW, Outcome.STARTED, Outcome.FITTED, Outcome.FITTED]
    assert [estimate.outcome for estimate in estimates] == outcomes
    np.testing.assert_array_equal(estimates[2].state.position, 0.0)


def test_without_point_times_the_trajectory_is_found_less_well_but_found(clouds, drive):
    estimates = follow([(timestamp, points, None) for timestamp, points, _ in clouds[:12]])
    assert {estimate.outcome for estimate in estimates[1:]} == {Outcome.FITTED}
    assert miss(estimates[-1], estimates[0], drive) < 0.5


def test_a_bare_plain_states_nothing_about_the_trajectory_along_it_and_the_covariance_says_so():
    generator, odometry = np.random.default_rng(0), LidarOdometry()
    for k in range(15):
        times = np.linspace(k * 10**8, k * 10**8 + 9 * 10**7, 8000).astype(np.int64)
        plain = np.column_stack([generator.uniform(-40, 40, (8000, 2)), np.full(8000, -1.0)])
        estimate = odometry.add(k * 10**8, plain, times)
    along_x, along_y, height = np.sqrt(np.diag(estimate.covariance)[3:])
    assert min(along_x, along_y) > 0.5
    assert height < 0.02


@pytest.mark.slow
def test_a_stationary_car_stays_where_it_is_while_others_pass():
    path = PathSpec(stops=(Stop(0.0, 12.0),))
    drive = simulate_street(
        5, frames=40, lidar=SPEC, cameras=(), path=path, traffic=TrafficSpec(cars=5.0, pedestrians=8.0)
    )
    estimates = follow(
        [
            (frame.timestamp_ns, SPEC.mount.apply(frame.points.positions), frame.points.timestamps_ns)
            for frame in drive.scene.lidars[0].frames
        ]
    )
    # a centimetre is what 2 cm of range noise leave in the first sweep's surfaces
    assert max(np.linalg.norm(estimate.state.position) for estimate in estimates) < 0.015


def test_shapes_and_settings_that_make_no_sense_are_refused():
    with pytest.raises(ArrayError, match="positions_ego"):
        LidarOdometry().add(0, np.zeros((4, 2)))
    with pytest.raises(ArrayError, match="timestamps_ns"):
        LidarOdometry().add(0, np.zeros((4, 3)), np.zeros(3, np.int64))
    with pytest.raises(OptionError, match="cube"):
        OdometryConfiguration(cube=0.0)
    with pytest.raises(OptionError, match="farthest"):
        OdometryConfiguration(farthest=1.0)
