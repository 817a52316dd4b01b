"""`sceneloom edit count`, `project` and `simplify` through the command line."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.scene import CuboidAnnotation, LabeledPointsAnnotation
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, simulate_street

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    drive = simulate_street(
        2, frames=3, lidar=LidarSpec(beams=16, steps=360), cameras=(camera,), traffic=TrafficSpec()
    )
    path = tmp_path_factory.mktemp("street") / "street.sfs"
    sceneloom.write(drive.scene, path)
    return path


def test_edit_count_reports_the_points_of_each_cuboid(call: Call, street: Path, tmp_path: Path) -> None:
    words = ("--at", "points", "--labeled-points", "--json")
    outcome = call("edit", "count", street, "-o", tmp_path / "out.sfs", *words)
    assert outcome.code == 0, outcome.err
    report = json.loads(outcome.out)
    assert report["points_in_cuboids"] == sum(report["points_by_cuboid"].values()) > 100
    with sceneloom.open(tmp_path / "out.sfs") as scene:
        labelled = [a for a in scene.annotations if isinstance(a, LabeledPointsAnnotation)]
        assert (
            sum(len(e.point_ids) for a in labelled for e in a.labeled_points) == report["points_in_cuboids"]
        )
        reported = {
            str(a.id): sum(path.values[k] for path in a.attributes for k in range(len(path.values)))
            for a in scene.annotations
            if isinstance(a, CuboidAnnotation)
        }
    assert reported == report["points_by_cuboid"]


def test_edit_project_fills_projections_that_a_file_keeps(call: Call, street: Path, tmp_path: Path) -> None:
    words = ("--min-pixels", "5", "--see-through", "tree", "--activations")
    outcome = call("edit", "project", street, "-o", tmp_path / "out.sfs", *words)
    assert outcome.code == 0, outcome.err
    assert "cuboids seen: " in outcome.out
    with sceneloom.open(tmp_path / "out.sfs") as scene:
        seen = [a for a in scene.annotations if isinstance(a, CuboidAnnotation) and a.projections]
    assert len(seen) > 3
    boxes = np.concatenate([p.boxes for a in seen for p in a.projections])
    there = np.isfinite(boxes[:, 0])
    assert (boxes[there, 2:] >= 5.0).all()
    assert (boxes[there, 0] + boxes[there, 2] <= 320.0 + 1e-6).all()
    assert all(a.activations for a in seen)
    assert {path.name for a in seen for path in a.attributes} == {"truncation", "occlusion"}


def test_edit_simplify_leaves_out_what_the_rest_reports(call: Call, street: Path, tmp_path: Path) -> None:
    outcome = call("edit", "simplify", street, "-o", tmp_path / "out.sfs", "--only", "cuboids", "-v")
    assert outcome.code == 0, outcome.err
    assert "timestamps of cuboids stay" in outcome.err
    with sceneloom.open(street) as before, sceneloom.open(tmp_path / "out.sfs") as after:
        timestamps = [
            sum(len(a.path.timestamps_ns) for a in scene.annotations if isinstance(a, CuboidAnnotation))
            for scene in (before, after)
        ]
    assert timestamps[1] < timestamps[0]


def test_wrong_values_are_wrong_usage(call: Call, street: Path, tmp_path: Path) -> None:
    for words in (
        ("simplify", "--tolerance-m", "-1"),
        ("project", "--camera", "none"),
        ("count", "--lidar", "none"),
    ):
        outcome = call("edit", words[0], street, "-o", tmp_path / "out.sfs", *words[1:])
        assert (outcome.code, (tmp_path / "out.sfs").exists()) == (2, False), outcome.err


def test_edit_simplify_reports_how_many_timestamps_it_left_out(
    call: Call, street: Path, tmp_path: Path
) -> None:
    outcome = call("edit", "simplify", street, "-o", tmp_path / "out.sfs", "--tolerance-m", "0.05", "--json")
    assert outcome.code == 0, outcome.err
    with sceneloom.open(street) as before, sceneloom.open(tmp_path / "out.sfs") as after:
        left = [
            sum(len(a.path.timestamps_ns) for a in scene.annotations if isinstance(a, CuboidAnnotation))
            + sum(len(s.poses.timestamps_ns) for s in scene.sensors if getattr(s, "poses", None) is not None)
            + sum(len(trajectory.timestamps_ns) for trajectory in scene.trajectories.values())
            for scene in (before, after)
        ]
    assert json.loads(outcome.out)["timestamps_left_out"] == left[0] - left[1] > 0


def test_the_help_of_an_edit_begins_with_its_own_options(call: Call) -> None:
    text = call("edit", "simplify", "--help").out
    assert text.index("--tolerance-m") < text.index("--overwrite") < text.index("--json")
