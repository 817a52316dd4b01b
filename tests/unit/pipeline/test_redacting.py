"""Regions of images that are hidden: which, and that nothing of them is left; and lists of boxes."""

import json

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.pipeline import redacting
from sceneloom.pipeline.redacting import ImageBox, filled, find_hidings, hide_in_images, read_image_boxes
from sceneloom.scene.annotations import BoxPath, ShapeType

CAMERA = Camera("pinhole", 64, 48, 50.0, 50.0, 31.5, 23.5)
PERIOD_NS = 100_000_000
EARLY = 1_700_000_000_000_000_000
"""A time of today [ns]: float64 is 256 ns off there."""


def scene_with(annotations=(), *, count=6, sensors=(), **fields):
    rng = np.random.default_rng(3)
    times = [EARLY + k * PERIOD_NS for k in range(count)]
    images = [sc.CameraImage.of(t, CAMERA, rng.integers(0, 256, (48, 64, 3), np.uint8)) for t in times]
    camera = sc.CameraSensor("front", CAMERA, sc.LazyFrames.of(images, times))
    return sc.Scene((camera, *sensors), tuple(annotations), **fields)


def hidings_of(scene, **how):
    (hiding,) = find_hidings(scene, **how)
    return {int(k): hiding.boxes[hiding.images == k].tolist() for k in np.unique(hiding.images)}, hiding


def test_what_is_left_of_hidden_boxes():
    # pixelated: sixteen colours at most, each the mean of its cell
    image = np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8)
    hidden = filled(image, np.array([[4, 6, 36, 38]]), fill="pixelate")
    inside = hidden[6:38, 4:36]
    assert len(np.unique(inside.reshape(-1, 3), axis=0)) <= 16
    np.testing.assert_allclose(inside[0, 0], image[6:14, 4:12].mean(axis=(0, 1)), atol=0.5)
    outside = np.ones((40, 40), bool)
    outside[6:38, 4:36] = False
    assert np.array_equal(hidden[outside], image[outside])
    # two images with equal means are alike once they are hidden
    for fill in ("blur", "pixelate", "black"):
        image = np.random.default_rng(1).integers(0, 256, (32, 32, 3), np.uint8)
        other = image.reshape(4, 8, 4, 8, 3)[:, ::-1, :, ::-1].reshape(32, 32, 3)
        whole = np.array([[0, 0, 32, 32]])
        assert not np.array_equal(image, other)
        assert np.array_equal(filled(image, whole, fill=fill), filled(other, whole, fill=fill))
    # blurred: smooth between the means of cells
    ramp = np.repeat(np.arange(0, 128, 4, dtype=np.uint8)[None], 32, axis=0)
    hidden = filled(ramp, np.array([[0, 0, 32, 32]])).astype(int)
    assert np.abs(np.diff(hidden[16])).max() <= 5
    np.testing.assert_allclose(hidden[:, 3:29], ramp[:, 3:29], atol=3)  # a ramp's means lie on it
    image = np.full((4, 4, 3), 9, np.uint8)
    assert filled(image, np.array([[1, 1, 2, 2]]), fill="black")[1, 1].tolist() == [0, 0, 0]
    with pytest.raises(OptionError, match="expected one of blur, pixelate, black"):
        filled(image, np.array([[0, 0, 1, 1]]), fill="smear")


