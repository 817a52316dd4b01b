"""A bag of ROS as a scene."""

from pathlib import Path

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.ros.log import RosLog, log_of
from sceneloom.formats.ros.opening import open_bags
from sceneloom.formats.ros.reading import NOT_READ
from sceneloom.formats.topics.scene_from_topics import scene_from_topics
from sceneloom.scene.assumed_lenses import with_assumed_models
from sceneloom.scene.notices import NoticeKind
from sceneloom.scene.scene import Scene


def open_bag(
    path: Path,
    *,
    form: str,
    lenient: bool = False,
    assume_model: bool = False,
    stamps: str | None = None,
    ego: str | None = None,
    world: str | None = None,
    distro: str | None = None,
) -> Scene:
    """Open a bag: its index and all small messages are read, pictures and points when they are asked for.

    Args:
        path: a `.bag`, a folder of ROS 2, or a file of it.
        form: name of the format.
        lenient: read what is whole of a bag that was not closed, is cut off or damaged; leave out topics and messages
            that are at fault; go by receive times where stamps are of another clock.
        assume_model: allow computing with lenses whose formulas nothing confirms.
        stamps: which time of a message counts: "header" or "receive"; None: that of its header.
        ego, world: names of the frames that are to be the ego and the world; None: chosen from the transforms.
        distro: of ROS, "humble", "noetic", …: whose types count where the bag does not define its own.

    Raises:
        DataError: the bag is damaged, or a message is wrong.
        OptionError: there is no such distribution or frame, or `stamps` is none of the two.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        bags = open_bags(path, ledger)
        try:
            log = log_of(str(path), bags, distro)
            _note_not_read(log, ledger)
        except BaseException:
            for bag in bags:
                bag.close()
            raise
        scene = scene_from_topics(log, ledger, form=form, metadata={}, stamps=stamps, ego=ego, world=world)
    return with_assumed_models(scene) if assume_model else scene


def _note_not_read(log: RosLog, ledger: Ledger) -> None:
    """Tell what is left out of messages that are read."""
    if log.notes is not None:
        return
    for topic in log.topics:
        if topic.kind is not None and topic.count and topic.schema in NOT_READ:
            message = f"{NOT_READ[topic.schema]} in messages {topic.schema} are not read"
            place = f"{log.name}: {topic.name}"
            ledger.note(NoticeKind.SKIPPED, "fields-not-read", place, message, count=topic.count)
