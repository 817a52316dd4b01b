"""Cameras: JPEG files and videos both ways, camera models, the time of an image."""

import io

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from sceneloom.cameras import Camera, project_unbounded, unproject
from sceneloom.errors import DataError
from sceneloom.formats.sfs.sensors import video_codec
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import SceneWriter, write_scene
from sceneloom.formats.video.reader import open_video
from sceneloom.formats.video.writer import copy_to_matroska, encode_to_mp4
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CameraImage, CameraSensor, LazyFrames, Poses, Scene, VideoContent

CAMERA_MODEL = Camera("pinhole", 32, 16, 40.0, 40.0, 15.5, 7.5)


def brown(*coefficients):
    return Camera("brown_conrady", 32, 16, 40.0, 40.0, 15.5, 7.5, coefficients)


MS = 1_000_000


def image_array(k):
    """A smooth image, different for each k, that JPEG keeps within a few levels."""
    v, u = np.mgrid[0:16, 0:32]
    return np.stack([4 * u + k, 8 * v, np.full_like(u, 10 * k)], axis=-1).astype(np.uint8)


def jpeg(k):
    return simplejpeg.encode_jpeg(image_array(k), 90, "RGB", "444")


@pytest.fixture(scope="module")
def mp4():
    """A short H.264 video."""
    target = io.BytesIO()
    encode_to_mp4((image_array(k) for k in range(5)), target, fps=10.0)
    return target.getvalue()


@pytest.fixture(scope="module")
def matroska(mp4):
    target = io.BytesIO()
    copy_to_matroska(mp4, target)
    return target.getvalue()


def camera(camera_images, **fields):
    lazy = LazyFrames.of(camera_images, [camera_image.timestamp_ns for camera_image in camera_images])
    return CameraSensor(**{"id": "front", "camera": CAMERA_MODEL, "images": lazy, "poses": Poses.identity(), **fields})


def shot(timestamp_ns, k=0, camera_model=CAMERA_MODEL):
    return CameraImage.of(timestamp_ns, camera_model, image_array(k))


def camera_header(**content):
    intrinsics = {"fx": 40, "fy": 40, "cx": 15.5, "cy": 7.5, "width": 32, "height": 16}
    poses = {"timestamps": [0], "values": [[0, 0, 0, 0, 0, 0, 1]]}
    camera = {"id": "c", "type": "camera", "poses": poses, "intrinsics": intrinsics, **content}
    return {"version": "1.0", "sensors": [camera]}


def jpeg_header(content, **fields):
    return camera_header(images=[{"timestamp": 5, "content": np.frombuffer(content, np.uint8), **fields}])


def test_jpeg_images_are_decoded_as_pillow_does_with_a_camera_model_of_their_size(open_header):
    camera_image = open_header(jpeg_header(jpeg(3), note="dusk")).cameras[0].images[0]
    expected = np.asarray(Image.open(io.BytesIO(jpeg(3))).convert("RGB"))
    # both decode with libjpeg-turbo; builds may differ by a level in the inverse transform
    assert np.abs(camera_image.rgb.astype(int) - expected).max() <= 1
    assert (camera_image.timestamp_ns, camera_image.extras) == (5000, {"note": "dusk"})
    assert camera_image.encoded() == jpeg(3)
    big = simplejpeg.encode_jpeg(np.zeros((32, 64, 3), np.uint8), 90, "RGB", "444")
    camera_model = open_header(jpeg_header(big)).cameras[0].images[0].camera
    assert camera_model == Camera("pinhole", 64, 32, 80.0, 80.0, 31.5, 15.5)
    for content in (b"", b"not a jpeg", b"\xff\xd8\xff\xe0", jpeg(1)[:40]):
        camera_images = open_header(jpeg_header(content)).cameras[0].images
        with pytest.raises(DataError, match=r"sensors\[0\].images\[0\].content: cannot be decoded"):
            camera_images[0].rgb  # noqa: B018


def test_a_camera_without_images_or_with_a_broken_video_opens(open_header):
    scene = open_header(camera_header())
    assert len(scene.cameras[0].images) == 0
    assert "no-images" in [warning.code for warning in scene.warnings]
    video = {"timestamps": [0], "content": np.zeros(100, np.uint8), "fps": 10}
    front = open_header(camera_header(video=video)).cameras[0]
    assert front.video.codec == "unknown"
    with pytest.raises(DataError, match=r"sensors\[0\].video.content"):
        front.images[0].rgb  # noqa: B018
    for content in (b"", b"\0" * 8, b"\0\0\0\1moov", b"\xff" * 64, b"\0\0\0\x10moovxxxxstsd"):
        assert video_codec(memoryview(content)) == "unknown"


