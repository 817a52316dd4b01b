"""An MCAP file with Foxglove's schemas as a scene."""

from pathlib import Path

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.mcap.log import open_log
from sceneloom.formats.topics.scene_from_topics import scene_from_topics
from sceneloom.scene.assumed_lenses import with_assumed_models
from sceneloom.scene.scene import Scene


def open_mcap(
    path: Path | str,
    *,
    lenient: bool = False,
    assume_model: bool = False,
    stamps: str | None = None,
    ego: str | None = None,
    world: str | None = None,
) -> Scene:
    """Open a file: its index and all small messages are read, pictures and points when they are asked for.

    Args:
        path: of the file; or its URL.
        lenient: read what is whole of a file that was not finished, is cut off or damaged; leave out topics and
            messages that are at fault; go by receive times where stamps are of another clock.
        assume_model: allow computing with lenses whose formulas nothing confirms.
        stamps: which time of a message counts: "header", what it says itself, or "receive", when it was recorded;
            None: what it says itself.
        ego, world: names of the frames that are to be the ego and the world; None: chosen from the transforms.

    Raises:
        DataError: the file is damaged, or a message is wrong.
        OptionError: a frame is not there, or `stamps` is none of the two.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        log = open_log(path, ledger)
        told = {"profile": log.index.profile, "library": log.index.library}
        scene = scene_from_topics(
            log, ledger, form="mcap", metadata=told, stamps=stamps, ego=ego, world=world
        )
    return with_assumed_models(scene) if assume_model else scene
