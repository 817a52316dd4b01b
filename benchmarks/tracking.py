"""How well objects are followed on KITTI's sequences, by TrackEval, and how long a frame takes.

    python -m benchmarks.tracking ../shared/data/real/kitti_tracking

Detections are those of PointRCNN in sweeps and RRC in images. What these are like is taken from simulated drives
("simulated"), or fitted to the other sequences ("left out", each sequence without itself); "shipped" is the file of the
package, which was fitted to all of them. The tracker's own numbers were set on `FITTED`; `HELD` was only looked at, and
`HARD` came later. The shares are those of what RRC's boxes reach with the true identities, at the best threshold for
each figure, and of what both detectors' boxes reach with every false one removed, on the first two. Times are of one
processor, for fusing and tracking.

    python -m benchmarks.tracking ../shared/data/real/kitti_tracking --cross-validate

leaves out one sequence after another: the detectors' numbers are fitted to the others, and each of the tracker's, of
`TrackerSettings` and of its module, is chosen out of itself, its half and its double (of shares: of their odds), by the
mean HOTA of both classes on the others, where that gains more than its standard error. "held out" is what the sequences
left out reach with that, with the interval of 95 % of a bootstrap over sequences; "defaults, left out" has the
tracker's defaults; "in sample" is what is reached if all is chosen on the very sequences that are reported, with
detectors fitted to them. It takes twenty minutes a variant.

FOLDER may be another one that is laid out like KITTI's, as by `benchmarks.tracking_drives`; its sequences are grouped
by what their names begin with.
"""

import argparse
import contextlib
import io
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import fields as dataclass_fields
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from benchmarks.detector_fits import KITTI, kitti_examples
from benchmarks.tracking_peers import follow as follow_as_peer
from sceneloom.detections import DetectionPair, FusedBoxes
from sceneloom.detections.fitting import FitSettings, columns_of, fit_columns
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.formats.kitti.benchmark_writer import write_labels
from sceneloom.formats.kitti.tracking_reader import KittiTracking, open_tracking_folder
from sceneloom.pipeline import DetectionInput, TrackingSettings, track_objects
from sceneloom.pipeline.detected_drive import kitti_drive
from sceneloom.tracking import ImageBox, TrackerSettings
from sceneloom.tracking import tracker as tracker_module

FITTED = ("0000", "0002", "0003", "0006", "0010")
HELD = ("0012", "0013", "0014", "0016")
HARD = ("0009", "0011", "0019")
CLASSES = ("car", "pedestrian")
CEILINGS = {"car": ((85.6, 91.7), (87.5, 94.9)), "pedestrian": ((60.2, None), (66.0, None))}
"""HOTA and MOTA that boxes reach with the true identities: RRC's, and those of both detectors."""
VARIANTS: Mapping[str, tuple[bool, ImageBox]] = {
    "online": (False, ImageBox.IMAGE),
    "online, projected": (False, ImageBox.PROJECTED),
    "offline": (True, ImageBox.IMAGE),
    "offline, projected": (True, ImageBox.PROJECTED),
}

PARTS = {"all": FITTED + HELD + HARD, "first": FITTED + HELD, "fitted": FITTED, "held": HELD, "hard": HARD}
"""Sequences of KITTI that have a row together."""

Scores = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""By sequence, class and metric."""


class Row(NamedTuple):
    """One line of the table."""

    hota: float
    det: float
    ass: float
    mota: float
    switches: int


def parts_of(names: tuple[str, ...]) -> Mapping[str, tuple[str, ...]]:
    """Which sequences have a row together."""
    if set(names) <= set(PARTS["all"]):
        return {part: tuple(name for name in some if name in names) for part, some in PARTS.items()}
    starts = sorted({name.partition("_")[0] for name in names})
    return {"all": names, **{start: tuple(name for name in names if name.startswith(start)) for start in starts}}


def fusions(folder: Path, names: tuple[str, ...], reported: str) -> dict[str, ProjectionSettings]:
    """How each sequence's detections are fused."""
    if reported in {"shipped", "simulated"}:
        return dict.fromkeys(names, ProjectionSettings(detectors=KITTI if reported == "shipped" else reported))
    columns = columns_of(kitti_examples(folder), overlap=FitSettings().overlap)
    if reported == "in sample":
        return dict.fromkeys(names, ProjectionSettings(detectors=fit_columns(columns, name="all")))
    return {
        name: ProjectionSettings(detectors=fit_columns(columns.without(columns.groups.index(name)), name="others"))
        for name in names
    }


