"""How a format of messages names topics and frames, and what it has messages for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from sceneloom.formats.loss import Loss, Support


@dataclass(frozen=True, slots=True)
class Dialect:
    """The habits of a format.

    Attributes:
        name: of the format, for losses.
        world, ego: names of these frames.
        part: makes a part of a topic's name of an id.
        fisheye: the name of OpenCV's fisheye camera model.
        camera_model_topic: last part of topics of camera models.
        sample_topics: last part of the topic of each stream of an IMU; "" for all that have none of their own.
        videos: whether there are messages for videos.
        covariances: whether poses have covariances.
        each_camera_model: whether each image comes with a message of its camera model, as synchronisers of pairs
            expect.
        intensity: dtype of intensities.
    """

    name: str
    world: str
    ego: str
    part: Callable[[str | int], str]
    fisheye: str
    camera_model_topic: str
    sample_topics: Mapping[str, str]
    videos: bool
    covariances: bool
    each_camera_model: bool = False
    intensity: str = "u1"


class Losses:
    """Collects what a target cannot hold."""

    def __init__(self) -> None:
        """Begin with none."""
        self.all: list[Loss] = []

    def dropped(self, field: str, what: str, *, count: int = 1) -> None:
        """Something is not in the target."""
        self._add(Loss(field=field, what=what, count=count))

    def converted(self, field: str, what: str, *, count: int = 1, error: float | None = None) -> None:
        """Something is stated in another way."""
        self._add(Loss(field=field, what=what, count=count, support=Support.CONVERTED, largest_error=error))

    def approximated(self, field: str, what: str, *, count: int = 1, error: float | None = None) -> None:
        """Something is replaced by something near."""
        self._add(
            Loss(field=field, what=what, count=count, support=Support.APPROXIMATED, largest_error=error)
        )

    def _add(self, loss: Loss) -> None:
        if loss.count > 0:
            self.all.append(loss)
