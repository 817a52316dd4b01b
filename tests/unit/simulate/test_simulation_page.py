import re
from pathlib import Path

PAGE = Path(__file__).parents[3] / "docs" / "simulation.md"


def test_what_the_page_says_can_be_typed_in_from_its_top_to_its_end():
    typed = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        exec(block, typed)
    assert set(typed["wrong"].true_frames) == {"lidar", "camera0", "imu"}
    assert [len(typed[name]) for name in ("sweeps", "images")] == [3, 2]
