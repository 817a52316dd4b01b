"""Labels written for each tool and read again: ids, places and times; what a tool cannot hold is reported."""

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.masks import MASKS, Mask
from sceneloom.formats.base.registry import find_format, format_named, open_scene, write_scene
from sceneloom.formats.labelling.drawn import RBBOX, corners_of, id_text, text_id
from sceneloom.scene import annotations_at as at

T0 = 1_700_000_000_000_000_001
TIMES = T0 + np.arange(6) * 33_333_333
CAMERA = Camera("pinhole", 64, 48, 50.0, 50.0, 31.5, 23.5)
PX = 0.01


def camera(identifier="front"):
    rows = np.random.default_rng(3).integers(0, 255, (len(TIMES), 48, 64, 3), np.uint8)
    images = [sc.CameraImage.of(int(t), CAMERA, rgb) for t, rgb in zip(TIMES, rows, strict=True)]
    return sc.CameraSensor(identifier, CAMERA, sc.LazyFrames.of(images, TIMES))


def box(identifier, values, times=TIMES, **fields):
    return sc.Box2DAnnotation(
        identifier, "front", sc.BoxPath(times, np.array(values, float)), **{"label": "car", **fields}
    )


def moving_boxes():
    """A box with key frames, and one that is gone in between, in two parts of one object."""
    yield box(7, [[1.25, 2.5, 10, 8], [11.25, 4.5, 14, 9.5]], TIMES[[0, 5]], attributes=(
        sc.AttributePath("colour", ("dark red",), static=True),
        sc.AttributePath("occluded", (False, True), TIMES[[0, 3]]),
        sc.AttributePath("doors", (4, 2), TIMES[[0, 2]]),
    ))  # fmt: skip
    yield sc.ObjectAnnotation("b-2", "person")
    yield box("b-2:box", [[5, 6, 2, 3], [6, 6, 2, 3]], TIMES[:2], label="person", parent_id="b-2")
    yield box("b-2:box:2", [[9, 6, 2, 3], [9.5, 6, 2, 3]], TIMES[4:], label="person", parent_id="b-2")


def parts_only():
    yield from [*moving_boxes()][1:]


def areas():
    ring = np.array([[1.0, 1], [20.5, 2], [18.25, 30], [2, 28]])
    path = sc.VertexPath(TIMES[:2], (ring, ring + 1.5))
    yield sc.ShapeAnnotation(3, sc.ShapeType.POLYGON_2D, path, "front", label="road")


def lines():
    line = np.array([[1.0, 40], [30.5, 20], [60, 41]])
    yield sc.ShapeAnnotation("l", sc.ShapeType.POLYLINE_2D, sc.VertexPath(TIMES[2:3], (line,)), "front", label="lane")


def rotated():
    rows = [[30.0, 20, 12, 6, 0.5], [31, 21, 12, 6, 0.75]]
    path = sc.VertexPath(TIMES[:2], tuple(corners_of(np.array(row)) for row in rows), extras={RBBOX: rows})
    yield sc.ShapeAnnotation("r", sc.ShapeType.POLYGON_2D, path, "front", label="car")


def masks():
    grid = np.zeros((48, 64), bool)
    grid[10:20, 30:40] = grid[15:30, 35:50] = True
    rows, columns = np.nonzero(grid)
    mask = Mask.of_pixels(48, 64, columns, rows)
    path = sc.BoxPath(TIMES[1:2], mask.box()[None], extras={MASKS: [mask.record()]})
    yield sc.Box2DAnnotation("m", "front", path, label="tree")


def keypoints(names=("nose", "tail")):
    pixels = np.array([[[10.0, 12], [11, 12]], [[20.25, 22], [np.nan, np.nan]]])
    flags = ([2, 1], [2, 0])
    seen = [(sc.PointProjection("front", TIMES[:2], pixels[k], extras={"visibility": flags[k]}),) for k in range(2)]
    nowhere = (np.zeros(0, np.int64), np.zeros((0, 3)))
    yield sc.ObjectAnnotation("k", "dog")
    yield sc.PointsAnnotation(
        "k:points", tuple(sc.PointPath(*nowhere, id=k) for k in range(2)), names, tuple(seen), parent_id="k"
    )


