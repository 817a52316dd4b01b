"""Files of labelling tools in the hands of others: Datumaro, pycocotools, and the SDK of Label Studio.

`SCENELOOM_DATUMARO_PYTHON` names a Python with `datumaro` and `pycocotools`, `SCENELOOM_LABEL_STUDIO_PYTHON` one with
`label-studio-sdk`. The real files are exports of these tools, with what their READMEs and elements state.
"""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tests.peers import python_with
from tests.unit.formats.labelling.test_round_trips import TIMES, by_id, scene_of

from sceneloom import scene as sc
from sceneloom.formats.base.masks import MASKS, Mask
from sceneloom.formats.base.registry import open_scene, write_scene
from sceneloom.formats.labelling.drawn import RBBOX
from sceneloom.formats.labelling.label_studio import unpacked_brush
from sceneloom.scene import annotations_at as at

PROGRAMS = Path(__file__).parent / "programs"
LIMIT_S = 300
PX = 0.01
MASK = [30, 10, 49, 29, 300]  # first and last columns and rows of the mask, and how many pixels it has


def asked(interpreter, program, *arguments):
    command = [interpreter, str(PROGRAMS / program), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def datumaro():
    return python_with("datumaro", "SCENELOOM_DATUMARO_PYTHON")


def boxes_of(scene, identifier, name):
    """The box of a track at an image, as edges; None where it has none."""
    k = TIMES.tolist().index(int(Path(name).name))
    for one in scene.annotations:
        if isinstance(one, sc.Box2DAnnotation) and one.id in (identifier, f"{identifier}:box", f"{identifier}:box:2"):
            rows, there = at.box_2d_at(one, TIMES[k : k + 1])
            if there[0]:
                return np.concatenate([rows[0, :2], rows[0, :2] + rows[0, 2:]])
    return None


@pytest.mark.parametrize(
    ("form", "options"), [("cvat", {"task": "images"}), ("coco", {}), ("datumaro", {})], ids=lambda one: str(one)[:8]
)
def test_datumaro_sees_each_box_area_and_mask_where_the_scene_has_it(datumaro, form, options, tmp_path):
    scene = scene_of("boxes", "areas", "rotated", "masks")
    write_scene(scene, tmp_path / "out", format=form, **options)
    items = asked(datumaro, "labels_datumaro.py", "read", tmp_path / "out", form)
    assert sorted(int(Path(item["id"]).name) for item in items) == TIMES.tolist()
    seen = {"bbox": 0, "mask": 0, "area": 0}
    for item in items:
        for one in item["annotations"]:
            track = one["attributes"].get("track_id")
            if one["type"] == "bbox":
                expected = boxes_of(scene, int(track) if str(track) == "7" else track, item["id"])
                if expected is None:  # what a mask or outline covers
                    assert track in (3, "r", "m")
                    continue
                np.testing.assert_allclose(one["points"], expected, atol=PX)
                seen["bbox"] += 1
            elif one["type"] == "mask":
                assert (one["mask"], one["label"]) == (MASK, "tree")
                seen["mask"] += 1
            elif one["type"] == "rotated_bbox":
                row = by_id(scene)["r"].path.extras[RBBOX][TIMES.tolist().index(int(Path(item["id"]).name))]
                np.testing.assert_allclose(one["points"], [*row[:4], np.degrees(row[4])], atol=PX)
                seen["area"] += 1
            elif one["type"] == "polygon" and one["label"] == "road":
                shape = by_id(scene)[3]
                vertices = shape.path.vertices[TIMES.tolist().index(int(Path(item["id"]).name))]
                np.testing.assert_allclose(one["points"], vertices.reshape(-1), atol=PX)
                seen["area"] += 1
    # of COCO, Datumaro also takes the boxes of masks
    assert seen == {"bbox": 11 if form == "coco" else 10, "mask": 1, "area": 4 if form == "cvat" else 2}


def test_datumaro_sees_tracks_of_videos_and_cuboids_of_tracklets_and_its_own_json(datumaro, tmp_path):
    scene = scene_of("boxes", "cuboids")
    write_scene(scene, tmp_path / "video", format="cvat", task="video")
    items = asked(datumaro, "labels_datumaro.py", "read", tmp_path / "video", "cvat")
    shown = [
        (one["attributes"]["track_id"], item["attributes"]["frame"])
        for item in items
        for one in item["annotations"]
        if not one["attributes"]["outside"]
    ]
    assert sorted(shown) == [(0, 0), (0, 1), (0, 4), (0, 5), *((7, k) for k in range(6))]
    poses = at.cuboid_poses(by_id(scene)[11], TIMES)
    write_scene(scene_of("cuboids"), tmp_path / "tracklet_labels.xml", format="tracklets")
    write_scene(scene_of("cuboids"), tmp_path / "json", format="datumaro", images="none")
    for path, form in ((tmp_path, "kitti_raw"), (tmp_path / "json", "datumaro")):
        items = asked(datumaro, "labels_datumaro.py", "read", path, form)
        rows = [one for item in items for one in item["annotations"] if one["type"] == "cuboid_3d"]
        assert len(rows) == 6
        for k, row in enumerate(rows):
            np.testing.assert_allclose(row["position"], poses.centers_world[k], atol=1e-3)
            np.testing.assert_allclose(row["scale"], [4, 2, 1.5], atol=1e-3)


@pytest.mark.parametrize("form", ["cvat", "coco", "datumaro", "yolo", "kitti_raw"])
def test_what_datumaro_writes_is_read_where_it_says(datumaro, form, tmp_path):
    items = asked(datumaro, "labels_datumaro.py", "write", tmp_path / "set", form)
    path = tmp_path / "set" / "tracklet_labels.xml" if form == "kitti_raw" else tmp_path / "set"
    with open_scene(path) as scene:
        assert [len(camera.images) for camera in scene.cameras] == ([] if form == "kitti_raw" else [3])
        times = (scene.cameras[0].images.timestamps_ns if scene.cameras else np.arange(3) * 100_000_000).tolist()
        found = {name: [] for name in ("bbox", "polygon", "mask", "points", "cuboid_3d")}
        for k in range(3):
            for one in scene.annotations:
                if isinstance(one, sc.Box2DAnnotation) and MASKS in one.path.extras:
                    if times[k] in one.path.timestamps_ns:
                        mask = Mask.of_record(one.path.extras[MASKS][0])
                        columns, rows = mask.pixels()
                        found["mask"].append([columns.min(), rows.min(), columns.max(), rows.max(), len(rows)])
                elif isinstance(one, sc.Box2DAnnotation):
                    rows, there = at.box_2d_at(one, times[k : k + 1])
                    found["bbox"] += [[*rows[0, :2], *(rows[0, :2] + rows[0, 2:])]] if there[0] else []
                elif isinstance(one, sc.ShapeAnnotation):
                    shown = at.shape_at(one, times[k : k + 1])[0]
                    found["polygon"] += [] if shown is None else [shown.reshape(-1)]
                elif isinstance(one, sc.PointsAnnotation):
                    seen = [row[0].points[row[0].timestamps_ns == times[k]] for row in one.projections]
                    found["points"] += [np.concatenate(seen).reshape(-1)] if len(seen[0]) else []
                elif isinstance(one, sc.CuboidAnnotation):
                    poses = at.cuboid_poses(one, times[k : k + 1])
                    row = [*poses.centers_world[0], *poses.sizes_lwh[0], *poses.quaternions_xyzw[0]]
                    found["cuboid_3d"] += [row] if poses.there[0] else []
    expected = {name: [] for name in found}
    for item in items:
        for one in item["annotations"]:
            if one["type"] == "cuboid_3d":
                half = one["rotation"][2] / 2
                row = [*one["position"], *one["scale"], 0, 0, np.sin(half), np.cos(half)]
            else:
                row = one.get("mask", one.get("points"))
            expected[one["type"]].append(row)
    assert sum(map(len, expected.values())) >= 3
    for name, rows in expected.items():
        np.testing.assert_allclose(np.array(found[name], float), np.array(rows, float), atol=PX)


def test_pycocotools_finds_boxes_masks_and_keypoints_where_the_scene_has_them(datumaro, tmp_path):
    scene = scene_of("boxes", "areas", "rotated", "masks", "keypoints")
    write_scene(scene, tmp_path / "a.coco.json")
    rows = asked(datumaro, "labels_pycocotools.py", tmp_path / "a.coco.json")
    assert len(rows) == 6 + 4 + 2 + 2 + 1 + 2
    assert [row["mask"] for row in rows if "mask" in row] == [MASK]
    # whole pixels of a quadrangle of 492.5, and of boxes of 72
    assert [round(row["pixels"] / 10) for row in rows if "pixels" in row] == [49, 7, 49, 7]
    assert [row["keypoints"] for row in rows if "keypoints" in row] == [[10, 12, 2, 20.25, 22, 2], [11, 12, 1, 0, 0, 0]]
    for row in rows:
        if row["attributes"].get("track_id") == 7:
            left, top, right, bottom = boxes_of(scene, 7, Path(row["image"]).stem)
            np.testing.assert_allclose(row["box"], [left, top, right - left, bottom - top], atol=PX)


def test_the_sdk_of_label_studio_unpacks_our_brushes_and_videos_and_we_its_brush(tmp_path):
    interpreter = python_with("label-studio-sdk", "SCENELOOM_LABEL_STUDIO_PYTHON")
    scene = scene_of("boxes", "masks")
    write_scene(scene, tmp_path / "a.label-studio.json")
    write_scene(scene, tmp_path / "v.label-studio.json", task="video")
    found = asked(interpreter, "labels_label_studio.py", *sorted(tmp_path.glob("*.json")))
    assert found["masks"] == {"m": MASK}
    assert {name: sorted(map(int, rows)) for name, rows in found["videos"].items()} == {
        "7": [1, 2, 3, 4, 5, 6],
        "b-2": [1, 2, 5, 6],
    }
    for number, row in found["videos"]["7"].items():
        left, top, right, bottom = boxes_of(scene, 7, str(TIMES[int(number) - 1]))
        np.testing.assert_allclose(row, [left, top, right - left, bottom - top], atol=PX)
    mask = unpacked_brush(bytes(found["brush"]), 48, 64)
    assert (mask.area, mask.box().tolist()) == (15 * 23 - 2 * 6, [7, 5, 23, 15])


STRANGERS = {
    "cvat/alert_images_points.xml": {"object": 19, "points": 19},
    "datumaro/cvat_for_images.xml": {"box_2d": 1, "polyline_2d": 1, "polygon_2d": 1, "object": 3, "points": 3},
    "datumaro/cvat_for_video.xml": {"box_2d": 1, "polyline_2d": 1, "object": 2, "points": 2},
    "datumaro/kitti_raw/tracklet_labels.xml": {"cuboid": 3},
    "datumaro/coco/instances_val.json": {"polygon_2d": 1, "box_2d": 1},
    "datumaro/coco/person_keypoints_val.json": {"object": 2, "polygon_2d": 1, "box_2d": 1, "points": 2},
    "datumaro/datumaro_diverse": {"event": 5, "box_2d": 4, "object": 1, "points": 1},
    "datumaro/datumaro_skeleton": {"object": 1, "points": 1},
    "datumaro/datumaro_with_pcd": {"cuboid": 1},
    "label_studio/export_boxes.json": {"box_2d": 6},
    "label_studio/export_keypoints.json": {"object": 1, "box_2d": 1, "points": 1},
    "label_studio/export_coco_input.json": {"box_2d": 1, "polygon_2d": 1, "point_2d": 2},
}


@pytest.mark.parametrize("name", STRANGERS)
def test_files_of_others_hold_what_their_elements_state(name, data_dir, tmp_path):
    path = data_dir / "real" / "strangers" / name
    if not path.exists():
        pytest.skip(f"no {path}")
    with open_scene(path) as scene:
        kinds = [str(one.type) for one in scene.annotations]
        assert {kind: kinds.count(kind) for kind in kinds} == STRANGERS[name]
        write_scene(scene, tmp_path / "a.sfs")
        form = scene.format
        again = tmp_path / ("a.xml" if form in ("cvat", "tracklets") else "a.json")
        write_scene(scene, again, format=form)
        before = {key: (one.type, getattr(one, "label", None)) for key, one in by_id(scene).items()}
    with open_scene(again) as once:
        after = {key: (one.type, getattr(one, "label", None)) for key, one in by_id(once).items()}
    assert after.keys() == before.keys()
    assert after == before


def test_the_boxes_of_a_video_and_of_an_export_are_where_the_files_have_them(data_dir):
    folder = data_dir / "real" / "strangers"
    if not folder.exists():
        pytest.skip(f"no {folder}")
    with open_scene(folder / "datumaro" / "cvat_for_video.xml", rate_hz=1) as scene:
        (box,) = [one for one in scene.annotations if isinstance(one, sc.Box2DAnnotation)]
        assert (box.id, box.label, box.path.values.tolist()) == (0, "II", [[3, 4, 7, 1]])
        assert box.path.timestamps_ns.tolist() == [10 * 10**9]
    with open_scene(folder / "label_studio" / "export_keypoints.json") as scene:
        box = by_id(scene)["hplPm0Szvc:box"]
        np.testing.assert_allclose(box.path.values[0] / [2.16, 1.74, 2.16, 1.74],
            [38.849487785658, 7.65957446808511, 47.304964539007095, 50.92198581560283])  # fmt: skip
        assert by_id(scene)["hplPm0Szvc:points"].labels == ("nose", "left_eye", "right_eye")
