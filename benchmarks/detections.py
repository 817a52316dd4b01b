"""How good fused detections are on KITTI's tracking sequences, beside each detector alone and simple rules.

Run with `python -m benchmarks.detections FOLDER`, FOLDER laid out like KITTI's tracking benchmark with the lists of two
detectors beside the labels. Rows, for each class:

- sweeps: the detector of sweeps alone. noisy-or: 1 - (1 - p)(1 - q) of both scores as they are. match first: boxes with
  a partner in the image before those without, each by the sweep's score.
- ours: `fuse_by_projection` with the detectors of the package; cross: with numbers fitted to all other sequences (the
  honest row); half: fitted to 0000 0002 0003 0006 0010, scored on the rest; simulated: with the package's default.
- bound: with numbers fitted to the very pairs that are scored, labels and all: what scores can do with these boxes.
- tracked: objects followed online, with what they are like by the sweeps and images so far; fused as in cross.
- weak camera: 30 % of the image's boxes dropped, 4 % of jitter, one false box in each image; no camera: none.

Columns: the best F1 at an overlap in space of 0.5, average precision (40 points) at 0.7, and calibration error with
its deviation when sequences are drawn anew, by KITTI's rules for moderate difficulty. Boxes that touch a region in
which nobody labelled are neither true nor false; `--inside` leaves that to those that lie in it by half, as KITTI does
in images. Then how true covariances are.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.detector_fits import KITTI, kitti_examples
from sceneloom.arrays import Float64Array
from sceneloom.detections import DetectionPair, FusedBoxes
from sceneloom.detections.fitting import Columns, LabelledPair, columns_of, fit_columns
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import NO_BOX
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.evaluate.detection import (
    DIFFICULTIES,
    DetectionRules,
    ScoredDetections,
    at_difficulty,
    box_errors,
    judge_covariances,
    pair_detections,
    score_detections,
)
from sceneloom.evaluate.objects import FramePairs, ObjectTable, covered_by
from sceneloom.formats.kitti.labels import CENTRE_TO_CORNER, lidar_boxes, read_labels
from sceneloom.formats.kitti.tracking_reader import open_tracking_folder
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels import scores as kernels_scores
from sceneloom.pipeline.detected_drive import kitti_drive
from sceneloom.scene import Boxes2D
from sceneloom.tracking import Observation, Tracker, TrackerSettings

HALF = ("0000", "0002", "0003", "0006", "0010")
REGIONS = "DontCare"
CLASSES = ("Car", "Pedestrian")
MODERATE = DIFFICULTIES["moderate"]
DRAWN = 1000
ALL_REPORTED = TrackerSettings(report=0.0)


@dataclass(frozen=True, slots=True)
class Drive:
    """One sequence."""

    name: str
    pairs: tuple[DetectionPair, ...]
    locations: tuple[RigidTransform, ...]
    truth: ObjectTable


Fuse = Callable[[DetectionPair], tuple[FusedBoxes, Float64Array]]
"""A rule: objects, and scores in their location."""


def drives_of(folder: Path) -> list[Drive]:
    """Read all sequences that have labels."""
    tracking = open_tracking_folder(folder)
    found = []
    for name in tracking.sequences:
        path = folder / "label_02" / f"{name}.txt"
        if not path.is_file():
            continue
        sequence, labels = tracking.sequence(name), read_labels(path)
        pairs = tuple(
            DetectionPair(
                sequence.boxes_3d(frame), sequence.boxes_2d(frame), sequence.camera, sequence.camera_from_lidar
            )
            for frame in range(sequence.frame_count)
        )
        placed = lidar_boxes(labels.sizes_hwl, labels.bottoms, labels.rotations_y, sequence.rectified_from_lidar)
        truth = replace(
            ObjectTable.of_kitti(labels),
            boxes=np.column_stack(placed),
            corners_xyxy=labels.corners_xyxy + CENTRE_TO_CORNER,
        )
        found.append(Drive(name, pairs, kitti_drive(sequence).locations(), truth))
    return found


PLAIN = ProjectionSettings(detectors="independent", keep_camera_only=False)


def raw(rule: Callable[[Float64Array, Float64Array], Float64Array]) -> Fuse:
    """Boxes of the sweep as they are, with scores made of both detectors'; the second is NaN without a partner."""

    def fuse(pair: DetectionPair) -> tuple[FusedBoxes, Float64Array]:
        fused = fuse_by_projection(pair, settings=PLAIN)
        three, rows = pair.boxes_3d, fused.rows_3d
        of_image = np.full(len(rows), np.nan)
        has = fused.rows_2d != NO_BOX
        of_image[has] = pair.boxes_2d.scores[fused.rows_2d[has]]
        same = replace(fused, centers=three.centers[rows], sizes_lwh=three.sizes_lwh[rows], yaws=three.yaws[rows])
        return same, rule(1.0 / (1.0 + np.exp(-three.scores[rows])), of_image)

    return fuse


