"""`sceneloom fuse`: its algorithms, and the fusion of detections."""

import json
import pickle
import re
import shutil
from dataclasses import fields, replace

import numpy as np
import pytest
from tests.unit.cli.conftest import write_boxes

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.colouring import fuse_by_projection
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.json import format_json, parse_json
from sceneloom.db34t.scene_objects import boxes_2d_record
from sceneloom.detections.detectors import FOLDER
from sceneloom.errors import ArrayError, OptionError
from sceneloom.formats.kitti.labels import read_labels
from sceneloom.fusion import FusionConfiguration
from sceneloom.fusion.algorithms import FusionType, chosen_algorithm
from sceneloom.pipeline.tracking import TrackingSettings
from sceneloom.scene.scene import time_span
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, detect_2d, detect_3d, simulate_street

FILE = """
from dataclasses import replace
import numpy as np
import helper_beside
from sceneloom.colouring import fuse_by_projection

def red(points_world, requests, visibility, *, trajectory=None):
    found = fuse_by_projection(points_world, requests, visibility, trajectory=trajectory)
    seen = found.camera_index < 255
    return replace(found, colors=np.where(seen[:, None], helper_beside.RED, found.colors))

def short(points_world):
    return None

def boxes(pair):
    return None

number = 7
"""


@pytest.fixture(scope="module")
def drive():
    return sceneloom.simulate_street(3, frames=2).scene


@pytest.fixture
def file(tmp_path):
    (tmp_path / "helper_beside.py").write_text("import numpy\nRED = numpy.uint8([255, 0, 0])\n", "utf-8")
    path = tmp_path / "mine.py"
    path.write_text(FILE, "utf-8")
    return path


def colours_of(path):
    with sceneloom.open(path) as scene:
        points = [frame.points for lidar in scene.lidars for frame in lidar.frames]
        return np.unique(np.concatenate([p.colors[p.camera_index < 255] for p in points]), axis=0).tolist()


def changing(change):
    def function(points_world, requests, visibility, *, trajectory=None):
        return change(fuse_by_projection(points_world, requests, visibility, trajectory=trajectory))

    return function


def green(found):
    return replace(found, colors=np.where(found.camera_index[:, None] < 255, np.uint8([0, 255, 0]), found.colors))


def test_a_function_or_one_of_a_file_fuses(call, drive, recording, tmp_path, file):
    report = sceneloom.fuse(drive, tmp_path / "green.sfs", algorithm=changing(green))
    assert (report.fused, report.coloured_percent > 0) == (2, True)
    sceneloom.fuse(drive, tmp_path / "a.sfs", algorithm=f"{file}:red")
    done = call("fuse", recording, "-o", tmp_path / "b.sfs", "--algorithm", f"{file}:red", "--quiet")
    assert (done.code, done.err) == (0, "")
    found = [colours_of(tmp_path / f"{name}.sfs") for name in ("green", "a", "b")]
    assert found == [[[0, 255, 0]], [[255, 0, 0]], [[255, 0, 0]]]
    configuration = FusionConfiguration(fusion_algorithm=f"{file}:red")
    found = list(sceneloom.iter_fused(drive, configuration=configuration))
    assert len(found) == 2
    assert {tuple(c) for c in found[0].points.colors[found[0].points.camera_index < 255].tolist()} == {(255, 0, 0)}
    chosen = chosen_algorithm(FusionType.SENSOR_DATA, f"{file}:red")
    assert pickle.loads(pickle.dumps(chosen)) == chosen, "other processes find it"


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ("MV3d", "there are projection.*trained network"),
        ("{file}:nothing", r"no function 'nothing' in the file; it has boxes, red, short"),
        ("{file}:number", "number is a int; expected a function"),
        ("{file}:short", r"expected a function \(points_world, requests, visibility, \*, trajectory=None\)"),
        ("{file}x/none.py:red", "no such file; expected FILE.py:FUNCTION"),
        ("{broken}:red", "it cannot be loaded: ZeroDivisionError: division by zero"),
        ("{leaving}:red", "it cannot be loaded: SystemExit: 3"),
        ("{file}", "no function is named; expected FILE.py:FUNCTION"),
        ("{file}:", "no function is named; expected FILE.py:FUNCTION"),
    ],
)
def test_what_cannot_be_an_algorithm_is_named_as_bad_usage(refuses, recording, tmp_path, file, chosen, message):
    broken, leaving = tmp_path / "broken.py", tmp_path / "leaving.py"
    broken.write_text("1 / 0\n", "utf-8")
    leaving.write_text("raise SystemExit(3)\n", "utf-8")
    stated = chosen.format(file=file, broken=broken, leaving=leaving)
    done = refuses(2, "", "fuse", recording, "-o", tmp_path / "a.sfs", "--algorithm", stated)
    assert re.search(message, done.err), done.err
    assert ("Traceback" in done.err, (tmp_path / "a.sfs").exists()) == (False, False)


