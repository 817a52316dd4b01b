"""Pictures in and out of videos and PNG folders: exact reading, encoding, copying without encoding."""

from sceneloom.formats.video.png_folder import PngFolder
from sceneloom.formats.video.reader import VideoReader, open_video
from sceneloom.formats.video.remux import RemuxResult, copy_to_matroska, encode_to_mp4, remux_to_mp4
from sceneloom.formats.video.source import VideoSource
from sceneloom.formats.video.writer import VideoTarget, VideoWriter

__all__ = [
    "PngFolder",
    "RemuxResult",
    "VideoReader",
    "VideoSource",
    "VideoTarget",
    "VideoWriter",
    "copy_to_matroska",
    "encode_to_mp4",
    "open_video",
    "remux_to_mp4",
]
