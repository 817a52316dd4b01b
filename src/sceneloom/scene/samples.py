"""Synchronised sets of a scene's frames by number, for those who train or analyse."""

from collections.abc import Callable, Iterator, Sequence
from typing import Generic, TypeVar, overload

from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.sample import Sample
from sceneloom.scene.sample_making import SampleMaker
from sceneloom.scene.sample_selection import ALL, Choice, select
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

Item = TypeVar("Item")


class Samples(Sequence[Sample]):
    """The synchronised sets of a scene, one per frame of the reference sensor.

    Nothing is read before a sample is asked for, and nothing but reference times is kept. Any sample can be had at any
    time; going forward is the quickest trajectory through videos. Samples can be pickled, and forked processes can use
    them: each process opens the scene's files for itself.
    """

    def __init__(self, maker: SampleMaker, rows: range) -> None:
        """Take what makes the samples, and which of them these are."""
        self._maker, self._rows = maker, rows

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self._maker.selection.scene

    @property
    def reference_id(self) -> Identifier:
        """The sensor whose frames are counted."""
        return self._maker.selection.reference.id

    @property
    def tolerance_ns(self) -> int:
        """How far from a sample's moment a frame may be [ns]."""
        return self._maker.selection.tolerance_ns

    @property
    def trajectory(self) -> str | None:
        """Name of the trajectory that poses come from; None where there is none, or the sensors' own poses state it."""
        return self._maker.trajectory

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> "Samples": ...
    def __getitem__(self, index: int | slice) -> "Sample | Samples":
        if isinstance(index, slice):
            return Samples(self._maker, self._rows[index])
        return self._maker.make(self._rows[index])

    def __iter__(self) -> Iterator[Sample]:
        return map(self._maker.make, self._rows)

    def map(self, function: Callable[[Sample], Item]) -> "MappedSamples[Item]":
        """Give what a function makes of each sample, made when it is asked for: what a loader's workers hand on.

        Args:
            function: such as `Sample.arrays`; one of a module, if it is to be pickled.
        """
        return MappedSamples(self, function)


class MappedSamples(Sequence[Item], Generic[Item]):
    """What a function makes of each sample; nothing is made before it is asked for, nothing kept."""

    def __init__(self, samples: Samples, function: Callable[[Sample], Item]) -> None:
        """Take the samples and the function."""
        self.samples, self._function = samples, function

    def __len__(self) -> int:
        return len(self.samples)

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> "MappedSamples[Item]": ...
    def __getitem__(self, index: int | slice) -> "Item | MappedSamples[Item]":
        if isinstance(index, slice):
            return MappedSamples(self.samples[index], self._function)
        return self._function(self.samples[index])

    def __iter__(self) -> Iterator[Item]:
        return map(self._function, self.samples)


def samples_of(
    scene: Scene,
    *,
    reference: Identifier = "lidar",
    cameras: Choice = ALL,
    depth_cameras: Choice = ALL,
    lidars: Choice | None = None,
    radars: Choice = (),
    trajectory: str | EgoMotion | None = None,
    tolerance_ns: int | None = None,
) -> Samples:
    """Give the synchronised sets of a scene; `Scene.samples` describes the arguments."""
    selection = select(
        scene,
        reference=reference,
        lidars=lidars,
        cameras=cameras,
        depth_cameras=depth_cameras,
        radars=radars,
        trajectory=trajectory,
        tolerance_ns=tolerance_ns,
    )
    maker = SampleMaker(selection)
    return Samples(maker, range(maker.count))
