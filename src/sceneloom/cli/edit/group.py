"""The command `sceneloom edit` and the table of its verbs: a drive in, the same drive with one thing changed out."""

from types import MappingProxyType

import click

from sceneloom.cli.verb_group import VerbGroup

VERBS = MappingProxyType(
    {
        "deskew": "Undo the motion during each lidar sweep.",
        "crop": "Keep a part: in time, in space, of some sensors or labels.",
        "merge": "Make one scene of several of one drive.",
        "thin": "Keep fewer points, or fewer frames.",
        "to-world": "Bring points, poses and annotations into the world.",
        "to-ego": "Bring points, poses and annotations onto the ego.",
        "to-sensor": "Bring points into the frames of their sensors.",
        "count": "Count the points in each cuboid.",
        "project": "See the cuboids with the cameras.",
        "simplify": "Keep only those timestamps of paths that the others do not report.",
        "apply": "Apply localization adjustments and camera calibrations.",
        "blur": "Hide faces, plates and other locations in images for good.",
        "anonymise": "Take out where a drive was, by whom, and on request when.",
        "undistort": "Resample images so that their camera models are pinholes.",
        "camera_model": "Report the camera models by another model, as near as it comes.",
    }
)
"""Each verb stands in the module of its name, with `_` for `-`."""


@click.group(cls=VerbGroup, verbs=VERBS, room="sceneloom.cli.edit")
def edit() -> None:
    """Change one thing of a drive, and write the drive anew."""
