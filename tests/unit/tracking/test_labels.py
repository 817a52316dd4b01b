"""Annotations made from tracks: paths, flags, riders, evidence."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import sceneloom
from sceneloom import scene as sc
from sceneloom.errors import OptionError
from sceneloom.scene import Scene, Support, Tracks
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_at
from sceneloom.simulate import CameraSpec, LidarSpec, RadarSpec, TrafficSpec, simulate_street
from sceneloom.tracking import labels
from sceneloom.tracking.settings import LabelSettings

FOLLOWED = ("car", "pedestrian", "cyclist")


def made(number=1, label="car", *, count=21, period_ns=100_000_000, speed=8.0, **changes):
    """A car of 4.2 m that drives straight along x, seen by both detectors; any column can be replaced."""
    times = 1_000_000_000 + period_ns * np.arange(count, dtype=np.int64)
    along = speed * (times - times[0]) * 1e-9
    columns = {
        "timestamps_ns": times, "centers": np.column_stack([along, np.zeros(count), np.full(count, 0.8)]),
        "sizes_lwh": np.tile([4.2, 1.8, 1.6], (count, 1)), "velocities": np.tile([speed, 0.0, 0.0], (count, 1)),
        "yaws": np.zeros(count), "yaw_rates": np.zeros(count), "scores": np.full(count, 0.9),
        "covariances": np.tile(0.01 * np.eye(10), (count, 1, 1)), "supports": np.full(count, Support.BOTH, np.uint8),
    }  # fmt: skip
    return sc.Track(number, label, **{**columns, **changes})


def followed(drive, timestamps_ns):
    """What a perfect tracker would state of a simulated drive."""
    truth, found = drive.truth.boxes(timestamps_ns), []
    for i, (instance, label) in enumerate(zip(truth.instances.tolist(), truth.labels, strict=True)):
        rows = np.flatnonzero(truth.present[:, i])
        if len(rows) > 1 and label in FOLLOWED:
            columns = {
                "timestamps_ns": truth.timestamps_ns[rows],
                "centers": truth.centers_world[rows, i],
                "sizes_lwh": np.tile(truth.sizes_lwh[i], (len(rows), 1)),
                **{name: getattr(truth, name)[rows, i] for name in ("yaws", "velocities", "yaw_rates")},
            }
            found.append(made(instance, label, count=len(rows), **columns))
    return Tracks(tuple(found))


DEGREES = CuboidAngles()


def wandering(seed, count=16):
    """A track that wanders and rotates."""
    random = np.random.default_rng(seed)
    centers = np.cumsum(random.normal(0.0, 0.08, (count, 3)), axis=0) + np.arange(count)[:, None] * [0.8, 0, 0]
    steps = np.cumsum(random.integers(50_000_000, 150_000_000, count))
    yaws = np.cumsum(random.normal(0.0, 0.03, count)) + 3.0
    return made(count=count, timestamps_ns=steps, centers=centers, yaws=yaws)


def deviations(path, first, last, keyframes):
    """How far the scene's own readers, asked for states, are from them: most of locations [m], of headings [deg]."""
    part = sc.CuboidPath(path.timestamps_ns[keyframes], path.cuboids(keyframes, DEGREES).values)
    values, there = cuboid_at(sc.CuboidAnnotation("a", part), path.timestamps_ns[first : last + 1])
    assert there.all()
    boxes = path.boxes[first : last + 1]
    rotations = (values[:, 8] - np.degrees(boxes[:, 6]) + 180.0) % 360.0 - 180.0
    return np.linalg.norm(values[:, 3:6] - boxes[:, :3], axis=1).max(), np.abs(rotations).max()


def least_count(path, settings):
    """The fewest keyframes, by trying every way from the first state to the last."""
    last = len(path.timestamps_ns) - 1

    def reports(a, b):
        away, rotated = deviations(path, a, b, np.array([a, b]))
        return away <= settings.tolerance_m and rotated <= settings.tolerance_deg

    @cache
    def fewest(a):
        return 0 if a == last else 1 + min(fewest(b) for b in range(a + 1, last + 1) if reports(a, b))

    return 1 + fewest(0)


