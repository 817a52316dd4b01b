"""Boxes that come one by one, of all sensors: handed in as whole frames."""

import time
from collections.abc import Callable

from sceneloom.fusion.bare_boxes import MOST_BOXES, BareBoxes, seq_of
from sceneloom.fusion.messages.boxes import Box2d, Box3d, Boxes2d, Boxes3d
from sceneloom.fusion.messages.records import kind_of
from sceneloom.fusion.outcome import Cause, refused
from sceneloom.fusion.received_records import ReceivedRecords, RefusedError
from sceneloom.fusion.setting import Setting

HandIn = Callable[[Boxes3d | Boxes2d, Setting], None]
"""Takes a frame that is whole, by the configuration in force when its first box came."""


class Collection:
    """Keeps boxes that came alone until their frames are whole. Changed by one thread at a time."""

    def __init__(self, received_records: ReceivedRecords, hand_in: HandIn) -> None:
        """Keep nothing yet.

        Args:
            received_records: knows whose boxes are that name no sensor, and which frames have come.
            hand_in: reported each whole frame.
        """
        self._received_records = received_records
        self._hand_in = hand_in
        self._bare: dict[tuple[type, int], BareBoxes] = {}

    def __len__(self) -> int:
        """How many boxes wait for others of their frame."""
        return sum(len(bare.boxes) for bare in self._bare.values())

    def add(self, box: Box3d | Box2d, setting: Setting) -> bool:
        """Keep a box; where it begins a frame, the one before is whole.

        Returns:
            Whether it begins a frame.

        Raises:
            RefusedError: it is not taken; the answer says why.
        """
        sensor_id = self._received_records.sender_of(box, setting)
        bare = self._bare.setdefault((type(box), sensor_id), BareBoxes(sensor_id, setting))
        begins = bare.begins(box)
        if begins:
            stream = kind_of(Boxes3d if isinstance(box, Box3d) else Boxes2d).name, sensor_id
            if self._received_records.has_come(stream, seq_of(box)):
                reason = f"a box of frame {seq_of(box)}, of which all have come; expected it before the next frame's"
                raise RefusedError(refused(Cause.DUPLICATE, reason))
            self._close(bare)
            bare.setting = setting
        elif len(bare.boxes) >= MOST_BOXES:
            reason = f"more than {MOST_BOXES} boxes of frame {seq_of(box)}"
            raise RefusedError(refused(Cause.TOO_MANY, reason))
        bare.add(box, time.monotonic())
        return begins

    def close(self, *, older_than_s: float | None = None) -> None:
        """Hand in frames: all of them, or those that nothing came for since a time of the monotonic clock [s]."""
        for bare in self._bare.values():
            if older_than_s is None or bare.latest_s <= older_than_s:
                self._close(bare)

    def oldest_s(self) -> float | None:
        """When the last box of the frame came that waits longest for another, by the monotonic clock [s].

        For any thread. None where no boxes wait.
        """
        return min((bare.latest_s for bare in tuple(self._bare.values()) if bare.boxes), default=None)

    def _close(self, bare: BareBoxes) -> None:
        whole = bare.close()
        if whole is not None:
            self._hand_in(whole, bare.setting)