class Remembered:
    """Fusion that fuses each pair of one sequence once: the tracker's numbers change nothing of it."""

    def __init__(self, settings: ProjectionSettings) -> None:
        self.settings = settings
        self.fused: dict[int, FusedBoxes] = {}

    def __call__(self, pair: DetectionPair) -> FusedBoxes:
        """The objects behind the boxes of a pair."""
        time_ns = pair.boxes_3d.timestamp_ns
        if time_ns not in self.fused:
            self.fused[time_ns] = fuse_by_projection(pair, settings=self.settings)
        return self.fused[time_ns]


class Numbers(NamedTuple):
    """The tracker's numbers: its settings, and those of its module that are not the usual ones."""

    settings: TrackerSettings = TrackerSettings()
    constants: Mapping[str, float] = MappingProxyType({})


_Trackers = Mapping[str, Numbers]  # by sequence

CONSTANTS = (
    "_ACROSS", "_CLIMB", "_LEAST_OVERLAP", "_LEAST_SIGMA", "_OVERLAP_SIGMA", "_ROTATION_TIME", "_SEEN_ALONG",
    "_SIZE_DRIFT", "_TWIN_OVERLAP", "_TWIN_SHARE", "_USUAL_OVERLAP", "EDGE_PX", "RETURN_TIME",
)  # fmt: skip
"""Numbers of `tracking.tracker` that nothing measured."""

SHARES = ("trust", "report", "drop", "accept", "_LEAST_OVERLAP", "_TWIN_OVERLAP", "_TWIN_SHARE", "_USUAL_OVERLAP")


@contextlib.contextmanager
def with_constants(constants: Mapping[str, float]) -> Iterator[None]:
    """The tracker's module with other numbers."""
    usual = {name: getattr(tracker_module, name) for name in constants}
    for name, value in constants.items():
        setattr(tracker_module, name, value)
    try:
        yield
    finally:
        for name, value in usual.items():
            setattr(tracker_module, name, value)


def follow(
    tracking: KittiTracking,
    fusion: Mapping[str, ProjectionSettings | Remembered],
    variant: str,
    location: Path,
    trackers: _Trackers | None = None,
) -> float:
    """Write the results of all sequences, and give the time of a frame [ms]."""
    offline, box2d = VARIANTS[variant]
    location.mkdir(parents=True)
    seconds, frames = 0.0, 0
    for name, settings in fusion.items():
        numbers = Numbers() if trackers is None else trackers[name]
        how: dict[str, Any] = {"fusion": settings}
        if isinstance(settings, Remembered):
            how = {"fusion": settings.settings, "algorithm": settings}
        with tempfile.TemporaryDirectory() as scratch, with_constants(numbers.constants):
            report = track_objects(
                tracking.path,
                Path(scratch) / "out",
                chosen=DetectionInput(sequences=[name]),
                box2d=box2d,
                settings=TrackingSettings(offline=offline, tracker=numbers.settings, **how),
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
        metric.combine_sequences({k: scores[name][label][metric.get_name()] for k, name in enumerate(names)})
        for metric in metrics
    )
    means = (100.0 * float(hota[field].mean()) for field in ("HOTA", "DetA", "AssA"))
    return Row(*means, 100.0 * float(clear["MOTA"]), int(clear["IDSW"]))


def lines(scores: Scores, variant: str, milliseconds: float) -> Iterator[str]:
    """Lines of the table of one way to follow objects."""
    for label in CLASSES:
        for part, names in parts_of(tuple(name for name in scores if name != "COMBINED_SEQ")).items():
            if not any(scores[name][label]["Count"]["GT_Dets"] for name in names):
                continue
            row = together(scores, names, label)
            figures = f"{row.hota:7.2f}{row.det:7.2f}{row.ass:7.2f}{row.mota:8.2f}{row.switches:6d}"
            shares = f"{'':16s}"
            if part == "first":
                shares = "".join(f"{100 * row.hota / hota:8.1f}" for hota, _ in CEILINGS[label])
            shares += f"{milliseconds:8.2f}"
            yield f"{variant:20s}{label:12s}{part:8s}{figures}{shares}"


