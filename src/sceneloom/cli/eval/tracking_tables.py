"""The figures of a tracker as tables for people, shares in percent."""

from typing import TYPE_CHECKING

import click

from sceneloom.cli.printing import print_table, several

if TYPE_CHECKING:
    from sceneloom.evaluate.tracking import ClassTracking, TrackingReport, TrackingScores

_HOTA = ("HOTA", "DetA", "AssA", "LocA", "DetRe", "DetPr", "AssRe", "AssPr")
_CLEAR = ("MOTA", "MOTP", "Recall", "Precision", "TP", "FN", "FP", "IDSW", "Frag", "MT", "PT", "ML")
_IDENTITY = ("IDF1", "IDP", "IDR", "IDTP", "IDFN", "IDFP")
_FAMILIES = {"hota": _HOTA, "clear": _CLEAR, "identity": _IDENTITY}


def print_tracking(report: "TrackingReport") -> None:
    """Print what was compared, and by class the three families of figures, of each sequence and of all together."""
    click.echo(f"{report.results} against {report.truth}")
    click.echo(
        f"{several(len(report.sequences), 'sequence')}, similarity {report.similarity}, "
        f"{report.least_similarity:g} for CLEAR and identities"
    )
    for label, scores in report.classes.items():
        combined = scores.combined
        click.echo(
            f"{label}: {several(combined.true_objects, 'object')} in {combined.true_boxes} boxes, "
            f"{several(combined.found_objects, 'track')} in {combined.found_boxes}"
        )
        for family, names in _FAMILIES.items():
            print_table([("", *names), *_rows(scores, family, names)])


def _rows(scores: "ClassTracking", family: str, names: tuple[str, ...]) -> list[tuple[str, ...]]:
    rows = [(sequence, *_cells(one, family, names)) for sequence, one in scores.sequences.items()]
    return [*(rows if len(rows) > 1 else ()), ("all", *_cells(scores.combined, family, names))]


def _cells(scores: "TrackingScores", family: str, names: tuple[str, ...]) -> list[str]:
    values = [getattr(getattr(scores, family), name.lower()) for name in names]
    return [str(value) if isinstance(value, int) else f"{100 * value:.2f}" for value in values]
