"""COLMAP models: images with their poses, and points. Only written."""

from sceneloom.formats.base.spec import FormatSpec
from sceneloom.formats.posed_images.spec import ONLY_WRITTEN, SUPPORTS

FORMAT = FormatSpec(
    name="colmap",
    title="COLMAP",
    looks_like="a folder with images/ and sparse/0/cameras.txt, images.txt, points3D.txt",
    suffixes=(".colmap",),
    writer="sceneloom.formats.colmap.writer:write_colmap",
    write_options=("images", "voxel", "points", "trajectory", "model"),
    supports=SUPPORTS,
    along_trajectory=True,
    instead=ONLY_WRITTEN.format("a COLMAP model"),
)
