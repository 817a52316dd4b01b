"""Own data: a folder of clouds and images that a manifest `rig.toml` describes."""