@pytest.mark.parametrize("seed", range(6))
def test_no_fewer_keyframes_would_do(seed):
    settings = LabelSettings(tolerance_m=0.1, tolerance_deg=2.0, stationary=False)
    path = labels.label_path(wandering(seed), settings)
    rows = path.keyframes(settings)
    assert len(rows) == least_count(path, settings)
    assert 2 < len(rows) < len(path.timestamps_ns)


def test_states_are_reported_within_the_tolerances_by_few_keyframes_and_sizes_are_what_most_of_the_weight_says():
    for tolerance_m, tolerance_deg in [(0.02, 5.0), (0.3, 0.5), (0.0, 0.0)]:
        settings = LabelSettings(tolerance_m=tolerance_m, tolerance_deg=tolerance_deg)
        path = labels.label_path(wandering(9, count=60), settings)
        away, rotated = deviations(path, 0, 59, path.keyframes(settings))
        assert away <= tolerance_m + 1e-9  # centimetres of metres: sums of few roundings
        assert rotated <= tolerance_deg + 1e-6
    times = np.concatenate([np.arange(10), np.arange(40, 50)]) * 100_000_000
    track = made(count=20, timestamps_ns=times, centers=np.column_stack([times * 8e-9, np.zeros(20), np.zeros(20)]))
    assert labels.label_path(track, LabelSettings()).keyframes(LabelSettings()).tolist() == [0, 19]
    yaws = (np.linspace(2.6, 3.8, 21) + np.pi) % (2 * np.pi) - np.pi
    path = labels.label_path(made(yaws=yaws), LabelSettings())
    assert path.boxes[:, 6] == pytest.approx(np.linspace(2.6, 3.8, 21), abs=1e-12)
    assert path.keyframes(LabelSettings()).tolist() == [0, 20]
    sizes = np.tile([4.2, 1.8, 1.6], (21, 1))
    sizes[:15, 0] = 3.0
    covariances = np.tile(0.01 * np.eye(10), (21, 1, 1))
    covariances[:15] *= 4.0  # half the states weigh 15 / 4 against 6
    path = labels.label_path(made(sizes_lwh=sizes, covariances=covariances), LabelSettings())
    assert (path.boxes[:, 3] == 4.2).all()
    free = labels.label_path(made(sizes_lwh=sizes), LabelSettings(constant_sizes=False))
    assert (free.boxes[:, 3] == sizes[:, 0]).all()
    random = np.random.default_rng(1)
    values, weights = random.normal(size=(9, 3)), random.integers(1, 5, (9, 3)).astype(float)
    for column, median in enumerate(labels.weighted_medians(values, weights)):
        repeated = np.sort(np.repeat(values[:, column], weights[:, column].astype(int)))
        assert median == repeated[(len(repeated) - 1) // 2]


def test_what_stands_gets_one_pose_and_heading_and_what_creeps_does_not():
    random = np.random.default_rng(0)
    noise = np.column_stack([random.normal(0.0, 0.1, (21, 2)), np.zeros(21)])
    stationary = labels.label_path(made(speed=0.0, centers=noise + np.array([5.0, 2.0, 0.8])), LabelSettings())
    assert stationary.stands
    assert stationary.keyframes(LabelSettings()).tolist() == [0]
    # the median of 21 numbers of deviation 0.1 deviates by 0.027
    assert stationary.boxes[0, :3] == pytest.approx([5.0, 2.0, 0.8], abs=0.1)
    assert not labels.label_path(made(speed=0.5), LabelSettings()).stands
    assert not labels.label_path(made(speed=0.0), LabelSettings(stationary=False)).stands
    unsure = np.tile(np.diag([0.01] * 7 + [0.2] * 3), (4, 1, 1))
    assert labels.label_path(made(count=4, speed=0.4, covariances=unsure), LabelSettings()).stands
    assert not labels.label_path(made(count=4, speed=0.4), LabelSettings()).stands
    assert not labels.label_path(made(count=4, speed=1.0, covariances=100.0 * unsure), LabelSettings()).stands
    along = np.concatenate([np.zeros(15), np.linspace(0.0, 1.5, 6)])  # stationary at first, then walking
    walking = made(label="pedestrian", centers=np.column_stack([along, np.zeros((21, 2))]))
    assert not labels.label_path(walking, LabelSettings()).stands
    yaws = np.full(21, 0.4)
    yaws[[2, 7, 8]] += np.pi
    assert labels.usual_heading(yaws, np.ones(21)) == pytest.approx(0.4, abs=1e-12)
    assert np.cos(labels.usual_heading(yaws + np.pi, np.ones(21)) - 0.4) == pytest.approx(-1.0, abs=1e-12)


def kinds(track):
    return {found.kind for found in labels.flags_of(track)}


def changed(column, rows, values):
    """A track of which some rows of a column are changed."""
    whole = np.array(getattr(made(), column))
    whole[rows] = values
    return made(**{column: whole})


ZIGZAG = np.column_stack([0.8 * np.arange(21), 0.3 * (-1.0) ** np.arange(21), np.full(21, 0.8)])


def test_each_flaw_is_flagged_where_it_is_and_a_good_track_has_no_flag():
    assert not labels.flags_of(made())
    assert not labels.flags_of(made(label="pedestrian", speed=0.0))
    yaws = (np.linspace(2.9, 3.5, 21) + np.pi) % (2 * np.pi) - np.pi
    velocities = 8.0 * np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros(21)])
    assert not labels.flags_of(made(yaws=yaws, velocities=velocities, centers=np.cumsum(velocities * 0.1, axis=0)))
    for changes, kind, row in [
        ({"count": 4}, labels.FlagKind.SHORT, 0),
        ({"scores": np.full(21, 0.3)}, labels.FlagKind.UNSURE, 0),
        (("supports", slice(3, 18), Support.INTERPOLATED), labels.FlagKind.SPARSE, 10),
        ({"supports": np.full(21, Support.IMAGE, np.uint8)}, labels.FlagKind.IMAGE_ONLY, 0),
        ({"centers": ZIGZAG}, labels.FlagKind.JITTER, 1),
        (("centers", (slice(12, None), 1), 3.0), labels.FlagKind.JUMP, 12),
        (("sizes_lwh", (5, 0), 6.0), labels.FlagKind.SIZE, 5),
        (("yaws", slice(9, 10), np.pi), labels.FlagKind.YAW_FLIP, 9),
        ({"yaws": np.radians(15.0) * (-1.0) ** np.arange(21)}, labels.FlagKind.YAW_JITTER, 1),
        ({"yaws": np.full(21, np.pi)}, labels.FlagKind.AGAINST_MOTION, 0),
    ]:
        track = made(**changes) if isinstance(changes, dict) else changed(*changes)
        (found,) = [one for one in labels.flags_of(track) if one.kind is kind]
        assert found.timestamp_ns == track.timestamps_ns[row]
        assert found.urgency > 1.0
    assert labels.FlagKind.JITTER not in kinds(changed("centers", (slice(12, None), 1), 3.0))
    assert labels.FlagKind.YAW_JITTER not in kinds(changed("yaws", slice(9, 10), np.pi))


