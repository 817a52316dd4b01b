"""Sequences of NCore: what the documentation states of stores and models, written, read again, damaged and faulty."""

import json
import lzma
import pickle
import shutil
import struct
import tarfile
import zlib
from dataclasses import replace

import numpy as np
import pytest
from tests.unit.formats.ncore.models import MODELS

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats import write_scene
from sceneloom.formats.base.registry import drives_of
from sceneloom.formats.ncore.sequences import camera_of, parameters_of
from sceneloom.formats.ncore.store import _from_blosc, _from_cbor, _to_cbor
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street


@pytest.fixture(scope="module")
def street():
    camera = CameraSpec(Camera("fisheye", 48, 32, 20.0, 20.0, 23.5, 15.5, (0.02, -0.01, 0.001, -5e-4)), camera_mount())
    return simulate_street(5, frames=3, lidar=LidarSpec(beams=4, steps=60), cameras=(camera,)).scene


@pytest.fixture(scope="module")
def archive(street, tmp_path_factory):
    path = tmp_path_factory.mktemp("ncore") / "drive.ncore4.zarr.itar"
    write_scene(street, path, format="ncore")
    return path


def unpacked(archive, folder):
    """The archive as a folder store, by the standard library."""
    target = folder / archive.name.removesuffix(".itar")
    with tarfile.open(archive) as tar:
        tar.extractall(target, filter="data")
    return target


def test_a_drive_comes_back_as_it_was_from_an_archive_and_from_a_folder(street, archive, tmp_path):
    for path in (archive, unpacked(archive, tmp_path)):
        scene = sceneloom.open(path)
        assert scene.format == "ncore"
        for one, other in zip(scene.lidars[0].frames, street.lidars[0].frames, strict=True):
            assert np.allclose(one.points.positions, other.points.positions, atol=3e-5)  # float32 of up to 100 m
            assert np.array_equal(one.points.intensities, other.points.intensities)
            assert np.abs(one.points.timestamps_ns - other.points.timestamps_ns).max() <= 500
        assert scene.cameras[0].camera == street.cameras[0].camera
        for one, other in zip(scene.cameras[0].images, street.cameras[0].images, strict=True):
            assert abs(one.timestamp_ns - other.timestamp_ns) <= 500
            assert np.abs(one.rgb.astype(int) - other.rgb).mean() < 3  # JPEG
        assert np.allclose(scene.cameras[0].mount.matrix, street.cameras[0].mount.matrix)
        expected = {str(one.id): one for one in street.annotations}
        for one in scene.annotations:
            assert one.label == expected[one.id].label
            assert np.allclose(one.path.values[:, :6], expected[one.id].path.values[:, :6])
        frames = pickle.loads(pickle.dumps(scene.lidars[0].frames))
        assert np.array_equal(frames[1].points.positions, scene.lidars[0].frames[1].points.positions)


def test_a_sequence_that_was_read_is_written_again_with_its_numbers(archive, tmp_path):
    scene = sceneloom.open(archive)
    write_scene(scene, tmp_path / "drive.ncore4.zarr.itar", format="ncore")
    again = sceneloom.open(tmp_path / "drive.ncore4.zarr.itar")
    assert again.cameras[0].extras == scene.cameras[0].extras
    assert again.metadata == scene.metadata
    for one, other in zip(again.sensors, scene.sensors, strict=True):
        assert np.array_equal(one.mount.matrix, other.mount.matrix)
        frames = (sensor.images if sensor.type == "camera" else sensor.frames for sensor in (one, other))
        for frame, expected in zip(*frames, strict=True):
            assert (frame.timestamp_ns, frame.extras) == (expected.timestamp_ns, expected.extras)
    for one, other in zip(again.annotations, scene.annotations, strict=True):
        assert np.allclose(one.path.values, other.path.values, atol=1e-12)
        assert np.array_equal(one.path.timestamps_ns, other.path.timestamps_ns)
    positions, expected = (one.lidars[0].frames[0].points.positions for one in (again, scene))
    assert np.allclose(positions, expected, atol=2e-5)  # two roundings to float32 of up to 100 m


