"""Outputs in stores: whole, or not there at all."""

import json

import fsspec
import numpy as np
import pytest
from click.testing import CliRunner

import sceneloom
from sceneloom.cli.main import sceneloom as program
from sceneloom.errors import MissingExtraError, OutputError
from sceneloom.formats.remote import stores
from sceneloom.formats.remote.uploads import MARKER, check_remote_output, upload, uploading


@pytest.fixture
def memory():
    """A store in memory, empty at first."""
    files = fsspec.filesystem("memory")
    files.store.clear()
    files.pseudo_dirs[:] = [""]
    yield files
    files.store.clear()
    files.pseudo_dirs[:] = [""]


@pytest.fixture
def drive(tmp_path, encode_sfs):
    frames = [{"timestamp": k, "points": {"positions": np.full((2, 3), k, np.float32)}} for k in range(3)]
    path = tmp_path / "drive.sfs"
    path.write_bytes(encode_sfs({"version": "1.0", "sensors": [{"id": "top", "type": "lidar", "frames": frames}]}))
    return path


def test_a_scene_is_written_to_a_store_as_to_disk(memory, drive, tmp_path):
    with sceneloom.open(drive) as scene:
        sceneloom.write(scene, tmp_path / "copy.sfs")
        sceneloom.write(scene, "memory://bucket/deep/copy.sfs")
    assert memory.cat_file("/bucket/deep/copy.sfs") == (tmp_path / "copy.sfs").read_bytes()


def test_what_is_there_is_kept_unless_it_may_be_replaced(memory, drive):
    memory.pipe("/bucket/copy.sfs", b"old")
    with sceneloom.open(drive) as scene:
        with pytest.raises(OutputError, match=r"bucket/copy\.sfs: exists already; .*--overwrite"):
            sceneloom.write(scene, "memory://bucket/copy.sfs")
        assert memory.cat_file("/bucket/copy.sfs") == b"old"
        sceneloom.write(scene, "memory://bucket/copy.sfs", overwrite=True)
    assert memory.cat_file("/bucket/copy.sfs")[:1] == b"{"


def test_a_verb_that_fails_leaves_nothing(memory):
    with pytest.raises(RuntimeError), uploading("memory://bucket/a.bin", overwrite=False) as draft:
        draft.write_bytes(b"half")
        raise RuntimeError
    assert memory.store == {}
    assert not draft.parent.exists()


def test_an_upload_that_is_cut_is_begun_anew(memory, tmp_path, waits, monkeypatch):
    (tmp_path / "a.bin").write_bytes(b"x" * 100)
    put, faults = stores.Store.put, [ConnectionResetError("cut"), TimeoutError("slow")]

    def failing(self, source):
        if faults:
            raise faults.pop()
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", failing)
    upload(tmp_path / "a.bin", "memory://bucket/a.bin")
    assert len(waits) == 2
    assert memory.cat_file("/bucket/a.bin") == b"x" * 100


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


def folder(tmp_path, names):
    root = tmp_path / "drive"
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    return root


def test_the_marker_of_a_folder_comes_last(memory, tmp_path, monkeypatch):
    put, order = stores.Store.put, []
    monkeypatch.setattr(stores.Store, "put", lambda self, source: (order.append(self.path), put(self, source)))
    upload(folder(tmp_path, ["data.jsonl", "frames/0.png", "frames/1.png"]), "memory://bucket/drive")
    assert order[-1] == f"/bucket/drive/{MARKER}"
    assert sorted(memory.find("/bucket/drive")) == [
        f"/bucket/drive/{name}" for name in (MARKER, "data.jsonl", "frames/0.png", "frames/1.png")
    ]
    assert memory.cat_file("/bucket/drive/frames/1.png") == b"frames/1.png"


def test_a_folder_that_fails_midway_is_taken_back(memory, tmp_path, monkeypatch):
    put = stores.Store.put

    def failing(self, source):
        if self.path.endswith("1.png"):
            raise PermissionError(13, "no")
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", failing)
    with pytest.raises(OutputError, match="cannot be written"):
        upload(folder(tmp_path, ["data.jsonl", "frames/0.png", "frames/1.png"]), "memory://bucket/drive")
    assert memory.store == {}


def test_a_folder_that_is_replaced_keeps_nothing_of_the_old_one(memory, tmp_path):
    for name in (MARKER, "old.bin", "data.jsonl"):
        memory.pipe(f"/bucket/drive/{name}", b"old")
    with pytest.raises(OutputError, match="exists already"):
        check_remote_output("memory://bucket/drive", overwrite=False)
    upload(folder(tmp_path, ["data.jsonl"]), "memory://bucket/drive")
    assert sorted(memory.find("/bucket/drive")) == [f"/bucket/drive/{MARKER}", "/bucket/drive/data.jsonl"]
    assert memory.cat_file("/bucket/drive/data.jsonl") == b"data.jsonl"


def test_web_servers_and_locations_without_a_name_are_refused():
    with pytest.raises(OutputError, match="web server, which is only read from"):
        check_remote_output("https://me:hidden@host/drive.sfs", overwrite=False)
    with pytest.raises(OutputError, match="names no file or folder"):
        check_remote_output("s3://", overwrite=False)


def test_the_extra_that_is_missing_for_a_scheme_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gcsfs", None)
    with pytest.raises(MissingExtraError, match=r"gs://b/drive\.sfs: .*gcsfs.*pip install 'sceneloom\[cloud\]'"):
        check_remote_output("gs://b/drive.sfs", overwrite=False)


def test_verbs_write_to_stores(memory, drive):
    done = CliRunner().invoke(program, ["convert", str(drive), "memory://bucket/copy.sfs"])
    assert done.exit_code == 0, done.output
    assert "memory://bucket/copy.sfs" in done.output
    again = CliRunner().invoke(program, ["convert", str(drive), "memory://bucket/copy.sfs"])
    assert again.exit_code == 1
    assert "exists already" in str(again.exception)
    done = CliRunner().invoke(
        program,
        ["edit", "thin", "memory://bucket/copy.sfs", "-o", "memory://bucket/thin.sfs", "--every", "2", "--json"],
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["output"] == "memory://bucket/thin.sfs"
    with sceneloom.open("memory://bucket/thin.sfs") as scene:
        assert len(scene.lidars[0].frames) == 2


def test_convert_of_the_library_writes_to_stores(memory, drive):
    report = sceneloom.convert(drive, "memory://bucket/copy.sfs")
    assert report.target == "memory://bucket/copy.sfs"
    assert "/bucket/copy.sfs" in memory.store
