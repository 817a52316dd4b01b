"""Conversions: what is refused, what a report says of each field, and what is read back."""

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import LossError, OptionError, OutputError, without_folders
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.base import losses
from sceneloom.formats.base.losses import KEPT, Loss, Support, dropped
from sceneloom.formats.base.registry import written_formats
from sceneloom.pipeline import convert
from sceneloom.pipeline.converting import field_supports, fields_meant, lost
from sceneloom.scene.contents import MODEL_FIELDS
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

TIMESTAMPS = np.array([1_000_000_000, 1_100_000_000])
TRAJECTORY = sc.Poses(TIMESTAMPS, np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))


def drive(*, events=(), points_ns=0):
    frames = [
        sc.LidarFrame(int(t), sc.LidarPoints(np.ones((4, 3), np.float32), timestamps_ns=np.full(4, t + points_ns)))
        for t in TIMESTAMPS
    ]
    lidar = sc.LidarSensor(
        "top", sc.LazyFrames.of(frames, TIMESTAMPS.tolist()), TRAJECTORY, points_frame=sc.PointsFrame.WORLD
    )
    trajectory = sc.Trajectory("trajectory", TIMESTAMPS, TRAJECTORY.positions, TRAJECTORY.quaternions_xyzw)
    return sc.Scene((lidar,), annotations=events, trajectories={"trajectory": trajectory})


@pytest.fixture
def scene_file(tmp_path):
    write_scene(drive(), tmp_path / "drive.sfs")
    return tmp_path / "drive.sfs"


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_shows_only_while_writing_leaves_nothing_behind_and_rounding_to_other_units_is_no_loss(tmp_path):
    write_scene(drive(points_ns=500), tmp_path / "drive.sfs", time_unit="nanoseconds")
    with open_scene(tmp_path / "drive.sfs") as scene:
        assert scene.lidars[0].frames[0].points.timestamps_ns[0] == TIMESTAMPS[0] + 500
    with pytest.raises(LossError, match=r"'lidar'|points_frame|model|poses"):
        convert(tmp_path / "drive.sfs", tmp_path / "trajectory", strict=True)
    assert names(tmp_path) == ["drive.sfs"]
    report = convert(tmp_path / "drive.sfs", tmp_path / "copy.sfs", strict=True, time_unit="microseconds")
    rounded = {field.field: field for field in report.of_support(Support.CONVERTED)}
    assert rounded["sensors.lidar.frames.points.timestamps_ns"].largest_error == 0.5


def test_a_trajectory_out_of_a_drive_says_what_stays_behind(scene_file, tmp_path):
    report = convert(scene_file, tmp_path / "trajectory.jsonl")
    supports = {field.field: field.support for field in report.fields}
    assert supports["trajectories.positions"] == supports["trajectories.name"] == Support.KEPT
    assert supports["sensors.lidar.frames.points.positions"] == Support.DROPPED
    with pytest.raises(LossError, match="jsonl would not hold all"):
        convert(scene_file, tmp_path / "again.jsonl", strict=True)
    assert "again.jsonl" not in names(tmp_path)
    report = convert(tmp_path / "trajectory.jsonl", tmp_path / "trajectory.tum")
    assert [field.field for field in report.lost] == ["trajectories.name"]


def test_what_is_known_beforehand_is_refused_before_writing_and_reports_name_every_field(tmp_path, monkeypatch):
    source = tmp_path / "event.sfs"
    write_scene(drive(events=(sc.EventAnnotation("e", int(TIMESTAMPS[0])),)), source)
    for suffix in (".md", ".txt"):
        report = convert(source, tmp_path / "drive", loss=tmp_path / f"loss{suffix}", overwrite=True)
        text = (tmp_path / f"loss{suffix}").read_text()
        assert report.fields
        assert all(field.field in text for field in report.fields)
        assert f"{source.name} (sfs) → drive (recording)" in text
    monkeypatch.setattr("sceneloom.formats.recording.writer.write_recording", None)
    with pytest.raises(LossError, match=r"recording would not hold all: .*annotations.event.id") as caught:
        convert(source, tmp_path / "strict", strict=True, loss=tmp_path / "loss.json")
    assert names(tmp_path) == ["drive", "event.sfs", "loss.json", "loss.md", "loss.txt"]
    reported = json.loads((tmp_path / "loss.json").read_text())
    assert reported["written"] is caught.value.report.written is False
    assert ("annotations.event.id", "dropped") in {(row["field"], row["support"]) for row in reported["fields"]}


