"""A scalable picture being drawn, piece by piece; every text in it is escaped."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape

_NO_TEXT = re.compile(
    r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff\u202a-\u202e\u2066-\u2069]"
)
"""Characters that no document may hold, and those that turn the direction of what follows."""

_CAPITAL = 9.2
LETTER = 7.2
"""Width of a letter of the usual size, on the average [units]; the longest texts are cut by it."""


def plain(text: object) -> str:
    """A text without characters that no document may hold."""
    return _NO_TEXT.sub("\N{REPLACEMENT CHARACTER}", str(text))


def shortened(text: object, letters: int) -> str:
    """A text of at most so many letters."""
    whole = plain(text)
    return whole if len(whole) <= letters else f"{whole[: max(letters - 1, 1)]}…"


def text_width(text: str) -> float:
    """About how wide a text of the usual size is [units]; capitals are wider."""
    return sum(_CAPITAL if letter.isupper() else LETTER for letter in text)


def number(value: float) -> str:
    """A coordinate with a tenth of a unit, without needless digits."""
    return f"{value:.1f}".removesuffix(".0")


@dataclass(slots=True)
class Svg:
    """A picture of so many units; the page stretches it to the room that there is.

    Attributes:
        width, height: [units].
        parts: its elements.
    """

    width: float
    height: float
    parts: list[str] = field(default_factory=list)

    def line(self, x1: float, y1: float, x2: float, y2: float, look: str) -> None:
        """Draw a straight line."""
        ends = f'x1="{number(x1)}" y1="{number(y1)}" x2="{number(x2)}" y2="{number(y2)}"'
        self.parts.append(f'<line {ends} class="{look}"/>')

    def rectangle(
        self, x: float, y: float, width: float, height: float, look: str, *, title: str = "", dim: float = 1.0
    ) -> None:
        """Draw a filled rectangle; `title` is told to those who point at it."""
        place = f'x="{number(x)}" y="{number(y)}" width="{number(max(width, 0.5))}" height="{number(max(height, 0))}"'
        opacity = "" if dim == 1.0 else f' fill-opacity="{dim:.2f}"'
        self._add("rect", f'{place} class="{look}"{opacity}', title)

    def circle(self, x: float, y: float, radius: float, look: str, *, title: str = "") -> None:
        """Draw a filled disc."""
        self._add("circle", f'cx="{number(x)}" cy="{number(y)}" r="{number(radius)}" class="{look}"', title)

    def path(
        self, points: Iterable[tuple[float, float]], look: str, *, closed: bool = False, title: str = ""
    ) -> None:
        """Draw straight lines from point to point."""
        corners = [f"{number(x)} {number(y)}" for x, y in points]
        if corners:
            self._add("path", f'd="M{"L".join(corners)}{"Z" if closed else ""}" class="{look}"', title)

    def text(self, x: float, y: float, text: object, look: str = "ink", *, anchor: str = "start") -> None:
        """Write a text; `anchor` is "start", "middle" or "end"."""
        place = f'x="{number(x)}" y="{number(y)}" class="{look}" text-anchor="{anchor}"'
        self.parts.append(f"<text {place}>{escape(plain(text))}</text>")

    def _add(self, element: str, attributes: str, title: str) -> None:
        told = f"><title>{escape(plain(title))}</title></{element}>" if title else "/>"
        self.parts.append(f"<{element} {attributes}{told}")

    def document(self, identifier: str, title: str, text: str) -> str:
        """Give the element for the page.

        Args:
            identifier: unique on the page.
            title: what it is.
            text: what it shows, for those who cannot see it.
        """
        box = f"0 0 {number(self.width)} {number(self.height)}"
        heads = (
            f'<title id="{identifier}-t">{escape(plain(title))}</title>'
            f'<desc id="{identifier}-d">{escape(plain(text))}</desc>'
        )
        labels = f'aria-labelledby="{identifier}-t" aria-describedby="{identifier}-d"'
        return (
            f'<svg id="{identifier}" viewBox="{box}" role="img" {labels} style="--w:{number(self.width)}">'
            f"{heads}{''.join(self.parts)}</svg>"
        )


def series(number_of: int) -> str:
    """The look of the so-many-th of several things: eight colours, then again."""
    return f"s{number_of % 8 + 1}"
