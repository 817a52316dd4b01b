"""How long it takes to hold tracks against the truth, TrackEval's time beside ours.

    python -m benchmarks.evaluation ../shared/data/real/kitti_tracking

Results are the boxes of a detector in images, each with the identity of the box that it overlaps most in the frame
before. Times are those of one processor, the least of several runs; TrackEval's include its reading.
"""

import argparse
import contextlib
import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sceneloom.evaluate.detection import evaluate_detection
from sceneloom.evaluate.object_files import read_both
from sceneloom.evaluate.tracking import evaluate_tracking

LEAST_SCORE, LEAST_OVERLAP = 0.4, 0.3


def overlaps(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Intersection over union of (N, 4) and (M, 4) boxes of an image."""
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    common = np.clip(high - low, 0, None).prod(axis=2)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (first, second)]
    return common / (areas[0][:, None] + areas[1][None] - common)


def followed(detections: np.ndarray, label: str, next_id: int) -> list[str]:
    """Lines of KITTI's results."""
    lines: list[str] = []
    before, ids_before = np.zeros((0, 4)), []
    for frame in range(int(detections[:, 0].max()) + 1):
        boxes = detections[(detections[:, 0] == frame) & (detections[:, 5] > LEAST_SCORE), 1:5]
        ids = [-1] * len(boxes)
        alike = overlaps(before, boxes)
        while alike.size and alike.max() > LEAST_OVERLAP:
            i, j = np.unravel_index(alike.argmax(), alike.shape)
            ids[j] = ids_before[i]
            alike[i], alike[:, j] = -1, -1
        for k, box in enumerate(boxes):
            if ids[k] < 0:
                ids[k], next_id = next_id, next_id + 1
            corners = " ".join(f"{edge:.6f}" for edge in box)
            lines.append(f"{frame} {ids[k]} {label} -1 -1 -10 {corners} -1 -1 -1 -1000 -1000 -1000 -10 0.9")
        before, ids_before = boxes, ids
    return lines


def write_sides(folder: Path, location: Path) -> None:
    """Labels and results as TrackEval wants to find them."""
    (location / "truth" / "label_02").mkdir(parents=True)
    (location / "results" / "greedy" / "data").mkdir(parents=True)
    lengths = []
    for labels in sorted((folder / "label_02").glob("*.txt")):
        text = labels.read_text()
        (location / "truth" / "label_02" / labels.name).write_text(text)
        lines: list[str] = []
        for number, label in enumerate(("Car", "Pedestrian")):
            path = folder / "det2d_rrc" / label / labels.name
            detections = np.loadtxt(path, delimiter=",", ndmin=2)
            lines += followed(detections, label, 1000 * number) if detections.size else []
        (location / "results" / "greedy" / "data" / labels.name).write_text("\n".join(lines) + "\n")
        frames = 1 + max(int(line.split()[0]) for line in [*text.splitlines(), *lines] if line.strip())
        lengths.append(f"{labels.stem} empty 000000 {frames:06d}\n")
    (location / "truth" / "evaluate_tracking.seqmap.training").write_text("".join(lengths))


def by_trackeval(location: Path) -> None:
    """Let TrackEval compute the same figures."""
    import trackeval

    quiet = {"PRINT_CONFIG": False}
    off = dict.fromkeys(("PRINT_RESULTS", "OUTPUT_SUMMARY", "OUTPUT_DETAILED", "PLOT_CURVES", "TIME_PROGRESS"), False)
    with contextlib.redirect_stdout(io.StringIO()):
        dataset = trackeval.datasets.Kitti2DBox(
            {"GT_FOLDER": str(location / "truth"), "TRACKERS_FOLDER": str(location / "results"), **quiet}
        )
        metrics = [trackeval.metrics.HOTA(), trackeval.metrics.CLEAR({**quiet}), trackeval.metrics.Identity({**quiet})]
        trackeval.Evaluator({**off, **quiet, "LOG_ON_ERROR": None}).evaluate([dataset], metrics)


def least_seconds(work: Callable[[], object], runs: int) -> float:
    """Time of the processor, the least of some runs."""
    times = []
    for _ in range(runs):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


def main(folder: Path) -> None:
    """Measure, and print a line for each."""
    with tempfile.TemporaryDirectory() as name:
        location = Path(name)
        write_sides(folder, location)
        results, truth = location / "results" / "greedy", location / "truth"
        sides = read_both(results, truth)
        frames = sum(1 + int(table.frames.max()) for table in sides.truth.values())
        print(f"{len(sides.truth)} sequences, {frames} frames, cars and pedestrians")
        ours = least_seconds(lambda: evaluate_tracking(sides.results, sides.truth), 5)
        print(f"tracks, in memory       {ours:8.3f} s")
        reading = least_seconds(lambda: read_both(results, truth), 3)
        print(f"tracks, with reading    {ours + reading:8.3f} s")
        found = read_both(folder / "det3d_pointrcnn", folder)
        seconds = least_seconds(lambda: evaluate_detection(found.results, found.truth, classes=("car",)), 5)
        print(f"detections, in memory   {seconds:8.3f} s")
        theirs = least_seconds(lambda: by_trackeval(location), 2)
        print(f"tracks, by TrackEval    {theirs:8.3f} s   {theirs / (ours + reading):.1f} times as long")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("../shared/data/real/kitti_tracking"))
    main(parser.parse_args().folder)
