"""A drive as coloured clouds and depth images: maps, labels there and back, blind sensors, and what is refused."""

import json
from dataclasses import replace

import laspy
import numpy as np
import pytest
from PIL import Image

import sceneloom
from sceneloom import simulate as sim
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.points.cloud import NO_LABEL
from sceneloom.formats.points.files import read_cloud
from sceneloom.pipeline import ColourOutputs, ColourSettings, colour, iter_fused
from sceneloom.pipeline.depth_images import write_depth_images
from sceneloom.scene import CameraImage, LabeledPointsAnnotation, LazyFrames, LidarFrame, LidarPoints
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

CAMERA_MODEL = Camera("pinhole", 320, 200, 190.0, 190.0, 159.5, 99.5)
FRAMES = 4


@pytest.fixture(scope="module")
def exposed(tmp_path_factory):
    """Two cameras that overlap, each with an automatic of its own; from files, so that images are made once."""
    cameras = [
        CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=yaw), exposure=sim.ExposureSpec(drift_stops=0.4), supersampling=2)
        for yaw in (0.0, 55.0)
    ]
    drive = simulate_street(21, frames=FRAMES, lidar=LidarSpec(beams=32, steps=600), cameras=cameras)
    folder = tmp_path_factory.mktemp("drives") / "drive"
    sceneloom.write(drive.scene, folder, images="png")
    with sceneloom.open(folder) as scene:
        yield replace(drive, scene=scene)


def label_folder(scene, folder, *, name="{number:06d}", camera="camera0"):
    """Label images whose number is the column's hundred, so that left and right differ."""
    location = folder / camera
    location.mkdir(parents=True)
    image = np.broadcast_to(np.where(np.arange(320) < 160, 3, 300).astype(np.uint16), (200, 320))
    images = next(c for c in scene.cameras if c.id == camera).images
    for number, time_ns in enumerate(images.timestamps_ns.tolist()):
        Image.fromarray(image).save(location / (name.format(number=number, time_ns=time_ns) + ".png"))
    return folder


def mean_error(drive, folder, *, exposure):
    """Mean difference of colours from the exact ones, all sweeps brightened alike by the best factor."""
    settings = ColourSettings(exposure=exposure)
    colour(drive.scene, settings=settings, outputs=ColourOutputs(per_sweep=folder))
    colors, truth = [], []
    for k in range(FRAMES):
        cloud = read_cloud(folder / f"{k:06d}.ply").columns
        seen = cloud["camera"] != 255
        found = np.stack([cloud[name] for name in ("red", "green", "blue")], axis=1)
        colors.append(found[seen].astype(float))
        truth.append(drive.truth.clean_points_world(k).colors[seen].astype(float))
    found, wanted = np.concatenate(colors), np.concatenate(truth)
    factor = np.median(found / np.maximum(wanted, 1))
    return float(np.abs(found - np.minimum(factor * wanted, 255)).mean())


def test_evening_out_exposures_takes_a_quarter_of_the_error(exposed, tmp_path):
    plain, evened = (mean_error(exposed, tmp_path / str(flag), exposure=flag) for flag in (False, True))
    assert evened < 0.75 * plain


def test_a_map_holds_every_point_of_every_sweep_with_its_time_and_provenance_or_the_coloured_only(exposed, tmp_path):
    report = colour(exposed.scene, tmp_path / "map.las", settings=ColourSettings(provenance=True))
    read = laspy.read(tmp_path / "map.las")
    clouds = [frame.points for frame in iter_fused(exposed.scene)]
    assert report.written == len(read) == sum(map(len, clouds))
    times = np.concatenate([points.timestamps_ns for points in clouds]) * 1e-9
    np.testing.assert_allclose(np.asarray(read.gps_time), times, atol=1e-6)
    seen, images = np.asarray(read.camera) != 255, np.asarray(read.image)
    assert report.coloured_percent == pytest.approx(100 * seen.mean())
    assert (images[seen] >= 0).all()
    assert (images[~seen] == -1).all()
    assert (np.asarray(read.weight)[seen] > 0).all()
    # the pixel that is named has the colour, but for the gain and what lies between pixels
    for k in np.flatnonzero(seen)[::97].tolist():
        camera = exposed.scene.cameras[int(read.camera[k])]
        assert 0 <= read.u[k] + 0.5 <= camera.images[int(read.image[k])].camera.width
    first = exposed.truth.clean_points_world(0).positions_world
    assert np.median(np.linalg.norm(read.xyz[: len(first)] - first, axis=1)) < 0.05  # noise of the lidar
    report = colour(exposed.scene, tmp_path / "coloured.las", settings=ColourSettings(only_coloured=True))
    assert (np.asarray(laspy.read(tmp_path / "coloured.las").camera) != 255).all()
    assert report.written == round(report.points * report.coloured_percent / 100)


