"""The bytes of protobuf messages by hand."""

import pytest
from google.protobuf.internal.encoder import _VarintBytes

from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.fusion.messages.wire_bytes import enclosed, field_head, varint


@pytest.mark.parametrize("number", [0, 1, 127, 128, 300, 16383, 16384, 2**31, 2**35 + 5])
def test_numbers_are_written_as_protobuf_does(number):
    assert varint(number) == _VarintBytes(number)


def test_a_field_is_read_by_protobuf():
    content = b"x" * 200
    message = fusion_pb2.ImageData.FromString(field_head(8, len(content)) + content)
    assert message.data == content


def test_the_parts_of_a_message_become_a_field_of_another_one():
    inner = [b"\x18\x05", memoryview(field_head(8, 3)), b"abc"]
    request = fusion_pb2.SendRequest.FromString(b"".join(enclosed(2, inner)))
    assert (request.image.seq, request.image.data) == (5, b"abc")
