"""Segments of the Waymo Open Dataset v2, built to the columns that its public package declares."""

import contextlib
import pickle
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.cameras.projection import project
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.registry import drives_of
from sceneloom.formats.waymo import reader
from sceneloom.scene.annotations_at import CuboidAngles

pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")

SEGMENT = "10023947602400723454_1120_000_1140_000"
FIRST_US = 1_552_440_195_362_591
PERIOD_US = 100_000
MIDDLE_US = 43_000  # after the timestamp of a frame the vehicle is at its pose
FRAMES = 3
SIZES = {1: (8, 60), 2: (4, 20)}
BEAMS = np.linspace(-0.3, 0.04, 8) ** 3 * 9  # not evenly spread
EDGES = (-1.5, 0.5)
MOUNTS = {1: ([1.43, 0.0, 2.18], Rotation.from_euler("z", 2.6)), 2: ([4.07, 0.0, 0.69], Rotation.from_euler("y", 0.05))}
CAMERAS = {
    1: ([1.54, -0.02, 2.11], Rotation.from_euler("yz", [0.01, 0.02])),
    4: ([1.4, 0.1, 2.1], Rotation.from_euler("z", 1.57)),
}
EXPOSED_US = {1: 30_000, 4: 61_000}  # middle of the exposure of the middle column
LENS = {
    "f_u": 60.0,
    "f_v": 61.0,
    "c_u": 32.5,
    "c_v": 24.25,
    "k1": 0.04,
    "k2": -0.3,
    "p1": 0.001,
    "p2": -0.002,
    "k3": 0.0,
}
NEAR = 2e-4
"""Poses of points are float32 in a world of some hundred metres."""


def ego(micros):
    """Where the vehicle is, and how it is turned, as it drives a bend at 10 m/s."""
    s = (micros - FIRST_US) / 1e6
    return np.array([120.0 + 10 * s, -45.0 + 3 * s * s, 17.0]), Rotation.from_euler("ZYX", [0.5 + 0.4 * s, 0.01, 0.02])


def matrix(location, rotation):
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation.as_matrix(), location
    return found.ravel().tolist()


def frame_us(k):
    return FIRST_US + k * PERIOD_US


def pose_us(k):
    return frame_us(k) + MIDDLE_US


def beams(number):
    """Inclinations of the rows of an image, from above."""
    height = SIZES[number][0]
    if number == 1:
        return BEAMS[::-1]
    return np.array([EDGES[0] + (k + 0.5) * (EDGES[1] - EDGES[0]) / height for k in range(height)])[::-1]


def ranges(number, k, back):
    rng = np.random.default_rng([number, k, back])
    image = rng.uniform(2, 70, (*SIZES[number], 4)).astype(np.float32)
    image[..., 1] = rng.uniform(0, 1.2, SIZES[number])
    image[..., 3] = np.where(rng.random(SIZES[number]) < 0.1, 1, -1)
    image[rng.random(SIZES[number]) < (0.2 if back == 1 else 0.9)] = -1
    return image


def column_us(k, column):
    return frame_us(k) + round(PERIOD_US * column / SIZES[1][1])


def table(root, component, schema, rows, group=1000):
    path = root / component / f"{SEGMENT}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {"key.segment_context_name": pa.string(), **schema}
    rows = [{"key.segment_context_name": SEGMENT, **row} for row in rows]
    arrays = [pa.array([row.get(name) for row in rows], kind) for name, kind in columns.items()]
    parquet.write_table(pa.table(arrays, names=list(columns)), str(path), row_group_size=group)


FRAME = {"key.frame_timestamp_micros": pa.int64()}
LASER, CAMERA = {"key.laser_name": pa.int8()}, {"key.camera_name": pa.int8()}
MATRIX, SHAPE = pa.list_(pa.float64(), 16), pa.list_(pa.int32(), 3)


def images_of(prefix, kind, returns):
    names = [f"{prefix}.range_image_return{number}" for number in range(1, returns + 1)]
    return {
        f"{name}.{part}": pa.list_(kind) if part == "values" else SHAPE
        for name in names
        for part in ("values", "shape")
    }


def image_row(prefix, images):
    found = {}
    for number, image in enumerate(images, 1):
        found[f"{prefix}.range_image_return{number}.values"] = None if image is None else image.ravel().tolist()
        found[f"{prefix}.range_image_return{number}.shape"] = None if image is None else list(image.shape)
    return found