def test_of_two_objects_in_one_location_the_less_sure_is_flagged_and_states_without_boxes_at_the_ends_go():
    supports = np.full(21, Support.PREDICTED, np.uint8)
    assert labels.boxed_part(made(supports=supports)) is None
    supports[[4, 9]] = Support.IMAGE, Support.SWEEP
    part = labels.boxed_part(made(supports=supports, corners_xyxy={"camera": np.ones((21, 4))}))
    assert part.timestamps_ns.tolist() == made().timestamps_ns[4:10].tolist()
    assert part.corners_xyxy["camera"].shape == (6, 4)
    sure, unsure = made(1), made(2, scores=np.full(21, 0.6))
    apart = made(3, centers=made().centers + np.array([0.0, 4.0, 0.0]))
    above = made(4, centers=made().centers + np.array([0.0, 0.0, 5.0]), scores=np.full(21, 0.5))
    (found,) = labels.overlap_flags([sure, unsure, apart, above])
    assert (found.track, found.kind) == (2, labels.FlagKind.OVERLAP)
    assert not labels.overlap_flags([sure, unsure], {frozenset((1, 2))})
    later = made(2, timestamps_ns=made().timestamps_ns + 10_000_000_000)
    assert not labels.overlap_flags([made(1), later])
    assert not labels.overlap_flags([])


def beside(number, label, left):
    return made(number, label, centers=made().centers + np.array([0.1, left, 0.0]))


FRAMES = 10
TOLERANCES = LabelSettings(tolerance_m=0.04, tolerance_deg=0.8)