def test_video_images_are_decoded_when_asked_for_and_with_images_beside_them_nothing_is_lost(
    open_header, target, decode_sfs, mp4
):
    images = [{"timestamp": 5, "content": np.frombuffer(jpeg(3), np.uint8)}]
    video = {"timestamps": [0, 100, 200, 300, 400], "content": np.frombuffer(mp4, np.uint8), "fps": 10}
    front = open_header(camera_header(video=video)).cameras[0]
    assert (len(front.images), front.fps, front.video.codec) == (5, 10.0, "h264")
    with open_video(mp4) as reader:
        for k in (4, 0, 2):
            np.testing.assert_array_equal(front.images[k].rgb, reader.rgb(k))
    with front.video.open() as file:
        assert file.read() == mp4
    write_scene(open_header(camera_header(images=images, video=video)), target)
    record = decode_sfs(target.read_bytes())["sensors"][0]
    assert record["images"][0]["timestamp"] == 5
    assert record["images"][0]["content"].tobytes() == jpeg(3)
    assert record["video"]["content"].tobytes() == mp4


def test_images_are_written_as_jpeg_and_stated_to_be_and_can_be_streamed(target):
    report = write_scene(Scene((camera([shot(k * 100 * MS, k) for k in range(3)]),)), target)
    for k, camera_image in enumerate(FORMAT.open(target).cameras[0].images):
        # quality 95 without subsampling: a few levels on a smooth image
        assert np.abs(camera_image.rgb.astype(int) - image_array(k)).max() <= 6
        assert camera_image.timestamp_ns == k * 100 * MS
    assert {loss.field: loss.count for loss in report} == {"sensors[front].images[].content": 3}
    with SceneWriter(target, overwrite=True) as writer:
        writer.add_sensor(camera([]))
        writer.add_frame("front", shot(5 * MS, 1))
    assert FORMAT.open(target).cameras[0].images.timestamps_ns.tolist() == [5 * MS]


def video_camera(content, count=5, indices=None, **fields):
    camera_images = [CameraImage(k * 100 * MS, CAMERA_MODEL, lambda: image_array(0)) for k in range(count)]
    return camera(camera_images, video=VideoContent(lambda: io.BytesIO(content), "h264", indices), **fields)


def test_an_mp4_is_copied_byte_for_byte_another_container_remuxed_and_a_part_encoded_anew(
    target, decode_sfs, mp4, matroska
):
    def written(*arguments, **fields):
        report = write_scene(Scene((video_camera(*arguments, **fields),)), target, overwrite=True)
        return [loss.field for loss in report], FORMAT.open(target).cameras[0]

    assert written(mp4, extras={"video": {"maker": "x"}})[0] == []
    video = decode_sfs(target.read_bytes())["sensors"][0]["video"]
    assert video.pop("content").tobytes() == mp4
    timestamps = [0, 100_000, 200_000, 300_000, 400_000]
    assert video == {"timestamps": timestamps, "fps": pytest.approx(10.0), "maker": "x"}
    with open_video(mp4) as reader:
        lost, front = written(matroska)
        np.testing.assert_array_equal(front.images[3].rgb, reader.rgb(3))
        assert lost == []
        lost, front = written(mp4, count=2, indices=(1, 3))
        # encoded twice: within a few levels on a smooth image
        assert np.abs(front.images[1].rgb.astype(int) - reader.rgb(3)).mean() < 6
        assert lost == ["sensors[front].video.content"]
    with pytest.raises(DataError, match="front"):
        written(matroska, count=9)


def test_jpeg_files_are_copied_byte_for_byte_with_the_start_of_exposure_where_the_model_has_its_middle(
    target, decode_sfs
):
    camera_images = [
        CameraImage(10 * (k + 1) * MS, CAMERA_MODEL, lambda: image_array(0), encoded=lambda k=k: jpeg(k), extras=extras)
        for k, extras in enumerate(({}, {"exposureTimeSeconds": 0.008}))
    ]
    report = write_scene(Scene((camera(camera_images, extras={"exposureTimeSeconds": 0.002}),)), target)
    images = decode_sfs(target.read_bytes())["sensors"][0]["images"]
    assert [image["content"].tobytes() for image in images] == [jpeg(0), jpeg(1)]
    assert [image["timestamp"] for image in images] == [9_000, 16_000]
    assert FORMAT.open(target).cameras[0].images.timestamps_ns.tolist() == [10 * MS, 20 * MS]
    assert len(report) == 0


