"""What a file says of each object, action, event and context: in the whole, and frame by frame."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.openlabel.frame_times import FrameTimes
from sceneloom.formats.openlabel.words import ELEMENTS, GEOMETRY, KEPT_WHOLE, PLAIN


@dataclass(frozen=True, slots=True)
class Stated:
    """One element of data at one time.

    Attributes:
        time_ns: of its frame [ns]; None where it holds for the whole object.
        part: the element.
    """

    time_ns: int | None
    part: Part


@dataclass(slots=True)
class Element:
    """All that a file says of one object, action, event or context.

    Attributes:
        kind: "object", "action", "event" or "context".
        uid: its key.
        id: its key, with its kind where something else of the file has the same key.
        head: its entry in the root.
        data: what is stated for it, by the type and the name of the data.
        frames: numbers of the frames that name it.
    """

    kind: str
    uid: str
    id: str
    head: Part
    data: dict[tuple[str, str], list[Stated]] = field(default_factory=dict)
    frames: list[int] = field(default_factory=list)

    @property
    def intervals(self) -> list[tuple[int, int]]:
        """First and last frame of each interval that its entry names."""
        found = []
        for interval in self.head.items("frame_intervals"):
            ends = [interval.need(name).value for name in ("frame_start", "frame_end")]
            if not all(isinstance(end, int) and 0 <= end < 1 << 53 for end in ends) or ends[0] > ends[1]:
                raise interval.fault("frame_start and frame_end, two numbers of frames in order")
            found.append((ends[0], ends[1]))
        return found


def gather(document: Part, times: FrameTimes) -> list[Element]:
    """Gather the data of all elements, in the order of the file.

    Raises:
        DataError: an element is wrong, or a frame names one that has no entry.
    """
    found: dict[tuple[str, str], Element] = {}
    taken: set[str] = set()
    for listed, kind in ELEMENTS.items():
        for uid, head in document.each(listed):
            element = Element(kind, uid, uid if uid not in taken else f"{kind}:{uid}", head)
            taken.add(uid)
            found[kind, uid] = element
            _take(element, head.get(f"{kind}_data"), None)
    for key, frame in document.each("frames"):
        if not key.isdigit():
            continue
        for listed, kind in ELEMENTS.items():
            for uid, entry in frame.each(listed):
                if (kind, uid) not in found:
                    raise entry.fault(f"an entry openlabel.{listed}.{uid} of the {kind} that it speaks of")
                found[kind, uid].frames.append(int(key))
                if isinstance(entry.value, dict):
                    _take(found[kind, uid], entry.get(f"{kind}_data"), times.at(int(key)))
    return list(found.values())


def _take(element: Element, data: Part | None, time_ns: int | None) -> None:
    if data is None:
        return
    for kind, values in data.members().items():
        seen: dict[str, int] = {}
        for part in _parts(data, kind, values):
            name = part.members().get("name")
            name = name if isinstance(name, str) else kind
            seen[name] = seen.get(name, 0) + 1
            unique = name if seen[name] == 1 else f"{name}#{seen[name]}"
            element.data.setdefault((kind, unique), []).append(Stated(time_ns, part))


def _parts(data: Part, kind: str, values: Any) -> Iterator[Part]:
    if kind not in (*GEOMETRY, *PLAIN, *KEPT_WHOLE):
        known = ", ".join((*GEOMETRY, *PLAIN, *KEPT_WHOLE))
        raise Part(data.file, f"{data.location}.{kind}", values).fault(f"a type of data out of {known}")
    return data.items(kind)
