"""The figures of detections as tables for people, shares in percent."""

from typing import TYPE_CHECKING

import click

from sceneloom.cli.printing import print_table, several

if TYPE_CHECKING:
    from sceneloom.evaluate.detection import (
        ClassDetection,
        CovarianceScores,
        DetectionReport,
        DetectionScores,
    )

_COLUMNS = ("AP40", "AP11", "max F1", "at score", "precision", "recall", "objects", "detections", "ECE")


def print_detection(report: "DetectionReport") -> None:
    """Print what was compared, and by class precision and recall, and how true scores and covariances are."""
    click.echo(f"{report.results} against {report.truth}")
    click.echo(several(len(report.sequences), "sequence"))
    for label, reported in report.classes.items():
        click.echo(label)
        rows = [
            (f"{one.similarity} > {one.least_overlap:g}", name, *_cells(scores))
            for one in reported
            for name, scores in one.difficulties.items()
        ]
        print_table([("overlap", "", *_COLUMNS), *rows])
        _print_covariances(reported)


def _cells(scores: "DetectionScores") -> list[str]:
    shares = [scores.ap40, scores.ap11, scores.max_f1, scores.precision, scores.recall]
    ap40, ap11, max_f1, precision, recall = (f"{100 * share:.2f}" for share in shares)
    threshold = "" if scores.threshold is None else f"{scores.threshold:.3f}"
    error = "" if scores.calibration is None else f"{scores.calibration.error:.4f}"
    counts = (str(scores.true_objects), str(scores.detections))
    return [ap40, ap11, max_f1, threshold, precision, recall, *counts, error]


def _print_covariances(reported: "tuple[ClassDetection, ...]") -> None:
    judged = next((one for one in reported if one.covariances), None)
    if judged is None or judged.covariances is None:
        return
    levels = [part.level for part in next(iter(judged.covariances.values())).coverages]
    head = ("covariances", "errors", "rms", "NEES", "expected", *(f"{100 * level:g} %" for level in levels))
    print_table([head, *(_row(name, part) for name, part in judged.covariances.items())])
    if judged.headings_reversed is not None:
        click.echo(f"  headings reversed: {100 * judged.headings_reversed:.2f} %")


def _row(name: str, part: "CovarianceScores") -> tuple[str, ...]:
    shares = (f"{100 * one.share:.2f}" for one in part.coverages)
    expected = f"{part.nees_low:.2f} to {part.nees_high:.2f}"
    return (name, str(part.count), f"{part.root_mean_square:.3f}", f"{part.nees:.2f}", expected, *shares)