def keys(k, **further):
    return {"key.frame_timestamp_micros": frame_us(k), **{f"key.{name}": value for name, value in further.items()}}


def write_lidars(root):
    prefix = "[LiDARComponent]"
    order = [(k, number) for k in range(FRAMES) for number in (2, 1)]
    rows = [
        {
            **keys(k, laser_name=number),
            **image_row(prefix, [ranges(number, k, 1), ranges(number, k, 2) if number == 1 else None]),
        }
        for k, number in order
    ]
    table(root, "lidar", {**FRAME, **LASER, **images_of(prefix, pa.float32(), 2)}, rows, group=4)
    prefix = "[LiDARPoseComponent]"
    rows = []
    for k in range(FRAMES):
        image = np.zeros((*SIZES[1], 6), np.float32)
        for column in range(SIZES[1][1]):
            location, rotation = ego(column_us(k, column))
            image[:, column] = [*rotation.as_euler("ZYX")[::-1], *location]
        rows.append({**keys(k, laser_name=1), **image_row(prefix, [image])})
    table(root, "lidar_pose", {**FRAME, **LASER, **images_of(prefix, pa.float32(), 1)}, rows)
    prefix = "[LiDARSegmentationLabelComponent]"
    labels = np.arange(2 * SIZES[1][0] * SIZES[1][1], dtype=np.int32).reshape(*SIZES[1], 2) % 23
    rows = [{**keys(1, laser_name=1), **image_row(prefix, [labels, labels[::-1]])}]
    table(root, "lidar_segmentation", {**FRAME, **LASER, **images_of(prefix, pa.int32(), 2)}, rows)
    prefix = "[LiDARCalibrationComponent]"
    schema = {f"{prefix}.extrinsic.transform": MATRIX}
    schema |= {f"{prefix}.beam_inclination.{name}": pa.float64() for name in ("min", "max")}
    schema |= {f"{prefix}.beam_inclination.values": pa.list_(pa.float64())}
    rows = [
        {
            "key.laser_name": number,
            f"{prefix}.extrinsic.transform": matrix(*mount),
            f"{prefix}.beam_inclination.min": EDGES[0],
            f"{prefix}.beam_inclination.max": EDGES[1],
            f"{prefix}.beam_inclination.values": BEAMS.tolist() if number == 1 else None,
        }
        for number, mount in MOUNTS.items()
    ]
    table(root, "lidar_calibration", {**LASER, **schema}, rows)
    return labels


def jpeg(k, number):
    content = BytesIO()
    Image.new("RGB", (64, 48), (60 * k, 20 * number, 0)).save(content, "JPEG")
    return content.getvalue()


def write_cameras(root):
    prefix = "[CameraImageComponent]"
    shutter = [
        f"{prefix}.rolling_shutter_params.{name}"
        for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")
    ]
    schema = {f"{prefix}.image": pa.binary(), f"{prefix}.pose.transform": MATRIX}
    schema |= dict.fromkeys([f"{prefix}.pose_timestamp", *shutter], pa.float64())
    rows = []
    for k in range(FRAMES):
        for number in CAMERAS:
            micros = frame_us(k) + EXPOSED_US[number]
            at = {f"{prefix}.image": jpeg(k, number), f"{prefix}.pose.transform": matrix(*ego(micros))}
            times = [micros / 1e6, 0.004, micros / 1e6 - 0.022, micros / 1e6 + 0.022]
            rows.append(
                {
                    **keys(k, camera_name=number),
                    **at,
                    **dict(zip([f"{prefix}.pose_timestamp", *shutter], times, strict=True)),
                }
            )
    table(root, "camera_image", {**FRAME, **CAMERA, **schema}, rows, group=2)
    prefix = "[CameraCalibrationComponent]"
    schema = {f"{prefix}.intrinsic.{name}": pa.float64() for name in LENS}
    schema |= {f"{prefix}.extrinsic.transform": MATRIX, f"{prefix}.width": pa.int32(), f"{prefix}.height": pa.int32()}
    schema |= {f"{prefix}.rolling_shutter_direction": pa.int8()}
    rows = [
        {
            "key.camera_name": number,
            **{f"{prefix}.intrinsic.{name}": value for name, value in LENS.items()},
            f"{prefix}.extrinsic.transform": matrix(*mount),
            f"{prefix}.width": 64,
            f"{prefix}.height": 48,
            f"{prefix}.rolling_shutter_direction": 2,
        }
        for number, mount in CAMERAS.items()
    ]
    table(root, "camera_calibration", {**CAMERA, **schema}, rows)


