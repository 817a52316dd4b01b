"""Who may call: this machine, or those with a token over TLS; and the conformance kit by the descriptor."""

import datetime as dt
import ipaddress
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import grpc
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2
from grpc_reflection.v1alpha.reflection import ReflectionServicer

from sceneloom.db34t.conformance.catalogue import CallFailedError
from sceneloom.db34t.conformance.examination import GrpcTransport, NobodyAnswersError, examine
from sceneloom.db34t.transport import SERVICE, Security, is_local, read_pair, read_token
from sceneloom.errors import DataError, OptionError
from sceneloom.service.client import FusionClient
from sceneloom.service.server import FusionServer, ServerSettings
from sceneloom.service.startup import check_port

TOKEN = "0123456789abcdefghij"


class Authority:
    """Signs certificates."""

    def __init__(self, folder, name):
        self.folder, self.name = folder, name
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.certificate = self._sign(name, self.key, authority=True)
        self.path = self._write(f"{name}.pem", self.certificate.public_bytes(serialization.Encoding.PEM))

    def _sign(self, name, key, *, authority):
        begin = dt.datetime(2020, 1, 1, tzinfo=dt.UTC)
        subject, issuer = (x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)]) for text in (name, self.name))
        names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
        build = x509.CertificateBuilder(issuer, subject, key.public_key(), x509.random_serial_number())
        build = build.not_valid_before(begin).not_valid_after(begin + dt.timedelta(days=36500))
        build = build.add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
        return build.add_extension(x509.SubjectAlternativeName(names), critical=False).sign(self.key, hashes.SHA256())

    def _write(self, name, content):
        path = self.folder / name
        path.write_bytes(content)
        return path

    def issue(self, name):
        """Files of a certificate and its key."""
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = self._sign(name, key, authority=False)
        private = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        public = certificate.public_bytes(serialization.Encoding.PEM)
        return self._write(f"{name}.crt", public), self._write(f"{name}.key", private)


def test_the_token_is_asked_for_by_reflection_and_not_by_health(serve, connect):
    call = connect(serve(security=Security(token=TOKEN)))
    answer = health_pb2_grpc.HealthStub(call.channel).Check(health_pb2.HealthCheckRequest(), timeout=30)
    assert answer.status == health_pb2.HealthCheckResponse.SERVING
    reflected = call.channel.stream_stream("/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo")
    with pytest.raises(grpc.RpcError, match="UNAUTHENTICATED"):
        list(reflected(iter([b""]), timeout=30))


def test_with_the_certificates_and_the_token_calls_are_answered_and_strangers_are_refused(serve, connect, tmp_path):
    authority, stranger = (Authority(tmp_path, name) for name in ("authority", "stranger"))
    certificate, key = authority.issue("server")
    server = serve(
        security=Security(tls_certificate=certificate, tls_key=key, tls_client_authority=authority.path, token=TOKEN)
    )

    def caller(*files):
        client = [path.read_bytes() for path in reversed(files)] or [None, None]
        credentials = grpc.ssl_channel_credentials(authority.path.read_bytes(), *client)
        return connect(server, credentials=credentials, metadata=(("authorization", f"Bearer {TOKEN}"),))

    for client in ((), stranger.issue("client of another")):
        assert caller(*client).fails("GetProperty", name="chirality")[0] == "UNAVAILABLE"
    assert caller(*authority.issue("client"))("GetProperty", name="chirality").name == "chirality"


HOSTS = ["0.0.0.0", "::", "192.0.2.1", "10.0.0.1", "example.org", "localhost.example.org", "127.0.0.1.example.org", ""]


@pytest.mark.parametrize("host", HOSTS)
def test_other_machines_are_let_in_only_over_tls_with_a_token(host, tmp_path):
    pem = tmp_path / "some.pem"
    for security, lacking in (
        (Security(), "a TLS certificate and key and a token"),
        (Security(token=TOKEN), "a TLS certificate and key"),
        (Security(tls_certificate=pem, tls_key=pem), "a token"),
    ):
        with pytest.raises(OptionError, match=f"needs {lacking};"):
            FusionServer(ServerSettings(host=host, security=security))
    Security(tls_certificate=pem, tls_key=pem, token=TOKEN).check_host(host)
    with pytest.raises(OptionError, match="expected both"):
        Security(tls_certificate=pem).check_host("localhost")
    with pytest.raises(OptionError, match="without the server's"):
        Security(tls_client_authority=pem).check_host("localhost")
    assert all(map(is_local, ("127.0.0.1", "127.9.9.9", "::1", "[::1]", "localhost")))


def test_a_token_is_read_from_a_file_that_holds_nothing_else(tmp_path):
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\n")
    assert read_token(path) == TOKEN
    for content in (b"short", b"two words in one file", b"\xff" * 32, b""):
        path.write_bytes(content)
        with pytest.raises(DataError, match="expected"):
            read_token(path)


def test_a_port_that_is_taken_and_an_address_that_is_not_of_this_machine_are_reported(serve):
    server = serve()
    taken = f"cannot listen at 127.0.0.1:{server.port}: address already in use; choose another port"
    with pytest.raises(OptionError, match=taken):
        serve(port=server.port)
    with pytest.raises(OptionError, match="already in use; choose another metrics port"):
        serve(metrics_port=server.port)
    for host, reason in (("203.0.113.9", "assign"), ("nowhere.invalid", "no such host")):
        with pytest.raises(OptionError, match=f"cannot listen at {host}:0: .*{reason}"):
            check_port(host, 0)


def test_the_file_that_is_no_certificate_or_not_its_key_is_named(serve, tmp_path):
    authority = Authority(tmp_path, "authority")
    certificate, key = authority.issue("server")
    _, another = authority.issue("another")
    none = tmp_path / "none.pem"
    none.write_text("nothing")
    for chain, private, client_authority, wrong in (
        (none, key, None, "none.pem: no certificate"),
        (certificate, none, None, "none.pem: not that key"),
        (certificate, another, None, "another.key: not that key"),
        (certificate, key, none, "none.pem: no certificate"),
    ):
        security = Security(tls_certificate=chain, tls_key=private, tls_client_authority=client_authority)
        with pytest.raises(DataError, match=wrong):
            serve(security=security)
    with pytest.raises(DataError, match=r"none.pem: no certificate"):
        FusionClient("127.0.0.1:1", ca=none)
    locked = tmp_path / "locked.key"  # which nobody is asked the password for
    private = serialization.load_pem_private_key(key.read_bytes(), None)
    encryption = serialization.BestAvailableEncryption(b"secret")
    locked.write_bytes(private.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption))
    with pytest.raises(DataError, match="expected the unencrypted key"):
        read_pair(certificate, locked)


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
