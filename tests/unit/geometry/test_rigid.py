"""Rotations and paths of poses against SciPy, slow oracles, and where digits are easily lost; rigid transforms."""

import math
import pickle
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sceneloom.errors import ArrayError, CalibrationError
from sceneloom.geometry import rigid
from sceneloom.geometry.rigid import RigidTransform, angle_between, interpolate_poses, slerp, thin_poses

ROUNDING = 1e-14  # some tens of operations on numbers of size 1, each rounded by 1e-16
QUARTER_LEFT = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))


@pytest.fixture(scope="module")
def quaternions():
    """Random rotations, and some by half a circle or nearly none, where formulas lose their digits."""
    axes = np.vstack([np.eye(3), np.random.default_rng(1).normal(size=(20, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = [0.0, 1e-12, 1e-6, 1.0, np.pi - 1e-8, np.pi]
    special = [np.append(axis * np.sin(a / 2), np.cos(a / 2)) for axis in axes for a in angles]
    return np.vstack([np.random.default_rng(0).normal(size=(300, 4)), special])


def same_rotation(a, b):
    """Largest difference of components, whichever of q and -q was chosen."""
    return np.minimum(np.abs(a - b).max(axis=-1), np.abs(a + b).max(axis=-1))


def test_rotations_are_those_of_scipy_for_quaternions_of_any_length(quaternions):
    rotations, vectors = Rotation.from_quat(quaternions), np.random.default_rng(2).normal(size=(len(quaternions), 3))
    matrices, units, products = rotations.as_matrix(), rotations.as_quat(), rotations * rotations[::-1]
    assert np.abs(rigid.matrix_from_quaternion(quaternions) - matrices).max() < ROUNDING
    rotated = rigid.rotate_vectors(quaternions, vectors)
    assert np.abs(rotated - rotations.apply(vectors)).max() < ROUNDING
    # one rotates many, and many rotate one
    assert np.allclose(rigid.rotate_vectors(quaternions[3], vectors)[3], rotated[3])
    assert np.allclose(rigid.rotate_vectors(quaternions, vectors[3])[3], rotated[3])
    found = rigid.quaternion_from_matrix(matrices)
    assert (found[:, 3] >= 0).all()
    for one, expected in (
        (found, units),
        (rigid.multiply_quaternions(units, units[::-1]), products.as_quat()),
        (rigid.conjugate_quaternion(units), rotations.inv().as_quat()),
    ):
        assert same_rotation(one, expected).max() < ROUNDING


def test_rotation_vectors_are_those_of_scipy_and_missing_rotations_stay_missing(quaternions):
    rotations = Rotation.from_quat(quaternions)
    expected, found = rotations.as_rotvec(), rigid.rotation_vector_from_quaternion(quaternions)
    half_rotations = np.abs(np.linalg.norm(expected, axis=1) - np.pi) < 1e-7  # there v and -v are one rotation
    assert np.abs(found - expected)[~half_rotations].max() < ROUNDING
    assert same_rotation(rigid.quaternion_from_rotation_vector(found), rotations.as_quat()).max() < ROUNDING
    tiny = np.array([3e-200, -4e-200, 0.0])
    back = rigid.rotation_vector_from_quaternion(rigid.quaternion_from_rotation_vector(tiny))
    assert np.allclose(back, tiny, rtol=1e-14)
    # missing rotations stay missing without a warning, and extreme lengths are normalised
    missing = np.full((2, 4), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(rigid.rotate_vectors(missing, [1.0, 2, 3])).all()
        assert np.isnan(rigid.multiply_quaternions(missing, QUARTER_LEFT)).all()
        assert np.isnan(slerp(missing, QUARTER_LEFT, 0.5)).all()
    expected = rigid.matrix_from_quaternion(QUARTER_LEFT)
    for scale in (1e-200, 1e200):
        assert np.allclose(rigid.matrix_from_quaternion(scale * np.array(QUARTER_LEFT)), expected, atol=ROUNDING)


def test_slerp_is_that_of_scipy_inside_and_beyond_both_ends_and_keeps_the_digits_of_angles(quaternions):
    a, b = quaternions[:150], quaternions[150:300]
    for fraction in (0.0, 1e-9, 0.3, 0.999, 1.0):
        expected = [Slerp([0, 1], Rotation.from_quat([p, q]))(fraction).as_quat() for p, q in zip(a, b, strict=True)]
        # scipy goes through rotation vectors, which cost it some digits for rotations of nearly half a circle
        assert angle_between(slerp(a, b, fraction), np.array(expected)).max() < 1e-12
    expected = Rotation.from_euler("z", [[-90], [180]], degrees=True).as_quat()
    assert same_rotation(slerp([0, 0, 0, 1], QUARTER_LEFT, [-1.0, 2.0]), expected).max() < ROUNDING
    # at constant speed near no rotation and near half a rotation
    for angle in (0.0, 1e-100, 1e-12, np.pi - 1e-12, np.pi):
        start, stop = rigid.quaternion_from_rotation_vector([[0.0, 0, 0], [0, angle, 0]])
        rotated = angle_between(start, slerp(start, stop, np.linspace(0, 1, 11)))
        assert np.allclose(rotated, np.linspace(0, angle, 11), rtol=1e-12, atol=ROUNDING * angle)
    start, stop = rigid.quaternion_from_rotation_vector([[0.0, 0, 0], [1e-12, 0, 0]])
    assert angle_between(start, stop) == pytest.approx(1e-12, rel=1e-3)  # the quaternion's own rounding
    assert angle_between(start, -start) == 0.0


def test_a_rounded_rotation_is_brought_back_to_the_nearest_and_its_error_reported():
    rotation = Rotation.from_euler("xyz", [0.1, -0.4, 2.0]).as_matrix()
    rounded = np.round(rotation, 3)
    found, error = rigid.nearest_rotation(rounded)
    assert np.abs(found @ found.T - np.eye(3)).max() < ROUNDING
    assert error == pytest.approx(np.abs(rounded @ rounded.T - np.eye(3)).max())
    assert np.abs(found - rotation).max() < 1e-3  # no farther from the truth than the rounding took it
    # a mirror is no rotation however orthonormal it is
    assert rigid.nearest_rotation(np.diag([1e300, 1.0, 1.0]))[1] == math.inf
    mirrored, error = rigid.nearest_rotation(np.diag([1.0, 1.0, -1.0]))
    assert error == np.inf
    assert np.linalg.det([found, mirrored]) == pytest.approx(1.0)
    matrix = Rotation.from_rotvec([0.3, 0.2, -1]).as_matrix() + 0.05 * np.random.default_rng(5).normal(size=(3, 3))
    found, _ = rigid.nearest_rotation(matrix)
    for step in np.vstack([np.eye(3), -np.eye(3)]) * 1e-4:
        neighbour = found @ Rotation.from_rotvec(step).as_matrix()
        assert np.linalg.norm(matrix - found) < np.linalg.norm(matrix - neighbour)
    rounded = np.round(WORLD_FROM_EGO.matrix, 4)
    transform, error = RigidTransform.nearest(rounded)
    assert 1e-6 < error < 1e-3
    assert np.abs(transform.matrix - WORLD_FROM_EGO.matrix).max() < 1e-4  # half a unit of the fourth decimal, some
    assert np.array_equal(transform.translation, rounded[:3, 3])
    assert RigidTransform.nearest(np.diag([1.0, -1, 1, 1]))[1] == np.inf


ROTATION = Rotation.from_rotvec([0.3, -0.2, 1.0])
WORLD_FROM_EGO = RigidTransform(ROTATION.as_matrix(), np.array([10.0, 20.0, 0.5]))
EGO_FROM_LIDAR = RigidTransform.from_quaternion(np.array([0.0, 0, 2]), np.array([0.0, 0, 0.1, 1]))
POINTS = np.random.default_rng(0).normal(size=(7, 3))


def test_a_transform_moves_points_rotates_directions_and_comes_back_from_its_parts_and_other_processes():
    assert np.allclose(WORLD_FROM_EGO.apply(POINTS), np.add(ROTATION.apply(POINTS), [10, 20, 0.5]), atol=1e-14)
    assert np.allclose(WORLD_FROM_EGO.rotate(POINTS), ROTATION.apply(POINTS), atol=1e-14)
    assert np.array_equal(RigidTransform.identity().apply(POINTS), POINTS)
    world_from_lidar = WORLD_FROM_EGO @ EGO_FROM_LIDAR
    assert np.allclose(world_from_lidar.apply(POINTS), WORLD_FROM_EGO.apply(EGO_FROM_LIDAR.apply(POINTS)))
    assert np.allclose(world_from_lidar.matrix, WORLD_FROM_EGO.matrix @ EGO_FROM_LIDAR.matrix)
    np.testing.assert_array_equal(WORLD_FROM_EGO.inverse_matrix, WORLD_FROM_EGO.inverse().matrix)
    again = RigidTransform.from_quaternion(WORLD_FROM_EGO.translation, WORLD_FROM_EGO.quaternion_xyzw)
    found, error = RigidTransform.nearest(WORLD_FROM_EGO.matrix[:3])
    assert error < 1e-14
    for one in (again, found):
        assert np.allclose(one.matrix, WORLD_FROM_EGO.matrix, atol=1e-14)
    assert np.array_equal(pickle.loads(pickle.dumps(WORLD_FROM_EGO)).matrix, WORLD_FROM_EGO.matrix)
    with pytest.raises(ValueError, match="read-only"):
        WORLD_FROM_EGO.translation[0] = 1.0


@pytest.mark.parametrize(
    ("make", "values", "error", "message"),
    [
        *(
            (rigid.nearest_rotation, (wrong,), CalibrationError, "expected 3x3 finite numbers")
            for wrong in (np.full((3, 3), np.nan), np.eye(4), [[1, 2], [3, 4]])
        ),
        (rigid.matrix_from_quaternion, ([[0, 0, 0, 1], [0, 0, 0, 0]],), ArrayError, "expected a rotation"),
        (rigid.rotation_vector_from_quaternion, ([0, 0, 0, 0],), ArrayError, "expected a rotation"),
        (rigid.matrix_from_quaternion, ([0, 0, 1],), ArrayError, r"expected \(\.\.\., 4\)"),
        (RigidTransform.nearest, (np.eye(3),), CalibrationError, "4x4 or 3x4"),
        (RigidTransform.nearest, (np.full((4, 4), np.inf),), CalibrationError, "finite"),
        (RigidTransform.nearest, (WORLD_FROM_EGO.matrix.T,), CalibrationError, "last row"),
        *(
            (RigidTransform, (rotation, np.array(translation)), CalibrationError, "orthonormal right-handed")
            for rotation, translation in (
                (1.00001 * np.eye(3), [0.0, 0.0, 0.0]),
                (np.diag([1.0, 1, -1]), [0.0, 0.0, 0.0]),
                (np.full((3, 3), np.nan), [0.0, 0.0, 0.0]),
                (np.eye(3), [0.0, np.nan, 0.0]),
            )
        ),
    ],
)
def test_what_is_no_rotation_or_not_rigid_is_refused(make, values, error, message):
    with pytest.raises(error, match=message):
        make(*values)


EPOCH_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000


@pytest.fixture
def path():
    """Six uneven poses at today's epoch, rotating by up to a third of a circle from one to the next."""
    rng = np.random.default_rng(0)
    times = EPOCH_NS + np.array([0, 100, 250, 251, 400, 1000]) * 1_000_000
    rotations = Rotation.from_rotvec(np.cumsum(rng.uniform(-1, 1, (6, 3)), axis=0)).as_quat()
    return times, rng.uniform(-100, 100, (6, 3)), rotations


def slow_pose(times, positions, quaternions, query):
    """One pose, by exact integer arithmetic and scipy."""
    k = max(i for i in range(len(times) - 1) if i == 0 or times[i] <= query)
    fraction = (int(query) - int(times[k])) / (int(times[k + 1]) - int(times[k]))
    position = [(1 - fraction) * p + fraction * q for p, q in zip(positions[k], positions[k + 1], strict=True)]
    return position, Slerp([0, 1], Rotation.from_quat(quaternions[k : k + 2]))(fraction).as_quat()


def test_poses_between_are_those_of_a_slow_oracle(path):
    queries = np.random.default_rng(1).integers(path[0][0], path[0][-1], 300)
    positions, quaternions, coverage = interpolate_poses(*path, queries)
    expected = [slow_pose(*path, query) for query in queries]
    assert np.allclose(positions, [p for p, _ in expected], atol=1e-12)  # 1e-16 of 100 m, some operations
    assert angle_between(quaternions, np.array([q for _, q in expected])).max() < 1e-12
    assert (coverage == 0).all()
    # a nanosecond counts at today's epoch: float64 seconds would resolve 238 ns
    times, positions = EPOCH_NS + np.array([0, 1000]), np.array([[0.0, 0, 0], [1000.0, 0, 0]])
    found, _, _ = interpolate_poses(times, positions, np.tile([0.0, 0, 0, 1], (2, 1)), times[:1] + 1)
    assert found[0, 0] == 1.0


def test_beyond_the_ends_velocity_and_rotating_go_on_as_far_as_the_reach(path):
    rotations = Rotation.from_euler("z", [[0], [10]], degrees=True).as_quat()
    ends, queries = np.array([0, SECOND_NS]), np.array([-1, -1, 0, 1, 2, 2]) * SECOND_NS + [-1, 0, 0, 0, 0, 1]
    positions, quaternions, coverage = interpolate_poses(
        ends, np.array([[0.0, 0, 0], [3.0, 0, 0]]), rotations, queries, reach_ns=SECOND_NS
    )
    assert coverage.tolist() == [2, 1, 0, 0, 1, 2]
    assert coverage.dtype == np.uint8
    assert np.array_equal(positions[:, 0], [np.nan, -3, 0, 3, 6, np.nan], equal_nan=True)
    yaw = Rotation.from_quat(quaternions[1:5]).as_euler("zyx", degrees=True)[:, 0]
    assert np.allclose(yaw, [-10, 0, 10, 20])
    assert np.isnan(quaternions[[0, 5]]).all()
    # without reach nothing beyond the ends is given
    positions, quaternions, coverage = interpolate_poses(*path, np.array([path[0][0] - 1, path[0][-1] + 1]))
    assert coverage.tolist() == [2, 2]
    assert np.isnan(np.hstack([positions, quaternions])).all()
    # a path of one pose is stationary within its reach
    position, quaternion, queries = [1.0, 2, 3], [0.0, 0, 0, 1], np.array([30, 49, 50, 60, 61])
    positions, quaternions, coverage = interpolate_poses(
        np.array([50]), np.array([position]), np.array([quaternion]), queries, reach_ns=10
    )
    assert coverage.tolist() == [2, 1, 0, 1, 2]
    assert np.array_equal(np.hstack([positions, quaternions])[1:4], [position + quaternion] * 3)
    # times at the edge of 64 bits are out of reach and do not wrap
    edges = np.array([np.iinfo(np.int64).min, np.iinfo(np.int64).max])
    coverages = [interpolate_poses(*path, edges, reach_ns=reach)[2].tolist() for reach in (0, SECOND_NS, edges[1])]
    assert coverages[:2] == [[2, 2], [2, 2]]
    assert coverages[2][0] == 2


def test_quaternions_come_out_unit_inputs_are_left_alone_and_an_empty_path_is_refused(path):
    before = [array.copy() for array in path]
    queries = path[0] + 5
    for array in (*path, queries):
        array.flags.writeable = False
    interpolate_poses(*path, queries, reach_ns=10)
    assert all(np.array_equal(a, b) for a, b in zip(before, path, strict=True))
    _, quaternions, _ = interpolate_poses(path[0], path[1], 1.005 * path[2], path[0][:1] + 7)
    assert np.linalg.norm(quaternions[0]) == pytest.approx(1.0, abs=1e-15)
    found = interpolate_poses(*path, np.zeros(0, np.int64))
    assert [array.shape for array in found] == [(0, 3), (0, 4), (0,)]
    with pytest.raises(ArrayError, match="at least one"):
        interpolate_poses(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)), np.array([1]))


STEP_NS = 5_000_000
POSITION_TOLERANCE, ROTATION_TOLERANCE = 1e-3, np.radians(0.01)
NEARLY = 1 + 1e-6  # two slerps of nearly one axis do not differ quite linearly between two poses


def dense_path(positions, rotation_vectors=None):
    vectors = np.zeros((len(positions), 3)) if rotation_vectors is None else rotation_vectors
    return np.arange(len(positions)) * STEP_NS, positions, rigid.quaternion_from_rotation_vector(vectors)


def straight_path(count):
    return dense_path(np.outer(np.arange(count), [0.1, 0.02, 0.0]))


def winding_path(count):
    s = np.arange(count) * 0.005
    positions = np.column_stack([10 * s, 2 * np.sin(s), 0.1 * np.cos(3 * s)])
    return dense_path(positions, np.column_stack([0 * s, 0.02 * np.sin(5 * s), 0.4 * np.sin(s)]))


def trembling_path(count):
    rng = np.random.default_rng(0)
    return dense_path(rng.normal(0, 0.01, (count, 3)), rng.normal(0, 0.01, (count, 3)))


def deviation(dense, required_ns, extra):
    """Largest distance [m] and angle of the thinned path from the dense one, looked at five times per step."""
    knots_ns = np.union1d(required_ns, dense[0][extra])
    knots = interpolate_poses(*dense, knots_ns, reach_ns=10**12)[:2]
    start, stop = max(required_ns.min(), dense[0][0]), min(required_ns.max(), dense[0][-1])
    queries = np.arange(start, stop + 1, STEP_NS // 5)
    thin, true = interpolate_poses(knots_ns, *knots, queries), interpolate_poses(*dense, queries)
    return np.linalg.norm(thin[0] - true[0], axis=1).max(), angle_between(thin[1], true[1]).max()


@pytest.mark.parametrize("make", [straight_path, winding_path, trembling_path])
@pytest.mark.parametrize("every", [1, 20, 333])
def test_the_thinned_path_stays_within_the_tolerances(make, every):
    dense = make(2000)
    required = dense[0][::every] + 1_234_567  # a camera's times lie between the poses, the last beyond them
    distance, angle = deviation(dense, required, thin_poses(*dense, required))
    assert distance <= POSITION_TOLERANCE * NEARLY
    assert angle <= ROTATION_TOLERANCE * NEARLY


def test_thinned_paths_have_no_poses_on_lines_few_on_curves_and_staircases_and_one_at_a_corner():
    along, across = np.minimum(np.arange(1001), 500.0), np.maximum(np.arange(1001) - 500.0, 0.0)
    corner = dense_path(np.column_stack([along, across, 0 * along]) * 0.1)
    turn = dense_path(np.zeros((401, 3)), np.outer(np.abs(np.arange(401) - 200) * 0.001, [0, 0, 1]))
    for dense, kept in ((straight_path(5000), []), (corner, [500]), (turn, [200])):
        assert thin_poses(*dense, dense[0][[0, -1]]).tolist() == kept
    for count, kept in ((1, 0), (2, 1)):
        dense = trembling_path(count)
        assert len(thin_poses(*dense, np.array([-7, 3, 10**10]))) == kept
        assert len(thin_poses(*dense, dense[0])) == 0
    radius, speed = 50.0, 10.0
    angle = np.arange(4001) * 0.005 * speed / radius
    dense = dense_path(radius * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle]))
    fewest = angle[-1] / (2 * np.sqrt(2 * POSITION_TOLERANCE / radius))  # chords whose arcs bulge by the tolerance
    extra = thin_poses(*dense, dense[0][[0, -1]])
    assert fewest * 0.9 < len(extra) < fewest * 2.1  # halving lands at most one halving below the best length
    # a staircase of ever larger steps is split in few levels
    positions = np.zeros((20_000, 3))
    positions[:, 0] = np.exp(np.linspace(0, 12, 20_000)) * (np.arange(20_000) % 2)  # the worst is always the last
    dense = dense_path(positions)
    distance, _ = deviation(dense, dense[0][[0, -1]], thin_poses(*dense, dense[0][[0, -1]]))
    assert distance <= POSITION_TOLERANCE * NEARLY


def test_poses_at_required_times_in_any_order_are_not_repeated_and_wider_tolerances_need_fewer():
    dense = trembling_path(100)
    required = dense[0][20:80:10]
    extra = thin_poses(*dense, required)
    assert 20 < extra.min() < extra.max() < 70
    assert not np.isin(dense[0][extra], required).any()
    assert (np.diff(extra) > 0).all()
    dense = winding_path(2000)
    ends, required = dense[0][[0, -1]], dense[0][::200]
    shuffled = np.random.default_rng(0).permutation(np.repeat(required, 2))
    for given, meant in ((shuffled, required), (required[:0], ends)):
        assert np.array_equal(thin_poses(*dense, given), thin_poses(*dense, meant))
    coarse = thin_poses(*dense, ends, position_tolerance=0.05, rotation_tolerance=np.radians(1))
    assert 0 < len(coarse) < len(thin_poses(*dense, ends)) < 2000