def test_tracks_are_joined_by_straight_lines_and_annotations_hidden_by_labels_while_they_last():
    boxes = (
        ImageBox((0, 0, 10, 10), number=1, track="a"),
        ImageBox((30, 6, 40, 16), timestamp_ns=EARLY + 4 * PERIOD_NS, track="a"),
        ImageBox((1, 2, 3, 4), number=5),
    )
    found, hiding = hidings_of(scene_with(), boxes=boxes)
    rows = [[0, 0, 10, 10], [10, 2, 20, 12], [20, 4, 30, 14], [30, 6, 40, 16], [1, 2, 3, 4]]
    assert found == {number: [row] for number, row in enumerate(rows, 1)}
    assert (hiding.given, hiding.unmatched) == (3, 0)
    # held before and after; in an image twice, both are hidden
    boxes = (ImageBox((0, 0, 9, 9), number=2, track="a"), ImageBox((0, 0, 9, 9), number=3, track="a"))
    assert sorted(hidings_of(scene_with(), boxes=boxes, hold=0.1)[0]) == [1, 2, 3, 4]
    boxes = (ImageBox((0, 0, 9, 9), number=2, track="a"), ImageBox((20, 0, 29, 9), number=2, track="a"))
    assert sorted(hidings_of(scene_with(), boxes=boxes)[0][2]) == [[0, 0, 9, 9], [20, 0, 29, 9]]
    boxes = (
        ImageBox((0, 0, 9, 9), number=6),
        ImageBox((0, 0, 9, 9), timestamp_ns=EARLY + 560_000_000),
        ImageBox((0, 0, 9, 9), timestamp_ns=EARLY + 249_000_000),
    )
    found, hiding = hidings_of(scene_with(), boxes=boxes)
    assert (sorted(found), hiding.unmatched) == ([2], 2)
    with pytest.raises(OptionError, match="camera 'rear'; its cameras are 'front'"):
        find_hidings(scene_with(), boxes=(ImageBox((0, 0, 9, 9), camera="rear", number=0),))
    path = BoxPath(
        np.array([EARLY + PERIOD_NS - 3_000, EARLY + 3 * PERIOD_NS - 3_000]),
        np.array([[0.0, 0.0, 8.0, 8.0], [20.0, 0.0, 8.0, 8.0]]),
    )
    outline = sc.VertexPath(np.array([EARLY]), (np.array([[5.0, 6.0], [9.0, 2.0], [7.0, 9.0]]),))
    annotations = (
        sc.Box2DAnnotation("f", "front", path, label="face"),
        sc.ShapeAnnotation("p", ShapeType.POLYGON_2D, outline, "front", label="plate"),
        sc.Box2DAnnotation("c", "front", path, label="car"),
    )
    found, hiding = hidings_of(scene_with(annotations), labels=("face", "plate"))
    assert (sorted(found), hiding.given) == ([0, 1, 2, 3], 3)
    assert found[0] == [[5.0, 2.0, 9.0, 9.0]]
    np.testing.assert_allclose(found[2], [[10.0, 0.0, 18.0, 8.0]], atol=1e-3)  # 3 µs of 0.2 s
    with pytest.raises(OptionError, match="no box or outline in an image with label 'nose'; there are car"):
        find_hidings(scene_with(annotations), labels=("nose",))
    rows = [3, 0, 2, 1]
    times = EARLY + np.array(rows) * PERIOD_NS
    path = BoxPath(times, np.array([[2.0 * k, 1.0, 8.0, 8.0] for k in rows]))
    found, _ = hidings_of(scene_with((sc.Box2DAnnotation("f", "front", path, label="face"),)), labels=("face",))
    assert {k: boxes[0][0] for k, boxes in found.items()} == {0: 0.0, 1: 2.0, 2: 4.0, 3: 6.0}
    # what is stationary in an image is hidden in all of them
    first = BoxPath(np.array([EARLY]), np.array([[1.0, 1.0, 8.0, 8.0]]))
    bonnet = sc.Box2DAnnotation("b", "front", first, label="bonnet", stationary=True)
    assert sorted(hidings_of(scene_with((bonnet,)), labels=("bonnet",))[0]) == list(range(6))


def test_regions_are_the_even_pixels_around_boxes_within_the_image_hidden_when_it_is_decoded():
    boxes = (
        ImageBox((11.0, 11.0, 21.0, 31.0), number=0),
        ImageBox((60.0, -4.0, 70.0, 4.0), number=0),
        ImageBox((64.0, 0.0, 80.0, 9.0), number=1),
        ImageBox((5.0, 5.0, 5.0, 9.0), number=2),
    )
    _, hiding = hidings_of(scene_with(), boxes=boxes)
    regions = redacting.hidden_regions(hiding, 64, 48, margin=0.1)
    assert {k: rows.tolist() for k, rows in regions.pixels.items()} == {0: [[10, 8, 22, 34], [58, 0, 64, 6]]}
    assert (regions.outside, regions.cut) == (2, 1)
    scene = scene_with()
    hidings = find_hidings(scene, boxes=(ImageBox((8, 8, 24, 24), number=2),))
    hidden = hide_in_images(scene, hidings, fill="black", margin=0.0)
    before, after = scene.cameras[0].images, hidden.cameras[0].images
    assert not after[2].rgb[8:24, 8:24].any()
    assert np.array_equal(after[2].rgb[:, 24:], before[2].rgb[:, 24:])
    assert np.array_equal(after[1].rgb, before[1].rgb)
    # boxes none of which is in an image hide nothing and are refused
    with pytest.raises(OptionError, match="none of the 1 boxes lies in any image"):
        hide_in_images(scene, find_hidings(scene, boxes=(ImageBox((8, 8, 24, 24), number=60),)))