def test_what_cannot_be_written_is_refused_at_once_and_replaced_only_where_it_may(scene_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for options, message in (
        ({"loss": "loss.pdf"}, r"suffix '.pdf'; a loss report is written as .json, .md, .txt"),
        ({"to": "rig"}, "the format rig is only read; written are sfs, recording"),
    ):
        with pytest.raises(OptionError, match=message):
            convert(scene_file, tmp_path / "drive", **options)
    assert names(tmp_path) == ["drive.sfs"]
    (copy := tmp_path / "copy.sfs").write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists already"):
        convert(scene_file, copy, strict=True)
    assert copy.read_bytes() == b"mine"
    report = convert(scene_file, copy, strict=True, overwrite=True)
    assert (report.written, report.lost) == (True, ())
    with open_scene(copy) as scene:
        assert (len(scene.lidars[0].frames), scene.lidars[0].id) == (2, "top")
    assert names(tmp_path) == ["copy.sfs", "drive.sfs"]


HOLDS = {
    "": KEPT,
    "sensors": dropped("no sensors"),
    "sensors.lidar": KEPT,
    "sensors.lidar.frames.points": losses.converted("as 32 bits"),
    "sensors.lidar.frames.points.colors": losses.approximated("three bits each"),
}
KINDS = {"sensors[top]": "sensors.lidar", "sensors[a.b]": "sensors.camera", "annotations[7]": "annotations.cuboid"}


def test_the_longest_beginning_that_ends_at_a_dot_counts_and_a_line_is_about_the_fields_that_it_names():
    supports = {
        "sensors.lidar.frames.points.colors": Support.APPROXIMATED,
        "sensors.lidar.frames.points.rings": Support.CONVERTED,
        "sensors.lidar.id": Support.KEPT,
        "sensors.lidarish.id": Support.DROPPED,
        "metadata": Support.KEPT,
    }
    assert {field: losses.holding_of(HOLDS, field).support for field in supports} == supports
    assert losses.holding_of({"sensors": KEPT}, "metadata") is None
    assert losses.unknown_names({**HOLDS, "sensors.lidar.frame": KEPT, "meta": KEPT}) == ["sensors.lidar.frame", "meta"]
    fields = {
        "sensors[top].frames[].points.intensities": ["sensors.lidar.frames.points.intensities"],
        "sensors[top].frames[].points.timestamps": ["sensors.lidar.frames.points.timestamps_ns"],
        "sensors[top].frames[3].points.reflectivity": ["sensors.lidar.frames.points.extras"],
        "sensors[top].serial": ["sensors.lidar.extras"],
        "sensors[a.b].intrinsics.distortion": ["sensors.camera.camera"],
        "sensors[a.b].images[].content": ["sensors.camera.images.rgb"],
        "annotations[7].attributes[].extras": ["annotations.cuboid.attributes"],
        "trajectories[vio].covariances": ["trajectories.covariances"],
        "trajectories.vio.covariances": ["trajectories.covariances"],
        "trajectories.covariances": ["trajectories.covariances"],
        "sensors.imu.streams.barometer.values": ["sensors.imu.streams.other.values"],
        "metadata.weather": ["metadata"],
        "sensors": ["sensors.order"],
        "replay": [],
    }
    assert {location: list(fields_meant(location, KINDS)) for location in fields} == fields
    assert set(fields_meant("sensors[top]", KINDS)) == {f for f in MODEL_FIELDS if f.startswith("sensors.lidar.")}
    everywhere = fields_meant("sensors[].poses", KINDS)
    assert set(everywhere) == {f for f in MODEL_FIELDS if f.startswith("sensors.") and f.endswith(".poses")}


def test_the_worst_that_happened_counts_and_the_largest_error_and_fields_that_are_not_held_stand_by_themselves():
    contents = {"sensors.lidar.frames.points.timestamps_ns": 9, "sensors.lidar.id": 1, "metadata": 1}
    times = "sensors[top].frames[].points.timestamps"
    reported = [
        Loss(field=times, what="µs", support=Support.CONVERTED, largest_error=0.4),
        Loss(field=times, what="ms", support=Support.APPROXIMATED, largest_error=0.2),
        Loss(field="sensors[top].id", what="read back as 'lidar'", kept="the header"),
        Loss(field="replay", what="a note", count=3, support=Support.KEPT),
        Loss(field="sensors[a.b].mount", what="taken to be where the IMU is"),
    ]
    found = {support.field: support for support in field_supports(contents, HOLDS, reported, KINDS)}
    times = found["sensors.lidar.frames.points.timestamps_ns"]
    assert (times.support, times.count, times.largest_error) == (Support.APPROXIMATED, 9, 0.4)
    assert times.how[-1] == "as 32 bits"
    assert found["sensors.lidar.id"].support == Support.KEPT
    assert "it is in the header" in found["sensors.lidar.id"].how[0]
    assert (found["metadata"].support, found["metadata"].how) == (Support.KEPT, ())
    assert (found["replay"].count, found["replay"].how) == (3, ("a note (3 times)",))
    missing = ["sensors.lidar.frames.points.timestamps_ns", "sensors[a.b].mount"]
    assert [support.field for support in lost(found.values())] == missing


SMALL = LidarSpec(beams=8, steps=90)


def shape(identifier, kind, times, vertices):
    where = {"sensor_id": "camera0"} if kind.endswith("_2d") else {}
    return sc.ShapeAnnotation(
        identifier, sc.ShapeType(kind), sc.VertexPath(times, (np.array(vertices, float),) * len(times)), **where
    )


def annotated(with_camera):
    """Three sweeps with an annotation of every type; those in images only where there is a camera."""
    drive = sceneloom.simulate_street(3, frames=3, lidar=SMALL, **({} if with_camera else {"cameras": ()})).scene
    times = drive.lidars[0].frames.timestamps_ns
    here = next(iter(drive.trajectories.values())).positions[20]
    cuboids = [a for a in drive.annotations if isinstance(a, sc.CuboidAnnotation)][:6]
    still = sc.Poses(times[:1], np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]]))
    state = sc.AttributePath("review_state", ("approved",), times[:1])
    ahead = [here + np.array([x, y, 1]) for x, y in ((10, 0), (10, 3), (15, 3))]
    found = [
        replace(cuboids[0], attributes=(*cuboids[0].attributes, state), parent_id="thing"),
        *cuboids[1:],
        shape("line", "polyline", times, ahead),
        shape("area", "polygon", times, ahead),
        sc.PointsAnnotation("points", (sc.PointPath(times, np.repeat([ahead[0]], 3, axis=0)),), labels=("a",)),
        sc.EventAnnotation("event", int(times[0]), 10**8, label="start"),
        sc.LabeledPointsAnnotation("labelled", (sc.LabeledPoints("lidar", np.arange(5, dtype=np.uint32), 0),), "road"),
        sc.ObjectAnnotation("thing", "car"),
        sc.LinkAnnotation("link", cuboids[0].id, cuboids[1].id, "follows", is_bidirectional=False),
        sc.GroupAnnotation("group", "convoy"),
        sc.LocalizationAdjustment("adjustment", still),
    ]
    if with_camera:
        seen = drive.cameras[0].images.timestamps_ns
        found += [
            sc.Box2DAnnotation("box", "camera0", sc.BoxPath(seen, np.tile([50.0, 60, 70, 80], (3, 1))), "car"),
            shape("line in images", "polyline_2d", seen, [[1, 2], [30, 40]]),
            shape("area in images", "polygon_2d", seen, [[1, 2], [30, 40], [5, 60]]),
            sc.CameraCalibration("calibration", "camera0", still),
        ]
    return replace(drive, annotations=tuple(found))