def raising(points_world, requests, visibility, *, trajectory=None):
    return points_world["no such"]


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (raising, OptionError, r"algorithm raising: IndexError: .*test_fuse.py, line \d+"),
        (changing(lambda found: None), OptionError, "returned a NoneType; expected sceneloom.colouring.ColouredPoints"),
        (changing(lambda found: replace(found, colors=found.colors[1:])), ArrayError, r"algorithm function: colors"),
        (changing(lambda found: replace(found, views=())), OptionError, r"0 views of \d images; expected one of each"),
        (7, OptionError, "algorithm 7: a int; expected a function"),
        (lambda points: None, OptionError, "expected a function"),
    ],
)
def test_a_function_that_does_not_do_its_part_is_named(drive, tmp_path, function, error, message):
    with pytest.raises(error, match=message):
        sceneloom.fuse(drive, tmp_path / "a.sfs", algorithm=function)
    assert not (tmp_path / "a.sfs").exists()


def test_detection_fusion_takes_functions_of_one_pair_and_a_client_names_no_file(tmp_path, file):
    chosen = chosen_algorithm(FusionType.DETECTIONS, lambda pair: None)
    with pytest.raises(OptionError, match=r"returned a NoneType; expected sceneloom.detections.FusedBoxes"):
        chosen(None)
    with pytest.raises(OptionError, match=r"expected a function \(pair\)"):
        chosen_algorithm(FusionType.DETECTIONS, lambda: None)
    assert "algorithm" in {field.name for field in fields(TrackingSettings)}
    # a client of the service cannot have a file executed
    marker = tmp_path / "executed"
    file.write_text(f"open({str(marker)!r}, 'w')\n", "utf-8")
    with FusionInterface(inline=True) as interface:
        assert not interface.set_property("fusion_algorithm", f"{file}:red")
    assert not marker.exists()


@pytest.fixture(scope="module")
def detected(tmp_path_factory):
    """Three sweeps with what detectors found in them, as lines of JSON."""
    folder = tmp_path_factory.mktemp("drive")
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    drive = simulate_street(1, frames=3, lidar=LidarSpec(beams=16, steps=240), cameras=(camera,))
    sceneloom.write(drive.scene, folder / "recording", images="png")
    write_boxes(drive, folder)
    return folder, *([report.boxes for report in reports] for reports in (detect_3d(drive), detect_2d(drive)))


@pytest.fixture
def folder(detected):
    return detected[0]


@pytest.fixture
def files(folder):
    return ("--boxes3d", folder / "boxes3d.jsonl", "--boxes2d", folder / "boxes2d.jsonl")


@pytest.fixture
def kitti(tmp_path):
    """A folder laid out like KITTI's tracking benchmark: two frames, people in sweeps and cars in images."""
    texts = {
        "calib": "P2: 700 0 600 0 0 700 180 0 0 0 1 0\nR_rect 1 0 0 0 1 0 0 0 1\n"
        "Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0\nTr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0\n",
        "oxts": ("0 0" + " 0" * 28 + "\n") * 2,
        "det2d_a/Car": "1,10,20,110,220,0.75\n",
        "det3d_b/Pedestrian": "0,1,0,0,9,9,2.0,1.8,0.6,0.8,-1.0,1.5,8.0,0.0,0.2\n",
    }
    for name, text in texts.items():
        (folder := tmp_path / "kitti" / name).mkdir(parents=True)
        (folder / "0001.txt").write_text(text)
    return tmp_path / "kitti"


