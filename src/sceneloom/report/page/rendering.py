"""From numbers and images to one page of HTML that holds everything."""

from base64 import b64encode
from collections.abc import Iterator
from functools import partial
from importlib.resources import files
from importlib.util import find_spec
from typing import Any

from sceneloom.errors import MissingExtraError, how_to_install
from sceneloom.report.figures import Figures, Photo
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.numbers.verdict import Advice
from sceneloom.report.page.content import Drawing, Section
from sceneloom.report.page.sections.annotations import annotations_section
from sceneloom.report.page.sections.calibration import calibration_section
from sceneloom.report.page.sections.coverage import coverage_section
from sceneloom.report.page.sections.drive import drive_section
from sceneloom.report.page.sections.findings import findings_section
from sceneloom.report.page.sections.fusion import fusion_section
from sceneloom.report.page.sections.source import source_section
from sceneloom.report.page.sections.timing import timing_section
from sceneloom.report.page.sections.trajectory import trajectory_section
from sceneloom.report.page.sections.truth import truth_section
from sceneloom.report.page.sections.warnings import warnings_section
from sceneloom.report.plots import plain
from sceneloom.scene.findings import Severity

MOST_ADVICES = 8
"""Reported at the top of the page; the others are folded."""
MARKS = {"sound": "✔", "look": "▲", "faulty": "✖"}


def check_extra() -> Any:
    """Give the package that fills the template; matplotlib, which draws, is looked for, too.

    Raises:
        MissingExtraError: one of them is not installed.
    """
    try:
        import jinja2
    except ImportError:
        raise MissingExtraError(f"a report needs jinja2: {how_to_install('report')}") from None
    if find_spec("matplotlib") is None:
        raise MissingExtraError(f"a report needs matplotlib: {how_to_install('report')}")
    return jinja2


def render_page(report: DriveReport, figures: Figures) -> str:
    """Put a report into its page.

    Raises:
        MissingExtraError: what fills the template is not installed.
    """
    jinja2 = check_extra()
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=partial(_plain, whole=_source_path(report), name=report.name),
        loader=jinja2.FunctionLoader(_resource),
    )
    environment.filters["data_uri"] = _data_uri
    shown, further = _advices(report)
    page: str = environment.get_template("report.html.j2").render(
        report=report,
        style=_resource("style.css"),
        sections=list(sections_of(report, figures)),
        marks=MARKS,
        advices=shown,
        more_advices=further,
    )
    return page


def sections_of(report: DriveReport, figures: Figures) -> Iterator[Section]:
    """The sections of a page in their order."""
    yield drive_section(report)
    yield timing_section(report)
    yield trajectory_section(report)
    yield calibration_section(report, figures)
    yield coverage_section(report)
    yield fusion_section(report, figures)
    yield annotations_section(report, figures)
    truth = truth_section(report)
    if truth is not None:
        yield truth
    yield findings_section(report)
    yield warnings_section(report)
    yield source_section(report)


def _advices(report: DriveReport) -> tuple[list[Advice], list[Advice]]:
    """Those reported first, and the others; hints are reported first only where there are few."""
    advices = list(report.verdict.advices)
    urgent = [advice for advice in advices if advice.severity is not Severity.HINT]
    first = (urgent or advices)[:MOST_ADVICES] if len(advices) > MOST_ADVICES else advices
    return first, [advice for advice in advices if advice not in first]


def _resource(name: str) -> str:
    return files("sceneloom.report.page").joinpath(name).read_text("utf-8")


def _source_path(report: DriveReport) -> str:
    """The path of the drive where it says more than its name; empty otherwise."""
    source = report.summary.source
    return source if "/" in source or "\\" in source else ""


def _plain(value: Any, *, whole: str, name: str) -> Any:
    """Take characters out of a text that no page may hold, and where on its machine the drive lies.

    Markup of our own stays as it is.
    """
    if not isinstance(value, str) or hasattr(value, "__html__"):
        return value
    if whole:
        value = value.replace(f"{whole}/", "").replace(whole, name)
    return plain(value)


def _data_uri(shown: Photo | Drawing) -> str:
    kind, content = ("jpeg", shown.jpeg) if isinstance(shown, Photo) else ("svg+xml", shown.svg)
    return f"data:image/{kind};base64,{b64encode(content).decode('ascii')}"
