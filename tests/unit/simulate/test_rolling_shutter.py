import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, unproject
from sceneloom.errors import OptionError
from sceneloom.simulate import CameraSpec, ExposureSpec, LidarSpec, camera_mount, simulate_street
from sceneloom.simulate.camera import RenderedCamera
from sceneloom.simulate.drive import Truth
from sceneloom.simulate.objects import Mover, MovingDesign, PackedShapes, Part, pack_movers
from sceneloom.simulate.street import GroundMap, Lane, Street
from sceneloom.simulate.trajectory import EgoPath

CAMERA_MODEL = Camera("pinhole", 160, 120, 100.0, 100.0, 79.5, 59.5)
READOUT_NS = 40_000_000
SPEED = 10.0
LEFT = camera_mount(position=(0.0, 0.0, 1.6), yaw_deg=90.0)
AHEAD = camera_mount(position=(0.0, 0.0, 1.6))


@pytest.fixture(scope="module")
def moving_path():
    """An ego that drives along x at 10 m/s, at the origin at time zero."""
    along = SPEED * (np.arange(40) - 20.0)
    path = EgoPath(0, -17.0, np.column_stack([along, np.zeros(40)]), np.zeros((3, 1, 3)))
    shift = path.at_seconds(np.zeros(1)).positions[0, :2]
    return replace(path, control_points=path.control_points - shift)


@pytest.fixture(scope="module")
def image_of(street_of, moving_path):
    """The truth of one image, taken at time zero, of the given shapes."""

    def make(shapes, mount, **options):
        spec = CameraSpec(CAMERA_MODEL, mount, **options)
        street = street_of(shapes, moving_path)
        return RenderedCamera.of(spec, street, moving_path, timestamps_ns=np.zeros(1, np.int64)).truth(0)

    return make


@pytest.fixture(scope="module")
def rolling_drive():
    """A drive seen by the same camera with a global and with a rolling shutter."""
    cameras = (
        CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=70.0)),
        CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=70.0), readout_ns=READOUT_NS),
    )
    return simulate_street(3, frames=4, lidar=LidarSpec(beams=32, steps=600), cameras=cameras)


def middles(mask):
    """Middle column of the marked pixels of each row [px], NaN in rows without."""
    columns = np.where(mask, np.arange(mask.shape[1]), np.nan)
    with np.errstate(invalid="ignore"):
        return np.array([np.nan if np.isnan(row).all() else np.nanmean(row) for row in columns])


def test_an_upright_pole_beside_the_road_slants_by_the_way_driven_while_the_rows_are_read(image_of, box):
    pole = box([0.0, 8.05, 5.0], [0.15, 0.05, 5.0])
    upright = middles(image_of([pole], LEFT).instances == 1)
    slanted = middles(image_of([pole], LEFT, readout_ns=READOUT_NS).instances == 1)
    rows = np.flatnonzero(~np.isnan(slanted))
    assert len(rows) > 60
    seconds = ((rows + 0.5) / 120 - 0.5) * READOUT_NS * 1e-9
    # The face is 8 m away; a camera that drives to the right sees the pole move to the left, 125 px a second.
    expected = 79.5 - 100.0 * SPEED * seconds / 8.0
    # The middle of whole pixels is off by half a pixel at most.
    np.testing.assert_allclose(slanted[rows], expected, atol=0.5)
    assert slanted[rows[0]] - slanted[rows[-1]] == pytest.approx(125.0 * np.ptp(seconds), abs=1.0)
    assert np.ptp(seconds) > 0.02
    assert np.nanmax(upright) - np.nanmin(upright) < 1e-9


def test_what_moves_past_a_stationary_camera_slants_as_well(stationary_path, box):
    pole = box([0.0, 0.0, 5.0], [0.15, 0.05, 5.0])
    seconds = 0.5 * np.arange(-10.0, 20.0)
    curve = np.column_stack([6.0 * seconds, np.full(30, 8.05), np.zeros(30), np.zeros(30)])
    movers = pack_movers(
        [Mover(1, "car", (0.3, 0.1, 10.0), -(10**10), 10**10, stands=False)],
        [MovingDesign("car", (Part((pole,)),), (0.3, 0.1, 10.0))],
        curve[None],
        start_ns=0,
        first_knot=-4.0,
        knot_step=0.5,
    )
    street = Street((), PackedShapes.of([], []), GroundMap.of(Lane.of(stationary_path)), movers)
    spec = CameraSpec(CAMERA_MODEL, LEFT, readout_ns=READOUT_NS)
    camera = RenderedCamera.of(spec, street, stationary_path, timestamps_ns=np.zeros(1, np.int64))
    slanted = middles(camera.truth(0).instances == 1)
    rows = np.flatnonzero(~np.isnan(slanted))
    assert len(rows) > 60
    # 6 m/s to the right at 8 m are 75 px a second.
    expected = 79.5 + 75.0 * ((rows + 0.5) / 120 - 0.5) * READOUT_NS * 1e-9
    np.testing.assert_allclose(slanted[rows], expected, atol=0.5)
    assert slanted[rows[-1]] - slanted[rows[0]] > 1.0


