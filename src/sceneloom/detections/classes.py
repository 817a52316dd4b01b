"""Which words of two detectors may mean the same object, and how large such objects are.

Words are compared without regard to case, blanks, dashes, dots and underscores. What is in no table is kept as it came.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only


class Kind(NamedTuple):
    """One class of objects.

    Attributes:
        family: of classes that detectors take for one another.
        words: other names of it.
        size_lwh: typical length, width and height [m].
        size_sigmas: how much they differ from one object to the next, as standard deviations [m].
    """

    family: str
    words: tuple[str, ...]
    size_lwh: tuple[float, float, float]
    size_sigmas: tuple[float, float, float]


_VEHICLES, _PEOPLE = "vehicles", "people"

KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "car": Kind(
            _VEHICLES,
            ("vehicle", "passengercar", "sedan", "suv", "taxi", "policecar", "regularvehicle", "auto"),
            (4.2, 1.8, 1.55),
            (0.5, 0.15, 0.15),
        ),
        "van": Kind(_VEHICLES, ("minivan", "pickup", "pickuptruck"), (5.0, 1.95, 2.1), (0.7, 0.15, 0.3)),
        "truck": Kind(
            _VEHICLES,
            ("lorry", "boxtruck", "truckcab", "semitruck", "largevehicle", "constructionvehicle"),
            (9.0, 2.5, 3.2),
            (3.0, 0.3, 0.5),
        ),
        "bus": Kind(_VEHICLES, ("coach", "schoolbus", "articulatedbus"), (11.0, 2.6, 3.3), (2.5, 0.2, 0.3)),
        "trailer": Kind(_VEHICLES, ("vehiculartrailer",), (10.0, 2.5, 3.5), (3.0, 0.3, 0.7)),
        "tram": Kind(_VEHICLES, ("train", "streetcar", "railedvehicle"), (16.0, 2.5, 3.5), (6.0, 0.3, 0.3)),
        "pedestrian": Kind(
            _PEOPLE,
            ("person", "people", "human", "adult", "child", "walker", "personsitting", "stroller"),
            (0.8, 0.65, 1.72),
            (0.25, 0.15, 0.15),
        ),
        "cyclist": Kind(
            _PEOPLE, ("bicyclist", "bicycle", "bike", "rider"), (1.75, 0.6, 1.7), (0.2, 0.15, 0.15)
        ),
        "motorcyclist": Kind(
            _PEOPLE, ("motorcycle", "motorbike", "scooter", "moped"), (2.1, 0.75, 1.6), (0.3, 0.15, 0.2)
        ),
    }
)
"""The classes that are known. A van is often taken for a car and a cyclist for a pedestrian, a bus for neither.

Source: sizes are the means of KITTI's labels, rounded, and common dimensions of road vehicles where it has none.
"""

SAYS_NOTHING = frozenset({"", "unknown", "object", "misc", "other", "generic", "dontcare", "unclassified"})
"""Words by which a detector says that something is there, and not what."""

_UNLISTED = Kind("", (), (2.0, 1.2, 1.6), (1.5, 0.6, 0.5))
_ANY = -1

_KIND_OF = {name: name for name in KINDS} | {
    word: name for name, kind in KINDS.items() for word in kind.words
}
_FAMILIES = {family: k for k, family in enumerate(dict.fromkeys(kind.family for kind in KINDS.values()))}
_DROPPED = str.maketrans("", "", " -_.")


@lru_cache(maxsize=4096)
def kind_name(label: str) -> str:
    """Give the name under which a word is compared: that of its class, or of an unlisted word its letters."""
    plain = label.casefold().translate(_DROPPED)
    return _KIND_OF.get(plain, plain)


def says_nothing(label: str) -> bool:
    """Whether a word leaves open what it is."""
    return kind_name(label) in SAYS_NOTHING


def codes(labels_3d: Sequence[str], labels_2d: Sequence[str]) -> tuple[Int64Array, Int64Array]:
    """Give the classes of two detectors as numbers that can be compared.

    Returns:
        Of each (N, 2) int64: a number for the class, equal for equal classes, and one for its family, -1 where the word
        is in no table or says nothing.
    """
    numbers: dict[str, int] = {}
    return _numbered(labels_3d, numbers), _numbered(labels_2d, numbers)


def _numbered(labels: Sequence[str], numbers: dict[str, int]) -> Int64Array:
    rows: dict[str, tuple[int, int]] = {}
    for label in dict.fromkeys(labels):
        name = kind_name(label)
        rows[label] = numbers.setdefault(name, len(numbers)), _family(name)
    return np.array([rows[label] for label in labels], np.int64).reshape(-1, 2)


@lru_cache(maxsize=4096)
def _family(name: str) -> int:
    return _FAMILIES[KINDS[name].family] if name in KINDS else _ANY


def typical_sizes(labels: Sequence[str]) -> tuple[Float64Array, Float64Array]:
    """Give typical lengths, widths and heights of classes and their spread, both (N, 3) float64 [m].

    Of words in no table these are wide enough to hold a person and a car.
    """
    kinds = [KINDS.get(kind_name(label), _UNLISTED) for label in labels]
    sizes = np.array([kind.size_lwh for kind in kinds]).reshape(-1, 3)
    sigmas = np.array([kind.size_sigmas for kind in kinds]).reshape(-1, 3)
    return read_only(sizes), read_only(sigmas)
