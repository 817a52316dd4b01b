"""`sceneloom conformance` against our own server, over the network of this machine."""

import json

import pytest

pytest.importorskip("grpc", reason="the extra `serve` is not installed")

from sceneloom.db34t.conformance.examination import CHECKS
from sceneloom.service.running import running_server
from sceneloom.service.server import Security, ServerSettings


@pytest.fixture(scope="module")
def address():
    with running_server() as server:
        yield server.address


def test_our_server_passes_every_check_and_the_report_says_so(call, address, tmp_path):
    outcome = call("conformance", address, "--report", tmp_path / "r.json", "--quiet")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.splitlines()[0] == f"{address}: {len(CHECKS)} checks: {len(CHECKS)} passed, 0 failed"
    report = json.loads((tmp_path / "r.json").read_text("utf-8"))
    assert (report["passed"], len(report["checks"])) == (True, len(CHECKS))


def test_some_checks_can_be_run_and_printed_for_machines(call, address):
    outcome = call("conformance", address, "--only", "5.4", "--only", "T10-8", "--json", "--quiet")
    found = json.loads(outcome.out)
    assert [check["id"] for check in found["checks"]] == ["5.4-1", "5.4-2", "5.4-3", "T10-8"]
    shown = call("conformance", address, "--only", "5.4-3", "--verbose", "--quiet").out
    assert shown.splitlines()[0] == "5.4"
    assert "5.4-3   passed" in shown


def test_checks_are_listed_without_a_server(call):
    listed = call("conformance", "--checks")
    assert listed.code == 0
    assert [line.split()[0] for line in listed.out.splitlines()] == [check.id for check in CHECKS]


def test_a_failed_check_is_reported_with_both_languages_and_exit_code_1(call, address, monkeypatch):
    from sceneloom.db34t import transport as db34t_transport

    sound = db34t_transport.GrpcTransport.call

    def two(self, method, request):
        reply = sound(self, method, request)
        if method == "AddProperty" and reply.status == 1:
            reply.status = 2
        return reply

    monkeypatch.setattr(db34t_transport.GrpcTransport, "call", two)
    outcome = call("conformance", address, "--only", "5.3-3", "--quiet")
    assert outcome.code == 1
    assert "5.3-3   failed" in outcome.out
    assert "0—添加失败" in outcome.out
    assert "sent AddProperty speed: expected 1, found 2" in outcome.out


def test_nobody_at_the_address_unknown_checks_and_reports_are_reported(call, address, tmp_path, monkeypatch):
    from sceneloom.db34t import transport as db34t_transport

    monkeypatch.setattr(db34t_transport, "PATIENCE_S", 1.0)
    nobody = call("conformance", "127.0.0.1:1", "--quiet")
    assert nobody.code == 1
    assert nobody.err.startswith("sceneloom: 127.0.0.1:1: no server answers there; is it running")
    assert call("conformance", address, "--only", "9.9").code == 2
    assert call("conformance", address, "--report", tmp_path / "r.pdf").code == 2
    assert call("conformance").code == 2


def test_a_token_is_shown_to_this_machine_and_never_to_another_without_encryption(call, tmp_path):
    token = tmp_path / "token"
    token.write_text("a-token-that-is-long-enough-for-a-server\n")
    settings = ServerSettings(security=Security(token=token.read_text().strip()))
    with running_server(settings) as server:
        arguments = ("conformance", server.address, "--only", "5.3-3", "--quiet")
        assert call(*arguments).code == 1
        assert call(*arguments, "--token-file", token).code == 0
    far = call("conformance", "192.0.2.1:1", "--token-file", token, "--quiet")
    assert far.code == 2
    assert "not encrypted" in far.err
