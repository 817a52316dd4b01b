"""Tests of labels: a simulated drive with its true tracks, and scenes that lack this or that."""

from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.errors import OptionError
from sceneloom.scene import (
    Box2DAnnotation,
    CuboidAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
    Scene,
    Support,
    Tracks,
)
from sceneloom.scene.annotations_at import cuboid_at
from sceneloom.simulate import CameraSpec, LidarSpec, RadarSpec, TrafficSpec, simulate_street
from sceneloom.tracking.labels import FlagKind, label_tracks
from sceneloom.tracking.settings import LabelSettings

FRAMES = 10
TOLERANCES = LabelSettings(tolerance_m=0.04, tolerance_deg=0.8)


@pytest.fixture(scope="module")
def drive():
    return simulate_street(
        3,
        frames=FRAMES,
        lidar=LidarSpec(beams=32, steps=600),
        cameras=(CameraSpec(sceneloom.cameras.Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5)),),
        radars=(RadarSpec(),),
        traffic=TrafficSpec(),
    )


@pytest.fixture(scope="module")
def tracks(true_tracks, drive):
    return true_tracks(drive, drive.truth.lidar.timestamps_ns + 50_000_000)


@pytest.fixture(scope="module")
def labelled(drive, tracks):
    return label_tracks(replace(drive.scene, annotations=()), tracks, settings=TOLERANCES)


def cuboids_of(scene):
    return {each.id: each for each in scene.annotations if isinstance(each, CuboidAnnotation)}


def reported(cuboid, name):
    return next(path for path in cuboid.attributes if path.name == name)


def test_true_tracks_become_cuboids_that_stay_within_the_tolerances(labelled, tracks):
    cuboids = cuboids_of(labelled.scene)
    assert len(cuboids) == len(tracks) == labelled.objects
    for track in tracks:
        cuboid = cuboids[f"cuboid-{track.id}"]
        values, there = cuboid_at(cuboid, track.timestamps_ns)
        assert there.all()
        # what stands is one pose: people who stand in the street do not move at all
        assert np.linalg.norm(values[:, 3:6] - track.centers, axis=1).max() <= TOLERANCES.tolerance_m + 1e-9
        assert values[:, :3] == pytest.approx(track.sizes_lwh, abs=1e-12)
        rotated = (values[:, 8] - np.degrees(track.yaws) + 180.0) % 360.0 - 180.0
        assert np.abs(rotated).max() <= TOLERANCES.tolerance_deg + 1e-6
    assert labelled.keyframes < labelled.states / 3


def test_what_stands_in_the_street_is_found(labelled, tracks):
    stationary = {each.id for each in cuboids_of(labelled.scene).values() if each.stationary}
    trajectories = {track.id: np.linalg.norm(np.ptp(track.centers, axis=0)) for track in tracks}
    assert {
        f"cuboid-{number}" for number, trajectory in trajectories.items() if trajectory < 1e-9
    } <= stationary
    # in nine tenths of a second, by the speed that counts as stationary
    assert (
        not {f"cuboid-{number}" for number, trajectory in trajectories.items() if trajectory > 0.25}
        & stationary
    )
    assert labelled.stationary == len(stationary) > 5


def test_points_in_labels_are_those_of_the_truth(labelled, drive):
    cuboids = cuboids_of(labelled.scene)
    compared = 0
    for frame in (2, 5):
        sweep = drive.truth.sweep(frame)
        for instance, count in zip(*np.unique(sweep.instances, return_counts=True), strict=True):
            cuboid = cuboids.get(f"cuboid-{instance}")
            if cuboid is None or not cuboid.stationary:
                continue
            points = reported(cuboid, "points")
            row = points.timestamps_ns.tolist().index(sweep.frame.timestamp_ns)
            # range noise of centimetres puts points of a face just outside of it, and some of the ground into it
            assert points.values[row] <= 1.1 * count + 3
            compared += points.values[row] > 0
    assert compared > 3