def test_copies_of_images_in_free_fields_go_and_colours_of_points_are_reported_or_dropped():
    points = sc.LidarPoints(np.zeros((2, 3), np.float32), colors=np.full((2, 3), 7, np.uint8))
    lidar = sc.LidarSensor("lidar", sc.LazyFrames.of([sc.LidarFrame(EARLY, points)], [EARLY]))
    thumbnail = np.frombuffer(b"\xff\xd8\xff" + bytes(200), np.uint8)
    metadata = {"a": {"thumbnail": thumbnail, "b": [1, "data:image/png;base64," + "A" * 60]}, "name": "drive"}
    scene = scene_with(sensors=(lidar,), metadata=metadata)
    hidings = find_hidings(scene, boxes=(ImageBox((8, 8, 24, 24), number=2),))
    hidden = hide_in_images(scene, hidings)
    assert dict(hidden.metadata) == {"a": {"b": [1]}, "name": "drive"}
    locations = {n.location for n in hidden.warnings if n.code == "embedded-image"}
    assert locations == {"metadata.a.thumbnail", "metadata.a.b[1]"}
    (reported,) = (n for n in hidden.warnings if n.code == "colours-of-points")
    assert "came from images before anything was hidden" in reported.message
    assert hidden.lidars[0].frames[0].points.colors is not None
    assert hide_in_images(scene, hidings, drop_colours=True).lidars[0].frames[0].points.colors is None


def read(tmp_path, text, name="boxes.csv"):
    path = tmp_path / name
    path.write_text(text, "utf-8")
    return read_image_boxes(path)


def test_csv_and_json_lists_of_boxes(tmp_path):
    text = "camera,frame,time,x1,y1,x2,y2,id,class\nfront,3,,1,2,30.5,40,a,face\n1,,1700000000.000000001,0,0,1,1,,\n"
    assert read(tmp_path, text) == (
        ImageBox((1.0, 2.0, 30.5, 40.0), "front", 3, None, "a", "face"),
        ImageBox((0.0, 0.0, 1.0, 1.0), "1", None, 1_700_000_000_000_000_001),
    )
    box = ImageBox((1.0, 2.0, 4.0, 6.0), None, None, 12)
    row = {"timestamp_ns": 12, "box": [1, 2, 4, 6]}
    assert read(tmp_path, "timestamp_ns,left,top,width,height\n12,1,2,3,4\n") == (box,)
    assert read(tmp_path, json.dumps([row])) == read(tmp_path, json.dumps({"boxes": [row]})) == (box,)
    with pytest.raises(DataError, match="no such file"):
        read_image_boxes(tmp_path / "none.csv")
    (tmp_path / "x.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="is no UTF-8"):
        read_image_boxes(tmp_path / "x.csv")


def test_what_is_wrong_is_reported_with_its_line(tmp_path):
    for text, problem in [
        ("a,b\n1,2\n", "line 1: columns a, b; expected camera, number"),
        ("", "line 1: columns none"),
        ("number,x1,y1,x2,y2\n0,1,2,3,x\n", "line 2: y2: 'x'; expected a number"),
        ("number,x1,y1,x2,y2\n0,1,2,3,nan\n", "line 2: y2: 'nan'; expected a finite number"),
        ("number,x1,y1,x2,y2\n0,5,2,3,4\n", "expected x1 <= x2"),
        ("number,x1,y1,x2,y2\n0.5,1,2,3,4\n", "number: '0.5'; expected a whole number"),
        ("number,x1,y1,x2,y2\n,1,2,3,4\n", "does not state which image"),
        ("number,x1,y1,x2,y2\n0,1,2,3\n", "line 2: has more or fewer values"),
        ("[1]", r"boxes\[0\]: 1; expected an object"),
        ("{}", "expected a list of boxes"),
        ("[", "is no JSON"),
        ('[{"number": true, "box": [1, 2, 3, 4]}]', "number: True"),
        ("time,x1,y1,x2,y2\n1e30,1,2,3,4\n", "expected seconds on the scene's clock"),
        ("number,x1,y1,x2,y2\n1e99999999,1,2,3,4\n", "expected a finite number"),
        ("timestamp_ns,x1,y1,x2,y2\n1e30,1,2,3,4\n", "expected one that an image of the scene can have"),
        ('[{"number": 0, "x1": 1, "y1": 2, "x2": [3], "y2": 4}]', r"x2: \[3\]; expected a number"),
        ("number,x1,y1,x2,y2," + "a" * 200_000, "is no CSV: field larger"),
    ]:
        with pytest.raises(DataError, match=problem):
            read(tmp_path, text)