def cuboids():
    rows = [[4, 2, 1.5, 10, 20, 1, 0, 0, 30], [4, 2, 1.5, 12, 24, 1, 1, -2, 90]]
    yield sc.CuboidAnnotation(11, sc.CuboidPath(TIMES[[0, 5]], np.array(rows, float)), "Car")


PARTS = {
    "boxes": moving_boxes, "areas": areas, "lines": lines, "rotated": rotated, "masks": masks, "keypoints": keypoints,
    "cuboids": cuboids, "parts": parts_only,
}  # fmt: skip


def scene_of(*parts):
    annotations = tuple(one for part in parts for one in PARTS[part]())
    lidar = [sc.LidarFrame(int(t), sc.LidarPoints(np.ones((2, 3), np.float32))) for t in TIMES]
    sensors = (sc.LidarSensor("top", sc.LazyFrames.of(lidar, TIMES)), camera())
    return sc.Scene(sensors, annotations=annotations)


def by_id(scene):
    return {one.id: one for one in scene.annotations}


def check_same(found, expected):
    """The annotation is the same, wherever both state it."""
    assert type(found) is type(expected)
    assert getattr(found, "label", None) == getattr(expected, "label", None)
    match expected:
        case sc.Box2DAnnotation():
            rows, there = at.box_2d_at(expected, TIMES)
            again, there_again = at.box_2d_at(found, TIMES)
            assert there.tolist() == there_again.tolist()
            np.testing.assert_allclose(again[there], rows[there], atol=PX)
            assert [*found.path.extras.get(MASKS, ())] == [*expected.path.extras.get(MASKS, ())]
        case sc.ShapeAnnotation():
            assert found.path.timestamps_ns.tolist() == expected.path.timestamps_ns.tolist()
            for one, other in zip(found.path.vertices, expected.path.vertices, strict=True):
                np.testing.assert_allclose(one, other, atol=PX)
            rows, others = (np.array(one.path.extras.get(RBBOX, np.zeros((0, 5)))) for one in (found, expected))
            np.testing.assert_allclose(rows[:, :4], others[:, :4], atol=PX)
            np.testing.assert_allclose(np.degrees(rows[:, 4]), np.degrees(others[:, 4]), atol=0.01)
        case sc.PointsAnnotation():
            for one, other in zip(found.projections, expected.projections, strict=True):
                np.testing.assert_allclose(one[0].points, other[0].points, atol=PX)
                assert one[0].timestamps_ns.tolist() == other[0].timestamps_ns.tolist()
        case sc.CuboidAnnotation():
            (there,), (again,) = ([at.cuboid_poses(one, TIMES)] for one in (expected, found))
            np.testing.assert_allclose(again.centers_world, there.centers_world, atol=1e-3)
            np.testing.assert_allclose(again.sizes_lwh, there.sizes_lwh, atol=1e-3)
            dots = np.abs((again.quaternions_xyzw * there.quaternions_xyzw).sum(axis=1)).clip(0, 1)
            assert np.degrees(2 * np.arccos(dots)).max() < 0.01


def values_at(annotation, name):
    attribute = next(one for one in annotation.attributes if one.name == name)
    return at.attribute_at(attribute, TIMES)


HELD = [
    ("cvat", "out", {}, "boxes areas lines rotated"),
    ("cvat", "out", {"task": "images"}, "boxes areas lines rotated masks"),
    ("cvat", "a.xml", {"task": "video"}, "boxes areas lines rotated"),
    ("coco", "out", {}, "boxes areas rotated masks keypoints"),
    ("coco", "a.json", {}, "boxes areas rotated masks keypoints"),
    ("datumaro", "out", {}, "boxes areas lines rotated masks keypoints"),
    ("datumaro", "a.json", {}, "cuboids"),
    ("label-studio", "out", {}, "areas lines rotated masks keypoints boxes"),
    ("label-studio", "a.json", {"task": "video"}, "rotated parts"),
    ("tracklets", "tracklet_labels.xml", {}, "cuboids"),
    ("tracklets", "t.xml", {"dialect": "kitti"}, "cuboids"),
]