def test_objects_of_a_drive_are_records_of_table_10(reported, detected, files, tmp_path):
    folder, in_space, in_images = detected
    out = tmp_path / "objects.jsonl"
    report = reported("fuse", folder / "recording", "--type", "detection", *files, "-o", out)["drives"][0]
    records = [parse_json(line) for line in out.read_text().splitlines()]
    sides = [json.loads(line) for line in (tmp_path / "objects.frames.jsonl").read_text().splitlines()]
    assert len(records) == len(sides) == len(in_space)
    for record, boxes, seen in zip(records, in_space, in_images, strict=True):
        assert record.timestamp.nanoseconds == boxes.timestamp_ns
        # each box is in one object, and no object is of none
        assert sorted(n for n in record.box_3d_ids if n is not None) == list(range(len(boxes)))
        assert sorted(n for n in record.box_2d_ids if n is not None) == list(range(len(seen)))
        assert all(pair != (None, None) for pair in zip(record.box_3d_ids, record.box_2d_ids, strict=True))
    assert report["objects"] == sum(map(len, records))
    assert report["both"] == sum(
        None not in pair for r in records for pair in zip(r.box_3d_ids, r.box_2d_ids, strict=True)
    )


@pytest.mark.usefixtures("inline")
def test_lines_of_a_batch_name_the_boxes_and_detectors_of_their_drives(call, succeeds, folder, tmp_path):
    (tmp_path / "mine.toml").write_text((FOLDER / "simulated.toml").read_text())
    line = {
        "path": str(folder / "recording"),
        "boxes3d": str(folder / "boxes3d.jsonl"),
        "detectors": "mine.toml",
        "truth": "truth.tum",
    }
    (tmp_path / "list").write_text(json.dumps(line))
    seen = ("--boxes2d", folder / "boxes2d.jsonl")
    how = ("--type", "detection", *seen, "--suffix", ".jsonl", "--workers", 1)
    done = succeeds("batch fuse --list", tmp_path / "list", *how, "-o", tmp_path / "out")
    assert "not read by fuse: what the lists state for --truth\n" in done.err
    files = ("--boxes3d", folder / "boxes3d.jsonl", *seen)
    call("fuse", folder / "recording", "--type", "detection", *files, "-o", tmp_path / "alone.jsonl")
    assert (tmp_path / "out" / "recording.jsonl").read_bytes() == (tmp_path / "alone.jsonl").read_bytes()


@pytest.mark.parametrize("numbered", [False, True], ids=["by times", "by numbers of frames"])
def test_a_part_of_a_drive_has_the_boxes_of_its_time(succeeds, reported, detected, tmp_path, numbered):
    folder, _, in_images = detected
    seen = folder / "boxes2d.jsonl"
    if numbered:
        (seen := tmp_path / "car" / "seen.txt").parent.mkdir()
        rows = [(k, *corners, 0.9) for k, boxes in enumerate(in_images) for corners in boxes.corners_xyxy.tolist()]
        seen.write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    files = ("--boxes3d", folder / "boxes3d.jsonl", "--boxes2d", seen)
    with sceneloom.open(folder / "recording") as scene:
        start = (scene.lidars[0].frames.timestamps_ns[1] - time_span(scene)[0]) / 1e9
    records = []
    for name, part in (("whole", ()), ("part", ("--start", start, "--stop", start + 0.1))):
        out = tmp_path / f"{name}.jsonl"
        succeeds("fuse", folder / "recording", "--type", "detection", *files, "-o", out, *part)
        records.append([parse_json(line) for line in out.read_text().splitlines()])
    (_, second, _), (one,) = records
    assert (one.timestamp, one.box_2d_ids) == (second.timestamp, second.box_2d_ids)
    assert any(number is not None for number in one.box_2d_ids)
    tracked = ("track", folder / "recording", *files, "-o", tmp_path / "t.jsonl", "--start", start)
    assert reported(*tracked)["drives"][0]["frames"] == 2