def weakened(pair: DetectionPair, generator: np.random.Generator) -> DetectionPair:
    """The same pair by a weak camera."""
    two, camera = pair.boxes_2d, pair.camera
    kept = two.select(generator.random(len(two)) >= 0.3)
    sides = np.tile(kept.sizes_wh, 2)
    corners = kept.corners_xyxy + 0.04 * sides * generator.standard_normal(sides.shape)
    wide = generator.uniform(30.0, 200.0)
    high = wide / generator.uniform(1.2, 2.5)
    left, top = generator.uniform(0.0, camera.width - wide), generator.uniform(140.0, camera.height - 60.0)
    false = [left, top, left + wide, min(top + high, camera.height)]
    return replace(
        pair,
        boxes_2d=Boxes2D(
            two.timestamp_ns,
            np.vstack([corners, false]),
            np.append(kept.scores, generator.uniform(0.3, 1.0)),
            (*kept.labels, "Car"),
            sensor_id=two.sensor_id,
        ),
    )


def blinded(pair: DetectionPair) -> DetectionPair:
    """The same pair without a camera."""
    return replace(pair, boxes_2d=Boxes2D.empty(pair.boxes_2d.timestamp_ns))


RULES: dict[str, Fuse] = {
    "sweeps": raw(lambda p, _: p),
    "noisy-or": raw(lambda p, q: 1.0 - (1.0 - p) * (1.0 - np.nan_to_num(q))),
    "match first": raw(lambda p, q: np.where(np.isnan(q), p / 2.0, 0.5 + p / 2.0)),
}


def table_of(pairs: Sequence[DetectionPair], fuse: Fuse) -> tuple[ObjectTable, float | None]:
    """The objects of a sequence, and the degrees of freedom of their errors."""
    frames, fields, freedom = list[int](), list[tuple[Float64Array, ...]](), None
    labels = list[str]()
    for frame, pair in enumerate(pairs):
        fused, scores = fuse(pair)
        covariances = np.zeros((len(fused), 7, 7))
        covariances[:, :3, :3], covariances[:, 3:6, 3:6] = fused.center_covariances, fused.size_covariances
        covariances[:, 6, 6] = fused.yaw_variances
        boxes = np.column_stack([fused.centers, fused.sizes_lwh, fused.yaws])
        fields.append((boxes, scores, fused.corners_xyxy, covariances))
        frames += [frame] * len(fused)
        # the sweep's own class: whoever is sure of another one is not asked here
        labels += [pair.boxes_3d.labels[row] for row in fused.rows_3d.tolist()]
        freedom = fused.degrees_of_freedom
    boxes, scores, corners, covariances = (np.concatenate(parts) for parts in zip(*fields, strict=True))
    numbers = np.array(frames, np.int64)
    table = ObjectTable(
        numbers, np.full(len(numbers), -1), tuple(labels), corners, boxes, scores=scores, covariances=covariances
    )
    return table, freedom


def scored(
    results: dict[str, ObjectTable], drives: list[Drive], label: str, overlap: float, *, inside: bool
) -> ScoredDetections:
    """What counts at moderate difficulty."""
    truth = {drive.name: drive.truth for drive in drives}
    rules = DetectionRules(least_overlap=overlap, regions_in_space=True)
    found = at_difficulty(pair_detections(results, truth, label, rules=rules), MODERATE)
    if inside:
        return found
    joined, first = list[ObjectTable](), 0
    for name in sorted(truth):
        joined.append(truth[name].select(truth[name].are(REGIONS)).moved(first))
        first += 1 + max((int(table.frames.max()) for table in (truth[name], results[name]) if len(table)), default=-1)
    regions = ObjectTable.joined(joined).in_order()
    frames = 1 + max(int(found.found.frames.max(initial=-1)), int(regions.frames.max(initial=-1)))
    pairs = FramePairs.of(regions.frame_starts(frames), found.found.frame_starts(frames))
    shares = covered_by(found.found, regions.corners_xyxy, pairs)  # type: ignore[arg-type]
    return replace(found, excused=kernels_scores.reached_columns(shares, *pairs.locations, 1e-6))


