"""What formats share: image files, bytes in files and messages as others read them, and the ledger of all faults."""

import io
import os
import struct
import warnings

import cv2
import numpy as np
import pytest
from google.protobuf.internal.encoder import _VarintBytes
from PIL import Image, PngImagePlugin
from tests.unit.formats.labelling.test_round_trips import scene_of

from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import ArrayError, CalibrationError, DataError, OutputError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import ByteStream
from sceneloom.formats.base.images import EncodedImage, write_depth_image
from sceneloom.formats.base.json_files import damage_of_json, read_json
from sceneloom.formats.base.registry import open_scene, write_scene
from sceneloom.formats.base.wire_formats import enclosed, field_head, read_varint, varint, wire_fields
from sceneloom.formats.recording.reader import _MOST_LOCATIONS, _FaultLedger
from sceneloom.pipeline.redacting import _stripped

DEPTHS = np.random.default_rng(4).uniform(0.5, 120.0, (37, 51)).astype(np.float32)
DEPTHS[::3] = 0.0


def test_opencv_reads_the_png_as_metres_times_256_and_depths_beyond_16_bits_become_nothing_and_are_counted(tmp_path):
    beyond = np.array([[255.99, 255.9961, 256.0, 1000.0, np.inf, 0.0, 0.001]], np.float32)
    counts = [write_depth_image(depths, tmp_path / f"{k}.png") for k, depths in enumerate((DEPTHS, beyond))]
    read, extremes = (cv2.imread(str(tmp_path / f"{k}.png"), cv2.IMREAD_UNCHANGED) for k in range(2))
    assert (counts, read.dtype, read.shape) == ([0, 3], np.uint16, DEPTHS.shape)
    # Half a step of 1/256 m: the values are rounded.
    assert np.abs(read / 256.0 - DEPTHS).max() <= 0.5 / 256
    assert np.array_equal(read == 0, DEPTHS == 0)
    assert extremes.tolist() == [[65533, 65535, 0, 0, 0, 0, 1]]


def test_npz_holds_the_depths_bit_by_bit_and_a_confidence_of_the_same_size_only(tmp_path):
    depths, confidence = DEPTHS.copy(), (DEPTHS > 0).astype(np.float32)
    depths[1, 1] = np.inf
    write_depth_image(depths, tmp_path / "d.npz")
    write_depth_image(depths, tmp_path / "e.npz", confidence=confidence)
    with np.load(tmp_path / "d.npz") as file, np.load(tmp_path / "e.npz") as both:
        assert (file.files, file["depth"].dtype, file["depth"].tobytes()) == (["depth"], np.float32, depths.tobytes())
        np.testing.assert_array_equal(both["confidence"], confidence)
    with pytest.raises(ArrayError, match="confidence"):
        write_depth_image(depths, tmp_path / "f.npz", confidence=confidence[1:])


@pytest.mark.parametrize("name", ["d.png", "d.npz"])
def test_what_is_no_depth_image_is_refused_and_files_are_replaced_only_on_request(tmp_path, name):
    for depths, message in (
        (np.array([[1.0, np.nan]], np.float32), r"depth_image\[0, 1\]: nan"),
        (np.array([[1.0], [-2.0]], np.float32), r"depth_image\[1, 0\]: -2.0"),
        (np.zeros((0, 5), np.float32), "at least one pixel"),
        (np.zeros((4, 5)), "float32"),
    ):
        with pytest.raises(ArrayError, match=message):
            write_depth_image(depths, tmp_path / name)
    assert not list(tmp_path.iterdir())
    (tmp_path / name).write_bytes(b"kept")
    with pytest.raises(OutputError, match="exists already"):
        write_depth_image(DEPTHS, tmp_path / name)
    assert (tmp_path / name).read_bytes() == b"kept"
    write_depth_image(DEPTHS, tmp_path / name, overwrite=True)
    assert (tmp_path / name).read_bytes() != b"kept"
    with pytest.raises(OutputError, match="missing"):
        write_depth_image(DEPTHS, tmp_path / "missing" / name)


def encoded(form, rgb=None, **options):
    file = io.BytesIO()
    (Image.new("RGB", (64, 48), (9, 9, 9)) if rgb is None else Image.fromarray(rgb)).save(file, form, **options)
    return file.getvalue()


