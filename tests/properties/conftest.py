"""How parts of the model are compared."""

import numpy as np
import pytest

from sceneloom.scene import LazyFrames


def _assert_same(read, expected):
    """Compare parts of the model field by field, arrays with their dtype."""
    if isinstance(expected, np.ndarray):
        assert read.dtype == expected.dtype
        np.testing.assert_array_equal(read, expected)
    elif isinstance(expected, LazyFrames):
        _assert_same(list(read), list(expected))
    elif hasattr(expected, "__dataclass_fields__"):
        assert type(read) is type(expected)
        for name in expected.__dataclass_fields__:
            _assert_same(getattr(read, name), getattr(expected, name))
    elif isinstance(expected, list | tuple):
        assert len(read) == len(expected)
        for a, b in zip(read, expected, strict=True):
            _assert_same(a, b)
    elif hasattr(expected, "items"):
        assert set(read) == set(expected)
        for name in expected:
            _assert_same(read[name], expected[name])
    else:
        assert (type(read), read) == (type(expected), expected)


@pytest.fixture(scope="session")
def assert_same():
    """Compares parts of the model field by field."""
    return _assert_same
