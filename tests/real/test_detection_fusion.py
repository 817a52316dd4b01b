"""Detection fusion on drives of KITTI: real detectors of images and sweeps, against people's labels."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.detections import DetectionPair
from sceneloom.detections.projection import fuse_by_projection, project_outlines
from sceneloom.detections.results import NO_BOX
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm

CLASSES = ("Car", "Pedestrian")
ALIKE = {"Car": ("Car", "Van"), "Pedestrian": ("Pedestrian", "Person", "Person_sitting", "Cyclist")}
"""Labels that a detector of the class may also find: not counted, if they are not of it."""
LEAST_HEIGHT = 25.0
"""What is lower in the image is not counted, as in KITTI's moderate level [px]."""
SEQUENCES = ("0003", "0006", "0012", "0014", "0016")
THRESHOLD = 0.7


def read_calibration(path):
    """The camera, `camera_from_lidar` and `rectified_from_lidar`."""
    lines = map(str.split, path.read_text().splitlines())
    rows = {name.rstrip(":"): np.array(numbers, np.float64).reshape(3, -1) for name, *numbers in lines}
    k, shift, rectified = rows["P2"][:, :3], np.eye(4), np.eye(4)
    rectified[:3, :3] = rows["R_rect"]
    shift[:3, 3] = np.linalg.solve(k, rows["P2"][:, 3])
    rectified = rectified @ np.vstack([rows["Tr_velo_cam"], [0, 0, 0, 1]])
    transforms = [RigidTransform.nearest(matrix)[0] for matrix in (shift @ rectified, rectified)]
    return Camera("pinhole", 1242, 375, k[0, 0], k[1, 1], k[0, 2], k[1, 2]), *transforms


def boxes_in_lidar(rows, scores, labels, rectified_from_lidar):
    """Boxes of rows h, w, l, x, y, z, ry, the location being the middle of the bottom in the camera's frame."""
    rows = np.asarray(rows, np.float64).reshape(-1, 7)
    centers = rectified_from_lidar.inverse().apply(rows[:, 3:6] - np.array([0, 1, 0]) * rows[:, :1] / 2)
    scores, yaws = np.asarray(scores, np.float64), -rows[:, 6] - np.pi / 2
    return Boxes3D(0, centers, rows[:, [2, 1, 0]], yaws, scores, tuple(labels), score_form=ScoreForm.LOGIT)


def read_drive(folder, sequence):
    """Pairs of detections by frame, and labels: boxes in images, locations in the lidar's frame, classes."""
    camera, camera_from_lidar, rectified = read_calibration(folder / "calib" / f"{sequence}.txt")

    def of_frame(name, columns):
        """The rows of a frame, and their classes."""
        paths = [folder / name / c / f"{sequence}.txt" for c in CLASSES]
        texts = [path.read_text() if path.exists() else "" for path in paths]
        tables = [np.array(text.replace(",", " ").split(), float).reshape(-1, columns) for text in texts]
        rows, classes = np.vstack(tables), np.repeat(CLASSES, [len(table) for table in tables])
        return lambda frame: (rows[rows[:, 0] == frame], tuple(classes[rows[:, 0] == frame].tolist()))

    two, three = of_frame("det2d_rrc", 6), of_frame("det3d_pointrcnn", 15)
    labels = [line.split() for line in (folder / "label_02" / f"{sequence}.txt").read_text().splitlines()]
    pairs, truth = [], []
    for frame in range(1 + max(int(row[0]) for row in labels)):
        (rows, classes), (rows_3d, classes_3d) = two(frame), three(frame)
        boxes_3d = boxes_in_lidar(rows_3d[:, 7:14], rows_3d[:, 6], classes_3d, rectified)
        pairs.append(
            DetectionPair(boxes_3d, Boxes2D(0, rows[:, 1:5] + 0.5, rows[:, 5], classes), camera, camera_from_lidar)
        )
        own = sorted((row for row in labels if int(row[0]) == frame), key=lambda row: row[2] == "DontCare")
        known = [row for row in own if row[2] != "DontCare"]
        centers = boxes_in_lidar([row[10:17] for row in known], [0] * len(known), [""] * len(known), rectified).centers
        centers = np.vstack([centers, np.full((len(own) - len(known), 3), np.nan)])
        boxes = np.array([row[6:10] for row in own], np.float64).reshape(-1, 4)
        truth.append((boxes, centers, [row[2] for row in own]))
    return list(zip(pairs, truth, strict=True))


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
def drives(drive):
    return [read_drive(drive("real/kitti_tracking"), sequence) for sequence in SEQUENCES]


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
