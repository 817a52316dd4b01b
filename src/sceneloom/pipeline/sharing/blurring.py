"""The job of hiding places in pictures: read a drive, hide boxes for good, write it, say what was done."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from sceneloom.editing.hiding import (
    HiddenRegions,
    Hiding,
    PictureBox,
    find_hidings,
    hide_in_pictures,
    regions_of,
)
from sceneloom.errors import OptionError
from sceneloom.formats.table import check_scene_output
from sceneloom.formats.video.replacing import ReplacedPictures
from sceneloom.pipeline.edited import EditReport, edit_files
from sceneloom.pipeline.sharing.hidden_pictures import with_hidden_files
from sceneloom.pipeline.sharing.hidden_videos import HiddenVideos
from sceneloom.scene import Identifier, Scene
from sceneloom.scene.types import Progress, key_of


class CameraBlur(msgspec.Struct, frozen=True, kw_only=True):
    """What was hidden in the pictures of one camera.

    Attributes:
        camera: its id.
        boxes: how many were given for it; of annotations, how many keyframes.
        hidden: how many places were hidden, with those between given boxes.
        pictures: in how many pictures.
        of_pictures: how many it has.
        without_picture: boxes that name a picture which is not there.
        outside: boxes that lie outside of their picture or have no size.
        cut: boxes that reach beyond an edge of their picture; what is inside was hidden.
        encoded: pictures of its video that were encoded anew; None where it has no video.
        copied: pictures of its video that were copied as they are.
        reason: why all pictures of a video were encoded anew, where one would have liked to copy some.
    """

    camera: Identifier
    boxes: int
    hidden: int
    pictures: int
    of_pictures: int
    without_picture: int
    outside: int
    cut: int
    encoded: int | None = None
    copied: int | None = None
    reason: str | None = None


class BlurReport(msgspec.Struct, frozen=True, kw_only=True):
    """What was done.

    Attributes:
        edit: reading, writing, notices and losses.
        fill: what took the place of what was there.
        margin: by what share of its size each box grew on each side.
        cameras: one after the other.
    """

    edit: EditReport
    fill: str
    margin: float
    cameras: tuple[CameraBlur, ...]


def blur_files(
    source: str | Path,
    output: str | Path,
    *,
    boxes: Sequence[PictureBox] = (),
    labels: Iterable[str] = (),
    fill: str = "blur",
    margin: float = 0.1,
    hold: float = 0.0,
    drop_colours: bool = False,
    reading: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
    **writing: Any,
) -> BlurReport:
    """Hide boxes in the pictures of a drive, and write it.

    Videos keep their times. In H.264, groups of pictures none of which is touched are copied; other videos with
    touched pictures are encoded anew. Of pictures in files of their own only touched ones are encoded anew; all lose
    what their files say besides the picture. Of videos only the pictures go over.

    Args:
        source: a file or folder of any format.
        output: a file or a folder, by its suffix in any format that can be written.
        boxes: what to hide, out of `formats.picture_boxes.read_picture_boxes` or from a detector.
        labels: those of the drive's own boxes and outlines in pictures that are to be hidden.
        fill, margin: see `editing.hiding.hide_in_pictures`.
        hold: what a track or an annotation is hidden longer before its first and after its last picture [s].
        drop_colours: whether points lose the colours that cameras gave them.
        reading: reading options.
        progress: told after each sweep and radar cycle that is written.
        overwrite: whether an output that exists may be replaced.
        writing: further options of the output's format.

    Raises:
        OptionError: a camera or label is not there, there is nothing to hide, or a value cannot be followed.
        OutputError: the output exists, or cannot be written.
        SceneloomError: the source is wrong.
    """
    chosen = tuple(labels)
    if not boxes and not chosen:
        raise OptionError(
            "nothing to hide; expected boxes in a CSV or JSON file (`--boxes FILE`) "
            "or labels of annotations (`--label NAME`)"
        )
    check_scene_output(Path(output), overwrite=overwrite)
    told: list[CameraBlur] = []
    with TemporaryDirectory(dir=Path(output).parent, prefix=".sceneloom-blur-") as folder:
        settings = _Settings(tuple(boxes), chosen, fill, margin, hold, drop_colours)

        def change(scenes: Sequence[Scene], _: Any) -> Scene:
            changed, done = settings.hidden(scenes[0], Path(folder))
            told.extend(done)
            return changed

        report = edit_files(
            "blur",
            [source],
            output,
            change,
            reading=reading,
            progress=progress,
            overwrite=overwrite,
            **writing,
        )
    return BlurReport(edit=report, fill=fill, margin=margin, cameras=tuple(told))


@dataclass(frozen=True, slots=True)
class _Settings:
    """What to hide, and how."""

    boxes: tuple[PictureBox, ...]
    labels: tuple[str, ...]
    fill: str
    margin: float
    hold: float
    drop_colours: bool

    def hidden(self, scene: Scene, folder: Path) -> tuple[Scene, list[CameraBlur]]:
        """Hide in a scene; its videos are written into a folder."""
        hidings = find_hidings(scene, boxes=self.boxes, labels=self.labels, hold=self.hold)
        regions = regions_of(scene, hidings, margin=self.margin)
        pixels = {key: found.pixels for key, found in regions.items()}
        bare = hide_in_pictures(
            scene, hidings, fill=self.fill, margin=self.margin, drop_colours=self.drop_colours
        )
        videos = HiddenVideos(folder, self.fill)
        changed = videos.scene(scene, with_hidden_files(scene, bare, pixels), pixels)
        counts = {key_of(camera.id): len(camera.pictures) for camera in scene.cameras}
        return changed, [
            _camera_blur(hiding, regions[key], counts[key], videos.written.get(key))
            for hiding in hidings
            for key in [key_of(hiding.camera_id)]
        ]


def _camera_blur(
    hiding: Hiding, regions: HiddenRegions, pictures: int, video: ReplacedPictures | None
) -> CameraBlur:
    return CameraBlur(
        camera=hiding.camera_id,
        boxes=hiding.given,
        hidden=sum(map(len, regions.pixels.values())),
        pictures=len(regions.pixels),
        of_pictures=pictures,
        without_picture=hiding.unmatched,
        outside=regions.outside,
        cut=regions.cut,
        encoded=None if video is None else video.encoded,
        copied=None if video is None else video.pictures - video.encoded,
        reason=None if video is None else video.reason,
    )
