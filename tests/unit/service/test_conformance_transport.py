"""The kit reaches a server by the descriptor alone, over TLS where the server wants it."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import grpc
import pytest
from grpc_reflection.v1alpha import reflection_pb2
from grpc_reflection.v1alpha.reflection import ReflectionServicer

from sceneloom.db34t.conformance.catalogue import CallFailedError
from sceneloom.db34t.conformance.examination import GrpcTransport, NobodyAnswersError, examine
from sceneloom.db34t.transport import SERVICE, Security

from .test_security import Authority

TOKEN = "a-token-without-blanks"


def test_a_server_with_tls_client_certificates_and_a_token_is_checked_like_any(serve, tmp_path):
    authority = Authority(tmp_path, "authority")
    certificate, key = authority.issue("server")
    server = serve(
        security=Security(tls_certificate=certificate, tls_key=key, tls_client_authority=authority.path, token=TOKEN)
    )
    token = tmp_path / "token"
    token.write_text(TOKEN + "\n")
    address, access = f"localhost:{server.port}", {"ca": authority.path, "certificate": authority.issue("kit")}
    with GrpcTransport.connected(address, token_file=token, **access) as transport:
        assert examine(transport, only=["5.3", "X-6", "X-7"]).failed_ids == ()
    with pytest.raises(NobodyAnswersError, match=r"UNAUTHENTICATED.*--token-file"):
        GrpcTransport.connected(address, **access)


SURROUNDINGS = ["X-21", "X-22", "X-23"]


@contextmanager
def connected(*handlers):
    """A transport to a server with nothing but some handlers."""
    server = grpc.server(ThreadPoolExecutor(1))
    server.add_generic_rpc_handlers(handlers)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        with GrpcTransport.connected(f"127.0.0.1:{port}") as transport:
            yield transport
    finally:
        server.stop(None).wait()


def test_a_server_without_health_and_reflection_fails_these_checks_and_says_so():
    with connected() as transport:
        examination = examine(transport, only=SURROUNDINGS)
    assert list(examination.failed_ids) == SURROUNDINGS
    assert all("UNIMPLEMENTED" in finding.seen[-1].found for finding in examination.findings)


def test_a_server_with_the_newer_reflection_alone_is_asked_by_that():
    names = (SERVICE.full_name,)
    method = grpc.stream_stream_rpc_method_handler(
        ReflectionServicer(names).ServerReflectionInfo,
        reflection_pb2.ServerReflectionRequest.FromString,
        reflection_pb2.ServerReflectionResponse.SerializeToString,
    )
    handlers = {"ServerReflectionInfo": method}
    with connected(grpc.method_handlers_generic_handler("grpc.reflection.v1.ServerReflection", handlers)) as transport:
        assert transport.services() == set(names)
        assert examine(transport, only=SURROUNDINGS).failed_ids == ("X-21",)
        with pytest.raises(CallFailedError, match="code 5"):  # NOT_FOUND
            transport.files_with("nothing.of.the.kind")
