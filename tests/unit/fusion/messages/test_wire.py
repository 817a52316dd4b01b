"""The committed protobuf code is what the `.proto` says."""

from pathlib import Path

from grpc_tools import protoc

from sceneloom.db34t.wire import fusion_pb2

PROTO_FOLDER = Path(__file__).parents[4] / "proto"
PROTO = "sceneloom/db34t4101/v1/fusion.proto"


def without_versions(code):
    """Generated code less what changes with the compiler alone."""
    return [line for line in code.splitlines() if line.startswith(("DESCRIPTOR", "  _globals"))]


def test_the_committed_code_is_made_from_the_proto_as_it_is(tmp_path):
    arguments = ["protoc", f"-I{PROTO_FOLDER}", f"--python_out={tmp_path}", PROTO]
    assert protoc.main(arguments) == 0
    compiled = (tmp_path / PROTO.replace(".proto", "_pb2.py")).read_text("utf-8")
    committed = Path(fusion_pb2.__file__).read_text("utf-8")
    assert without_versions(committed) == without_versions(compiled)
    assert len(without_versions(committed)) > 30
