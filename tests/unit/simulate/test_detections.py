"""Simulated detectors: errors, misses, false boxes and scores as their specifications state them."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import beta, chi2, kstest

from sceneloom import simulate as sim
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.geometry.boxes import points_in_box
from sceneloom.scene import PointsFrame, ScoreForm
from sceneloom.simulate import ClassSpec, Detector2dSpec, Detector3dSpec, ScoreSpec, detect_2d, detect_3d
from sceneloom.simulate.detections import FALSE, MissSpec, _LineViews, _projected_boxes, deal_out, draw_scores
from sceneloom.simulate.street import PackedShapes

CAMERA_MODEL = Camera("pinhole", 320, 200, 190.0, 190.0, 159.5, 95.5)
CAR = (4.2, 1.8, 1.5)
SHARP = {"car": ClassSpec(half_evidence=1e-6, false_rate=0.0, size_lwh=CAR)}
ALWAYS = MissSpec(recall=1.0, hiding=0.0)
# those that find all there is and make nothing up, and fair ones
ALL_2D = Detector2dSpec(classes=SHARP, misses=ALWAYS)
ALL_3D = Detector3dSpec(classes=SHARP, misses=ALWAYS, flip_share=0.0)
FAIR_2D = Detector2dSpec(classes={"car": ClassSpec(half_evidence=60.0, false_rate=1.2, size_lwh=CAR)}, repeated=0.2)
FAIR_3D = Detector3dSpec(classes={"car": ClassSpec(half_evidence=8.0, false_rate=1.5, size_lwh=CAR)}, repeated=0.2)
SIGMAS = np.array([0.10, 0.06, 0.04, 0.12, 0.05, 0.05, np.radians(1.5)])


@pytest.fixture(scope="module")
def drive():
    lidar, camera = sim.LidarSpec(beams=2, steps=20), sim.CameraSpec(CAMERA_MODEL, sim.camera_mount())
    return sim.simulate_street(6, frames=50, lidar=lidar, cameras=(camera,))


@pytest.fixture(scope="module")
def busy_drive():
    """A long drive past parked cars, seen by a coarse lidar without noise."""
    lidar = sim.LidarSpec(beams=16, steps=360, range_sigma=0.0, drop_rate=0.0)
    return sim.simulate_street(6, frames=70, lidar=lidar, cameras=())


@pytest.fixture(scope="module")
def reports(drive):
    """Everything found in each image, half of it twice."""
    return detect_2d(drive, "camera0", replace(ALL_2D, repeated=0.5))


@pytest.fixture(scope="module")
def reports_3d(busy_drive):
    """Everything found in each sweep, half of it twice, a tenth of it rotated back."""
    every = replace(ALL_3D, covariances=True, repeated=0.5, flip_share=0.1, velocity_sigma=0.3)
    return detect_3d(busy_drive, every)


@pytest.fixture(scope="module")
def fair(drive):
    return detect_2d(drive, "camera0", FAIR_2D)


@pytest.fixture(scope="module")
def fair_3d(busy_drive):
    return detect_3d(busy_drive, FAIR_3D)


def matched(report):
    """Rows of the truth that the boxes of a report are of."""
    return [report.truth_instances.tolist().index(instance) for instance in report.instances]


def test_the_true_boxes_are_the_edges_of_the_visible_pixels_and_as_hidden_as_the_image_says(drive, reports, fair):
    labels, seen = {thing.instance: thing.label for thing in drive.truth.objects}, 0
    for k in (0, 30):
        shown, report = drive.truth.instances("camera0", k), reports[k]
        cars = [instance for instance in np.unique(shown) if labels.get(int(instance)) == "car"]
        assert sorted(report.truth_instances) == cars
        truth = zip(report.truth_instances, report.truth.corners_xyxy, report.evidence, strict=True)
        for instance, box, pixels in truth:
            rows, columns = np.nonzero(shown == instance)
            assert pixels == len(rows)
            assert box.tolist() == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            seen += 1
    assert seen > 6
    truth = drive.truth.occlusion("camera0", 30)
    shares = dict(zip(truth.instances.tolist(), truth.hidden.tolist(), strict=True))
    expected = [shares[int(instance)] for instance in reports[30].truth_instances]
    assert reports[30].occlusions.tolist() == pytest.approx(expected)
    assert max(expected) > 0.1
    # boxes end where the image does and are never empty
    edges = np.concatenate([report.boxes.corners_xyxy for report in (*reports, *fair)])
    assert ((edges >= 0) & (edges <= [320, 200, 320, 200])).all()
    assert ((edges[:, 2:] - edges[:, :2]) >= 1).all()
    assert (np.concatenate([report.truth.corners_xyxy for report in reports])[:, 2] == 320).any()


def test_edges_are_off_by_as_much_as_the_specification_says_and_whole_boxes_are_projected_ones(reports, drive):
    normal = []
    for report in reports:
        truth = report.truth.corners_xyxy[matched(report)]
        sigmas = 0.8 + 0.015 * np.tile(truth[:, 2:] - truth[:, :2], 2)
        # Edges near the border are cut off there, and small boxes are kept from rotating inside out.
        free = (truth > 6).all(axis=1) & (truth[:, 2] < 314) & (truth[:, 3] < 194)
        free &= (truth[:, 2:] - truth[:, :2]).min(axis=1) > 6
        normal.append(((report.boxes.corners_xyxy - truth) / sigmas)[free])
    normal = np.concatenate(normal)
    assert len(normal) > 150
    np.testing.assert_allclose((normal**2).mean(axis=0), 1.0, atol=4 * np.sqrt(2 / len(normal)))
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=4 / np.sqrt(len(normal)))
    whole, visible = (
        detect_2d(drive, "camera0", replace(ALL_2D, amodal=amodal), frames=[12])[0] for amodal in (True, False)
    )
    camera_from_world = drive.truth.world_from_camera("camera0", 12).inverse()
    matrix = np.array([[CAMERA_MODEL.fx, 0, CAMERA_MODEL.cx], [0, CAMERA_MODEL.fy, CAMERA_MODEL.cy], [0, 0, 1.0]])
    known, compared = {thing.instance: thing for thing in drive.truth.objects}, 0
    grid = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), -1).reshape(-1, 3)
    for instance, box in zip(whole.truth_instances, whole.truth.corners_xyxy, strict=True):
        thing = known[int(instance)]
        corners = upright(grid, thing.center_world, thing.yaw, thing.size_lwh)
        if camera_from_world.apply(corners)[:, 2].min() >= 0.5:
            rotation, _ = cv2.Rodrigues(camera_from_world.rotation)
            pixels = cv2.projectPoints(corners, rotation, camera_from_world.translation, matrix, None)[0][:, 0] + 0.5
            expected = np.clip([*pixels.min(axis=0), *pixels.max(axis=0)], 0, [320, 200, 320, 200])
            np.testing.assert_allclose(box, expected, atol=1e-6)
            compared += 1
    assert compared >= 3
    # Pixels are whole, and what is seen of an object lies in its box.
    beyond = (whole.truth.corners_xyxy - visible.truth.corners_xyxy) * [1, 1, -1, -1]
    assert (beyond <= 1).all()


def upright(points, center, yaw, size_lwh):
    return Rotation.from_euler("z", yaw).apply(points * np.array(size_lwh) / 2) + center


def test_false_boxes_come_at_their_rate_overlap_few_objects_and_lie_near_returns(fair, busy_drive, fair_3d):
    counts = np.array([(report.instances == FALSE).sum() for report in fair])
    assert counts.mean() == pytest.approx(1.2, abs=4 * np.sqrt(1.2 / len(fair)))
    for report in fair:
        for x1, y1, x2, y2 in report.boxes.corners_xyxy[report.instances == FALSE]:
            for a1, b1, a2, b2 in report.truth.corners_xyxy:
                shared = max(0, min(x2, a2) - max(x1, a1)) * max(0, min(y2, b2) - max(y1, b1))
                # They are placed with less than 0.2, before errors of a pixel.
                assert shared < 0.3 * ((x2 - x1) * (y2 - y1) + (a2 - a1) * (b2 - b1) - shared)
    counts = np.array([(report.instances == FALSE).sum() for report in fair_3d])
    # The mean of 70 Poisson numbers of 1.5, 4 deviations.
    assert counts.mean() == pytest.approx(1.5, abs=4 * np.sqrt(1.5 / 70))
    assert counts.var() == pytest.approx(1.5, rel=0.7)
    for k in (3, 50):
        positions, report = busy_drive.scene.lidars[0].frames[k].points.positions, fair_3d[k]
        for center in report.boxes.centers[report.instances == FALSE]:
            assert np.linalg.norm(positions - center, axis=1).min() < 3.0
            assert np.linalg.norm(report.truth.centers - center, axis=1).min(initial=99.0) > 2.5


@pytest.mark.parametrize(("dimensions", "name"), [(2, "fair"), (3, "fair_3d")])
def test_a_frame_is_the_same_whichever_others_are_asked_for(dimensions, name, drive, busy_drive, request):
    def found(spec):
        if dimensions == 2:
            return detect_2d(drive, None, spec, frames=[44])[0]
        return detect_3d(busy_drive, spec, frames=[44])[0]

    def values(report):
        return np.sort(report.boxes.corners_xyxy if dimensions == 2 else report.boxes.centers, axis=0)

    spec = FAIR_2D if dimensions == 2 else FAIR_3D
    alone, again, together = found(spec), found(spec), request.getfixturevalue(name)[44]
    assert len(alone.boxes) > dimensions - 1
    np.testing.assert_array_equal(values(alone), values(together))
    np.testing.assert_array_equal(again.boxes.scores, alone.boxes.scores)
    assert not np.array_equal(values(found(replace(spec, seed=1)))[:3], values(alone)[:3])


@pytest.mark.parametrize("sensor_id", ["camera0", "lidar"])
def test_reports_of_a_faulty_sensor_have_its_timestamps_and_gaps(drive, busy_drive, sensor_id):
    is_camera = sensor_id == "camera0"
    right = drive if is_camera else busy_drive
    start = int((right.scene.cameras[0].images if is_camera else right.scene.lidars[0].frames).timestamps_ns[0])
    blind, late_ns = ((start + 200_000_000, start + 300_000_000),), -9 if is_camera else 40_000_000
    rotation = (0.0, 3.0, 0.0) if is_camera else (0.0, 0.0, 0.0)
    wrong = sim.SensorFaults(time_offset_ns=late_ns, lost_frames=(1,), blind=blind, rotation_deg=rotation)
    faulty = sim.inject(right, sim.Faults({sensor_id: wrong}))
    found, expected = (
        detect_2d(one, "camera0", ALL_2D, frames=frames) if is_camera else detect_3d(one, ALL_3D, frames=frames)
        for one, frames in ((faulty, [0, 1, 2]), (right, [0, 2, 3]))
    )
    assert [a.boxes.timestamp_ns - b.boxes.timestamp_ns for a, b in zip(found, expected, strict=True)] == [late_ns] * 3
    assert [len(report.boxes) > 0 for report in found] == [True, False, True]
    np.testing.assert_array_equal(np.sort(found[2].instances), np.sort(expected[2].instances))
    if is_camera:
        np.testing.assert_array_equal(found[2].truth.corners_xyxy, expected[2].truth.corners_xyxy)
    else:
        assert len(found[1].truth) == 0


def errors_of(report):
    """Errors of centres, sizes and yaws in the box's own axes (N, 7) by their sigmas, and how much these grow (N,)."""
    rows = matched(report)
    truth = report.truth.select(rows)
    apart = report.boxes.centers - truth.centers
    own = [Rotation.from_euler("z", -yaw).apply(row) for yaw, row in zip(truth.yaws, apart, strict=True)]
    growth = (1 + np.linalg.norm(truth.centers, axis=1) / 60.0) * np.sqrt(1 + 30.0 / report.evidence[rows])
    sizes = report.boxes.sizes_lwh - truth.sizes_lwh
    return np.column_stack([np.reshape(own, (-1, 3)), sizes, rotated(report, truth)]) / SIGMAS, growth


