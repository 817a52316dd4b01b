"""Pages of the examples: programs, and notebooks with what their cells gave."""

import ast
import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path

from links import PROJECT


def example_page(path: Path) -> str | None:
    """The page of an example; None of files that are none."""
    if path.suffix == ".py" and path.parent == PROJECT / "examples":
        source = path.read_text("utf-8")
        title = path.stem.split("_", 1)[1].replace("_", " ").capitalize()
        text = ast.get_docstring(ast.parse(source)) or ""
        return f'# {title}\n\n{text}\n\n```python title="examples/{path.name}"\n{source}```\n'
    if path.suffix == ".ipynb":
        return "\n\n".join(_cells(path)) + "\n"
    return path.read_text("utf-8") if path.suffix == ".md" else None


def _cells(path: Path) -> Iterator[str]:
    """The cells of a notebook and what they gave, as Markdown."""
    for number, cell in enumerate(json.loads(path.read_text("utf-8"))["cells"]):
        text = "".join(cell["source"])
        yield text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```"
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                yield f"![What the cell above shows]({path.stem}-{number}.png)"
            elif "text/html" in data:
                yield "".join(data["text/html"])
            else:
                shown = "".join(output.get("text", data.get("text/plain", ())))
                yield f"```text\n{shown.rstrip()}\n```"


def notebook_images() -> Iterator[tuple[str, bytes]]:
    """The images among the outputs of notebooks, with their locations on the site."""
    for path in sorted((PROJECT / "examples").rglob("*.ipynb")):
        folder = path.parent.relative_to(PROJECT).as_posix()
        for number, cell in enumerate(json.loads(path.read_text("utf-8"))["cells"]):
            for output in cell.get("outputs", ()):
                if "image/png" in output.get("data", {}):
                    image = base64.b64decode("".join(output["data"]["image/png"]))
                    yield f"{folder}/{path.stem}-{number}.png", image


def listed_examples(pages: dict[str, str]) -> str:
    """The page that lists the examples, out of the pages by their locations."""
    rows = []
    for location, text in sorted(pages.items()):
        if location.startswith("examples/") and location.count("/") <= 2:
            title, _, rest = text.partition("\n")
            name = title.removeprefix("# ").strip()
            first = _first_sentence(rest)
            rows.append(f"| [{name}]({location.removeprefix('examples/')}) | {first} |")
    table = "\n".join(["| example | content |", "| --- | --- |", *rows])
    return f"# Examples\n\nEach runs as it stands, on simulated data, and is run by the tests.\n\n{table}\n"


def _first_sentence(text: str) -> str:
    """The first sentence of a page's text; none where it begins with code."""
    paragraph = " ".join(text.strip().split("\n\n")[0].split())
    return "" if paragraph.startswith("```") else re.split(r"(?<=[.:]) ", paragraph)[0].rstrip(":")
