"""Damaged scene files: what is whole comes back as a valid scene, what is not is reported."""

import contextlib
import json
import pickle

import av
import numpy as np
import pytest
import simplejpeg
from click.testing import CliRunner

import sceneloom
from sceneloom.cli.main import sceneloom as program
from sceneloom.errors import DataError, OutputError, SceneloomError
from sceneloom.formats.sfs.reader import parse_path, take_out, what_goes
from sceneloom.formats.sfs.salvage import recover_header, salvage
from sceneloom.formats.sfs.writer import Spool

POSES = {"timestamps": [0, 10**6], "values": [[0, 0, 0, 0, 0, 0, 1], [9, 0, 0, 0, 0, 0, 1]]}
CAMERA_MODEL = {"fx": 60.0, "fy": 60.0, "cx": 48.0, "cy": 32.0, "width": 96, "height": 64}


def cloud(k, *, points=10):
    """A sweep of a tenth of a second, `k` in all its values."""
    return {
        "timestamp": 100_000 * k,
        "points": {
            "positions": np.full((points, 3), k, np.float32),
            "intensities": np.full(points, k, np.uint8),
            "timestamps": np.arange(points, dtype=np.uint32) + 100_000 * k,
        },
    }


def drive(*, frames=5):
    """A lidar, a camera with JPEG images, and annotations of which one counts frames."""
    jpeg = np.frombuffer(simplejpeg.encode_jpeg(np.zeros((64, 96, 3), np.uint8), 50), np.uint8)
    images = [{"timestamp": 100_000 * k, "content": jpeg} for k in range(3)]
    labels = [{"sensor_id": "top", "sensor_frame": k, "point_ids": np.array([k], np.uint32)} for k in range(frames)]
    return {
        "version": "1.0",
        "annotations": [
            {"id": "box", "type": "cuboid", "path": {"timestamps": [0], "values": [[1.0] * 9]}},
            {"id": "labels", "type": "labeled_points", "label": "car", "labeled_points": labels},
        ],
        "sensors": [
            {"id": "top", "type": "lidar", "poses": POSES, "frames": [cloud(k) for k in range(frames)]},
            {"id": "cam", "type": "camera", "poses": POSES, "intrinsics": CAMERA_MODEL, "images": images},
        ],
    }


@pytest.fixture
def salvaged(tmp_path):
    """Salvage a content; give the report and the scene, opened without leniency."""

    def run(content):
        number = len(list(tmp_path.iterdir()))
        damaged, whole = tmp_path / f"damaged{number}.sfs", tmp_path / f"whole{number}.sfs"
        damaged.write_bytes(content)
        return salvage(damaged, whole), sceneloom.open(whole)

    return run


def items_of(content):
    stop = content.index(b"\0")
    return json.loads(content[:stop])["$items"], stop


def number_of(content, path):
    return next(number for number, item in enumerate(items_of(content)[0]) if item["keys"] == path)


