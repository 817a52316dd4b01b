"""Motions with known clocks for the tests of offsets and skews."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from sceneloom.geometry.rigid import multiply_quaternions, quaternion_from_rotation_vector


@dataclass(frozen=True)
class Sway:
    """A body that sways about all axes: its rates are sums of sines, its orientation is integrated in small steps."""

    amplitudes: np.ndarray
    frequencies: np.ndarray
    phases: np.ndarray

    @classmethod
    def of(cls, seed: int, *, size: float = 0.2, axes: tuple[float, float, float] = (0.3, 0.3, 1.0)) -> "Sway":
        """Draw one; `size` is that of the rates [rad/s]."""
        draw, shape = np.random.default_rng(seed), (6, 3)
        amplitudes = size * np.array(axes) * draw.standard_normal(shape)
        return cls(amplitudes, 2 * np.pi * draw.uniform(0.05, 1.2, shape), draw.uniform(0, 2 * np.pi, shape))

    def rates(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 3) [rad/s] in the body's frame."""
        return (self.amplitudes * np.sin(self.frequencies * seconds[:, None, None] + self.phases)).sum(axis=1)

    def orientations(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 4) at ascending times: products of the rotations of two thousandths of a second each."""
        edges = np.arange(seconds[0] - 0.5, seconds[-1] + 0.5, 2e-3)
        steps = quaternion_from_rotation_vector(self.rates(edges[:-1] + 1e-3) * 2e-3)
        rotations = [np.array([0.0, 0.0, 0.0, 1.0])]
        for x, y, z, w in steps.tolist():
            a, b, c, d = rotations[-1]
            axis = d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x, d * z + a * y - b * x + c * w
            rotations.append(np.array([*axis, d * w - a * x - b * y - c * z]))
        rows = np.searchsorted(edges, seconds) - 1
        rest = (seconds - edges[rows])[:, None] * self.rates(0.5 * (seconds + edges[rows]))
        return multiply_quaternions(np.array(rotations)[rows], quaternion_from_rotation_vector(rest))


@pytest.fixture
def sway() -> Callable[..., Sway]:
    return Sway.of


def timestamps(seconds: np.ndarray, offset: float = 0.0, skew_ppm: float = 0.0) -> np.ndarray:
    """Timestamps [ns] of a clock that is off by an offset at 0 and a skew; its zero is a date of today."""
    off = offset + skew_ppm * 1e-6 * seconds
    return 1_700_000_000_000_000_000 + np.rint((seconds + off) * 1e9).astype(np.int64)


@pytest.fixture(name="timestamps")
def _timestamps() -> Callable[..., np.ndarray]:
    return timestamps
