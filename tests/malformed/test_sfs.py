"""Scene files cut everywhere and with bytes and values changed: a scene or an error of ours, nothing else."""

import contextlib
import io

import numpy as np
import pytest
import simplejpeg
from tests.malformed import damage
from tests.malformed.damage import STRANGE, TWO, header, locations, look_at_everything, replaced

from sceneloom.errors import SceneloomError
from sceneloom.formats.sfs.salvage import salvage
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.formats.video.writer import encode_to_mp4

CAMERA = {"id": "c", "type": "camera", "poses": damage.POSES, "intrinsics": damage.PINHOLE}
JPEG = np.frombuffer(simplejpeg.encode_jpeg(np.zeros((8, 8, 3), np.uint8), 50), np.uint8)
GOLDEN = {
    "clouds": header(["lidar", "radar", "points"], time_offset=10**15, time_unit="microseconds"),
    "annotations": header(["odometry", "sonar"], ["cuboid", "event", "labeled_points"]),
    "ours": {
        "version": "1.0",
        "sensors": [
            {**CAMERA, "images": [{"timestamp": 3, "content": JPEG}]},
            {"id": "o", "type": "odometry", "poses": damage.POSES},
        ],
        "attributes": [{"name": "n", "timestamps": [0], "values": [1500]}],
        "metadata": {"sceneloom": damage.OURS},
    },
}
SLOW = pytest.mark.slow
DRAWN = header(annotations=damage.ANNOTATIONS)
"""Annotations of all types: changed in their values, not in their bytes, which would take too long."""
EACH = pytest.mark.parametrize("golden", GOLDEN.values(), ids=GOLDEN)
EACH_AND_DRAWN = pytest.mark.parametrize("golden", [*GOLDEN.values(), DRAWN], ids=[*GOLDEN, "drawn"])
THINNED = pytest.mark.parametrize("step", [4, pytest.param(1, marks=SLOW)])
"""Every how many locations are changed: a few of each kind, or every one."""


@pytest.fixture
def survives(tmp_path):
    """Open damaged content; whatever is raised is ours."""
    path = tmp_path / "damaged.sfs"

    def check(content):
        path.unlink(missing_ok=True)  # a new file is far quicker than an old one made shorter
        path.write_bytes(content)
        FORMAT.sniff(path)
        for lenient in (False, True):
            with contextlib.suppress(SceneloomError), FORMAT.open(path, lenient=lenient) as scene:
                look_at_everything(scene)

    return check


@EACH
def test_the_undamaged_files_open_and_can_be_written(golden, encode_sfs, tmp_path):
    path = tmp_path / "whole.sfs"
    path.write_bytes(encode_sfs(golden))
    scene = FORMAT.open(path)
    look_at_everything(scene)
    assert len(scene.sensors) + len(scene.annotations) > 1
    write_scene(scene, tmp_path / "again.sfs")


@THINNED
@EACH
@pytest.mark.few(2)
def test_a_file_cut_or_with_another_byte_anywhere_gives_a_scene_or_an_error_of_ours(golden, step, encode_sfs, survives):
    content, rng, swaps = encode_sfs(golden), np.random.default_rng(7), b'0-9"[]{},:.eE\0\xff '
    for location in range(0, len(content), step):
        survives(content[:location])
        survives(content[:location] + swaps[(k := int(rng.integers(len(swaps)))) : k + 1] + content[location + 1 :])


@pytest.mark.parametrize("step", [3, pytest.param(1, marks=SLOW)])
@pytest.mark.parametrize("golden", [*GOLDEN.values(), pytest.param(DRAWN, marks=SLOW)], ids=[*GOLDEN, "drawn"])
@pytest.mark.few(1)
def test_a_value_of_another_kind_anywhere_gives_a_scene_or_an_error_of_ours(golden, step, encode_sfs, survives):
    """Every value of the header is replaced in order by everything else that JSON can state, or by a part of that."""
    for number, path in enumerate(locations(golden)):
        for value in [*STRANGE, TWO][number % step :: step]:
            survives(encode_sfs(replaced(golden, path, value)))


@EACH_AND_DRAWN
def test_a_value_that_is_missing_anywhere_gives_a_scene_or_an_error_of_ours(golden, encode_sfs, survives):
    for path in locations(golden):
        survives(encode_sfs(replaced(golden, path)))