BOXES = [
    (0, "car", 1, [14.0, 2.0, 0.9], 0.3),
    (1, "car", 1, [13.1, 2.0, 0.9], 0.25),
    (1, "walker", 2, [6.0, -4.0, 0.8], -2.0),
]


def write_labels(root):
    prefix = "[LiDARBoxComponent]"
    names = [f"{prefix}.box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"] + [f"{prefix}.box.heading"]
    schema = dict.fromkeys([*names, *(f"{prefix}.speed.{axis}" for axis in "xyz")], pa.float64())
    schema |= {f"{prefix}.type": pa.int8(), f"{prefix}.num_lidar_points_in_box": pa.int64()}
    schema |= {f"{prefix}.difficulty_level.detection": pa.int8()}
    rows = [
        {
            **keys(k, laser_object_id=name),
            **dict(zip(names, [*center, 4.5, 1.9, 1.6, heading], strict=True)),
            f"{prefix}.type": kind,
            f"{prefix}.num_lidar_points_in_box": 40 + k,
            f"{prefix}.speed.x": 9.5 if kind == 1 else None,
            f"{prefix}.difficulty_level.detection": 2 if k else None,
        }
        for k, name, kind, center, heading in BOXES
    ]
    table(root, "lidar_box", {**FRAME, "key.laser_object_id": pa.string(), **schema}, rows)
    prefix = "[CameraBoxComponent]"
    names = [f"{prefix}.box.{part}.{axis}" for part in ("center", "size") for axis in "xy"]
    rows = [
        {
            **keys(k, camera_name=4, camera_object_id="a"),
            **dict(zip(names, [20.0 + k, 10.0, 8.0, 6.0], strict=True)),
            f"{prefix}.type": 4,
        }
        for k in range(2)
    ]
    schema = {**dict.fromkeys(names, pa.float64()), f"{prefix}.type": pa.int8()}
    table(root, "camera_box", {**FRAME, **CAMERA, "key.camera_object_id": pa.string(), **schema}, rows)


def write_segment(root):
    column = "[VehiclePoseComponent].world_from_vehicle.transform"
    rows = [{**keys(k), column: matrix(*ego(pose_us(k)))} for k in range(FRAMES)]
    table(root, "vehicle_pose", {**FRAME, column: MATRIX}, rows)
    write_lidars(root)
    write_cameras(root)
    write_labels(root)
    names = ("time_of_day", "location", "weather")
    row = dict(zip([f"[StatsComponent].{name}" for name in names], ("Day", "location_sf", "sunny"), strict=True))
    table(root, "stats", {**FRAME, **dict.fromkeys(row, pa.string())}, [{**keys(k), **row} for k in range(FRAMES)])
    return root


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_segment(tmp_path_factory.mktemp("waymo"))


def expected_points(number, k):
    """Points in the vehicle's frame at the pose of a frame, one by one, and their pixels."""
    location, mount = MOUNTS[number]
    here, turned = ego(pose_us(k))
    found = []
    for back in (1, 2) if number == 1 else (1,):
        image = ranges(number, k, back)
        height, width = SIZES[number]
        for row in range(height):
            for column in range(width):
                if image[row, column, 0] <= 0:
                    continue
                # seen from the vehicle's axes, column 0 is right behind, and columns go clockwise
                own = np.arctan2(*mount.as_matrix()[[1, 0], 0])
                azimuth = np.pi - 2 * np.pi * (column + 0.5) / width - own
                ray = Rotation.from_euler("ZY", [azimuth, -beams(number)[row]]).apply([1.0, 0.0, 0.0])
                point = mount.apply(ray * image[row, column, 0]) + location
                if number == 1:
                    moving, moving_turned = ego(column_us(k, column))
                    point = turned.inv().apply(moving_turned.apply(point) + moving - here)
                found.append((*point, row, *image[row, column, 1:3], back))
    return np.array(found)


