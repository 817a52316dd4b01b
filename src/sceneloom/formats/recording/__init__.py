"""The recording format of Spectacular AI: a folder of JSON lines, videos, a calibration and lidar binaries.

What decodes videos is imported when the format is first asked for.
"""
