"""Zipped drives: the same scene as from the folder, nothing outside the folder, nothing left behind."""

import pickle
import stat
import subprocess
import sys
import tempfile
import zipfile

import numpy as np
import pytest
from tests.unit.formats.labelling.test_round_trips import scene_of

from sceneloom.checks import validate
from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.base import zipped
from sceneloom.formats.base.registry import find_format, open_scene, write_scene
from sceneloom.formats.recording.spec import FORMAT

LINES = [
    {"sensor": {"type": "gyroscope", "values": [0.0, 0.1, 0.2]}, "time": 0.0},
    {"frames": [{"cameraInd": 0}], "number": 0, "time": 0.0},
    {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": "lidar/0.bin"}, "time": 0.0},
    {"frames": [{"cameraInd": 0}], "number": 1, "time": 0.1},
]


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """The folder of temporary files, so that the test sees what is left in it."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def drive(recording, pinhole):
    recording.lines(LINES).calibration([pinhole]).video("data.mkv", 2)
    return recording.points("lidar/0.bin", [(1.0, 2.0, 3.0, 7, 1, 0.0)]).path


def zip_of(folder, path, *, top="", extra=()):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            archive.write(file, top + str(file.relative_to(folder)))
        for name, content in extra:
            archive.writestr(name, content)
    return path


def assert_refused(path, scratch, problem):
    with pytest.raises(DataError, match=problem):
        FORMAT.open(path)
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize("top", ["", "my drive/"])
def test_a_zipped_drive_is_the_same_scene_and_its_faults_are_reported_as_those_of_a_folder(
    drive, scratch, tmp_path, top
):
    extra = [("__MACOSX/._drive", b"x"), (f"{top}.DS_Store", b"x")] if top else []
    path = zip_of(drive, tmp_path / "drive.zip", top=top, extra=extra)
    assert find_format(path).name == "recording"
    with FORMAT.open(drive) as expected, open_scene(path) as scene:
        assert scene.source == str(path)
        assert [s.id for s in scene.sensors] == [s.id for s in expected.sensors]
        for k in range(2):
            np.testing.assert_array_equal(scene.cameras[0].images[k].rgb, expected.cameras[0].images[k].rgb)
        np.testing.assert_array_equal(scene.lidars[0].frames[0].points.positions, [[1.0, 2.0, 3.0]])
        assert len(list(scratch.iterdir())) == 1
    with (drive / "data.jsonl").open("a") as file:
        file.write("{broken\n")
    zip_of(drive, path, top=top)
    assert_refused(path, scratch, rf"drive\.zip/{top}data\.jsonl: line 5: {{broken")
    findings = validate(path, locations=None).findings
    assert [(f.rule, f.path) for f in findings if f.severity == "error"] == [("broken-lines", "data.jsonl: line 5")]
    assert list(scratch.iterdir()) == []


def test_frames_go_to_other_processes_and_nothing_is_left_when_they_end(drive, scratch, tmp_path):
    def run(code, **options):
        return subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, **options).stdout

    path = zip_of(drive, tmp_path / "drive.zip")
    with open_scene(path) as scene:
        other = "import pickle, sys; scene = pickle.load(sys.stdin.buffer);"
        mean = run(f"{other} print(scene.cameras[0].images[1].rgb.mean()); scene.close()", input=pickle.dumps(scene))
        assert float(mean) == 10.0  # image k is grey 10 k
        # the other process closed its scene and ended; the files are this one's
        assert scene.cameras[0].images[1].rgb.mean() == 10.0
    assert list(scratch.iterdir()) == []
    code = (
        f"import sceneloom, os; scene = sceneloom.open({str(path)!r});"
        "frames = scene.cameras[0].images; del scene;"
        "print(frames[1].rgb.mean(), len(os.listdir(os.environ['TMPDIR'])))"
    )
    assert run(code, text=True, env={"TMPDIR": str(scratch)}).split() == ["10.0", "1"]
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "mode", "problem"),
    [
        ("../outside.bin", 0, "leads out of the folder"),
        ("lidar/../../outside.bin", 0, "leads out of the folder"),
        ("/tmp/outside.bin", 0, "leads out of the folder"),
        ("C:/outside.bin", 0, "leads out of the folder"),
        ("lidar\\..\\..\\outside.bin", 0, "leads out of the folder"),
        ("lidar\\0.bin", 0, "is no name of a file"),
        ("a" * 1001, 0, "is no name of a file"),
        ("lidar/0.bin", stat.S_IFLNK | 0o777, "is a link or a device"),
        ("lidar/0.bin", stat.S_IFIFO | 0o777, "is a link or a device"),
        ("data.jsonl", 0, "stands there twice"),
        ("data.jsonl/x", 0, "cannot be unpacked"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_names_that_lead_astray_are_refused(tmp_path, scratch, name, mode, problem):
    path = tmp_path / "bad.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data.jsonl", "{}\n")
        member = zipfile.ZipInfo(name)
        member.external_attr = mode << 16
        archive.writestr(member, b"../../x")
    assert_refused(path, scratch, problem)
    assert not list(tmp_path.rglob("outside.bin"))


def test_archives_beyond_the_bounds_are_refused_before_anything_is_written(tmp_path, scratch, monkeypatch):
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data.jsonl", "{}\n")
        archive.writestr("data.mkv", bytes(5_000_000))
    for bound, value, problem in (
        ("MOST_FILES", 1, "holds 2 files; expected 1 at most"),
        ("LARGEST_TOTAL", 1000, "says that it holds 5000003 bytes; expected 1000 at most"),
        ("_ALWAYS_FINE", 1000, "times as many; expected 300 times at most"),
        ("_SPARE_BYTES", 1 << 60, "free; unpack it elsewhere and open the folder, or set TMPDIR"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(zipped, bound, value)
            assert_refused(path, scratch, problem)


def test_damaged_encrypted_and_other_archives_and_those_cut_anywhere_raise_errors_of_ours_only(
    drive, scratch, tmp_path
):
    whole, path = zip_of(drive, tmp_path / "drive.zip").read_bytes(), tmp_path / "bad.zip"
    # a wrong byte inside the first file's compressed bytes breaks its checksum
    flipped = bytearray(whole)
    flipped[120] ^= 0xFF
    encrypted = bytearray(whole)
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        encrypted[encrypted.find(signature) + offset] |= 1
    for content, problem in (
        (flipped, "cannot be unpacked"),
        (encrypted, "is encrypted"),
        (whole[: len(whole) // 2], "cannot be unpacked, is damaged or cut off: File is not a zip file"),
        *[(whole[: len(whole) * cut // 400], r"bad\.zip: ") for cut in range(0, 400, 7)],
    ):
        path.write_bytes(content)
        assert_refused(path, scratch, problem)
    path.write_bytes(whole[:-300])
    with pytest.raises(DataError, match="a zip archive that cannot be unpacked, is damaged or cut off"):
        find_format(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.jsonl", "{}")
        archive.writestr("b/data.jsonl", "{}")
    assert not FORMAT.sniff(path)
    assert_refused(path, scratch, r"a zip archive that holds no such drive; expected a folder with a data\.jsonl")


@pytest.mark.parametrize(("name", "top"), [("cvat", ""), ("coco", "export/"), ("yolo", ""), ("supervisely", "a/b/")])
def test_what_labelling_tools_export_as_zip_is_read_as_its_folder_is_and_goes_when_it_is_closed(
    tmp_path, scratch, name, top
):
    folder = tmp_path / f"drive.{name}"
    write_scene(scene_of("cuboids" if name == "supervisely" else "boxes"), folder, format=name)
    path = zip_of(folder, tmp_path / "drive.zip", top=top)
    with open_scene(folder) as expected, open_scene(path) as scene:
        assert (scene.source, scene.format) == (str(path), name)
        assert repr(scene.annotations) == repr(expected.annotations)
        assert len(scene.annotations) > 0
        for shown, wanted in zip(scene.cameras, expected.cameras, strict=True):
            np.testing.assert_array_equal(shown.images[0].rgb, wanted.images[0].rgb)
        assert not any(str(scratch) in warning.location + warning.message for warning in scene.warnings)
    assert list(scratch.iterdir()) == []
    with open_scene(path, format=name) as scene:
        assert len(scene.annotations) == len(expected.annotations)
    assert list(scratch.iterdir()) == []


def test_an_archive_of_one_file_is_that_file_and_of_anything_else_says_what_is_in_it_and_to_unpack_it(
    tmp_path, scratch
):
    write_scene(scene_of("boxes"), tmp_path / "a.xml", format="cvat")
    with zipfile.ZipFile(tmp_path / "one.zip", "w") as archive:
        archive.write(tmp_path / "a.xml", "job 7.xml")
    with open_scene(tmp_path / "one.zip") as scene:
        assert scene.format == "cvat"
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("a/notes.md", "x")
        archive.write(tmp_path / "a.xml", "a/labels/annotations.xml")
    for _ in range(2):  # what was looked into is kept for who opens it, once
        with pytest.raises(UnknownFormatError, match=r"inside are other\.zip/a/labels \(cvat\);") as error:
            open_scene(tmp_path / "other.zip")
        assert "a zip archive: unpack what is wanted of it first (`unzip other.zip -d FOLDER`)" in str(error.value)
        assert str(scratch) not in str(error.value)
        assert len(list(scratch.iterdir())) == 1
    with pytest.raises(DataError, match=r"other\.zip: a zip archive that holds no such drive; expected a \.json file"):
        open_scene(tmp_path / "other.zip", format="coco")
    assert list(scratch.iterdir()) == []
