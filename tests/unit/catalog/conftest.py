"""Drives whose every number is known, as scene files, and a catalogue of them."""

from dataclasses import replace

import numpy as np
import pymap3d
import pytest

import sceneloom
from sceneloom.catalog import build
from sceneloom.scene import AttributePath, CuboidAnnotation, CuboidPath, GnssSensor, OdometrySensor, Poses, Scene

ORIGIN = (48.0, 11.0, 500.0)


def times_ns(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.int64) * 100_000_000


def box(identifier, label, timestamps_s, centers, *, attributes=()) -> CuboidAnnotation:
    values = np.column_stack([np.tile([4.0, 2.0, 1.5], (len(centers), 1)), centers, np.zeros((len(centers), 3))])
    timestamps = np.round(np.asarray(timestamps_s) * 1e9).astype(np.int64)
    return CuboidAnnotation(identifier, CuboidPath(timestamps, values), label, attributes=attributes)


def street(*, seconds: int = 10, origin=ORIGIN, annotations=None) -> Scene:
    """An ego that goes east by 5 m/s, and from half-time on by 15 m/s, with fixes at 10 Hz.

    A car stands 50 m east and 10 m north, a walker is there from 2 s to 3 s and goes north by 2 m/s from (20, 5); it
    rains from 4 s on.
    """
    times = times_ns(seconds * 10)
    t, half = times / 1e9, seconds / 2
    east = np.where(t < half, 5.0 * t, 5.0 * half + 15.0 * (t - half))
    points = np.stack([east, np.zeros_like(t), np.zeros_like(t)], axis=-1)
    lla = np.stack(pymap3d.enu2geodetic(east, 0.0 * t, 0.0 * t, *origin), axis=-1)
    unknown = np.full(len(times), np.nan)
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    rain = AttributePath("weather", ("dry", "Rain"), np.array([0, 4_000_000_000]))
    if annotations is None:
        colour = AttributePath("colour", ("red",), static=True)
        annotations = (
            box("car 1", "Car", [0.0, seconds - 0.1], [[50, 10, 0]] * 2, attributes=(colour,)),
            box(7, "pedestrian.adult", [2.0, 3.0], [[20, 5, 0], [20, 7, 0]]),
        )
    sensors = GnssSensor("gnss", times, lla, unknown, unknown), OdometrySensor("ego", Poses(times, points, rotations))
    return Scene(sensors, annotations=tuple(annotations), attributes=(rain,))


@pytest.fixture(scope="session")
def drives(tmp_path_factory):
    """Three drives: the street in one town, in another, and one in which nothing is annotated."""
    folder = tmp_path_factory.mktemp("drives")
    other = street(origin=(-33.9, 179.9999, 20.0))
    sceneloom.write(street(), folder / "north.sfs")
    sceneloom.write(replace(other, attributes=()), folder / "o'south [x].sfs")
    shared = AttributePath("odd", ("a", "b"), np.array([0, 1, 2], np.int64))  # a timestamp more than values
    short = street(seconds=2, annotations=())
    sceneloom.write(replace(short, attributes=(shared,)), folder / "short.sfs")
    return sorted(folder.iterdir())


@pytest.fixture(scope="session")
def catalogue(drives, tmp_path_factory):
    """The catalogue of the drives, in a folder whose name means much to shells, SQL and patterns."""
    folder = tmp_path_factory.mktemp("catalogues") / "o'c [a] *"
    report = build(drives, folder)
    assert (report.scenes, report.failed) == (3, ())
    return folder