@pytest.mark.parametrize(("form", "name", "options", "parts"), HELD, ids=lambda one: str(one).replace(" ", ","))
def test_what_a_tool_holds_comes_back_with_its_ids_times_and_places(form, name, options, parts, tmp_path):
    scene = scene_of(*parts.split())
    write_scene(scene, tmp_path / name, format=form, **options)
    assert find_format(tmp_path / name) is format_named(form)
    reading = {"dialect": options["dialect"]} if "dialect" in options else {}
    with open_scene(tmp_path / name, **reading) as again:
        found = by_id(again)
        assert {key_type(one) for one in found} == {key_type(one) for one in by_id(scene)}
        for identifier, expected in by_id(scene).items():
            check_same(found[identifier], expected)
        if "boxes" in parts:
            assert values_at(found[7], "colour") == ["dark red"] * 6
            assert values_at(found[7], "occluded") == [False] * 3 + [True] * 3
            assert values_at(found[7], "doors") == [4, 4, 2, 2, 2, 2]
            assert all(type(one) is int for one in values_at(found[7], "doors"))
        if "." not in name:
            (seen,) = again.cameras
            assert seen.id == "front"
            assert seen.images.timestamps_ns.tolist() == TIMES.tolist()
            assert np.array_equal(seen.images[3].rgb, scene.cameras[0].images[3].rgb)
    # once more: nothing is added
    with open_scene(tmp_path / name, **reading) as once:
        write_scene(once, tmp_path / f"again-{name}", format=form, **options)
    with open_scene(tmp_path / f"again-{name}", format=form, **reading) as twice:
        assert [key_type(one.id) for one in twice.annotations] == [key_type(one.id) for one in again.annotations]
        for identifier, expected in found.items():
            check_same(by_id(twice)[identifier], expected)


def key_type(identifier):
    return type(identifier), identifier


@pytest.mark.parametrize("identifier", [0, -3, 7, "7", "a b", '"7"', "", "7 ", "007", 123456789012345678])
def test_whole_numbers_and_texts_stay_apart_as_ids(identifier):
    assert key_type(text_id(id_text(identifier))) == key_type(identifier)


