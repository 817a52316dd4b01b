"""`sceneloom edit count`: how many points of each lidar frame lie in each cuboid."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from sceneloom.cli.edit.running import chosen_trajectory, common, editing, run_edit, trajectory
from sceneloom.cli.identifiers import known_ids

if TYPE_CHECKING:
    from sceneloom.colouring.cuboid_points import PointCounts
    from sceneloom.scene.scene import Scene


@click.command()
@editing
@trajectory
@click.option(
    "--lidar",
    "lidars",
    multiple=True,
    metavar="ID",
    help="The only lidars whose points to count. [default: all]",
)
@click.option(
    "--at",
    type=click.Choice(["frame", "points"]),
    default="frame",
    show_default=True,
    help="Meet cuboids at the time of the frame (deskewed sweeps), or of each point (sweeps as measured).",
)
@click.option("--margin", type=float, default=0.0, metavar="M", help="Count points so far outside, too.")
@click.option("--activations", is_flag=True, help="Also report when each lidar has points of each cuboid.")
@click.option("--labeled-points", is_flag=True, help="Add an annotation of labelled points for each cuboid.")
@common
def count(
    path: Path,
    output: Path,
    trajectory: str | None,
    heading: str | None,
    lidars: tuple[str, ...],
    at: str,
    margin: float,
    activations: bool,
    labeled_points: bool,
    **common: Any,
) -> None:
    """Count the points in each cuboid: an attribute `points` per lidar, and labelled points on request."""
    from sceneloom.colouring.cuboid_points import (
        count_points,
        with_activations,
        with_counts,
        with_labeled_points,
    )

    details: dict[str, Any] = {}

    def change(scenes: "Sequence[Scene]", _: Any) -> "Scene":
        scene = scenes[0].corrected()
        counts = count_points(
            scene,
            lidars=known_ids(scene, lidars) or "all",
            moment=at,
            trajectory=chosen_trajectory(scene, trajectory, heading),
            listed=labeled_points,
            margin=margin,
            activations=not activations,
        )
        details.update(_reported(counts))
        counted = with_counts(scene, counts)
        counted = with_activations(counted, counts) if activations else counted
        return with_labeled_points(counted, counts) if labeled_points else counted

    run_edit("count", [path], output, change, details=details, **common)


def _reported(counts: "PointCounts") -> dict[str, Any]:
    total = np.sum([lidar.counts.sum(axis=0) for lidar in counts.lidars], axis=0)
    points = (
        {str(identifier): int(total[row]) for row, identifier in enumerate(counts.annotation_ids)}
        if counts.lidars
        else {}
    )
    return {
        "cuboids": len(counts.annotation_ids),
        "points_in_cuboids": sum(points.values()),
        "cuboids_without_points": sum(number == 0 for number in points.values()),
        "frames_without_pose": counts.unplaced,
        "points_by_cuboid": points,
    }
