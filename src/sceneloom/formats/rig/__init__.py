"""Own data: a folder of clouds and pictures that a manifest `rig.toml` describes."""
