"""Camera models and mountings are written in the spelling that the vendor's software reads."""

import json
from types import MappingProxyType

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras import Camera, project_unbounded, unproject
from sceneloom.cameras.camera import MODELS
from sceneloom.errors import CalibrationError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.poses import mounting
from sceneloom.formats.recording.calibration import CameraParameters, camera_model, rigid_transform
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.formats.recording.write_calibration import camera_model_entry
from sceneloom.formats.recording.writer import write_recording
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CameraSensor, Coordinates, GnssSensor, ImuSensor, LazyFrames, Poses, Scene, VectorSamples


def camera(model, *coefficients):
    return Camera(model, 640, 480, 500.0, 501.0, 320.5, 240.25, coefficients)


WRITTEN = [
    (camera("pinhole"), "pinhole", []),
    (camera("fisheye", 0.1, -0.2, 0.3, -0.4), "kannala-brandt4", [0.1, -0.2, 0.3, -0.4]),
    (camera("fisheye", 0.1), "kannala-brandt4", [0.1, 0.0, 0.0, 0.0]),
    (camera("brown_conrady", *range(1, 6)), "brown-conrady", [*range(1, 6), 0.0, 0.0, 0.0]),
    (camera("brown_conrady", *range(1, 9), 0, 0, *range(11, 17)), "brown-conrady", [*range(1, 9), *range(11, 17)]),
    (camera("kannala_brandt18", *range(1, 19)), "kannala-brandt18", list(range(1, 19))),
    (camera("kannala_brandt18", 0.1, 0.2), "kannala-brandt18", [0.1, 0.2] + [0.0] * 16),
    (camera("omnidir", 1, 2, 3, 4, 5, 6), "omnidir", [1, 2, 3, 4, 5, 6]),
    # sixteen numbers without a prism
    (camera("brown_conrady", *range(1, 9), *[0.0] * 8), "brown-conrady", list(range(1, 9))),
]


@pytest.mark.parametrize(("exact", "model", "coefficients"), WRITTEN)
def test_camera_models_are_written_under_the_format_s_names(exact, model, coefficients):
    fields, how_far = camera_model_entry(exact)
    assert how_far is None
    assert fields == {
        "model": model,
        "distortionCoefficients": coefficients,
        "focalLengthX": 500.0,
        "focalLengthY": 501.0,
        "principalPointX": 320.5,
        "principalPointY": 240.25,
        "imageWidth": 640,
        "imageHeight": 480,
    }


STRANGERS = [
    camera("brown_conrady", -0.2, 0.05, 0, 0, 0, 0, 0, 0, 0.002, -0.001),
    camera("fisheye_rad_tan_prism", 0.05, -0.01, 0, 0, 0, 0, 1e-3, 0, 1e-3, 0, 0, 0),
    Camera("omnidirectional", 640, 480, 900.0, 900.0, 320.0, 240.0, (-0.1, 0.02, 0, 0, 0, 0, 1.1)),
    camera("mod_kannala", 0.02),
    camera("mod_equi_fish", 0.0, -0.02, 0.01, -0.003),
    Camera("ftheta", 640, 480, 1.0, 1.0, 320.0, 240.0, (0.0, 500.0, 0.0, -12.0, 2.0)),
    camera("fisheye_radial_custom", 0.05, -0.01, 0, 0, 0, 0, 1e-4, 0, 0.5, -0.3),
    Camera("cylindrical", 640, 480, 1500.0, 1500.0, 320.0, 240.0),
    Camera("equirectangular", 640, 480, 1500.0, 1500.0, 320.0, 240.0),
]


def test_every_model_is_either_written_or_fitted():
    assert {exact.model for exact in [*STRANGERS, *(exact for exact, _, _ in WRITTEN)]} == set(MODELS)


@pytest.mark.parametrize("exact", STRANGERS)
@pytest.mark.few(3)
def test_a_camera_model_that_the_format_lacks_is_fitted_and_the_error_that_is_left_is_stated(exact):
    fields, how_far = camera_model_entry(exact)
    assert how_far.startswith(f"{exact.model} camera model reported as ")
    # what the format's own reader makes of the fields
    written = camera_model(msgspec.convert(fields, CameraParameters), None, "calibration.json")
    u, v = np.meshgrid(np.linspace(-0.5, 639.5, 50), np.linspace(-0.5, 479.5, 40))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    off = np.hypot(*(project_unbounded(written, unproject(exact, pixels)) - pixels).T)
    stated = float(how_far.split("up to ")[1].split()[0])
    assert np.nanmax(off) <= 1.1 * stated
    assert stated < 1.5


def test_a_camera_model_that_nothing_of_the_format_comes_near_is_refused():
    for exact, problem in (
        (Camera("cylindrical", 640, 480, 110.0, 200.0, 320.0, 240.0), "cylindrical camera model reported as .* a"),
        (camera("periscope"), "camera model 'periscope'; a"),
    ):
        with pytest.raises(CalibrationError, match=f"{problem} recording can hold pinhole, fisheye"):
            camera_model_entry(exact)


MOUNT = RigidTransform(Rotation.from_euler("zyx", [0.3, -0.2, 0.9]).as_matrix(), np.array([1.5, -0.2, 0.7]))


def written_entry(folder, entry, mount=MOUNT):
    """The entry of a camera that came with one from a recording, as it is written."""
    still = ImuSensor("imu", {"gyroscope": VectorSamples(np.zeros(1, np.int64), np.zeros((1, 3)))})
    sensor = posed_camera(camera("fisheye"), mount=mount, extras=MappingProxyType({"calibration": entry}))
    write_recording(Scene((sensor, still)), folder, overwrite=True)
    (written,) = json.loads((folder / "calibration.json").read_text())["cameras"]
    return written