@pytest.mark.parametrize(("name", "number"), [("lidar_top", 1), ("lidar_front", 2)])
def test_points_of_both_returns_are_where_beams_columns_and_poses_of_points_place_them(root, name, number):
    lidar = sceneloom.open(root).sensor(name)
    assert lidar.points_frame == "ego"
    for k in (0, 2, 1):
        frame = pickle.loads(pickle.dumps(lidar.frames))[k]
        expected, points = expected_points(number, k), frame.points
        assert len(points) == len(expected) > 50
        assert np.abs(points.positions - expected[:, :3]).max() < NEAR
        assert points.rings.tolist() == expected[:, 3].tolist()
        assert np.array_equal(points.extras["elongation"], expected[:, 5].astype(np.float32))
        assert points.extras["return_number"].tolist() == expected[:, 6].tolist()
        assert np.array_equal(points.intensities, np.clip(np.rint(expected[:, 4] * 255), 0, 255))
        # the pose of a frame belongs to a time that no column states; it is found between the images
        assert abs(frame.timestamp_ns - 1000 * pose_us(k)) < 1_000_000
        assert set(points.timestamps_ns.tolist()) == {frame.timestamp_ns}
        assert frame.extras["frame_timestamp_micros"] == frame_us(k)


def test_classes_of_points_are_those_of_their_pixels_where_a_sweep_is_labelled(root):
    frames = sceneloom.open(root).sensor("lidar_top").frames
    labels = np.arange(2 * 8 * 60).reshape(8, 60, 2) % 23
    expected = np.concatenate([labels[ranges(1, 1, 1)[..., 0] > 0], labels[::-1][ranges(1, 1, 2)[..., 0] > 0]])
    points = frames[1].points
    assert np.array_equal(points.extras["instance_id"], expected[:, 0])
    assert np.array_equal(points.extras["semantic_class"], expected[:, 1])
    assert not frames[0].points.extras["semantic_class"].any()
    assert "semantic_class" not in sceneloom.open(root).sensor("lidar_front").frames[1].points.extras


def test_images_have_the_middle_of_their_exposure_and_poses_and_project_as_the_description_states(root):
    scene = sceneloom.open(root)
    for name, number in (("camera_front", 1), ("camera_side_left", 4)):
        camera = scene.sensor(name)
        location, mount = CAMERAS[number]
        for k, image in enumerate(camera.images):
            micros = frame_us(k) + EXPOSED_US[number]
            assert abs(image.timestamp_ns - 1000 * micros) < 1000
            assert image.encoded() == jpeg(k, number)
            assert np.abs(image.rgb.mean(axis=(0, 1)) - [60 * k, 20 * number, 0]).max() < 4
            here, turned = ego(micros)
            assert np.allclose(camera.poses.positions[k], here + turned.apply(location), atol=1e-4)
        assert camera.extras["calibration"]["shutterRollTimeSeconds"] == pytest.approx(0.040, abs=1e-6)
        # x ahead, y left, z up there; u = f (-y/x) + c with the distortion of OpenCV, from the image's corner
        ahead = np.array([10.0, 1.5, -0.8])
        x, y = -ahead[1] / ahead[0], -ahead[2] / ahead[0]
        r2, p1, p2 = x * x + y * y, LENS["p1"], LENS["p2"]
        radial = 1 + LENS["k1"] * r2 + LENS["k2"] * r2 * r2
        u = LENS["f_u"] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + LENS["c_u"] - 0.5
        v = LENS["f_v"] * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + LENS["c_v"] - 0.5
        on_vehicle = mount.apply(ahead) + location
        pixels, visible = project(camera.camera, camera.mount.inverse().apply(on_vehicle[None]))
        assert visible.all()
        assert np.allclose(pixels[0], [u, v], atol=1e-6)


def test_boxes_are_in_the_world_and_in_images_with_what_is_stated_of_them(root):
    scene = sceneloom.open(root)
    car, walker, seen = scene.annotations
    assert (car.id, car.label, walker.label, seen.label) == ("car", "TYPE_VEHICLE", "TYPE_PEDESTRIAN", "TYPE_CYCLIST")
    rows = {("car", 0): BOXES[0], ("car", 1): BOXES[1], ("walker", 0): BOXES[2]}
    for annotation in (car, walker):
        for row, values in enumerate(annotation.path.values):
            k, _, _, center, heading = rows[annotation.id, row]
            here, turned = ego(pose_us(k))
            assert values[:3].tolist() == [4.5, 1.9, 1.6]
            assert np.allclose(values[3:6], here + turned.apply(center), atol=1e-9)
            found = Rotation.from_quat(CuboidAngles.of(scene).quaternions(values[6:]))
            assert (found.inv() * turned * Rotation.from_euler("z", heading)).magnitude() < 1e-9
            assert annotation.path.timestamps_ns[row] == scene.sensor("lidar_top").frames.timestamps_ns[k]
    stated = {one.name: one.values for one in car.attributes}
    assert stated == {"num_lidar_points_in_box": (40, 41), "speed.x": (9.5, 9.5), "difficulty_level.detection": (2,)}
    assert (seen.id, seen.sensor_id) == ("camera_side_left:a", "camera_side_left")
    assert seen.path.values.tolist() == [[16.0, 7.0, 8.0, 6.0], [17.0, 7.0, 8.0, 6.0]]
    assert seen.path.timestamps_ns.tolist() == scene.sensor("camera_side_left").images.timestamps_ns[:2].tolist()
    assert scene.metadata["waymo"] == {
        "segment": SEGMENT,
        "time_of_day": "Day",
        "location": "location_sf",
        "weather": "sunny",
    }


