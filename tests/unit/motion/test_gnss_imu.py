"""The GNSS/IMU smoother: its equations against differences, fixes between states, and drives whose truth is known."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry import rigid
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.kernels.imu_chain import SIZE
from sceneloom.motion import gnss_imu
from sceneloom.motion.ego_trajectory import find_ego_motion, with_trajectory_estimated
from sceneloom.scene import GnssSensor, ImuSensor, PlainAnnotation, Scene, Trajectory, VectorSamples, WarningKind
from sceneloom.simulate.drive import GRAVITY, GnssSpec, ImuSpec, ImuTruth, gnss_sensor, imu_sensor, imu_truth
from sceneloom.simulate.trajectory import EgoPath, PathSpec, Stop

COUNT = 5
WEIGHTS = np.array([1.0, 0.5, 1.0])


def rotated(rng, size, count):
    return rigid.matrix_from_quaternion(rigid.quaternion_from_rotation_vector(size * rng.standard_normal((count, 3))))


def made_up_chain(rng, parts):
    knots = np.array([0, 400, 1000, 1300, 2000]) * 1_000_000
    times = np.arange(0, 2_000_000_001, 10_000_000)
    values = np.hstack([0.3 * rng.standard_normal((201, 3)), rng.standard_normal((201, 3))])
    values[:, 5] += 9.8
    samples = gnss_imu.InertialSamples(times, values, np.empty((0, 2), np.int64))
    inertial = samples.preintegrated(knots, biases=np.zeros((4, 6)), densities=np.tile([1e-4, 1e-2], (4, 1)))
    locations, seconds = np.array([0, 2, 4]), np.array([0.3, 0.0, -0.01])
    fixes = gnss_imu.Fixes(
        knots[locations] + np.int64(seconds * 1e9), locations, seconds, rng.standard_normal((3, 3)),
        rng.standard_normal((3, 3)), np.array([0.44, 0.0, 0.0]), rng.standard_normal((3, 3, 6)),
        0.02 * rng.standard_normal((3, 6)), rng.uniform(0.5, 2.0, (3, 3)), np.zeros(3, np.int64),
        np.zeros((3, 3)),
    )  # fmt: skip
    spread = rng.standard_normal((2, 6, 6))
    relative = gnss_imu.RelativePoses(
        np.array([1, 3]), rotated(rng, 0.5, 2), rng.standard_normal((2, 3)),
        spread @ spread.swapaxes(1, 2) + np.eye(6),
    )  # fmt: skip
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    speeds = gnss_imu.BodySpeeds(np.array([1, 4]), axes, np.array([0.0, 0.7]), np.array([0.3, 0.4]))
    chain = gnss_imu.Chain(
        knots, np.array([True, "i" in parts, False, True]), inertial, fixes, 9.8, gnss_imu.SmootherSettings()
    )
    if "i" not in parts:
        chain = replace(chain, measured=np.zeros(4, np.bool_))
    return replace(chain, relative=(relative,) if "r" in parts else (), speeds=(speeds,) if "s" in parts else ())


def made_up_states(rng):
    moving = rotated(rng, 0.7, COUNT), *rng.standard_normal((2, COUNT, 3))
    return gnss_imu.States(*moving, 0.02 * rng.standard_normal((COUNT, 6)))


@pytest.mark.parametrize("parts", ["", "i", "r", "s", "irs"])
def test_the_right_side_is_half_the_falling_slope_of_the_cost(parts):
    rng = np.random.default_rng(len(parts))
    chain, states = made_up_chain(rng, parts), made_up_states(rng)
    here, size = gnss_imu.equations(chain, states, WEIGHTS), 1e-6
    for row in range(COUNT):
        for column in range(15):
            move = np.zeros((COUNT, 15))
            move[row, column] = size
            up, down = (gnss_imu.equations(chain, states.stepped(s * move), WEIGHTS).cost for s in (1, -1))
            # costs of some 1e5 leave 1e-11 of them, over 2e-6, to rounding
            assert -(up - down) / (4 * size) == pytest.approx(
                here.right[row, column], rel=1e-4, abs=1e-5 * here.cost + 1e-3
            )


def test_steps_along_whitened_slopes_lead_to_where_no_direction_leads_down_in_parts_too():
    rng = np.random.default_rng(3)
    chain, states = made_up_chain(rng, "i"), made_up_states(rng)
    # close to what was measured, where leaving out the second order of the rotation does not matter
    for _ in range(30):
        states = gnss_imu.step(chain, states, WEIGHTS, 0.0).states
    here = gnss_imu.equations(chain, states, WEIGHTS)
    residuals, first, second = gnss_imu.inertial_residuals(chain, states)
    for k in np.flatnonzero(chain.measured):
        coupling = first[k].T @ chain.information[k] @ second[k]
        assert np.allclose(coupling[:9, :9], here.couplings[k][:9, :9], rtol=1e-2, atol=1e-2 * np.abs(coupling).max())
        assert residuals[k] @ chain.information[k] @ residuals[k] <= here.cost
    rng = np.random.default_rng(4)
    chain, states = made_up_chain(rng, "irs"), made_up_states(rng)
    before, damping = gnss_imu.equations(chain, states, WEIGHTS).cost, 1e-4
    for _ in range(60):
        gone = gnss_imu.step(chain, states, WEIGHTS, damping)
        states, damping = gone.states, gone.damping
    after = gnss_imu.equations(chain, states, WEIGHTS)
    assert after.cost < before
    solution = np.abs(after.right).max(axis=0) / np.sqrt(np.abs(after.blocks).max(axis=(0, 1)))
    assert solution.max() < 1e-2 * np.sqrt(after.cost)
    chain = made_up_chain(np.random.default_rng(5), "irs").part(1, 4)
    assert (len(chain.knots_ns), chain.fixes.knots.tolist(), chain.relative[0].knots.tolist()) == (3, [1], [0])
    assert (chain.speeds[0].knots.tolist(), len(chain.inertial.rotations)) == ([0], 2)


PATH = PathSpec(yaw_rate=0.8, speeds=(3.0, 5.0)).plan(np.random.default_rng(0), start_ns=0, duration=10.0)
KNOTS = np.array([500, 1400, 2300, 3200]) * 1_000_000
TIMES = np.array([490, 500, 800, 1399, 1500, 2000, 2309, 3200, 3210]) * 1_000_000
LEVER = np.array([0.4, -0.3, 1.2])
MEASURED = np.array([True, True, True])


def samples(gaps=()):
    times = np.arange(1960, dtype=np.int64) * 5_000_000
    truth = imu_truth(ImuSpec(), PATH, times, seed=0)
    values = np.hstack([truth.angular_rates, truth.specific_forces])
    return gnss_imu.InertialSamples(times, values, np.array(gaps, np.int64).reshape(-1, 2))


def carried(measured=MEASURED, bias=0.0):
    states, count = PATH.at(TIMES), len(TIMES)
    sigmas, levers = np.ones((count, 3)), np.tile(LEVER, (count, 1))
    positions = states.positions + states.rotations @ LEVER
    reported, receivers = np.zeros(count, np.bool_), np.zeros(count, np.int64)
    fixes = gnss_imu.GnssFixes(TIMES, positions, sigmas, reported, levers, receivers, np.zeros(3), ())
    return fixes.carried(KNOTS, measured, samples(), biases=np.tile(bias, (3, 1)) + np.zeros(6), gravity=GRAVITY)


def expected(fixes, moved=None):
    """Where true states state that the antennas are, (F, 3), moved by (K, 15)."""
    moved = np.zeros((len(KNOTS), SIZE)) if moved is None else moved
    states, at = PATH.at(KNOTS), fixes.knots
    rotations = states.rotations @ rigid.matrix_from_quaternion(rigid.quaternion_from_rotation_vector(moved[:, :3]))
    levers = fixes.levers + np.einsum("nij,nj->ni", fixes.slopes, moved[at, 9:] - fixes.biases)
    away = np.einsum("nij,nj->ni", rotations[at], levers) - fixes.falls[:, None] * [0.0, 0.0, 1.0]
    trajectories = fixes.seconds[:, None] * (states.velocities + moved[:, 6:9])[at]
    return states.positions[at] + moved[at, 3:6] + trajectories + away


def test_true_states_expect_the_antenna_where_it_is_and_lie_apart_only_where_the_imu_leads_well():
    found = carried()
    assert found.knots.tolist() == [0, 0, 0, 0, 1, 1, 2, 3, 3]
    # 10 ms beyond the first and the last state nothing but the velocity leads on: 1 m/s² and turns of 1 rad/s leave
    # less than a millimetre of the ego, and a centimetre of the lever
    limits = np.where((KNOTS[0] > TIMES) | (KNOTS[-1] < TIMES), 2e-2, 1e-4)
    assert (np.abs(expected(found) - found.positions).max(axis=1) < limits).all()
    found = carried(~MEASURED)
    assert found.knots.tolist() == [0, 0, 0, 1, 1, 2, 2, 3, 3]
    assert not found.falls.any()
    assert np.array_equal(found.levers, np.tile(LEVER, (len(TIMES), 1)))
    # a bias taken off is one known to the slopes
    plain, other = carried(), carried(bias=np.array([2e-3, -1e-3, 3e-3, 0.05, -0.04, 0.02]))
    assert np.abs(other.levers - plain.levers).max() > 0.01
    # what is second order in 3e-3 rad and 0.05 m/s² over 0.9 s
    assert np.abs(expected(other) - expected(plain)).max() < 1e-4
    fixes = np.arange(0, 9_700_000_001, 100_000_000, dtype=np.int64)
    settings = gnss_imu.SmootherSettings()
    quiet = gnss_imu.knot_times(fixes, samples(), np.empty(0, np.int64), settings)
    assert np.diff(quiet).max() == 500_000_000
    assert len(quiet) < len(fixes) / 4
    with_gap = gnss_imu.knot_times(fixes, samples(((3_040_000_000, 5_060_000_000),)), np.empty(0, np.int64), settings)
    inside = with_gap[(with_gap > 3_040_000_000) & (with_gap < 5_060_000_000)]
    assert inside.tolist() == [time for time in fixes.tolist() if 3_060_000_000 <= time <= 5_040_000_000]
    assert {3_040_000_000, 5_060_000_000} <= set(with_gap.tolist())
    noisy = samples()
    noisy.values[:, 3:] += 3.0 * np.random.default_rng(2).standard_normal((len(noisy.values), 3))
    assert len(gnss_imu.knot_times(fixes, noisy, np.empty(0, np.int64), settings)) >= len(fixes)
    # times of no IMU are all states
    fixes = np.array([0, 5, 30, 2000]) * 1_000_000
    knots = gnss_imu.knot_times(fixes, None, np.array([15, 1000], np.int64) * 1_000_000, gnss_imu.SmootherSettings())
    assert knots.tolist() == [0, 30_000_000, 1_000_000_000, 2_000_000_000]
    with pytest.raises(OptionError, match="gate"):
        gnss_imu.SmootherSettings(gate=0.0)


@pytest.mark.slow
def test_variances_are_those_of_drawn_states():
    rng, found = np.random.default_rng(1), carried()
    roots = 1e-3 * rng.standard_normal((len(KNOTS), SIZE, SIZE))
    own = roots @ roots.swapaxes(1, 2)
    drawn = [
        expected(found, np.einsum("kij,kj->ki", roots, rng.standard_normal((len(KNOTS), SIZE)))) for _ in range(4000)
    ]
    # a variance of 4000 draws has a deviation of √(2 / 4000) = 2.2 %
    variances = found.variances(PATH.at(KNOTS).rotations, own)
    assert np.var(drawn, axis=0) == pytest.approx(variances, rel=0.1)


# the synthetic world has the same gravity everywhere, and most of its receivers no slow errors
SETTINGS = gnss_imu.SmootherSettings(gravity=GRAVITY, slow_error=0.01)
ORIGIN = GnssSpec().origin_lla
SECOND = 1_000_000_000


@dataclass(frozen=True)
class Drive:
    path: EgoPath
    truth: ImuTruth
    imu: ImuSensor
    gnss: GnssSensor

    def scene(self, imu=None, gnss=None):
        return Scene((imu or self.imu, gnss or self.gnss), source="made up")

    def run(self, imu=None, gnss=None):
        return gnss_imu.gnss_imu_motion(self.scene(imu, gnss), settings=SETTINGS)


def drive(seed, *, seconds=40.0, rate=2.0, imu=None, path=None, gnss=None):
    imu, gnss = imu or ImuSpec(rate_hz=100.0), gnss or GnssSpec(rate_hz=rate)
    trajectory = (path or PathSpec()).plan(np.random.default_rng(seed), start_ns=0, duration=seconds)
    samples = np.arange(int(seconds * imu.rate_hz)) * round(SECOND / imu.rate_hz) + 1_300_000
    fixes = np.arange(int(seconds * rate)) * round(SECOND / rate)
    truth = imu_truth(imu, trajectory, samples, seed=seed)
    return Drive(trajectory, truth, imu_sensor(imu, truth, seed=seed), gnss_sensor(gnss, trajectory, fixes, seed=seed))


def errors(run, path):
    """(N, 6) rotate [rad] and shift [m] about the world's axes, away from the truth."""
    states = path.at(run.trajectory.timestamps_ns)
    rotations = rigid.multiply_quaternions(
        run.trajectory.quaternions_xyzw, rigid.conjugate_quaternion(states.quaternions_xyzw)
    )
    shift = enu_from_geodetic(run.origin_lla, ORIGIN)
    return np.hstack(
        [rigid.rotation_vector_from_quaternion(rotations), run.trajectory.positions + shift - states.positions]
    )


