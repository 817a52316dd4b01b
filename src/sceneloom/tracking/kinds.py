"""Classes as numbers: which words of detectors may be one object, and which of them move as vehicles do."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.detections.classes import KINDS, SAYS_NOTHING, kind_name

_FAMILIES = {family: k for k, family in enumerate(dict.fromkeys(kind.family for kind in KINDS.values()))}
_VEHICLES = _FAMILIES[KINDS["car"].family]
ANY = -1
_numbers: dict[str, int] = {}


@lru_cache(maxsize=4096)
def _code(label: str) -> tuple[int, int]:
    name = kind_name(label)
    if name in SAYS_NOTHING:
        return ANY, ANY
    kind = KINDS.get(name)
    return _numbers.setdefault(name, len(_numbers)), ANY if kind is None else _FAMILIES[kind.family]


def codes_of(labels: Sequence[str]) -> Int64Array:
    """Give classes as (N, 2) int64: a number of the class and one of its family, -1 for none."""
    return np.array([_code(label) for label in labels], np.int64).reshape(-1, 2)


def is_vehicle(codes: Int64Array) -> BoolArray:
    """Which classes move along their heading as cars do, (N,) bool of (N, 2) codes."""
    vehicles: BoolArray = codes[:, 1] == _VEHICLES
    return vehicles
