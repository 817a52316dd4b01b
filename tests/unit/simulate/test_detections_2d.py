from dataclasses import replace

import cv2
import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.simulate import (
    CameraSpec,
    ClassSpec,
    Detector2dSpec,
    Faults,
    LidarSpec,
    MissSpec,
    SensorFaults,
    camera_mount,
    detect_2d,
    plant,
    simulate_street,
)
from sceneloom.simulate.detections import FALSE

CAMERA_MODEL = Camera("pinhole", 320, 200, 190.0, 190.0, 159.5, 95.5)
SHARP = {"car": ClassSpec(half_evidence=1e-6, false_rate=0.0, size_lwh=(4.2, 1.8, 1.5))}
EVERYTHING = Detector2dSpec(classes=SHARP, misses=MissSpec(recall=1.0, hiding=0.0))
"""Finds all there is and makes nothing up."""
FAIR = Detector2dSpec(
    classes={"car": ClassSpec(half_evidence=60.0, false_rate=1.2, size_lwh=(4.2, 1.8, 1.5))}, repeated=0.2
)


@pytest.fixture(scope="module")
def drive():
    """A drive past parked cars with one small camera."""
    return simulate_street(
        6, frames=50, lidar=LidarSpec(beams=2, steps=20), cameras=(CameraSpec(CAMERA_MODEL, camera_mount()),)
    )


@pytest.fixture(scope="module")
def reports(drive):
    """Everything found in each image, half of it twice."""
    return detect_2d(drive, "camera0", replace(EVERYTHING, repeated=0.5))


@pytest.fixture(scope="module")
def fair(drive):
    """What a fair detector finds."""
    return detect_2d(drive, "camera0", FAIR)


def matched(report):
    """Rows of the truth that the boxes of a report are of."""
    return [report.truth_instances.tolist().index(instance) for instance in report.instances]


def test_the_true_boxes_are_the_edges_of_the_visible_pixels(drive, reports):
    labels = {thing.instance: thing.label for thing in drive.truth.objects}
    seen = 0
    for k in (0, 30):
        shown = drive.truth.instances("camera0", k)
        cars = [instance for instance in np.unique(shown) if labels.get(int(instance)) == "car"]
        assert sorted(reports[k].truth_instances) == cars
        for instance, box, pixels in zip(
            reports[k].truth_instances, reports[k].truth.corners_xyxy, reports[k].evidence, strict=True
        ):
            rows, columns = np.nonzero(shown == instance)
            assert pixels == len(rows)
            assert box.tolist() == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            seen += 1
    assert seen > 6


def test_edges_are_off_by_as_much_as_the_specification_says(reports):
    normal = []
    for report in reports:
        truth = report.truth.corners_xyxy[matched(report)]
        error = report.boxes.corners_xyxy - truth
        sigmas = 0.8 + 0.015 * np.tile(truth[:, 2:] - truth[:, :2], 2)
        # Edges near the border are cut off there, and small boxes are kept from rotating inside out.
        free = (truth > 6).all(axis=1) & (truth[:, 2] < 314) & (truth[:, 3] < 194)
        free &= (truth[:, 2:] - truth[:, :2]).min(axis=1) > 6
        normal.append((error / sigmas)[free])
    normal = np.concatenate(normal)
    assert len(normal) > 150
    np.testing.assert_allclose((normal**2).mean(axis=0), 1.0, atol=4 * np.sqrt(2 / len(normal)))
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=4 / np.sqrt(len(normal)))


def test_boxes_end_where_the_image_does_and_are_never_empty(reports, fair):
    edges = np.concatenate([report.boxes.corners_xyxy for report in (*reports, *fair)])
    assert (edges >= 0).all()
    assert (edges <= [320, 200, 320, 200]).all()
    assert ((edges[:, 2:] - edges[:, :2]) >= 1).all()
    touching = np.concatenate([report.truth.corners_xyxy for report in reports])
    assert (touching[:, 2] == 320).any()


def test_boxes_of_whole_objects_are_the_projected_boxes_in_space(drive):
    report = detect_2d(drive, "camera0", replace(EVERYTHING, amodal=True), frames=[12])[0]
    visible = detect_2d(drive, "camera0", EVERYTHING, frames=[12])[0]
    camera_from_world = drive.truth.world_from_camera("camera0", 12).inverse()
    matrix = np.array(
        [[CAMERA_MODEL.fx, 0, CAMERA_MODEL.cx], [0, CAMERA_MODEL.fy, CAMERA_MODEL.cy], [0, 0, 1.0]]
    )
    known = {thing.instance: thing for thing in drive.truth.objects}
    compared = 0
    for instance, box in zip(report.truth_instances, report.truth.corners_xyxy, strict=True):
        thing = known[int(instance)]
        x, y = np.array([[1, 1, -1, -1] * 2, [1, -1, -1, 1] * 2]) * np.array(thing.size_lwh[:2])[:, None] / 2
        z = np.repeat([-0.5, 0.5], 4) * thing.size_lwh[2]
        cosine, sine = np.cos(thing.yaw), np.sin(thing.yaw)
        corners = np.column_stack([cosine * x - sine * y, sine * x + cosine * y, z]) + thing.center_world
        if camera_from_world.apply(corners)[:, 2].min() < 0.5:
            continue
        rotation, _ = cv2.Rodrigues(camera_from_world.rotation)
        pixels = (
            cv2.projectPoints(corners, rotation, camera_from_world.translation, matrix, None)[0][:, 0] + 0.5
        )
        expected = np.clip([*pixels.min(axis=0), *pixels.max(axis=0)], 0, [320, 200, 320, 200])
        np.testing.assert_allclose(box, expected, atol=1e-6)
        compared += 1
    assert compared >= 3
    shown = visible.truth.corners_xyxy
    # Pixels are whole, and what is seen of an object lies in its box.
    assert (report.truth.corners_xyxy[:, :2] <= shown[:, :2] + 1).all()
    assert (report.truth.corners_xyxy[:, 2:] >= shown[:, 2:] - 1).all()