def rotated(report, truth):
    return np.mod(report.boxes.yaws - truth.yaws + np.pi / 2, np.pi) - np.pi / 2


def test_errors_and_covariances_are_as_large_as_the_specification_says(reports_3d, busy_drive):
    errors, growth = (np.concatenate(parts) for parts in zip(*map(errors_of, reports_3d), strict=True))
    normal = errors / growth[:, None]
    # A mean square of N normal errors is 1 with the deviation sqrt(2 / N); 4 of them are a chance of 1 in 16,000.
    # Sizes of far objects are cut off at a fifth, which takes less than 2 % off.
    np.testing.assert_allclose((normal**2).mean(axis=0), 1.0, atol=4 * np.sqrt(2 / len(normal)) + 0.02)
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=4 / np.sqrt(len(normal)) + 0.02)
    assert np.percentile(growth, 95) > 2 * np.percentile(growth, 5)
    # the stated covariances hold the errors
    distances = []
    for report in reports_3d:
        boxes, truth = report.boxes, report.truth.select(matched(report))
        off = [boxes.centers - truth.centers, boxes.sizes_lwh - truth.sizes_lwh, rotated(report, truth)]
        error = np.column_stack(off)
        distances += list(np.einsum("ni,nij,nj->n", error, np.linalg.inv(boxes.covariances), error))
    # A binomial of N boxes at 95 %: 4 deviations.
    allowed = 4 * np.sqrt(0.95 * 0.05 / len(distances)) + 0.005
    assert np.mean(np.array(distances) < chi2.ppf(0.95, 7)) == pytest.approx(0.95, abs=allowed)
    # headings are rotated back as often as asked for
    off = np.concatenate([report.boxes.yaws - report.truth.select(matched(report)).yaws for report in reports_3d])
    assert (np.cos(off) < 0).mean() == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / len(off)))
    # velocities are given on request
    assert detect_3d(busy_drive, ALL_3D, frames=[0])[0].boxes.velocities is None
    errors = np.concatenate([r.boxes.velocities - r.truth.select(matched(r)).velocities for r in reports_3d[::3]])
    assert errors[:, :2].std() == pytest.approx(0.3, rel=4 / np.sqrt(4 * len(errors)))


