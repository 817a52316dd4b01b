"""Which frame of a tree is the ego, and which one the world."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from sceneloom.errors import OptionError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.topics.frames import FrameTree
from sceneloom.scene.warnings import WarningKind

EGO_NAMES = ("base_link", "ego", "ego_vehicle", "base_footprint", "vehicle", "base", "body")
"""What the frame of a vehicle is called, the likeliest first. Source: REP 105 for the first."""


@dataclass(frozen=True, slots=True)
class Roles:
    """The frames that a scene is reported in.

    Attributes:
        ego: that sensors are mounted on; None where no sensor has a frame in the tree.
        world: that the ego moves in; None where nothing moves.
    """

    ego: str | None
    world: str | None


def choose_roles(
    tree: FrameTree,
    sensor_frames: Iterable[str],
    *,
    ego: str | None,
    world: str | None,
    location: str,
    ledger: Ledger,
) -> Roles:
    """Choose the frames.

    The ego is a frame of one of the usual names, below the lowest frame that moves and above most sensors; without
    such a name that frame itself. The world is the highest frame above it.

    Args:
        tree: the frames.
        sensor_frames: of all sensors.
        ego, world: frames that somebody chose, or None.
        location: for warnings.
        ledger: takes what was chosen.

    Raises:
        OptionError: a frame that was chosen is not there.
    """
    frames = tree.frames
    for role, frame in (("ego", ego), ("world", world)):
        if frame is not None and frame not in frames:
            raise OptionError(f"{role} {frame!r}; the frames are {', '.join(sorted(frames)) or 'none'}")
    own = [frame for frame in sensor_frames if frame in frames]
    chosen = ego or _ego(tree, own)
    if chosen is None:
        return Roles(None, world)
    above = tree.ancestors(chosen)[1:]
    moving = [frame for frame in (chosen, *above) if tree.moves(frame)]
    if world is None and moving:
        world = above[-1]
        others = above[above.index(tree.edges[moving[0]].parent) : -1]
        choice = f"; {', '.join(others)} could be it, too" if others else ""
        message = f"frame {chosen!r} is the ego, {world!r} the world{choice}"
        ledger.note(WarningKind.ASSUMED, "frames-chosen", location, message)
    return Roles(chosen, world)


def _ego(tree: FrameTree, sensor_frames: list[str]) -> str | None:
    """The frame that carries most sensors."""
    movers = Counter(
        next((frame for frame in tree.ancestors(frame) if tree.moves(frame)), None) for frame in sensor_frames
    )
    movers.pop(None, None)
    if not movers:
        moving = [frame for frame in tree.frames if tree.moves(frame)]
        body = moving[0] if moving and not sensor_frames else None
    else:
        body = movers.most_common(1)[0][0]
    candidates = [name for name in EGO_NAMES if name in tree.frames]
    if body is not None:
        above = tree.ancestors(body)[1:]
        near = [name for name in candidates if name in above or tree.mount(body, name) is not None]
        return near[0] if near else body
    if candidates:
        return candidates[0]
    roots = Counter(tree.ancestors(frame)[-1] for frame in sensor_frames)
    return roots.most_common(1)[0][0] if roots else None
