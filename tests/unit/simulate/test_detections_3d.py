from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sceneloom.errors import OptionError
from sceneloom.geometry.boxes import points_in_box
from sceneloom.scene import PointsFrame, ScoreForm
from sceneloom.simulate import (
    ClassSpec,
    Detector3dSpec,
    Faults,
    LidarSpec,
    MissSpec,
    ScoreSpec,
    SensorFaults,
    TrafficSpec,
    detect_3d,
    plant,
    simulate_street,
)
from sceneloom.simulate.detections import FALSE
from sceneloom.simulate.objects import PackedShapes

CARS = {"car": ClassSpec(half_evidence=8.0, false_rate=1.5, size_lwh=(4.2, 1.8, 1.5))}
SHARP = {"car": ClassSpec(half_evidence=1e-6, false_rate=0.0, size_lwh=(4.2, 1.8, 1.5))}
EVERYTHING = Detector3dSpec(classes=SHARP, misses=MissSpec(recall=1.0, hiding=0.0), flip_share=0.0)
"""Finds all there is and makes nothing up."""


FAIR = Detector3dSpec(classes=CARS, repeated=0.2)


@pytest.fixture(scope="module")
def drive():
    """A long drive past parked cars, seen by a coarse lidar without noise."""
    lidar = LidarSpec(beams=16, steps=360, range_sigma=0.0, drop_rate=0.0)
    return simulate_street(6, frames=70, lidar=lidar, cameras=())


@pytest.fixture(scope="module")
def reports(drive):
    """Everything found in each sweep, half of it twice, a tenth of it rotated back."""
    every = replace(EVERYTHING, covariances=True, repeated=0.5, flip_share=0.1, velocity_sigma=0.3)
    return detect_3d(drive, every)


@pytest.fixture(scope="module")
def fair(drive):
    """What a fair detector finds of the cars."""
    return detect_3d(drive, FAIR)


def matched(report):
    """Rows of the truth that the boxes of a report are of."""
    return [report.truth_instances.tolist().index(instance) for instance in report.instances]


def errors_of(report):
    """Errors in each box's own axes (N, 7) and how much each should have grown by its range and points (N,)."""
    rows = matched(report)
    truth = report.truth.select(rows)
    apart = report.boxes.centers - truth.centers
    own = [Rotation.from_euler("z", -yaw).apply(row) for yaw, row in zip(truth.yaws, apart, strict=True)]
    rotated = np.mod(report.boxes.yaws - truth.yaws + np.pi / 2, np.pi) - np.pi / 2
    ranges = np.linalg.norm(truth.centers, axis=1)
    growth = (1 + ranges / 60.0) * np.sqrt(1 + 30.0 / report.evidence[rows])
    sizes = report.boxes.sizes_lwh - truth.sizes_lwh
    return np.column_stack([np.reshape(own, (-1, 3)), sizes, rotated]), growth


def test_every_object_with_a_point_on_it_is_found_by_a_detector_that_finds_all(reports):
    assert sum(len(report.truth) for report in reports) > 500
    for report in reports:
        assert sorted(report.instances[~report.duplicates]) == sorted(report.truth_instances)
        assert len(report.missed) == 0


def test_errors_are_as_large_as_the_specification_says(reports):
    both = [errors_of(report) for report in reports]
    errors, growth = (np.concatenate(parts) for parts in zip(*both, strict=True))
    sigmas = np.array([0.10, 0.06, 0.04, 0.12, 0.05, 0.05, np.radians(1.5)])
    normal = errors / sigmas / growth[:, None]
    # A mean square of N normal errors is 1 with the deviation sqrt(2 / N); 4 of them are a chance of 1 in 16,000.
    # Sizes of far objects are cut off at a fifth, which takes less than 2 % off.
    allowed = 4 * np.sqrt(2 / len(normal)) + 0.02
    np.testing.assert_allclose((normal**2).mean(axis=0), 1.0, atol=allowed)
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=4 / np.sqrt(len(normal)) + 0.02)
    assert np.percentile(growth, 95) > 2 * np.percentile(growth, 5)