def test_occlusion_is_what_the_truth_of_the_image_says(drive, reports):
    truth = drive.truth.occlusion("camera0", 30)
    shares = dict(zip(truth.instances.tolist(), truth.hidden.tolist(), strict=True))
    expected = [shares[int(instance)] for instance in reports[30].truth_instances]
    assert reports[30].occlusions.tolist() == pytest.approx(expected)
    assert max(expected) > 0.1


def test_objects_are_missed_as_often_as_their_pixels_state(fair):
    pixels, occlusions = (
        np.concatenate([getattr(report, name) for report in fair]) for name in ("evidence", "occlusions")
    )
    chances = 0.98 / (1 + np.exp(-(2.0 * np.log(pixels / 60.0) - 2.0 * occlusions)))
    np.testing.assert_allclose(np.concatenate([report.chances for report in fair]), chances)
    found = np.concatenate([np.isin(report.truth_instances, report.instances) for report in fair])
    for some in (pixels < 60, pixels >= 60):
        assert some.sum() > 30
        deviation = np.sqrt((chances * (1 - chances))[some].sum())
        assert abs(found[some].sum() - chances[some].sum()) < 4 * deviation


def test_false_boxes_come_at_their_rate_and_overlap_few_objects(fair):
    counts = np.array([(report.instances == FALSE).sum() for report in fair])
    assert counts.mean() == pytest.approx(1.2, abs=4 * np.sqrt(1.2 / len(fair)))
    for report in fair:
        for x1, y1, x2, y2 in report.boxes.corners_xyxy[report.instances == FALSE]:
            for a1, b1, a2, b2 in report.truth.corners_xyxy:
                shared = max(0, min(x2, a2) - max(x1, a1)) * max(0, min(y2, b2) - max(y1, b1))
                both = (x2 - x1) * (y2 - y1) + (a2 - a1) * (b2 - b1) - shared
                # They are placed with less than 0.2, before errors of a pixel.
                assert shared / both < 0.3


def test_scores_in_images_are_calibrated(fair):
    scores = np.concatenate([report.boxes.scores for report in fair])
    true = np.concatenate([(report.instances != FALSE) & ~report.duplicates for report in fair])
    assert len(scores) > 200
    for low in np.arange(0.0, 1.0, 0.25):
        own = (scores >= low) & (scores < low + 0.25)
        deviation = np.sqrt((scores * (1 - scores))[own].sum())
        assert abs(true[own].sum() - scores[own].sum()) < 4 * deviation + 1e-9


def test_duplicates_are_marked(reports):
    found = sum(len(report.truth) for report in reports)
    again = sum(int(report.duplicates.sum()) for report in reports)
    assert again / found == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / found))
    for report in reports:
        assert sorted(report.instances[~report.duplicates]) == sorted(report.truth_instances)


def test_an_image_is_the_same_whichever_others_are_asked_for(drive, fair):
    alone = detect_2d(drive, None, FAIR, frames=[44])[0]
    assert len(alone.boxes) > 1
    one, other = (np.sort(report.boxes.corners_xyxy, axis=0) for report in (alone, fair[44]))
    np.testing.assert_array_equal(one, other)


def test_reports_of_a_faulty_camera_have_its_timestamps_and_gaps(drive):
    start = int(drive.scene.cameras[0].images.timestamps_ns[0])
    wrong = SensorFaults(
        time_offset_ns=-9,
        lost_frames=(1,),
        blind=((start + 200_000_000, start + 300_000_000),),
        rotation_deg=(0.0, 3.0, 0.0),
    )
    reports = detect_2d(plant(drive, Faults({"camera0": wrong})), "camera0", EVERYTHING, frames=[0, 1, 2])
    right = detect_2d(drive, "camera0", EVERYTHING, frames=[0, 2, 3])
    late = [a.boxes.timestamp_ns - b.boxes.timestamp_ns for a, b in zip(reports, right, strict=True)]
    assert late == [-9] * 3
    assert [len(report.boxes) > 0 for report in reports] == [True, False, True]
    np.testing.assert_array_equal(reports[2].truth.corners_xyxy, right[2].truth.corners_xyxy)


def test_what_is_not_a_camera_is_refused(drive):
    with pytest.raises(OptionError, match="'lidar' is of type lidar; expected a camera"):
        detect_2d(drive, "lidar")
    without = simulate_street(1, frames=1, lidar=LidarSpec(beams=2, steps=20), cameras=())
    with pytest.raises(OptionError, match="no camera"):
        detect_2d(without)


@pytest.mark.parametrize("wrong", [{"repeated": 2.0}, {"corner_sigma_px": -1.0}])
def test_detector_numbers_out_of_bounds_are_refused(wrong):
    with pytest.raises(OptionError, match="detector"):
        Detector2dSpec(**wrong)