def usual(name: str) -> float:
    """One of the tracker's numbers."""
    return float(getattr(tracker_module if name in CONSTANTS else TrackerSettings(), name))


def alternatives(name: str) -> tuple[float, float]:
    """Half and double of one of the tracker's numbers; of a share, of its odds."""
    value = usual(name)
    if name in SHARES:
        odds = value / (1.0 - value)
        return odds / (odds + 2.0), 2.0 * odds / (2.0 * odds + 1.0)
    return 0.5 * value, 2.0 * value


def changed(changes: Mapping[str, float]) -> Numbers:
    """The tracker's numbers with some changes."""
    constants = {name: value for name, value in changes.items() if name in CONSTANTS}
    own = {name: value for name, value in changes.items() if name not in constants}
    return Numbers(replace(TrackerSettings(), **own), constants)


def figure(scores: Scores, names: tuple[str, ...]) -> float:
    """What numbers are chosen by: the mean HOTA of both classes."""
    return sum(together(scores, names, label).hota for label in CLASSES) / len(CLASSES)


def sure_gain(scores: Scores, usual_scores: Scores, names: tuple[str, ...]) -> float:
    """By how much a figure is better than the usual one, less the standard error of that by the jackknife.

    Source: Breiman, Friedman, Olshen and Stone 1984, "Classification and Regression Trees", section 3.4.3, for the rule
    of one standard error.
    """
    gain = figure(scores, names) - figure(usual_scores, names)
    if gain <= 0.0:
        return gain
    fewer = [tuple(other for other in names if other != name) for name in names]
    gains = np.array([figure(scores, some) - figure(usual_scores, some) for some in fewer])
    return gain - float(np.sqrt((len(names) - 1) * gains.var()))


def chosen(judged: Mapping[str, Scores], names: tuple[str, ...]) -> Numbers:
    """The tracker's numbers, each as it is surely best on some sequences with the defaults of all others."""
    best: dict[str, float] = {}
    for name in numbers_of_tracker():
        gains = [sure_gain(judged[f"{name} {end}"], judged["default"], names) for end in ENDS]
        if max(gains) > 0.0:
            best[name] = alternatives(name)[int(np.argmax(gains))]
    return changed(best)


ENDS = ("low", "high")


def numbers_of_tracker() -> list[str]:
    """The names of all that is a number."""
    own = [row.name for row in dataclass_fields(TrackerSettings) if isinstance(row.default, float)]
    return [*own, *CONSTANTS]


def interval(scores: Scores, names: tuple[str, ...], label: str) -> tuple[float, float]:
    """What 95 of 100 HOTA of as many sequences, drawn with putting back, lie between."""
    random = np.random.default_rng(0)
    draws = [together(scores, tuple(random.choice(names, len(names))), label).hota for _ in range(200)]
    low, high = np.percentile(draws, (2.5, 97.5))
    return float(low), float(high)


PEERS = {"AB3DMOT": False, "DeepFusionMOT": True}
"""Trackers of others, and whether they take the boxes of both detectors."""

LEAST_SCORES = (-99.0, 0.0, 1.0, 2.0, 3.0)
"""Of PointRCNN's boxes, out of which those of the peers are chosen, which say nothing of them."""


def write_peer(
    tracking: KittiTracking, least_scores: Mapping[str, Mapping[str, float]], location: Path, *, by_both: bool
) -> None:
    """Write what a peer follows, with the least score of each sequence and class."""
    location.mkdir(parents=True)
    for name, of_classes in least_scores.items():
        sequence = tracking.sequence(name)
        labels = {label.capitalize(): least for label, least in of_classes.items()}
        found = follow_as_peer(kitti_drive(sequence), sequence.rectified_from_lidar, labels, by_both=by_both)
        write_labels(found, location / f"{name}.txt")


