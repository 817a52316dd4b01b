"""Scenes cropped in time and space, and scenes merged: by ids that are free, in one world, on one clock."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.unit.editing.conftest import box

from sceneloom import scene as sc
from sceneloom.editing import crop_scene, merge_scenes, to_ego, to_world
from sceneloom.errors import DataError, OptionError
from sceneloom.formats import open_scene, write_scene
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.scene import time_span
from sceneloom.simulate import LidarSpec, simulate_street

BOX = (-10.0, -15.0, -20.0, 25.0, 12.0, 20.0)
REACH = 22.0


def inside_box(points):
    return ((points >= BOX[:3]) & (points <= BOX[3:])).all(axis=1)


@pytest.mark.parametrize("given", list(sc.PointsFrame))
@pytest.mark.parametrize("frame", list(sc.PointsFrame))
def test_points_in_a_box_of_any_frame_stay(drive, given, frame):
    cropped = crop_scene(drive.scene(given), box=BOX, frame=frame)
    for sensor_id in ("lidar", "radar"):
        before = drive.scene(given).sensor(sensor_id)
        for k, found in enumerate(cropped.sensor(sensor_id).frames):
            inside = inside_box(drive.frame_from_world(k, frame).apply(drive.points_world(k)))
            assert 0 < inside.sum() < len(inside)
            np.testing.assert_array_equal(found.points.positions, before.frames[k].points.positions[inside])
    assert cropped.metadata["sceneloom"]["cropped"] == {"box": list(BOX), "frame": frame.value}


def test_points_within_range_stay_and_a_map_where_any_sensor_comes_by(drive):
    for frame in (sc.PointsFrame.SENSOR, sc.PointsFrame.EGO):
        cropped = crop_scene(drive.scene(sc.PointsFrame.WORLD), reach=REACH, frame=frame)
        for k, found in enumerate(cropped.sensor("lidar").frames):
            away = np.linalg.norm(drive.frame_from_world(k, frame).apply(drive.points_world(k)), axis=1)
            expected = drive.points_world(k)[away <= REACH].astype(np.float32)
            np.testing.assert_array_equal(found.points.positions, expected)
    locations = np.array([[20.0, 0, 0], [20, 5, 0], [-20, 0, 0], [np.nan, 0, 0]], np.float32)
    scene = drive.scene(sc.PointsFrame.WORLD)
    scene = replace(scene, sensors=(*scene.sensors, sc.PointsSensor("map", locations)))
    inside = crop_scene(scene, box=(0, -1, -1, 30, 9, 1)).sensor("map").positions
    np.testing.assert_array_equal(inside, locations[:2])
    # the ego goes from (20, 0) to (19.6, 4): the second location is 1.1 m from where it ends
    near = crop_scene(scene, reach=1.5, frame="ego").sensor("map").positions
    np.testing.assert_array_equal(near, locations[:2])


def test_labelled_points_are_counted_anew_also_in_a_part_in_time(drive):
    inside = np.flatnonzero(inside_box(drive.points_world(2)))
    ids = np.array([inside[3], inside[0], np.setdiff1d(np.arange(40), inside)[0]], np.uint32)
    label = sc.LabeledPointsAnnotation("a", (sc.LabeledPoints("lidar", ids, 2),))
    cropped = crop_scene(drive.scene(sc.PointsFrame.WORLD, [label]), box=BOX)
    assert cropped.annotations[0].labeled_points[0].point_ids.tolist() == [3, 0]
    assert {warning.code for warning in cropped.warnings} == {"labelled-points"}
    # frames are counted from the part's own start
    label = sc.LabeledPointsAnnotation("a", (sc.LabeledPoints("lidar", np.arange(40, dtype=np.uint32), 3),))
    cropped = crop_scene(drive.scene(sc.PointsFrame.WORLD, [label]), start=0.3, box=BOX)
    entry = cropped.annotations[0].labeled_points[0]
    assert entry.sensor_frame == 3 - (drive.frames - len(cropped.sensor("lidar").frames))
    kept = cropped.sensor("lidar").frames[entry.sensor_frame].points.positions
    assert len(entry.point_ids) == len(kept) == inside_box(drive.points_world(3)).sum()
    # a cropped scene can go to another process
    cropped = crop_scene(drive.scene(), box=BOX, frame="ego").sensor("radar")
    again = pickle.loads(pickle.dumps(cropped))
    np.testing.assert_array_equal(again.frames[1].points.positions, cropped.frames[1].points.positions)


def test_cuboids_stay_while_their_centre_is_inside(drive):
    times = drive.timestamps_ns
    passing = box("passing", times, [[-25.0, 0, 0], [-12, 0, 0], [0, 0, 0], [30, 0, 0], [40, 0, 0]])
    passing = replace(
        passing, activations=(sc.Activation("lidar", times, durations_ns=(1, 2, 3, 4, 5)),), stationary=False
    )
    seldom = box("between", [0, 400_000_000], [[-50.0, 0, 0], [50, 0, 0]])
    outside = box("outside", times[:2], [[0.0, 50, 0], [0, 50, 0]])
    parked = box("parked", [7], [[1.0, 1, 1]], stationary=True)
    cropped = crop_scene(drive.scene(annotations=[passing, seldom, outside, parked]), box=BOX)
    found = {annotation.id: annotation for annotation in cropped.annotations}
    # inside at the third keyframe, and between it and its neighbours, which stay for that
    assert found["passing"].path.timestamps_ns.tolist() == times[1:4].tolist()
    assert found["passing"].activations[0].durations_ns == (2, 3, 4)
    # inside at a frame's time, at no keyframe
    assert found["between"].path.timestamps_ns.tolist() == [0, 400_000_000]
    assert set(found) == {"passing", "between", "parked"}
    assert [(n.code, n.count) for n in cropped.warnings] == [("annotations-left-out", 1)]
    # those on the ego are cropped in the world, and the other way round
    front = box("front", drive.timestamps_ns, np.tile([20.0, 0.5, 0], (5, 1)))
    for annotation, frame in ((front, "world"), (front, "ego")):
        on_ego = to_ego(drive.scene(annotations=[annotation]))
        near = crop_scene(on_ego, box=(19, 0, -1, 21, 1, 1), frame=frame)
        assert len(near.annotations) == (frame == "world")
        far = crop_scene(drive.scene(annotations=[annotation]), box=(-5, -5, -2, 5, 5, 2), frame=frame)
        assert len(far.annotations) == (frame == "ego")


def test_shapes_and_named_points_stay_whole_when_any_vertex_is_inside(drive):
    first, square = drive.timestamps_ns[:1], np.array([[24.0, 0, 0], [30, 0, 0], [30, 6, 0]])
    near, far = sc.PointPath(first, np.zeros((1, 3))), sc.PointPath(first, np.array([[99.0, 0, 0]]))
    shapes = [
        sc.ShapeAnnotation("touching", sc.ShapeType.POLYGON, sc.VertexPath(first, (square,))),
        sc.ShapeAnnotation("away", sc.ShapeType.POLYLINE, sc.VertexPath(first, (square + 9.0,))),
        sc.ShapeAnnotation("drawn", sc.ShapeType.POLYGON_2D, sc.VertexPath(first, (square[:, :2] + 99.0,)), "camera"),
        sc.PointsAnnotation("body", (far, near)),
        sc.PointsAnnotation("far body", (far,)),
    ]
    cropped = crop_scene(drive.scene(annotations=shapes), box=BOX)
    assert [annotation.id for annotation in cropped.annotations] == ["touching", "drawn", "body"]
    assert len(cropped.annotations[0].path.vertices[0]) == 3
    assert len(cropped.annotations[2].paths) == 2


def test_sensors_go_with_all_that_is_stated_for_them_and_labels_stay_with_parents_and_links(drive):
    seen = replace(
        box("seen", [0], [[0.0, 0, 0]]),
        activations=(sc.Activation("radar", drive.timestamps_ns), sc.Activation("lidar", drive.timestamps_ns)),
        attributes=(sc.AttributePath("wet", ("yes",), sensor_id="camera"), sc.AttributePath("new", ("yes",))),
    )
    drawn = sc.Box2DAnnotation("drawn", "camera", sc.BoxPath(drive.timestamps_ns[:1], np.ones((1, 4))))
    owner = sc.ObjectAnnotation("owner", parent_id="drawn")
    link = sc.LinkAnnotation("link", "seen", "drawn")
    cropped = crop_scene(drive.scene(annotations=[seen, drawn, owner, link]), without=["camera", "radar"])
    assert [sensor.id for sensor in cropped.sensors] == ["lidar", "ego"]
    assert [(a.id, a.parent_id) for a in cropped.annotations] == [("seen", None), ("owner", None)]
    assert [entry.sensor_id for entry in cropped.annotations[0].activations] == ["lidar"]
    assert [attribute.name for attribute in cropped.annotations[0].attributes] == ["new"]
    counts = {"annotations": 1, "links": 1, "parents": 1, "sensors": 2}
    expected = {"colours-kept": 1, **{f"{name}-left-out": count for name, count in counts.items()}}
    assert {warning.code: warning.count for warning in cropped.warnings} == expected
    annotations = [
        sc.GroupAnnotation("fleet"),
        replace(box("car", [0], [[0.0, 0, 0]]), label="car", parent_id="fleet"),
        replace(box("van", [0], [[0.0, 0, 0]]), label="van", parent_id="fleet"),
        replace(box("cab", [0], [[0.0, 0, 0]]), label="car"),
        sc.LinkAnnotation("same", "car", "cab"),
        sc.LinkAnnotation("other", "car", "van"),
        sc.LocalizationAdjustment("repair", sc.Poses.identity()),
    ]
    cropped = crop_scene(drive.scene(annotations=annotations), labels=["car"])
    assert [annotation.id for annotation in cropped.annotations] == ["fleet", "car", "cab", "same", "repair"]


def test_points_name_the_cameras_by_their_new_locations(drive):
    scene = with_cameras(drive, "camera", "left", "right")
    for without, stays, index in (("left", "right", [0, 255, 1, 255]), ("right", "left", [0, 1, 255, 255])):
        cropped = crop_scene(scene, without=[without])
        assert cropped.lidars[0].frames[0].points.camera_index[:4].tolist() == index
        assert cropped.metadata["sceneloom"]["fusion"]["cameras"] == ["camera", stays]


def test_what_cannot_be_followed_is_refused(drive):
    for stated, problem in (
        ({"box": (0, 0, 0, -1, 1, 1)}, "each minimum at most"),
        ({"box": (0, 0, 0)}, "expected xmin"),
        ({"reach": -1.0}, "range -1.0"),
        ({"frame": "moon", "reach": 1.0}, "frame 'moon'"),
        ({"without": ["nose"]}, "no sensor 'nose'"),
        ({"labels": ["unicorn"]}, "no annotation has the label 'unicorn'"),
        ({"sensors": ["lidar"], "without": ["lidar"]}, "no sensor is left"),
        ({}, "nothing to crop by; expected one of a time"),
    ):
        with pytest.raises(OptionError, match=problem):
            crop_scene(drive.scene(), **stated)
    # the ego cannot go from under what rides on it
    with pytest.raises(OptionError, match="to-world"):
        crop_scene(to_ego(drive.scene()), without=["ego"])


@pytest.mark.parametrize(
    ("cut", "counts"),
    [
        ({"without": ("imu",)}, {"at home": 3, "on the road": 2, "a phone": 1}),
        # the line without a time stood behind the last one, and goes with it
        ({"stop": 1.12}, {"at home": 0, "on the road": 2, "a phone": 0}),
        # a line of which nothing says what it is of stays
        ({"without": ("gnss",)}, {"gps": 0, "at home": 1, "latitude": 0}),
    ],
)
def test_lines_of_a_recording_that_no_scene_has_a_location_for_are_cut_with_it(tmp_path, cut, counts):
    folder = tmp_path / "drive"
    write_scene(simulate_street(1, frames=3, lidar=LidarSpec(beams=4, steps=30), cameras=()).scene, folder)

    def fix(latitude, note):
        return {"latitude": latitude, "longitude": 25.0, "altitude": 1.0, "note": note}

    lines = [
        {"madeBy": "a phone"},
        {"location": "on the road", "time": 1.02},
        {"location": "at home", "time": 1.19},
        {"gps": fix(60.0, "on the road"), "time": 1.03},
        {"gps": fix(61.0, "at home"), "time": 1.18},
        {"sensor": {"type": "gyroscope", "values": [1.0, 1.0, 1.0]}, "gps": fix(62.0, "at home"), "time": 1.185},
    ]
    with (folder / "data.jsonl").open("a") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)
    with open_scene(folder) as scene:
        if "stop" in cut:
            cut = {"stop": cut["stop"] - time_span(scene)[0] / 1e9}
        cropped = crop_scene(scene, **cut)
        kept = str(cropped.metadata["recording"])
        write_scene(cropped, tmp_path / "out")
    text = (tmp_path / "out" / "data.jsonl").read_text()
    assert {word: text.count(word) for word in counts} == counts
    assert not [word for word, count in counts.items() if count == 0 and word in kept and word != "gps"]


def only(scene, *ids, **changes):
    return replace(scene, sensors=tuple(scene.sensor(identifier) for identifier in ids), **changes)


def test_sensors_of_both_stand_in_the_merged_scene_and_cameras_are_counted_among_all(drive):
    scene = drive.scene()
    merged = merge_scenes([only(scene, "lidar", "ego"), only(scene, "camera", "radar", "ego")])
    assert [sensor.id for sensor in merged.sensors] == ["lidar", "ego", "camera", "radar"]
    assert list(merged.trajectories) == ["ego"]
    assert [(warning.code, warning.location) for warning in merged.warnings] == [("same-sensor", "sensors[ego]")]
    # points name the cameras by their locations among all
    merged = merge_scenes([with_cameras(drive, "a", "b"), with_cameras(drive, "c", "d")])
    assert [camera.id for camera in merged.cameras] == ["a", "b", "c", "d"]
    seen = [merged.sensor(f"lidar of {name}").frames[0].points.camera_index[:3].tolist() for name in "ac"]
    assert seen == [[0, 1, 255], [2, 3, 255]]
    assert merged.metadata["sceneloom"]["fusion"]["cameras"] == ["a", "b", "c", "d"]
    again = pickle.loads(pickle.dumps(merged.sensor("lidar of c")))
    assert again.frames[0].points.camera_index[0] == 2


def test_ids_that_are_taken_are_refused_or_changed_with_all_references(drive):
    first = only(drive.scene(annotations=[box("a", [0], [[0.0, 0, 0]])]), "camera")
    second = replace(
        box("a", [0], [[1.0, 0, 0]]),
        activations=(sc.Activation("camera", drive.timestamps_ns),),
        attributes=(sc.AttributePath("wet", ("no",), sensor_id="camera"),),
    )
    others = (
        sc.Box2DAnnotation("b", "camera", sc.BoxPath(drive.timestamps_ns[:1], np.ones((1, 4))), parent_id="a"),
        sc.LinkAnnotation("c", "a", "b"),
        sc.CameraCalibration("d", "camera", time_offset_ns=1),
    )
    other = only(drive.scene(annotations=(second, *others)), "camera", "lidar")
    other = replace(other, sensors=(other.sensor("camera"), replace(other.sensor("lidar"), parent_id="camera")))
    with pytest.raises(OptionError, match=r"sensors\['camera'\]: scene has this id, too; `--rename`"):
        merge_scenes([first, other])
    merged = merge_scenes([first, other], rename=True)
    assert [sensor.id for sensor in merged.sensors] == ["camera", "camera-2", "lidar"]
    assert merged.sensor("lidar").parent_id == "camera-2"
    found = {annotation.id: annotation for annotation in merged.annotations}
    assert list(found) == ["a", "a-2", "b", "c", "d"]
    car, drawn, link = found["a-2"], found["b"], found["c"]
    assert car.path.values[0, 3] == 1.0
    assert {e.sensor_id for e in (*car.activations, *car.attributes, drawn, found["d"])} == {"camera-2"}
    assert (drawn.parent_id, link.from_id, link.to_id) == ("a-2", "a-2", "b")
    # numbers and texts are two ids
    one, text = (replace(first, sensors=(replace(first.sensors[0], id=k),), annotations=()) for k in (1, "1"))
    assert [sensor.id for sensor in merge_scenes([one, text]).sensors] == [1, "1"]
    assert [sensor.id for sensor in merge_scenes([one, one], rename=True).sensors] == [1, 2]


WORLDS = [
    RigidTransform.from_quaternion(np.array([100.0, -50.0, 3.0]), np.array([0.0, 0, 0, 1])),
    RigidTransform.from_quaternion(np.array([90.0, 20.0, 1.0]), np.array([0.0, 0, np.sin(0.4), np.cos(0.4)])),
]
"""`world_from_file` of two scenes."""


def seen_from(world_from_file, drive):
    """A scene whose locations were computed by formula in the frame of a file."""
    file_from_world = world_from_file.inverse()
    corner = file_from_world.apply(np.array([[1.0, 2.0, 3.0]]))
    rotated = box("box", [0], corner, 30.0 - np.degrees(2 * np.arcsin(world_from_file.quaternion_xyzw[2])))
    shape = sc.ShapeAnnotation("shape", sc.ShapeType.POINT, sc.VertexPath(np.zeros(1, np.int64), (corner,)))
    path = drive.path()
    poses = zip(path.positions, path.quaternions_xyzw, strict=True)
    poses = [file_from_world @ RigidTransform.from_quaternion(p, q) for p, q in poses]
    positions, quaternions = [p.translation for p in poses], [p.quaternion_xyzw for p in poses]
    scene = drive.scene(sc.PointsFrame.WORLD)
    poses = sc.Poses(path.timestamps_ns, np.array(positions), np.array(quaternions))
    camera = replace(scene.sensor("camera"), poses=poses, mount=None)
    return replace(
        scene,
        sensors=(camera, sc.PointsSensor("map", file_from_world.apply(drive.points_world(1)).astype(np.float32))),
        annotations=(rotated, shape),
        metadata={"sceneloom": {"world_from_file": world_from_file.matrix.tolist()}},
        trajectories={},
    )


def test_scenes_of_two_origins_are_brought_into_the_world_of_the_first(drive):
    first, second = (seen_from(world, drive) for world in WORLDS)
    merged = merge_scenes([first, second], rename=True)
    cameras = [merged.sensor(name).poses.positions for name in ("camera", "camera-2")]
    np.testing.assert_allclose(*cameras, atol=1e-9)
    boxes = {annotation.id: annotation for annotation in merged.annotations}
    np.testing.assert_allclose(boxes["box-2"].path.values, boxes["box"].path.values, atol=1e-9)
    np.testing.assert_allclose(boxes["shape-2"].path.vertices[0], boxes["shape"].path.vertices[0], atol=1e-9)
    # float32 was rounded at up to 130 m from either origin
    np.testing.assert_allclose(merged.sensor("map-2").positions, merged.sensor("map").positions, atol=3e-5)
    assert merged.metadata["sceneloom"]["world_from_file"] == WORLDS[0].matrix.tolist()
    # a scene that says nothing of its world is taken to be in the one that others came from
    plain = replace(seen_from(RigidTransform.identity(), drive), metadata={})
    merged = merge_scenes([first, plain], rename=True)
    cameras = [merged.sensor(name).poses.positions for name in ("camera", "camera-2")]
    np.testing.assert_allclose(*cameras, atol=1e-9)
    assert "worlds-related" in [warning.code for warning in merged.warnings]


def test_angles_are_stated_as_the_first_scene_says_them(drive):
    other = box("b", [0], [[0.0, 0, 0]])
    other = replace(other, path=replace(other.path, values=np.array([[4.0, 2, 1, 0, 0, 0, 0.3, -0.4, 2.0]])))
    ours = {"sceneloom": {"euler_unit": "radians", "euler_order": "zyx"}}
    radians = only(drive.scene(annotations=[other]), "radar", metadata=ours)
    first = only(drive.scene(annotations=[box("a", [0], [[0.0, 0, 0]])]), "lidar")
    found = merge_scenes([first, radians]).annotations[1].path.values[0, 6:]
    expected = Rotation.from_euler("ZYX", [2.0, -0.4, 0.3])
    assert (Rotation.from_euler("XYZ", found, degrees=True).inv() * expected).magnitude() < 1e-12


def with_cameras(drive, *ids):
    scene = drive.scene(sc.PointsFrame.WORLD)
    frame = scene.sensor("lidar").frames[0]
    index = np.resize(np.array([*range(len(ids)), 255], np.uint8), len(frame.points))
    frames = sc.LazyFrames.of([replace(frame, points=replace(frame.points, camera_index=index))], [0])
    lidar = replace(scene.sensor("lidar"), id="lidar of " + ids[0], frames=frames)
    cameras = tuple(replace(scene.sensor("camera"), id=identifier) for identifier in ids)
    return replace(scene, sensors=(lidar, *cameras), metadata={"sceneloom": {"fusion": {"cameras": list(ids)}}})


def whole_drive(drive):
    """A drive with one thing of everything, whose parts are to be joined."""
    times, threes = drive.timestamps_ns, np.arange(15.0).reshape(5, 3)
    attribute = sc.AttributePath("speed", tuple(range(5)), times)
    entries = tuple(sc.LabeledPoints("lidar", np.arange(5, dtype=np.uint32), k) for k in range(5))
    annotations = [
        replace(
            box("car", times, threes),
            activations=(sc.Activation("lidar", times, durations_ns=(1, 2, 3, 4, 5)),),
            attributes=(attribute,),
        ),
        sc.LabeledPointsAnnotation("labels", entries),
        sc.PointsAnnotation("body", (sc.PointPath(times, threes),)),
        sc.ShapeAnnotation("lane", sc.ShapeType.POLYLINE, sc.VertexPath(times, (np.ones((2, 3)),) * 5)),
        sc.EventAnnotation("rotation", int(times[0]), int(times[4])),
        sc.Box2DAnnotation("drawn", "camera", sc.BoxPath(times, np.arange(20.0).reshape(5, 4))),
        sc.LocalizationAdjustment("repair", drive.path(hz=10)),
    ]
    scene = to_world(drive.scene(annotations=annotations))
    imu = sc.ImuSensor("imu", {"gyroscope": sc.VectorSamples(times, threes)})
    gnss = sc.GnssSensor("gnss", times, threes * 1e-6, np.ones(5), np.ones(5))
    return replace(scene, sensors=(*scene.sensors, imu, gnss), attributes=(attribute,))


@pytest.mark.parametrize("order", [1, -1])
def test_parts_of_a_drive_are_joined_to_what_they_were(drive, order):
    scene = whole_drive(drive)
    joined = merge_scenes([crop_scene(scene, stop=0.2), crop_scene(scene, start=0.2)][::order], join=True)
    for sensor_id in ("lidar", "radar"):
        before, after = scene.sensor(sensor_id), joined.sensor(sensor_id)
        assert after.frames.timestamps_ns.tolist() == before.frames.timestamps_ns.tolist()
        for a, b in zip(before.frames, after.frames, strict=True):
            assert a.timestamp_ns == b.timestamp_ns
            np.testing.assert_array_equal(a.points.positions, b.points.positions)
    images = joined.sensor("camera").images
    assert [image.timestamp_ns for image in images] == (drive.timestamps_ns + 20_000_000).tolist()
    for values in (
        lambda s: s.sensor("camera").poses.positions,
        lambda s: s.sensor("ego").poses.positions,
        lambda s: s.trajectories["ego"].positions,
        lambda s: s.sensor("imu").streams["gyroscope"].values,
        lambda s: s.sensor("gnss").positions_lla,
    ):
        np.testing.assert_array_equal(values(joined), values(scene))
    assert len(pickle.loads(pickle.dumps(joined.sensor("lidar"))).frames[3].points) == 40
    was, found = ({a.id: a for a in each.annotations} for each in (scene, joined))
    assert set(found) == set(was)
    for name in ("car", "drawn"):
        np.testing.assert_array_equal(found[name].path.values, was[name].path.values)
    assert found["car"].activations[0].durations_ns == (1, 2, 3, 4, 5)
    assert sorted(entry.sensor_frame for entry in found["labels"].labeled_points) == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(found["body"].paths[0].values, was["body"].paths[0].values)
    assert len(found["lane"].path.vertices) == 5
    assert (found["rotation"].start_ns, found["rotation"].duration_ns) == (0, 400_000_000)
    np.testing.assert_array_equal(found["repair"].poses.positions, drive.path(hz=10).positions)


def test_frames_that_are_in_both_parts_are_taken_once_if_they_are_equal(drive):
    scene = only(drive.scene(sc.PointsFrame.WORLD), "lidar")
    lidar = scene.sensor("lidar")
    parts = [replace(scene, sensors=(replace(lidar, frames=lidar.frames[a:b]),)) for a, b in ((0, 3), (2, 5))]
    joined = merge_scenes(parts, join=True)
    assert joined.sensor("lidar").frames.timestamps_ns.tolist() == drive.timestamps_ns.tolist()
    assert {warning.code: warning.count for warning in joined.warnings} == {"frames-twice": 1}
    moved = replace(lidar.frames[2], points=replace(lidar.frames[2].points, positions=np.ones((1, 3), np.float32)))
    other = replace(scene, sensors=(replace(lidar, frames=sc.LazyFrames.of([moved], [200_000_000])),))
    with pytest.raises(OptionError, match="two frames at 200000000 ns whose points differ"):
        merge_scenes([parts[0], other], join=True)


def test_what_is_stationary_stays_so_and_what_the_second_part_says_otherwise_is_reported(drive):
    first = drive.timestamps_ns[:1]
    lane = sc.ShapeAnnotation("lane", sc.ShapeType.POLYLINE, sc.VertexPath(first, (np.eye(3),)), stationary=True)
    scene = drive.scene(annotations=(box("b", first, np.ones(3), stationary=True), lane))
    joined = merge_scenes([crop_scene(scene, stop=0.2), crop_scene(scene, start=0.2)], join=True)
    assert [a.path.timestamps_ns.tolist() for a in joined.annotations] == [[0], [0]]
    weather = [sc.AttributePath("weather", (stated,), static=True) for stated in ("rain", "sun")]
    scenes = []
    for label, still, attribute in (("car", False, weather[0]), ("truck", True, weather[1])):
        seen = box("b", drive.timestamps_ns, np.ones(3), label=label, stationary=still)
        scenes.append(replace(drive.scene(annotations=(seen,)), attributes=(attribute,), extras={"owner": label}))
    joined = merge_scenes(scenes, join=True)
    assert (joined.annotations[0].label, joined.attributes, joined.extras["owner"]) == ("car", (weather[0],), "car")
    reported = [warning.location for warning in joined.warnings if warning.code == "fields-differ"]
    assert sorted(reported) == ["annotations[b].label", "annotations[b].stationary", "attributes[weather]", "owner"]


def test_what_does_not_go_together_is_refused(drive):
    for change, problem in (
        (lambda s: replace(s, frames=s.frames[::2]), "lie between those of the first"),
        (lambda s: replace(s, mount=RigidTransform.identity(), frames=s.frames[4:]), "mounted otherwise"),
        (lambda s: replace(s, points_frame=sc.PointsFrame.EGO), "expected one frame"),
        (lambda s: sc.PointsSensor("lidar", np.zeros((1, 3), np.float32)), "expected one kind"),
    ):
        scene = only(drive.scene(sc.PointsFrame.WORLD), "lidar")
        lidar = scene.sensor("lidar")
        first = replace(scene, sensors=(replace(lidar, frames=lidar.frames[1::2]),))
        with pytest.raises(OptionError, match=problem):
            merge_scenes([first, replace(scene, sensors=(change(lidar),))], join=True)
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


def test_metadata_events_and_what_closes_are_those_of_both(drive):
    first = only(drive.scene(), "lidar", metadata={"weather": "A", "sceneloom": {"applied": [{"id": 1}], "x": 1}})
    second = only(drive.scene(), "radar", metadata={"weather": "B", "sceneloom": {"applied": [{"id": 2}], "y": 2}})
    merged = merge_scenes([first, second])
    assert merged.metadata == {"weather": "A", "sceneloom": {"applied": [{"id": 1}, {"id": 2}], "x": 1, "y": 2}}
    assert [(n.code, n.location) for n in merged.warnings] == [("metadata-differ", "metadata.weather")]
    # an event lasts until its last part ends, though that is a moment
    for parts, joined in (
        (((0, 5), (10, None)), (0, 10)),
        (((0, None), (10, None)), (0, 10)),
        (((10, 5), (0, 5)), (0, 15)),
        (((3, None), (3, None)), (3, None)),
    ):
        one, other = (sc.Scene((), (sc.EventAnnotation("rotation", start, lasts),)) for start, lasts in parts)
        (event,) = merge_scenes([one, other], join=True).annotations
        assert (event.start_ns, event.duration_ns) == joined
    closed, scene = [], drive.scene()
    names = ("lidar", "radar")
    with merge_scenes([only(scene, name, on_close=lambda name=name: closed.append(name)) for name in names]):
        assert closed == []
    assert closed == ["lidar", "radar"]


def fixes(identifier, *lla):
    return sc.GnssSensor(identifier, np.array([0, 10**8]), np.array([lla] * 2), np.ones(2), np.ones(2))


def located(metadata, *sensors):
    return lambda scene: replace(scene, metadata=metadata, sensors=(*scene.sensors, *sensors))


BOSTON = located({"nuscenes": {"log": {"location": "boston-seaport"}}})
SINGAPORE = located({"sceneloom": {"location": "singapore-onenorth"}})
MUNICH, BERLIN = (located({}, fixes(f"gnss{x}", x, 11.0, 500.0)) for x in (48.0, 52.5))


@pytest.mark.parametrize(
    ("first", "second", "reason"),
    [
        (located({"city": "Pittsburgh"}), located({"city": "Miami"}), "it was in miami"),
        (BOSTON, SINGAPORE, "singapore-onenorth, the other in boston-seaport"),
        (MUNICH, BERLIN, r"satellite fixes are 500\.\d km apart"),
    ],
)
def test_scenes_of_two_cities_are_refused_unless_they_are_forced(drive, first, second, reason):
    parts = [first(only(drive.scene(), "lidar")), second(only(drive.scene(), "radar"))]
    with pytest.raises(OptionError, match=reason):
        merge_scenes(parts)
    merged = merge_scenes(parts, force=True)
    assert [n.message for n in merged.warnings if n.code == "different-drives"]
    assert {"lidar", "radar"} <= {sensor.id for sensor in merged.sensors}


def moved_away(path, metres):
    return replace(path, positions=path.positions + np.array([metres, 0, 0]))


def later(scene, seconds):
    """Another part, `seconds` after the first: of a lidar that its own file has."""
    lidar = scene.sensor("lidar")
    times = lidar.frames.timestamps_ns + int(seconds * 1e9)
    frames = [replace(f, timestamp_ns=int(t)) for f, t in zip(lidar.frames, times, strict=True)]
    return replace(
        scene, sensors=(replace(lidar, id="other", frames=sc.LazyFrames.of(frames, times)),), trajectories={}
    )


def test_egos_far_apart_and_parts_of_other_days_are_of_two_drives_and_unrelated_ones_warned_of(drive):
    scene = drive.scene()
    lidar, radar = only(scene, "lidar"), only(scene, "radar")
    away = [replace(radar, trajectories={"ego": moved_away(scene.trajectories["ego"], x)}) for x in (20, 5000)]
    assert merge_scenes([lidar, away[0]], rename=True)
    with pytest.raises(OptionError, match="their egos are 5,000 m apart at one time"):
        merge_scenes([lidar, away[1]], rename=True)
    assert merge_scenes([radar, later(scene, 600)])
    with pytest.raises(OptionError, match="10 days are between them"):
        merge_scenes([radar, later(scene, 864_001)])
    # poses of sensors stand in for an ego that is not known
    alone = replace(to_world(lidar), trajectories={})
    sensor = alone.sensor("lidar")
    other = replace(sensor, id="other", poses=moved_away(sensor.poses, 5000.0))
    with pytest.raises(OptionError, match="their egos are 5,000 m apart at one time"):
        merge_scenes([alone, replace(alone, sensors=(other,))])
    # scenes that nothing relates are merged with a warning
    first, second = only(drive.scene(), "lidar"), only(drive.scene(), "radar")
    bare = replace(second, trajectories={}, sensors=tuple(replace(one, poses=None) for one in second.sensors))
    assert "drives-unrelated" not in {n.code for n in merge_scenes([first, second]).warnings}
    assert "drives-unrelated" in {n.code for n in merge_scenes([first, bare]).warnings}
