"""`sceneloom send`, `get` and `conformance` against services in this process."""

import json

import numpy as np
import pytest
from PIL import Image
from tests.unit.cli.conftest import small_drive

import sceneloom
from sceneloom.colouring.cuboid_projection import project_cuboids
from sceneloom.db34t import CalibrationData, ImageData, PointCloudData, Timestamp
from sceneloom.db34t.conformance import examination
from sceneloom.db34t.conformance.examination import CHECKS
from sceneloom.db34t.transport import Security
from sceneloom.service.client import FusionClient
from sceneloom.service.running import running_server
from sceneloom.service.server import ServerSettings
from sceneloom.service.session_log import SessionLog, compare

TOKEN = "sixteen-characters-or-more"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "drive.sfs"
    sceneloom.write(project_cuboids(small_drive().scene), path)
    return path


@pytest.fixture(scope="module")
def address():
    with running_server() as server:
        yield server.address


@pytest.fixture
def sent(drive, address, request, reported):
    """The name of a session that was sent the drive."""
    name = f"s{abs(hash(request.node.name))}"
    report = reported("send", drive, address, "--rate", 0, "--session", name, "-q")
    assert report["refused"] == {}
    assert report["sent"]["points"] == report["sent"]["image"] == report["sent"]["boxes_3d"] == 3
    return name


def test_what_was_sent_is_reported_and_results_without_an_output_are_lines_of_json(drive, address, succeeds):
    session = ("--session", "reported")
    shown = succeeds("send", drive, address, "--rate", 0, *session, "-q").out
    assert all(text in shown for text in ("3 image", "refused: none", "lidar"))
    get = ("get", address, "--type", "sensor", *session)
    followed = succeeds(*get, "--follow", "--count", 2).out
    assert [json.loads(line)["number"] for line in followed.splitlines()] == [0, 1], "it ends after so many"
    (line,) = (json.loads(line) for line in succeeds(*get).out.splitlines())
    assert (line["number"], line["width"], "image_data" in line) == (2, 96, False)
    assert succeeds(*get).out == "", "all were fetched, which is no error"


def test_sensor_data_become_a_folder_with_depths_images_and_points(address, sent, refuses, reported, tmp_path):
    out = tmp_path / "out"
    with FusionClient(address, session=sent) as client:
        client.set_property("result_queue_length", 10)
    words = ("get", address, "--type", "sensor", "-o", out, "--session", sent)
    assert reported(*words, "--count", 2)["results"] == 2
    lines = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    with Image.open(out / lines[0]["depth"]) as image:
        depth = np.array(image)
    assert (depth.shape, depth.dtype, depth.max() > 0) == ((64, 96), np.uint16, True)
    with Image.open(out / lines[1]["image"]) as image:
        assert image.size == (96, 64)
    with np.load(out / lines[0]["points"]) as points:
        assert set(points) >= {"x", "y", "z", "r", "g", "b"}
        assert len(points["x"]) == lines[0]["point_num"]
    refuses(1, "", *words)


def test_sensor_data_become_a_scene_file_and_detections_lines_as_table_10(address, sent, succeeds, tmp_path):
    scene_file, lines = tmp_path / "out.sfs", tmp_path / "out.jsonl"
    succeeds("get", address, "--type", "sensor", "-o", scene_file, "--session", sent)
    with sceneloom.open(scene_file) as scene:
        assert [len(lidar.frames) for lidar in scene.lidars] == [3]
        assert scene.lidars[0].frames[0].points.colors is not None
    succeeds("get", address, "--type", "detection", "-o", lines, "--session", sent, "--wait", 0)
    found = json.loads(lines.read_text().splitlines()[0])["detections"][0]
    assert set(found) >= {"id", "class", "confidence", "X", "Y", "Z", "center_cov", "direction", "x1"}


def test_a_log_is_sent_once_more(drive, refuses, reported, succeeds, tmp_path):
    log = tmp_path / "first.mcap"
    with SessionLog(log) as kept, running_server(ServerSettings(observe=kept.session)) as server:
        succeeds("send", drive, server.address, "--rate", 0, "--session", "rig", "-q")
        first = succeeds("get", server.address, "--type", "detection", "--session", "rig").out
    assert compare(log)
    with running_server(ServerSettings()) as server:
        found = reported("send", log, server.address, "--rate", 0, "-q")
        assert (found["sent"]["points"], found["refused"]) == (3, {})
        assert succeeds("get", server.address, "--type", "detection", "--session", "rig").out == first
        refuses(2, "", "send", log, server.address, "--start", 1)