@pytest.mark.parametrize("suffix", [".las", ".laz", ".ply", ".pcd", ".sfs"])
@pytest.mark.few(2)
def test_a_map_of_cubes_has_one_point_for_each(exposed, tmp_path, suffix):
    report = colour(exposed.scene, tmp_path / f"map{suffix}", settings=ColourSettings(voxel=0.5))
    if suffix == ".sfs":
        with sceneloom.open(tmp_path / "map.sfs") as scene:
            (sensor,) = scene.sensors
            positions, colors = sensor.positions.copy(), sensor.colors.copy()
        assert len(colors) == len(positions)
    else:
        cloud = read_cloud(tmp_path / f"map{suffix}").columns
        positions = np.stack([cloud[axis] for axis in "xyz"], axis=1)
    assert len(positions) == report.written < 0.5 * report.points
    # means of points lie in their own cubes; the origin of the cubes is the ego's first position
    origin = 0.0 if suffix == ".sfs" else exposed.scene.trajectories["groundTruth"].positions[0]
    cubes = np.floor((positions - origin) / 0.5)
    # the road lies in a face of the cubes, which rounding to a millimetre moves some points over
    assert len(np.unique(cubes, axis=0)) > 0.95 * len(positions)


def test_labels_go_onto_points_by_number_and_by_time_into_every_kind_of_file_and_back_into_images(exposed, tmp_path):
    by_number = label_folder(exposed.scene, tmp_path / "numbers")
    by_time = label_folder(exposed.scene, tmp_path / "times", name="{time_ns}")
    (by_number / "labels.json").write_text(json.dumps({"3": "left"}))
    first = colour(exposed.scene, tmp_path / "a.las", settings=ColourSettings(labels=by_number))
    colour(exposed.scene, tmp_path / "b.las", settings=ColourSettings(labels=by_time))
    a, b = laspy.read(tmp_path / "a.las"), laspy.read(tmp_path / "b.las")
    assert (np.asarray(a.label) == np.asarray(b.label)).all()
    assert set(np.unique(a.label).tolist()) == {3, 300, NO_LABEL}
    assert (np.asarray(a.classification)[np.asarray(a.label) == 3] == 3).all()
    assert (np.asarray(a.classification)[np.asarray(a.label) != 3] == 0).all()
    assert (first.labels.images, first.labels.missing, first.labels.classes) == (FRAMES, FRAMES, 2)
    assert first.labels.points == int((np.asarray(a.label) != NO_LABEL).sum())
    colour(exposed.scene, tmp_path / "c.sfs", settings=ColourSettings(labels=by_number))
    with sceneloom.open(tmp_path / "c.sfs") as scene:
        assert {each.label for each in scene.annotations} == {"left", "300"}
        assert sum(len(e.labeled_points[0].point_ids) for e in scene.annotations) == first.labels.points
    labels = label_folder(exposed.scene, tmp_path / "labels")
    outputs = ColourOutputs(per_sweep=tmp_path / "drive.sfs")
    colour(exposed.scene, settings=ColourSettings(labels=labels), outputs=outputs)
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        assert len(scene.lidars[0].frames) == FRAMES
        kinds = [each for each in scene.annotations if isinstance(each, LabeledPointsAnnotation)]
        assert {each.label for each in kinds} == {"3", "300"}
        report = colour(scene, outputs=ColourOutputs(project_labels=tmp_path / "back"))
    assert report.labels.drawn == 2 * FRAMES
    assert json.loads((tmp_path / "back" / "labels.json").read_text()) == {"3": "3", "300": "300"}
    wrong = drawn = 0
    for number in range(FRAMES):
        found = np.asarray(Image.open(tmp_path / "back" / "camera0" / f"{number:06d}.png"))
        wanted = np.asarray(Image.open(labels / "camera0" / f"{number:06d}.png"))
        drawn += int((found > 0).sum())
        wrong += int(((found > 0) & (found != wanted)).sum())
    assert drawn > 5000
    assert wrong < 0.005 * drawn  # float32 positions and microseconds in the file move points over a pixel's edge


