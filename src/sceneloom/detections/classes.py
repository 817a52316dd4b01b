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

UNLISTED = len(KINDS)
"""The number of the first class that is in no table, and the row of such classes in tables."""

_OTHERWISE = Kind("", (), (2.0, 1.2, 1.6), (1.5, 0.6, 0.5))
_NONE = -1

_KIND_OF = {name: name for name in KINDS} | {
    word: name for name, kind in KINDS.items() for word in kind.words
}
_LOCATIONS = {name: k for k, name in enumerate(KINDS)}
_FAMILIES = tuple(dict.fromkeys(kind.family for kind in KINDS.values()))
_DROPPED = str.maketrans("", "", " -_.")

FAMILIES: Int64Array = read_only(
    [*(_FAMILIES.index(kind.family) for kind in KINDS.values()), _NONE], np.int64
)
"""(K + 1,), the family of each class of `KINDS`, and -1 for whatever else there is."""
SIZES: Float64Array = read_only(
    [(*kind.size_lwh, *kind.size_sigmas) for kind in (*KINDS.values(), _OTHERWISE)]
)
"""(K + 1, 6) float64 [m]: usual length, width and height of each class, and how much they differ; of words in no table
wide enough to hold a person and a car."""


@lru_cache(maxsize=4096)
def kind_name(label: str) -> str:
    """Give the name under which a word is compared: that of its class, or of an unlisted word its letters."""
    plain = label.casefold().translate(_DROPPED)
    return _KIND_OF.get(plain, plain)


@lru_cache(maxsize=4096)
def says_nothing(label: str) -> bool:
    """Whether a word leaves open what it is."""
    return kind_name(label) in SAYS_NOTHING


def numbers_of(labels_3d: Sequence[str], labels_2d: Sequence[str]) -> tuple[Int64Array, Int64Array]:
    """Give the classes of two detectors as numbers that can be compared.

    Returns:
        (N,) and (M,) int64, equal for equal classes: their location in `KINDS`, or UNLISTED and more.
    """
    others: dict[str, int] = {}
    return _numbered(labels_3d, others), _numbered(labels_2d, others)


def _numbered(labels: Sequence[str], others: dict[str, int]) -> Int64Array:
    numbers = [_location(label) for label in labels]
    if None in numbers:
        for k, number in enumerate(numbers):
            if number is None:
                numbers[k] = UNLISTED + others.setdefault(kind_name(labels[k]), len(others))
    return np.array(numbers, np.int64)


@lru_cache(maxsize=4096)
def _location(label: str) -> int | None:
    return _LOCATIONS.get(kind_name(label))


def table_rows(numbers: Int64Array) -> Int64Array:
    """Give the rows of tables with one row for each of `KINDS` and a last one for whatever else there is."""
    rows: Int64Array = np.minimum(numbers, UNLISTED)
    return rows
