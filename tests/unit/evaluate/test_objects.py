"""Objects from scenes, fused detections and KITTI's labels, against each other and the development kit's corners."""

import json
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.errors import ArrayError, DataError, OptionError
from sceneloom.evaluate.detection import compare_detections
from sceneloom.evaluate.object_files import labelled_times, scene_objects
from sceneloom.evaluate.objects import FramePairs, ObjectTable, Similarity, similarities
from sceneloom.evaluate.tracking import compare_tracks
from sceneloom.formats.kitti.labels import KittiLabels
from sceneloom.scene import AttributePath, CuboidAnnotation, CuboidPath, Scene

SECOND = 1_000_000_000


def cuboid(identifier, label, x, yaw_deg=0.0, **fields) -> CuboidAnnotation:
    """A box of 4 x 2 x 1.5 m that goes 10 m along x in 10 s, with a timestamp at either end."""
    rows = np.array([[4, 2, 1.5, x, 0, 0, 0, 0, yaw_deg], [4, 2, 1.5, x + 10, 0, 0, 0, 0, yaw_deg]], float)
    return CuboidAnnotation(identifier, CuboidPath(np.array([0, 10 * SECOND]), rows), label=label, **fields)


def scene(*cuboids: CuboidAnnotation) -> Scene:
    return Scene((), annotations=cuboids)


def test_cuboids_are_rows_at_every_time_and_scores_hold_until_the_next():
    rotated = cuboid("a", "car", 5, yaw_deg=90)
    table = scene_objects(scene(rotated, cuboid("b", None, 50)), np.arange(0, 30, 5) * SECOND)
    assert table.frames.tolist() == [0, 0, 1, 1, 2, 2]
    assert table.labels[:2] == ("car", "object")
    np.testing.assert_allclose(table.boxes[2], [10, 0, 0, 4, 2, 1.5, np.pi / 2], atol=1e-12)
    assert table.scores is None
    assert labelled_times(scene(rotated)).tolist() == [0, 10 * SECOND]
    # they are one where nothing is stated
    stated = AttributePath("existence", (0.2, 0.8), np.array([0, 5 * SECOND]))
    table = scene_objects(
        scene(cuboid("a", "car", 0, attributes=(stated,)), cuboid("b", "car", 30)), np.array([0, 4, 6]) * SECOND
    )
    assert table.scores[table.ids == 0].tolist() == [0.2, 0.2, 0.8]
    assert table.scores[table.ids == 1].tolist() == [1, 1, 1]
    with pytest.raises(OptionError, match="no cuboids"):
        scene_objects(scene(), np.zeros(1, np.int64))


def test_tracks_of_scenes_are_compared_in_space_and_all_their_classes(tmp_path: Path):
    true = scene(cuboid("a", "TRUCK", 0), cuboid("b", "BUS", 40))
    found = scene(cuboid("x", "truck", 1), cuboid("y", "bus", 80))
    for name, one in (("true", true), ("found", found)):
        sceneloom.write(one, tmp_path / f"{name}.sfs")
    reported = compare_tracks(tmp_path / "found.sfs", tmp_path / "true.sfs")
    assert (reported.similarity, sorted(reported.classes)) == ("3d", ["bus", "truck"])
    assert reported.classes["truck"].combined.clear.motp == pytest.approx(3 / 5)
    assert reported.classes["bus"].combined.clear.mota == -1.0
    with pytest.raises(OptionError, match="similarity '2d': one side has no such boxes; comparable: bev, 3d, distance"):
        compare_tracks(tmp_path / "found.sfs", tmp_path / "true.sfs", similarity="2d")
    with pytest.raises(OptionError, match="similarity 'near'; expected one of 2d, bev, 3d, distance"):
        compare_tracks(tmp_path / "found.sfs", tmp_path / "true.sfs", similarity="near")
    with pytest.raises(OptionError, match="no scores"):
        compare_detections(tmp_path / "found.sfs", tmp_path / "true.sfs")
    with pytest.raises(OptionError, match="expected two scenes, or KITTI's text on both sides"):
        (tmp_path / "0000.txt").write_text("")
        compare_tracks(tmp_path / "0000.txt", tmp_path / "true.sfs")


