"""Runs rules over a scene: first those that look at the whole, then one frame after the other before all that look."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.errors import SceneloomError
from sceneloom.formats.sfs.garbage import collector_paused
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import Progress

Hits = dict[str, list[Hit]]
"""What was found, by the id of the rule, in the order of the rules."""


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def find_all(
    subject: Subject, rules: Sequence[Rule], *, frames: bool = True, progress: Progress | None = None
) -> Hits:
    """Run rules over a scene; they look at whatever numbers there are, and those that overflow are not within limits.

    Args:
        subject: the scene.
        rules: which.
        frames: whether frames and images are read for the rules that look at them; each is read once.
        progress: called with the number of frames done and of all.
    """
    # the tables of a scene with many annotations are very many objects that form no cycles
    with collector_paused():
        hits: Hits = {rule.id: list(rule.find(subject)) if rule.find is not None else [] for rule in rules}
    looking = [rule for rule in rules if rule.look is not None]
    if not (frames and looking):
        return hits
    total = sum(len(_frames_of(sensor)) for sensor in subject.scene.sensors)
    for done, frame in enumerate(_frames_in_hand(subject), start=1):
        for rule in looking:
            if rule.look is not None:
                hits[rule.id].extend(rule.look(subject, frame))
        if progress is not None:
            progress(done, total)
    for rule in looking:
        if rule.conclude is not None:
            hits[rule.id].extend(rule.conclude(subject))
    return hits


def _frames_in_hand(subject: Subject) -> Iterator[FrameInHand]:
    """Read every frame and decode every image once; one that cannot be read is handed out with its fault."""
    for path, sensor in subject.sensors():
        for number in range(len(_frames_of(sensor))):
            try:
                yield FrameInHand(sensor, path, number, _read(sensor, number))
            except SceneloomError as error:
                yield FrameInHand(sensor, path, number, None, str(error))


def _frames_of(sensor: Sensor) -> Sequence[Any]:
    if isinstance(sensor, CameraSensor):
        return sensor.images
    return sensor.frames if isinstance(sensor, LidarSensor | RadarSensor | DepthCameraSensor) else ()


def _read(sensor: Sensor, number: int) -> Any:
    if isinstance(sensor, CameraSensor):
        return sensor.images[number].loaded()
    if isinstance(sensor, DepthCameraSensor):
        return sensor.frames[number].loaded()
    return _frames_of(sensor)[number]
