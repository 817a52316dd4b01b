"""Outputs in stores: whole, or not there at all."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import sceneloom
from sceneloom.cli.main import sceneloom as program
from sceneloom.errors import MissingExtraError, OutputError
from sceneloom.formats.remote import stores
from sceneloom.formats.remote.uploads import MARKER, check_remote_output, upload, uploading

NAMES = ["data.jsonl", "frames/0.png", "frames/1.png"]


@pytest.fixture
def drive(tmp_path, encode_sfs):
    frames = [{"timestamp": k, "points": {"positions": np.full((2, 3), k, np.float32)}} for k in range(3)]
    path = tmp_path / "drive.sfs"
    path.write_bytes(encode_sfs({"version": "1.0", "sensors": [{"id": "top", "type": "lidar", "frames": frames}]}))
    return path


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "drive"
    (root / "frames").mkdir(parents=True)
    for name in NAMES:
        (root / name).write_text(name)
    return root


@pytest.fixture
def puts(monkeypatch):
    """Paths of what was sent, in order, and the errors that come of some of them."""
    put, order, faults = stores.Store.put, [], {}

    def noted(self, source):
        order.append(self.path)
        for name in [name for name in faults if self.path.endswith(name) and faults[name]]:
            raise faults[name].pop()
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", noted)
    return order, faults


def test_a_scene_is_written_to_a_store_as_to_disk_and_replaces_nothing_unless_it_may(memory, drive, tmp_path):
    memory.pipe("/bucket/deep/copy.sfs", b"old")
    with sceneloom.open(drive) as scene:
        with pytest.raises(OutputError, match=r"bucket/deep/copy\.sfs: exists already; .*--overwrite"):
            sceneloom.write(scene, "memory://bucket/deep/copy.sfs")
        assert memory.cat_file("/bucket/deep/copy.sfs") == b"old"
        sceneloom.write(scene, tmp_path / "copy.sfs")
        sceneloom.write(scene, "memory://bucket/deep/copy.sfs", overwrite=True)
    assert memory.cat_file("/bucket/deep/copy.sfs") == (tmp_path / "copy.sfs").read_bytes()
    assert sceneloom.convert(drive, "memory://bucket/other.sfs").target == "memory://bucket/other.sfs"
    assert "/bucket/other.sfs" in memory.store


def test_a_verb_that_fails_leaves_nothing_and_an_upload_that_is_cut_is_begun_anew(memory, folder, waits, puts):
    with pytest.raises(RuntimeError), uploading("memory://bucket/a.bin", overwrite=False) as draft:
        draft.write_bytes(b"half")
        raise RuntimeError
    assert memory.store == {}
    assert not draft.parent.exists()
    puts[1]["data.jsonl"] = [ConnectionResetError("cut"), TimeoutError("slow")]
    upload(folder / "data.jsonl", "memory://bucket/data.jsonl")
    assert (len(waits), memory.cat_file("/bucket/data.jsonl")) == (2, b"data.jsonl")


def test_chunks_that_were_sent_are_given_up_where_one_fails(memory, tmp_path, waits, monkeypatch):
    """Nothing may put them together later, neither a commit nor the file's end."""
    (tmp_path / "a.bin").write_bytes(b"x" * 100)
    reported = []

    class File:
        closed = False

        def write(self, piece):
            reported.append(len(piece))
            if len(reported) == 3:
                raise PermissionError(13, "not any more")

        def __getattr__(self, name):
            return lambda: reported.append(name)

    monkeypatch.setattr(stores, "_PART", 40)
    monkeypatch.setattr(type(memory), "open", lambda *_, **__: File())
    with pytest.raises(OutputError, match=r"memory://bucket/a\.bin: cannot be written: .*not any more"):
        upload(tmp_path / "a.bin", "memory://bucket/a.bin")
    assert reported == [40, 40, 20, "discard"]
    assert waits == []


def test_a_folder_replaces_all_of_the_old_one_its_marker_comes_last_and_one_that_fails_midway_is_taken_back(
    memory, folder, puts
):
    puts[1]["1.png"] = [PermissionError(13, "no")]
    with pytest.raises(OutputError, match="cannot be written"):
        upload(folder, "memory://bucket/drive")
    assert memory.store == {}
    for name in (MARKER, "old.bin", "data.jsonl"):
        memory.pipe(f"/bucket/drive/{name}", b"old")
    with pytest.raises(OutputError, match="exists already"):
        check_remote_output("memory://bucket/drive", overwrite=False)
    upload(folder, "memory://bucket/drive")
    assert puts[0][-1] == f"/bucket/drive/{MARKER}"
    assert sorted(memory.find("/bucket/drive")) == [f"/bucket/drive/{name}" for name in (MARKER, *NAMES)]
    assert [memory.cat_file(f"/bucket/drive/{name}").decode() for name in NAMES] == NAMES


@pytest.mark.parametrize(
    ("url", "error", "problem"),
    [
        ("https://me:hidden@host/drive.sfs", OutputError, "web server, which is only read from"),
        ("s3://", OutputError, "names no file or folder"),
        ("gs://b/drive.sfs", MissingExtraError, r"gs://b/drive\.sfs: .*gcsfs.*pip install 'sceneloom\[cloud\]'"),
    ],
)
def test_locations_that_nothing_can_be_written_to_are_refused(monkeypatch, url, error, problem):
    monkeypatch.setitem(__import__("sys").modules, "gcsfs", None)
    with pytest.raises(error, match=problem):
        check_remote_output(url, overwrite=False)


def test_verbs_write_to_stores(memory, drive):
    convert = ["convert", str(drive), "memory://bucket/copy.sfs"]
    done = CliRunner().invoke(program, convert)
    assert done.exit_code == 0, done.output
    assert "memory://bucket/copy.sfs" in done.output
    again = CliRunner().invoke(program, convert)
    assert again.exit_code == 1
    assert "exists already" in str(again.exception)
    thin = ["edit", "thin", "memory://bucket/copy.sfs", "-o", "memory://bucket/thin.sfs", "--every", "2", "--json"]
    done = CliRunner().invoke(program, thin)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["output"] == "memory://bucket/thin.sfs"
    with sceneloom.open("memory://bucket/thin.sfs") as scene:
        assert len(scene.lidars[0].frames) == 2
