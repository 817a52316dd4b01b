"""Drives in stores of other programs, by the protocols of S3, Google and Azure: moto, an emulator, Azurite.

The servers are no part of the development environment. With `SCENELOOM_MOTO_PYTHON` naming an interpreter that has
`moto[server]` installed, `SCENELOOM_GCS_PYTHON` one that has `gcp-storage-emulator`, and `SCENELOOM_AZURITE` the
program `azurite-blob`, these tests run; without them, they are skipped.
"""

import os
import re
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from uuid import uuid4

import fsspec
import numpy as np
import pytest
from tests.peers import python_with

import sceneloom
from sceneloom.batch import Input, Job, run
from sceneloom.batch.running import claimed
from sceneloom.errors import DataError, OutputError
from sceneloom.formats.remote import stores
from sceneloom.formats.remote.mirror import find_urls
from sceneloom.formats.remote.uploads import MARKER, upload

MOTO = """
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer("127.0.0.1", 0)
server.start()
print("at http://127.0.0.1:%d" % server._server.server_port, flush=True)
input()
"""

GOOGLE = """
from gcp_storage_emulator.server import create_server
server = create_server("127.0.0.1", 0, in_memory=True)
server.start()
print("at http://127.0.0.1:%d" % server._api._httpd.server_port, flush=True)
input()
"""

AZURITE = ("--inMemoryPersistence", "--disableTelemetry", "--skipApiVersionCheck", "--blobPort", "0")

KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
"""Azurite's own account has this key. Source: its documentation."""


# how the client of Google sends parts is its own affair
pytestmark = pytest.mark.filterwarnings("ignore:Sending a large body directly:ResourceWarning")


def command(scheme):
    """What serves a scheme."""
    if scheme == "s3":
        return [python_with("moto[server]", "SCENELOOM_MOTO_PYTHON"), "-c", MOTO]
    if scheme == "gs":
        return [python_with("gcp-storage-emulator", "SCENELOOM_GCS_PYTHON"), "-c", GOOGLE]
    program = os.environ.get("SCENELOOM_AZURITE")
    if program is None:
        pytest.skip("no Azurite: SCENELOOM_AZURITE names no program azurite-blob")
    return [program, *AZURITE]


def environment(scheme, address):
    """Where the server is, and who asks."""
    account = f"{address}/devstoreaccount1"
    # else the client of Google looks for credentials, to ask of what kind a bucket is
    google = {"STORAGE_EMULATOR_HOST": address, "GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT": "false"}
    amazon = {"ACCESS_KEY_ID": "whoever", "SECRET_ACCESS_KEY": "hidden", "DEFAULT_REGION": "us-east-1"}
    azure = f"DefaultEndpointsProtocol=http;AccountName=devstoreaccount1;AccountKey={KEY};BlobEndpoint={account};"
    return {
        "s3": {f"AWS_{name}": value for name, value in {**amazon, "ENDPOINT_URL": address}.items()},
        "gs": google,
        "az": {"AZURE_STORAGE_CONNECTION_STRING": azure},
    }[scheme]


CLIENTS = {"s3": "s3fs", "gs": "gcsfs", "az": "adlfs"}


@pytest.fixture(scope="module", params=CLIENTS)
def server(request):
    """A scheme, and the address of a server of its own, which ends with the tests."""
    pytest.importorskip(CLIENTS[request.param], reason=f"{CLIENTS[request.param]} of the extra `cloud` is not there")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command(request.param), text=True, **pipes) as running:
        address = next(found[1] for line in running.stdout if (found := re.search(r" (http://127\S+\d)", line)))
        yield request.param, address
        running.kill()


@pytest.fixture
def bucket(server, monkeypatch):
    """An empty bucket; where the server is and who asks stands in the environment."""
    scheme, address = server
    for name, value in environment(scheme, address).items():
        monkeypatch.setenv(name, value)
    fsspec.get_filesystem_class(scheme).clear_instance_cache()
    yield Bucket(scheme, fsspec.filesystem(scheme))
    fsspec.get_filesystem_class(scheme).clear_instance_cache()


class Bucket:
    """A new bucket, as another client sees it; servers do not all remove them."""

    def __init__(self, scheme, files):
        self.scheme, self.files = scheme, files
        self.name = f"drives-{uuid4().hex}"
        files.mkdir(self.name)

    def url(self, name):
        return f"{self.scheme}://{self.name}/{name}"

    def names(self):
        self.files.invalidate_cache()
        return [name.removeprefix(f"{self.name}/") for name in self.files.find(self.name)]


@pytest.fixture
def drive(tmp_path, encode_sfs):
    rng = np.random.default_rng(7)
    clouds = rng.normal(size=(30, 50_000, 3)).astype(np.float32)
    frames = [{"timestamp": 100_000 * k, "points": {"positions": cloud}} for k, cloud in enumerate(clouds)]
    path = tmp_path / "drive.sfs"
    path.write_bytes(encode_sfs({"version": "1.0", "sensors": [{"id": "top", "type": "lidar", "frames": frames}]}))
    return path


def same_frames(url, drive, numbers):
    with sceneloom.open(url) as scene, sceneloom.open(drive) as local:
        for k in numbers:
            found, expected = scene.lidars[0].frames[k].points, local.lidars[0].frames[k].points
            np.testing.assert_array_equal(found.positions, expected.positions)