def test_what_was_fused_is_tracked_as_if_at_once_and_done_whole(refuses, succeeds, folder, files, tmp_path):
    recording, objects = folder / "recording", tmp_path / "objects.jsonl"
    succeeds("fuse", recording, "--type", "detection", *files, "-o", objects)
    refuses(2, "done whole", "track", objects, "-o", tmp_path / "a.jsonl", "--start", 1)
    succeeds("track", objects, "-o", tmp_path / "a.jsonl")
    succeeds("track", recording, *files, "-o", tmp_path / "b.jsonl")
    one, other = (
        [(k, each) for k, line in enumerate(path.read_text().splitlines()) for each in json.loads(line)["objects"]]
        for path in (tmp_path / "a.jsonl", tmp_path / "b.jsonl")
    )
    assert one
    for (k, a), (n, b) in zip(one, other, strict=True):
        assert (k, a["id"], a["class"]) == (n, b["id"], b["class"])
        # 0.4 m: 1 % of the distance, as boxes of some 50 px get whole pixels on the way through the file
        np.testing.assert_allclose(a["center"], b["center"], atol=0.4)
    # the tracker takes the detectors for what they are said to be
    succeeds("track", objects, "--detectors", "kitti_rrc_pointrcnn", "-o", tmp_path / "k.jsonl")
    assert (tmp_path / "k.jsonl").read_text() != (tmp_path / "a.jsonl").read_text()
    for name in ("boxes3d", "boxes2d"):  # one detector is enough
        succeeds("track", recording, f"--{name}", folder / f"{name}.jsonl", "-o", tmp_path / f"{name}.sfs")
    (tmp_path / "objects.frames.jsonl").unlink()
    refuses(1, "objects.frames.jsonl: is missing", "track", objects, "-o", tmp_path / "c.jsonl")


def test_records_name_their_camera_or_the_command_does(call, tmp_path):
    camera = Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5)
    cameras = (CameraSpec(camera), CameraSpec(camera, camera_mount(yaw_deg=60.0)))
    drive = simulate_street(1, frames=2, lidar=LidarSpec(beams=8, steps=90), cameras=cameras)
    sceneloom.write(drive.scene, tmp_path / "drive", images="png")
    reports = {one.id: detect_2d(drive, one.id) for one in drive.scene.cameras}
    words = []
    for number, (name, found) in enumerate(reports.items(), start=1):  # the lidar is number 0
        lines = [format_json(boxes_2d_record(r.boxes, sensor_id=number, seq=k)) for k, r in enumerate(found)]
        (tmp_path / f"{name}.jsonl").write_text("\n".join(lines))
        words += ["--boxes2d", tmp_path / f"{name}.jsonl", "--camera", name]
    (tmp_path / "all.jsonl").write_text("\n".join((tmp_path / f"{n}.jsonl").read_text() for n in reports))
    texts = []
    for number, given in enumerate((words, ["--boxes2d", tmp_path / "all.jsonl"])):
        out = tmp_path / f"{number}.jsonl"
        outcome = call("fuse", tmp_path / "drive", "--type", "detection", *given, "-o", out)
        assert (outcome.code, "sensor_id" in outcome.err) == (0, False), outcome.err
        texts.append(out.read_text())
    assert texts[0] == texts[1]
    found = [len(parse_json(line)) for line in texts[0].splitlines()]
    assert sum(found) == sum(len(r.boxes) for reports_of_one in reports.values() for r in reports_of_one)


