"""`sceneloom edit`: each of its verbs on small drives."""

from dataclasses import replace

import numpy as np
import pytest
from tests.unit.cli.conftest import small_drive

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.pipeline.redacting import ImageBox, blur_files
from sceneloom.scene import CuboidAnnotation, LabeledPointsAnnotation, LocalizationAdjustment, Poses
from sceneloom.scene.scene import time_span
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, annotate, simulate_street


def test_edit_simplify_leaves_out_what_the_rest_reports_and_counts_it(call, succeeds, reported, street, tmp_path):
    outcome = succeeds("edit simplify", street, "-o", tmp_path / "cuboids.sfs", "--only", "cuboids", "-v")
    assert "timestamps of cuboids stay" in outcome.err
    report = reported("edit simplify", street, "-o", tmp_path / "out.sfs", "--tolerance-m", "0.05")
    counts = []
    for path in (street, tmp_path / "cuboids.sfs", tmp_path / "out.sfs"):
        with sceneloom.open(path) as scene:
            cuboids = [a.path for a in scene.annotations if isinstance(a, CuboidAnnotation)]
            poses = [s.poses for s in scene.sensors if getattr(s, "poses", None)] + list(scene.trajectories.values())
            counts.append([sum(len(one.timestamps_ns) for one in found) for found in (cuboids, poses)])
    before, cuboids, after = counts
    assert cuboids[0] < before[0]
    assert report["timestamps_left_out"] == sum(before) - sum(after) > 0
    text = call("edit simplify --help").out
    assert text.index("--tolerance-m") < text.index("--overwrite") < text.index("--json"), "its own options first"


def test_edit_deskew_writes_the_drive_with_sweeps_of_one_moment(call, refuses, succeeds, reported, recording, tmp_path):
    outcome = succeeds("edit deskew", recording, "-o", tmp_path / "drive", "--at", "end", "--lidar", "lidar")
    assert "deskewed 3 of 3 sweeps by trajectory groundTruth to the end of each" in outcome.out
    assert "m on average" in outcome.out
    assert "lost: sensors[lidar].frames[].points.measured_timestamps_ns" in outcome.err
    with sceneloom.open(tmp_path / "drive") as scene:
        assert all(np.ptp(frame.points.timestamps_ns) == 0 for frame in scene.lidars[0].frames)
    report = reported("edit deskew", recording, "-o", tmp_path / "d.sfs", "--trajectory", "imu")
    assert (report["trajectory"], report["deskewed"], report["at"]) == ("imu", 3, "middle")
    assert "rotation-only" in [warning["code"] for warning in report["warnings"]]
    refuses(2, "no sensor 'lidar9'", "edit deskew", recording, "-o", tmp_path / "e.sfs", "--lidar", "lidar9")
    assert call("fuse", recording, "-o", tmp_path / "e.sfs", "--trajectory", "imu").code == 1


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
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


def test_parts_are_cropped_out_and_merged_to_the_whole(refuses, succeeds, reported, scene_file, tmp_path):
    with sceneloom.open(scene_file) as scene:
        start_ns, _ = time_span(scene)
        cut = str((int(scene.lidars[0].frames.timestamps_ns[1]) - start_ns) * 1e-9)
    how = ("--range", "15", "--start", cut, "--without", "camera1", "--label", "car")
    report = reported("edit crop", scene_file, "-o", tmp_path / "crop.sfs", *how)
    assert (report["edit"], report["after"]["frames"]) == ("crop", 4)
    assert 0 < report["after"]["points"] < report["before"]["points"]
    assert "sensors-left-out" in [warning["code"] for warning in report["warnings"]]
    with sceneloom.open(tmp_path / "crop.sfs") as scene:
        away = np.concatenate([frame.points.positions for frame in scene.lidars[0].frames])
        assert [camera.id for camera in scene.cameras] == ["camera0"]
        labels = {getattr(annotation, "label", None) for annotation in scene.annotations}
    assert ("car" in labels, "pole" in labels) == (True, False)
    assert np.linalg.norm(away, axis=1).max() <= 15.0
    parts = [tmp_path / "a.sfs", tmp_path / "b.sfs"]
    for part, side in zip(parts, ("--stop", "--start"), strict=True):
        succeeds("edit crop", scene_file, "-o", part, side, cut)
    refuses(2, "`--rename`", "edit merge", *parts, "-o", tmp_path / "c.sfs")
    succeeds("edit merge", *parts, "-o", tmp_path / "c.sfs", "--join")
    with sceneloom.open(scene_file) as whole, sceneloom.open(tmp_path / "c.sfs") as scene:
        for stated in (lambda s: [one.id for one in s.sensors], lambda s: {one.id for one in s.annotations}):
            assert stated(scene) == stated(whole)
        assert scene.lidars[0].frames.timestamps_ns.tolist() == whole.lidars[0].frames.timestamps_ns.tolist()


