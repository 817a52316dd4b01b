"""Writing a report, and its page as a browser, a screen reader and a stranger's file see it."""

import hashlib
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from importlib.resources import files
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from sceneloom.errors import DataError, MissingExtraError, OptionError, OutputError
from sceneloom.formats.base.losses import Loss, LossReport, Support
from sceneloom.report import ReportSettings, drive_report, write_report
from sceneloom.report.content import COLOURS
from sceneloom.report.page import collect, read_losses, render_page
from sceneloom.scene import (
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    DataWarning,
    GnssSensor,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    Scene,
    WarningKind,
)

VOID = {"meta", "link", "img", "br", "rect", "circle", "line", "path", "input", "hr"}
LOADING = {"src", "href", "srcset", "data", "action", "poster", "background", "xlink:href"}


class Page(HTMLParser):
    """Collects what the tests ask about, and checks that elements close in the order in which they open."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.crossed: list[str] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag in VOID:
            return
        if not self.open or self.open[-1] != tag:
            self.crossed.append(tag)
        else:
            self.open.pop()

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.texts.append(data)

    def all(self, *tags):
        return [attributes for tag, attributes in self.elements if tag in tags]

    @property
    def text(self):
        return " ".join(self.texts)


def page_of(scene, **settings):
    found = collect(scene, ReportSettings(quick=True, **settings))
    text = render_page(found.report, found.figures)
    return text, Page(text)


def check_sound(page):
    """What holds for every page, whatever is on it."""
    assert not page.crossed
    assert not page.open
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    for _, attributes in page.elements:
        for name in ("aria-labelledby", "aria-describedby"):
            assert set(attributes.get(name, "").split()) <= set(ids)
    assert all(image.get("alt") for image in page.all("img"))
    assert all(head.get("scope") in {"col", "row"} for head in page.all("th"))
    assert len(page.all("caption")) == len(page.all("table"))
    assert page.all("html")[0]["lang"] == "en"
    assert not page.all("script", "iframe", "object", "embed", "form", "base")


def check_sealed(text, page):
    """Nothing on the page leads or loads from outside."""
    for tag, attributes in page.elements:
        for name, value in attributes.items():
            assert not name.startswith("on"), (tag, name)
            if name in LOADING:
                assert value.startswith(("#", "data:")), (tag, name, value[:80])
    targets = {attributes["href"][1:] for attributes in page.all("a")}
    assert targets <= {attributes.get("id") for _, attributes in page.elements}
    (style,) = re.findall(r"<style>(.*?)</style>", text, re.DOTALL)
    assert "url(" not in style
    assert "@import" not in style
    assert "default-src 'none'" in text


def test_the_page_of_a_drive_is_sound_sealed_and_small_with_a_verdict_first_and_every_section(page):
    parsed = Page(page)
    check_sound(parsed)
    check_sealed(page, parsed)
    assert len(page.encode()) < 1_500_000
    assert len(parsed.all("img")) >= 4
    names = re.findall(r'<h2 id="([a-z]+)-h">', page)
    assert names == [
        "verdict", "drive", "timing", "trajectory", "calibration", "coverage", "fusion", "annotations", "findings",
        "warnings", "source",
    ]  # fmt: skip


def test_counts_of_the_drive_are_those_that_were_put_into_it_and_go_to_json_and_back(short, collected):
    report = collected.report
    assert {c.label: c.objects for c in report.labels.classes} == {"car": 1, "bin": 1}
    (cloud,) = report.coverage.clouds
    assert (cloud.points_least, cloud.points_most, cloud.sweeps) == (1560, 1560, 4)
    assert report.fusion.points == 4 * 1560
    assert report.summary.duration == pytest.approx(0.3)
    assert report.trajectories.trajectories[0].metres == pytest.approx(1.5)
    # the camera sits where the lidar does and looks ahead: x right is -y, y down is -z, z forward is x
    x, y, z = short.lidars[0].frames[0].points.positions.astype(np.float64).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = 60.0 * -y / x + 59.5, 60.0 * -z / x + 39.5
    inside = (x > 0) & (u >= -0.5) & (u < 119.5) & (v >= -0.5) & (v < 79.5)
    (camera,) = report.fusion.cameras
    assert (camera.paired, camera.in_image_percent) == (4, pytest.approx(100.0 * inside.mean(), abs=0.2))
    reported = msgspec.json.decode(msgspec.json.encode(report))
    assert reported["timing"]["streams"][0]["sensor"] == "lidar"
    assert reported["provenance"]["made"] == "2024-05-06 07:08:09 UTC"
    assert reported["verdict"]["state"] in {"sound", "look"}


EVIL = "<script>alert(1)</script>"
QUOTED = "\" onload=\"alert(2)' onerror='x"
ROTATED = "a\u202eb\x00\x1b[31m\ud800"


def evil_scene():
    points = LidarPoints(np.ones((4, 3), np.float32))
    frames = LazyFrames.of([LidarFrame(t, points) for t in (0, 10**8)], [0, 10**8])
    row = np.array([[1.0, 1, 1, 1, 1, 1, 0, 0, 0]])
    attribute = AttributePath(EVIL, (EVIL,), np.array([0]))
    boxes = [
        CuboidAnnotation(k, CuboidPath(np.array([0]), row), label=label, stationary=True, attributes=(attribute,))
        for k, label in enumerate((EVIL, QUOTED, ROTATED, "]]></svg>", "{{ 7 * 7 }}", "&lt;b&gt;"))
    ]
    warnings = tuple(
        DataWarning(kind=WarningKind.ASSUMED, code="x", location=location, message=f"`{EVIL}`")
        for location in (EVIL, QUOTED, ROTATED, "p", "q")
    )
    sensors = [LidarSensor(name, frames, points_frame="world") for name in (EVIL, QUOTED, ROTATED, "</style></title>")]
    return Scene(
        tuple(sensors),
        annotations=tuple(boxes),
        metadata={EVIL: EVIL, "sceneloom": {"euler_unit": "degrees", "euler_order": "xyz", QUOTED: ROTATED}},
        source=f"/drives/{EVIL}",
        format=EVIL,
        warnings=warnings,
    )


def test_what_a_file_says_stands_on_the_page_as_text():
    text, page = page_of(evil_scene(), title=f"{EVIL}{QUOTED}")
    check_sound(page)
    check_sealed(text, page)
    assert EVIL in page.text  # it is shown, not dropped
    assert "{{ 7 * 7 }}" in page.text
    assert not re.search("[\u202a-\u202e\x00\x1b]", text)
    text.encode("utf-8")


@pytest.mark.parametrize("case", ["no camera", "no lidar", "no poses and annotations", "nothing"])
def test_a_drive_without_some_of_its_parts_has_a_page(short, case):
    scene = {
        "no camera": lambda: replace(short, sensors=short.lidars),
        "no lidar": lambda: replace(short, sensors=short.cameras),
        "no poses and annotations": lambda: Scene((replace(short.lidars[0], mount=None), short.cameras[0])),
        "nothing": lambda: Scene(()),
    }[case]()
    text, page = page_of(scene)
    check_sound(page)
    check_sealed(text, page)
    assert {"nothing": "no sensors", "no poses and annotations": "Not reported:"}.get(case, "") in page.text


def fixes(times_ns, degrees):
    """A scene of fixes alone, which go north by so much from one to the next."""
    count = len(times_ns)
    lla = np.column_stack([52.5 + degrees * np.arange(count), np.full(count, 13.4), np.full(count, 40.0)])
    return Scene((GnssSensor("gnss", times_ns, lla, *np.full((2, count), np.nan)),))


def test_a_scene_of_fixes_alone_has_a_map_with_north_and_huge_counts_make_no_huge_page():
    _, page = page_of(fixes(np.arange(0, 10 * 10**9, 10**9), 1e-4))
    check_sound(page)
    assert "North is up." in page.text
    assert "52.50045° N, 13.40000° E" in page.text
    times = np.arange(60_000, dtype=np.int64) * 10_000_000
    times[30_000:] += 10**9
    warnings = tuple(
        DataWarning(kind=WarningKind.SKIPPED, code="x", location=f"line {k}", message="left out") for k in range(5000)
    )
    text, page = page_of(replace(fixes(times, 1e-7), warnings=warnings))
    check_sound(page)
    assert len(text) < 300_000
    assert "and 4,700 more" in page.text


def test_colours_of_texts_have_contrast():
    """Source of the formula: WCAG 2.2, relative luminance and contrast ratio."""

    def luminance(colour):
        digits = colour[1:] if len(colour) == 7 else "".join(2 * digit for digit in colour[1:])
        parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
        linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    def contrast(*colours):
        dark, light = sorted(map(luminance, colours))
        return (light + 0.05) / (dark + 0.05)

    style = files("sceneloom.report").joinpath("style.css").read_text("utf-8")
    blocks = {
        "light": style.split("@media", maxsplit=1)[0],
        "dark": style.split("prefers-color-scheme: dark")[1].split("* {", maxsplit=1)[0],
        "print": style.split("@media print")[1].split("body {", maxsplit=1)[0],
    }
    pairs = [
        *((text, ground) for text in ("ink", "faint", "link") for ground in ("paper", "panel")),
        *((kind, f"{kind}-panel") for kind in ("bad", "warn", "good", "hint")),
    ]
    for name, block in blocks.items():
        colours = dict(re.findall(r"--([a-z0-9-]+): (#[0-9a-f]{3,6});", block))
        for text, ground in pairs:
            assert contrast(colours[text], colours[ground]) >= 4.5, (name, text, ground)
    for colour in COLOURS:
        assert contrast(colour, "#ffffff") >= 3.0, colour


def test_page_and_numbers_are_written_beside_one_another_and_refused_before_anything_is_read(tmp_path, monkeypatch):
    page, numbers = tmp_path / "r.html", tmp_path / "r.json"
    found = write_report(Scene((), source="empty"), page, numbers=numbers)
    assert page.read_text("utf-8").startswith("<!DOCTYPE html>")
    assert msgspec.json.decode(numbers.read_bytes())["name"] == found.name == "empty"
    with pytest.raises(OptionError, match=r"ends in \.html"):
        write_report("missing", tmp_path / "r.pdf")
    with pytest.raises(OutputError, match="overwrite"):
        write_report("missing", page)
    for settings, reported in (({"images": -1}, "images -1"), ({"compare": ("sun",)}, "compare 'sun'")):
        with pytest.raises(OptionError, match=reported):
            ReportSettings(**settings)
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(MissingExtraError, match=r"sceneloom\[report\]"):
        write_report(Scene(()), page, overwrite=True)
    assert write_report(Scene(()), numbers=numbers, overwrite=True).verdict.state  # numbers need no template


def test_the_hash_is_of_a_file_of_the_names_and_contents_of_a_folder_or_of_the_ends_of_what_is_large(
    tmp_path, monkeypatch
):
    (file := tmp_path / "drive.sfs").write_bytes(b"abc" * 1000)
    assert drive_report.hash_of(file) == (hashlib.sha256(b"abc" * 1000).hexdigest(), "file", 3000)
    hashes = [drive_report.hash_of(tmp_path)[0]]
    file = file.rename(tmp_path / "c")
    hashes.append(drive_report.hash_of(tmp_path)[0])
    file.write_bytes(b"0123456789abcdef")
    hashes.append(drive_report.hash_of(tmp_path)[0])
    assert len(set(hashes)) == 3
    monkeypatch.setattr(drive_report, "MOST_HASHED", 10)
    digest, kind, size = drive_report.hash_of(file)
    assert (kind, size) == ("ends", 16)
    file.write_bytes(b"0123456789abcdeX")
    assert drive_report.hash_of(file)[0] != digest


def test_losses_are_read_as_a_conversion_reports_them(tmp_path):
    losses = (Loss(field="sensors[x]", what="rounded", count=3, support=Support.CONVERTED, largest_error=0.5),)
    file = tmp_path / "loss.json"
    for content in (b"", b"{}", b"[1]", b'{"losses": 3}', b"\xff"):
        file.write_bytes(content)
        with pytest.raises(DataError, match="loss"):
            read_losses(file)
    for reported in (losses, LossReport(losses), {"output": "x", "losses": LossReport(losses)}):
        file.write_bytes(msgspec.json.encode(reported))
        assert read_losses(file) == losses
    write_report(Scene(()), tmp_path / "r.html", settings=ReportSettings(losses=file))
    assert "sensors[x]" in (tmp_path / "r.html").read_text("utf-8")