def test_what_else_a_recording_stated_of_a_camera_is_written_back(tmp_path):
    before = {"shutterRollTimeSeconds": 0.02, "model": "pinhole", "imuToCameraMatrix": [[1]], "note": {"a": 1}}
    entry = written_entry(tmp_path / "drive", before)
    assert (entry["model"], entry["shutterRollTimeSeconds"], entry["note"]) == ("kannala-brandt4", 0.02, {"a": 1})
    assert "imuToCameraMatrix" not in entry
    assert entry["imuToCamera"] == MOUNT.inverse().matrix.tolist()


def test_the_numbers_of_a_mounting_that_was_read_are_kept_while_they_mean_it(tmp_path):
    rows = MOUNT.inverse().matrix.tolist()
    rows[0][3] = np.nextafter(rows[0][3], 9.0)
    read = rigid_transform(rows, "", Ledger(lenient=False)).inverse()
    assert written_entry(tmp_path / "drive", {"imuToCameraMatrix": rows}, read)["imuToCamera"] == rows
    moved = RigidTransform(read.rotation, read.translation + 1.0)
    anew = written_entry(tmp_path / "drive", {"imuToCamera": rows}, moved)["imuToCamera"]
    assert anew == moved.inverse().matrix.tolist()
    for wrong in (None, "there", [1, 2], [[1.0] * 4] * 3, [["a"] * 4] * 4, [[float("nan")] * 4] * 4):
        entry = written_entry(tmp_path / "drive", {"imuToCamera": wrong}, read)
        assert entry["imuToCamera"] == read.inverse().matrix.tolist()


def ego_path():
    rotations = Rotation.from_rotvec(np.linspace(0, 1, 5)[:, None] * [0.0, 0.0, 1.0])
    positions = np.stack([np.arange(5.0), np.zeros(5), np.zeros(5)], axis=1)
    return Poses(np.arange(5, dtype=np.int64) * 10**8, positions, rotations.as_quat())


def sensor_path(mount, move=0.0):
    path = ego_path()
    pairs = zip(path.positions, path.quaternions_xyzw, strict=True)
    poses = [RigidTransform.from_quaternion(*pair) @ mount for pair in pairs]
    positions = np.array([pose.translation for pose in poses])
    positions[-1, 2] += move
    return Poses(path.timestamps_ns, positions, np.array([pose.quaternion_xyzw for pose in poses]))


def posed_camera(model=None, **fields):
    return CameraSensor("camera0", model or camera("pinhole"), LazyFrames.of([], []), **fields)


def turned(x):
    return RigidTransform(MOUNT.rotation @ Rotation.from_rotvec([x, 0, 0]).as_matrix(), MOUNT.translation)


RAISED = RigidTransform(MOUNT.rotation, MOUNT.translation + np.array([0, 0, 0.3]))
ON_EGO = Poses(np.zeros(1, np.int64), MOUNT.translation[None], MOUNT.quaternion_xyzw[None])
SHORT = Poses(ego_path().timestamps_ns[:3], ego_path().positions[:3], ego_path().quaternions_xyzw[:3])
POSED = {"poses": sensor_path(MOUNT)}


@pytest.mark.parametrize(
    ("fields", "ego", "expected", "lost"),
    [
        (POSED, ego_path(), MOUNT, []),
        ({"poses": ON_EGO, "coordinates": Coordinates.EGO}, None, MOUNT, []),
        ({"poses": sensor_path(MOUNT, move=0.5)}, ego_path(), MOUNT, [(5, "moves up to 0.5 m")]),
        ({**POSED, "mount": MOUNT}, ego_path(), MOUNT, []),
        ({**POSED, "mount": RAISED}, ego_path(), RAISED, [(5, "up to 0.3 m and 0 degrees")]),
        ({**POSED, "mount": turned(0.01)}, ego_path(), turned(0.01), [(5, "0.573 degrees")]),
        ({**POSED, "mount": MOUNT}, SHORT, MOUNT, [(2, "left out:")]),
        ({}, ego_path(), None, []),
        (POSED, None, None, []),
    ],
)
def test_mountings_come_from_poses_that_agree_with_the_ego_s_and_others_are_reported(fields, ego, expected, lost):
    mount, losses = mounting(posed_camera(**fields), ego)
    assert (mount is None) == (expected is None)
    if mount is not None:
        np.testing.assert_allclose(mount.matrix, expected.matrix, atol=1e-12)
    for loss, (count, what) in zip(losses, lost, strict=True):
        assert what in loss.what
        assert loss.count == count


def test_the_position_of_an_antenna_is_written_and_comes_back(tmp_path):
    mount = RigidTransform.from_quaternion(np.array([0.4, -0.1, 1.2]), np.array([0.0, 0.0, 0.6, 0.8]))
    times, ones = np.arange(3, dtype=np.int64) * 10**9, np.ones(3)
    receivers = [GnssSensor(name, times, np.ones((3, 3)), ones, ones, mount=mount) for name in ("gnss", "rtkgps")]
    losses = FORMAT.write(Scene(tuple(receivers)), tmp_path / "drive")
    assert [loss.field for loss in losses] == ["sensors[rtkgps].mount"]
    with FORMAT.open(tmp_path / "drive") as scene:
        # a matrix and its inverse, each rounded to float64
        np.testing.assert_allclose(scene.sensor("gnss").mount.matrix, mount.matrix, atol=1e-15)
        assert scene.sensor("rtkgps").mount is None
        text = (tmp_path / "drive" / "calibration.json").read_bytes()
        FORMAT.write(scene, tmp_path / "again")
    assert (tmp_path / "again" / "calibration.json").read_bytes() == text