def test_boxes_in_other_frames_are_the_same_but_for_a_wrong_mounting_and_no_such_sensor_is_refused(busy_drive, drive):
    report, ego, world = (detect_3d(busy_drive, ALL_3D, boxes_frame=frame, frames=[7])[0] for frame in PointsFrame)
    own, in_ego, in_world = (r.boxes.select(np.argsort(r.instances)) for r in (report, ego, world))
    np.testing.assert_allclose(in_ego.centers, busy_drive.truth.lidar.spec.mount.apply(own.centers), atol=1e-9)
    frame = busy_drive.scene.lidars[0].frames[7]
    assert report.boxes.timestamp_ns == frame.reference_ns != frame.timestamp_ns
    at = busy_drive.truth.path.at(np.array([frame.reference_ns]))
    # The scene's poses are interpolated between samples 10 ms apart.
    np.testing.assert_allclose(in_world.centers, in_ego.centers @ at.rotations[0].T + at.positions[0], atol=1e-3)
    known = {thing.instance: thing for thing in busy_drive.truth.objects}
    things = [known[instance] for instance in world.truth_instances]
    np.testing.assert_allclose(world.truth.centers, [thing.center_world for thing in things])
    assert world.truth.yaws.tolist() == [thing.yaw for thing in things]
    assert (own.frame, in_ego.frame, in_world.frame) == tuple(PointsFrame)
    assert own.sensor_id == "lidar"
    # a wrong mounting moves boxes of the ego and not those of the sensor
    for frame, factor in [(PointsFrame.SENSOR, 0.0), (PointsFrame.EGO, 1.0)]:
        wrong = sim.SensorFaults(rotation_deg=(0.0, 0.0, 2.0), shift=(0.0, 0.3, 0.0))
        faulty = sim.inject(busy_drive, sim.Faults({"lidar": wrong}))
        right, moved = (detect_3d(one, ALL_3D, frames=[5], boxes_frame=frame)[0] for one in (busy_drive, faulty))
        np.testing.assert_array_equal(right.truth.centers, moved.truth.centers)
        own = detect_3d(busy_drive, ALL_3D, frames=[5])[0].boxes.centers.copy()
        off = Rotation.from_euler("z", 2.0, degrees=True).apply(own) - own + np.array([0.0, 0.3, 0.0])
        error = factor * busy_drive.truth.lidar.spec.mount.rotate(off)
        np.testing.assert_allclose(moved.boxes.centers - right.boxes.centers, error, atol=1e-9)
    without = sim.simulate_street(1, frames=1, lidar=sim.LidarSpec(beams=2, steps=20), cameras=())
    for call, message in (
        (lambda: detect_2d(drive, "lidar"), "'lidar' is of type lidar; expected a camera"),
        (lambda: detect_2d(without), "no camera"),
        (lambda: detect_3d(busy_drive, lidar_id="imu"), "'imu' is of type imu; expected a lidar"),
        (lambda: detect_3d(busy_drive, frames=[70]), "frame 70; expected 0 to 69"),
    ):
        with pytest.raises(OptionError, match=message):
            call()


