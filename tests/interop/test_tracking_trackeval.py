"""Figures of trackers on KITTI's sequences, against TrackEval."""

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest

from sceneloom.evaluate.objects import ObjectTable
from sceneloom.evaluate.tracking import evaluate_tracking
from sceneloom.formats.kitti.labels import read_labels

trackeval = pytest.importorskip("trackeval", reason="no trackeval: pip install trackeval")

SEQUENCES = ("0000", "0012", "0013", "0014")
"""Cars and people, a short one, many people, and cars that are hard to see."""


def _names(text: str) -> dict[str, str]:
    return dict(pair.split("=") for pair in text.split())


FAMILIES = {
    "hota": ("HOTA", _names("hota=HOTA deta=DetA assa=AssA loca=LocA detre=DetRe detpr=DetPr assre=AssRe asspr=AssPr")),
    "clear": (
        "CLEAR",
        _names("mota=MOTA motp=MOTP recall=CLR_Re precision=CLR_Pr tp=CLR_TP fn=CLR_FN fp=CLR_FP idsw=IDSW frag=Frag")
        | _names("mt=MT pt=PT ml=ML"),
    ),
    "identity": ("Identity", _names("idf1=IDF1 idp=IDP idr=IDR idtp=IDTP idfn=IDFN idfp=IDFP")),
}
"""By family of figures: our names and TrackEval's."""


def overlaps(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    common = np.clip(high - low, 0, None).prod(axis=2)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (first, second)]
    return common / (areas[0][:, None] + areas[1][None] - common)


def follow_greedily(detections: np.ndarray, first_id: int) -> list[tuple[int, int, np.ndarray]]:
    """Give each box the id of the one it overlaps most in the frame before; many switches, as is wanted."""
    tracked, next_id = [], first_id
    before, ids_before = np.zeros((0, 4)), []
    for frame in range(int(detections[:, 0].max()) + 1):
        boxes = detections[(detections[:, 0] == frame) & (detections[:, 5] > 0.4), 1:5]
        ids = [-1] * len(boxes)
        alike = overlaps(before, boxes)
        while alike.size and alike.max() > 0.3:
            i, j = np.unravel_index(alike.argmax(), alike.shape)
            ids[j] = ids_before[i]
            alike[i], alike[:, j] = -1, -1
        for k in range(len(boxes)):
            if ids[k] < 0:
                ids[k], next_id = next_id, next_id + 1
            tracked.append((frame, ids[k], boxes[k]))
        before, ids_before = boxes, ids
    return tracked


def write_results(folder: Path, path: Path, name: str) -> None:
    lines = []
    for number, label in enumerate(("Car", "Pedestrian")):
        detections = np.loadtxt(folder / "det2d_rrc" / label / f"{name}.txt", delimiter=",", ndmin=2)
        for frame, track, box in follow_greedily(detections, 1000 * number) if detections.size else ():
            corners = " ".join(f"{edge:.6f}" for edge in box)
            lines.append(f"{frame} {track} {label} -1 -1 -10 {corners} -1 -1 -1 -1000 -1000 -1000 -10 0.9")
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def sides(data_dir, tmp_path_factory) -> tuple[Path, Path]:
    """Labels and results of a tracker as TrackEval wants to find them."""
    folder = data_dir / "real" / "kitti_tracking"
    if not folder.is_dir():
        pytest.skip(f"no sequences at {folder}")
    location = tmp_path_factory.mktemp("trackeval")
    (location / "truth" / "label_02").mkdir(parents=True)
    (location / "results" / "greedy" / "data").mkdir(parents=True)
    lengths = []
    for name in SEQUENCES:
        text = (folder / "label_02" / f"{name}.txt").read_text()
        (location / "truth" / "label_02" / f"{name}.txt").write_text(text)
        write_results(folder, location / "results" / "greedy" / "data" / f"{name}.txt", name)
        lengths.append(f"{name} empty 000000 {int(text.split(chr(10))[-2].split()[0]) + 1:06d}\n")
    (location / "truth" / "evaluate_tracking.seqmap.training").write_text("".join(lengths))
    return location / "truth", location / "results"


@pytest.fixture(scope="module")
def theirs(sides):
    truth, results = sides
    quiet = {"PRINT_CONFIG": False}
    off = dict.fromkeys(("PRINT_RESULTS", "OUTPUT_SUMMARY", "OUTPUT_DETAILED", "PLOT_CURVES", "TIME_PROGRESS"), False)
    with contextlib.redirect_stdout(io.StringIO()):
        dataset = trackeval.datasets.Kitti2DBox({"GT_FOLDER": str(truth), "TRACKERS_FOLDER": str(results), **quiet})
        metrics = [trackeval.metrics.HOTA(), trackeval.metrics.CLEAR({**quiet}), trackeval.metrics.Identity({**quiet})]
        evaluator = trackeval.Evaluator({**off, **quiet, "LOG_ON_ERROR": None})
        reported, _ = evaluator.evaluate([dataset], metrics)
    return reported["Kitti2DBox"]["greedy"]


@pytest.fixture(scope="module")
def ours(sides):
    truth, results = sides
    tables = [
        {path.stem: ObjectTable.of_kitti(read_labels(path)) for path in sorted(folder.glob("*.txt"))}
        for folder in (results / "greedy" / "data", truth / "label_02")
    ]
    return evaluate_tracking(*tables)


@pytest.mark.parametrize("label", ["car", "pedestrian"])
def test_figures_and_curves_over_similarities_are_those_of_trackeval(ours, theirs, label):
    evaluated = ours[label]
    for sequence in (*SEQUENCES, "COMBINED_SEQ"):
        reported = evaluated.combined if sequence == "COMBINED_SEQ" else evaluated.sequences[sequence]
        for family, (name, figures) in FAMILIES.items():
            scores, expected = getattr(reported, family), theirs[sequence][label][name]
            for figure, their_name in figures.items():
                # both add the same numbers in another order
                assert getattr(scores, figure) == pytest.approx(np.mean(expected[their_name]), abs=1e-9), figure
    curves, expected = evaluated.combined.hota.curves, theirs["COMBINED_SEQ"][label]["HOTA"]
    for figure, their_name in FAMILIES["hota"][1].items():
        np.testing.assert_allclose(curves[figure], expected[their_name], rtol=0, atol=1e-9)
    assert curves["tp"] == tuple(expected["HOTA_TP"])
    # the results make every kind of mistake
    reported = [one.combined.clear for one in ours.values()]
    for mistake in ("fn", "fp", "idsw", "frag", "mt", "pt", "ml"):
        assert sum(getattr(clear, mistake) for clear in reported) > 0, mistake
