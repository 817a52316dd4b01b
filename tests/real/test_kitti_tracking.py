"""Sequences of KITTI's tracking benchmark with the lists of two detectors, tracked and evaluated."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cli import main
from sceneloom.detections import DetectionPair
from sceneloom.detections.projection import fuse_by_projection, project_outlines
from sceneloom.detections.results import NO_BOX
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.evaluate.detection import compare_detections
from sceneloom.evaluate.tracking import compare_tracks
from sceneloom.formats.base.text_tables import read_table
from sceneloom.formats.kitti.benchmark_writer import write_labels
from sceneloom.formats.kitti.labels import lidar_boxes, read_labels
from sceneloom.formats.kitti.tracking_reader import open_tracking_folder
from sceneloom.fusion import FusionConfiguration
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detected_drive import calibration_warnings, kitti_drive
from sceneloom.pipeline.fusing_detections import iter_fused_detections
from sceneloom.pipeline.tracking import projected_boxes

PART = ("0012", "0014")
"""A car that stands, and one that drives, with another camera."""


@pytest.fixture(scope="module")
def folder(drive):
    return drive("real/kitti_tracking")


@pytest.fixture(scope="module")
def tracking(folder):
    return open_tracking_folder(folder)


@pytest.mark.parametrize("name", PART)
def test_a_sequence_is_read_without_doubts_and_boxes_of_sweeps_are_outlined_where_their_detector_says(tracking, name):
    sequence, off = tracking.sequence(name), []
    assert name in tracking.sequences
    assert sequence.warnings == ()
    assert sequence.classes_2d == sequence.classes_3d == {"Car", "Pedestrian"}
    assert len(sequence.world_from_ego.timestamps_ns) == sequence.frame_count
    for frame in range(0, sequence.frame_count, 5):
        values, _ = sequence.detections_3d.of(frame)
        boxes = sequence.boxes_3d(frame)
        outlines = projected_boxes(boxes, sequence.camera, sequence.camera_from_lidar)
        ahead = values[:, 12] > 6.0  # the detector does not cut boxes that reach behind the camera
        # it counts pixel centres and cuts at the centre of the last one
        limits = [sequence.camera.width - 1.0, sequence.camera.height - 1.0] * 2
        off.append(np.abs(np.clip(outlines[ahead] - 0.5, 0.0, limits) - values[ahead, 2:6]))
    differences = np.concatenate(off)
    assert len(differences) > 40
    # boxes here are upright in the lidar's frame, there in the camera's: half a degree moves their corners a little
    assert np.median(differences) < 0.3
    assert np.quantile(differences, 0.95) < 3.0


def test_what_people_labelled_as_stationary_stands_in_the_world(tracking, folder):
    sequence = tracking.sequence("0014")
    labels = read_labels(folder / "label_02" / "0014.txt")
    labels = labels.select(labels.have_position)
    locations = kitti_drive(sequence).locations()
    centers, _, _ = lidar_boxes(labels.sizes_hwl, labels.bottoms, labels.rotations_y, sequence.rectified_from_lidar)
    world = np.array([locations[f].apply(center) for f, center in zip(labels.frames.tolist(), centers, strict=True)])
    driven = np.linalg.norm(locations[-1].translation - locations[0].translation)
    assert driven > 20.0
    spreads = []
    for track in np.unique(labels.track_ids):
        own = world[labels.track_ids == track]
        if len(own) >= 20:
            spreads.append(np.linalg.norm(np.ptp(own, axis=0)[:2]))
    # parked cars; people draw boxes within some decimetres
    assert (np.array(spreads) < 1.5).sum() >= 3


def rotated_deg(rotations):
    """How far each rotation is from the first one."""
    cosines = (np.einsum("ij,nij->n", rotations[0], rotations) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))


def test_the_trajectory_rotates_as_images_state(tracking, folder):
    locations = kitti_drive(tracking.sequence("0006")).locations()
    rows = read_table(folder / "orbslam3_poses" / "0006.txt", named=False).numbers(range(12))
    by_unit = rotated_deg(np.array([location.rotation for location in locations]))
    by_images = rotated_deg(rows.reshape(-1, 3, 4)[:, :, :3])
    assert by_images.max() > 60.0  # the drive rotates a corner
    # half a degree is what the odometry of images and the mounting of the unit are off together
    assert np.abs(by_unit - by_images).max() < 1.0


def test_a_calibration_that_is_rotated_is_noticed_by_the_boxes(tracking):
    sequence = tracking.sequence("0014")
    for degrees, reported in ((0.0, False), (2.5, True)):
        half = np.radians(degrees) / 2
        about_y = RigidTransform.from_quaternion(np.zeros(3), np.array([0.0, np.sin(half), 0.0, np.cos(half)]))
        wrong = replace(sequence, camera_from_lidar=about_y @ sequence.camera_from_lidar)
        warnings = calibration_warnings(kitti_drive(wrong))
        assert ("calibration-off" in {warning.code for warning in warnings}) == reported


def test_labels_are_written_as_they_were_read(folder, drive, tmp_path):
    source = folder / "label_02" / "0014.txt"
    write_labels(read_labels(source), tmp_path / "0014.txt")
    assert (tmp_path / "0014.txt").read_text() == source.read_text()
    labels = read_labels(drive("real/kitti_object") / "label_2" / "000000.txt")
    assert (labels.types, labels.frames.tolist()) == (("Pedestrian",), [0])


def test_a_folder_without_labels_is_tracked(folder, tmp_path):
    for path in folder.rglob("0012.txt"):
        name = path.relative_to(folder)
        if name.parts[0] in {"calib", "oxts", "det2d_rrc", "det3d_pointrcnn"}:
            (tmp_path / "drive" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "drive" / name).write_bytes(path.read_bytes())
    with pytest.raises(SystemExit) as stop:
        main(["track", str(tmp_path / "drive"), "-o", str(tmp_path / "out"), "--format", "kitti", "-q"])
    assert stop.value.code in (None, 0)
    found = read_labels(tmp_path / "out" / "0012.txt")
    assert set(found.types) == {"Car", "Pedestrian"}
    keys = list(zip(found.frames.tolist(), found.track_ids.tolist(), strict=True))
    assert len(keys) == len(set(keys))  # evaluations refuse an id that stands twice in a frame
    assert (found.corners_xyxy[:, 2:] > found.corners_xyxy[:, :2]).all()


def test_detectors_that_the_configuration_names_count_before_those_that_are_known_of_the_folder(tracking):
    drive = kitti_drive(tracking.sequence("0012"))
    settings = ProjectionSettings(detectors="independent")
    named = next(iter_fused_detections(drive, configuration=FusionConfiguration(detectors="independent"))).fused
    stated = next(iter_fused_detections(drive, settings=settings)).fused
    known = next(iter_fused_detections(drive)).fused
    np.testing.assert_array_equal(named.scores, stated.scores)
    assert not np.array_equal(named.scores, known.scores)


SEQUENCES = ("0000", "0012", "0014")


@pytest.mark.parametrize("similarity", ["2d", "bev", "3d", "distance"])
def test_labels_held_against_themselves_have_no_fault(folder, drive, similarity):
    reported = compare_tracks(folder, folder, sequences=SEQUENCES, similarity=similarity)
    assert sorted(reported.classes) == ["car", "pedestrian"]
    for scores in reported.classes.values():
        combined = scores.combined
        assert combined.true_boxes > 100
        # an overlap of a box with itself may be off by the rounding of its area
        assert combined.hota.hota == pytest.approx(1, abs=1e-9)
        assert (combined.clear.mota, combined.clear.idsw, combined.identity.idf1) == (1.0, 0, 1.0)
    if similarity == "3d":  # as that of scenes is
        path = drive("real/sfs_reference/argoverse2_2frames_cuboids.sfs")
        reported = compare_tracks(path, path)
        assert (reported.similarity, {one.combined.clear.mota for one in reported.classes.values()}) == ("3d", {1})
        assert sum(scores.combined.true_objects for scores in reported.classes.values()) == 81


def test_detectors_are_as_good_as_they_are_known_to_be(folder):
    space = compare_detections(folder / "det3d_pointrcnn", folder, classes=("car",), sequences=SEQUENCES)
    images = compare_detections(folder / "det2d_rrc", folder, classes=("car",), sequences=SEQUENCES)
    reported = {one.similarity: one.difficulties["moderate"] for one in space.classes["car"]}
    # trained on such drives, PointRCNN reaches more than its published 75 to 79 % of AP at an overlap of 0.7
    assert 0.75 < reported["3d"].ap40 <= reported["bev"].ap40 < 1.0
    assert reported["3d"].calibration is None
    (one,) = images.classes["car"]
    assert one.similarity == "2d"
    assert one.difficulties["moderate"].ap40 > 0.9
    assert one.difficulties["moderate"].calibration.error < 0.1


ALIKE = {"Car": ("Car", "Van"), "Pedestrian": ("Pedestrian", "Person", "Person_sitting", "Cyclist")}
"""Labels that a detector of the class may also find: not counted, if they are not of it."""
LEAST_HEIGHT = 25.0
"""What is lower in the image is not counted, as in KITTI's moderate level [px]."""
DETECTED = ("0003", "0006", "0012", "0014", "0016")
THRESHOLD = 0.7


