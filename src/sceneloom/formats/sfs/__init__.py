"""The Sensor Fusion Scene format: `.sfs` files, read lazily and written as a stream."""

from sceneloom.formats.sfs.form import FORMAT, SfsFormat
from sceneloom.formats.sfs.salvaging import LostPart, SalvageReport, salvage
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.formats.sfs.writing import write_scene

__all__ = ["FORMAT", "LostPart", "SalvageReport", "SceneWriter", "SfsFormat", "salvage", "write_scene"]
