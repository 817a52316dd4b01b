"""Pictures in and out of videos and PNG folders: exact reading, encoding, copying without encoding."""

from sceneloom.formats.video.png_folder import PngFolder
from sceneloom.formats.video.reader import VideoReader, open_video
from sceneloom.formats.video.source import VideoSource

__all__ = ["PngFolder", "VideoReader", "VideoSource", "open_video"]
