"""Bytes: of a file against a file in memory, and of protobuf messages by hand."""

import io
import os

import pytest
from google.protobuf.internal.encoder import _VarintBytes

from sceneloom.db34t.wire import fusion_pb2
from sceneloom.formats.base.files import ByteStream
from sceneloom.formats.base.protobuf import enclosed, field_head, varint, wire_fields

CONTENT = bytes(range(50))


@pytest.mark.parametrize("content", [CONTENT, memoryview(CONTENT)])
def test_bytes_are_read_and_sought_as_in_a_file(content):
    ours, theirs = io.BufferedReader(ByteStream(content), 8), io.BytesIO(CONTENT)
    for step in (
        lambda file: file.read(5),
        lambda file: file.seek(20),
        lambda file: file.read(11),
        lambda file: file.seek(-4, os.SEEK_CUR),
        lambda file: file.tell(),
        lambda file: file.seek(-3, os.SEEK_END),
        lambda file: file.read(),
        lambda file: file.seek(90),
        lambda file: file.read(1),
    ):
        assert step(ours) == step(theirs)


def test_numbers_fields_and_parts_of_messages_are_written_as_protobuf_does_and_fields_found_without_being_read():
    for number in (0, 1, 127, 128, 300, 16383, 16384, 2**31, 2**35 + 5):
        assert varint(number) == _VarintBytes(number)
    content = b"x" * 200
    assert fusion_pb2.ImageData.FromString(field_head(8, len(content)) + content).data == content
    inner = [b"\x18\x05", memoryview(field_head(8, 3)), b"abc"]
    request = fusion_pb2.SendRequest.FromString(b"".join(enclosed(2, inner)))
    assert (request.image.seq, request.image.data) == (5, b"abc")
    image = fusion_pb2.ImageData(seq=300, encoding="rgb8", data=b"abc", timestamp=fusion_pb2.Timestamp(s=5))
    content = b"??" + image.SerializeToString() + b"?"
    fields = wire_fields(content, 2, len(content) - 1)
    assert [field.number for field in fields] == [2, 3, 6, 8]
    assert content[fields[3].start : fields[3].stop] == b"abc"
    assert content[fields[1].head : fields[1].stop] == b"\x18\xac\x02"
    # what is unusual or very long is left to protobuf
    odd = b"\x0b", b"\x0a\x05ab", b"\x08", b"\x08\xff", b"\x0d123", b"\x08" + b"\xff" * 11, b"\x08\x01" * 1001
    assert [wire_fields(content, 0, len(content)) for content in odd] == [None] * 7