@pytest.mark.usefixtures("inline")
def test_kittis_sequences_are_fused_into_two_files_each_or_kittis_text_and_tracked(refuses, succeeds, tmp_path, kitti):
    out, text = tmp_path / "out", tmp_path / "text"
    succeeds("fuse", kitti, "--type", "detection", "-o", out)
    assert sorted(file.name for file in out.iterdir()) == ["0001.frames.jsonl", "0001.jsonl"]
    (record, *_) = (parse_json(line) for line in (out / "0001.jsonl").read_text().splitlines())
    # the box of the sweep that no image's detector looked for keeps its probability: 1 / (1 + exp(-2))
    assert record.class_names == ("Pedestrian",)
    succeeds("track", out, "-o", tmp_path / "tracked")
    succeeds("fuse", kitti, "--type", "detection", "--format", "kitti", "-o", text)
    assert [file.name for file in text.iterdir()] == ["0001.txt"]
    found = read_labels(text / "0001.txt")
    assert (found.frames.tolist(), found.types, found.track_ids.tolist()) == ([0, 1], ("Pedestrian", "Car"), [-1, -1])
    # what one detector alone found stays as it reported it
    one = (*found.sizes_hwl[0], *found.bottoms[0], found.rotations_y[0], *found.corners_xyxy[1])
    np.testing.assert_allclose(one, [1.8, 0.6, 0.8, -1.0, 1.5, 8.0, 0.0, 10, 20, 110, 220], atol=1e-6)
    stated = "--camera does not count here: it is a folder of KITTI's"
    refuses(2, stated, "track", kitti, "-o", tmp_path / "none", "--camera", "front")
    for path in list(kitti.rglob("0001.txt")):
        shutil.copy(path, path.with_name("0002.txt"))
    succeeds("batch track", kitti, "-o", tmp_path / "batch", "--workers", 1)
    assert [file.name for file in sorted((tmp_path / "batch" / "kitti").iterdir())] == ["0001.txt", "0002.txt"]


LISTED = "--det2d x does not count here: the boxes come from the lists of --boxes3d and --boxes2d"


@pytest.mark.parametrize(
    ("words", "code", "reported"),
    [
        ((), 2, "no boxes; name files of them with --boxes3d, --boxes2d or both"),
        (("--boxes3d", "gone.jsonl"), 1, "gone.jsonl"),
        (("--boxes3d", "{boxes2d}"), 1, "expected Boxes3d or Box3d"),
        (("--boxes3d", "{boxes3d}", "--lidar", "roof"), 2, "lidar 'roof'"),
        (("--boxes2d", "{boxes2d}", "--camera", "front"), 2, "camera 'front'"),
        (("--boxes3d", "{boxes3d}", "--det2d", "x"), 2, LISTED),
        (("--det3d", "x"), 2, "--det3d x does not count here: it is no folder of KITTI's sequences"),
        (("--boxes3d", "{boxes3d}", "--sequence", "1", "--sequence", "2"), 2, "one drive is opened at a time"),
        (("--boxes3d", "{boxes3d}", "--depth", "x"), 2, "--depth does not count here"),
        (("--format", "kitti"), 2, "for folders laid out like KITTI's only"),
        (("--boxes3d", "x", "--type", "sensor"), 2, "it needs --type detection"),
    ],
)
def test_what_cannot_be_fused_is_reported(refuses, folder, tmp_path, words, code, reported):
    given = [word.format(boxes2d=folder / "boxes2d.jsonl", boxes3d=folder / "boxes3d.jsonl") for word in words]
    refuses(code, reported, "fuse", folder / "recording", "--type", "detection", "-o", tmp_path / "out.jsonl", *given)
    assert not list(tmp_path.glob("out*"))


def test_lists_of_boxes_are_of_one_drive_of_a_data_set(refuses, succeeds, folder, tmp_path):
    with sceneloom.open(folder / "recording") as scene:
        sceneloom.write(scene, tmp_path / "set", format="kitti-tracking")
    for path in sorted((tmp_path / "set").rglob("0000*")):
        if path.stem == "0000" and path.is_dir():
            shutil.copytree(path, path.with_name("0001"))
        elif path.stem == "0000":
            shutil.copy(path, path.with_name(f"0001{path.suffix}"))
    stated = ("track", tmp_path / "set", "--boxes3d", folder / "boxes3d.jsonl", "-o", tmp_path / "out.jsonl")
    refuses(2, "choose one with `--sequence NAME`", *stated)
    succeeds(*stated, "--sequence", "0001")
    assert (tmp_path / "out.jsonl").read_text()
