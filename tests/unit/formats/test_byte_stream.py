"""Bytes as a file, against a file in memory."""

import io
import os

import pytest

from sceneloom.formats.base.files import ByteStream

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