def test_a_jpeg_of_very_many_scans_and_a_png_whose_head_declares_very_many_pixels_are_refused():
    for progressive in (False, True):
        content = encoded("JPEG", progressive=progressive)
        assert np.ptp(EncodedImage(content, "jpeg", 64, 48)()) == 0
        last = content.rindex(b"\xff\xda")
        many = content[:-2] + content[last:-2] * 200 + content[-2:]
        with pytest.raises(DataError, match="scans, each of which may paint the whole image; expected at most 100"):
            EncodedImage(many, "jpeg", 64, 48)()
    for side in (60_000, 10_000):
        content = encoded("PNG")
        content = content[:16] + struct.pack(">II", side, side) + content[24:]
        with pytest.raises(DataError, match=r"expected 64x48|expected 134217728 pixels at most"):
            EncodedImage(content, "png", 64, 48)()
        # even where so many are expected
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises(DataError, match=r"cannot be decoded as png|pixels at most"):
                EncodedImage(content, "png", side, side)()


PIXELS = np.random.default_rng(0).integers(0, 256, (40, 56, 3), np.uint8)
SECRET = b"49.011 N, taken by Ann"


def jpeg(**options):
    exif = Image.Exif()
    exif[0x010E] = SECRET.decode()
    return encoded("JPEG", PIXELS, exif=exif, comment=SECRET, **options)


def pixels(content):
    with Image.open(io.BytesIO(content)) as image:
        image.load()
        return np.array(image), dict(image.getexif()), image.info


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_blocks": 2}])
def test_a_jpeg_loses_its_locations_and_comments_and_neither_pixel_nor_profile_of_colours(options):
    profile = b"a profile" * 20
    content = jpeg(icc_profile=profile, **options) + jpeg()
    bare, left_out = _stripped(content)
    assert SECRET in content
    assert SECRET not in bare
    assert {"APP1", "COM", "after the end"} <= set(left_out)
    before, after = pixels(content), pixels(bare)
    assert np.array_equal(before[0], after[0])
    assert (after[1], after[2]["icc_profile"]) == ({}, profile)


def test_a_png_loses_its_texts_and_no_pixel_and_other_files_are_refused_or_cut():
    text = PngImagePlugin.PngInfo()
    text.add_text("location", SECRET.decode())
    bare, left_out = _stripped(encoded("PNG", PIXELS, pnginfo=text) + SECRET)
    assert SECRET not in bare
    assert set(left_out) == {"tEXt", "after the end"}
    assert np.array_equal(pixels(bare)[0], PIXELS)
    for content, problem in ((b"GIF89a", "neither JPEG nor PNG"), (jpeg()[:10], "ends within a segment")):
        with pytest.raises(DataError, match=problem):
            _stripped(content)
    broken = jpeg()[:-30]
    assert _stripped(broken)[0].endswith(broken[-20:])


CONTENT = bytes(range(50))


@pytest.mark.parametrize("content", [CONTENT, memoryview(CONTENT)])
def test_bytes_are_read_and_sought_as_in_a_file(content):
    ours, theirs = io.BufferedReader(ByteStream(content), 8), io.BytesIO(CONTENT)
    for step in (
        lambda file: file.read(5),
        lambda file: file.seek(20),
        lambda file: file.read(11),
        lambda file: file.seek(-4, os.SEEK_CUR),
        lambda file: file.tell(),
        lambda file: file.seek(-3, os.SEEK_END),
        lambda file: file.read(),
        lambda file: file.seek(90),
        lambda file: file.read(1),
    ):
        assert step(ours) == step(theirs)


def test_numbers_fields_and_parts_of_messages_are_written_as_protobuf_does_and_fields_found_without_being_read():
    for number in (0, 1, 127, 128, 300, 16383, 16384, 2**31, 2**35 + 5):
        assert varint(number) == _VarintBytes(number)
        assert read_varint(b"." + varint(number), 1, 1 + len(varint(number))) == (number, 1 + len(varint(number)))
    content = b"x" * 200
    assert fusion_pb2.ImageData.FromString(field_head(8, len(content)) + content).data == content
    inner = [b"\x18\x05", memoryview(field_head(8, 3)), b"abc"]
    request = fusion_pb2.SendRequest.FromString(b"".join(enclosed(2, inner)))
    assert (request.image.seq, request.image.data) == (5, b"abc")
    image = fusion_pb2.ImageData(seq=300, encoding="rgb8", data=b"abc", timestamp=fusion_pb2.Timestamp(s=5))
    content = b"??" + image.SerializeToString() + b"?"
    fields = wire_fields(content, 2, len(content) - 1)
    assert [field.number for field in fields] == [2, 3, 6, 8]
    assert content[fields[3].start : fields[3].stop] == b"abc"
    assert content[fields[1].head : fields[1].stop] == b"\x18\xac\x02"
    # what is unusual or very long is left to protobuf
    odd = b"\x0b", b"\x0a\x05ab", b"\x08", b"\x08\xff", b"\x0d123", b"\x08" + b"\xff" * 11, b"\x08\x01" * 1001
    assert [wire_fields(content, 0, len(content)) for content in odd] == [None] * 7