def cut_before(content, path):
    """Cut a file in the middle of the array at a path of keys."""
    items, stop = items_of(content)
    item = items[number_of(content, path)]
    return content[: stop + item["offset"] + item["length"] // 2]


def test_frames_behind_the_cut_are_left_out_and_reported_and_an_optional_array_leaves_its_frame(salvaged, encode_sfs):
    content = encode_sfs({name: v for name, v in drive().items() if name != "annotations"})
    report, scene = salvaged(cut_before(content, ["sensors", 0, "frames", 3, "points", "positions"]))
    assert [frame.points.positions[0, 0] for frame in scene.lidars[0].frames] == [0, 1, 2]
    images = [f"sensors[1].images[{k}]" for k in range(3)]
    assert [part.location for part in report.lost] == ["sensors[0].frames[3]", "sensors[0].frames[4]", *images]
    assert report.lost[0].bytes == 10 * (12 + 1 + 4)
    assert "the file has" in report.lost[0].problem
    assert [(s.id, s.kept, s.count) for s in report.sensors] == [("top", 3, 5), ("cam", 0, 3)]
    assert scene.lidars[0].poses is not None
    assert [n.count for n in scene.warnings if n.code == "salvaged"] == [5]
    content = encode_sfs({**drive(), "annotations": [], "sensors": drive()["sensors"][:1]})
    report, scene = salvaged(cut_before(content, ["sensors", 0, "frames", 4, "points", "intensities"]))
    frames = scene.lidars[0].frames
    assert len(frames) == 5
    assert (frames[4].points.intensities, frames[4].points.timestamps_ns) == (None, None)
    assert frames[3].points.intensities.tolist() == [3] * 10
    lost = [part.location for part in report.lost]
    assert lost == ["sensors[0].frames[4].points.intensities", "sensors[0].frames[4].points.timestamps"]


def test_labelled_points_follow_the_frames_and_arrays_that_stay(salvaged, encode_sfs):
    content = encode_sfs(drive())
    items, stop = items_of(content)
    items[number_of(content, ["sensors", 0, "frames", 1, "points", "positions"])]["offset"] = 10**9
    text = json.dumps({**json.loads(content[:stop]), "$items": items}).encode()
    report, scene = salvaged(text + content[stop:])
    assert [part.location for part in report.lost] == ["sensors[0].frames[1]"]
    (labels,) = (annotation for annotation in scene.annotations if annotation.id == "labels")
    found = [(part.sensor_frame, part.point_ids.tolist()) for part in labels.labeled_points]
    assert found == [(0, [0]), (1, [2]), (2, [3]), (3, [4])]
    assert scene.lidars[0].frames[1].points.positions[0, 0] == 2
    scene.close()
    header = {"version": "1.0", "sensors": drive()["sensors"], "annotations": drive()["annotations"]}
    cut = cut_before(encode_sfs(header), ["annotations", 1, "labeled_points", 3, "point_ids"])
    report, scene = salvaged(cut)
    (labels,) = (annotation for annotation in scene.annotations if annotation.id == "labels")
    assert [part.sensor_frame for part in labels.labeled_points] == [0, 1, 2]
    assert [part.location for part in report.lost] == [f"annotations[1].labeled_points[{k}]" for k in (3, 4)]


def test_a_whole_file_loses_nothing_a_changed_number_one_frame_and_one_that_is_none_its_annotation(
    salvaged, encode_sfs
):
    content = drive()
    report, scene = salvaged(encode_sfs(content))
    assert report.lost == ()
    assert [(s.id, s.kept, s.count) for s in report.sensors] == [("top", 5, 5), ("cam", 3, 3)]
    assert "salvaged" not in [warning.code for warning in scene.warnings]
    bad = {"timestamps": [0], "values": np.array([[1.0, 1, 1, np.nan, 0, 0, 0, 0, 0]])}
    content["annotations"].insert(0, {"id": "nowhere", "type": "cuboid", "path": bad})
    report, scene = salvaged(encode_sfs(content))
    assert [part.location for part in report.lost] == ["annotations[nowhere].path.values[0]"]
    assert "expected finite numbers" in report.lost[0].problem
    assert [annotation.id for annotation in scene.annotations] == ["box", "labels"]
    content = encode_sfs({**drive(), "annotations": []})
    report, scene = salvaged(content.replace(b'"timestamp": 200000', b'"timestamp": "0000"', 1))
    assert [part.location for part in report.lost] == ["sensors[0].frames[2]"]
    assert len(scene.lidars[0].frames) == 4


def test_a_header_that_was_cut_keeps_what_is_complete_and_arrays_are_found_behind_a_damaged_part(salvaged, encode_sfs):
    text = json.dumps({**drive(), "$items": []}, default=lambda _: "").encode()
    report, scene = salvaged(text[: text.index(b'"frames"') + 100])
    assert ([a.id for a in scene.annotations], scene.sensors) == (["box", "labels"], ())
    assert report.lost[0].location == "sensors[0]"
    assert "cut off or damaged here" in report.lost[0].problem
    assert report.annotations == 2
    report, scene = salvaged(encode_sfs(drive()).replace(b'"intrinsics": {"fx"', b'"intrinsics": {#fx"'))
    assert [sensor.id for sensor in scene.sensors] == ["top"]
    assert [frame.points.positions[0, 0] for frame in scene.lidars[0].frames] == [0, 1, 2, 3, 4]
    assert report.lost[0].location == "sensors[1]"
    assert "cut off or damaged here" in report.lost[0].problem
    assert sum("lead nowhere" in part.problem for part in report.lost) == 3


def encoded(path, *, images, flags):
    """H.264 with images that are stored in another order than they are shown in."""
    rng = np.random.default_rng(5)
    with av.open(path, "w", format="mp4", options={"movflags": flags} if flags else {}) as movie:
        stream = movie.add_stream("libx264", rate=10, options={"bf": "2", "g": "12"})
        stream.width, stream.height = 96, 64
        for _ in range(images):
            frame = av.VideoFrame.from_ndarray(rng.integers(0, 256, (64, 96, 3), np.uint8), format="rgb24")
            movie.mux(stream.encode(frame))
        movie.mux(stream.encode())
    return np.frombuffer(path.read_bytes(), np.uint8)


def video_scene(encode_sfs, content, count):
    video = {"timestamps": [1000 * k**2 for k in range(count)], "content": content, "fps": 10}
    camera = {"id": "cam", "type": "camera", "poses": POSES, "intrinsics": CAMERA_MODEL, "video": video}
    return encode_sfs({"version": "1.0", "sensors": [camera]})


@pytest.mark.parametrize("ours", [False, True])
def test_a_video_that_was_cut_keeps_its_whole_images_with_their_times(salvaged, encode_sfs, tmp_path, ours):
    flags, path = "" if ours else "faststart", tmp_path / "whole video.sfs"
    path.write_bytes(video_scene(encode_sfs, encoded(tmp_path / "video.mp4", images=30, flags=flags), 30))
    if ours:
        with sceneloom.open(path) as scene:
            # a part of a video is encoded anew
            sceneloom.write(sceneloom.crop_scene(scene, start=0.001), tmp_path / "ours.sfs")
        path = tmp_path / "ours.sfs"
    content = path.read_bytes()
    start = content.index(b"mdat") if ours else 0
    report, scene = salvaged(content[: start + (len(content) - start) * (3 if ours else 4) // 6])
    original, images = sceneloom.open(path).cameras[0].images, scene.cameras[0].images
    count = 29 if ours else 30
    assert 5 < len(images) < len(original) == count
    times = original.timestamps_ns.tolist()
    for image in images:
        np.testing.assert_array_equal(image.rgb, original[times.index(image.timestamp_ns)].rgb)
    assert report.lost[0].location == "sensors[0].video.content"
    assert f"{len(images)} of its {count} images" in report.lost[0].problem


@pytest.mark.parametrize("inside", [True, False])
def test_images_before_the_cut_of_a_video_are_read_leniently(encode_sfs, tmp_path, inside):
    content = encoded(tmp_path / "video.mp4", images=30, flags="faststart")
    path, fixed = tmp_path / "cut.sfs", tmp_path / "fixed.sfs"
    path.write_bytes(video_scene(encode_sfs, content, 30))
    with sceneloom.open(path) as scene:
        expected = [image.rgb for image in scene.cameras[0].images]
    whole = path.read_bytes()
    cut = content[: len(content) * 2 // 3]
    path.write_bytes(video_scene(encode_sfs, cut, 30) if inside else whole[: len(whole) * 2 // 3])
    with pytest.raises(DataError, match=r"cut|after its header"):
        sceneloom.convert(path, tmp_path / "copy.sfs")
    with sceneloom.open(path, lenient=True) as opened:
        scene = pickle.loads(pickle.dumps(opened))
        images = scene.cameras[0].images
        assert 10 < len(images) < 30
        for image in images:
            number = round((image.timestamp_ns / 1e6) ** 0.5)
            np.testing.assert_array_equal(image.rgb, expected[number])
        (warning,) = [warning for warning in scene.warnings if warning.code == "at-fault"]
        assert f"{len(images)} of its 30 images are whole" in warning.message
    report = sceneloom.validate(path, fix=fixed)
    assert report.left_out[0].path.startswith("sensors[0].video.content")
    with sceneloom.open(fixed) as scene:
        assert len(scene.cameras[0].images) == len(images)


@pytest.mark.parametrize("flags", ["", "frag_keyframe+empty_moov", None])
def test_a_video_whose_tables_are_lost_or_that_is_none_is_left_out_and_its_camera_stays(
    salvaged, encode_sfs, tmp_path, flags
):
    if flags is None:
        content = video_scene(encode_sfs, np.arange(99, dtype=np.uint8), 3)
    else:
        content = video_scene(encode_sfs, encoded(tmp_path / "video.mp4", images=30, flags=flags), 30)
        content = content[: len(content) * 2 // 3]
    report, scene = salvaged(content)
    assert len(scene.cameras[0].images) == 0
    assert scene.cameras[0].poses is not None
    (lost,) = report.lost
    assert lost.location.endswith(".video")
    assert flags is not None or "cannot be read as video" in lost.problem


def test_a_scene_cut_or_changed_anywhere_is_salvaged_or_refused(encode_sfs, tmp_path):
    source, target = tmp_path / "damaged.sfs", tmp_path / "out.sfs"

    def salvaged(content):
        source.unlink(missing_ok=True)  # a new file is far quicker than an old one made shorter
        source.write_bytes(content)
        return salvage(source, target, overwrite=True)

    content, complete = encode_sfs(drive(frames=3)), 0
    for length in [*range(0, len(content), 61), len(content)]:
        try:
            report = salvaged(content[:length])
        except SceneloomError:
            assert length < 20
            continue
        with sceneloom.open(target) as scene:
            for frame in scene.lidars[0].frames if scene.lidars else ():
                assert (frame.points.positions == frame.timestamp_ns // 100_000_000).all()
        complete += not report.lost
        assert bool(report.lost) == (length < items_of(content)[1] or length < len(content) - 4)
    assert complete
    content, swaps = encode_sfs(drive(frames=2)), b'0-9"[]{},:.eE\0\xff '
    rng = np.random.default_rng(7)
    for location in range(0, len(content), 29):
        changed = bytearray(content)
        changed[location] = swaps[int(rng.integers(len(swaps)))]
        with contextlib.suppress(SceneloomError):
            salvaged(changed)
            sceneloom.open(target).close()


def test_the_command_reports_what_is_kept_and_lost_and_the_damaged_file_is_never_written_over(
    encode_sfs, tmp_path, monkeypatch
):
    path, target = tmp_path / "drive.sfs", tmp_path / "out.sfs"
    monkeypatch.setattr("sceneloom.formats.sfs.writer._IN_MEMORY", 1000)
    for reserve in (640, 1 << 17):
        with Spool(path, reserve=lambda reserve=reserve: reserve) as spool:
            spool.add(np.ones(100_000, np.float32))
            spool.add(np.ones(100_000, np.float32))
        with pytest.raises(DataError, match="draft of a writer that was stopped"):
            salvage(path, target)
        assert not target.exists()
    path.write_bytes(cut_before(encode_sfs(drive()), ["sensors", 0, "frames", 3, "points", "positions"]))
    with pytest.raises(DataError, match="choose another name"):
        salvage(path, path, overwrite=True)
    with pytest.raises(DataError, match="No such file"):
        salvage(tmp_path / "absent.sfs", target)
    done = CliRunner().invoke(program, ["salvage", str(path), "-o", str(target)])
    assert done.exit_code == 0, done.output
    assert all(words in done.output for words in ("top", "3 of 5", "sensors[0].frames[3]"))
    with pytest.raises(OutputError, match="exists already"):
        salvage(path, target)
    done = CliRunner().invoke(program, ["salvage", str(path), "-o", str(target), "--json", "--overwrite"])
    assert json.loads(done.stdout)["sensors"][0] == {"id": "top", "type": "lidar", "kept": 3, "count": 5}


def test_a_header_is_recovered_up_to_the_damage_and_what_is_none_is_refused():
    deep = '{"version": ' + "[" * 5000 + '1, "$items": [7]}'
    ours = '{"metadata": {"sceneloom": {"layout": 1, "sensors": [{"id": "imu"}, 5'
    for text, header, *lost in (
        ('{"a": [1]}', {"a": [1]}),
        ('{"version": "1.0", "sensors": [{"a": 1}, {"a"', {"version": "1.0", "sensors": [{"a": 1}]}, "sensors[1]"),
        ('{"version": "1.0", "time_offset": 12', {"version": "1.0"}, "…"),
        ('{"version": "1.0"', {"version": "1.0"}, "header"),
        ('{"version": "1.0", "metadata": {"a": 1, "b": [1', {"version": "1.0", "metadata": {"a": 1}}, "metadata.…"),
        (ours, {"metadata": {"sceneloom": {"layout": 1, "sensors": [{"id": "imu"}]}}}, "metadata.sceneloom.sensors[1]"),
        ('{"version": "1.0", "sensors": [{"a": 1}]', {"version": "1.0", "sensors": [{"a": 1}]}, "header"),
        ('{"version": "1.0",, "x": 1, "$items": [7]}', {"version": "1.0", "$items": [7]}, "…"),
        ('{"a": [1, 2], "sensors": [{"b": "ä\udcff', {"a": [1, 2], "sensors": []}, "sensors[0]"),
        (deep, {"$items": [7]}, "…"),
    ):
        found, reported = recover_header(memoryview(text.encode("utf-8", "surrogateescape")), "file")
        assert (found, [location for location, _, _ in reported]) == (header, lost)
    for text in (b"hello", b"[1, 2", b"\xff\xfe"):
        with pytest.raises(DataError, match="does not begin as the header"):
            recover_header(memoryview(text), "file")


def test_with_a_value_of_our_metadata_goes_the_stream_that_cannot_be_without_it():
    imu = {"id": "i", "type": "imu", "streams": {"gyroscope": {"values": ""}}}
    header = {"version": "1.0", "metadata": {"own": {"a": ""}, "sceneloom": {"sensors": [imu]}}}
    gyroscope = "metadata.sceneloom.sensors[0].streams.gyroscope"
    own = "metadata.own.a"
    for lost, goes in ((own, own), (f"{own}[3]", own), (f"{gyroscope}.values", gyroscope)):
        assert what_goes(header, parse_path(lost)) == parse_path(goes)
    for absent in ("metadata.sceneloom.sensors[0].streams.absent", "sensors[9].frames[0]", "version", "nothing"):
        assert what_goes(header, parse_path(absent)) is None

    # and notes about images follow those that stay
    for content, part, kept, noted, kept_notes in (
        ({"video": {"timestamps": [1, 2, 3]}}, ("video",), {}, {"extras": [{}, {}, {}]}, {"extras": []}),
        ({"images": ["a", "b", "c"]}, ("images", 1), {"images": ["a", "c"]},
         {"camera_of_image": [0, 1, 2], "mounts": [5], "extras": [{}, {}, {}]},
         {"camera_of_image": [0, 2], "mounts": [5], "extras": [{}, {}]}),
    ):  # fmt: skip
        notes = [{"id": "c", "images": noted}, {"id": "d", "images": {"extras": [{}]}}]
        camera = {"id": "c", "type": "camera"}
        header = {"sensors": [camera | content], "metadata": {"sceneloom": {"sensor_notes": notes}}}
        take_out(header, [("sensors", 0, *part)])
        assert header["sensors"] == [camera | kept]
        assert [note["images"] for note in notes] == [kept_notes, {"extras": [{}]}]