def test_objects_are_missed_as_often_as_evidence_and_occlusion_state_and_scores_are_calibrated(fair, fair_3d):
    for reports, half, groups in (
        (fair, 60.0, [(0, 60), (60, np.inf)]),
        (fair_3d, 8.0, [(0, 4), (4, 15), (15, np.inf)]),
    ):
        evidence, occlusions, stated = (
            np.concatenate([getattr(report, name) for report in reports])
            for name in ("evidence", "occlusions", "chances")
        )
        chances = 0.98 / (1 + np.exp(-(2.0 * np.log(evidence / half) - 2.0 * occlusions)))
        np.testing.assert_allclose(stated, chances)
        found = np.concatenate([np.isin(report.truth_instances, report.instances) for report in reports])
        for some in (occlusions > 0.3, *((evidence >= low) & (evidence < high) for low, high in groups)):
            assert some.sum() > 20
            deviation = np.sqrt((chances * (1 - chances))[some].sum())
            assert abs(found[some].sum() - chances[some].sum()) < 4 * deviation + 1e-9
        assert sum(len(report.missed) for report in reports) == (~found).sum()
        scores = np.concatenate([report.boxes.scores for report in reports])
        true = np.concatenate([(report.instances != FALSE) & ~report.duplicates for report in reports])
        assert len(scores) > 200
        assert 0.3 < true.mean() < 0.95
        for low in np.arange(0.0, 1.0, 0.25):
            own = (scores >= low) & (scores < low + 0.25)
            deviation = np.sqrt((scores * (1 - scores))[own].sum())
            assert abs(true[own].sum() - scores[own].sum()) < 4 * deviation + 1e-9


