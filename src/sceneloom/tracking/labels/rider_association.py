"""Who rides what: people that stay with a bicycle or a motorcycle."""

from collections.abc import Iterable, Iterator

import numpy as np

from sceneloom.detections.classes import kind_name
from sceneloom.scene.tracks import Track

_RIDDEN = frozenset(
    {"bicycle", "bike", "motorcycle", "motorbike", "scooter", "moped", "cyclist", "motorcyclist"}
)
_NEAR = 0.8
"""A rider's middle is no farther than this from that of what he rides, seen from above [m]."""
_LEAST_STATES = 3
_SHARE = 0.7
"""Of the time that both are there, so much they are together."""


def _plain(label: str) -> str:
    return "".join(letter for letter in label.casefold() if letter.isalnum())


def _is_person(label: str) -> bool:
    return _plain(label) == "rider" or (kind_name(label) == "pedestrian" and _plain(label) not in _RIDDEN)


def riders(tracks: Iterable[Track]) -> Iterator[tuple[Track, Track]]:
    """Give each rider with what he rides; each of both once, the nearest pairs first.

    Words for a rider and what he rides together, such as "cyclist", count as what is ridden: a detector that says so
    has one box for both, and a person beside it is somebody who is there, too.
    """
    kept = list(tracks)
    people = [track for track in kept if _is_person(track.label)]
    ridden = [track for track in kept if _plain(track.label) in _RIDDEN]
    pairs = [
        (distance, person, bike)
        for person in people
        for bike in ridden
        if (distance := _together(person, bike)) is not None
    ]
    taken: set[int] = set()
    for _, person, bike in sorted(pairs, key=lambda pair: (pair[0], pair[1].id, pair[2].id)):
        if not {person.id, bike.id} & taken:
            taken |= {person.id, bike.id}
            yield person, bike


def _together(person: Track, bike: Track) -> float | None:
    """How near two usually are [m]; None if they are not together."""
    _, mine, its = np.intersect1d(person.timestamps_ns, bike.timestamps_ns, return_indices=True)
    if len(mine) < _LEAST_STATES:
        return None
    apart = np.linalg.norm(person.centers[mine, :2] - bike.centers[its, :2], axis=1)
    return float(np.median(apart)) if float((apart < _NEAR).mean()) >= _SHARE else None
