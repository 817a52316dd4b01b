"""Plots: files that any reader of XML takes, whatever names and numbers are in them."""

from xml.etree import ElementTree as ET

import numpy as np

from sceneloom.report.content import bars, columns, line_plot
from sceneloom.report.page import ReportSettings, collect
from sceneloom.scene import GnssSensor, Scene, Trajectory

NAMES = ("a", "$x^2$ $", "<b>&", "车", "\x00\u202e\ud800", "n" * 300, "")


def texts(svg):
    return " ".join("".join(element.itertext()) for element in ET.fromstring(svg).iter())


def test_names_stand_in_plots_as_text_and_equal_plots_have_equal_bytes():
    reported = texts(bars(NAMES, range(len(NAMES)), labels=["1"] * len(NAMES)))
    assert all(name in reported for name in NAMES[:4])
    assert "n" * 300 not in reported
    for svg in (columns(NAMES, range(len(NAMES)), x_name="$", y_name="y"), bars(("a",), (0.0,), labels=("0",))):
        ET.fromstring(svg)
    first, again = (columns("ab", [3, 4], x_name="interval [ms]", y_name="count") for _ in range(2))
    assert first == again
    assert b"dc:date" not in first, "it states nothing of when it was made"
    assert "interval [ms]" in texts(first)
    for far in (1e9, 1e155, 1e300, np.inf, np.nan):  # locations are drawn or left out
        ET.fromstring(line_plot([[(0.0, 0.0), (1.0, far), (2.0, 3.0)]], x_name="x", y_name="y"))


def test_trajectories_that_go_far_off_have_a_map_and_fixes_alone_are_drawn_east_and_north():
    def drawn(scene):
        trajectories = collect(scene, ReportSettings(quick=True)).report.trajectories
        return texts(trajectories.draw_map()), trajectories.middle_text()

    for far in (1e9, 1e17, 1e100):
        trajectory = Trajectory("ego", np.arange(3) * 10**9, np.array([[0, 0, 0], [5.0, 1, 0], [far, -far, 0]]))
        reported, middle = drawn(Scene((), trajectories={"ego": trajectory}))
        assert ("x [m]" in reported, middle) == (True, "")
    lla = np.column_stack([52.5 + 1e-4 * np.arange(10), np.full(10, 13.4), np.full(10, 40.0)])
    reported, middle = drawn(Scene((GnssSensor("gnss", np.arange(10) * 10**9, lla, *np.full((2, 10), np.nan)),)))
    assert ("north [m]" in reported, "fixes of gnss" in reported) == (True, True)
    assert middle == "52.50045° N, 13.40000° E"