def test_cameras_and_lidars_report_when_they_see_a_cuboid(labelled):
    seen = [each for each in cuboids_of(labelled.scene).values() if each.projections]
    assert len(seen) > 5
    for each in seen:
        assert "camera0" in {activation.sensor_id for activation in each.activations}
        assert np.isfinite(each.projections[0].boxes).any()


def radial_speeds(labelled, track):
    """What the radar says of a track: times [ns] and speeds [m/s]; none where it never met it."""
    for path in cuboids_of(labelled.scene)[f"cuboid-{track.id}"].attributes:
        if path.name == "radial_velocity":
            return path.timestamps_ns, np.array(path.values)
    return np.zeros(0, np.int64), np.zeros(0)


def test_radars_measure_how_fast_what_drives_goes_away(labelled, drive, tracks):
    radar, compared = drive.truth.radars["radar0"], 0
    for track in tracks:
        times, speeds = radial_speeds(labelled, track)
        if len(times) < 5 or np.linalg.norm(track.velocities[0]) < 3.0:
            continue
        rows = np.abs(track.timestamps_ns[:, None] - times).argmin(axis=0)
        poses = [radar.pose(k).translation for k in np.searchsorted(radar.timestamps_ns, times)]
        lines = track.centers[rows] - np.array(poses)
        lines /= np.linalg.norm(lines, axis=1)[:, None]
        expected = (lines * track.velocities[rows]).sum(axis=1)
        # 0.08 m/s of the radar, lines to other parts than the middle, speeds that change within 50 ms
        assert abs(np.median(speeds - expected)) < 0.5
        compared += 1
    assert compared > 2
    assert FlagKind.RADAR not in {found.kind for found in labelled.flags}


def test_a_radar_contradicts_a_track_of_another_speed(labelled, drive, tracks):
    fast = [track for track in tracks if np.linalg.norm(track.velocities[0]) > 5.0]
    heard = max(fast, key=lambda track: len(radial_speeds(labelled, track)[0]))
    wrong = replace(heard, velocities=-heard.velocities)
    settings = LabelSettings(projections=False, points=False)
    found = label_tracks(replace(drive.scene, annotations=()), Tracks((wrong,)), settings=settings)
    assert FlagKind.RADAR in {one.kind for one in found.flags}


def test_a_label_says_how_sure_it_is_and_whence_it_comes(a_track):
    scores = np.linspace(0.5, 1.0, 21)
    supports = np.full(21, Support.BOTH, np.uint8)
    supports[8:10] = Support.PREDICTED
    track = a_track(7, scores=scores, supports=supports)
    scene = label_tracks(Scene(()), Tracks((track,)), settings=LabelSettings(source="made by hand")).scene
    cuboid = cuboids_of(scene)["cuboid-7"]
    existence = reported(cuboid, "existence")
    rows = np.searchsorted(existence.timestamps_ns, track.timestamps_ns, side="right") - 1
    assert np.abs(np.array(existence.values)[rows] - scores).max() <= 0.05 + 1e-3
    assert len(existence.values) < 21
    support = reported(cuboid, "support")
    assert support.values == ("both", "predicted", "both")
    assert support.timestamps_ns.tolist() == track.timestamps_ns[[0, 8, 10]].tolist()
    assert reported(cuboid, "source").values == ("made by hand",)
    assert reported(cuboid, "track").values == (7,)


def test_boxes_in_images_and_cuboid_belong_to_one_object(a_track, drive):
    images = drive.scene.cameras[0].images.timestamps_ns
    corners = np.full((FRAMES, 4), np.nan)
    corners[[0, 1, 2, 8, 9]] = np.array([10.0, 20.0, 50.0, 60.004])
    track = a_track(
        5,
        count=FRAMES,
        timestamps_ns=images + 7_000_000,
        corners_xyxy={"camera0": corners, "other": corners},
    )
    settings = LabelSettings(projections=False, points=False, radar=False)
    scene = label_tracks(replace(drive.scene, annotations=()), Tracks((track,)), settings=settings).scene
    (thing,) = [each for each in scene.annotations if isinstance(each, ObjectAnnotation)]
    boxes = [each for each in scene.annotations if isinstance(each, Box2DAnnotation)]
    assert [box.path.timestamps_ns.tolist() for box in boxes] == [
        images[[0, 1, 2]].tolist(),
        images[[8, 9]].tolist(),
    ]
    assert boxes[0].path.values[0].tolist() == [10.0, 20.0, 40.0, 40.0]
    assert {each.parent_id for each in (*boxes, *cuboids_of(scene).values())} == {thing.id}