def test_the_stated_covariances_hold_the_errors(reports):
    distances = []
    for report in reports:
        truth = report.truth.select(matched(report))
        error = np.column_stack(
            [
                report.boxes.centers - truth.centers,
                report.boxes.sizes_lwh - truth.sizes_lwh,
                np.mod(report.boxes.yaws - truth.yaws + np.pi / 2, np.pi) - np.pi / 2,
            ]
        )
        distances += list(np.einsum("ni,nij,nj->n", error, np.linalg.inv(report.boxes.covariances), error))
    inside = np.mean(np.array(distances) < chi2.ppf(0.95, 7))
    # A binomial of N boxes at 95 %: 4 deviations.
    assert inside == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / len(distances)) + 0.005)


def test_the_true_boxes_hold_the_points_of_their_objects(drive, reports):
    checked = 0
    for k in (0, 40):
        sweep, report = drive.truth.sweep(k), reports[k]
        ego = drive.truth.path.at(np.array([report.truth.timestamp_ns]))
        mount = drive.truth.lidar.spec.mount
        in_ego = (sweep.points_world - ego.positions[0]) @ ego.rotations[0]
        in_lidar = mount.inverse().apply(in_ego)
        for j, instance in enumerate(report.truth_instances):
            half = report.truth.yaws[j] / 2
            rotation = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
            own = in_lidar[sweep.instances == instance]
            # The box stands upright in a lidar that leans by half a degree: 2 cm at the ends of a car.
            inside = points_in_box(
                own, report.truth.centers[j], report.truth.sizes_lwh[j], rotation, margin=0.04
            )
            assert inside.all()
            assert len(own) == report.evidence[j]
            checked += len(own)
    assert checked > 300


def test_boxes_in_other_frames_are_the_same_boxes(drive):
    report, ego, world = (
        detect_3d(drive, EVERYTHING, boxes_frame=frame, frames=[7])[0] for frame in PointsFrame
    )
    mount = drive.truth.lidar.spec.mount
    by_instance = [np.argsort(r.instances) for r in (report, ego, world)]
    own, in_ego, in_world = (
        r.boxes.select(rows) for r, rows in zip((report, ego, world), by_instance, strict=True)
    )
    np.testing.assert_allclose(in_ego.centers, mount.apply(own.centers), atol=1e-9)
    at = drive.truth.path.at(np.array([report.boxes.timestamp_ns]))
    expected = in_ego.centers @ at.rotations[0].T + at.positions[0]
    # The scene's poses are interpolated between samples 10 ms apart.
    np.testing.assert_allclose(in_world.centers, expected, atol=1e-3)
    known = {thing.instance: thing for thing in drive.truth.objects}
    for k, instance in enumerate(world.truth_instances):
        assert world.truth.centers[k] == pytest.approx(known[instance].center_world)
        assert world.truth.yaws[k] == known[instance].yaw
    assert (own.frame, in_ego.frame, in_world.frame) == tuple(PointsFrame)
    assert own.sensor_id == "lidar"


def test_objects_are_missed_as_often_as_points_and_occlusion_state(drive, fair):
    points, occlusions = (
        np.concatenate([getattr(report, name) for report in fair]) for name in ("evidence", "occlusions")
    )
    chances = 0.98 / (1 + np.exp(-(2.0 * np.log(points / 8.0) - 2.0 * occlusions)))
    np.testing.assert_allclose(np.concatenate([report.chances for report in fair]), chances)
    found = np.concatenate([np.isin(report.truth_instances, report.instances) for report in fair])
    for some in (points < 4, (points >= 4) & (points < 15), points >= 15, occlusions > 0.3):
        expected, deviation = chances[some].sum(), np.sqrt((chances * (1 - chances))[some].sum())
        assert some.sum() > 20
        assert abs(found[some].sum() - expected) < 4 * deviation + 1e-9
    assert found[points >= 15].mean() > 0.85 > 0.3 > found[points < 4].mean()
    assert sum(len(report.missed) for report in fair) == (~found).sum()