def test_columns_that_are_read_from_the_left_make_what_passes_narrower(image_of, box):
    wall = box([0.0, 9.0, 5.0], [3.0, 1.0, 5.0])
    still = (image_of([wall], LEFT).instances[40] == 1).sum()
    seen = (image_of([wall], LEFT, readout_ns=READOUT_NS, left_to_right=True).instances[40] == 1).sum()
    # An edge at x is seen in the column u with u = 79.5 + 12.5 (x - 10 t), t = ((u + 0.5) / 160 - 0.5) 0.04.
    pace = 12.5 * SPEED * 0.04 / 160
    assert still == pytest.approx(6 * 12.5, abs=1)
    assert seen == pytest.approx(6 * 12.5 / (1 + pace), abs=1)
    assert seen < still


def test_each_rows_depth_is_that_at_the_rows_time(image_of, box):
    wall = box([21.0, 0.0, 20.0], [1.0, 60.0, 20.0])
    depths = image_of([wall], AHEAD, readout_ns=READOUT_NS).depths
    rows = np.arange(70)
    expected = 20.0 - SPEED * ((rows + 0.5) / 120 - 0.5) * 0.04
    np.testing.assert_allclose(depths[:60], np.repeat(expected[:60, None], 160, axis=1), atol=1e-5)
    assert depths[0, 0] - depths[59, 0] == pytest.approx(SPEED * 0.04 * 59 / 120, abs=1e-5)


def test_line_poses_are_trajectory_and_mounting_at_each_lines_time(rolling_drive):
    camera = rolling_drive.truth.cameras["camera1"]
    rotations, origins = camera.line_poses(2)
    timestamp = rolling_drive.scene.sensor("camera1").images.timestamps_ns[2]
    times = timestamp + np.rint(((np.arange(120) + 0.5) / 120 - 0.5) * READOUT_NS).astype(np.int64)
    np.testing.assert_array_equal(camera.line_times_ns(2), times)
    ego = rolling_drive.truth.path.at(times)
    world_from_ego = Rotation.from_matrix(ego.rotations)
    mount = camera_mount(yaw_deg=70.0)
    composed = world_from_ego * Rotation.from_matrix(mount.rotation.copy())
    np.testing.assert_allclose(rotations, composed.as_matrix(), atol=1e-12)
    expected = world_from_ego.apply(mount.translation.copy()) + ego.positions
    np.testing.assert_allclose(origins, expected, atol=1e-12)


def test_depths_along_the_rays_from_the_lines_poses_end_on_the_ground(rolling_drive):
    camera, truth = rolling_drive.truth.cameras["camera1"], rolling_drive.truth.image("camera1", 2)
    rotations, origins = camera.line_poses(2)
    row, column = np.nonzero(truth.instances == 0)
    rays = unproject(CAMERA_MODEL, np.column_stack([column, row]).astype(np.float64))
    points = rays / rays[:, 2:] * truth.depths[row, column][:, None].astype(np.float64)
    world = np.einsum("nij,nj->ni", rotations[row], points) + origins[row]
    assert len(world) > 3000
    # float32 holds 100 m in steps of 8e-6 m.
    np.testing.assert_allclose(world[:, 2], 0.0, atol=2e-5)


def test_the_line_that_sees_a_point_is_the_one_in_which_it_lies(rolling_drive):
    camera, truth = rolling_drive.truth.cameras["camera1"], rolling_drive.truth.image("camera1", 1)
    rotations, origins = camera.line_poses(1)
    row, column = np.nonzero((truth.depths > 0) & (truth.depths < 60))
    rays = unproject(CAMERA_MODEL, np.column_stack([column, row]).astype(np.float64))
    points = rays / rays[:, 2:] * truth.depths[row, column][:, None].astype(np.float64)
    world = np.einsum("nij,nj->ni", rotations[row], points) + origins[row]
    np.testing.assert_array_equal(camera.lines_seeing(1, world), row)
    # A ray that grazes an edge may fall on its other side.
    assert rolling_drive.truth.visible("camera1", 1, world).mean() > 0.995
    middle = rolling_drive.truth.world_from_camera("camera1", 1)
    pixels, inside = project(CAMERA_MODEL, middle.inverse().apply(world))
    assert np.nanmax(np.abs(pixels[inside] - np.column_stack([column, row])[inside])) > 3.0


