"""The images of a report, small enough to be sent."""

from dataclasses import dataclass, field
from io import BytesIO

from sceneloom.images.canvas import PilImage

WIDTH_PX = 1100
"""Wider images are made smaller."""
MOST_BYTES = 150_000
"""Of one image; its quality is lowered until it fits."""
_QUALITIES = (82, 74, 66, 56, 46)


@dataclass(frozen=True, slots=True)
class Photo:
    """One image of a report.

    Attributes:
        section: where on the page it stands.
        title: what it is, in a few words.
        text: what it shows, for those who cannot see it.
        width, height: [px].
        jpeg: its file.
    """

    section: str
    title: str
    text: str
    width: int
    height: int
    jpeg: bytes = field(repr=False)


@dataclass(slots=True)
class Figures:
    """Collects images for the sections of a report.

    Attributes:
        most: no more are taken.
        photos: those that were.
        left_out: how many were not.
    """

    most: int
    photos: list[Photo] = field(default_factory=list)
    left_out: int = 0

    def add(self, section: str, title: str, text: str, image: PilImage) -> None:
        """Take an image, made smaller and encoded so that it fits."""
        if len(self.photos) >= self.most:
            self.left_out += 1
            return
        if image.width > WIDTH_PX:
            image = image.resize(
                (WIDTH_PX, max(1, round(image.height * WIDTH_PX / image.width))), reducing_gap=2.0
            )
        self.photos.append(Photo(section, title, text, image.width, image.height, _encoded(image)))

    def of(self, section: str) -> list[Photo]:
        """The images of a section."""
        return [photo for photo in self.photos if photo.section == section]


def _encoded(image: PilImage) -> bytes:
    content = b""
    for quality in _QUALITIES:
        file = BytesIO()
        image.save(file, "JPEG", quality=quality, optimize=True, progressive=True)
        content = file.getvalue()
        if len(content) <= MOST_BYTES:
            break
    return content
