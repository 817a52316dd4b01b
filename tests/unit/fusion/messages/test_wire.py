"""The committed protobuf code is what the `.proto` says."""

from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from grpc_tools import protoc

from sceneloom.fusion.messages.wire import fusion_pb2

PROTO_FOLDER = Path(__file__).parents[4] / "proto"
PROTO = "sceneloom/db34t4101/v1/fusion.proto"


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    target = tmp_path_factory.mktemp("compiled") / "fusion.binpb"
    arguments = ["protoc", f"-I{PROTO_FOLDER}", f"--descriptor_set_out={target}", PROTO]
    assert protoc.main(arguments) == 0
    return FileDescriptorSet.FromString(target.read_bytes()).file[0]


def test_the_committed_code_describes_the_proto_as_it_is(compiled):
    assert fusion_pb2.DESCRIPTOR.serialized_pb == compiled.SerializeToString()
