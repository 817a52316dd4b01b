"""What scenes are drawn from."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
IDS = st.integers(-(2**53), 2**53) | NAMES
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | NAMES,
    lambda children: st.lists(children, max_size=3) | st.dictionaries(NAMES, children, max_size=2),
    max_leaves=6,
)


def optional(strategy):
    return st.none() | strategy


def floats(*shape, within=1e9, width=64):
    dtype = np.float64 if width == 64 else np.float32
    return hnp.arrays(dtype, shape, elements=st.floats(-within, within, width=width))


def quaternions(count):
    """Unit quaternions, far from all half rotations."""
    raw = hnp.arrays(np.float64, (count, 4), elements=st.floats(0.1, 1.0))
    return raw.map(lambda found: found / np.linalg.norm(found, axis=1, keepdims=True))


def timestamps(low, high, *, count=None, least=1, most=12, unique=True):
    """Ascending times of int64, of a count or of any from `least` to `most`."""
    sizes = {"min_size": least if count is None else count, "max_size": most if count is None else count}
    times = st.lists(st.integers(low, high), unique=unique, **sizes)
    return times.map(lambda found: np.array(sorted(found), np.int64))
