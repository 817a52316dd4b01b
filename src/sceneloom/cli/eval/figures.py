"""The figures of an evaluation as tables for people."""

from typing import TYPE_CHECKING

import click

from sceneloom.cli.printing import print_table, seconds, several

if TYPE_CHECKING:
    from sceneloom.evaluate.trajectory_errors import (
        ErrorStatistics,
        KittiErrors,
        RelativeErrors,
        TrajectoryReport,
    )

_COLUMNS = ("mean", "rms", "median", "95 %", "max", "min", "std")


def print_report(report: "TrajectoryReport") -> None:
    """Print what was compared, the errors at the same times, those of motions, and KITTI's."""
    click.echo(f"{report.estimate} against {report.reference}")
    click.echo(
        f"{several(report.pairs, 'pair')} of {report.estimate_poses} and {report.reference_poses} poses, "
        f"{report.seconds:.3f} s from {seconds(report.start_ns)}, {report.path_length:.2f} m, "
        f"{100 * report.coverage:.1f} % of the reference's time"
    )
    click.echo(_alignment(report))
    absolute = report.absolute
    rows = [
        ("translation [m]", absolute.translation),
        ("  horizontal [m]", absolute.horizontal),
        ("  vertical [m]", absolute.vertical),
        ("rotation [°]", absolute.rotation_deg),
    ]
    click.echo("absolute errors (ATE)")
    print_table(
        [("", *_COLUMNS), *((name, *_cells(reported)) for name, reported in rows if reported is not None)]
    )
    if report.relative:
        click.echo("errors of motions (RPE)")
        print_table([("over", "", *_COLUMNS, "per metre", "per second"), *_relative_rows(report.relative)])
    if report.kitti is not None:
        _print_kitti(report.kitti)


def _alignment(report: "TrajectoryReport") -> str:
    how = report.alignment
    if how.kind == "none":
        return "compared as they are, without alignment"
    scale = f", scale {how.scale:.6g}" if how.kind == "sim3" else ""
    return f"aligned by {how.kind} on {several(how.poses, 'pair')}{scale}"


def _relative_rows(relative: "tuple[RelativeErrors, ...]") -> list[tuple[str, ...]]:
    rows = []
    for step in relative:
        percent, rotation = step.translation_percent, step.rotation_deg_per_m
        reported = "" if percent is None else f"{percent:.4g} %"
        rows.append(
            (step.delta, "m", *_cells(step.translation), reported, f"{step.translation_per_s:.4g} m/s")
        )
        if step.rotation_deg is not None:
            reported = "" if rotation is None else f"{rotation:.4g} °/m"
            per_second = f"{step.rotation_deg_per_s:.4g} °/s"
            rows.append(("", "°", *_cells(step.rotation_deg), reported, per_second))
    return rows


def _print_kitti(kitti: "KittiErrors") -> None:
    click.echo("KITTI's odometry figures")
    rows = [("segments of", "count", "translation", "rotation")]
    rows += [
        (
            "all lengths" if part.length is None else f"{part.length:g} m",
            str(part.segments),
            f"{part.translation_percent:.4f} %",
            f"{part.rotation_deg_per_m:.6f} °/m",
        )
        for part in (*kitti.by_length, kitti.overall)
    ]
    print_table(rows)


def _cells(errors: "ErrorStatistics") -> list[str]:
    values = (
        errors.mean,
        errors.rms,
        errors.median,
        errors.percentile_95,
        errors.max,
        errors.min,
        errors.std,
    )
    return [f"{value:.4g}" for value in values]
