"""The kit reaches a server by the descriptor alone, over TLS where the server wants it."""

import pytest

from sceneloom.errors import OptionError
from sceneloom.service.conformance.examination import examine
from sceneloom.service.conformance.transport import CallFailedError, Doors, GrpcTransport
from sceneloom.service.security import Security

from .test_security import Authority

TOKEN = "a-token-without-blanks"


def test_a_server_with_tls_client_certificates_and_a_token_is_checked_like_any(serve, tmp_path):
    authority = Authority(tmp_path, "authority")
    certificate, key = authority.issue("server")
    server = serve(
        security=Security(
            tls_certificate=certificate, tls_key=key, tls_client_authority=authority.path, token=TOKEN
        )
    )
    token = tmp_path / "token"
    token.write_text(TOKEN + "\n")
    doors = Doors(authority.path, token, *authority.issue("kit"))
    with GrpcTransport.connected(f"localhost:{server.port}", doors) as transport:
        assert examine(transport, only=["5.3", "X-6", "X-7"]).failed_ids == ()
    without = Doors(authority.path, None, *authority.issue("kit"))
    with GrpcTransport.connected(f"localhost:{server.port}", without) as transport:
        found = examine(transport, only=["5.3-1"]).findings[0].failures
    assert "UNAUTHENTICATED" in found[0].found


def test_a_token_is_not_sent_over_an_open_connection_to_another_machine(tmp_path):
    token = tmp_path / "token"
    token.write_text(TOKEN)
    for address in ("192.0.2.7:1", "fusion.example:1", "[2001:db8::1]:1"):
        with pytest.raises(OptionError, match="not encrypted"):
            Doors(token_file=token).channel(address)
    for address in ("127.0.0.1:1", "localhost:1", "[::1]:1"):
        Doors(token_file=token).channel(address).close()


def test_a_call_that_ends_with_an_error_is_told_with_its_code(serve):
    from sceneloom.fusion.messages.wire import fusion_pb2

    with GrpcTransport.connected(serve().address, Doors()) as transport:
        with pytest.raises(CallFailedError) as failed:
            transport.call("GetProperty", fusion_pb2.GetPropertyRequest(name="nothing"))
        assert failed.value.code == "NOT_FOUND"
        with pytest.raises(CallFailedError, match="INVALID_ARGUMENT"):
            list(transport.subscribe(fusion_pb2.SubscribeRequest(fusion_type=3, most=1)))