def test_riders_are_linked_with_what_they_ride_and_do_not_count_as_overlapping(a_track):
    found = label_tracks(Scene(()), Tracks((a_track(1, "rider"), a_track(2, "bicycle"))))
    (link,) = [each for each in found.scene.annotations if isinstance(each, LinkAnnotation)]
    assert (link.from_id, link.to_id, link.label) == ("cuboid-1", "cuboid-2", "rides")
    assert not found.flags


def test_flags_are_reported_in_the_label_and_the_worst_first_in_the_metadata(a_track, drive):
    short, empty = a_track(1, count=3), a_track(2, centers=a_track().centers + np.array([0.0, 0.0, 300.0]))
    settings = LabelSettings(projections=False, radar=False)
    found = label_tracks(replace(drive.scene, annotations=()), Tracks((short, empty)), settings=settings)
    review = found.scene.metadata["sceneloom"]["labels"]["review"]
    assert [one["urgency"] for one in review] == sorted((one["urgency"] for one in review), reverse=True)
    assert ("cuboid-2", "empty boxes") in {(one["annotation"], one["flag"]) for one in review}
    cuboids = cuboids_of(found.scene)
    assert "short" in reported(cuboids["cuboid-1"], "review").values[0]
    assert reported(cuboids["cuboid-2"], "review").values == (("empty boxes",),)


def test_what_is_hardly_there_is_left_out_on_request(a_track):
    tracks = Tracks((a_track(1, count=2), a_track(2, scores=np.full(21, 0.2)), a_track(3)))
    settings = LabelSettings(least_states=3, least_score=0.3)
    assert list(cuboids_of(label_tracks(Scene(()), tracks, settings=settings).scene)) == ["cuboid-3"]
    assert label_tracks(Scene(()), Tracks(())).objects == 0


def test_a_scene_without_a_trajectory_keeps_the_labels_and_says_what_is_missing(a_track, drive):
    lost = replace(drive.scene, annotations=(), trajectories={})
    sensors = tuple(replace(s, poses=None) if hasattr(s, "poses") else s for s in lost.sensors)
    found = label_tracks(replace(lost, sensors=sensors), Tracks((a_track(),)))
    assert {"labels-not-projected", "labels-not-counted", "labels-not-heard"} <= {
        warning.code for warning in found.scene.warnings
    }
    assert len(cuboids_of(found.scene)) == 1


def test_annotations_stay_and_ids_that_are_taken_are_refused(labelled, tracks):
    with pytest.raises(OptionError, match="used twice"):
        label_tracks(
            labelled.scene, tracks, settings=LabelSettings(projections=False, points=False, radar=False)
        )


@pytest.mark.parametrize(
    "wrong", [{"tolerance_m": -0.1}, {"least_score": 1.5}, {"tolerance_deg": float("nan")}]
)
def test_numbers_out_of_bounds_are_refused(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong))):
        LabelSettings(**wrong)


@pytest.mark.parametrize("profile", ["sfs", "scale"])
@pytest.mark.few(1)
def test_labels_pass_validation(labelled, tmp_path, profile):
    sceneloom.write(labelled.scene, tmp_path / "labels.sfs", profile=profile)
    report = sceneloom.validate(tmp_path / "labels.sfs", profile=profile)
    assert [str(finding.severity) for finding in report.findings].count("error") == 0
    if profile == "sfs":
        with sceneloom.open(tmp_path / "labels.sfs") as read:
            assert len(read.annotations) == len(labelled.scene.annotations)
