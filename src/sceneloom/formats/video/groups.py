"""Which groups of pictures of a video can be copied while others are encoded anew, and why not, where none can."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.formats.video.h264 import (
    ParameterSets,
    identifier_of,
    is_parameter_set,
    starts_anew,
    units_of,
)
from sceneloom.formats.video.index import VideoIndex
from sceneloom.formats.video.packet_copy import iter_picture_packets
from sceneloom.formats.video.reader import VideoReader
from sceneloom.formats.video.source import OpenVideo, VideoSource

_PIXELS = frozenset({"yuv420p", "yuvj420p"})
"""FFmpeg's names of the pixels that our encoder makes, too."""

_MOST_SETS = 32


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """The groups of pictures of a video, in the order of storage.

    Attributes:
        sets: the video's parameter sets.
        free_id: a number that none of them has.
        of_packets: (N,) int64, the group of each packet, from 0.
        of_pictures: (N,) int64, the group of each picture, in the order of showing.
    """

    sets: ParameterSets
    free_id: int
    of_packets: Int64Array
    of_pictures: Int64Array

    def touched(self, pictures: BoolArray) -> BoolArray:
        """Say which groups hold any of some pictures, (N,) bool."""
        touched = np.zeros(int(self.of_packets.max(initial=-1)) + 1, np.bool_)
        touched[self.of_pictures[pictures]] = True
        return touched


def separate_groups(reader: VideoReader, source: VideoSource) -> Groups | str:
    """Find the groups of pictures that stand for themselves; a text that says why where they do not.

    Raises:
        DataError: the video is damaged.
    """
    index = reader.index
    numbers = _group_numbers(index)
    obstacles = (
        (reader.codec != "h264", f"{reader.codec} is not encoded group by group"),
        (not index.timed or index.hidden > 0, "the video does not say when each of its pictures is shown"),
        (reader.width % 2 + reader.height % 2 > 0, "its pictures are of an odd size"),
        (numbers is None, "its groups of pictures lean on one another"),
    )
    reason = next((reason for stands, reason in obstacles if stands), None)
    if reason is not None or numbers is None:
        return reason or ""
    opened = OpenVideo(source, reader.name)
    try:
        decoder = opened.stream.codec_context
        sets = ParameterSets.of_record(bytes(decoder.extradata or b""))
        if sets is None or decoder.pix_fmt not in _PIXELS:
            return f"its pixels ({decoder.pix_fmt}) or its container are of another kind than our encoder's"
        obstacle = _obstacle(opened, reader.name, sets, numbers)
    finally:
        opened.close()
    taken = {identifier_of(unit) for unit in (*sets.sequence, *sets.picture)}
    free = next((number for number in range(1, _MOST_SETS) if number not in taken), None)
    if obstacle is not None or free is None:
        return obstacle or "it has too many parameter sets"
    return Groups(sets, free, numbers, numbers[index.positions])


def _group_numbers(index: VideoIndex) -> Int64Array | None:
    """The group of each packet, (N,); None where a picture is stored after the key picture of another group."""
    keys = np.empty(len(index), np.int64)
    keys[index.positions] = index.positions[index.entries]
    if len(keys) == 0 or (np.diff(keys) < 0).any():
        return None
    return np.asarray(np.searchsorted(np.unique(keys), keys), np.int64)


def _obstacle(opened: OpenVideo, name: str, sets: ParameterSets, numbers: Int64Array) -> str | None:
    """What in the packets keeps groups from being exchanged."""
    known = {*sets.sequence, *sets.picture}
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    for position, packet in enumerate(iter_picture_packets(opened, name)):
        units = units_of(bytes(packet), sets.length_size)
        if units is None:
            return "its packets are of another kind than its container says"
        if any(is_parameter_set(unit) and unit not in known for unit in units):
            return "its parameters change on the way"
        if position in starts and not starts_anew(units):
            return "its groups of pictures lean on one another"
    return None
