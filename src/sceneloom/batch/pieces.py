"""A drive in pieces: what is done with it in several tasks, the last of which joins what the others made.

The verb's `call` takes part in this by the option `piece`, a mapping of JSON values:

- {"work": "plan", "seconds": …, "count": …}: it writes nothing and gives the stages of the drive, each a list of such
  mappings. A stage begins when the one before is done; no stages: the drive is done in one piece, as ever.
- one of those, with "folder" and "stages" added: it writes a file of its own, and finds in the folder what earlier
  stages made, under the names that `piece_name` gives; of each stage there are so many.
- {"work": "join", "folder": …, "stages": …}: it writes the output of the drive out of all these.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.batch.jobs import Parts
from sceneloom.errors import OptionError

PIECE = "piece"
"""The option that says which piece of a drive is meant."""

PLAN = "plan"
JOIN: Mapping[str, Any] = {"work": "join"}
SHORTEST_SECONDS = 30.0
"""Parts that are chosen by the number of workers are not shorter: what leads into each is done twice."""

Stages = Sequence[Sequence[Mapping[str, Any]]]


def piece_name(stage: int, number: int) -> str:
    """The file of a piece in the folder of its drive."""
    return f"{stage}-{number:05d}"


def plan_of(parts: Parts) -> Mapping[str, Any]:
    """What asks a verb how a drive is to be split."""
    if parts.seconds is not None and not 0.0 < parts.seconds < float("inf"):
        raise OptionError(f"parts of {parts.seconds} s; expected a positive number of seconds")
    return {"work": PLAN, "seconds": parts.seconds, "count": parts.count}


def cut_times(
    timestamps_ns: Int64Array, *, seconds: float | None = None, count: int = 1
) -> tuple[tuple[int, int], ...]:
    """Cut a drive between its frames into spans of about equal length.

    Args:
        timestamps_ns: (N,) int64 [ns], of the frames of reference, rising.
        seconds: how long a span is, about; None to go by `count`, with none shorter than `SHORTEST_SECONDS`.

    Returns:
        [start_ns, stop_ns) of each span, every frame in exactly one of them; the first reaches back and the last one on
        as far as int64 goes. A single span for a drive that is no longer than one.
    """
    lasting = float(np.ptp(timestamps_ns)) * 1e-9 if len(timestamps_ns) else 0.0
    if seconds is None:
        spans = min(count, int(lasting / SHORTEST_SECONDS))
    else:
        spans = round(min(lasting / seconds, len(timestamps_ns)))
    limits = np.iinfo(np.int64)
    if spans < 2:
        return ((int(limits.min), int(limits.max)),)
    wanted_ns = timestamps_ns[0] + (np.arange(1, spans) * (lasting * 1e9 / spans)).astype(np.int64)
    rows = np.unique(np.searchsorted(timestamps_ns, wanted_ns).clip(1, len(timestamps_ns) - 1))
    between_ns = np.unique(timestamps_ns[rows - 1] + (timestamps_ns[rows] - timestamps_ns[rows - 1] + 1) // 2)
    bounds = [int(limits.min), *between_ns.tolist(), int(limits.max)]
    return tuple(pairwise(bounds))


def stage_files(piece: Mapping[str, Any], stage: int | None = None) -> list[Path]:
    """What a stage made, in the order of its pieces, for one of a later stage or for joining; None: the last one."""
    counts = piece["stages"]
    number = len(counts) - 1 if stage is None else stage
    return [Path(piece["folder"], piece_name(number, k)) for k in range(counts[number])]


def told_part(part: Mapping[str, Any]) -> str:
    """What counts for a piece alone, as the record keeps it and tells pieces apart by."""
    return json.dumps(dict(part), sort_keys=True)


@dataclass(slots=True)
class Split:
    """How far a drive in pieces is.

    Attributes:
        stages: numbers of the pieces that are not done yet, of each stage that is left.
        counts: how many pieces each stage has; no stages for a drive no longer than a part, which is done as ever.
        failed: whether a piece failed, and the drive with it.
    """

    stages: list[set[int]]
    counts: tuple[int, ...]
    failed: bool = False

    def end(self, number: int) -> bool:
        """Take a piece as done; gives whether a stage is over with it."""
        self.stages[0].discard(number)
        return not self.stages[0]

    def begin(self) -> set[int]:
        """Pass over the stages that are done, and give what is to be done next; nothing: joining."""
        while self.stages and not self.stages[0]:
            del self.stages[0]
        return set(self.stages[0]) if self.stages else set()
