"""Recordings of which some images are left: which images those are then, and what is reported their video."""

import av
import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.editing import crop_scene, thin_scene
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CameraImage, CameraSensor, LazyFrames, Scene

CAMERA_MODEL = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
TIMESTAMPS_NS = np.arange(12, dtype=np.int64) * 100_000_000
GREYS = 15 + 20 * np.arange(12)
# H.264 at its usual quality moves an even grey by a level or two, twice here; neighbours are 20 apart
TWICE_ENCODED = 4


@pytest.fixture
def drive(tmp_path):
    """A recording whose one camera has an H.264 video of greys, the first image its only key frame."""
    pairs = zip(TIMESTAMPS_NS.tolist(), GREYS, strict=True)
    images = [CameraImage.of(t, CAMERA_MODEL, np.full((48, 64, 3), grey, np.uint8)) for t, grey in pairs]
    images = LazyFrames.of(images, TIMESTAMPS_NS)
    camera = CameraSensor("camera0", CAMERA_MODEL, images, mount=RigidTransform.identity(), fps=10.0)
    FORMAT.write(Scene((camera,)), tmp_path / "drive")
    with FORMAT.open(tmp_path / "drive") as scene:
        yield scene


def written(scene, folder, **options):
    report = FORMAT.write(scene, folder, **options)
    with FORMAT.open(folder) as again:
        images = again.cameras[0].images
        reported = {loss.field: loss.what for loss in report if loss.field.startswith("sensors[camera0]")}
        return reported, images.timestamps_ns.tolist(), [int(np.median(shot.rgb)) for shot in images]


@pytest.mark.parametrize(
    ("change", "rows"),
    [
        (lambda scene: thin_scene(scene, every=3), slice(None, None, 3)),
        (lambda scene: crop_scene(scene, start=0.45), slice(5, None)),
        (lambda scene: crop_scene(scene, start=0.25, stop=0.85), slice(3, 9)),
    ],
)
def test_what_packets_cannot_give_alone_is_encoded_anew_and_reported(drive, tmp_path, change, rows):
    reported, timestamps_ns, greys = written(change(drive), tmp_path / "part")
    assert timestamps_ns == TIMESTAMPS_NS[rows].tolist()
    np.testing.assert_allclose(greys, GREYS[rows], atol=TWICE_ENCODED)
    assert reported["sensors[camera0].video"].startswith("encoded anew as H.264: the video could not be copied")
    assert reported["sensors[camera0].images[].rgb"] == "encoded as H.264, which changes colours a little"


def test_a_key_frame_by_itself_is_copied_and_nothing_is_reported_it(drive, tmp_path):
    reported, timestamps_ns, greys = written(crop_scene(drive, stop=0.05), tmp_path / "part")
    assert (reported, timestamps_ns) == ({}, TIMESTAMPS_NS[:1].tolist())
    assert greys == [int(np.median(drive.cameras[0].images[0].rgb))]


def test_lossless_images_of_a_part_are_those_of_the_video(drive, tmp_path):
    reported, _, greys = written(thin_scene(drive, every=3), tmp_path / "part", images="lossless")
    whole = [int(np.median(image.rgb)) for image in drive.cameras[0].images]
    # colours of 8-bit YUV as 8-bit RGB, decoded once and kept
    assert greys == whole[::3]
    assert list(reported) == ["sensors[camera0].video"]
    assert "FFV1, which loses nothing" in reported["sensors[camera0].video"]


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "options", "encoded"),
    [
        ("data.mkv", "ffv1", "bgr0", {"g": "1"}, False),
        ("data.mkv", "ffv1", "bgr0", {"g": "4"}, True),
        ("data.avi", "mjpeg", "yuvj444p", {}, False),
        ("data.mov", "png", "rgb24", {}, True),
        ("data.mp4", "libx264", "yuv420p", {"g": "1"}, False),
    ],
)
def test_gaps_in_numbers_cost_no_image_anything_and_stay(
    recording, pinhole, tmp_path, name, codec, pixels, options, encoded
):
    generator = np.random.default_rng(1)
    with av.open(str(recording.path / name), "w") as container:
        stream = container.add_stream(codec, rate=10, options={"threads": "1", **options})
        stream.width, stream.height, stream.pix_fmt = 32, 16, pixels
        for _ in range(9):
            rgb = generator.integers(0, 255, (16, 32, 3)).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(format=pixels)))
        container.mux(stream.encode())
    numbers = [3, 4, 6, 7, 11]
    recording.calibration([pinhole])
    recording.lines({"frames": [{"cameraInd": 0}], "number": number, "time": 0.1 * number} for number in numbers)
    with recording.open() as scene:
        before = [image.rgb for image in scene.cameras[0].images]
        report = FORMAT.write(scene, tmp_path / "again")
    with FORMAT.open(tmp_path / "again") as scene:
        assert [image.extras["number"] for image in scene.cameras[0].images] == numbers
        np.testing.assert_array_equal([image.rgb for image in scene.cameras[0].images], before)
    reported = {loss.field: loss.what for loss in report if loss.field != "replay"}
    assert list(reported) == (["sensors[camera0].video"] if encoded else [])
    assert not encoded or "FFV1, which loses nothing" in reported["sensors[camera0].video"]
    if not encoded:
        assert packets(tmp_path / "again" / "data.mkv") == [packets(recording.path / name)[k - 3] for k in numbers]


def packets(path):
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]