CALIBRATION = """P0: 700 0 600 0 0 700 180 0 0 0 1 0
P1: 700 0 600 0 0 700 180 0 0 0 1 0
P2: 700 0 600 0 0 700 180 0 0 0 1 0
P3: 700 0 600 0 0 700 180 0 0 0 1 0
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0
"""
"""The camera stands where the lidar does, and looks along its x axis."""


def fused_line(cloud: int, x: float, confidence: float) -> str:
    """A car of 4 x 2 x 1.5 m that heads along the lidar's x axis, x known to 0.1 m, y to 0.2 m."""
    car = {"id": 0, "confidence": confidence, "timestamp": f"{cloud / 10:.9f}", "class": "Car", "velocity": 0.0}
    car |= {"X": x, "Y": 2.0, "Z": 0.0, "direction": [1.0, 0.0, 0.0], "length": 4.0, "width": 2.0, "height": 1.5}
    car |= {"x1": 100, "y1": 100, "x2": 200, "y2": 180}
    car |= {name: np.diag([0.01, y, 0.01]).ravel().tolist() for name, y in (("center_cov", 0.04), ("size_cov", 0.01))}
    head = {"image_seq": cloud, "points_seq": cloud, "camera_id": 1, "lidar_id": 0, "timestamp": car["timestamp"]}
    return json.dumps({"detections": {**head, "detections": [car]}})


@pytest.fixture
def fused(tmp_path: Path) -> tuple[Path, Path]:
    """Cars 20 m ahead in three sweeps, found 0.1, 0.2 and 0.1 m too far; where sensors were is reported beside."""
    results, truth = tmp_path / "fused", tmp_path / "kitti"
    for folder in (results, truth / "label_02", truth / "calib"):
        folder.mkdir(parents=True)
    lines = [fused_line(k, x, 0.9) for k, x in enumerate((20.1, 20.2, 20.1))]
    (results / "0000.jsonl").write_text("\n".join(lines) + "\n")
    (results / "0000.frames.jsonl").write_text("{}\n")
    (truth / "calib" / "0000.txt").write_text(CALIBRATION)
    # middle at x 20, y 2, z 0 of the lidar: right -2, down 0.75 at its bottom, ahead 20; it heads along the view
    label = "0 0 Car 0 0 -10 99.5 99.5 199.5 179.5 1.5 2 4 -2 0.75 20 -1.5707963267948966"
    labels = [f"{frame}{label[1:]}" for frame in range(3)]
    (truth / "label_02" / "0000.txt").write_text("\n".join(labels) + "\n")
    return results, truth


def test_fused_detections_are_compared_in_the_lidars_frame_with_their_covariances(fused: tuple[Path, Path]):
    reported = compare_detections(*fused, classes=("car",))
    assert [one.similarity for one in reported.classes["car"]] == ["2d", "bev", "3d"]
    for one in reported.classes["car"]:
        scores = one.difficulties["easy"]
        assert (scores.max_f1, scores.true_objects) == (1.0, 3)
        # records have 32 bits
        assert scores.calibration.error == pytest.approx(0.1, abs=1e-6)
    judged = reported.classes["car"][0].covariances
    assert set(judged) == {"center", "size"}
    assert judged["center"].nees == pytest.approx((1 + 4 + 1) / 3, rel=1e-4)
    assert judged["size"].nees == pytest.approx(0, abs=1e-9)
    assert reported.classes["car"][0].headings_reversed == 0.0