def test_wrong_addresses_certificates_tokens_and_sessions_are_refused(
    drive, address, refuses, tmp_path, monkeypatch, succeeds
):
    monkeypatch.setattr(examination, "PATIENCE_S", 1.0)
    refuses(1, "", "get", "127.0.0.1:9", "--type", "sensor")
    refuses(2, "", "get", "127.0.0.1:9", "--type", "sensor", "--client-cert", drive)
    nobody = "sceneloom: 127.0.0.1:1: no server answers there; is it running"
    refuses(1, nobody, "conformance", "127.0.0.1:1", "--quiet")
    for words in ((address, "--only", "9.9"), (address, "--report", tmp_path / "r.pdf"), ()):
        refuses(2, "", "conformance", *words)
    (token := tmp_path / "token").write_text(f"{TOKEN}\n")
    with running_server(ServerSettings(security=Security(token=TOKEN))) as server:
        for words in (("send", drive, server.address, "--rate", 0), ("conformance", server.address, "--only", "5.3-3")):
            refuses(1, "", *words, "-q")
            succeeds(*words, "-q", "--token-file", token)
    refuses(2, "without TLS", "conformance", "192.0.2.1:1", "--token-file", token, "--quiet")
    for wrong in ("nonsense", "host:", ":50051", "host:port", "a b:1"):
        for verb in (("get", "--type", "sensor"), ("send", "drive"), ("conformance",)):
            refuses(2, "expected HOST:PORT", *verb, wrong)
    monkeypatch.chdir(tmp_path)
    for form in ((), ("--json",), ("-o", "x.jsonl")):
        words = ("get", address, "--type", "detection", "--session", "nosuch", *form)
        assert refuses(2, "session 'nosuch' has received no records", *words).out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["token"]


def test_points_with_fields_of_any_name_become_a_folder(address, succeeds, tmp_path):
    fields = ("x", "y", "z", "file", "allow_pickle", "../up", "echo 1")
    with FusionClient(address, session="names") as client:
        intrinsics, extrinsics = (8, 0, 3.5, 0, 8, 3.5, 0, 0, 1), (0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)
        matrices = {"intrinsic_matrix": intrinsics, "extrinsic_matrix": extrinsics}
        client.set_calibration(CalibrationData(image_size=(8, 8), reference_frame=0, **matrices))
        now = Timestamp(5, 0)
        pixels, how = np.zeros((8, 8, 1), np.uint8), {"encoding": "mono8", "channel": 1}
        image = ImageData(sensor_id=0, timestamp=now, seq=0, height=8, width=8, **how, data=pixels)
        rows = np.arange(14, dtype=np.float32).reshape(2, 7)
        cloud = PointCloudData(sensor_id=0, timestamp=now, seq=0, number=2, fields=fields, fields_number=7, data=rows)
        assert client.send(image)
        assert client.send(cloud)
        client.flush()
    out = tmp_path / "out"
    succeeds("get", address, "--type", "sensor", "--session", "names", "-o", out)
    with np.load(next((out / "points").iterdir())) as points:
        assert set(points) == {*fields, *"rgb"} - {"../up"} | {"..%2Fup"}
        np.testing.assert_array_equal(points["file"], rows[:, 3])
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_our_server_passes_every_check_and_the_report_says_so(call, reported, succeeds, address, tmp_path):
    outcome = succeeds("conformance", address, "--report", tmp_path / "r.json", "--quiet")
    assert outcome.err == ""
    assert outcome.out.splitlines()[0] == f"{address}: {len(CHECKS)} checks: {len(CHECKS)} passed, 0 failed"
    report = json.loads((tmp_path / "r.json").read_text("utf-8"))
    assert (report["passed"], len(report["checks"])) == (True, len(CHECKS))
    listed = succeeds("conformance --checks")
    assert [line.split()[0] for line in listed.out.splitlines()] == [check.id for check in CHECKS]
    found = reported("conformance", address, "--only", "5.4", "--only", "T10-8", "--quiet")
    assert [check["id"] for check in found["checks"]] == ["5.4-1", "5.4-2", "5.4-3", "T10-8"]
    shown = call("conformance", address, "--only", "5.4-3", "--verbose", "--quiet").out
    assert (shown.splitlines()[0], "5.4-3   passed" in shown) == ("5.4", True)


def test_a_failed_check_is_reported_with_both_languages_and_exit_code_1(call, address, monkeypatch):
    sound = examination.GrpcTransport.call

    def two(self, method, request):
        reply = sound(self, method, request)
        if method == "AddProperty" and reply.status == 1:
            reply.status = 2
        return reply

    monkeypatch.setattr(examination.GrpcTransport, "call", two)
    outcome = call("conformance", address, "--only", "5.3-3", "--quiet")
    assert outcome.code == 1
    assert "5.3-3   failed" in outcome.out
    assert "0—添加失败" in outcome.out
    assert "sent AddProperty speed: expected 1, found 2" in outcome.out