def rms(values):
    return float(np.sqrt((values**2).sum(axis=1).mean()))


def in_deviations(run, path, part=slice(0, 6)):
    """Squared error in units of the covariance, per degree of freedom."""
    away, covariances = errors(run, path)[:, part], run.trajectory.covariances[:, part, part]
    return float((away * np.linalg.solve(covariances, away[:, :, None])[:, :, 0]).sum(axis=1).mean() / away.shape[1])


def enu(gnss):
    return enu_from_geodetic(gnss.positions_lla, ORIGIN)


def moved(gnss, positions, **others):
    return replace(gnss, positions_lla=geodetic_from_enu(positions, ORIGIN), **others)


def some_fixes(gnss, rows):
    return GnssSensor(
        gnss.id, gnss.timestamps_ns[rows], gnss.positions_lla[rows], gnss.accuracies[rows],
        gnss.vertical_accuracies[rows],
    )  # fmt: skip


@pytest.fixture(scope="module")
def town():
    return drive(5)


def test_without_fixes_or_imu_the_other_leads_on_and_an_ego_that_always_stands_has_no_heading(town):
    seconds = town.gnss.timestamps_ns / SECOND
    rows = (seconds < 15) | (seconds > 25)
    run = town.run(gnss=some_fixes(town.gnss, rows))
    assert rms(errors(run, town.path)[:, 3:5]) < 0.3
    assert in_deviations(run, town.path, slice(3, 6)) < 2.5
    out = (run.trajectory.timestamps_ns > 19 * SECOND) & (run.trajectory.timestamps_ns < 21 * SECOND)
    east = run.trajectory.covariances[:, 3, 3]
    assert east[out].mean() > 1.2 * np.median(east)
    seconds = town.imu.streams["gyroscope"].timestamps_ns / SECOND
    rows = (seconds < 15) | (seconds > 20)
    streams = {name: VectorSamples(s.timestamps_ns[rows], s.values[rows]) for name, s in town.imu.streams.items()}
    run = town.run(imu=ImuSensor(town.imu.id, streams))
    assert rms(errors(run, town.path)[:, 3:5]) < 0.4
    assert np.degrees(rms(errors(run, town.path)[:, 2:3])) < 4.0
    assert "imu-gaps" in [warning.code for warning in run.warnings]
    rng, times = np.random.default_rng(0), np.arange(2000) * 10_000_000
    streams = {
        "gyroscope": VectorSamples(times, 0.001 * rng.standard_normal((2000, 3))),
        "accelerometer": VectorSamples(times, [0, 0, GRAVITY] + 0.01 * rng.standard_normal((2000, 3))),
    }
    fixes, unknown = np.arange(20) * SECOND, np.full(20, np.nan)
    gnss = GnssSensor("gnss", fixes, geodetic_from_enu(rng.standard_normal((20, 3)), ORIGIN), unknown, unknown)
    run = gnss_imu.gnss_imu_motion(Scene((ImuSensor("imu", streams), gnss)))
    assert "heading-unknown" in [warning.code for warning in run.warnings]
    spread = np.linalg.norm(run.trajectory.positions - run.trajectory.positions.mean(axis=0), axis=1)
    # in 20 fixes of a metre some decimetres of drift cannot be told from noise
    assert spread.max() < 0.4