def spread_of_calibration(results: dict[str, ObjectTable], drives: list[Drive], label: str, *, inside: bool) -> float:
    """Deviation of the calibration error when sequences are drawn anew.

    Source: Efron 1979, "Bootstrap Methods: Another Look at the Jackknife", with whole sequences, within which boxes are
    alike.
    """
    counts, gaps = list[list[int]](), list[list[float]]()
    for drive in drives:
        alone = scored({drive.name: results[drive.name]}, [drive], label, 0.5, inside=inside)
        reported = score_detections(alone).calibration
        if reported is not None:
            counts.append([each.count for each in reported.bins])
            gaps.append([each.count * ((each.mean_score or 0.0) - (each.share_true or 0.0)) for each in reported.bins])
    drawn = np.random.default_rng(0).integers(len(counts), size=(DRAWN, len(counts)))
    off = np.abs(np.array(gaps)[drawn].sum(axis=1)).sum(axis=1)
    return float((off / np.array(counts)[drawn].sum(axis=(1, 2))).std())


def print_row(
    name: str, drives: list[Drive], tables: dict[str, tuple[ObjectTable, float | None]], label: str, *, inside: bool
) -> None:
    """Print the figures of one rule."""
    results = {key: table for key, (table, _) in tables.items()}
    half, most = (score_detections(scored(results, drives, label, overlap, inside=inside)) for overlap in (0.5, 0.7))
    calibration = ""
    if half.calibration is not None:
        spread = spread_of_calibration(results, drives, label, inside=inside)
        calibration = f"{half.calibration.error:9.4f} ± {spread:.4f}"
    print(f"{name:24s}{100 * half.max_f1:8.2f}{100 * half.ap40:8.2f}{100 * most.ap40:8.2f}{calibration}")


def print_covariances(
    name: str, drives: list[Drive], tables: dict[str, tuple[ObjectTable, float | None]], label: str
) -> None:
    """Print how often errors lie in the regions that covariances promise."""
    truth = {drive.name: drive.truth for drive in drives}
    rules = DetectionRules(least_overlap=0.3, neighbours={}, regions="")
    results = {key: table for key, (table, _) in tables.items()}
    errors, covariances = box_errors(pair_detections(results, truth, label, rules=rules))
    freedom = next(iter(tables.values()))[1]
    for part, columns in (("middle", slice(0, 3)), ("size", slice(3, 6))):
        for shape, degrees in (("Student", freedom), ("Gauss", None)):
            reported = judge_covariances(
                errors[:, columns], covariances[:, columns, columns], degrees_of_freedom=degrees
            )
            shares = "".join(f"{100 * coverage.share:8.1f}" for coverage in reported.coverages)
            print(f"{name:12s}{part:8s}{shape:9s}{shares}{reported.log_volume:9.2f}{reported.count:8d}")


def fitted_without(columns: Columns, names: Sequence[str]) -> ProjectionSettings:
    """What detectors are like by all other sequences."""
    groups = [columns.groups.index(name) for name in names]
    detectors = fit_columns(columns.without(*groups), name="others")
    return ProjectionSettings(detectors=detectors, keep_camera_only=False)


def fitted_to(examples: Sequence[LabelledPair], pairs: Sequence[DetectionPair]) -> ProjectionSettings:
    """What detectors are like by the truth of these pairs, which are seen in some way."""
    seen = (replace(example, pair=pair) for example, pair in zip(examples, pairs, strict=True))
    detectors = fit_columns(columns_of(seen, overlap=0.5), name="the same")
    return ProjectionSettings(detectors=detectors, keep_camera_only=False)


def by_settings(settings: ProjectionSettings) -> Fuse:
    """Fusion with some settings."""

    def fuse(pair: DetectionPair) -> tuple[FusedBoxes, Float64Array]:
        fused = fuse_by_projection(pair, settings=settings)
        return fused, fused.scores

    return fuse


