"""What is in a saved view, by Rerun's own reader."""

import io
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from tests.properties.injected import (
    CAMERA_MODEL,
    POINTS,
    RANDOM_POINTS,
    SHOTS,
    TIMES,
    TRAJECTORY_TIMES,
    ego_at,
    injected_scene,
    jpeg,
)

from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.scene import CameraImage, CameraSensor, LazyFrames
from sceneloom.view import ColourBy, ViewSettings, save_view

SENSORS = "/injected/world/sensors"
SINGLE = 1e-5
"""Locations near the origin are float32 in the viewer: 24 bits of 30 m are 2 µm."""


def reference_ns(k):
    """The median of the times of sweep k's points, which are a little more than a millisecond apart."""
    return int(TIMES[k] + (POINTS // 2) * 1_000_001)


def rotated(row):
    return Rotation.from_quat(row.values["Transform3D:quaternion"][0])


def pinhole_of(saved):
    """The calibration matrix that the left camera is shown by."""
    row = saved.timed(f"{SENSORS}/left/image", "Pinhole:image_from_camera")[0]
    return row.array("Pinhole:image_from_camera").reshape(3, 3).T  # column by column in the file


def test_everything_that_the_drive_holds_has_its_entity_at_capture_times_and_frame_numbers(injected_saved):
    expected = {
        f"{SENSORS}/top/points", f"{SENSORS}/top/points/labelled", f"{SENSORS}/left/image",
        f"{SENSORS}/right/image", f"{SENSORS}/depth/image", f"{SENSORS}/radar_front/points",
        f"{SENSORS}/radar_front/velocities", f"{SENSORS}/left/calibrated", f"{SENSORS}/left/image/boxes/light",
        f"{SENSORS}/left/image/projections/car", f"{SENSORS}/left/image/points",
        f"{SENSORS}/left/image/polygon_2d/sign", "/injected/world/ego", "/injected/world/trajectories/vio",
        "/injected/world/trajectories/gnss_ins", "/injected/world/clouds/map",
        r"/injected/world/corrected\ trajectories/adjust-1",
        "/injected/world/annotations/cuboids/car", "/injected/world/annotations/links/drives",
        "/injected/world/annotations/points/points", "/injected/world/annotations/polyline/lane",
        "/injected/imu/imu_box/accelerometer", "/injected/imu/imu_box/imuTemperature", "/injected/gnss/antenna/height",
        "/injected/earth/antenna/fix", "/injected/earth/antenna/trajectory", "/injected/map/gnss/antenna/trajectory",
        "/injected/events/event-1", "/injected/relations", "/injected/annotations", "/injected/notes",
        r"/injected/attributes/weather\ \(left\)",
    }  # fmt: skip
    assert expected <= set(injected_saved.rows)
    assert injected_saved.timelines == {"time", "frame"}
    sweeps = injected_saved.timed(f"{SENSORS}/top/points", "Points3D:positions")
    assert [(row.time_ns, row.frame) for row in sweeps] == [(reference_ns(k), k) for k in range(3)]
    images = injected_saved.timed(f"{SENSORS}/left/image", "EncodedImage:blob")
    assert [(row.time_ns, row.frame) for row in images] == [(int(SHOTS[k]), k) for k in range(3)]


def test_a_lidar_is_where_the_ego_carried_it_and_its_points_where_it_met_them(injected_saved):
    poses = injected_saved.timed(f"{SENSORS}/top", "Transform3D:translation")
    for k, row in enumerate(poses):
        locations, rotations = ego_at(np.array([reference_ns(k)]))
        where = locations[0] + rotations[0].apply([1.0, 0.0, 1.8])
        assert np.allclose(row.array("Transform3D:translation")[0], where, atol=SINGLE)
        assert (rotated(row).inv() * rotations[0]).magnitude() < SINGLE
    shown = injected_saved.timed(f"{SENSORS}/top/points", "Points3D:positions")[1]
    world = rotated(poses[1]).apply(shown.array("Points3D:positions")) + poses[1].array("Transform3D:translation")[0]
    locations, rotations = ego_at(TIMES[1] + np.arange(POINTS) * 1_000_001)
    expected = locations + rotations.apply(RANDOM_POINTS[1] + [1.0, 0.0, 1.8])
    assert np.allclose(world, expected, atol=1e-4)  # float32 twice, at 40 m
    rgb = (np.arange(POINTS * 3) + 1).astype(np.uint8).reshape(POINTS, 3).astype(np.uint32)
    assert np.array_equal(shown.array("Points3D:colors"), rgb[:, 0] << 24 | rgb[:, 1] << 16 | rgb[:, 2] << 8 | 255)
    labelled = injected_saved.timed(f"{SENSORS}/top/points/labelled", "Points3D:positions")[0]
    assert labelled.time_ns == reference_ns(1)
    assert np.allclose(labelled.array("Points3D:positions"), shown.array("Points3D:positions")[[1, 3, 5]])
    context = injected_saved.lasting("/injected", "AnnotationContext:context")[0]
    names = {one["class_id"]: one["class_description"]["info"]["label"] for one in context}
    assert [names[one] for one in labelled.values["Points3D:class_ids"]] == ["tree-1"] * 3


def test_points_as_measured_are_those_of_the_file_and_points_in_the_world_are_the_same_locations(save, injected):
    shown = save(injected, as_measured=True).arrays(f"{SENSORS}/top/points", "Points3D:positions")[2]
    assert np.array_equal(shown.astype(np.float32), RANDOM_POINTS[2])
    saved = save(replace(injected_scene(odd=True), corrections="ignore"))
    shown = saved.timed("/injected/world/clouds/top", "Points3D:positions")[1]
    world = rotated(shown).apply(shown.array("Points3D:positions")) + shown.array("Transform3D:translation")[0]
    locations, rotations = ego_at(TIMES[1] + np.arange(POINTS) * 1_000_001)
    assert np.allclose(world, locations + rotations.apply(RANDOM_POINTS[1]), atol=1e-4)


@pytest.mark.parametrize("by", list(ColourBy))
def test_every_way_of_colouring_reports_points_apart(save, injected, by):
    saved = save(injected, colour_by=by, sensors=("top",))
    assert saved.report.drives[0].colours == {"top": by.value}
    colours = saved.timed(f"{SENSORS}/top/points", "Points3D:colors")[0].array("Points3D:colors")
    assert len(np.unique(colours)) >= 4


def test_radar_returns_depths_fixes_and_corrected_trajectories_are_shown_as_they_are(injected_saved):
    arrows = injected_saved.timed(f"{SENSORS}/radar_front/velocities", "Arrows3D:vectors")[0]
    points = RANDOM_POINTS[0][:5].astype(np.float64)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)  # as long as its way in a second
    assert np.allclose(arrows.array("Arrows3D:vectors"), directions * np.linspace(-2, 2, 5)[:, None], atol=SINGLE)
    assert np.allclose(arrows.array("Arrows3D:origins"), points, atol=SINGLE)
    row = injected_saved.timed(f"{SENSORS}/depth/image", "DepthImage:buffer")[1]
    steps = np.unique(np.frombuffer(bytes(row.values["DepthImage:buffer"][0]), np.uint16))
    assert row.values["DepthImage:meter"] == [256.0]
    measured = np.rint((np.arange(48 * 64) % 500 + 1) * 0.001 * 256)
    assert (set(steps) <= {0.0, *measured}, len(steps) > 50) == (True, True), "none is made up"
    path = r"/injected/world/corrected\ trajectories/adjust-1"
    strip = np.array(injected_saved.lasting(path, "LineStrips3D:strips")[0])
    locations, rotations = ego_at(TRAJECTORY_TIMES)
    assert np.allclose(strip, rotations.apply(locations) + locations + 0.01, atol=SINGLE)
    fixes = injected_saved.arrays("/injected/earth/antenna/fix", "GeoPoints:positions")
    assert fixes[2].tolist() == [[48.1001, 11.5001]]
    heights = injected_saved.arrays("/injected/gnss/antenna/height", "Scalars:scalars")
    assert np.array_equal(heights, [[520.5]] * 3)
    inertial = injected_saved.arrays("/injected/imu/imu_box/accelerometer", "Scalars:scalars")
    assert np.allclose(inertial, np.linspace(9, 10, 9).reshape(3, 3))


def with_camera(scene, camera_model, images):
    """The drive with one camera alone."""
    camera = next(sensor for sensor in scene.cameras if sensor.id == "left")
    frames = LazyFrames.of(images, [image.timestamp_ns for image in images])
    alone = replace(camera, camera=camera_model, images=frames, video=None)
    return replace(scene, sensors=(alone,), annotations=())


def test_images_of_a_pinhole_are_its_own_files_and_those_of_a_bent_camera_model_straight(save, injected):
    camera_model = Camera("pinhole", 64, 48, 50.0, 51.0, 31.0, 24.0)
    images = [replace(image, camera=camera_model) for image in injected.cameras[0].images]
    saved = save(with_camera(injected, camera_model, images))
    shown = saved.timed(f"{SENSORS}/left/image", "EncodedImage:blob")
    assert [bytes(row.values["EncodedImage:blob"][0]) for row in shown] == [jpeg(k) for k in range(3)]
    matrix = pinhole_of(saved)
    assert np.allclose(matrix, [[50.0, 0.0, 31.5], [0.0, 51.0, 24.5], [0.0, 0.0, 1.0]])  # counted from the corner
    camera_model = Camera("brown_conrady", 400, 300, 250.0, 250.0, 199.5, 149.5, (-0.3, 0.1, 0.002, -0.001, 0.0))
    marks = np.array([[-0.5, -0.35, 1.0], [0.45, -0.3, 1.0], [0.1, 0.2, 1.0], [-0.4, 0.3, 1.0]])
    none, coefficients = np.zeros(3), np.array(camera_model.coefficients)
    pixels, _ = cv2.projectPoints(marks, none, none, camera_model.matrix, coefficients)
    rgb = np.zeros((300, 400, 3), np.uint8)
    for u, v in np.rint(pixels.reshape(-1, 2)).astype(int):
        rgb[v - 2 : v + 3, u - 2 : u + 3] = 255
    saved = save(with_camera(injected, camera_model, [CameraImage.of(int(SHOTS[0]), camera_model, rgb)]))
    rows = saved.rows[f"{SENSORS}/left/image"]
    matrix = pinhole_of(saved)
    content = bytes(next(r.values["EncodedImage:blob"][0] for r in rows if "EncodedImage:blob" in r.values))
    shown = np.asarray(Image.open(io.BytesIO(content)).convert("L"), np.float64)
    count, _, _, centres = cv2.connectedComponentsWithStats((shown > 128).astype(np.uint8))
    assert count == 1 + len(marks)
    expected = (marks @ matrix.T)[:, :2] - 0.5
    for location in expected:  # marks of five pixels around a rounded location, resampled and encoded: a pixel at most
        assert np.linalg.norm(centres[1:] - location, axis=1).min() < 1.0


def test_what_is_drawn_into_a_bent_image_follows_it(injected_saved):
    matrix = pinhole_of(injected_saved)
    points = injected_saved.timed(f"{SENSORS}/left/image/points", "Points2D:positions")[0]
    drawn = np.array([[10.0, 20.0], [11.0, 20.0]]) - 0.5
    straight = cv2.undistortPoints(drawn[:, None], CAMERA_MODEL.matrix, np.array(CAMERA_MODEL.coefficients))[:, 0]
    expected = (np.column_stack([straight, np.ones(2)]) @ matrix.T)[:, :2]
    assert np.allclose(points.array("Points2D:positions"), expected, atol=2e-3)  # OpenCV iterates to 1e-3 of a pixel


def test_a_cuboid_is_at_each_moment_where_its_path_leads_with_its_trail_and_links(injected_saved):
    rows = injected_saved.timed("/injected/world/annotations/cuboids/car", "Boxes3D:centers")
    moments = {row.time_ns: row for row in rows if row.values["Boxes3D:centers"]}
    assert set(map(int, TIMES)) <= set(moments)
    middle = moments[reference_ns(1)]
    share = (reference_ns(1) - TIMES[1]) / 1e8
    assert np.allclose(middle.array("Boxes3D:centers"), [[11.0 + share, 1.0, 0.75]], atol=SINGLE)
    assert np.allclose(middle.array("Boxes3D:half_sizes"), [[2.0, 1.0, 0.75]])
    rotation = Rotation.from_quat(middle.array("Boxes3D:quaternions")[0]).as_euler("xyz", degrees=True)
    assert np.allclose(rotation, [0.0, 0.0, 5.0 + 5.0 * share], atol=1e-3)
    assert middle.values["attributes"] == ["speed fast"]
    assert (middle.values["parent"], middle.values["links"]) == (["group-1"], ["drives: points person-1"])
    assert moments[int(TIMES[1])].values["seen_by"] == ["top"]
    trails = injected_saved.timed("/injected/world/annotations/cuboids/car/trails", "LineStrips3D:strips")
    trail = next(row for row in trails if row.time_ns == TIMES[2]).array("LineStrips3D:strips")[0]
    assert np.allclose(trail, [[10.0 + k, 1.0, 0.75] for k in range(3)], atol=SINGLE)
    links = injected_saved.timed("/injected/world/annotations/links/drives", "Arrows3D:vectors")
    first = next(row for row in links if row.time_ns == TIMES[0])
    assert np.allclose(first.array("Arrows3D:origins"), [[10.0, 1.0, 0.75]])
    assert np.allclose(first.array("Arrows3D:vectors"), [[-5.0, 0.0, -0.75]])
    late = [row for row in rows if row.time_ns > TIMES[2]]
    assert late
    assert all(row.values["Boxes3D:centers"] == [] for row in late)


def test_events_and_findings_are_in_the_log_relations_a_graph_and_all_annotations_listed(injected_saved):
    rows = injected_saved.timed("/injected/events/event-1", "StateChange:state")
    reported = [(row.time_ns, row.values["StateChange:state"]) for row in rows]
    assert reported == [(TIMES[1], ["braking"]), (TIMES[1] + 30_000_000, [""])]
    assert "state fast" in rows[0].values["TextLog:text"][0]
    edges = injected_saved.lasting("/injected/relations", "GraphEdges:edges")
    pairs = {(edge["first"], edge["second"]) for edge in edges}
    assert {("group-1", "car-1"), ("object-1", "group-1"), ("car-1", "person-1")} <= pairs
    table = injected_saved.lasting("/injected/annotations", "TextDocument:text")[0]
    for name in ("car-1", "sign-1", "person-1", "tree-1", "adjust-1", "calib-1", "odd-1"):
        assert name in table
    notes = injected_saved.timed("/injected/notes", "TextLog:text")
    assert notes[0].values["TextLog:level"] == ["ERROR"], "the worst first"
    texts = " ".join(row.values["TextLog:text"][0] for row in notes)
    for word in ("cycle", "without distortion", "'scribble'", "'temperature'"):
        assert word in texts


def test_every_camera_has_a_view_and_no_map_is_fetched_unless_it_is_asked_for(save, injected, injected_saved):
    def kinds(saved):
        return {v[0] for name, v in saved.layout if name == "ViewBlueprint:class_identifier" and v}

    assert "Map" not in kinds(injected_saved)
    assert "Map" in kinds(save(injected, map_tiles=True))
    names = [value[0] for name, value in injected_saved.layout if name == "ViewBlueprint:display_name" and value]
    assert {"left", "right", "depth", "world", "from afar", "log", "events", "accelerometer"} <= set(names)
    assert ("ViewportBlueprint:auto_views", [False]) in injected_saved.layout


def test_a_drive_is_cut_in_time_in_number_and_by_sensor_and_several_have_roots_of_their_own(save, injected):
    thin = save(injected, every=2).report.drives[0].logged
    assert (thin["sweeps"], thin["images"]) == (2, 4)
    sweeps = save(injected, start=0.09).timed(f"{SENSORS}/top/points", "Points3D:positions")
    assert [(row.time_ns, row.frame) for row in sweeps] == [(reference_ns(k), k) for k in (1, 2)]
    alone = save(injected, sensors=("left",)).report.drives[0].logged
    assert (alone["images"], "sweeps" in alone) == (3, False)
    with pytest.raises(OptionError, match="nobody"):
        save(injected, sensors=("nobody",))
    saved = save(injected, injected)
    assert [drive.root for drive in saved.report.drives] == ["/injected", r"/injected\ \(2\)"]
    assert {f"{root}/world/ego" for root in ("/injected", r"/injected\ \(2\)")} <= set(saved.rows)
    ViewSettings(detections="f.jsonl")  # the settings alone are fine
    with pytest.raises(OptionError, match="one drive"):
        save(injected, injected, tracks="t.jsonl")


def test_a_world_far_away_is_shown_from_near_the_drive_and_one_without_a_trajectory_from_the_ego(save, injected):
    far = np.array([691_234.5, 5_334_567.25, 500.0])
    trajectory, lidar = injected.trajectories["vio"], injected.lidars[0]
    moved = replace(trajectory, positions=trajectory.positions + far)
    own = replace(lidar.poses, positions=lidar.poses.positions + far)
    bare = replace(injected, annotations=())
    saved = save(replace(bare, sensors=(replace(lidar, poses=own),), trajectories={"vio": moved}))
    origin = np.array(saved.report.drives[0].origin)
    assert np.abs(far - origin).max() <= 51.0
    assert (origin % 100 == 0).all()
    row = saved.timed(f"{SENSORS}/top", "Transform3D:translation")[0]
    locations, rotations = ego_at(np.array([reference_ns(0)]))
    where = locations[0] + rotations[0].apply([1.0, 0.0, 1.8]) + far - origin
    assert np.allclose(row.array("Transform3D:translation")[0], where, atol=1e-4)
    saved = save(replace(bare, sensors=(replace(lidar, poses=None, parent_id=None),), trajectories={}))
    row = saved.timed(f"{SENSORS}/top", "Transform3D:translation")[0]
    assert np.allclose(row.array("Transform3D:translation"), [[1.0, 0.0, 1.8]])
    assert "ego-stands-still" in {warning.code for warning in saved.report.drives[0].warnings}


def test_an_interrupted_save_leaves_nothing_and_a_file_that_is_there_stays(injected, tmp_path):
    def stop(done, total):
        if done == 4:
            raise KeyboardInterrupt

    target = tmp_path / "drive.rrd"
    with pytest.raises(KeyboardInterrupt):
        save_view([injected], target, progress=stop)
    assert list(tmp_path.iterdir()) == []
    target.write_bytes(b"mine")
    with pytest.raises(OutputError, match="--overwrite"):
        save_view([injected], target)
    assert target.read_bytes() == b"mine"
    with pytest.raises(OptionError, match=r"\.rrd"):
        save_view([injected], tmp_path / "drive.mcap")


def test_a_broken_image_is_an_error_with_its_location_or_passed_over(save, injected):
    def torn():
        raise DataError("drive", "images[1]", "is torn")

    camera: CameraSensor = injected.cameras[0]
    images = [replace(p, encoded=None, decode=torn) if k == 1 else p for k, p in enumerate(camera.images)]
    scene = with_camera(injected, camera.camera, images)
    with pytest.raises(DataError, match="is torn"):
        save(scene)
    saved = save(scene, reading={"lenient": True})
    assert saved.report.drives[0].logged["images"] == 2
    assert "is torn" in {warning.message for warning in saved.report.drives[0].warnings}