def test_thin_reports_how_many_points_are_left_also_of_sensors_that_stay_as_they_are(
    succeeds, reported, recording, scene_file, tmp_path
):
    def counts_of(path):
        with sceneloom.open(path) as scene:
            return {str(lidar.id): sum(len(frame.points) for frame in lidar.frames) for lidar in scene.lidars}

    outcome = succeeds("edit thin", recording, "-o", tmp_path / "thin", "--voxel", "2")
    before, after = (counts_of(path)["lidar"] for path in (recording, tmp_path / "thin"))
    assert "thin: done in" in outcome.out
    assert f"{before} points -> {after}" in outcome.out
    outcome = succeeds("edit thin", recording, "-o", tmp_path / "every", "--voxel", "2", "--every", "2")
    assert " points of the frames that stay -> " in outcome.out
    succeeds("edit merge", scene_file, scene_file, "-o", tmp_path / "two.sfs", "--rename")
    points = counts_of(tmp_path / "two.sfs")
    how = ("--points", "1", "--sensor", next(iter(points)))
    report = reported("edit thin", tmp_path / "two.sfs", "-o", tmp_path / "thin.sfs", *how)
    total = sum(points.values())
    assert report["before"]["points"] == total
    assert total / 2 < report["after"]["points"] <= total / 2 + report["before"]["frames"]


def test_frames_are_changed_and_an_adjustment_is_applied(succeeds, scene_file, tmp_path, refuses):
    for frame in ("ego", "world", "sensor"):
        succeeds("edit", f"to-{frame}", scene_file, "-o", tmp_path / f"{frame}.sfs")
        with sceneloom.open(tmp_path / f"{frame}.sfs") as scene:
            assert scene.lidars[0].points_frame == frame
    lift = replace(Poses.identity(), positions=np.array([[0.0, 0.0, 2.5]]))
    with sceneloom.open(scene_file) as scene:
        annotations = (*scene.annotations, LocalizationAdjustment(7, lift))
        sceneloom.write(replace(scene, annotations=annotations), tmp_path / "given.sfs")
    words = ("edit apply", tmp_path / "given.sfs", "-o", tmp_path / "x.sfs", "--only")
    refuses(2, "no correction '8'", *words, "8")
    succeeds(*words, "7")
    with sceneloom.open(tmp_path / "x.sfs") as scene:
        assert scene.metadata["sceneloom"]["applied"] == [{"id": 7, "type": "localization_adjustment"}]


@pytest.mark.parametrize("verb", ["deskew", "thin", "crop", "merge", "to-world", "to-ego", "to-sensor", "apply"])
def test_no_edit_replaces_a_file_unasked(refuses, scene_file, tmp_path, verb):
    (tmp_path / "there.sfs").touch()
    options = ["--every", "2"] if verb == "thin" else []
    refuses(1, "--overwrite", "edit", verb, scene_file, "-o", tmp_path / "there.sfs", *options)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    drive = simulate_street(2, frames=3, lidar=LidarSpec(beams=16, steps=360), cameras=(camera,), traffic=TrafficSpec())
    path = tmp_path_factory.mktemp("street") / "street.sfs"
    sceneloom.write(drive.scene, path)
    return path


