"""How well objects are followed on KITTI's sequences, by TrackEval, and how long a frame takes.

    python -m benchmarks.tracking ../shared/data/real/kitti_tracking

Detections are those of PointRCNN in sweeps and RRC in images. What these are like is taken from simulated drives
("simulated"), or fitted to the other sequences ("left out", each sequence without itself); "shipped" is the file of the
package, which was fitted to all of them. The tracker's own numbers were set on `FITTED`; `HELD` was only looked at. The
shares are those of what RRC's boxes reach with the true identities, at the best threshold for each figure, and of what
both detectors' boxes reach with every false one removed. Times are of one processor, for fusing and tracking.
"""

import argparse
import contextlib
import io
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.detector_fits import KITTI, kitti_examples
from sceneloom.detections.fitting import FitSettings, columns_of, fit_columns
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.formats.kitti.tracking_reader import KittiTracking, open_tracking_folder
from sceneloom.pipeline import DetectionInput, TrackingSettings, track_objects
from sceneloom.tracking import ImageBox

FITTED = ("0000", "0002", "0003", "0006", "0010")
HELD = ("0012", "0013", "0014", "0016")
CLASSES = ("car", "pedestrian")
CEILINGS = {"car": ((85.6, 91.7), (87.5, 94.9)), "pedestrian": ((60.2, None), (66.0, None))}
"""HOTA and MOTA that boxes reach with the true identities: RRC's, and those of both detectors."""
VARIANTS: Mapping[str, tuple[bool, ImageBox]] = {
    "online": (False, ImageBox.IMAGE),
    "online, projected": (False, ImageBox.PROJECTED),
    "offline": (True, ImageBox.IMAGE),
    "offline, projected": (True, ImageBox.PROJECTED),
}

Scores = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""By sequence, class and metric."""


class Row(NamedTuple):
    """One line of the table."""

    hota: float
    det: float
    ass: float
    mota: float
    switches: int


def fusions(folder: Path, names: tuple[str, ...], reported: str) -> dict[str, ProjectionSettings]:
    """How each sequence's detections are fused."""
    if reported != "left out":
        detectors = KITTI if reported == "shipped" else "simulated"
        return dict.fromkeys(names, ProjectionSettings(detectors=detectors))
    columns = columns_of(kitti_examples(folder), overlap=FitSettings().overlap)
    return {
        name: ProjectionSettings(detectors=fit_columns(columns.without(columns.groups.index(name)), name="others"))
        for name in names
    }


def follow(tracking: KittiTracking, fusion: Mapping[str, ProjectionSettings], variant: str, location: Path) -> float:
    """Write the results of all sequences, and give the time of a frame [ms]."""
    offline, box2d = VARIANTS[variant]
    location.mkdir(parents=True)
    seconds, frames = 0.0, 0
    for name, settings in fusion.items():
        with tempfile.TemporaryDirectory() as scratch:
            report = track_objects(
                tracking.path,
                Path(scratch) / "out",
                chosen=DetectionInput(sequences=[name]),
                box2d=box2d,
                settings=TrackingSettings(offline=offline, fusion=settings),
            )
            (location / f"{name}.txt").write_text((Path(scratch) / "out" / f"{name}.txt").read_text())
        seconds += sum(drive.seconds for drive in report.drives)
        frames += sum(drive.frames for drive in report.drives)
    return 1e3 * seconds / frames


def lay_out_truth(folder: Path, tracking: KittiTracking, names: tuple[str, ...], truth: Path) -> None:
    """Put labels where TrackEval looks for them."""
    (truth / "label_02").mkdir(parents=True)
    lengths = []
    for name in names:
        (truth / "label_02" / f"{name}.txt").write_text((folder / "label_02" / f"{name}.txt").read_text())
        lengths.append(f"{name} empty 000000 {tracking.sequence(name).frame_count:06d}\n")
    (truth / "evaluate_tracking.seqmap.training").write_text("".join(lengths))


def evaluate(truth: Path, results: Path) -> dict[str, Scores]:
    """Let TrackEval judge all results, by their names."""
    import trackeval

    quiet = {"PRINT_CONFIG": False}
    wordy = ("PRINT_RESULTS", "OUTPUT_SUMMARY", "OUTPUT_DETAILED", "PLOT_CURVES", "TIME_PROGRESS")
    off = {**dict.fromkeys(wordy, False), **quiet, "LOG_ON_ERROR": None}
    with contextlib.redirect_stdout(io.StringIO()):
        dataset = trackeval.datasets.Kitti2DBox({"GT_FOLDER": str(truth), "TRACKERS_FOLDER": str(results), **quiet})
        metrics = [trackeval.metrics.HOTA(), trackeval.metrics.CLEAR({**quiet})]
        found, _ = trackeval.Evaluator(off).evaluate([dataset], metrics)
    judged: dict[str, Scores] = found["Kitti2DBox"]
    return judged


def together(scores: Scores, names: tuple[str, ...], label: str) -> Row:
    """The figures of some sequences as of one."""
    import trackeval

    with contextlib.redirect_stdout(io.StringIO()):
        metrics = trackeval.metrics.HOTA(), trackeval.metrics.CLEAR({"PRINT_CONFIG": False})
    hota, clear = (
        metric.combine_sequences({name: scores[name][label][metric.get_name()] for name in names}) for metric in metrics
    )
    means = (100.0 * float(hota[field].mean()) for field in ("HOTA", "DetA", "AssA"))
    return Row(*means, 100.0 * float(clear["MOTA"]), int(clear["IDSW"]))


def lines(scores: Scores, variant: str, milliseconds: float) -> Iterator[str]:
    """Lines of the table of one way to follow objects."""
    for label in CLASSES:
        for part, names in (("all", FITTED + HELD), ("fitted", FITTED), ("held", HELD)):
            present = tuple(name for name in names if name in scores)
            if not present:
                continue
            row = together(scores, present, label)
            figures = f"{row.hota:7.2f}{row.det:7.2f}{row.ass:7.2f}{row.mota:8.2f}{row.switches:6d}"
            shares = ""
            if part == "all":
                shares = "".join(f"{100 * row.hota / hota:8.1f}" for hota, _ in CEILINGS[label])
                shares += f"{milliseconds:8.2f}"
            yield f"{variant:20s}{label:12s}{part:8s}{figures}{shares}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--detectors", nargs="*", default=["simulated", "left out"])
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS)[:3])
    reported = parser.parse_args()
    tracking = open_tracking_folder(reported.folder)
    names = tuple(name for name in tracking.sequences if name in FITTED + HELD)
    heads = ("HOTA", "DetA", "AssA", "MOTA", "IDSW", "% 2D", "% both", "ms")
    widths = (7, 7, 7, 8, 6, 8, 8, 8)
    for detectors in reported.detectors:
        fusion = fusions(reported.folder, names, detectors)
        with tempfile.TemporaryDirectory() as scratch:
            location = Path(scratch)
            lay_out_truth(reported.folder, tracking, names, location / "truth")
            times = {
                variant: follow(tracking, fusion, variant, location / "results" / variant / "data")
                for variant in reported.variants
            }
            judged = evaluate(location / "truth", location / "results")
        print(f"\n{detectors:40s}" + "".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True)))
        for variant in reported.variants:
            print("\n".join(lines(judged[variant], variant, times[variant])))


if __name__ == "__main__":
    main()