@pytest.mark.parametrize("mounting", [(0.0, 0.0, 3.0), (0.0, 1.2, 0.5)])
def test_an_imu_that_looks_elsewhere_is_found_to(mounting, town):
    rotation = rigid.matrix_from_quaternion(rigid.quaternion_from_rotation_vector(np.array(mounting)))
    streams = {name: VectorSamples(s.timestamps_ns, s.values @ rotation.T) for name, s in town.imu.streams.items()}
    run = town.run(imu=ImuSensor("imu", streams))
    back = rigid.quaternion_from_matrix(rigid.matrix_from_quaternion(run.trajectory.quaternions_xyzw) @ rotation)
    looked = replace(run, trajectory=replace(run.trajectory, quaternions_xyzw=back))
    away, heading = errors(looked, town.path), np.sqrt(run.trajectory.covariances[:, 2, 2])
    assert (np.abs(away[:, 2]) < 4.0 * heading + 0.02).all()
    assert np.degrees(rms(away[:, :2])) < 1.0
    assert np.degrees(rms(away[:, 2:3])) < 10.0


def test_errors_are_small_and_as_large_as_the_covariances_state_at_low_rates_and_after_stands_too():
    squares, away, biases = [], [], []
    for seed in range(6):
        one = drive(seed)
        run = one.run()
        squares.append(in_deviations(run, one.path))
        away.append(errors(run, one.path))
        middle = run.biases[len(run.biases) // 2]
        spread = np.sqrt(np.einsum("kii->ki", run.covariances)[len(run.covariances) // 2, 9:])
        true = np.concatenate([one.truth.gyroscope_bias, one.truth.accelerometer_bias])
        biases.append((middle - true) / spread)
    all_away = np.vstack(away)
    assert rms(all_away[:, 3:5]) < 0.2  # fixes of 0.4 m an axis
    assert rms(all_away[:, 5:]) < 0.3
    assert np.degrees(rms(all_away[:, 2:3])) < 1.0
    assert np.degrees(rms(all_away[:, :2])) < 0.2
    # neighbouring errors are alike: a drive counts as some five independent states of six numbers, so that the mean
    # over six has a deviation of √(2 / 180) = 0.1; below 1 by what the fixes might drift
    assert 0.3 < np.mean(squares) < 1.4
    # 36 squares of one: mean 1 ± 0.24
    assert 0.25 < np.mean(np.square(biases)) < 1.6
    slow, halting = drive(6, imu=ImuSpec(rate_hz=10.0)), drive(6, path=PathSpec(stops=(Stop(0.5, 12.0),)))
    run = slow.run()
    assert rms(errors(run, slow.path)[:, 3:5]) < 0.25
    assert in_deviations(run, slow.path) < 2.0
    away = errors(halting.run(), halting.path)
    assert rms(away[:, 3:5]) < 0.25
    assert np.degrees(rms(away[:, 2:3])) < 2.0


def test_the_trajectory_is_given_at_the_rate_of_the_imu_or_of_fixes_alone_with_the_heading_of_the_motion(town):
    run = town.run()
    assert run.trajectory.name == "gnss"
    samples = town.imu.streams["gyroscope"].timestamps_ns
    assert np.isin(samples, run.trajectory.timestamps_ns).all()
    assert run.trajectory.covariances.shape == (len(run.trajectory.timestamps_ns), 6, 6)
    assert np.allclose(run.origin_lla, town.gnss.positions_lla[0])
    assert len(run.velocities) == len(run.biases) == len(run.trajectory.timestamps_ns)
    speeds = run.velocities - town.path.at(run.trajectory.timestamps_ns).velocities
    assert rms(speeds) < 0.2
    scene = Scene((town.gnss,), source="made up")
    run = gnss_imu.gnss_imu_motion(scene, settings=SETTINGS)
    assert run.trajectory.quaternions_xyzw is None
    states = town.path.at(run.trajectory.timestamps_ns)
    away = run.trajectory.positions + enu_from_geodetic(run.origin_lla, ORIGIN) - states.positions
    assert rms(away[:, :2]) < 0.5
    with pytest.raises(PoseError, match="--orientation-from motion"):
        find_ego_motion(scene, name="gnss")
    ego = find_ego_motion(scene, name="gnss", heading="motion")
    assert ego.heading == "motion"
    ahead = rigid.matrix_from_quaternion(ego.path.quaternions_xyzw)[:, :2, 0]
    cosine = (ahead * states.velocities[:, :2]).sum(axis=1) / np.linalg.norm(states.velocities[:, :2], axis=1)
    assert np.median(cosine) > np.cos(np.radians(8.0))  # fixes of 0.4 m every half second


def test_the_default_after_recorded_trajectories_says_where_its_world_is_and_that_annotations_stay(town):
    scene = town.scene()
    ego = find_ego_motion(scene)
    assert (ego.name, ego.enu_origin_lla) == ("gnss", tuple(town.gnss.positions_lla[0]))
    assert ego.covariances is not None
    placed = with_trajectory_estimated(replace(scene, metadata={"sceneloom": {"seed": 1}}), ego)
    assert placed.metadata["sceneloom"]["seed"] == 1
    assert placed.metadata["sceneloom"]["enu_origin"]["latitude"] == town.gnss.positions_lla[0, 0]
    reported = [warning for warning in ego.warnings if warning.code == "trajectory-from-gnss"]
    assert [warning.kind for warning in reported] == [WarningKind.ASSUMED]
    recorded = Trajectory("pose", np.zeros(1, np.int64), np.ones((1, 3)), np.array([[0.0, 0, 0, 1]]))
    with_pose = replace(scene, trajectories={"pose": recorded})
    assert (find_ego_motion(with_pose).name, find_ego_motion(with_pose, name="gnss").name) == ("pose", "gnss")
    scene = replace(town.scene(), annotations=(PlainAnnotation("a", "cuboid", {}),))
    recorded_one = {"pose": recorded}
    for frame, paths, reported in (("world", recorded_one, True), ("ego", recorded_one, False), ("world", {}, False)):
        annotated = replace(scene, metadata={"sceneloom": {"annotations_frame": frame}}, trajectories=paths)
        codes = {warning.code for warning in find_ego_motion(annotated, name="gnss").warnings}
        assert ("annotations-not-moved" in codes) is reported


def test_few_fixes_wrong_times_and_milliseconds_taken_for_seconds_are_reported(town):
    for count in (0, 1):
        with pytest.raises(PoseError, match="GNSS"):
            find_ego_motion(town.scene(gnss=some_fixes(town.gnss, np.arange(count))), name="gnss")
    run = town.run(gnss=some_fixes(town.gnss, np.array([0, 40])))
    assert np.isfinite(run.trajectory.positions).all()
    assert np.isfinite(run.trajectory.covariances).all()
    locations = town.gnss.positions_lla.copy()
    locations[: len(locations) // 2, 0] -= 20.0  # their middle is a hundred kilometres and more from both
    run = town.run(gnss=replace(town.gnss, positions_lla=locations))
    assert len(run.fixes) == len(locations) // 2
    assert "gnss-fixes-elsewhere" in {warning.code for warning in run.warnings}
    for wrong_ns in [9_000_000_000 * SECOND, -9_000_000_000 * SECOND, 2 * 86_400 * SECOND]:
        times = town.gnss.timestamps_ns.copy()
        times[0 if wrong_ns < 0 else -1] = wrong_ns
        with pytest.raises(PoseError, match="is a timestamp wrong"):
            town.run(gnss=replace(town.gnss, timestamps_ns=times))
    for late in ["all", "imu", "gnss", "gnss alone"]:
        gnss = replace(town.gnss, timestamps_ns=town.gnss.timestamps_ns * (1 if late == "imu" else 1000))
        times = 1 if late == "gnss" else 1000
        streams = {n: VectorSamples(s.timestamps_ns * times, s.values) for n, s in town.imu.streams.items()}
        sensors = (gnss,) if late == "gnss alone" else (ImuSensor("imu", streams), gnss)
        with pytest.raises(PoseError, match="milliseconds"):
            gnss_imu.gnss_imu_motion(Scene(sensors, source="made up"))


def test_the_antenna_may_sit_elsewhere_and_the_noise_and_slow_errors_of_fixes_are_found_whatever_they_report(town):
    lever, states = np.array([0.8, -0.4, 1.2]), town.path.at(town.gnss.timestamps_ns)
    fixes = moved(town.gnss, enu(town.gnss) + states.rotations @ lever, mount=rigid.RigidTransform(np.eye(3), lever))
    assert rms(errors(town.run(gnss=fixes), town.path)[:, 3:]) < rms(errors(town.run(), town.path)[:, 3:]) + 0.05
    nothing = np.full(len(town.gnss.timestamps_ns), np.nan)
    for accuracy in (nothing, np.full(len(nothing), 0.05)):
        run = town.run(gnss=replace(town.gnss, accuracies=accuracy, vertical_accuracies=nothing))
        # 240 residuals report a deviation to 5 %
        assert np.median(run.fix_sigmas[:, 0]) == pytest.approx(0.4, rel=0.25)
        assert np.median(run.fix_sigmas[:, 2]) == pytest.approx(0.8, rel=0.25)
    # an accuracy worse than the noise stands for what all fixes have in common
    run = town.run(gnss=replace(town.gnss, accuracies=np.full(len(nothing), 3.0)))
    assert "gnss-slow-errors" in [warning.code for warning in run.warnings]
    assert np.sqrt(run.trajectory.covariances[:, 3, 3]).min() > 2.5


def test_slow_errors_of_receivers_are_no_jumps_and_stay_in_the_covariances_of_honest_and_of_optimistic_ones():
    settings = gnss_imu.SmootherSettings(gravity=GRAVITY)
    inside = {1.0: [], 2.0: []}
    for seed in range(20, 24):
        one = drive(seed, gnss=GnssSpec(rate_hz=2.0, correlated_sigma=1.5, correlation_time=20.0))
        for optimism, found in inside.items():
            gnss = replace(
                one.gnss, accuracies=one.gnss.accuracies / optimism,
                vertical_accuracies=one.gnss.vertical_accuracies / optimism,
            )  # fmt: skip
            run = gnss_imu.gnss_imu_motion(one.scene(gnss=gnss), settings=settings)
            assert run.used.mean() > 0.95
            away, covariances = errors(run, one.path)[:, 3:5], run.trajectory.covariances[:, 3:5, 3:5]
            squares = (away * np.linalg.solve(covariances, away[:, :, None])[:, :, 0]).sum(axis=1)
            found.append(squares < 5.991)  # 95 % of chi-square with two degrees of freedom
            # fixes alone show nothing of slow errors: what the receiver states is in the covariances
            alone = gnss_imu.gnss_imu_motion(Scene((gnss,), source="made up"), settings=settings)
            assert np.sqrt(alone.trajectory.covariances[:, 3, 3].min()) > 0.9 * gnss.accuracies[0]
    # 40 s are two correlation times: whether the receiver is honest hardly shows
    assert np.mean(inside[1.0]) > 0.9
    assert np.mean(inside[2.0]) > 0.7


def test_what_a_receiver_reports_between_precise_fixes_that_drift_is_followed_within_centimetres(town):
    truth = enu(town.gnss) - enu(town.gnss) + town.path.at(town.gnss.timestamps_ns).positions
    times = town.gnss.timestamps_ns[:, None] * 1e-9
    drifting = truth + 0.8 * np.sin(times / np.array([5.0, 7.0, 9.0]))
    gnss = moved(town.gnss, drifting, accuracies=np.ones(len(truth)), vertical_accuracies=np.ones(len(truth)))
    kept = some_fixes(gnss, np.arange(0, len(truth), 4))
    run = town.run(gnss=kept)
    assert run.used.all()
    trajectory = run.trajectory
    shift = enu_from_geodetic(run.origin_lla, ORIGIN)
    found = np.stack([np.interp(times[:, 0], trajectory.timestamps_ns * 1e-9, one) for one in trajectory.positions.T])
    within = slice(0, len(truth) - 4)
    # straight lines are off by decimetres on curves, a drift of up to 0.16 m/s by 8 cm if half of 2 s went wrong
    assert rms((found.T + shift - drifting)[within, :2]) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_fixes_without_noise_of_a_stationary_ego_are_followed_within_what_they_drift(seed):
    # eight seconds: a noise that stays too large, since rounds tell it from the drift slowly, leaves 0.3 mm and more
    rng, times = np.random.default_rng(seed), np.arange(80, dtype=np.int64) * (SECOND // 10)
    rates, forces = 2e-4 * rng.standard_normal((80, 3)), 0.003 * rng.standard_normal((80, 3)) + [0.0, 0.0, GRAVITY]
    imu = ImuSensor("imu", {"gyroscope": VectorSamples(times, rates), "accelerometer": VectorSamples(times, forces)})
    drifting = 0.01 * np.sin(times[:, None] * 1e-9 / np.array([1.3, 1.7, 2.1]) + rng.uniform(0.0, 6.0, 3))
    kept, stated = slice(0, None, 10), np.full(8, 0.02)
    gnss = GnssSensor("gnss", times[kept], geodetic_from_enu(drifting[kept], ORIGIN), stated, stated)
    run = gnss_imu.gnss_imu_motion(Scene((imu, gnss), source="made up"))
    found = run.trajectory.positions + enu_from_geodetic(run.origin_lla, ORIGIN)
    columns = [np.interp(times[:71], run.trajectory.timestamps_ns, one) for one in found.T]
    assert rms((np.stack(columns, axis=1) - drifting[:71])[:, :2]) < 2e-4


@pytest.mark.parametrize("seed", range(2))
def test_a_receiver_that_drifts_determines_no_heading_of_an_ego_that_always_stands(seed):
    rng, times = np.random.default_rng(seed), np.arange(10_000, dtype=np.int64) * (SECOND // 100)
    rates = 0.002 * rng.standard_normal((len(times), 3))
    forces = 0.02 * rng.standard_normal((len(times), 3)) + [0.02, -0.03, GRAVITY]
    imu = ImuSensor("imu", {"gyroscope": VectorSamples(times, rates), "accelerometer": VectorSamples(times, forces)})
    drifting = 0.06 * np.cumsum(rng.standard_normal((500, 3)), axis=0) + 0.3 * rng.standard_normal((500, 3))
    stated = np.ones(500)
    gnss = GnssSensor("gnss", times[::20], geodetic_from_enu(drifting, ORIGIN), stated, stated)
    run = gnss_imu.gnss_imu_motion(Scene((imu, gnss), source="made up"))
    assert "heading-unknown" in [warning.code for warning in run.warnings]
    # any heading: the standard deviation of what is uniform over the circle is 104 degrees
    assert np.degrees(np.sqrt(run.trajectory.covariances[:, 2, 2].min())) > 100.0
    assert np.degrees(np.sqrt(run.covariances[:, 2, 2].min())) > 100.0
    # two antennas determine it
    cos, sin = np.cos(0.9), np.sin(0.9)
    common = 0.02 * drifting
    pair = []
    for number, x in enumerate((1.0, -1.0)):
        lever = np.array([x, 0.0, 1.5])
        shifted = common + [cos * x, sin * x, 1.5] + 0.01 * rng.standard_normal((500, 3))
        where, mount = geodetic_from_enu(shifted, ORIGIN), rigid.RigidTransform(np.eye(3), lever)
        pair.append(GnssSensor(f"gnss{number}", times[::20], where, 0.01 * stated, 0.01 * stated, mount=mount))
    run = gnss_imu.gnss_imu_motion(Scene((imu, *pair), source="made up"))
    assert "heading-unknown" not in [warning.code for warning in run.warnings]
    assert np.degrees(np.sqrt(run.trajectory.covariances[:, 2, 2].max())) < 1.0
    quaternions = run.trajectory.quaternions_xyzw
    assert np.abs(2 * np.arctan2(quaternions[:, 2], quaternions[:, 3]) - 0.9).max() < 0.01


def test_accelerations_in_g_are_refused_and_fixes_that_the_imu_contradicts_are_doubted(town):
    sensor = town.imu.streams["accelerometer"]
    in_g = {**town.imu.streams, "accelerometer": VectorSamples(sensor.timestamps_ns, sensor.values / GRAVITY)}
    with pytest.raises(PoseError, match=r"accelerations are 1\.\d+ m/s² long .* `accelerometer_unit`"):
        town.run(imu=ImuSensor("imu", in_g))
    late = replace(town.gnss, timestamps_ns=town.gnss.timestamps_ns + 18 * SECOND)
    for gnss, doubted in ((late, True), (town.gnss, False)):
        (message,) = (one.message for one in town.run(gnss=gnss).warnings if one.code == "gnss-slow-errors")
        assert ("unless the IMU contradicts them" in message) is doubted


@pytest.mark.parametrize("seed", range(2))
def test_fixes_that_step_together_and_stay_so_are_warned_of_and_honest_ones_are_not(seed):
    one = drive(seed, seconds=60.0, gnss=GnssSpec(rate_hz=2.0, correlated_sigma=1.0, correlation_time=100.0))
    stepping = enu(one.gnss)
    stepping[60:76, :2] += 8.0  # for 8 s
    for positions, expected in ((stepping, True), (enu(one.gnss), False)):
        run = gnss_imu.gnss_imu_motion(one.scene(gnss=moved(one.gnss, positions)), settings=SETTINGS)
        assert ("gnss-steps" in [warning.code for warning in run.warnings]) is expected
        shifted = (run.trajectory.timestamps_ns - one.gnss.timestamps_ns[60]) * 1e-9
        inside = (shifted > 1.0) & (shifted < 6.5)
        sigmas = np.sqrt(run.trajectory.covariances[:, 3, 3])
        assert (np.median(sigmas[inside]) > 4.0, np.median(sigmas[~inside]) > 4.0) == (expected, False)
    # off after an outage, which no span of fixes may contain, and back two seconds later
    late, kept = enu(one.gnss), np.ones(len(stepping), np.bool_)
    late[60:64, 0], late[64:, 0], kept[40:60] = late[60:64, 0] + 25.0, late[64:, 0] + 10.0, False
    positions = moved(one.gnss, late).positions_lla[kept]
    columns = (one.gnss.timestamps_ns, one.gnss.accuracies, one.gnss.vertical_accuracies)
    times, *stated = (column[kept] for column in columns)
    run = gnss_imu.gnss_imu_motion(one.scene(gnss=GnssSensor("gnss", times, positions, *stated)), settings=SETTINGS)
    assert "gnss-steps" in [warning.code for warning in run.warnings]


def test_repeated_fixes_of_a_receiver_that_stands_are_measurements_and_those_of_a_slow_one_are_none():
    times = np.arange(40, dtype=np.int64) * SECOND
    # ten seconds of braking from 10 m/s, twenty of standing, ten of accelerating
    ramp = 5.0 - 5.0 * np.linspace(1.0, 0.0, 11) ** 2
    along = 10.0 * np.concatenate([ramp[:-1], np.full(20, 5.0), 10.0 - ramp[::-1][:-1]])
    assert len(along) == 40
    unknown = np.full(40, np.nan)
    gnss = GnssSensor("gnss", times, geodetic_from_enu(np.outer(along, [1.0, 0.0, 0.0]), ORIGIN), unknown, unknown)
    run = gnss_imu.gnss_imu_motion(Scene((gnss,), source="made up"))
    assert len(run.fixes) == 40
    standing = (run.trajectory.timestamps_ns > 12 * SECOND) & (run.trajectory.timestamps_ns < 28 * SECOND)
    assert np.abs(run.trajectory.positions[standing, 0] - 50.0).max() < 0.3
    held = replace(gnss, positions_lla=gnss.positions_lla[np.arange(40) // 4 * 4])
    assert len(gnss_imu.gnss_imu_motion(Scene((held,), source="made up")).fixes) <= 10


def test_fixes_that_jump_or_are_none_and_samples_that_nothing_measures_are_left_out(town):
    rng, positions = np.random.default_rng(0), enu(town.gnss)
    jumped = rng.uniform(size=len(positions)) < 0.08
    positions[jumped, :2] += 15.0 * np.array([0.6, 0.8])
    positions[40:46, 0] += 30.0
    jumped[40:46] = True
    run = town.run(gnss=moved(town.gnss, positions))
    assert not run.used[jumped].any()
    assert run.used[~jumped].mean() > 0.95
    assert rms(errors(run, town.path)[:, 3:5]) < 0.25
    [reported] = [warning for warning in run.warnings if warning.code == "gnss-jumps"]
    assert reported.count == (~run.used).sum()
    assert reported.message.startswith(f"{reported.count} of {len(positions)} fixes left out")
    gnss, more = town.gnss, np.ones(4)
    times = np.concatenate([gnss.timestamps_ns, [7, 8, 9, 10]])
    # none at all, not finite, off the earth, at a height of no receiver
    locations = np.vstack([gnss.positions_lla, [[0, 0, 0], [np.nan, 25, 0], [200, 25, 0], [60, 25, 1e300]]])
    accuracies = np.append(gnss.accuracies, more), np.append(gnss.vertical_accuracies, more)
    run = town.run(gnss=GnssSensor("gnss", times, locations, *accuracies))
    assert {warning.code: warning.count for warning in run.warnings}["gnss-fixes-left-out"] == 4
    assert len(run.used) == len(gnss.timestamps_ns)
    for stream, torn in [("accelerometer", 1e200), ("gyroscope", -1e12)]:
        samples = town.imu.streams[stream]
        values = samples.values.copy()
        values[700, 1] = torn
        streams = {**town.imu.streams, stream: VectorSamples(samples.timestamps_ns, values)}
        run = town.run(imu=ImuSensor("imu", streams))
        assert {warning.code: warning.count for warning in run.warnings}["imu-samples"] == 1
        assert np.abs(errors(run, town.path)[:, 3:]).max() < 2.0  # as without it: fixes of 0.4 m an axis