def test_all_objects_are_found_once_the_surest_first_and_duplicates_are_marked(reports, reports_3d, busy_drive):
    for every in (reports, reports_3d):
        found = sum(len(report.truth) for report in every)
        again = sum(int(report.duplicates.sum()) for report in every)
        assert found > 150
        assert again / found == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / found))
        for report in every:
            assert sorted(report.instances[~report.duplicates]) == sorted(report.truth_instances)
            assert set(report.instances[report.duplicates]) <= set(report.truth_instances)
            assert len(report.missed) == 0
    # the surest box comes first, and logits are logits
    plain, logits = (
        detect_3d(busy_drive, replace(FAIR_3D, scores=ScoreSpec(form=form)), frames=[2, 30]) for form in ScoreForm
    )
    for report, other in zip(plain, logits, strict=True):
        assert (np.diff(report.boxes.scores) <= 0).all()
        assert other.boxes.score_form is ScoreForm.LOGIT
        np.testing.assert_allclose(1 / (1 + np.exp(-other.boxes.scores)), report.boxes.scores, rtol=1e-6)


def test_a_share_of_errors_lasts_and_true_boxes_hold_the_points_of_their_objects(busy_drive, reports_3d):
    def by_instance(report):
        errors, growth = errors_of(report)
        return dict(zip(report.instances.tolist(), errors / growth[:, None], strict=True))

    spec, pairs = replace(ALL_3D, lasting_share=0.6), []
    now, later = (detect_3d(busy_drive, spec, frames=frames) for frames in (range(0, 20, 5), range(40, 60, 5)))
    for one, other in zip(map(by_instance, now), map(by_instance, later), strict=True):
        pairs += [(one[instance], other[instance]) for instance in one.keys() & other.keys()]
    first, second = (np.array(side) for side in zip(*pairs, strict=True))
    assert first.size > 100
    # A correlation of N pairs is uncertain by less than 1 / sqrt(N); objects that recur count once or so.
    assert (first * second).mean() == pytest.approx(0.6, abs=0.3)
    assert (first**2).mean() == pytest.approx(1.0, abs=0.4)
    checked = 0
    for k in (0, 40):
        sweep, report = busy_drive.truth.sweep(k), reports_3d[k]
        ego = busy_drive.truth.path.at(np.array([report.truth.timestamp_ns]))
        in_ego = (sweep.points_world - ego.positions[0]) @ ego.rotations[0]
        in_lidar = busy_drive.truth.lidar.spec.mount.inverse().apply(in_ego)
        for j, instance in enumerate(report.truth_instances):
            half, own = report.truth.yaws[j] / 2, in_lidar[sweep.instances == instance]
            rotation = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
            # The box stands upright in a lidar that leans by half a degree: 2 cm at the ends of a car.
            inside = points_in_box(own, report.truth.centers[j], report.truth.sizes_lwh[j], rotation, margin=0.04)
            assert inside.all()
            assert len(own) == report.evidence[j]
            checked += len(own)
    assert checked > 300
    # occlusion is the share of points that others take
    lidar, street, report = busy_drive.truth.lidar, busy_drive.truth.street, reports_3d[20]
    expected = []
    for instance, points in zip(report.truth_instances, report.evidence, strict=True):
        own = street.shapes.instances == instance
        shapes = PackedShapes(*(getattr(street.shapes, f.name)[own] for f in fields(PackedShapes)))
        alone = replace(lidar, street=replace(street, shapes=shapes)).sweep(20)
        expected.append(1 - points / (alone.instances == instance).sum())
    assert report.occlusions == pytest.approx(expected)
    assert 0 < sum(share > 0.2 for share in expected) < len(expected)


