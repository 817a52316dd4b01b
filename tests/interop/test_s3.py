"""Drives in a store that another program serves: moto's S3 server, by the protocol that Amazon's client speaks.

The server is no part of the development environment. With `SCENELOOM_MOTO_PYTHON` naming an interpreter that has
`moto[server]` installed, these tests run; without it, they are skipped.
"""

import re
import subprocess

import fsspec
import numpy as np
import pytest
from tests.peers import python_with

import sceneloom
from sceneloom.errors import DataError, OutputError
from sceneloom.formats.remote import MARKER, stores, upload

SERVER = """
import threading
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer("127.0.0.1", 0)
server.start()
print("port", server._server.server_port, flush=True)
input()
"""


@pytest.fixture(scope="module")
def endpoint():
    """Address of a server of its own, which ends with the tests."""
    command = [python_with("moto[server]", "SCENELOOM_MOTO_PYTHON"), "-c", SERVER]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        port = next(found[1] for line in server.stdout if (found := re.match(r"port (\d+)", line)))
        yield f"http://127.0.0.1:{port}"
        server.terminate()


@pytest.fixture
def bucket(endpoint, monkeypatch):
    """An empty bucket; where the server is and who asks stands in the environment."""
    for name, value in {
        "AWS_ACCESS_KEY_ID": "whoever",
        "AWS_SECRET_ACCESS_KEY": "hidden",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": endpoint,
    }.items():
        monkeypatch.setenv(name, value)
    fsspec.filesystem("s3").clear_instance_cache()
    files = fsspec.filesystem("s3")
    files.mkdir("drives")
    yield files
    files.rm("drives", recursive=True)
    files.clear_instance_cache()


@pytest.fixture
def drive(tmp_path, encode_sfs):
    rng = np.random.default_rng(7)
    frames = [
        {"timestamp": 100_000 * k, "points": {"positions": rng.normal(size=(50_000, 3)).astype(np.float32)}}
        for k in range(30)
    ]
    path = tmp_path / "drive.sfs"
    path.write_bytes(
        encode_sfs({"version": "1.0", "sensors": [{"id": "top", "type": "lidar", "frames": frames}]})
    )
    return path


def test_a_scene_goes_there_in_parts_and_comes_back_by_ranges(bucket, drive, monkeypatch):
    monkeypatch.setattr(stores, "_PART", 5 << 20)
    sceneloom.convert(drive, "s3://drives/deep/copy.sfs")
    assert "-" in bucket.info("drives/deep/copy.sfs")["ETag"], "the mark of an object that was put in parts"
    with sceneloom.open("s3://drives/deep/copy.sfs") as scene, sceneloom.open(drive) as local:
        for k in (0, 17, 29):
            found, expected = scene.lidars[0].frames[k].points, local.lidars[0].frames[k].points
            np.testing.assert_array_equal(found.positions, expected.positions)


def test_mcap_files_come_by_ranges(bucket, drive):
    sceneloom.convert(drive, "s3://drives/copy.mcap")
    with sceneloom.open("s3://drives/copy.mcap") as scene, sceneloom.open(drive) as local:
        found, expected = scene.lidars[0].frames[3].points, local.lidars[0].frames[3].points
        np.testing.assert_array_equal(found.positions, expected.positions)


def test_an_upload_that_fails_leaves_neither_object_nor_parts(bucket, drive, monkeypatch):
    monkeypatch.setattr(stores, "_PART", 5 << 20)
    opened = type(bucket).open

    def failing(self, *arguments, **options):
        file = opened(self, *arguments, **options)
        if "w" in arguments[1]:
            write, count = file.write, iter(range(9))

            def stops(piece):
                if next(count) == 2:
                    raise PermissionError(13, "not any more")
                return write(piece)

            file.write = stops
        return file

    monkeypatch.setattr(type(bucket), "open", failing)
    with pytest.raises(OutputError, match="not any more"):
        upload(drive, "s3://drives/copy.sfs")
    monkeypatch.undo()
    assert not bucket.exists("drives/copy.sfs")
    assert bucket.call_s3("list_multipart_uploads", Bucket="drives").get("Uploads", []) == []


def test_folders_are_written_with_their_marker_and_read_again(bucket, drive):
    sceneloom.convert(drive, "s3://drives/clouds", to="pcd")
    names = [name.removeprefix("drives/clouds/") for name in bucket.find("drives/clouds")]
    assert MARKER in names
    assert sum(name.endswith(".pcd") for name in names) == 30
    with sceneloom.open("s3://drives/clouds") as scene, sceneloom.open(drive) as local:
        found, expected = scene.lidars[0].frames[7].points, local.lidars[0].frames[7].points
        np.testing.assert_array_equal(found.positions, expected.positions)


def test_what_is_missing_is_said_and_no_key_is_shown(bucket):
    with pytest.raises(DataError, match=r"s3://drives/absent\.sfs: cannot be found") as told:
        sceneloom.open("s3://drives/absent.sfs")
    assert not told.value.passing
    assert "hidden" not in str(told.value)
    with pytest.raises(OutputError, match="nobucket"):
        upload(__import__("pathlib").Path(__file__), "s3://nobucket/copy.sfs")
