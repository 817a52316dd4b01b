"""Merged scenes: all that is in them, by ids that are free, in one world, on one clock."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.editing import crop_scene, merge_scenes, to_ego, to_world
from sceneloom.errors import DataError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    EventAnnotation,
    GnssSensor,
    ImuSensor,
    LabeledPoints,
    LabeledPointsAnnotation,
    LazyFrames,
    LinkAnnotation,
    LocalizationAdjustment,
    PointPath,
    PointsAnnotation,
    PointsFrame,
    PointsSensor,
    Poses,
    Scene,
    ShapeAnnotation,
    ShapeType,
    VectorSamples,
    VertexPath,
)


def only(scene, *ids, **changes):
    """A scene with some of its sensors."""
    return replace(scene, sensors=tuple(scene.sensor(identifier) for identifier in ids), **changes)


def test_sensors_of_both_stand_in_the_merged_scene_and_the_same_odometry_once(drive):
    scene = drive.scene()
    merged = merge_scenes([only(scene, "lidar", "ego"), only(scene, "camera", "radar", "ego")])
    assert [sensor.id for sensor in merged.sensors] == ["lidar", "ego", "camera", "radar"]
    assert list(merged.trajectories) == ["ego"]
    assert [(warning.code, warning.location) for warning in merged.warnings] == [("same-sensor", "sensors[ego]")]


def test_ids_that_are_taken_are_refused_or_changed_with_all_references(drive, box):
    first = only(drive.scene(annotations=[box("a", [0], [[0.0, 0, 0]])]), "camera")
    second = replace(
        box("a", [0], [[1.0, 0, 0]]),
        activations=(Activation("camera", drive.timestamps_ns),),
        attributes=(AttributePath("wet", ("no",), sensor_id="camera"),),
    )
    others = (
        Box2DAnnotation("b", "camera", BoxPath(drive.timestamps_ns[:1], np.ones((1, 4))), parent_id="a"),
        LinkAnnotation("c", "a", "b"),
        CameraCalibration("d", "camera", time_offset_ns=1),
    )
    other = only(drive.scene(annotations=(second, *others)), "camera", "lidar")
    lidar = replace(other.sensor("lidar"), parent_id="camera")
    other = replace(other, sensors=(other.sensor("camera"), lidar))
    with pytest.raises(OptionError, match=r"sensors\['camera'\]: scene has this id, too; `--rename`"):
        merge_scenes([first, other])
    merged = merge_scenes([first, other], rename=True)
    assert [sensor.id for sensor in merged.sensors] == ["camera", "camera-2", "lidar"]
    assert merged.sensor("lidar").parent_id == "camera-2"
    found = {annotation.id: annotation for annotation in merged.annotations}
    assert list(found) == ["a", "a-2", "b", "c", "d"]
    assert found["a-2"].path.values[0, 3] == 1.0
    assert found["a-2"].activations[0].sensor_id == "camera-2"
    assert found["a-2"].attributes[0].sensor_id == "camera-2"
    assert (found["b"].sensor_id, found["b"].parent_id) == ("camera-2", "a-2")
    assert (found["c"].from_id, found["c"].to_id) == ("a-2", "b")
    assert found["d"].sensor_id == "camera-2"


def test_numbers_and_texts_are_two_ids(drive):
    camera = drive.scene().sensor("camera")
    one, text = (replace(drive.scene(), sensors=(replace(camera, id=identifier),)) for identifier in (1, "1"))
    assert [sensor.id for sensor in merge_scenes([one, text]).sensors] == [1, "1"]
    assert [sensor.id for sensor in merge_scenes([one, one], rename=True).sensors] == [1, 2]


WORLDS = [
    RigidTransform.from_quaternion(np.array([100.0, -50.0, 3.0]), np.array([0.0, 0, 0, 1])),
    RigidTransform.from_quaternion(np.array([90.0, 20.0, 1.0]), np.array([0.0, 0, np.sin(0.4), np.cos(0.4)])),
]
"""`world_from_file` of two scenes."""


def seen_from(world_from_file, drive, box):
    """A scene whose locations were computed by formula in the frame of a file."""
    file_from_world = world_from_file.inverse()
    positions = file_from_world.apply(drive.points_world(1)).astype(np.float32)
    corner = file_from_world.apply(np.array([[1.0, 2.0, 3.0]]))
    rotated = box("box", [0], corner, 30.0 - np.degrees(2 * np.arcsin(world_from_file.quaternion_xyzw[2])))
    trajectory = drive.path()
    poses = [
        file_from_world @ RigidTransform.from_quaternion(p, q)
        for p, q in zip(trajectory.positions, trajectory.quaternions_xyzw, strict=True)
    ]
    path = Poses(
        trajectory.timestamps_ns,
        np.array([pose.translation for pose in poses]),
        np.array([pose.quaternion_xyzw for pose in poses]),
    )
    scene = only(drive.scene(PointsFrame.WORLD), "camera")
    camera = replace(scene.sensor("camera"), poses=path, mount=None)
    chart = PointsSensor("map", positions)
    shape = ShapeAnnotation("shape", ShapeType.POINT, VertexPath(np.zeros(1, np.int64), (corner,)))
    return replace(
        scene,
        sensors=(camera, chart),
        annotations=(rotated, shape),
        metadata={"sceneloom": {"world_from_file": world_from_file.matrix.tolist()}},
        trajectories={},
    )


def test_scenes_of_two_origins_are_brought_into_the_world_of_the_first(drive, box):
    first, second = (seen_from(world, drive, box) for world in WORLDS)
    merged = merge_scenes([first, second], rename=True)
    np.testing.assert_allclose(
        merged.sensor("camera-2").poses.positions, merged.sensor("camera").poses.positions, atol=1e-9
    )
    boxes = {annotation.id: annotation for annotation in merged.annotations}
    np.testing.assert_allclose(boxes["box-2"].path.values, boxes["box"].path.values, atol=1e-9)
    np.testing.assert_allclose(boxes["shape-2"].path.vertices[0], boxes["shape"].path.vertices[0], atol=1e-9)
    # float32 was rounded at up to 130 m from either origin
    np.testing.assert_allclose(merged.sensor("map-2").positions, merged.sensor("map").positions, atol=3e-5)
    assert merged.metadata["sceneloom"]["world_from_file"] == WORLDS[0].matrix.tolist()


def test_a_scene_that_says_nothing_of_its_world_is_taken_to_be_in_the_one_others_came_from(drive, box):
    moved, plain = (seen_from(world, drive, box) for world in (WORLDS[0], RigidTransform.identity()))
    plain = replace(plain, metadata={})
    merged = merge_scenes([moved, plain], rename=True)
    np.testing.assert_allclose(
        merged.sensor("camera-2").poses.positions, merged.sensor("camera").poses.positions, atol=1e-9
    )
    assert "worlds-related" in [warning.code for warning in merged.warnings]


def test_angles_are_stated_as_the_first_scene_says_them(drive, box):
    rows = np.array([[4.0, 2, 1, 0, 0, 0, 0.3, -0.4, 2.0]])
    other = box("b", [0], [[0.0, 0, 0]])
    other = replace(other, path=replace(other.path, values=rows))
    radians = drive.scene(annotations=[other])
    radians = replace(only(radians, "radar"), metadata={"sceneloom": {"euler_unit": "radians", "euler_order": "zyx"}})
    first = only(drive.scene(annotations=[box("a", [0], [[0.0, 0, 0]])]), "lidar")
    found = merge_scenes([first, radians]).annotations[1].path.values[0, 6:]
    expected = Rotation.from_euler("ZYX", [2.0, -0.4, 0.3])
    away = Rotation.from_euler("XYZ", found, degrees=True).inv() * expected
    assert away.magnitude() < 1e-12


def with_cameras(drive, *ids):
    """A scene of cameras and a lidar whose points name them."""
    scene = drive.scene(PointsFrame.WORLD)
    frame = scene.sensor("lidar").frames[0]
    index = np.resize(np.array([0, 1, 255], np.uint8), len(frame.points))
    lidar = replace(
        scene.sensor("lidar"),
        id="lidar of " + ids[0],
        frames=LazyFrames.of([replace(frame, points=replace(frame.points, camera_index=index))], [0]),
    )
    cameras = tuple(replace(scene.sensor("camera"), id=identifier) for identifier in ids)
    metadata = {"sceneloom": {"fusion": {"cameras": list(ids)}}}
    return replace(scene, sensors=(lidar, *cameras), metadata=metadata)


def test_points_name_the_cameras_by_their_locations_among_all(drive):
    merged = merge_scenes([with_cameras(drive, "a", "b"), with_cameras(drive, "c", "d")])
    assert [camera.id for camera in merged.cameras] == ["a", "b", "c", "d"]
    seen = [merged.sensor(f"lidar of {name}").frames[0].points.camera_index[:3].tolist() for name in "ac"]
    assert seen == [[0, 1, 255], [2, 3, 255]]
    assert merged.metadata["sceneloom"]["fusion"]["cameras"] == ["a", "b", "c", "d"]
    again = pickle.loads(pickle.dumps(merged.sensor("lidar of c")))
    assert again.frames[0].points.camera_index[0] == 2


def whole_drive(drive, box):
    """A drive with one thing of everything, whose parts are to be joined."""
    times = drive.timestamps_ns
    labelled = LabeledPointsAnnotation(
        "labels", tuple(LabeledPoints("lidar", np.arange(5, dtype=np.uint32), k) for k in range(5))
    )
    body = PointsAnnotation("body", (PointPath(times, np.arange(15.0).reshape(5, 3)),))
    shape = ShapeAnnotation("lane", ShapeType.POLYLINE, VertexPath(times, (np.ones((2, 3)),) * 5))
    event = EventAnnotation("rotation", int(times[0]), int(times[4]))
    drawn = Box2DAnnotation("drawn", "camera", BoxPath(times, np.arange(20.0).reshape(5, 4)))
    attribute = AttributePath("speed", tuple(range(5)), times)
    car = replace(
        box("car", times, np.arange(15.0).reshape(5, 3)),
        activations=(Activation("lidar", times, durations_ns=(1, 2, 3, 4, 5)),),
        attributes=(attribute,),
    )
    repair = LocalizationAdjustment("repair", drive.path(hz=10))
    scene = drive.scene(annotations=[car, labelled, body, shape, event, drawn, repair])
    imu = ImuSensor("imu", {"gyroscope": VectorSamples(times, np.arange(15.0).reshape(5, 3))})
    gnss = GnssSensor("gnss", times, np.arange(15.0).reshape(5, 3) * 1e-6, np.ones(5), np.ones(5))
    return replace(to_world(scene), sensors=(*to_world(scene).sensors, imu, gnss), attributes=(attribute,))


def test_parts_of_a_drive_are_joined_to_what_they_were(drive, box):
    scene = whole_drive(drive, box)
    parts = [crop_scene(scene, stop=0.2), crop_scene(scene, start=0.2)]
    for order in (parts, parts[::-1]):
        joined = merge_scenes(order, join=True)
        for sensor_id in ("lidar", "radar"):
            before, after = scene.sensor(sensor_id), joined.sensor(sensor_id)
            assert after.frames.timestamps_ns.tolist() == before.frames.timestamps_ns.tolist()
            for a, b in zip(before.frames, after.frames, strict=True):
                assert a.timestamp_ns == b.timestamp_ns
                np.testing.assert_array_equal(a.points.positions, b.points.positions)
        camera = joined.sensor("camera")
        assert [image.timestamp_ns for image in camera.images] == (drive.timestamps_ns + 20_000_000).tolist()
        np.testing.assert_array_equal(camera.poses.positions, scene.sensor("camera").poses.positions)
        np.testing.assert_array_equal(joined.sensor("ego").poses.positions, scene.sensor("ego").poses.positions)
        np.testing.assert_array_equal(joined.trajectories["ego"].positions, scene.trajectories["ego"].positions)
        np.testing.assert_array_equal(
            joined.sensor("imu").streams["gyroscope"].values, scene.sensor("imu").streams["gyroscope"].values
        )
        np.testing.assert_array_equal(joined.sensor("gnss").positions_lla, scene.sensor("gnss").positions_lla)
        assert len(pickle.loads(pickle.dumps(joined.sensor("lidar"))).frames[3].points) == 40


def test_annotations_of_the_parts_are_joined_to_what_they_were(drive, box):
    scene = whole_drive(drive, box)
    parts = [crop_scene(scene, stop=0.2), crop_scene(scene, start=0.2)]
    for order in (parts, parts[::-1]):
        found = {a.id: a for a in merge_scenes(order, join=True).annotations}
        assert set(found) == {a.id for a in scene.annotations}
        for name in ("car", "drawn"):
            before = next(a for a in scene.annotations if a.id == name)
            np.testing.assert_array_equal(found[name].path.values, before.path.values)
        assert found["car"].activations[0].durations_ns == (1, 2, 3, 4, 5)
        labelled = sorted(entry.sensor_frame for entry in found["labels"].labeled_points)
        assert labelled == [0, 1, 2, 3, 4]
        np.testing.assert_array_equal(found["body"].paths[0].values, np.arange(15.0).reshape(5, 3))
        assert len(found["lane"].path.vertices) == 5
        assert (found["rotation"].start_ns, found["rotation"].duration_ns) == (0, 400_000_000)
        np.testing.assert_array_equal(found["repair"].poses.positions, drive.path(hz=10).positions)


def test_frames_that_are_in_both_parts_are_taken_once_if_they_are_equal(drive):
    scene = only(drive.scene(PointsFrame.WORLD), "lidar")
    lidar = scene.sensor("lidar")
    parts = [replace(scene, sensors=(replace(lidar, frames=lidar.frames[a:b]),)) for a, b in ((0, 3), (2, 5))]
    joined = merge_scenes(parts, join=True)
    assert joined.sensor("lidar").frames.timestamps_ns.tolist() == drive.timestamps_ns.tolist()
    assert {warning.code: warning.count for warning in joined.warnings} == {"frames-twice": 1}
    moved = replace(lidar.frames[2], points=replace(lidar.frames[2].points, positions=np.ones((1, 3), np.float32)))
    other = replace(scene, sensors=(replace(lidar, frames=LazyFrames.of([moved], [200_000_000])),))
    with pytest.raises(OptionError, match="two frames at 200000000 ns whose points differ"):
        merge_scenes([parts[0], other], join=True)


def test_what_is_stationary_in_both_parts_of_a_scene_keeps_its_one_keyframe(drive, box):
    stationary = box("b", drive.timestamps_ns[:1], np.ones(3), stationary=True)
    lane = ShapeAnnotation(
        "lane", ShapeType.POLYLINE, VertexPath(drive.timestamps_ns[:1], (np.eye(3),)), stationary=True
    )
    scene = drive.scene(annotations=(stationary, lane))
    joined = merge_scenes([crop_scene(scene, stop=0.2), crop_scene(scene, start=0.2)], join=True)
    assert [a.path.timestamps_ns.tolist() for a in joined.annotations] == [[0], [0]]


def test_what_the_second_part_says_otherwise_is_reported(drive, box):
    weather = [AttributePath("weather", (stated,), static=True) for stated in ("rain", "sun")]
    scenes = [
        replace(
            drive.scene(annotations=(box("b", drive.timestamps_ns, np.ones(3), label=label, stationary=still),)),
            attributes=(attribute,),
            extras={"owner": label},
        )
        for label, still, attribute in (("car", False, weather[0]), ("truck", True, weather[1]))
    ]
    joined = merge_scenes(scenes, join=True)
    assert (joined.annotations[0].label, joined.attributes, joined.extras["owner"]) == ("car", (weather[0],), "car")
    reported = [warning.location for warning in joined.warnings if warning.code == "fields-differ"]
    assert sorted(reported) == ["annotations[b].label", "annotations[b].stationary", "attributes[weather]", "owner"]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda s: replace(s, frames=s.frames[::2]), "lie between those of the first"),
        (lambda s: replace(s, mount=RigidTransform.identity(), frames=s.frames[4:]), "mounted otherwise"),
        (lambda s: replace(s, points_frame=PointsFrame.EGO), "expected one frame"),
        (lambda s: PointsSensor("lidar", np.zeros((1, 3), np.float32)), "expected one kind"),
    ],
)
def test_parts_that_do_not_go_together_are_refused(drive, change, problem):
    scene = only(drive.scene(PointsFrame.WORLD), "lidar")
    lidar = scene.sensor("lidar")
    first = replace(scene, sensors=(replace(lidar, frames=lidar.frames[1::2]),))
    with pytest.raises(OptionError, match=problem):
        merge_scenes([first, replace(scene, sensors=(change(lidar),))], join=True)


def test_what_cannot_be_merged_is_refused(drive, box):
    scene = drive.scene(annotations=[box("a", [0], [[0.0, 0, 0]])])
    with pytest.raises(OptionError, match="expected two or more"):
        merge_scenes([scene])
    with pytest.raises(OptionError, match="bring both into the world first"):
        merge_scenes([scene, to_ego(scene)], rename=True)
    other = only(scene, "ego")
    shifted = replace(other, sensors=(replace(scene.sensor("ego"), poses=drive.path()),))
    with pytest.raises(OptionError, match=r"sensors\['ego'\]: scene has this id, too"):
        merge_scenes([other, shifted])
    bent = replace(scene, metadata={"sceneloom": {"world_from_file": [[1, 2], [3, 4]]}})
    with pytest.raises(DataError, match="expected a rigid 4x4 matrix"):
        merge_scenes([only(scene, "ego", annotations=()), bent])


def test_closing_the_merged_scene_closes_all(drive):
    closed = []
    scenes = [
        replace(only(drive.scene(), name), on_close=lambda name=name: closed.append(name))
        for name in ("lidar", "radar")
    ]
    with merge_scenes(scenes):
        assert closed == []
    assert closed == ["lidar", "radar"]


def test_metadata_of_both_are_kept_and_differences_reported(drive):
    first = only(drive.scene(), "lidar", metadata={"weather": "A", "sceneloom": {"applied": [{"id": 1}], "x": 1}})
    second = only(drive.scene(), "radar", metadata={"weather": "B", "sceneloom": {"applied": [{"id": 2}], "y": 2}})
    merged = merge_scenes([first, second])
    assert merged.metadata == {"weather": "A", "sceneloom": {"applied": [{"id": 1}, {"id": 2}], "x": 1, "y": 2}}
    assert [(n.code, n.location) for n in merged.warnings] == [("metadata-differ", "metadata.weather")]


@pytest.mark.parametrize(
    ("parts", "joined"),
    [
        (((0, 5), (10, None)), (0, 10)),
        (((0, None), (10, None)), (0, 10)),
        (((10, 5), (0, 5)), (0, 15)),
        (((3, None), (3, None)), (3, None)),
    ],
)
def test_an_event_lasts_until_its_last_part_ends_though_that_is_a_moment(parts, joined):
    one, other = (Scene((), (EventAnnotation("rotation", start, lasts),)) for start, lasts in parts)
    (event,) = merge_scenes([one, other], join=True).annotations
    assert (event.start_ns, event.duration_ns) == joined


def fixes(times, lla):
    count = len(times)
    return GnssSensor("gnss", times, np.tile(np.array(lla, np.float64), (count, 1)), np.ones(count), np.ones(count))


def moved_away(scene, metres):
    trajectories = {
        n: replace(trajectory, positions=trajectory.positions + np.array([metres, 0, 0]))
        for n, trajectory in scene.trajectories.items()
    }
    return replace(scene, trajectories=trajectories)


def later(scene, seconds):
    """Another part, `seconds` after the first: of a lidar that its own file has."""
    lidar = scene.sensor("lidar")
    times = lidar.frames.timestamps_ns + int(seconds * 1e9)
    frames = [replace(f, timestamp_ns=int(t)) for f, t in zip(lidar.frames, times, strict=True)]
    return replace(scene, sensors=(replace(lidar, id="other", frames=LazyFrames.of(frames, times)),), trajectories={})


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            lambda s, t: (s | {"metadata": {"city": "Pittsburgh"}}, t | {"metadata": {"city": "Miami"}}),
            "it was in miami",
        ),
        (
            lambda s, t: (
                s | {"metadata": {"nuscenes": {"log": {"location": "boston-seaport"}}}},
                t | {"metadata": {"sceneloom": {"location": "singapore-onenorth"}}},
            ),
            "singapore-onenorth, the other in boston-seaport",
        ),
        (
            lambda s, t: (
                s | {"sensors": (*s["sensors"], fixes(TIMESTAMPS, [48.0, 11.0, 500.0]))},
                t | {"sensors": (*t["sensors"], replace(fixes(TIMESTAMPS, [52.5, 13.4, 30.0]), id="gnss2"))},
            ),
            r"satellite fixes are 5\d\d\.\d km apart",
        ),
    ],
)
def test_scenes_of_two_cities_are_refused_unless_they_are_forced(drive, change, reason):
    scene = drive.scene()
    one = {"sensors": (scene.sensor("lidar"),), "metadata": {}}
    two = {"sensors": (scene.sensor("radar"),), "metadata": {}}
    parts = [replace(scene, **fields) for fields in change(one, two)]
    with pytest.raises(OptionError, match=reason):
        merge_scenes(parts)
    merged = merge_scenes(parts, force=True)
    assert [n.message for n in merged.warnings if n.code == "different-drives"]
    assert {"lidar", "radar"} <= {sensor.id for sensor in merged.sensors}


def test_egos_that_are_far_apart_at_one_time_are_of_two_drives(drive):
    scene = drive.scene()
    lidar, radar = only(scene, "lidar"), only(scene, "radar")
    assert merge_scenes([lidar, moved_away(radar, 20)], rename=True)
    with pytest.raises(OptionError, match="their egos are 5,000 m apart at one time"):
        merge_scenes([lidar, moved_away(radar, 5000)], rename=True)


def test_parts_that_are_days_apart_are_of_two_drives(drive):
    scene = drive.scene()
    assert merge_scenes([only(scene, "radar"), later(scene, 600)])
    with pytest.raises(OptionError, match="10 days are between them"):
        merge_scenes([only(scene, "radar"), later(scene, 864_001)])


def test_poses_of_sensors_stand_in_for_an_ego_that_is_not_known(drive):
    scene = drive.scene()
    lidar = replace(to_world(only(scene, "lidar")), trajectories={})
    sensor = lidar.sensor("lidar")
    away = replace(sensor, id="other", poses=replace(sensor.poses, positions=sensor.poses.positions + 5000.0))
    with pytest.raises(OptionError, match="their egos are 8,660 m apart at one time"):
        merge_scenes([lidar, replace(lidar, sensors=(away,))])


def test_scenes_that_nothing_relates_are_merged_with_a_warning(drive):
    scene = drive.scene()
    first, second = only(scene, "lidar"), only(scene, "radar")
    bare = replace(second, trajectories={}, sensors=tuple(replace(one, poses=None) for one in second.sensors))
    assert "drives-unrelated" not in {n.code for n in merge_scenes([first, second]).warnings}
    assert "drives-unrelated" in {n.code for n in merge_scenes([first, bare]).warnings}


TIMESTAMPS = np.array([0, 10**8], np.int64)
