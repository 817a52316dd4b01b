"""Own data: a folder of clouds and pictures that a manifest `rig.toml` describes."""

from sceneloom.formats.rig.form import FORMAT, RigFormat

__all__ = ["FORMAT", "RigFormat"]
