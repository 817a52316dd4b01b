"""The page beside the standard says what the fusion interface does: properties and counters."""

import re
from pathlib import Path

import pytest

from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.setting import PREDEFINED

from .sending import boxes_2d, boxes_3d, calibration, cloud, image

DOCS = Path(__file__).parents[3] / "docs"
PAGES = {name: (DOCS / f"{name}.md").read_text("utf-8") for name in ("db34t-4101", "db34t-4101.zh")}


def rows(page):
    """Cells of all rows of tables, by their first cell without backticks."""
    found = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in page.splitlines() if line[:1] == "|"]
    return {cells[0].replace("`", "").strip(): cells for cells in found}


def test_the_english_page_says_of_properties_what_the_interface_itself_says():
    cells = rows(PAGES["db34t-4101"])
    assert [name for name, row in PREDEFINED.items() if not cells[name][3].startswith(row.description)] == []


@pytest.mark.parametrize("page", PAGES.values(), ids=PAGES)
def test_every_counter_stands_there(page):
    with FusionInterface(inline=True) as fusion:
        fusion.send(cloud(0, 0))
        assert fusion.set_calibration(calibration(), camera_id=1, lidar_id=0)
        for seq in range(3):
            for send in (image, cloud, boxes_2d, boxes_3d):
                fusion.send(send(-20_000 * seq, seq))
        fusion.close()
        names = set(fusion.counters.counts())
    documented = [
        re.compile(re.escape(name).replace("KIND", "[a-z_0-9]+").replace("CAUSE", "[a-z-]+").replace("NAME", r"\S+"))
        for row in rows(page).values()
        for name in re.findall(r"`([^`]+)`", row[0])
    ]
    assert len(names) >= 9
    assert not [name for name in names if not any(pattern.fullmatch(name) for pattern in documented)]
