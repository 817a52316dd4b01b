"""Segments of the Waymo Open Dataset, version 2: a parquet file for each component."""