def test_false_boxes_come_at_their_rate_near_returns_and_away_from_objects(drive, fair):
    counts = np.array([(report.instances == FALSE).sum() for report in fair])
    # The mean of 70 Poisson numbers of 1.5, 4 deviations.
    assert counts.mean() == pytest.approx(1.5, abs=4 * np.sqrt(1.5 / 70))
    assert counts.var() == pytest.approx(1.5, rel=0.7)
    for k in (3, 50):
        positions = drive.scene.lidars[0].frames[k].points.positions
        for j in np.flatnonzero(fair[k].instances == FALSE):
            center = fair[k].boxes.centers[j]
            assert np.linalg.norm(positions - center, axis=1).min() < 3.0
            apart = np.linalg.norm(fair[k].truth.centers - center, axis=1)
            assert apart.min(initial=99.0) > 2.5


def test_headings_are_rotated_back_as_often_as_asked_for(reports):
    rotated = np.concatenate(
        [report.boxes.yaws - report.truth.select(matched(report)).yaws for report in reports]
    )
    back = np.cos(rotated) < 0
    assert back.mean() == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / len(back)))


def test_scores_on_a_drive_are_calibrated(fair):
    scores = np.concatenate([report.boxes.scores for report in fair])
    true = np.concatenate([(report.instances != FALSE) & ~report.duplicates for report in fair])
    assert len(scores) > 400
    assert 0.3 < true.mean() < 0.9
    for low in np.arange(0.0, 1.0, 0.25):
        own = (scores >= low) & (scores < low + 0.25)
        deviation = np.sqrt((scores * (1 - scores))[own].sum())
        assert abs(true[own].sum() - scores[own].sum()) < 4 * deviation


def test_the_surest_box_comes_first_and_logits_are_logits(drive):
    plain, logits = (
        detect_3d(drive, replace(FAIR, scores=ScoreSpec(form=form)), frames=[2, 30]) for form in ScoreForm
    )
    for report, other in zip(plain, logits, strict=True):
        assert (np.diff(report.boxes.scores) <= 0).all()
        assert other.boxes.score_form is ScoreForm.LOGIT
        np.testing.assert_allclose(1 / (1 + np.exp(-other.boxes.scores)), report.boxes.scores, rtol=1e-6)


def test_duplicates_are_of_objects_that_are_found_and_are_marked(reports):
    found = sum(len(report.truth) for report in reports)
    again = sum(int(report.duplicates.sum()) for report in reports)
    assert again / found == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / found))
    for report in reports:
        first = report.instances[~report.duplicates]
        assert len(set(first)) == len(first)
        assert set(report.instances[report.duplicates]) <= set(first)


def test_a_sweep_is_the_same_whichever_others_are_asked_for(drive, fair):
    alone = detect_3d(drive, FAIR, frames=[44])[0]
    for report in (alone, fair[44]):
        assert len(report.boxes) > 3
    one, other = (np.sort(report.boxes.centers, axis=0) for report in (alone, fair[44]))
    np.testing.assert_array_equal(one, other)
    again = detect_3d(drive, FAIR, frames=[44])[0]
    np.testing.assert_array_equal(again.boxes.scores, alone.boxes.scores)
    different = detect_3d(drive, replace(FAIR, seed=1), frames=[44])[0]
    assert not np.array_equal(np.sort(different.boxes.centers, axis=0)[:3], one[:3])


