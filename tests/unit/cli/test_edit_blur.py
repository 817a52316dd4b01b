"""`sceneloom edit blur` and `relative`: from a drive to one that can be shown."""

import json

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.editing.redact import ImageBox
from sceneloom.pipeline.redacting import blur_files
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Three images each: a recording with a video, and a scene file with JPEGs."""
    folder = tmp_path_factory.mktemp("drives")
    camera = CameraSpec(Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5))
    drive = simulate_street(1, frames=3, lidar=LidarSpec(beams=4, steps=60), cameras=(camera,))
    sceneloom.write(drive.scene, folder / "recording")
    sceneloom.write(drive.scene, folder / "scene.sfs")
    (folder / "boxes.csv").write_text("number,x1,y1,x2,y2\n1,20,10,60,50\n2,200,10,260,50\n")
    return folder


@pytest.mark.parametrize(
    ("source", "target"), [("recording", "out.sfs"), ("scene.sfs", "out.sfs"), ("scene.sfs", "out/")]
)
def test_boxes_are_hidden_in_the_written_drive_and_the_rest_is_not(call, drives, tmp_path, source, target):
    outcome = call(
        "edit", "blur", drives / source, "-o", f"{tmp_path}/{target}",
        "--boxes", drives / "boxes.csv", "--fill", "black", "--margin", "0", "--json",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    (reported,) = json.loads(outcome.out)["cameras"]
    assert (reported["boxes"], reported["hidden"], reported["images"], reported["outside"]) == (2, 1, 1, 1)
    with sceneloom.open(drives / source) as before, sceneloom.open(tmp_path / target) as after:
        old, new = before.cameras[0].images, after.cameras[0].images
        assert new[1].rgb[12:48, 22:58].max() < 40  # black, but for what a lossy codec brings in at the edges
        assert np.array_equal(new.timestamps_ns, old.timestamps_ns)
        assert np.abs(new[0].rgb.astype(int) - old[0].rgb).mean() < 8
        assert np.abs(new[1].rgb[:, 64:].astype(int) - old[1].rgb[:, 64:]).mean() < 8


def test_a_video_is_encoded_again_and_the_loss_report_says_so(call, drives, tmp_path):
    outcome = call(
        "edit",
        "blur",
        drives / "recording",
        "-o",
        tmp_path / "o.sfs",
        "--boxes",
        drives / "boxes.csv",
        "--json",
    )
    reported = json.loads(outcome.out)
    assert reported["cameras"][0]["encoded"] == 3
    (loss,) = [one for one in reported["losses"]["losses"] if "encoded again" in one["what"]]
    assert (loss["field"], loss["support"], loss["count"]) == ("sensors[camera0].video", "approximated", 3)


def blurred(folder, size, **how):
    camera = CameraSpec(Camera("pinhole", *size, 60.0, 60.0, 47.5, 31.5))
    drive = simulate_street(1, frames=2, lidar=LidarSpec(beams=4, steps=60), cameras=(camera,))
    sceneloom.write(drive.scene, folder / "in", **how)
    box = ImageBox((20.0, 10.0, 60.0, 50.0), number=1)
    report = blur_files(folder / "in", folder / "out", boxes=[box], fill="black", margin=0.0)
    with sceneloom.open(folder / "in") as before, sceneloom.open(folder / "out") as after:
        old, new = before.cameras[0], after.cameras[0]
        assert np.array_equal(new.images.timestamps_ns, old.images.timestamps_ns)
        return report, [image.rgb for image in old.images], [image.rgb for image in new.images]


def test_a_lossless_video_stays_so_but_for_what_is_hidden(tmp_path):
    report, old, new = blurred(tmp_path, (96, 64), images="ffv1")
    assert not [loss for loss in report.edit.losses if "encoded again" in loss.what]
    old[1][10:50, 20:60] = 0
    assert np.array_equal(new, old)


def test_images_of_a_video_whose_codec_cannot_hold_their_size_go_one_by_one(tmp_path):
    report, old, new = blurred(tmp_path, (95, 63), images="ffv1")
    assert (report.cameras[0].encoded, new[1][12:48, 22:58].max()) == (2, 0)
    assert np.array_equal(new[0], old[0])


def test_it_is_reported_in_words_too_and_without_boxes_nothing_is_written(call, drives, tmp_path):
    outcome = call(
        "edit", "blur", drives / "recording", "-o", tmp_path / "o.sfs", "--boxes", drives / "boxes.csv"
    )
    assert outcome.code == 0
    assert "1 of 3" in outcome.out
    assert "boxes that lie outside of their images" in outcome.err
    nothing = call("edit", "blur", drives / "recording", "-o", tmp_path / "n.sfs")
    assert (nothing.code, "expected boxes" in nothing.err) == (2, True)
    label = call("edit", "blur", drives / "recording", "-o", tmp_path / "n.sfs", "--label", "face")
    assert (label.code, "no box or outline in an image with label 'face'" in label.err) == (2, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["o.sfs"]


def test_images_that_are_not_touched_are_copied_without_what_they_state(call, drives, tmp_path):
    call(
        "edit", "blur", drives / "scene.sfs", "-o", tmp_path / "o.sfs", "--boxes", drives / "boxes.csv", "-q"
    )
    with sceneloom.open(drives / "scene.sfs") as before, sceneloom.open(tmp_path / "o.sfs") as after:
        old, new = before.cameras[0].images, after.cameras[0].images
        assert new[0].encoded is None or new[0].encoded() == old[0].encoded()
        assert np.array_equal(new[0].rgb, old[0].rgb)


def test_edit_relative_writes_a_drive_that_begins_at_zero(call, drives, tmp_path):
    outcome = call(
        "edit", "anonymise", drives / "recording", "-o", tmp_path / "r.sfs", "--dates", "shift", "--json"
    )
    assert outcome.code == 0, outcome.err
    codes = {warning["code"] for warning in json.loads(outcome.out)["warnings"]}
    assert "fixes-left-out" in codes
    with sceneloom.open(tmp_path / "r.sfs") as scene:
        trajectory = next(iter(scene.trajectories.values()))
        first = min(sensor.frames.timestamps_ns[0] for sensor in scene.lidars)
        assert abs(int(first)) < 1_000_000_000
        start = int(np.argmin(np.abs(trajectory.timestamps_ns)))
        assert (
            np.linalg.norm(trajectory.positions[start]) < 1.0
        )  # where a pose is, a tenth of a second after the first