@pytest.fixture(scope="module")
def drive():
    cameras = (CameraSpec(sceneloom.cameras.Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5)),)
    lidar, sensors = LidarSpec(beams=32, steps=600), {"cameras": cameras, "radars": (RadarSpec(),)}
    return simulate_street(3, frames=FRAMES, lidar=lidar, **sensors, traffic=TrafficSpec())


@pytest.fixture(scope="module")
def tracks(drive):
    return followed(drive, drive.truth.lidar.timestamps_ns + 50_000_000)


def label(drive, *tracks, **settings):
    """What becomes of tracks without anything of the drive's sensors but what settings say."""
    off = {"projections": False, "points": False, "radar": False} | settings
    return labels.label_tracks(replace(drive.scene, annotations=()), Tracks(tracks), settings=LabelSettings(**off))


@pytest.fixture(scope="module")
def labelled(drive, tracks):
    return labels.label_tracks(replace(drive.scene, annotations=()), tracks, settings=TOLERANCES)


def cuboids_of(scene):
    return {each.id: each for each in scene.annotations if isinstance(each, sc.CuboidAnnotation)}


def reported(cuboid, name):
    return next(path for path in cuboid.attributes if path.name == name)


def test_true_tracks_become_cuboids_within_the_tolerances_and_what_stands_is_found(labelled, tracks):
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
    stationary = {each.id for each in cuboids_of(labelled.scene).values() if each.stationary}
    trajectories = {track.id: np.linalg.norm(np.ptp(track.centers, axis=0)) for track in tracks}
    assert {f"cuboid-{number}" for number, trajectory in trajectories.items() if trajectory < 1e-9} <= stationary
    # in nine tenths of a second, by the speed that counts as stationary
    assert not {f"cuboid-{number}" for number, trajectory in trajectories.items() if trajectory > 0.25} & stationary
    assert labelled.stationary == len(stationary) > 5


def test_points_in_labels_are_those_of_the_truth_and_sensors_report_when_they_see_a_cuboid(labelled, drive):
    cuboids, compared = cuboids_of(labelled.scene), 0
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


def test_radars_measure_how_fast_what_drives_goes_away_and_contradict_another_speed(labelled, drive, tracks):
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
    assert labels.FlagKind.RADAR not in {found.kind for found in labelled.flags}
    fast = [track for track in tracks if np.linalg.norm(track.velocities[0]) > 5.0]
    heard = max(fast, key=lambda track: len(radial_speeds(labelled, track)[0]))
    wrong = replace(heard, velocities=-heard.velocities)
    found = label(drive, wrong, radar=True)
    assert labels.FlagKind.RADAR in {one.kind for one in found.flags}
    # returns of unknown velocity report none, and spoil no other
    own, middle = labels._Heard(), len(heard.timestamps_ns) // 2
    time_ns, center = int(heard.timestamps_ns[middle]), heard.centers[middle]
    returns = np.hstack([np.tile(center, (3, 1)), np.tile([1.0, 0.0, 0.0, 4.0], (3, 1))])
    returns[0, 6] = np.nan
    labels._listen(own, heard, time_ns, returns)
    assert (own.counts, own.speeds) == ([3], [4.0])