def test_columns_and_colours_stand_in_generic_data_and_what_is_lost_is_reported(street, tmp_path):
    frame = street.lidars[0].frames[0]
    count = len(frame.points)
    colors = np.arange(3 * count, dtype=np.uint8).reshape(count, 3)
    extras = {"ambient": np.arange(count, dtype=np.float64), "words": np.array(["a"] * count)}
    points = replace(frame.points, colors=colors, extras=extras)
    frames = sc.LazyFrames.of([replace(frame, points=points)], [frame.timestamp_ns])
    lidar = replace(street.lidars[0], frames=frames, model="Pandar64")
    report = write_scene(replace(street, sensors=(lidar,)), tmp_path / "a.zarr.itar", format="ncore")
    lost = {loss.field for loss in report if loss.support == "dropped"}
    assert {f"sensors[{lidar.id}].model", "sensors.lidar.frames.points.extras"} <= lost
    found = sceneloom.open(tmp_path / "a.zarr.itar").lidars[0].frames[0].points
    assert np.array_equal(found.colors, colors)
    assert np.array_equal(found.extras["ambient"], extras["ambient"])


@pytest.mark.parametrize("name", MODELS)
def test_camera_models_are_stated_as_they_were(name):
    stated = MODELS[name]
    camera, error = camera_of(stated["camera_model_type"], stated["camera_model_parameters"])
    assert error < 0.05
    kind, parameters = parameters_of(camera)
    assert camera_of(kind, parameters)[0].coefficients == pytest.approx(camera.coefficients, abs=1e-12)
    assert kind == stated["camera_model_type"]
    if error == 0:
        for key in ("principal_point", "focal_length", "linear_cde", "angle_to_pixeldist_poly"):
            expected = stated["camera_model_parameters"].get(key)
            assert expected is None or parameters[key] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"focal_length": [1, 2, 3]}, "focal_length .*expected 2 numbers"),
        ({"principal_point": None}, "principal_point None; expected 2 numbers"),
        ({"radial_coeffs": [1e300] * 6}, "radial_coeffs .*expected 6 numbers"),
    ],
)
def test_faulty_intrinsics_are_errors(change, message):
    with pytest.raises(CalibrationError, match=message):
        camera_of("opencv-pinhole", MODELS["opencv-pinhole"]["camera_model_parameters"] | change)
    with pytest.raises(CalibrationError, match="expected ftheta, opencv-pinhole"):
        camera_of("mirror", MODELS["opencv-pinhole"]["camera_model_parameters"])


def test_cbor_is_that_of_the_standard():
    # Source: RFC 8949, appendix A
    examples = {
        "00": 0, "1864": 100, "1a000f4240": 1000000, "1b000000e8d4a51000": 1000000000000, "3863": -100,
        "fb3ff199999999999a": 1.1, "f4": False, "f6": None, "6449455446": "IETF",
        "8301820203820405": [1, [2, 3], [4, 5]], "a26161016162820203": {"a": 1, "b": [2, 3]},
    }  # fmt: skip
    for text, value in examples.items():
        assert _from_cbor(bytes.fromhex(text)) == value
        assert b"".join(_to_cbor(value)).hex() == text
    assert _from_cbor(bytes.fromhex("f93e00")) == 1.5
    for text in ("", "61", "9a00ffffff", "1b00", "a1"):
        with pytest.raises((ValueError, IndexError)):
            _from_cbor(bytes.fromhex(text))


def blosc(content, itemsize, flags, split):
    """One block with zlib inside, as C-Blosc's description has it."""
    items = len(content) // itemsize
    shuffled = np.frombuffer(content, np.uint8).reshape(items, itemsize)
    if flags & 4:
        bits = np.unpackbits(shuffled, axis=1, bitorder="little")
        shuffled = np.packbits(bits.T, axis=1, bitorder="little")
    elif flags & 1:
        shuffled = shuffled.T
    raw = np.ascontiguousarray(shuffled).tobytes()
    parts = [raw[k * items : (k + 1) * items] for k in range(itemsize)] if split else [raw]
    packed = b"".join(struct.pack("<I", len(one)) + one for one in map(zlib.compress, parts))
    size = 20 + len(packed)
    head = struct.pack("<4B3I", 2, 1, flags | 3 << 5 | (0 if split else 16), itemsize, len(content), len(content), size)
    return head + struct.pack("<I", 20) + packed


