"""`sceneloom edit` crop, merge, thin, to-world, to-ego, to-sensor and apply, from file to file."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.scene import CuboidAnnotation, LocalizationAdjustment, Poses
from sceneloom.scene.scene import time_span
from sceneloom.simulate import CameraSpec, LidarSpec, annotate, simulate_street

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street with every type of annotation, in a scene file."""
    target = tmp_path_factory.mktemp("edited") / "drive.sfs"
    camera_models = (
        Camera("brown_conrady", 200, 100, 107.0, 107.0, 99.5, 47.5, (-0.12, 0.04, 0.0004, -0.0003, -0.006)),
        Camera("fisheye", 160, 100, 62.0, 62.0, 79.5, 47.5, (0.03, -0.008, 0.002, -0.0004)),
    )
    lidar = LidarSpec(elevations_deg=(-25.0, 15.0), steps=360)
    drive = simulate_street(0, frames=3, lidar=lidar, cameras=tuple(map(CameraSpec, camera_models)))
    sceneloom.write(annotate(drive).scene, target)
    return target


def second_sweep(scene_file: Path) -> str:
    """When the second sweep begins, in seconds after the scene."""
    with sceneloom.open(scene_file) as scene:
        begin_ns, _ = time_span(scene) or (0, 0)
        return str((int(scene.lidars[0].frames.timestamps_ns[1]) - begin_ns) * 1e-9)


def test_thin_reports_how_many_points_are_left(call: Call, recording: Path, tmp_path: Path) -> None:
    outcome = call("edit", "thin", recording, "-o", tmp_path / "thin", "--voxel", "2")
    assert outcome.code == 0, outcome.err
    assert "thin: done in" in outcome.out
    with sceneloom.open(recording) as before, sceneloom.open(tmp_path / "thin") as after:
        counts = [sum(len(frame.points) for frame in scene.lidars[0].frames) for scene in (before, after)]
        kept = after.lidars[0].frames[1].points.positions
    assert f"{counts[0]} points -> {counts[1]}" in outcome.out
    assert len(np.unique(np.floor(kept.astype(float) / 2.0), axis=0)) == len(kept)


def test_thin_counts_the_points_of_sensors_that_stay_as_they_are(
    call: Call, scene_file: Path, tmp_path: Path
) -> None:
    two = tmp_path / "two.sfs"
    assert call("edit", "merge", scene_file, scene_file, "-o", two, "--rename").code == 0
    with sceneloom.open(two) as scene:
        points = sum(len(frame.points) for lidar in scene.lidars for frame in lidar.frames)
        chosen = str(scene.lidars[0].id)
        assert len(scene.lidars) == 2
    thin = ("edit", "thin", two, "-o", tmp_path / "thin.sfs", "--points", "1", "--sensor", chosen)
    reported = json.loads(call(*thin, "--json").out)
    frames = reported["before"]["frames"]
    assert reported["before"]["points"] == points
    assert points / 2 < reported["after"]["points"] <= points / 2 + frames


def test_thin_says_that_points_are_those_of_frames_that_stay(
    call: Call, recording: Path, tmp_path: Path
) -> None:
    outcome = call("edit", "thin", recording, "-o", tmp_path / "thin", "--voxel", "2", "--every", "2")
    assert outcome.code == 0, outcome.err
    assert " points of the frames that stay -> " in outcome.out


def test_crop_is_reported_to_machines(call: Call, scene_file: Path, tmp_path: Path) -> None:
    outcome = call(
        *("edit", "crop", scene_file, "-o", tmp_path / "crop.sfs", "--range", "15"),
        *("--start", second_sweep(scene_file)),
        *("--without", "camera1", "--label", "car", "--json"),
    )
    assert outcome.code == 0, outcome.err
    report = json.loads(outcome.out)
    assert (report["edit"], report["after"]["frames"]) == ("crop", 4)
    assert 0 < report["after"]["points"] < report["before"]["points"]
    assert "sensors-left-out" in [warning["code"] for warning in report["warnings"]]
    with sceneloom.open(tmp_path / "crop.sfs") as scene:
        away = np.concatenate([frame.points.positions for frame in scene.lidars[0].frames])
        assert [camera.id for camera in scene.cameras] == ["camera0"]
        labels = {getattr(annotation, "label", None) for annotation in scene.annotations}
    assert "car" in labels
    assert "pole" not in labels
    assert np.linalg.norm(away, axis=1).max() <= 15.0


def test_a_box_is_six_numbers(call: Call, scene_file: Path, tmp_path: Path) -> None:
    wrong = call("edit", "crop", scene_file, "-o", tmp_path / "c.sfs", "--box", "1,2,3")
    assert (wrong.code, "expected six numbers" in wrong.err) == (2, True)
    empty = call("edit", "crop", scene_file, "-o", tmp_path / "c.sfs", "--box=5,0,0,-5,9,9")
    assert (empty.code, "each minimum at most" in empty.err) == (2, True)
    assert not (tmp_path / "c.sfs").exists()