def test_camera_models_mountings_and_fields_of_single_images_come_back(target, mp4):
    own = Camera("brown_conrady", 32, 16, 41.0, 41.0, 15.0, 7.0, (0.1, 0.01))
    mount = RigidTransform.from_quaternion(np.array([0.1, 0, 0]), np.array([0.1, 0.2, 0.3, 0.9]))
    camera_images = [
        CameraImage(0, CAMERA_MODEL, lambda: image_array(0)),
        CameraImage(100 * MS, own, lambda: image_array(0), mount, {"number": 7}),
    ]
    front = camera(camera_images, video=VideoContent(lambda: io.BytesIO(mp4), "h264"))
    report = write_scene(Scene((front,)), target)
    read = FORMAT.open(target).cameras[0]
    assert (read.camera, read.images[0].camera, read.images[1].camera) == (CAMERA_MODEL, CAMERA_MODEL, own)
    assert read.images[0].mount is None
    np.testing.assert_array_equal(read.images[1].mount.matrix, mount.matrix)
    assert read.images[1].extras == {"number": 7}
    assert [(loss.field, loss.count) for loss in report] == [("sensors[front].images[].camera", 1)]


def test_camera_models_that_the_format_lacks_are_fitted_and_kept_in_a_note_that_counts_unless_they_are_changed(
    target, encode_sfs, decode_sfs
):
    for camera_model, model, off in (
        (CAMERA_MODEL, None, None),
        (brown(0.1, 0.01), "brown_conrady", None),
        (Camera("fisheye", 32, 16, 40.0, 40.0, 15.5, 7.5, (0.1,)), "fisheye", None),
        (Camera("kannala-brandt18", 32, 16, 40.0, 40.0, 15.5, 7.5, (0.1,) * 18), None, "unknown number"),
        (brown(0.1, *[0.0] * 9, 0.01, 0, 0, 0, 0, 0), "brown_conrady", "px"),
    ):
        front = camera([shot(0, 0, camera_model)], camera=camera_model)
        report = write_scene(Scene((front,)), target, overwrite=True)
        intrinsics = decode_sfs(target.read_bytes())["sensors"][0]["intrinsics"]
        assert intrinsics.get("distortion", {}).get("model") == model
        losses = [loss for loss in report if "distortion" in loss.field]
        assert [off in loss.what for loss in losses] == ([] if off is None else [True])
        read = FORMAT.open(target).cameras[0].camera
        assert (read.model, read.fx) == (camera_model.model, camera_model.fx)
        count = len(camera_model.coefficients)
        assert read.coefficients[:count] == camera_model.coefficients
        assert not any(read.coefficients[count:])
    # at the corner (16, 8) px from the centre x' = x + s1 r²: about 40 · 0.01 · (0.4² + 0.2²) = 0.08 px
    prism = brown(*[0.0] * 10, 0.01, 0, 0, 0, 0, 0)
    report = write_scene(Scene((camera([], camera=prism),)), target, overwrite=True)
    header = decode_sfs(target.read_bytes())
    record = header["sensors"][0]["intrinsics"]
    numbers = [record[name] for name in ("width", "height", "fx", "fy", "cx", "cy")]
    written = Camera(record["distortion"]["model"], *numbers, tuple(record["distortion"]["params"]))
    u, v = np.meshgrid(np.linspace(-0.5, 31.5, 50), np.linspace(-0.5, 15.5, 40))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    off = np.hypot(*(project_unbounded(written, unproject(prism, pixels)) - pixels).T)
    (stated,) = (loss.what.split("up to ")[1].split()[0] for loss in report if "distortion" in loss.field)
    assert off.max() == pytest.approx(float(stated), rel=0.05)
    assert off.max() < 0.04
    assert FORMAT.open(target).cameras[0].camera == prism
    record["distortion"]["params"][0] = 0.25
    target.write_bytes(encode_sfs(header))
    read = FORMAT.open(target).cameras[0].camera
    assert read.coefficients[0] == 0.25
    assert not any(read.coefficients[10:])