def test_what_is_wrong_with_detections_and_what_is_no_text_of_kitti_is_named(fused: tuple[Path, Path], tmp_path: Path):
    results, truth = fused
    for name, content in (("noise", b"\x8f\xff\x00 7\n"), ("numbers", b"49.01 8.4 112.8\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "0000.txt").write_bytes(content)
        with pytest.raises(DataError, match=f"{name}/0000.txt"):
            compare_detections(tmp_path / name, truth)
    (tmp_path / "empty").mkdir()
    with pytest.raises(OptionError, match="is taken for a scene"):
        compare_detections(tmp_path / "empty", truth)
    with pytest.raises(OptionError, match="has no truth"):
        compare_detections(truth, results)
    for text, stated in (
        ('{"detections": ]\n', "0000.jsonl: line 1"),
        (f"{fused_line(1, 9, 0.5)}\n" * 2, "line 2: cloud 1 comes twice"),
        (f"{fused_line(1, 9, 0.5)}\n", "calib"),
    ):
        (results / "0000.jsonl").write_text(text)
        if stated == "calib":
            (truth / "calib" / "0000.txt").unlink()
        with pytest.raises(DataError, match=stated):
            compare_detections(*fused)


def labels(rng: np.random.Generator, count: int) -> KittiLabels:
    numbers, none, corners = np.arange(count), np.zeros(count), np.zeros((count, 4))
    sizes_hwl, bottoms = rng.uniform(1, 5, (count, 3)), rng.normal((0, 1.6, 20), 1.5, (count, 3))
    boxes = corners, sizes_hwl, bottoms, rng.uniform(-np.pi, np.pi, count)
    return KittiLabels(0 * numbers, numbers, ("Car",) * count, none, 0 * numbers, none, *boxes)


def ground(of: KittiLabels, k: int):
    """The footprint in the camera's x and z, as the development kit draws boxes (computeBox3D)."""
    _, width, length = of.sizes_hwl[k]
    x = np.array([1, 1, -1, -1]) * length / 2
    z = np.array([1, -1, -1, 1]) * width / 2
    cosine, sine = np.cos(of.rotations_y[k]), np.sin(of.rotations_y[k])
    shapely = pytest.importorskip("shapely", reason="no shapely: pip install shapely")
    return shapely.Polygon(np.column_stack([cosine * x + sine * z, -sine * x + cosine * z]) + of.bottoms[k, [0, 2]])


def test_boxes_of_kitti_overlap_as_their_corners_in_the_camera_do_and_columns_are_checked_and_joined():
    rng = np.random.default_rng(1)
    first, second = labels(rng, 12), labels(rng, 15)
    tables = ObjectTable.of_kitti(first), ObjectTable.of_kitti(second)
    pairs = FramePairs.of(*(table.frame_starts(1) for table in tables))
    above = similarities(*tables, pairs, Similarity.ABOVE).reshape(12, 15)
    space = similarities(*tables, pairs, Similarity.SPACE).reshape(12, 15)
    for i in range(12):
        for j in range(15):
            one, other = ground(first, i), ground(second, j)
            common = one.intersection(other).area
            assert above[i, j] == pytest.approx(common / (one.area + other.area - common), abs=1e-9)
            # the camera's y points down: a box reaches from its bottom to bottom - height
            bottoms, heights = (
                (first.bottoms[i, 1], second.bottoms[j, 1]),
                (first.sizes_hwl[i, 0], second.sizes_hwl[j, 0]),
            )
            high = min(bottoms) - max(bottom - height for bottom, height in zip(bottoms, heights, strict=True))
            room = common * max(high, 0)
            both = one.area * heights[0] + other.area * heights[1] - room
            assert space[i, j] == pytest.approx(room / both, abs=1e-9)
    frames, ids = np.zeros(2, np.int64), np.zeros(2, np.int64)
    with pytest.raises(ArrayError, match=r"objects.labels: 1; expected 2"):
        ObjectTable(frames, ids, ("car",))
    with pytest.raises(ArrayError, match=r"objects.boxes: \(2, 6\)"):
        ObjectTable(frames, ids, ("car", "car"), boxes=np.zeros((2, 6)))
    with pytest.raises(ArrayError, match=r"objects.ids"):
        ObjectTable(frames, np.zeros(3, np.int64), ("car", "car"))
    table = ObjectTable(np.zeros(1, np.int64), np.zeros(1, np.int64), ("car",), np.zeros((1, 4)))
    with pytest.raises(ValueError, match="read-only"):
        table.corners_xyxy[0, 0] = 1.0
    one = ObjectTable(np.zeros(1, np.int64), np.zeros(1, np.int64), ("car",), np.zeros((1, 4)), scores=np.ones(1))
    other = ObjectTable(np.ones(1, np.int64), np.zeros(1, np.int64), ("bus",), np.zeros((1, 4)))
    joined = ObjectTable.joined([one, ObjectTable.empty(), other])
    assert (joined.frames.tolist(), joined.labels) == ([0, 1], ("car", "bus"))
    assert joined.corners_xyxy is not None
    assert joined.scores is None