def test_masks_bound_what_they_cover_and_their_runs_are_packed_as_coco_has_them():
    # a run over two columns; the text is that of pycocotools 2.0.11 for the same pixels
    mask = Mask(10, 5, (12, 5, 20, 3, 10))
    columns, rows = mask.pixels()
    assert mask.box().tolist() == [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
    assert mask.record() == {"size": [10, 5], "counts": "<5d0NF"}
    assert Mask.of_record(mask.record()) == mask == Mask.of_pixels(10, 5, columns, rows)
    across = Mask(4, 3, (3, 2, 7))
    assert across.box().tolist() == [0, 0, 2, 4]
    for wrong in (
        {"size": [10, 5], "counts": [3]},
        {"size": [10, 5], "counts": "<"},
        {"size": [0, 5], "counts": []},
        7,
    ):
        with pytest.raises(ValueError, match=r"expected|of|ends"):
            Mask.of_record(wrong)


def test_yolo_keeps_classes_places_and_times_and_says_that_ids_are_gone(tmp_path):
    kinds = {"boxes": "detect", "areas": "segment", "rotated": "obb", "keypoints": "pose"}
    for part, task in kinds.items():
        scene = scene_of(part)
        report = write_scene(scene, tmp_path / task, format="yolo")
        assert any("ids" in loss.what for loss in report)
        with open_scene(tmp_path / task) as again:
            assert again.cameras[0].images.timestamps_ns.tolist() == TIMES.tolist()
            shown = [one for one in again.annotations if not isinstance(one, sc.ObjectAnnotation)]
            if task == "detect":
                expected = [at.box_2d_at(one, TIMES) for one in moving_boxes() if isinstance(one, sc.Box2DAnnotation)]
                rows = np.concatenate([row[there] for row, there in expected])
                found = np.concatenate([one.path.values for one in shown])
                order = [np.lexsort(np.round(table, 6).T) for table in (rows, found)]
                np.testing.assert_allclose(found[order[1]], rows[order[0]], atol=PX)
                assert {one.label for one in shown} == {"car", "person"}
            elif task == "pose":
                (points, *_) = [one for one in shown if isinstance(one, sc.PointsAnnotation)]
                assert points.labels == ("nose", "tail")
                np.testing.assert_allclose(points.projections[1][0].points, [[20.25, 22]], atol=PX)
            else:
                (shape,) = scene.annotations
                for one, vertices in zip(shown, shape.path.vertices, strict=True):
                    np.testing.assert_allclose(one.path.vertices[0], vertices, atol=PX)
                    assert (RBBOX in one.path.extras) == (task == "obb")


BOMB = '<?xml version="1.0"?><!DOCTYPE annotations [<!ENTITY a "aaaa">]><annotations><a>&a;</a></annotations>'
FEW_RUNS = (
    '<annotations><image id="0" width="9" height="9"><mask rle="1,2" left="0" top="0" width="9" height="9"/></image>'
    "</annotations>"
)
SIZE = '"original_width": 10, "original_height": 10'
WRONG_REGION = (
    '[{"data": {"image": "a.jpg"}, "annotations": [{"result": [{"id": "a", "type": "rectanglelabels", '
    f'{SIZE}, "value": {{"x": "1"}}}}]}}]}}]'
)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.xml", BOMB, "declares entities"),
        ("a.xml", f"<annotations>{'<a>' * 100}", "elements in 32 others"),
        ("a.xml", '<annotations><image id="0"><box xtl="x"/></image></annotations>', "line 1, <box>"),
        ("a.xml", FEW_RUNS, "runs of 3 pixels"),
        ("a.xml", '<annotations><image id="0"', "is no XML"),
        ("c.json", '{"images": [], "categories": [], "annotations": [{"image_id": 3}]}', "annotations[0].image_id"),
        ("c.json", '{"images": [{"id": 1, "width": -4}], "categories": [], "annotations": []}', "expected those of an"),
        ("d.json", '{"items": [{"id": "a", "annotations": [{"type": "bbox", "bbox": [1, 2]}]}], "categories": {}}',
         "items[0].annotations[0].bbox"),
        ("l.json", WRONG_REGION, "result[0].value.x"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_place_and_passed_over_where_that_is_asked_for(name, text, message, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(DataError) as caught:
        open_scene(tmp_path / name)
    assert message in str(caught.value)
    if "items" in text or "<box" in text or "rectangle" in text:
        with open_scene(tmp_path / name, lenient=True) as scene:
            assert not scene.annotations
            assert any("left out" in one.message for one in scene.warnings)


def test_options_that_cannot_be_followed_are_named(tmp_path):
    scene = scene_of("boxes")
    for form, options, message in (
        ("cvat", {"task": "x"}, "task 'x'"),
        ("cvat", {"camera": "rear"}, "no camera 'rear'"),
        ("cvat", {"images": "all"}, "images 'all'"),
        ("yolo", {"task": "x"}, "task 'x'"),
        ("tracklets", {"dialect": "x"}, "dialect 'x'"),
        ("label-studio", {"task": "x"}, "task 'x'"),
    ):
        with pytest.raises(OptionError, match=message):
            write_scene(scene, tmp_path / "o", format=form, **options)
    with pytest.raises(OptionError, match="rate_hz"):
        write_scene(scene, tmp_path / "a.coco.json")
        open_scene(tmp_path / "a.coco.json", rate_hz=0)


@pytest.mark.parametrize("shape", ["[[1, 2], 3]", "[{a: 1}, 3]"])
def test_a_shape_of_keypoints_that_is_none_is_not_used(shape, tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "1.txt").write_text("0 0.5 0.5 0.25 0.5\n")
    (tmp_path / "data.yaml").write_text(f"train: images\nkpt_shape: {shape}\nnames: [car]\n")
    with open_scene(tmp_path) as scene:
        assert [one.label for one in scene.annotations] == ["car"]