def test_what_moves_has_its_box_and_its_velocity_of_the_reference_time():
    traffic = sim.TrafficSpec(cars=4.0, cyclists=5.0, pedestrians=10.0)
    drive = sim.simulate_street(5, frames=2, lidar=sim.LidarSpec(beams=24, steps=400), cameras=(), traffic=traffic)
    exact = replace(ALL_3D, classes=dict.fromkeys(("car", "cyclist", "pedestrian"), SHARP["car"]))
    truth = (report := detect_3d(drive, exact, boxes_frame=PointsFrame.WORLD, frames=[1])[0]).truth
    assert set(truth.labels) == {"car", "cyclist", "pedestrian"}
    assert truth.timestamp_ns == drive.scene.lidars[0].frames[1].reference_ns
    around = drive.truth.boxes(truth.timestamp_ns + np.array([-1_000_000, 0, 1_000_000]))
    before, now, after = around.centers_world[:, np.searchsorted(around.instances, report.truth_instances)]
    np.testing.assert_allclose(truth.centers, now)
    # A central difference over 2 ms of curves with 100 m/s³ of jerk at most: 0.02 mm/s.
    np.testing.assert_allclose(truth.velocities, (after - before) / 2e-3, atol=1e-4)
    assert (np.linalg.norm(truth.velocities, axis=1) > 3).any()
    assert (truth.speeds[np.abs(truth.speeds) > 1] > 0).all()


def test_numbers_out_of_bounds_are_refused_by_name():
    for spec, wrong, message in [
        (MissSpec, {"recall": 0.0}, "detector.misses.recall: 0.0; expected"),
        (MissSpec, {"hiding": float("inf")}, "detector.misses.hiding: inf; expected"),
        (MissSpec, {"steepness": float("nan")}, "detector.misses.steepness: nan; expected"),
        (ClassSpec, {"half_evidence": 1.0, "false_rate": -1.0, "size_lwh": (1.0,) * 3}, "detector.classes.false_rate"),
        (ScoreSpec, {"concentration": 0.0}, "scores.concentration"),
        (ScoreSpec, {"form": ScoreForm.LOGIT, "logit_scale": 0.0}, "scores.logit_scale"),
        (ScoreSpec, {"form": ScoreForm.LOGIT, "logit_shift": float("nan")}, "scores.logit_shift"),
        (ScoreSpec, {"logit_shift": 1.0}, "scores: logit_scale and logit_shift are for logits"),
    ]:
        with pytest.raises(OptionError, match=f"^{message}"):
            spec(**wrong)