def test_a_share_of_an_objects_errors_lasts_and_the_rest_does_not(drive):
    sigmas = np.array([0.10, 0.06, 0.04, 0.12, 0.05, 0.05, np.radians(1.5)])
    pairs = []
    for report, later in zip(
        *(
            detect_3d(drive, replace(EVERYTHING, lasting_share=0.6), frames=frames)
            for frames in (range(0, 20, 5), range(40, 60, 5))
        ),
        strict=True,
    ):
        one, other = (
            dict(zip(r.instances.tolist(), e / sigmas / g[:, None], strict=True))
            for r in (report, later)
            for e, g in [errors_of(r)]
        )
        pairs += [(one[instance], other[instance]) for instance in one.keys() & other.keys()]
    first, second = (np.array(side) for side in zip(*pairs, strict=True))
    assert first.size > 100
    # A correlation of N pairs is uncertain by less than 1 / sqrt(N); objects that recur count once or so.
    assert (first * second).mean() == pytest.approx(0.6, abs=0.3)
    assert (first**2).mean() == pytest.approx(1.0, abs=0.4)


def test_velocities_are_given_on_request(drive, reports):
    assert detect_3d(drive, EVERYTHING, frames=[0])[0].boxes.velocities is None
    errors = np.concatenate(
        [r.boxes.velocities - r.truth.select(matched(r)).velocities for r in reports[::3]]
    )
    assert errors[:, :2].std() == pytest.approx(0.3, rel=4 / np.sqrt(4 * len(errors)))


def test_what_moves_has_its_box_and_its_velocity_of_the_reference_time():
    traffic = TrafficSpec(cars=4.0, cyclists=5.0, pedestrians=10.0)
    drive = simulate_street(5, frames=2, lidar=LidarSpec(beams=24, steps=400), cameras=(), traffic=traffic)
    exact = replace(EVERYTHING, classes=dict.fromkeys(("car", "cyclist", "pedestrian"), SHARP["car"]))
    report = detect_3d(drive, exact, boxes_frame=PointsFrame.WORLD, frames=[1])[0]
    assert set(report.truth.labels) == {"car", "cyclist", "pedestrian"}
    time_ns, step_ns = report.truth.timestamp_ns, 1_000_000
    assert time_ns == drive.scene.lidars[0].frames[1].reference_ns
    around = drive.truth.boxes(np.array([time_ns - step_ns, time_ns, time_ns + step_ns]))
    rows = np.searchsorted(around.instances, report.truth_instances)
    np.testing.assert_allclose(report.truth.centers, around.centers_world[1, rows])
    moved = (around.centers_world[2, rows] - around.centers_world[0, rows]) / 2e-3
    # A central difference over 2 ms of curves with 100 m/s³ of jerk at most: 0.02 mm/s.
    np.testing.assert_allclose(report.truth.velocities, moved, atol=1e-4)
    assert (np.linalg.norm(moved, axis=1) > 3).any()
    ahead = np.abs(report.truth.speeds) > 1
    assert (report.truth.speeds[ahead] > 0).all()


def test_a_wrong_mounting_moves_boxes_of_the_ego_and_not_those_of_the_sensor(drive):
    faulty = plant(
        drive, Faults({"lidar": SensorFaults(rotation_deg=(0.0, 0.0, 2.0), shift=(0.0, 0.3, 0.0))})
    )
    shift = np.array([0.0, 0.3, 0.0])
    for frame, factor in ((PointsFrame.SENSOR, 0.0), (PointsFrame.EGO, 1.0)):
        right, wrong = (detect_3d(d, EVERYTHING, frames=[5], boxes_frame=frame)[0] for d in (drive, faulty))
        np.testing.assert_array_equal(right.truth.centers, wrong.truth.centers)
        own = detect_3d(drive, EVERYTHING, frames=[5])[0].boxes.centers.copy()
        moved = wrong.boxes.centers - right.boxes.centers
        rotation = Rotation.from_euler("z", 2.0, degrees=True)
        error = drive.truth.lidar.spec.mount.rotate(rotation.apply(own) + shift - own)
        np.testing.assert_allclose(moved, factor * error, atol=1e-9)