def test_world_and_ego_and_back_give_the_same_scene(call: Call, scene_file: Path, tmp_path: Path) -> None:
    world, ego, again = (tmp_path / f"{name}.sfs" for name in ("world", "ego", "again"))
    assert call("edit", "to-world", scene_file, "-o", world).code == 0
    assert call("edit", "to-ego", world, "-o", ego).code == 0
    assert call("edit", "to-world", ego, "-o", again).code == 0
    assert call("edit", "to-sensor", again, "-o", tmp_path / "sensor.sfs").code == 0
    with (
        sceneloom.open(world) as a,
        sceneloom.open(again) as b,
        sceneloom.open(ego) as c,
        sceneloom.open(scene_file) as measured,
        sceneloom.open(tmp_path / "sensor.sfs") as back,
    ):
        assert c.lidars[0].coordinates == "ego"
        assert c.metadata["sceneloom"]["annotations_frame"] == "ego"
        for k in range(3):
            # float32 at up to 100 m
            np.testing.assert_allclose(
                b.lidars[0].frames[k].points.positions, a.lidars[0].frames[k].points.positions, atol=2e-5
            )
            np.testing.assert_allclose(
                back.lidars[0].frames[k].points.positions,
                measured.lidars[0].frames[k].points.positions,
                atol=5e-5,
            )
        assert [annotation.id for annotation in b.annotations] == [
            annotation.id for annotation in a.annotations
        ]
        for before, after in zip(a.annotations, b.annotations, strict=True):
            if isinstance(before, CuboidAnnotation):
                np.testing.assert_allclose(after.path.values, before.path.values, atol=1e-9)


def test_parts_are_merged_to_the_whole(call: Call, scene_file: Path, tmp_path: Path) -> None:
    parts, cut = [tmp_path / "a.sfs", tmp_path / "b.sfs"], second_sweep(scene_file)
    assert call("edit", "crop", scene_file, "-o", parts[0], "--stop", cut).code == 0
    assert call("edit", "crop", scene_file, "-o", parts[1], "--start", cut).code == 0
    refused = call("edit", "merge", *parts, "-o", tmp_path / "c.sfs")
    assert (refused.code, "state `--rename`" in refused.err) == (2, True)
    joined = call("edit", "merge", *parts, "-o", tmp_path / "c.sfs", "--join")
    assert joined.code == 0, joined.err
    with sceneloom.open(scene_file) as whole, sceneloom.open(tmp_path / "c.sfs") as scene:
        assert [s.id for s in scene.sensors] == [s.id for s in whole.sensors]
        for a, b in zip(whole.lidars[0].frames, scene.lidars[0].frames, strict=True):
            assert a.timestamp_ns == b.timestamp_ns
            np.testing.assert_array_equal(a.points.positions, b.points.positions)
        assert {a.id for a in scene.annotations} == {a.id for a in whole.annotations}


def test_an_adjustment_in_a_file_is_applied(call: Call, scene_file: Path, tmp_path: Path) -> None:
    lift = replace(Poses.identity(), positions=np.array([[0.0, 0.0, 2.5]]))
    with sceneloom.open(scene_file) as scene:
        annotations = (*scene.annotations, LocalizationAdjustment(7, lift))
        sceneloom.write(replace(scene, annotations=annotations), tmp_path / "given.sfs")
        before = scene.lidars[0].poses.positions
    unknown = call("edit", "apply", tmp_path / "given.sfs", "-o", tmp_path / "x.sfs", "--only", "8")
    assert (unknown.code, "no correction '8'" in unknown.err) == (2, True)
    outcome = call("edit", "apply", tmp_path / "given.sfs", "-o", tmp_path / "x.sfs", "--only", "7")
    assert outcome.code == 0, outcome.err
    with sceneloom.open(tmp_path / "x.sfs") as scene:
        np.testing.assert_allclose(
            scene.lidars[0].poses.positions, before + np.array([0.0, 0.0, 2.5]), atol=1e-9
        )
        assert scene.metadata["sceneloom"]["applied"] == [{"id": 7, "type": "localization_adjustment"}]


@pytest.mark.parametrize("verb", ["thin", "crop", "merge", "to-world", "to-ego", "to-sensor", "apply"])
def test_no_edit_replaces_a_file_unasked(call: Call, scene_file: Path, tmp_path: Path, verb: str) -> None:
    (tmp_path / "there.sfs").touch()
    options = ["--every", "2"] if verb == "thin" else []
    outcome = call("edit", verb, scene_file, "-o", tmp_path / "there.sfs", *options)
    assert (outcome.code, "--overwrite" in outcome.err) == (1, True)