def read_drive(tracking, folder, name):
    """Of each frame the pair of detections, and labels: boxes in images, locations in the lidar's frame, classes."""
    sequence, labels = tracking.sequence(name), read_labels(folder / "label_02" / f"{name}.txt")
    centers, _, _ = lidar_boxes(labels.sizes_hwl, labels.bottoms, labels.rotations_y, sequence.rectified_from_lidar)
    centers, classes = np.where(labels.have_position[:, None], centers, np.nan), np.array(labels.types)
    drive = []
    for frame in range(labels.frames.max() + 1):
        boxes, own = (sequence.boxes_3d(frame), sequence.boxes_2d(frame)), labels.frames == frame
        pair = DetectionPair(*boxes, sequence.camera, sequence.camera_from_lidar)
        drive.append((pair, (labels.corners_xyxy[own], centers[own], classes[own].tolist())))
    return drive


def overlaps(one, others):
    """Area in common of a box and others, and IoU."""
    sides = np.minimum(one[2:], others[:, 2:]) - np.maximum(one[:2], others[:, :2])
    common = np.maximum(sides, 0).prod(axis=1)
    areas = (others[:, 2:] - others[:, :2]).prod(axis=1)
    return common, common / ((one[2:] - one[:2]).prod() + areas - common + 1e-9)