def cross_validated_peer(
    peer: str, tracking: KittiTracking, names: tuple[str, ...], truth: Path, location: Path
) -> Scores:
    """What a peer reaches on sequences that did not choose which boxes it looks at."""
    for least in LEAST_SCORES:
        own = dict.fromkeys(names, dict.fromkeys(CLASSES, least))
        write_peer(tracking, own, location / "tried" / f"{least:g}" / "data", by_both=PEERS[peer])
    judged = evaluate(truth, location / "tried")
    held: dict[str, dict[str, float]] = {}
    for name in names:
        others = tuple(other for other in names if other != name)
        held[name] = {
            label: max(LEAST_SCORES, key=lambda least: together(judged[f"{least:g}"], others, label).hota)
            for label in CLASSES
        }
    write_peer(tracking, held, location / "held" / peer / "data", by_both=PEERS[peer])
    return evaluate(truth, location / "held")[peer]


def cross_validate(folder: Path, tracking: KittiTracking, names: tuple[str, ...], variant: str) -> None:
    """Print what is reached on sequences that chose nothing, and how much less that is than on those that did."""
    fusion = {name: Remembered(settings) for name, settings in fusions(folder, names, "left out").items()}
    tried = {"default": Numbers()}
    for name in numbers_of_tracker():
        tried |= {f"{name} {end}": changed({name: value}) for end, value in zip(ENDS, alternatives(name), strict=True)}
    with tempfile.TemporaryDirectory() as scratch:
        truth, results = Path(scratch) / "truth", Path(scratch) / "results"
        lay_out_truth(folder, tracking, names, truth)
        for key, numbers in tried.items():
            follow(tracking, fusion, variant, results / key / "data", dict.fromkeys(names, numbers))
        judged = evaluate(truth, results)
        print(f"\n{variant}: HOTA by each number, low, as it is, high")
        for name in numbers_of_tracker():
            rows = [judged[key] for key in (f"{name} low", "default", f"{name} high")]
            cars, people = ([together(row, names, label).hota for row in rows] for label in CLASSES)
            figures = "".join(f"{value:8.2f}" for value in (*cars, *people))
            print(f"{name:24s}{usual(name):10.4g}{figures}")
        held = {name: chosen(judged, tuple(other for other in names if other != name)) for name in names}
        own = {name: Remembered(settings) for name, settings in fusions(folder, names, "in sample").items()}
        rows = {
            "held out": (fusion, held),
            "defaults, left out": (fusion, dict.fromkeys(names, Numbers())),
            "in sample": (own, dict.fromkeys(names, chosen(judged, names))),
        }
        final = Path(scratch) / "final"
        for key, (how, numbers) in rows.items():
            follow(tracking, how, variant, final / key / "data", numbers)
        found = evaluate(truth, final)
        for peer in PEERS if variant == "online" else ():
            found[f"{peer}, held out"] = cross_validated_peer(peer, tracking, names, truth, Path(scratch) / peer)
    print(f"\n{variant:20s}{'class':12s}{'HOTA':>7}{'from':>7}{'to':>7}{'DetA':>7}{'AssA':>7}{'MOTA':>8}{'IDSW':>6}")
    for label in CLASSES:
        for key in found:
            row, (low, high) = together(found[key], names, label), interval(found[key], names, label)
            figures = (
                f"{row.hota:7.2f}{low:7.1f}{high:7.1f}{row.det:7.2f}{row.ass:7.2f}{row.mota:8.2f}{row.switches:6d}"
            )
            print(f"{key:20s}{label:12s}{figures}")
        difference = together(found["in sample"], names, label).hota - together(found["held out"], names, label).hota
        print(f"{'overfitting':20s}{label:12s}{difference:7.2f}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--detectors", nargs="*", default=["simulated", "left out"])
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS)[:3])
    parser.add_argument("--cross-validate", action="store_true")
    reported = parser.parse_args()
    tracking = open_tracking_folder(reported.folder)
    names = tuple(name for name in tracking.sequences if name in PARTS["all"]) or tracking.sequences
    if reported.cross_validate:
        for variant in reported.variants:
            cross_validate(reported.folder, tracking, names, variant)
        return
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
