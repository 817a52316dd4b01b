"""A drive as coloured clouds: one map, sweeps by themselves, labels carried between images and points."""