def test_a_label_says_how_sure_it_is_and_whence_it_comes_with_its_boxes_in_images_and_the_worst_flags_first(drive):
    scores, supports = np.linspace(0.5, 1.0, 21), np.full(21, Support.BOTH, np.uint8)
    supports[8:10] = Support.PREDICTED
    track = made(7, scores=scores, supports=supports)
    scene = labels.label_tracks(Scene(()), Tracks((track,)), settings=LabelSettings(source="made by hand")).scene
    cuboid = cuboids_of(scene)["cuboid-7"]
    existence = reported(cuboid, "existence")
    rows = np.searchsorted(existence.timestamps_ns, track.timestamps_ns, side="right") - 1
    assert np.abs(np.array(existence.values)[rows] - scores).max() <= 0.05 + 1e-3
    assert len(existence.values) < 21
    support = reported(cuboid, "support")
    assert support.values == ("both", "predicted", "both")
    assert support.timestamps_ns.tolist() == track.timestamps_ns[[0, 8, 10]].tolist()
    assert (reported(cuboid, "source").values, reported(cuboid, "track").values) == (("made by hand",), (7,))
    images, corners = drive.scene.cameras[0].images.timestamps_ns, np.full((FRAMES, 4), np.nan)
    corners[[0, 1, 2, 8, 9]] = np.array([10.0, 20.0, 50.0, 60.004])
    shown = {"camera0": corners, "other": corners}
    track = made(5, count=FRAMES, timestamps_ns=images + 7_000_000, corners_xyxy=shown)
    scene = label(drive, track).scene
    (thing,) = [each for each in scene.annotations if isinstance(each, sc.ObjectAnnotation)]
    boxes = [each for each in scene.annotations if isinstance(each, sc.Box2DAnnotation)]
    assert [box.path.timestamps_ns.tolist() for box in boxes] == [images[[0, 1, 2]].tolist(), images[[8, 9]].tolist()]
    assert boxes[0].path.values[0].tolist() == [10.0, 20.0, 40.0, 40.0]
    assert {each.parent_id for each in (*boxes, *cuboids_of(scene).values())} == {thing.id}
    short, empty = made(1, count=3), made(2, centers=made().centers + np.array([0.0, 0.0, 300.0]))
    found = label(drive, short, empty, points=True)
    review = found.scene.metadata["sceneloom"]["labels"]["review"]
    assert [one["urgency"] for one in review] == sorted((one["urgency"] for one in review), reverse=True)
    assert ("cuboid-2", "empty boxes") in {(one["annotation"], one["flag"]) for one in review}
    cuboids = cuboids_of(found.scene)
    assert "short" in reported(cuboids["cuboid-1"], "review").values[0]
    assert reported(cuboids["cuboid-2"], "review").values == (("empty boxes",),)


def test_persons_ride_the_nearest_thing_that_they_stay_with_and_are_linked_what_is_hardly_there_is_left_out(drive):
    for tracks, pairs in [
        # the nearest thing that a person stays with
        ([beside(1, "Pedestrian", 0.0), beside(2, "bicycle", 0.5), beside(3, "bicycle", 0.1)], [(1, 3)]),
        # each rides one thing and is ridden by one
        ([beside(1, "rider", 0.0), beside(2, "person", 0.3), beside(3, "motorcycle", 0.1)], [(1, 3)]),
        ([made(1, "pedestrian", centers=np.zeros((21, 3))), beside(2, "bicycle", 0.0)], []),  # who walks past
        ([made(1, "pedestrian", timestamps_ns=made().timestamps_ns + 7), beside(2, "bicycle", 0.0)], []),
        ([beside(1, "pedestrian", 0.0), beside(2, "car", 0.0)], []),  # cars are not ridden
    ]:
        assert [(person.id, bike.id) for person, bike in labels.riders(tracks)] == pairs
    found = labels.label_tracks(Scene(()), Tracks((made(1, "rider"), made(2, "bicycle"))))
    (link,) = [each for each in found.scene.annotations if isinstance(each, sc.LinkAnnotation)]
    assert (link.from_id, link.to_id, link.label) == ("cuboid-1", "cuboid-2", "rides")
    assert not found.flags
    tracks = Tracks((made(1, count=2), made(2, scores=np.full(21, 0.2)), made(3)))
    settings = LabelSettings(least_states=3, least_score=0.3)
    assert list(cuboids_of(labels.label_tracks(Scene(()), tracks, settings=settings).scene)) == ["cuboid-3"]
    assert labels.label_tracks(Scene(()), Tracks(())).objects == 0
    lost = replace(drive.scene, annotations=(), trajectories={})
    sensors = tuple(replace(s, poses=None) if hasattr(s, "poses") else s for s in lost.sensors)
    found = labels.label_tracks(replace(lost, sensors=sensors), Tracks((made(),)))
    codes = {warning.code for warning in found.scene.warnings}
    assert {"labels-not-projected", "labels-not-counted", "labels-not-heard"} <= codes
    assert len(cuboids_of(found.scene)) == 1


def test_ids_that_are_taken_and_numbers_out_of_bounds_are_refused(labelled, tracks):
    with pytest.raises(OptionError, match="used twice"):
        labels.label_tracks(
            labelled.scene, tracks, settings=LabelSettings(projections=False, points=False, radar=False)
        )
    for wrong in ({"tolerance_m": -0.1}, {"least_score": 1.5}, {"tolerance_deg": float("nan")}):
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