@pytest.mark.parametrize("flags", [0, 1, 4])
@pytest.mark.parametrize("split", [False, True])
def test_blosc_is_undone(flags, split):
    content = np.arange(1000, dtype="<f4").tobytes()
    packed = blosc(content, 4, flags, split)
    assert _from_blosc(packed, len(content)) == content
    with pytest.raises((ValueError, zlib.error, struct.error)):
        _from_blosc(packed[:40], len(content))
    with pytest.raises(ValueError, match="expected 4001"):
        _from_blosc(packed, 4001)


def test_a_folder_of_sequences_names_them_and_a_stranger_is_refused(archive, tmp_path):
    for name in ("a", "b"):
        shutil.copy(archive, tmp_path / f"{name}.ncore4.zarr.itar")
    assert [str(one) for one in drives_of(tmp_path)] == ["a", "b"]
    with pytest.raises(OptionError, match="2 sequences; choose one"):
        sceneloom.open(tmp_path)
    assert sceneloom.open(tmp_path, sequence="b").lidars
    listed = {"sequence_id": "drive", "component_stores": [{"path": "a.ncore4.zarr.itar"}]}
    (tmp_path / "meta.json").write_text(json.dumps(listed))
    assert sceneloom.open(tmp_path / "meta.json").cameras
    listed["component_stores"][0]["path"] = "../a.ncore4.zarr.itar"
    (tmp_path / "meta.json").write_text(json.dumps(listed))
    with pytest.raises(DataError, match="expected names of stores beside the file"):
        sceneloom.open(tmp_path / "meta.json")


def test_damaged_archives_and_other_versions_are_errors_with_their_location(archive, tmp_path):
    content = archive.read_bytes()
    path = tmp_path / "cut.zarr.itar"
    path.write_bytes(content[:-512])
    with pytest.raises(DataError, match="expected the index of an indexed tar archive"):
        sceneloom.open(path)
    magic, kind, start, length = struct.unpack("<4sIQI", content[-512:][:20])
    table = _from_cbor(lzma.decompress(content[start : start + length]))
    table["sizes"][3] = 1 << 60
    packed = lzma.compress(b"".join(_to_cbor(table)))
    path.write_bytes(
        content[:start]
        + packed
        + bytes(-len(packed) % 512)
        + struct.pack("<4sIQI", magic, kind, start, len(packed)).ljust(512, b"\0")
    )
    with pytest.raises(DataError, match=r"index: is damaged: .*beyond the members"):
        sceneloom.open(path)
    folder = unpacked(archive, tmp_path)
    about = json.loads((folder / ".zattrs").read_text())
    (folder / ".zattrs").write_text(json.dumps({**about, "version": "v9"}))
    with pytest.raises(DataError, match="version 'v9'; expected a component store of NCore v4"):
        sceneloom.open(folder)


def test_faulty_frames_and_boxes_are_errors_that_a_lenient_reading_counts(archive, tmp_path):
    folder = unpacked(archive, tmp_path)
    (lidar,) = (folder / "lidars").glob("[!.]*")
    frame = next(one for one in sorted((lidar / "frames").iterdir()) if one.is_dir())
    layout = json.loads((frame / "ray_bundle/direction/.zarray").read_text())
    (frame / "ray_bundle/direction/.zarray").write_text(json.dumps({**layout, "shape": [1 << 30, 3]}))
    with pytest.raises(DataError, match=r"ray_bundle/direction: .*expected .* at most"):
        sceneloom.open(folder).lidars[0].frames[0].points  # noqa: B018
    boxes = folder / "cuboids/default/cuboids/.zattrs"
    rows = json.loads(boxes.read_text())["cuboid_track_observations"]
    rows[0]["bbox3"]["dim"] = [0.0, 1.0, 1.0]
    rows[1]["reference_frame_id"] = "nowhere"
    boxes.write_text(json.dumps({"cuboid_track_observations": rows}))
    with pytest.raises(DataError, match="expected finite numbers and sizes above 0"):
        sceneloom.open(folder)
    scene = sceneloom.open(folder, lenient=True)
    assert {"boxes", "boxes-without-pose"} <= {warning.code for warning in scene.warnings}