def test_chances_are_those_of_the_formula_and_boxes_of_objects_beside_the_camera_reach_the_border():
    points, hidden = np.array([1.0, 8.0, 100.0]), np.array([0.0, 0.5, 0.9])
    by_hand = [0.98 / (1 + np.exp(-2 * np.log(n / 8) + 2 * h)) for n, h in zip(points, hidden, strict=True)]
    np.testing.assert_allclose(MissSpec().chances(points, hidden, np.full(3, 8.0)), by_hand)
    sharp = MissSpec(steepness=1e5, recall=1.0).chances(points, 0.0 * hidden, np.full(3, 8.0))
    np.testing.assert_array_equal(sharp, [0.0, 0.5, 1.0])
    ahead = np.array([[[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]])
    middle, size = np.array([[[1.0, 3.0, -1.0]]]), np.array([[8.0, 2.0, 2.0]])
    views = _LineViews(CAMERA_MODEL, False, ahead, np.zeros((1, 3)), middle, np.zeros((1, 1)), size)
    (box,) = _projected_boxes(views, np.array([[1.0, 2.0, 3.0, 4.0]]))
    # Its far end is 5 m ahead and begins 2 m to the left; its top is on the camera's height.
    assert box == pytest.approx([0.0, 96.0, 159.5 - 190 * 2 / 5 + 0.5, 200.0])


def draw_boxes(seed, *, frames=4000, false_rate=0.6, repeated=0.0, **spec):
    """Find the same six objects in many frames, with false boxes and duplicates: scores and what is true."""
    generator = np.random.default_rng(seed)
    chances = np.tile([0.98, 0.95, 0.8, 0.5, 0.2, 0.03], frames)
    looks = deal_out(chances, frames * false_rate, repeated=repeated)
    found = generator.random(6 * frames) < chances
    again = found & (generator.random(6 * frames) < repeated)
    false = generator.choice(6 * frames, generator.poisson(frames * false_rate), p=looks.false_shares)
    alike = np.concatenate([np.flatnonzero(found), np.flatnonzero(again), false])
    true = np.arange(len(alike)) < found.sum()
    return draw_scores(generator, looks.true_shares[alike], true, ScoreSpec(**spec)), true


def gaps(scores, true, bins=15):
    """In equal bins of the scores: how many more are true than the scores state, and the variance of that."""
    which = np.minimum((scores * bins).astype(int), bins - 1)
    return tuple(np.bincount(which, weights, bins) for weights in (true - scores, scores * (1 - scores)))


@pytest.mark.parametrize("concentration", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("repeated", [0.0, 0.3])
def test_of_all_boxes_with_a_score_that_share_is_true(concentration, repeated):
    scores, true = draw_boxes(3, concentration=concentration, repeated=repeated)
    assert len(scores) > 15_000
    off, variances = gaps(scores, true)
    # Expected calibration error: with 16,000 boxes in 15 bins chance alone gives about 0.006.
    assert np.abs(off).sum() / len(scores) < 0.012
    # Each bin is a binomial of its scores: the sum of squared normalised gaps is a chi-square of 15; 38 is its 99.9 %.
    assert (off**2 / np.maximum(variances, 1e-9)).sum() < 38
    # scores that do not know the rates would be noticed
    odds = scores / (1 - scores) * 3
    assert np.abs(gaps(odds / (1 + odds), true)[0]).sum() / len(scores) > 0.012


def test_scores_are_spread_and_boxes_dealt_out_as_the_derivation_says_also_as_logits():
    generator, kappa, count = np.random.default_rng(2), 2.5, 20_000
    for true, shape in ((True, (kappa * 0.7 + 1, kappa * 0.3)), (False, (kappa * 0.7, kappa * 0.3 + 1))):
        scores = draw_scores(generator, np.full(count, 0.7), np.full(count, true), ScoreSpec(concentration=kappa))
        assert kstest(scores, beta(*shape).cdf).pvalue > 1e-3
    # the dealt-out boxes are all boxes
    chances = np.array([0.9, 0.4, 0.01])
    looks = deal_out(chances, 1.7, repeated=0.25)
    assert looks.false_shares.sum() == pytest.approx(1.0)
    assert (chances / looks.true_shares).sum() == pytest.approx(chances.sum() * 1.25 + 1.7)
    assert (np.diff(looks.true_shares) < 0).all()
    np.testing.assert_allclose(deal_out(chances, 0.0).true_shares, 1.0)
    # what is never found looks false and nothing else changes
    np.testing.assert_array_equal(deal_out(np.array([0.0, 0.5]), 0.0).true_shares, [0.0, 1.0])
    # scores report less the more they are concentrated
    areas = []
    for concentration in (0.3, 1.0, 5.0):
        scores, true = draw_boxes(8, frames=500, concentration=concentration)
        areas.append((scores[true][:2000, None] > scores[~true][None, :1000]).mean())
    assert areas == sorted(areas, reverse=True)
    assert areas[0] - areas[2] > 0.01
    plain, worded, logits, warped = (
        draw_scores(np.random.default_rng(1), np.full(500, 0.6), np.arange(500) % 2 == 0, ScoreSpec(**spec))
        for spec in (
            {}, {"form": "probability"}, {"form": ScoreForm.LOGIT},
            {"form": ScoreForm.LOGIT, "logit_scale": 2.0, "logit_shift": -1.0},
        )
    )  # fmt: skip
    np.testing.assert_array_equal(worded, plain)
    np.testing.assert_allclose(1 / (1 + np.exp(-logits)), plain, rtol=1e-7)
    np.testing.assert_allclose(warped, 2 * logits - 1)
    assert np.abs(logits).max() > 1.5


WHOLE = Detector2dSpec(amodal=True, misses=ALWAYS)


@pytest.fixture(scope="module")
def drives():
    """A busy street in a bend, before a camera whose shutter rolls over the rows and before one of columns."""
    spec = sim.CameraSpec(CAMERA_MODEL, sim.camera_mount(yaw_deg=20.0), readout_ns=60_000_000)
    traffic = sim.TrafficSpec(cars=5.0, cyclists=4.0, pedestrians=8.0)
    options = {"lidar": sim.LidarSpec(beams=1, steps=1), "traffic": traffic, "path": sim.PathSpec(yaw_rate=0.6)}
    cameras = [(replace(spec, left_to_right=columns),) for columns in (False, True)]
    return [sim.simulate_street(4, frames=8, cameras=one, **options) for one in cameras]


@pytest.mark.slow
def test_what_a_rolling_shutter_shows_of_an_object_lies_in_its_whole_box(drives):
    for drive in drives:
        for k, report in enumerate(detect_2d(drive, "camera0", WHOLE)):
            shown = drive.truth.instances("camera0", k)
            for instance, box in zip(report.truth_instances, report.truth.corners_xyxy, strict=True):
                rows, columns = np.nonzero(shown == instance)
                # The centre of a pixel that shows it lies in the box, but for what moves within one line's time
                # and what the shutter's last lines round.
                assert box[0] - 0.1 <= columns.min() + 0.5 <= columns.max() + 0.5 <= box[2] + 0.1
                assert box[1] - 0.1 <= rows.min() + 0.5 <= rows.max() + 0.5 <= box[3] + 0.1


@pytest.mark.parametrize("axis", [1, 0])
@pytest.mark.few(1)
def test_whole_boxes_of_a_rolling_shutter_are_what_all_its_lines_see_of_the_boxes_in_space(drives, axis):
    drive = drives[axis == 0]
    camera, (report,) = drive.truth.cameras["camera0"], detect_2d(drive, "camera0", WHOLE, frames=[3])
    rotations, origins = camera.line_poses(3)
    boxes = drive.truth.boxes(camera.line_times_ns(3))
    # points on the twelve edges
    ends, along = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0]), -1).reshape(-1, 2), np.linspace(-1.0, 1.0, 200)
    edges = np.concatenate(
        [np.insert(np.tile(pair, (200, 1)), edge, along, axis=1) for edge in range(3) for pair in ends]
    )
    still_px = []
    for instance, found in zip(report.truth_instances, report.truth.corners_xyxy, strict=True):
        own, seen = boxes.instances.tolist().index(instance), []
        for line, (rotation, origin) in enumerate(zip(rotations, origins, strict=True)):
            points = upright(edges, boxes.centers_world[line, own], boxes.yaws[line, own], boxes.sizes_lwh[own])
            x, y, z = ((points - origin) @ rotation).T
            if z.min() < 0.5:
                break
            pixels = np.column_stack([190.0 * x / z + 159.5, 190.0 * y / z + 95.5])
            seen.append(pixels[np.abs(pixels[:, axis] - line) <= 0.5])
        else:
            pixels = np.concatenate(seen) + 0.5
            if len(pixels) < 50 or pixels.min() < 2 or (pixels > [318, 198]).any():
                continue
            expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
            # A corner can fall between two lines: half a pixel.
            np.testing.assert_allclose(found, expected, atol=0.6)
            # all lines at once, with the middle one, would give other boxes
            views = _LineViews.of(camera, 3, np.array([instance]))
            middle = slice(len(views.origins) // 2, len(views.origins) // 2 + 1)
            names = ("rotations", "origins", "centers_world", "yaws")
            frozen = replace(views, **{name: getattr(views, name)[middle] for name in names})
            still_px.append(np.abs(_projected_boxes(frozen, found[None])[0] - expected).max())
    assert len(still_px) >= 3
    assert max(still_px) > 1.0
