"""NVIDIA NCore, version 4: sequences as component stores in indexed tar archives or folders of zarr."""
