"""Tasks of every tool, written and read again: objects, boxes, cameras and points stay where they are."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras import project
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError, OutputError
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.base.losses import Support
from sceneloom.scene import Activation, AttributePath, CuboidAnnotation, LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.annotations_at import attribute_at
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

TOOLS = ["supervisely", "segments", "scale-task", "sustechpoints"]
WITH_POSES = ["segments", "scale-task", "sustechpoints"]
"""Tools that state where the clouds are."""
WITH_POINTS = ["supervisely", "segments"]

UUID_KEY = "0123456789abcdef0123456789abcdef"


def without_times(frame):
    return replace(frame, points=replace(frame.points, timestamps_ns=None))


def street():
    """A drive of three sweeps with a camera, whose objects have ids and attributes of every kind."""
    camera = CameraSpec(Camera("pinhole", 48, 16, 30.0, 30.0, 23.5, 7.5), camera_mount())
    scene = simulate_street(5, frames=3, lidar=LidarSpec(beams=8, steps=120), cameras=(camera,)).scene
    lidar = scene.lidars[0]
    scene = replace(scene, sensors=(replace(lidar, frames=lidar.frames.mapped(without_times)), *scene.sensors[1:]))
    times = lidar.frames.timestamps_ns
    cuboids = [one for one in scene.annotations if isinstance(one, CuboidAnnotation)][:4]
    attributes = (
        AttributePath("moving", (True, False), times[[0, 2]]),
        AttributePath("speed", (1.5,)),
        AttributePath("state", ("parked", "driving"), times[[0, 1]]),
    )
    ids = (7, 'bus "4"', UUID_KEY, cuboids[3].id)
    named = [replace(one, id=ids[k], attributes=attributes[:k]) for k, one in enumerate(cuboids)]
    path = named[3].path
    tilted = np.array(path.values)
    tilted[:, 6:8] = [2.0, -3.0]
    named[3] = replace(named[3], path=replace(path, values=tilted))
    return replace(scene, annotations=tuple(named))


@pytest.fixture(scope="module")
def scene():
    return street()


@pytest.fixture(scope="module", params=TOOLS)
def tool(request):
    return request.param


@pytest.fixture(scope="module")
def written(tool, scene, tmp_path_factory):
    path = tmp_path_factory.mktemp(tool) / "task"
    return write_scene(scene, path, format=tool), open_scene(path)


def test_each_tool_is_recognised_by_its_content(written, tool):
    assert written[1].format == tool


def test_objects_keep_ids_classes_and_sizes(written, scene, tool):
    found = {one.id: one for one in written[1].annotations}
    expected = {one.id: one for one in scene.annotations}
    assert set(found) == set(expected)
    for identifier, one in expected.items():
        assert found[identifier].label == one.label
        sizes = found[identifier].path.values[:, :3]
        np.testing.assert_allclose(sizes, np.broadcast_to(one.path.values[0, :3], sizes.shape), atol=1e-6)


def test_boxes_lie_in_the_sweeps_where_they_lay(written, scene, tool):
    """Boxes are compared in the frame of the sweep, which both scenes have."""
    for before, after in zip(scene.samples(), written[1].samples(), strict=True):
        there = {name: row for row, name in enumerate(after.boxes.ids)}
        assert set(there) == set(before.boxes.ids)
        rows = [there[name] for name in before.boxes.ids]
        one, other = (sample.world_from_lidar.inverse() for sample in (before, after))
        centers = other.apply(after.boxes.centers_world[rows])
        np.testing.assert_allclose(centers, one.apply(before.boxes.centers_world), atol=1e-3)
        axes = other.rotation @ after.boxes.rotations_world[rows]
        expected = one.rotation @ before.boxes.rotations_world
        if tool == "scale-task":  # it has upright boxes only
            np.testing.assert_allclose(after.boxes.yaws_world[rows], before.boxes.yaws_world, atol=np.radians(0.01))
            continue
        cosines = (np.trace(np.swapaxes(axes, 1, 2) @ expected, axis1=1, axis2=2) - 1) / 2
        assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < 0.01


def test_points_and_their_pixels_stay(written, scene, tool):
    for before, after in zip(scene.samples(), written[1].samples(), strict=True):
        positions = []
        for sample in (before, after):
            points = sample.world_from_lidar.inverse() @ sample.poses.world_from_points
            positions.append(points.apply(sample.sweep.points.positions))
        np.testing.assert_allclose(positions[1], positions[0], atol=1e-4)
        np.testing.assert_array_equal(after.sweep.points.intensities, before.sweep.points.intensities)
        (name,) = before.images
        pixels = [
            project(
                sample.cameras[str(name)], sample.camera_from_points[str(name)].apply(sample.sweep.points.positions)
            )
            for sample in (before, after)
        ]
        seen = pixels[0][1]
        assert seen.sum() > 10
        np.testing.assert_allclose(pixels[1][0][seen], pixels[0][0][seen], atol=0.01)
        np.testing.assert_array_equal(after.images[str(name)].rgb.shape, before.images[name].rgb.shape)
        if tool in ("segments", "scale-task"):
            assert after.images[str(name)].timestamp_ns == before.images[name].timestamp_ns


def test_attributes_hold_in_the_frames_in_which_they_held(written, scene, tool):
    found = {one.id: {a.name: a for a in one.attributes} for one in written[1].annotations}
    times = scene.lidars[0].frames.timestamps_ns
    for one in scene.annotations:
        for path in one.attributes:
            expected = attribute_at(path, times)
            if tool == "segments":  # it has no fractions
                expected = [str(value) if isinstance(value, float) else value for value in expected]
            assert attribute_at(found[one.id][path.name], times) == expected, path.name


def test_what_a_task_cannot_hold_is_in_the_report_and_nothing_else_is_dropped(written, tool):
    dropped = {loss.field for loss in written[0] if loss.support is Support.DROPPED}
    dropped -= {"sensors.lidar.frames.points.rings"} if tool == "scale-task" else set()
    assert not {field for field in dropped if field.startswith(("sensors.lidar.frames", "annotations"))}
    assert any(field.startswith("trajectories") for field in dropped) != (tool in WITH_POSES)


@pytest.mark.parametrize("name", WITH_POINTS)
def test_labelled_points_keep_their_rows(name, scene, tmp_path):
    count = len(scene.lidars[0].frames[1].points)
    rows = np.array([0, 3, count - 1], np.uint32)
    points = LabeledPointsAnnotation("road", (LabeledPoints(scene.lidars[0].id, rows, 1),), "Road", is_instance=True)
    options = {"task": "segmentation"} if name == "segments" else {}
    write_scene(replace(scene, annotations=(points,)), tmp_path / "task", format=name, **options)
    (found,) = open_scene(tmp_path / "task").annotations
    (entry,) = found.labeled_points
    assert (found.id, found.label, entry.sensor_frame) == ("road", "Road", 1)
    np.testing.assert_array_equal(entry.point_ids, rows)


def test_an_object_that_is_away_for_a_frame_is_not_put_there(tool, scene, tmp_path):
    times = scene.lidars[0].frames.timestamps_ns
    one = scene.annotations[0]
    write_scene(scene, tmp_path / "all", format=tool)
    read = open_scene(tmp_path / "all")
    gap = replace(
        next(found for found in read.annotations if found.id == one.id),
        activations=(Activation("lidar", times[[0, 2]], (1, 1)),),
    )
    write_scene(replace(read, annotations=(gap,)), tmp_path / "gap", format=tool)
    again = open_scene(tmp_path / "gap")
    there = [one.id in sample.boxes.ids for sample in again.samples()]
    assert there == [True, False, True]


def test_clouds_in_the_world_hold_what_is_stationary_in_one_place(scene, tmp_path):
    write_scene(scene, tmp_path / "task", format="supervisely", points_frame="world")
    read = open_scene(tmp_path / "task")
    before, after = scene.samples()[2], read.samples()[2]
    rows = [after.boxes.ids.index(name) for name in before.boxes.ids]
    np.testing.assert_allclose(after.boxes.centers_world[rows], before.boxes.centers_world, atol=1e-3)
    positions = before.poses.world_from_points.apply(before.sweep.points.positions)
    np.testing.assert_allclose(after.sweep.points.positions, positions, atol=1e-3)


def test_wrong_options_and_foreign_folders_are_refused(tool, scene, tmp_path):
    with pytest.raises(OptionError, match="points_frame"):
        write_scene(scene, tmp_path / "task", format=tool, points_frame="ego")
    with pytest.raises(OptionError, match="no sweep of a lidar 'roof'"):
        write_scene(scene, tmp_path / "task", format=tool, lidar="roof")
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "diary.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"diary\.txt"):
        write_scene(scene, tmp_path / "task", format=tool, overwrite=True)