def test_a_scene_goes_there_in_parts_and_comes_back_by_ranges(bucket, drive, monkeypatch):
    monkeypatch.setattr(stores, "_PART", 5 << 20)
    sceneloom.convert(drive, bucket.url("deep/copy.sfs"))
    if bucket.scheme == "s3":
        tag = bucket.files.info(f"{bucket.name}/deep/copy.sfs")["ETag"]
        assert "-" in tag, "the mark of an object that was put in parts"
    same_frames(bucket.url("deep/copy.sfs"), drive, (0, 17, 29))
    assert find_urls(bucket.url("*/*.sfs")) == [bucket.url("deep/copy.sfs")]
    with pytest.raises(OutputError, match="exists already"):
        sceneloom.convert(drive, bucket.url("deep/copy.sfs"))
    sceneloom.convert(drive, bucket.url("copy.mcap"))
    same_frames(bucket.url("copy.mcap"), drive, (3,))


def test_an_upload_that_fails_leaves_neither_object_nor_parts(bucket, drive, monkeypatch):
    if bucket.scheme == "gs":
        pytest.skip("the emulator does not know how an upload is given up")
    monkeypatch.setattr(stores, "_PART", 5 << 20)
    opened = type(bucket.files).open

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

    with monkeypatch.context() as faulty:
        faulty.setattr(type(bucket.files), "open", failing)
        with pytest.raises(OutputError, match="not any more"):
            upload(drive, bucket.url("copy.sfs"))
    assert bucket.names() == []
    if bucket.scheme == "s3":
        assert bucket.files.call_s3("list_multipart_uploads", Bucket=bucket.name).get("Uploads", []) == []


def test_folders_are_written_with_their_marker_and_read_again_unless_a_file_changed_meanwhile(bucket, drive):
    sceneloom.convert(drive, bucket.url("clouds"), to="pcd")
    names = [name.removeprefix("clouds/") for name in bucket.names()]
    assert MARKER in names
    assert sum(name.endswith(".pcd") for name in names) == 30
    same_frames(bucket.url("clouds"), drive, (7, 8, 9))
    with sceneloom.open(bucket.url("clouds")) as scene:
        name = sorted(bucket.files.find(f"{bucket.name}/clouds"))[20]
        content = bucket.files.cat(name)
        bucket.files.pipe(name, content[:-1] + bytes([content[-1] ^ 1]))
        with pytest.raises(DataError, match="was changed after it was opened"):
            scene.lidars[0].frames[20].points.positions  # noqa: B018


def test_what_is_missing_is_stated_and_no_key_is_shown(bucket):
    with pytest.raises(DataError, match=r"/absent\.sfs: cannot be found") as reported:
        sceneloom.open(bucket.url("absent.sfs"))
    assert not reported.value.passing
    with pytest.raises(OutputError, match="nobucket") as refused:
        upload(Path(__file__), f"{bucket.scheme}://nobucket/copy.sfs")
    for error in (reported, refused):
        assert "hidden" not in str(error.value)
        assert KEY not in str(error.value)


VERB = '''
import os, signal
from pathlib import Path

import sceneloom
from sceneloom.formats.remote import stores
from sceneloom.formats.remote.mirror import names_below

put = stores.Store.put


def die(self, source):
    """The first part of an output, and no more."""
    file = self.files.open(self.path, "wb", block_size=stores._PART, autocommit=False)
    file.write(source.read_bytes()[: stores._PART + 1])
    os.kill(os.getpid(), signal.SIGKILL)


def copy(location, output, options):
    stores._PART = 5 << 20
    name, mark = output.name, Path(options["marks"], output.name)
    seen = name in names_below(options["target"])
    with mark.open("a") as log:
        log.write(f"{seen} ")
    stores.Store.put = die if mark.read_text() == "False " else put
    sceneloom.convert(location, output)
'''


@pytest.mark.slow
def test_a_batch_into_a_store_is_whole_and_of_one_run(bucket, drive, tmp_path, monkeypatch):
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "verb_that_dies.py").write_text(VERB)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "modules"), prepend=os.pathsep)
    (tmp_path / "marks").mkdir()
    target = bucket.url("run1/")
    locations = [bucket.url(f"in/{name}.sfs") for name in "ab"]
    for location in locations:
        upload(drive, location)
    job = Job(
        verb="copy",
        call="verb_that_dies:copy",
        inputs=tuple(Input(location=location) for location in locations),
        options={"marks": str(tmp_path / "marks"), "target": target},
        suffix=".sfs",
    )

    def done(**how):
        return run(job, target, **{"record": tmp_path / "record", "workers": 2, **how})

    first = done()
    assert (first.done, first.failed, first.retried) == (2, 0, 2)
    assert bucket.names() == ["in/a.sfs", "in/b.sfs", "run1/.sceneloom-run", "run1/a.sfs", "run1/b.sfs"]
    # what a worker had sent when it was killed was not to be seen
    assert {path.read_text() for path in (tmp_path / "marks").iterdir()} == {"False False "}
    same_frames(bucket.url("run1/b.sfs"), drive, (0, 29))
    assert done(resume=True).skipped == 2
    bucket.files.rm_file(f"{bucket.name}/run1/a.sfs")
    again = done(resume=True)
    assert (again.done, again.skipped) == (2, 1)
    same_frames(bucket.url("run1/a.sfs"), drive, (0, 29))
    with pytest.raises(OutputError, match=r"holds the outputs of a run whose record is .*/record on "):
        done(record=tmp_path / "other")


def test_of_two_runs_that_begin_together_one_has_the_location(bucket, tmp_path):
    if bucket.scheme == "gs":
        pytest.skip("the emulator takes an object twice where the store refuses the second one")

    def begin(k):
        try:
            return claimed(bucket.url("run1"), run=f"run{k}", record=tmp_path / str(k))
        except OutputError as error:
            return str(error)

    with ThreadPoolExecutor(4) as thread_pool:
        reported = list(thread_pool.map(begin, range(4)))
    assert sum(isinstance(one, str) for one in reported) == 3
    assert bucket.names() == ["run1/.sceneloom-run"]