def test_reports_of_a_faulty_lidar_have_its_timestamps_and_gaps(drive):
    start = int(drive.scene.lidars[0].frames.timestamps_ns[0])
    wrong = SensorFaults(
        time_offset_ns=40_000_000, lost_frames=(1,), blind=((start + 200_000_000, start + 300_000_000),)
    )
    faulty = plant(drive, Faults({"lidar": wrong}))
    reports = detect_3d(faulty, EVERYTHING, frames=[0, 1, 2])
    right = detect_3d(drive, EVERYTHING, frames=[0, 2, 3])
    late = [a.boxes.timestamp_ns - b.boxes.timestamp_ns for a, b in zip(reports, right, strict=True)]
    assert late == [40_000_000] * 3
    assert [len(report.boxes) > 0 for report in reports] == [True, False, True]
    assert len(reports[1].truth) == 0
    np.testing.assert_array_equal(np.sort(reports[2].instances), np.sort(right[2].instances))


def test_boxes_are_of_the_reference_time_of_their_sweep(drive, reports):
    frame = drive.scene.lidars[0].frames[3]
    assert reports[3].boxes.timestamp_ns == frame.reference_ns != frame.timestamp_ns


def test_occlusion_is_the_share_of_points_that_others_take(drive, reports):
    lidar, street = drive.truth.lidar, drive.truth.street
    hidden = 0
    for j, instance in enumerate(reports[20].truth_instances):
        own = street.shapes.instances == instance
        shapes = PackedShapes(*(getattr(street.shapes, f.name)[own] for f in fields(PackedShapes)))
        alone = replace(lidar, street=replace(street, shapes=shapes)).sweep(20)
        expected = 1 - reports[20].evidence[j] / (alone.instances == instance).sum()
        assert reports[20].occlusions[j] == pytest.approx(expected)
        hidden += expected > 0.2
    assert 0 < hidden < len(reports[20].truth)


@pytest.mark.parametrize(
    "wrong",
    [
        {"flip_share": 1.2},
        {"center_sigmas": (0.1, -0.1, 0.1)},
        {"range_scale": 0.0},
        {"seed": -1},
        {"lasting_share": -0.1},
        {"yaw_sigma_deg": float("nan")},
        {"velocity_sigma": float("inf")},
    ],
)
def test_detector_numbers_out_of_bounds_are_refused_by_name(wrong):
    with pytest.raises(OptionError, match="^detector." + "|".join(wrong)):
        Detector3dSpec(**wrong)


def test_classes_and_misses_out_of_bounds_are_refused():
    for name, value in (("recall", 0.0), ("hiding", float("inf")), ("steepness", float("nan"))):
        with pytest.raises(OptionError, match=f"^detector.misses.{name}: {value}; expected"):
            MissSpec(**{name: value})
    with pytest.raises(OptionError, match="false_rate"):
        ClassSpec(half_evidence=1.0, false_rate=-1.0, size_lwh=(1.0, 1.0, 1.0))


def test_chances_are_those_of_the_formula_and_nothing_overflows_where_all_or_nothing_is_found():
    points, hidden = np.array([1.0, 8.0, 100.0]), np.array([0.0, 0.5, 0.9])
    by_hand = [0.98 / (1 + np.exp(-2 * np.log(n / 8) + 2 * h)) for n, h in zip(points, hidden, strict=True)]
    np.testing.assert_allclose(MissSpec().chances(points, hidden, np.full(3, 8.0)), by_hand)
    sharp = MissSpec(steepness=1e5, recall=1.0).chances(points, 0.0 * hidden, np.full(3, 8.0))
    np.testing.assert_array_equal(sharp, [0.0, 0.5, 1.0])


def test_what_is_not_a_lidar_or_not_a_sweep_is_refused(drive):
    with pytest.raises(OptionError, match="'imu' is of type imu; expected a lidar"):
        detect_3d(drive, lidar_id="imu")
    with pytest.raises(OptionError, match="frame 70; expected 0 to 69"):
        detect_3d(drive, frames=[70])