def test_what_hides_a_point_is_asked_from_the_line_that_would_see_it(street_of, moving_path, box):
    shapes = [box([0.0, 4.05, 5.0], [0.15, 0.05, 5.0]), box([0.0, 21.0, 10.0], [60.0, 1.0, 10.0])]
    street = street_of(shapes, moving_path)
    spec = CameraSpec(CAMERA_MODEL, LEFT, readout_ns=READOUT_NS)
    camera = RenderedCamera.of(spec, street, moving_path, timestamps_ns=np.zeros(1, np.int64))
    truth = Truth(street, moving_path, {}, {"camera0": camera}, {}, None)
    row, column = np.nonzero(camera.truth(0).instances[:60] > 0)
    # A ray through a pixel of the line meets the wall, 20 m away, where nothing but the pole can stand before it.
    seconds = ((row + 0.5) / 120 - 0.5) * READOUT_NS * 1e-9
    along, down = (column - 79.5) / 100.0, (row - 59.5) / 100.0
    on_wall = np.column_stack([SPEED * seconds + 20.0 * along, np.full(len(row), 20.0), 1.6 - 20.0 * down])
    from_pole = np.abs(SPEED * seconds + 4.0 * along)
    on_wall, from_pole = on_wall[on_wall[:, 2] < 19.0], from_pole[on_wall[:, 2] < 19.0]
    free = truth.visible("camera0", 0, on_wall)
    # The pole is 0.15 m to either side; the line is known to half a line, in which the camera drives 2 mm.
    sure = np.abs(from_pole - 0.15) > 0.003
    np.testing.assert_array_equal(free[sure], from_pole[sure] > 0.15)
    assert 300 < (~free).sum() < len(free) / 10


def test_a_global_shutter_takes_the_middle_of_a_rolling_one(rolling_drive):
    still, rolling = (rolling_drive.truth.image(f"camera{k}", 1) for k in (0, 1))
    # The rows 59 and 60 are taken 0.17 ms before and after the image's time: 2 mm on the way.
    agreeing = [(still.instances[row] == rolling.instances[row]).mean() for row in (0, 59, 60, 119)]
    assert min(agreeing[1:3]) > 0.98
    assert agreeing[0] < min(agreeing[1:3])
    assert rolling_drive.scene.sensor("camera0").extras == {}


def test_images_of_rolling_shutters_are_the_true_colours_and_repeat(rolling_drive):
    images = rolling_drive.scene.sensor("camera1").images
    later = images[3].rgb
    assert not np.array_equal(images[0].rgb, later)
    np.testing.assert_array_equal(images[3].rgb, later)
    np.testing.assert_array_equal(later, rolling_drive.truth.colors("camera1", 3))


def test_a_recording_keeps_the_roll_time_and_the_exposure_time(tmp_path):
    cameras = (
        CameraSpec(CAMERA_MODEL, readout_ns=33_000_000, exposure=ExposureSpec(exposure_ns=4_000_000)),
        CameraSpec(CAMERA_MODEL, readout_ns=20_000_000, left_to_right=True),
    )
    scene = simulate_street(1, frames=2, lidar=LidarSpec(beams=4, steps=50), cameras=cameras).scene
    sceneloom.write(scene, tmp_path / "drive")
    entries = json.loads((tmp_path / "drive" / "calibration.json").read_text())["cameras"]
    assert [entry["shutterRollTimeSeconds"] for entry in entries] == [0.033, 0.02]
    assert [entry.get("rollingShutterLeftToRight") for entry in entries] == [None, True]
    assert entries[0]["model"] == "pinhole"
    with sceneloom.open(tmp_path / "drive") as again:
        first, second = again.cameras
        assert first.extras["calibration"]["shutterRollTimeSeconds"] == 0.033
        assert second.extras["calibration"]["rollingShutterLeftToRight"] is True
        assert first.images[1].extras["exposureTimeSeconds"] == 0.004
        assert "exposureTimeSeconds" not in second.images[1].extras
        np.testing.assert_array_equal(first.images.timestamps_ns, scene.cameras[0].images.timestamps_ns)


def test_a_scene_file_keeps_the_roll_time_and_the_exposure_time(tmp_path):
    cameras = (CameraSpec(CAMERA_MODEL, readout_ns=33_000_000, exposure=ExposureSpec(exposure_ns=4_000_000)),)
    scene = simulate_street(1, frames=2, lidar=LidarSpec(beams=4, steps=50), cameras=cameras).scene
    sceneloom.write(scene, tmp_path / "drive.sfs")
    with sceneloom.open(tmp_path / "drive.sfs") as again:
        camera = again.cameras[0]
        assert camera.extras["calibration"]["shutterRollTimeSeconds"] == 0.033
        assert camera.images[1].extras["exposureTimeSeconds"] == 0.004
        np.testing.assert_array_equal(camera.images.timestamps_ns, scene.cameras[0].images.timestamps_ns)


def test_shutters_that_cannot_be_are_refused():
    for wrong in (-1, 200_000_000):
        with pytest.raises(OptionError, match="readout_ns"):
            CameraSpec(readout_ns=wrong)