def test_moving_points_are_left_out_by_boxes_and_by_rays_and_counted(tmp_path):
    drive = simulate_street(8, frames=22, lidar=LidarSpec(beams=24, steps=400), cameras=(), traffic=sim.TrafficSpec())
    (tmp_path / "rays").mkdir()
    settings = ColourSettings(remove_moving=True)
    report = colour(drive.scene, settings=settings, outputs=ColourOutputs(per_sweep=tmp_path / "rays" / "s"))
    assert report.removed_in_boxes + report.removed_by_rays > 200
    truth = [np.linalg.norm(drive.truth.clean_points_world(k).velocities, axis=1) > 0.5 for k in range(22)]
    left = sum(read_cloud(path).count for path in (tmp_path / "rays" / "s").glob("*.ply"))
    removed = sum(map(len, truth)) - left
    assert removed == report.removed_in_boxes + report.removed_by_rays
    assert 0.5 * sum(t.sum() for t in truth) < removed < 1.2 * sum(t.sum() for t in truth)


def test_a_drive_without_cameras_is_a_map_without_colours(tmp_path):
    drive = simulate_street(8, frames=2, lidar=LidarSpec(beams=8, steps=90), cameras=())
    report = colour(drive.scene, tmp_path / "map.las")
    assert report.coloured_percent == 0
    assert report.exposure is None
    assert (np.asarray(laspy.read(tmp_path / "map.las").red) == 128 * 257).all()
    with pytest.raises(DataError, match="expected a scene with cameras"):
        colour(drive.scene, tmp_path / "b.las", settings=ColourSettings(labels=tmp_path))


def test_label_images_that_do_not_fit_are_refused_with_their_names(exposed, tmp_path):
    def refused(settings_folder, match):
        with pytest.raises(DataError, match=match):
            colour(exposed.scene, tmp_path / "m.las", settings=ColourSettings(labels=settings_folder))
        assert not (tmp_path / "m.las").exists()

    refused(tmp_path / "nowhere", "no such folder")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", r"no label image in it; expected camera0/<number or time>\.png")
    small = label_folder(exposed.scene, tmp_path / "small")
    Image.new("L", (32, 20)).save(small / "camera0" / "000002.png")
    refused(small, r"000002\.png: 32x20 pixels; expected 320x200")
    Image.new("RGB", (320, 200)).save(small / "camera0" / "000002.png")
    refused(small, r"pixels are colours \(RGB\)")
    (small / "camera0" / "000002.png").write_bytes(b"nothing")
    refused(small, "is no PNG file")
    (small / "camera0" / "000002.png").rename(small / "camera0" / "rose.png")
    refused(small, r"rose\.png: named for no image")


def test_what_cannot_be_done_is_refused_before_anything_is_written(exposed, tmp_path):
    (tmp_path / "there.las").touch()
    twice, back = ColourOutputs(map=tmp_path / "m.las", images=tmp_path / "m.las"), tmp_path / "back"
    for error, message, arguments, options in (
        (OptionError, r"'\.xyz'; expected one of \.las \.laz \.ply \.pcd .* or \.sfs", ("map.xyz",), {}),
        (OptionError, "nothing to write", (), {}),
        (OptionError, "named twice", (), {"outputs": twice}),
        (OutputError, "exists already", ("there.las",), {}),
        (DataError, "no labelled points", (), {"outputs": ColourOutputs(project_labels=back)}),
    ):
        with pytest.raises(error, match=message):
            colour(exposed.scene, *(tmp_path / name for name in arguments), **options)
    with pytest.raises(OptionError, match="voxel -1"):
        ColourSettings(voxel=-1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there.las"]


def odd_scene(points, level=0, *, yaw_deg=0.0):
    """Three sweeps of these points, and a camera that takes images of one grey level."""
    cameras = [CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=yaw_deg))]
    drive = simulate_street(2, frames=3, lidar=LidarSpec(beams=4, steps=90), cameras=cameras)
    lidar, camera = drive.scene.lidars[0], drive.scene.cameras[0]
    times = lidar.frames.timestamps_ns.tolist()
    cloud = LidarPoints(np.asarray(points, np.float32).reshape(-1, 3))
    sweeps = LazyFrames.of([LidarFrame(time_ns, cloud) for time_ns in times], times)
    timestamps = camera.images.timestamps_ns.tolist()
    rgb = np.full((200, 320, 3), level, np.uint8)
    images = LazyFrames.of([CameraImage.of(time_ns, CAMERA_MODEL, rgb) for time_ns in timestamps], timestamps)
    sensors = (replace(lidar, frames=sweeps), replace(camera, images=images))
    return replace(drive.scene, sensors=sensors)