@pytest.fixture(scope="module", params=[True, False], ids=["with a camera", "without a camera"])
def source(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("annotated") / "drive.sfs"
    scene = annotated(request.param)
    sceneloom.write(scene, path)
    return scene, path


SUFFIXES = {"sfs": ".sfs", "mcap": ".mcap", "ros1": ".bag", "openlabel": ".json"}


@pytest.mark.few(18)
@pytest.mark.parametrize("target", written_formats())
def test_each_annotation_is_read_back_or_listed_with_its_count(source, target, tmp_path):
    scene, path = source
    only_written = target in ("colmap", "nerfstudio", "urdf", "kalibr", "camera-info")
    if only_written and not scene.cameras:
        pytest.skip("writes images, of which there are none")
    written = tmp_path / f"out{SUFFIXES.get(target, '')}"
    report = sceneloom.convert(path, written, to=target)
    found = ()
    if not only_written:
        with sceneloom.open(written, format=target) as again:
            found = again.annotations
    listed = Counter()
    for loss in report.losses.losses:
        if loss.support is Support.DROPPED and loss.field in _WHOLE:
            listed[loss.field.removeprefix("annotations.")] += loss.count
    kept = Counter(n.message.split(" ")[0] for n in report.warnings if n.code == "correction-applied")
    missing = kinds_of(scene.annotations) - kinds_of(found) - kept
    unlisted = missing - listed
    assert unlisted.total() <= listed["annotations"], f"{dict(unlisted)} of {dict(missing)}; {dict(listed)} listed"


def kinds_of(annotations):
    return Counter("shape" if isinstance(a, sc.ShapeAnnotation) else str(a.type) for a in annotations)


_WHOLE = {"annotations", *(f"annotations.{kind}" for kind in kinds_of(annotated(True).annotations))}


@pytest.mark.parametrize("target", ["kitti-object", "kitti-tracking", "kitti-raw"])
def test_boxes_of_a_drive_without_a_camera_are_in_their_locations_in_each_frame(tmp_path, target):
    scene = annotated(with_camera=False)
    sceneloom.write(scene, tmp_path / "drive.sfs")
    sceneloom.convert(tmp_path / "drive.sfs", tmp_path / "out", to=target)
    with sceneloom.open(tmp_path / "out") as again:
        assert not again.cameras
        for samples in zip(scene.samples(), again.samples(), strict=True):
            mine, theirs = (s.world_from_lidar.inverse().apply(s.boxes.centers_world) for s in samples)
            assert len(theirs) == len(mine) == 6
            np.testing.assert_allclose(theirs, mine, atol=1e-3)  # numbers of fixed digits


def test_every_sweep_and_every_single_image_is_reported_once(tmp_path):
    camera_model = Camera("pinhole", 64, 32, 40.0, 40.0, 31.5, 15.5)
    drive = simulate_street(frames=3, lidar=LidarSpec(beams=4, steps=60), cameras=(CameraSpec(camera_model),))
    write_scene(drive.scene, tmp_path / "drive.sfs")
    reported = []
    convert(tmp_path / "drive.sfs", tmp_path / "copy.sfs", progress=lambda *counts: reported.append(counts))
    assert reported[-1] == (6, 6)
    assert [done for done, _ in reported] == sorted(done for done, _ in reported)
    with open_scene(tmp_path / "copy.sfs") as copy:
        assert [len(copy.lidars[0].frames), len(copy.cameras[0].images)] == [3, 3]


TARGETS = ("sfs", "mcap", "openlabel", "ros2", "nuscenes", "kitti-raw", "kitti-object", "recording", "pcd", "ply")


@pytest.fixture(scope="module")
def source_paths(tmp_path_factory):
    """KITTI's frames: on reading them something is assumed of their folder."""
    folder = tmp_path_factory.mktemp("secret-home") / "drive"
    scene = sceneloom.simulate_street(3, frames=2).scene
    sceneloom.write(scene, folder.parent / "a.sfs")
    sceneloom.convert(folder.parent / "a.sfs", folder, to="kitti-object")
    return folder


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.few(5)
def test_no_target_holds_the_folder_of_its_source(source_paths, target, tmp_path):
    out = tmp_path / f"out{SUFFIXES.get(target, '')}"
    sceneloom.convert(source_paths, out, to=target, loss=tmp_path / "loss.json")
    files = [out] if out.is_file() else [path for path in out.rglob("*") if path.is_file()]
    for path in (*files, tmp_path / "loss.json"):
        assert b"secret-home" not in path.read_bytes(), path


def test_folders_above_the_source_are_left_out_and_repairs_are_not_reported_again(source_paths, tmp_path):
    location = f"{source_paths}/oxts.txt"
    repaired = sc.DataWarning(kind=sc.WarningKind.REPAIRED, code="poses-sorted", location=location, message="sorted")
    with sceneloom.open(source_paths) as scene:
        reported = replace(scene, warnings=(*scene.warnings, repaired))
        sceneloom.write(reported, tmp_path / "b.sfs")
    with sceneloom.open(tmp_path / "b.sfs") as again:
        locations = [n.location for n in again.warnings if n.code == "frames-apart"]
        assert locations
        assert not any("secret-home" in location for location in locations)
        assert "poses-sorted" not in {n.code for n in again.warnings}
    for text, source, expected in (
        ("/x/me/drives/a/calib.txt: odd", "/x/me/drives/a", "a/calib.txt: odd"),
        ("drives/a: odd", "drives/a", "a: odd"),
        ("topic /lidar/points", "/x/me/a.mcap", "topic /lidar/points"),
        ("/x/a and /y/b", "/x/a + /y/b", "a and b"),
        ("s3://bucket/a.sfs", "s3://bucket/a.sfs", "s3://bucket/a.sfs"),
        ("a.sfs", "a.sfs", "a.sfs"),
    ):
        assert without_folders(text, source) == expected