def test_what_is_missing_or_of_another_segment_is_reported(tmp_path):
    root = write_segment(tmp_path / "data")
    with pytest.raises(OptionError, match="no segment 'other'"):
        sceneloom.open(root, sequence="other")
    (root / "stats" / "another.parquet").touch()
    assert not drives_of(root)
    (root / "lidar" / "another.parquet").touch()
    assert sorted(Path(one).name for one in drives_of(root)) == [SEGMENT, "another"]
    (root / "lidar" / "another.parquet").unlink()
    (root / "camera_image" / f"{SEGMENT}.parquet").rename(root / "kept")
    with pytest.raises(DataError, match="has no image of frame"):
        sceneloom.open(root)
    (root / "camera_box" / f"{SEGMENT}.parquet").unlink()
    codes = {warning.code: warning.count for warning in sceneloom.open(root).warnings}
    assert codes["frame-pose-time"] == FRAMES
    (root / "lidar_pose" / f"{SEGMENT}.parquet").unlink()
    scene = sceneloom.open(root)
    assert "pixel-poses-missing" in {warning.code for warning in scene.warnings}
    assert scene.sensor("lidar_top").frames[0].points.timestamps_ns is None
    (root / "lidar_calibration" / f"{SEGMENT}.parquet").unlink()
    with pytest.raises(DataError, match=r"lidar_calibration.*is not there"):
        sceneloom.open(root)
    assert [sensor.type for sensor in sceneloom.open(root, lenient=True).sensors] == ["camera", "camera"]


def footer_of(path):
    content = path.read_bytes()
    length = int.from_bytes(content[-8:-4], "little")
    return content[-8 - length : -8]


def test_footers_state_what_pyarrow_reads_in_them_and_damaged_ones_end_in_errors(root):
    files = sorted(root.rglob("*.parquet"))
    for path in files:
        stated, _ = reader._compact(footer_of(path), 0, reader._STRUCT)
        metadata = parquet.ParquetFile(path).metadata
        groups = [metadata.row_group(k) for k in range(metadata.num_row_groups)]
        assert [(one[2], one[3]) for one in stated[4]] == [(one.total_byte_size, one.num_rows) for one in groups]
        columns = [one.column(k) for one in groups for k in range(one.num_columns)]
        found = [one[3] for group in stated[4] for one in group[1]]
        assert [one[5] for one in found] == [one.num_values for one in columns]
        assert [b".".join(one[3]).decode() for one in found] == [one.path_in_schema for one in columns]
    sound, chance = footer_of(files[0]), np.random.default_rng(4)
    for _ in range(3000):
        changed = bytearray(sound)
        for at in chance.integers(0, len(changed), 2):
            changed[at] = chance.integers(256)
        with contextlib.suppress(ValueError, IndexError):
            reader._compact(bytes(changed[: chance.integers(len(changed) + 1)]), 0, reader._STRUCT)


def test_a_footer_that_declares_far_more_values_than_its_file_holds_is_refused(tmp_path):
    # FileMetaData with one group of 2^40 rows, and one with a column of as many values
    many = b"\x80\x80\x80\x80\x80\x40"  # 2^40 as Thrift writes it
    column = bytes([0x3C, 0x39, 0x18, 1, ord("x"), 0x26]) + many + b"\0\0"
    path = tmp_path / "a.parquet"
    for group, where in ((b"\x36" + many + b"\0", ""), (bytes([0x19, 0x1C]) + column + b"\0", "x: ")):
        footer = bytes([0x49, 0x1C]) + group + b"\0"
        path.write_bytes(b"PAR1" + footer + len(footer).to_bytes(4, "little") + b"PAR1")
        with (
            path.open("rb") as file,
            pytest.raises(DataError, match=rf"a\.parquet: {where}\d+ bytes that unpack to {1 << 42}"),
        ):
            reader._check_groups(path, file)