def count(boxes_xyxy, scores, labels, truth, wanted):
    """True and false boxes of a class in one frame, and its labels; the surest box of a label is true."""
    locations, _, classes = truth
    high = (locations[:, 3] - locations[:, 1]) >= LEAST_HEIGHT
    own = np.array([c == wanted for c in classes], np.bool_) & high
    passed = np.array([c in ("DontCare", "Misc", *ALIKE[wanted]) for c in classes], np.bool_) & ~own
    taken, true, false = np.zeros(len(locations), np.bool_), 0, 0
    for k in np.argsort(-scores, kind="stable"):
        if labels[k] != wanted or scores[k] < THRESHOLD:
            continue
        common, ious = overlaps(boxes_xyxy[k], locations)
        free = np.where(own & ~taken, ious, 0.0)
        if len(free) and free.max() >= 0.5:
            taken[free.argmax()] = True
            true += 1
            continue
        wide, tall = boxes_xyxy[k, 2:] - boxes_xyxy[k, :2]
        if tall >= LEAST_HEIGHT and not (common[passed] > 0.5 * wide * tall).any():
            false += 1
    return np.array([true, false, own.sum()])


@pytest.fixture(scope="module")
def drives(tracking, folder):
    return [read_drive(tracking, folder, name) for name in DETECTED]


def recall_and_precision(drives, wanted):
    """Of the detector of images, of that of sweeps, and of both fused."""
    sums = np.zeros((3, 3))
    for drive in drives:
        for pair, truth in drive:
            two, three = pair.boxes_2d, pair.boxes_3d
            boxes = np.column_stack([three.centers, three.sizes_lwh, three.yaws])
            outlines = project_outlines(pair.camera, pair.camera_from_lidar, boxes).corners_xyxy
            fused = fuse_by_projection(pair)
            sums[0] += count(two.corners_xyxy, two.scores, two.labels, truth, wanted)
            sums[1] += count(outlines, 1 / (1 + np.exp(-three.scores)), three.labels, truth, wanted)
            sums[2] += count(fused.corners_xyxy, fused.scores, fused.labels, truth, wanted)
    true, false, labels = sums.T
    return true / labels, true / (true + false)


def test_what_is_fused_is_found_more_often_and_truer_than_by_the_detectors(drives):
    recall, precision = recall_and_precision(drives, "Car")
    assert recall[2] > max(recall[:2])
    assert precision[2] > max(precision[1] + 0.05, 0.9)
    recall, precision = recall_and_precision(drives, "Pedestrian")
    assert recall[2] > recall[1]
    assert precision[2] > precision[1] + 0.05


def test_far_cars_are_nearer_to_the_truth_across_the_line_of_sight_after_fusion(drives):
    errors, squares = [], []
    for drive in drives:
        for pair, (_, centers, classes) in drive:
            fused = fuse_by_projection(pair)
            cars = centers[[c in ("Car", "Van") for c in classes]]
            for k in np.flatnonzero((fused.rows_3d != NO_BOX) & (fused.rows_2d != NO_BOX)):
                before = pair.boxes_3d.centers[fused.rows_3d[k]]
                apart = np.linalg.norm(cars - before, axis=1)
                if not len(cars) or apart.min() > 1.0 or np.linalg.norm(before) < 40.0:
                    continue
                true = cars[apart.argmin()]
                aside = np.cross(true, [0, 0, 1]) / np.linalg.norm(true[:2])
                after = fused.centers[k] - true
                errors.append((aside @ (before - true), aside @ after, before[2] - true[2], after[2]))
                squares.append(after @ np.linalg.solve(fused.center_covariances[k], after))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert len(errors) > 100
    assert rms[1] < 0.9 * rms[0]
    assert rms[3] < 0.9 * rms[2]
    # the detector was trained on these drives: covariances are meant for others. The region is Student's, whose squares
    # have the mean 3 ν / (ν - 2); where they are fewer than these, it is too wide, and never much too narrow
    freedom = fused.degrees_of_freedom
    assert 0.3 < np.mean(squares) < 3.0 * freedom / (freedom - 2.0)
