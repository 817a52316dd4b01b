"""Plots: files that any reader of XML takes, whatever names and numbers are in them."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest

from sceneloom.report.content import bars, columns, line_plot
from sceneloom.report.page import ReportSettings, collect
from sceneloom.scene import GnssSensor, Scene, Trajectory

NAMES = ("a", "$x^2$ $", "<b>&", "车", "\x00\u202e\ud800", "n" * 300, "")


def texts(svg):
    return " ".join("".join(element.itertext()) for element in ET.fromstring(svg).iter())


def test_names_stand_in_plots_as_text():
    reported = texts(bars(NAMES, range(len(NAMES)), labels=["1"] * len(NAMES)))
    assert all(name in reported for name in NAMES[:4])
    assert "n" * 300 not in reported
    for svg in (columns(NAMES, range(len(NAMES)), x_name="$", y_name="y"), bars(("a",), (0.0,), labels=("0",))):
        ET.fromstring(svg)


def test_equal_plots_have_equal_bytes_and_state_nothing_of_when_they_were_made():
    first, again = (columns("ab", [3, 4], x_name="interval [ms]", y_name="count") for _ in range(2))
    assert first == again
    assert b"dc:date" not in first
    assert "interval [ms]" in texts(first)


@pytest.mark.parametrize("far", [1e9, 1e155, 1e300, np.inf, np.nan])
def test_locations_of_any_size_are_drawn_or_left_out(far):
    ET.fromstring(line_plot([[(0.0, 0.0), (1.0, far), (2.0, 3.0)]], x_name="x", y_name="y"))


@pytest.mark.parametrize("far", [1e9, 1e17, 1e100])
def test_trajectories_that_go_far_off_have_a_map(far):
    trajectory = Trajectory("ego", np.arange(3) * 10**9, np.array([[0, 0, 0], [5.0, 1, 0], [far, -far, 0]]))
    trajectories = collect(Scene((), trajectories={"ego": trajectory}), ReportSettings(quick=True)).report.trajectories
    svg = trajectories.draw_map()
    assert svg is not None
    assert "x [m]" in texts(svg)
    assert trajectories.middle_text() == ""


def test_fixes_alone_are_drawn_east_and_north():
    lla = np.column_stack([52.5 + 1e-4 * np.arange(10), np.full(10, 13.4), np.full(10, 40.0)])
    none = np.full(10, np.nan)
    scene = Scene((GnssSensor("gnss", np.arange(10) * 10**9, lla, none, none),))
    trajectories = collect(scene, ReportSettings(quick=True)).report.trajectories
    reported = texts(trajectories.draw_map())
    assert "north [m]" in reported
    assert "fixes of gnss" in reported
    assert trajectories.middle_text() == "52.50045° N, 13.40000° E"