@pytest.mark.parametrize(
    ("points", "level", "yaw_deg", "coloured"),
    [
        ([[8.0, 0.0, 0.0]], 90, 0.0, 3),  # one point
        ([[8.0, 0.0, 0.0]], 90, 180.0, 0),  # behind the camera
        ([], 90, 0.0, 0),
        ([[8.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [np.inf, 1.0, 1.0]], 90, 0.0, 3),
        (np.random.default_rng(0).uniform(5, 20, (900, 3)) * [1, 0.2, 0.05], 0, 0.0, None),  # all black
    ],
)
@pytest.mark.few(2)
def test_odd_drives_become_maps_all_the_same(tmp_path, points, level, yaw_deg, coloured):
    scene = odd_scene(points, level, yaw_deg=yaw_deg)
    report = colour(scene, tmp_path / "map.las", settings=ColourSettings(remove_moving=True))
    read = laspy.read(tmp_path / "map.las")
    seen = np.asarray(read.camera) == 0
    assert (np.asarray(read.red)[seen] == level * 257).all()
    assert (np.asarray(read.red)[~seen] == 128 * 257).all()
    assert report.exposure.seam_before is None
    if coloured is not None:
        assert seen.sum() == coloured
    assert len(read) <= np.isfinite(np.asarray(points).reshape(-1, 3)).all(axis=1).sum() * 3


CAMERA = Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5)


@pytest.fixture(scope="module")
def drive():
    cameras = (
        CameraSpec(CAMERA, camera_mount()),
        CameraSpec(CAMERA, camera_mount(pitch_deg=-88.0)),  # sees the sky
    )
    return simulate_street(2, frames=3, lidar=LidarSpec(beams=16, steps=180), cameras=cameras)


def depths_of(folder, camera, number):
    with np.load(folder / camera / f"{number:06d}.npz") as arrays:
        return arrays["depth"], arrays["confidence"]


def test_depths_come_near_to_the_truth_where_they_are_sure(drive, tmp_path):
    report = write_depth_images(drive.scene, tmp_path / "out", form="npz")
    assert [(camera.camera, camera.images) for camera in report.cameras] == [("camera0", 3), ("camera1", 3)]
    depths, confidence = depths_of(tmp_path / "out", "camera0", 1)
    truth = drive.truth.depth("camera0", 1)
    sure = confidence > 0.9
    assert sure.mean() > 0.2
    right = np.abs(depths - truth) < np.maximum(0.5, 0.05 * truth)
    assert right[sure].mean() > 0.85


@pytest.mark.parametrize("method", ["sparse", "dense"])
def test_a_camera_that_sees_no_point_gets_empty_images(drive, tmp_path, method):
    report = write_depth_images(drive.scene, tmp_path / "out", method=method, cameras=["camera1"])
    (camera,) = report.cameras
    assert (camera.filled_percent, camera.images) == (0, 3)
    assert not np.array(Image.open(tmp_path / "out" / "camera1" / "000000.png")).any()
    assert not (tmp_path / "out" / "camera0").exists()


@pytest.mark.parametrize("sensor", ["lidar", "camera0"])
def test_blind_sensors_make_no_depths_out_of_nothing(drive, tmp_path, sensor):
    blind = sim.inject(drive, sim.Faults({sensor: sim.SensorFaults(blind=((0, 10**12),))}, seed=1))
    write_depth_images(blind.scene, tmp_path / "out", form="npz", cameras=["camera0"], images=tmp_path / "look")
    depths, confidence = depths_of(tmp_path / "out", "camera0", 0)
    if sensor == "lidar":
        assert not np.any([depths, confidence])
    else:
        truth = drive.truth.depth("camera0", 0)
        right = np.abs(depths - truth) < np.maximum(0.5, 0.05 * truth)
        assert right[confidence > 0.9].mean() > 0.85
    assert len(list((tmp_path / "look" / "camera0").iterdir())) == 3


def test_a_part_of_the_drive_keeps_its_numbers_and_wrong_values_are_refused_before_anything_is_read(drive, tmp_path):
    write_depth_images(drive.scene, tmp_path / "out", stop=0.35, cameras=["camera0"])
    lines = [json.loads(line) for line in (tmp_path / "out" / "index.jsonl").read_text().splitlines()]
    assert len(lines) == len(list((tmp_path / "out" / "camera0").glob("*.png"))) < 3
    assert all((tmp_path / "out" / line["file"]).is_file() for line in lines)
    for options in ({"method": "best"}, {"form": "tiff"}, {"cameras": ["roof"]}, {"images": tmp_path / "new"}):
        with pytest.raises(OptionError):
            write_depth_images(drive.scene, tmp_path / "new", **options)
    with pytest.raises(DataError, match="no lidar"):
        write_depth_images(replace(drive.scene, sensors=()), tmp_path / "new")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    with pytest.raises(OutputError):
        write_depth_images(drive.scene, tmp_path / "full")
    assert not (tmp_path / "new").exists()