def tracked(drive: Drive, pairs: Sequence[DetectionPair], settings: ProjectionSettings) -> tuple[ObjectTable, None]:
    """The objects of a sequence, followed online and reported however unlikely they are."""
    tracker, parts, labels = Tracker(ALL_REPORTED), list[tuple[Float64Array, ...]](), list[str]()
    fuse = partial(fuse_by_projection, settings=replace(settings, keep_camera_only=True))
    for frame, (pair, location) in enumerate(zip(pairs, drive.locations, strict=True)):
        reported = tracker.step(Observation.of_pairs({"camera": pair}, location, fuse=fuse))
        heads = (
            np.column_stack([np.cos(reported.yaws), np.sin(reported.yaws), np.zeros(len(reported))]) @ location.rotation
        )
        boxes = np.column_stack(
            [location.inverse().apply(reported.centers), reported.sizes_lwh, np.arctan2(heads[:, 1], heads[:, 0])]
        )
        corners = np.nan_to_num(reported.corners_xyxy["camera"])
        parts.append((np.full(len(reported), frame, np.float64), corners, boxes, reported.scores))
        labels += reported.labels
    frames, corners, boxes, scores = (np.concatenate(column) for column in zip(*parts, strict=True))
    numbers = frames.astype(np.int64)
    return ObjectTable(numbers, np.full(len(numbers), -1), tuple(labels), corners, boxes, scores=scores), None


Seeing = Callable[[Drive], Iterator[DetectionPair]]


def seen_weakly(drive: Drive) -> Iterator[DetectionPair]:
    """Every pair by a weak camera, the same one each time."""
    generator = np.random.default_rng(int(drive.name) if drive.name.isdigit() else 0)
    for pair in drive.pairs:
        yield weakened(pair, generator)


SEEING: dict[str, Seeing] = {
    "": lambda drive: iter(drive.pairs),
    "weak camera": seen_weakly,
    "no camera": lambda drive: (blinded(pair) for pair in drive.pairs),
}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--inside", action="store_true")
    parser.add_argument("--detectors", default=KITTI)
    reported = parser.parse_args()
    drives = drives_of(reported.folder)
    names = tuple(drive.name for drive in drives)
    examples = tuple(kitti_examples(reported.folder, names))
    columns = columns_of(examples, overlap=0.5)
    rules: dict[str, Callable[[str], Fuse]] = {name: lambda _, rule=rule: rule for name, rule in RULES.items()}
    fixed = {
        "ours": by_settings(ProjectionSettings(detectors=reported.detectors, keep_camera_only=False)),
        "simulated": by_settings(ProjectionSettings(keep_camera_only=False)),
    }
    rules |= {name: lambda _, rule=rule: rule for name, rule in fixed.items()}
    others = {name: fitted_without(columns, [name]) for name in names}
    crossed = {name: by_settings(settings) for name, settings in others.items()}
    rules["cross"] = crossed.__getitem__
    rest = [drive for drive in drives if drive.name not in HALF]
    halved = by_settings(fitted_without(columns, [drive.name for drive in rest]))
    print(f"{'':24s}{'F1@0.5':>8s}{'AP@0.5':>8s}{'AP@0.7':>8s}{'ECE':>9s}")
    for label in CLASSES:
        for seeing, pairs in SEEING.items():
            print(f"-- {label} {seeing}")
            for name, rule in rules.items():
                by_rule = {d.name: table_of(tuple(pairs(d)), rule(d.name)) for d in drives}
                print_row(name, drives, by_rule, label, inside=reported.inside)
            bound = by_settings(fitted_to(examples, [pair for drive in drives for pair in pairs(drive)]))
            print_row(
                "bound",
                drives,
                {d.name: table_of(tuple(pairs(d)), bound) for d in drives},
                label,
                inside=reported.inside,
            )
            followed = {d.name: tracked(d, tuple(pairs(d)), others[d.name]) for d in drives}
            print_row("tracked", drives, followed, label, inside=reported.inside)
            tables = {d.name: table_of(tuple(pairs(d)), halved) for d in rest}
            print_row("half, on the rest", rest, tables, label, inside=reported.inside)
            for name in ("sweeps", "match first"):
                plain = {d.name: table_of(tuple(pairs(d)), RULES[name]) for d in rest}
                print_row(f"{name}, on the rest", rest, plain, label, inside=reported.inside)
            if not seeing:
                print(f"{'regions':29s}{'50':>8s}{'90':>8s}{'95':>8s}{'99':>8s}{'log vol':>9s}{'boxes':>8s}")
                print_covariances("cross", drives, by_rule, label)
                print_covariances("half", rest, tables, label)


if __name__ == "__main__":
    main()