def line(number):
    return DataError("/drive/data.jsonl", f"line {number}", f"{number} is odd")


@pytest.mark.parametrize(
    ("content", "location", "value"),
    [
        (b'{"images": [],\n "annotations": [{"id": 1}, {"bbox": [1, 2', "line 2, column 43", "annotations[1].bbox[1]"),
        (b'{"a": {"b c": 1, "d": "\xc3\xa4\\"', "line 1, column 27", "a.d"),
        (b'{"a": {"b": [], "nam', "line 1, column 21", "a"),
        (b'[{"a": [[],[]]}, {', "line 1, column 19", "[1]"),
        (b"[" * 60, "line 1, column 61", "…]" + "[0]" * 33),
        (b"{", "line 1, column 2", "its first value"),
    ],
)
def test_json_that_is_cut_off_is_reported_with_line_column_and_the_value_it_ends_in(tmp_path, content, location, value):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(DataError) as error:
        read_json(path, object)
    assert error.value.location == location
    assert error.value.problem == f"is no JSON: the file ends within {value}, it is cut off"
    with pytest.raises(DataError, match=rf"a\.json: {location}: is no JSON: "):
        open_scene(path)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b'{"a": 1,\n\n  "b": x}', "line 3, column 8: is no JSON: invalid character"),
        (b'{"a": "\xff"}', "line 1, column 8: is no JSON: Invalid UTF-8"),
        (b"", "line 1, column 1: is no JSON: the file is empty"),
        (b"[" * 100_000, "is no JSON: "),
    ],
)
def test_json_with_other_damage_is_reported_where_it_is_and_a_mark_before_it_is_none(tmp_path, content, problem):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"a\.json: {problem}"):
        read_json(path, object)
    path.write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_json(path, dict) == {"a": 1}
    (tmp_path / "a.jsonl").write_bytes(b'{"a": 1}\n{"a": 2}\n')
    assert damage_of_json(tmp_path / "a.jsonl") is None
    path.write_bytes(b'{"a": 1}\n}')
    assert damage_of_json(path) == "a.json: line 2, column 1: is no JSON: trailing characters"


@pytest.mark.parametrize("name", ["coco", "datumaro", "label-studio"])
def test_labels_cut_anywhere_are_refused_as_json_that_is_cut_off(tmp_path, name):
    path = tmp_path / f"a.{name}.json"
    write_scene(scene_of("boxes"), path, format=name)
    whole = path.read_bytes().rstrip()
    for cut in range(1, 40):
        path.write_bytes(whole[: len(whole) * cut // 40])
        with pytest.raises(DataError, match=r"line \d+, column \d+: is no JSON: the file ends within .+, it is cut"):
            open_scene(path)


def test_of_very_many_faults_those_beyond_are_counted_with_the_position_of_the_last():
    ledger = _FaultLedger("/drive")
    for number in range(_MOST_LOCATIONS + 500):
        ledger.fault("broken", line(number))
    ledger.fault("other", line(7))
    assert len(ledger.faults) == _MOST_LOCATIONS + 2
    assert sum(fault.count for fault in ledger.faults if fault.code == "broken") == _MOST_LOCATIONS + 500
    last = ledger.faults[-1]
    assert (last.path, last.count) == (f"data.jsonl: line {_MOST_LOCATIONS + 499}", 500)


def test_locations_are_distinguished_from_the_folder_on_and_vital_faults_refused_even_by_a_lenient_reading():
    with pytest.raises(DataError):
        Ledger(lenient=True).refuse("unreadable", line(1))
    ledger = _FaultLedger("/drive")
    ledger.refuse("unreadable", line(1))
    ledger.fault("camera_model", CalibrationError("/drive/data.jsonl: line 3: frames[].imuToCamera: is skewed: 0.5"))
    ledger.fault("camera_model", CalibrationError("no camera model at all"))
    ledger.fault("camera_model", CalibrationError("/drive/a file: is odd"))
    ledger.fault("broken", line(3))
    assert [(fault.path, fault.problem, fault.code, fault.vital) for fault in ledger.faults] == [
        ("data.jsonl: line 1", "1 is odd", "unreadable", True),
        ("data.jsonl: line 3: frames[].imuToCamera", "is skewed: 0.5", "camera_model", False),
        ("", "no camera model at all", "camera_model", False),
        ("", "a file: is odd", "camera_model", False),
        ("data.jsonl: line 3", "3 is odd", "broken", False),
    ]
