"""Folders of nerfstudio: images with their poses, and points. Only written."""

from sceneloom.formats.base.spec import FormatSpec
from sceneloom.formats.posed_images.spec import ONLY_WRITTEN, SUPPORTS, PosedSettings

FORMAT = FormatSpec(
    name="nerfstudio",
    title="nerfstudio",
    looks_like="a folder with transforms.json and images/",
    suffixes=(".nerfstudio",),
    writer="sceneloom.formats.nerfstudio.writer:write_nerfstudio",
    write_options=PosedSettings,
    supports=SUPPORTS,
    along_trajectory=True,
    instead=ONLY_WRITTEN.format("a folder of nerfstudio"),
)
