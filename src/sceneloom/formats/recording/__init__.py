"""The recording format of Spectacular AI: a folder of JSON lines, videos, a calibration and lidar binaries."""

from sceneloom.formats.recording.form import FORMAT, RecordingFormat

__all__ = ["FORMAT", "RecordingFormat"]