def test_a_damaged_video_gives_images_or_errors_of_ours(encode_sfs, survives):
    target = io.BytesIO()
    encode_to_mp4([np.zeros((16, 16, 3), np.uint8)] * 2, target, fps=10.0)
    video = {"timestamps": [0, 100], "content": np.frombuffer(target.getvalue(), np.uint8), "fps": 10}
    content = encode_sfs({"version": "1.0", "sensors": [{**CAMERA, "video": video}]})
    rng = np.random.default_rng(8)
    for location in range(content.index(b"ftyp"), len(content), 97):
        survives(damage.flipped(content, location, int(rng.integers(1, 256))))


@SLOW
@pytest.mark.parametrize("profile", ["sfs", "scale"])
@EACH_AND_DRAWN
def test_whatever_opens_is_written_or_refused_with_an_error_of_ours(golden, encode_sfs, tmp_path, profile):
    for number, path in enumerate(locations(golden)):
        for other, value in enumerate([*STRANGE, TWO]):
            source, target = tmp_path / f"{number} {other}.sfs", tmp_path / "target.sfs"
            source.write_bytes(encode_sfs(replaced(golden, path, value)))
            with contextlib.suppress(SceneloomError), FORMAT.open(source, lenient=True) as scene:
                write_scene(scene, target, profile=profile)
                FORMAT.open(target)
            target.unlink(missing_ok=True)
            source.unlink()


UNKNOWN = {"id": "p", "type": "x", "paths": [[{"timestamps": [1]}]], "projections": [[1]]}
STREAMS = {"id": "i", "type": "imu", "streams": {"gyroscope": {"values": 1}}}
STRANGER = {"id": "c", "type": "x", "images": [{"timestamp": "x", "content": ""}], "video": {"timestamps": "yz"}}
MAP = {"id": "m", "type": "points", "points": 1, "poses": {"timestamps": [{}], "values": [[]]}, "frames": [{}]}
FOUND = {
    "a map at fault with poses, which a map does not have": {"sensors": [MAP]},
    "an unknown sensor whose images have text for times": {"sensors": [STRANGER]},
    "an unknown annotation with lists of numbers in the position of projections": {"annotations": [UNKNOWN]},
    "the same beside damage": {"version": "lidar", "time_unit": 1, "annotations": [UNKNOWN]},
    "a stream of an IMU without its times": {"metadata": {"sceneloom": {"sensors": [STREAMS]}}},
    "sensors that are an object": {"sensors": {"lidar": {"type": "lidar"}}},
}


@pytest.mark.parametrize("fields", FOUND.values(), ids=FOUND)
def test_what_fuzzing_found_is_answered_read_written_and_salvaged(fields, encode_sfs, tmp_path):
    path, target = tmp_path / "found.sfs", tmp_path / "out.sfs"
    path.write_bytes(encode_sfs({"version": "1.0", **fields}))
    for lenient in (False, True):
        with contextlib.suppress(SceneloomError), FORMAT.open(path, lenient=lenient) as scene:
            write_scene(scene, target, overwrite=True)
            FORMAT.open(target).close()
    with contextlib.suppress(SceneloomError):
        salvage(path, target, overwrite=True)
        FORMAT.open(target).close()


ODD = [
    *(b"", b"{", b"\0" * 100, b'{"version":"1.0"}', b'{"version":"1.0"}\0', b'\xef\xbb\xbf{"version":"1.0"}\0'),
    b'{"version":"1.0","annotations":' + b"[" * 5000 + b"]" * 5000 + b"}\0",
    b'{"version":"1.0","x":' + b'{"a":' * 400 + b"1" + b"}" * 400 + b"}\0",
    b'{"version":"1.0","time_offset":1e300}\0',
    b'{"version":"1.0","time_offset":' + b"9" * 400 + b"}\0",
    b'{"version":"1.0","sensors":[{"type":"lidar","id":"\\ud800","frames":[]}]}\0',
    b'{"version":"1.0","sensors":[{"type":"\\u0000","id":""}]}\0',
    b'{"version":"1.0"}' + b" " * 1_000_000 + b"\0",
]


def test_odd_files_folders_and_missing_files_give_a_scene_or_an_error_of_ours(survives, tmp_path):
    for content in ODD:
        survives(content)
    for path in (tmp_path, tmp_path / "absent.sfs"):
        with pytest.raises(SceneloomError):
            FORMAT.open(path)
        assert not FORMAT.sniff(path)