def test_edit_count_and_project_report_what_is_seen_of_each_cuboid(succeeds, reported, street, tmp_path):
    report = reported("edit count", street, "-o", tmp_path / "out.sfs", "--at", "points", "--labeled-points")
    assert report["points_in_cuboids"] == sum(report["points_by_cuboid"].values()) > 100
    with sceneloom.open(tmp_path / "out.sfs") as scene:
        labelled = [a for a in scene.annotations if isinstance(a, LabeledPointsAnnotation)]
        cuboids = [a for a in scene.annotations if isinstance(a, CuboidAnnotation)]
        assert sum(len(e.point_ids) for a in labelled for e in a.labeled_points) == report["points_in_cuboids"]
        counts = {str(a.id): sum(value for path in a.attributes for value in path.values) for a in cuboids}
    assert counts == report["points_by_cuboid"]
    words = ("--min-pixels", "5", "--see-through", "tree", "--activations")
    assert "cuboids seen: " in succeeds("edit project", street, "-o", tmp_path / "seen.sfs", *words).out
    with sceneloom.open(tmp_path / "seen.sfs") as scene:
        seen = [a for a in scene.annotations if isinstance(a, CuboidAnnotation) and a.projections]
    assert len(seen) > 3
    sizes = np.concatenate([p.boxes[:, 2:] for a in seen for p in a.projections])
    assert (sizes[np.isfinite(sizes)] >= 5.0).all()
    assert all(a.activations for a in seen)
    assert {path.name for a in seen for path in a.attributes} == {"truncation", "occlusion"}


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Three images each: a recording with a video, and a scene file with JPEGs."""
    folder = tmp_path_factory.mktemp("drives")
    drive = small_drive()
    sceneloom.write(drive.scene, folder / "recording")
    sceneloom.write(drive.scene, folder / "scene.sfs")
    (folder / "boxes.csv").write_text("number,x1,y1,x2,y2\n1,20,10,60,50\n2,200,10,260,50\n")
    return folder


@pytest.mark.parametrize(
    ("source", "target"), [("recording", "out.sfs"), ("scene.sfs", "out.sfs"), ("scene.sfs", "out/")]
)
def test_boxes_are_hidden_in_the_written_drive_and_the_rest_is_not(reported, drives, tmp_path, source, target):
    how = ("--boxes", drives / "boxes.csv", "--fill", "black", "--margin", "0")
    report = reported("edit blur", drives / source, "-o", f"{tmp_path}/{target}", *how)
    (found,) = report["cameras"]
    assert (found["boxes"], found["hidden"], found["images"], found["outside"]) == (2, 1, 1, 1)
    with sceneloom.open(drives / source) as before, sceneloom.open(tmp_path / target) as after:
        old, new = before.cameras[0].images, after.cameras[0].images
        assert new[1].rgb[12:48, 22:58].max() < 40  # black, but for what a lossy codec brings in at the edges
        assert np.array_equal(new.timestamps_ns, old.timestamps_ns)
        assert np.abs(new[0].rgb.astype(int) - old[0].rgb).mean() < 8
        assert np.abs(new[1].rgb[:, 64:].astype(int) - old[1].rgb[:, 64:]).mean() < 8
        lost = (one for one in report["losses"]["losses"] if "encoded again" in one["what"])
        losses = [(one["field"], one["support"], one["count"]) for one in lost]
        if source == "recording":  # a video is encoded again
            assert (found["encoded"], losses) == (3, [("sensors[camera0].video", "approximated", 3)])
        elif target == "out.sfs":  # images that are not touched are copied, without what they state
            assert new[0].encoded is None or new[0].encoded() == old[0].encoded()
            assert np.array_equal(new[0].rgb, old[0].rgb)


@pytest.mark.parametrize("size", [(96, 64), (95, 63)])
def test_a_lossless_video_stays_so_unless_its_codec_cannot_hold_the_size(tmp_path, size):
    drive = small_drive(Camera("pinhole", *size, 60.0, 60.0, 47.5, 31.5), frames=2)
    sceneloom.write(drive.scene, tmp_path / "in", images="ffv1")
    box = ImageBox((20.0, 10.0, 60.0, 50.0), number=1)
    report = blur_files(tmp_path / "in", tmp_path / "out", boxes=[box], fill="black", margin=0.0)
    with sceneloom.open(tmp_path / "in") as before, sceneloom.open(tmp_path / "out") as after:
        old, new = before.cameras[0].images, after.cameras[0].images
        assert np.array_equal(new.timestamps_ns, old.timestamps_ns)
        old, new = ([image.rgb for image in images] for images in (old, new))
    assert np.array_equal(new[0], old[0])
    if size == (96, 64):
        assert not [loss for loss in report.edit.losses if "encoded again" in loss.what]
        old[1][10:50, 20:60] = 0
        assert np.array_equal(new[1], old[1])
    else:  # images go one by one
        assert (report.cameras[0].encoded, new[1][12:48, 22:58].max()) == (2, 0)


def test_what_was_blurred_is_counted_and_an_anonymised_drive_begins_at_zero(reported, succeeds, drives, tmp_path):
    how = ("--boxes", drives / "boxes.csv")
    outcome = succeeds("edit blur", drives / "recording", "-o", tmp_path / "p.sfs", *how)
    assert ("1 of 3" in outcome.out, "boxes that lie outside of their images" in outcome.err) == (True, True)
    report = reported("edit anonymise", drives / "recording", "-o", tmp_path / "r.sfs", "--dates", "shift")
    assert "fixes-left-out" in {warning["code"] for warning in report["warnings"]}
    with sceneloom.open(tmp_path / "r.sfs") as scene:
        assert abs(int(min(lidar.frames.timestamps_ns[0] for lidar in scene.lidars))) < 1_000_000_000


def test_edit_undistort_and_camera_model_write_other_camera_models_and_keep_a_limit(
    refuses, reported, succeeds, tmp_path
):
    distorted = tmp_path / "distorted"
    drive = small_drive(Camera("brown_conrady", 96, 64, 60.0, 60.0, 47.5, 31.5, (-0.2, 0.03)), frames=2)
    sceneloom.write(drive.scene, distorted, images="png")
    how = ("--size", "48x32", "--keep", "all", "--camera", "camera0")
    outcome = succeeds("edit undistort", distorted, "-o", tmp_path / "d.sfs", *how)
    assert f"wrote {tmp_path / 'd.sfs'}, " in outcome.out
    with sceneloom.open(tmp_path / "d.sfs") as scene:
        camera = scene.cameras[0].camera
        assert (camera.model, camera.width, camera.height) == ("pinhole", 48, 32)
        assert scene.metadata["sceneloom"]["undistorted"][0]["camera"]["coefficients"][0] == -0.2
    report = reported("edit camera-model", distorted, "-o", tmp_path / "drive", "--model", "fisheye")
    warnings = {warning["code"]: warning["message"] for warning in report["warnings"]}
    assert "brown_conrady camera model reported as fisheye, off by up to" in warnings["camera-model-fitted"]
    with sceneloom.open(tmp_path / "drive") as scene:
        assert scene.cameras[0].camera.model == "fisheye"
    limit = ("--model", "pinhole", "--limit", "0.5")
    refuses(1, "expected at most 0.5 px", "edit camera-model", distorted, "-o", tmp_path / "e.sfs", *limit)
    assert not (tmp_path / "e.sfs").exists()
