"""The clocks of a drive: which streams are in step, by how much others are off, and the drive put right."""

import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.editing.references import ours_of, with_ours, with_warnings
from sceneloom.editing.retime import ClockCorrection, retimed_scene
from sceneloom.errors import OptionError
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.registry import check_scene_output, write_scene
from sceneloom.motion.clock.comparison import LEVER_SIGMA, REACH_NS, TOLERANCE_NS, ClockEstimate, ClockVerdict
from sceneloom.motion.clock.streams import Stream, StreamKind, compare_streams, streams_of
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Progress, key_of
from sceneloom.warnings import DataWarning, repaired

_RANKS = (StreamKind.IMU, StreamKind.TRAJECTORY, StreamKind.LIDAR, StreamKind.CAMERA, StreamKind.GNSS)
"""Which kind of stream is taken for the reference before others."""


class ClockComparison(msgspec.Struct, frozen=True, kw_only=True):
    """One stream against another.

    Attributes:
        stream, kind: name and kind of the stream.
        reference: name of the other one, whose clock counts as the right one.
        method: by what: "rotation", "trajectory", or "none".
        estimate: what came out.
    """

    stream: str
    kind: str
    reference: str
    method: str
    estimate: ClockEstimate


class AppliedCorrection(msgspec.Struct, frozen=True, kw_only=True):
    """What was taken off the times of a stream: t - offset - skew (t - offset - at).

    Attributes:
        offset_ns, skew_ppm: offset and skew against the reference.
        at_ns: where the offset holds, on the reference's clock.
        through: the stream through which it was compared with the reference; None: directly.
    """

    stream: str
    offset_ns: float
    skew_ppm: float
    at_ns: int
    through: str | None = None


class SyncReport(msgspec.Struct, frozen=True, kw_only=True):
    """The clocks of a drive.

    Attributes:
        reference: name of the stream whose clock counts as the right one; None where nothing could be compared.
        comparisons: what was compared with what, each stream with the reference first.
        tolerance_ns: largest offset that counts as in step [ns].
        off: names of the streams that surely differ from the reference by more than the tolerance.
        output: what was written, or None.
        applied: what was corrected in it.
    """

    source: str
    reference: str | None
    comparisons: tuple[ClockComparison, ...]
    tolerance_ns: int
    off: tuple[str, ...]
    output: str | None = None
    applied: tuple[AppliedCorrection, ...] = ()
    seconds: float = 0.0
    warnings: tuple[DataWarning, ...] = ()
    losses: LossReport = LossReport()

    def comparison(self, stream: str) -> ClockComparison:
        """The comparison of a stream with the reference.

        Raises:
            OptionError: there is none.
        """
        for found in self.comparisons:
            if found.stream == stream and found.reference == self.reference:
                return found
        known = ", ".join(c.stream for c in self.comparisons if c.reference == self.reference)
        raise OptionError(f"{self.source}: stream {stream!r} was not compared; there are: {known or 'none'}")


def sync(
    scene: Scene, output: str | Path | None = None, *, reference: str | None = None,
    streams: Collection[str] | None = None, reach_ns: int = REACH_NS, tolerance_ns: int = TOLERANCE_NS,
    lever_sigma: float = LEVER_SIGMA, progress: Progress | None = None, overwrite: bool = False, **writing: Any,
) -> SyncReport:  # fmt: skip
    """Compare the clocks of a drive's streams, and write the drive with those corrected that are off.

    Streams are IMUs (by their gyroscope), trajectories, lidars (by odometry), cameras (by followed corners) and
    satellite receivers. Each is compared with the reference; what cannot be, with the first trajectory besides.

    Args:
        output: a recording or a scene file to write, by its suffix; None for none.
        reference: name of the stream whose clock is right; None for the first IMU, else trajectory, lidar, ….
        streams: names of the only streams to compare; None for all.
        reach_ns: offsets up to this are looked for [ns].
        tolerance_ns: offsets up to this do no harm [ns]: in step is what is surely within, off what is surely beyond.
        lever_sigma: how far from the ego's origin a receiver's antenna may be on each axis [m].
        writing: further options of the output's format.

    Raises:
        OptionError: there is no such stream, `reach_ns` or `tolerance_ns` is not above 0, `lever_sigma` below, or there
            are options of writing without an output.
        OutputError: the output exists, or cannot be written.
    """
    begun = time.perf_counter()
    if reach_ns <= 0:
        raise OptionError(f"offsets up to {reach_ns / 1e9:g} s; expected more than 0")
    if tolerance_ns <= 0:
        raise OptionError(f"a tolerance of {tolerance_ns / 1e6:g} ms; expected more than 0")
    if not 0.0 <= lever_sigma < float("inf"):
        raise OptionError(f"an antenna {lever_sigma:g} m off; expected 0 or more")
    if output is not None:
        check_scene_output(Path(output), overwrite=overwrite)
    elif writing:
        raise OptionError(f"{', '.join(writing)}: no option of `sync` without an output")
    scene = scene.corrected()
    found = {stream.name: stream for stream in streams_of(scene)}
    chosen = _chosen(scene, found, reference, streams)
    limits = {"reach_ns": reach_ns, "tolerance_ns": tolerance_ns, "lever_sigma": lever_sigma}
    comparisons = _compared(chosen, found, progress, **limits)
    right = chosen[0].name if chosen else None
    applied = _corrections(comparisons, right)
    report = SyncReport(
        source=scene.source,
        reference=right,
        comparisons=comparisons,
        tolerance_ns=tolerance_ns,
        off=tuple(c.stream for c in comparisons if c.reference == right and c.estimate.is_off),
        warnings=scene.warnings,
    )
    if output is not None:
        corrected = corrected_scene(scene, applied, reference=right)
        losses = write_scene(corrected, output, overwrite=overwrite, **writing)
        report = msgspec.structs.replace(
            report, output=str(output), applied=applied, warnings=corrected.warnings, losses=losses
        )
    return msgspec.structs.replace(report, seconds=time.perf_counter() - begun)


def corrected_scene(scene: Scene, corrections: Collection[AppliedCorrection], *, reference: str | None = None) -> Scene:
    """Give the scene with corrections applied; each stands in a warning, all in `metadata.sceneloom.clocks`.

    Args:
        corrections: by the names that `sync` gives streams.
        reference: the stream against which they were found.

    Raises:
        OptionError: there is no such stream.
    """
    found = {stream.name: stream for stream in streams_of(scene)}
    sensors, trajectories = {}, {}
    for correction in corrections:
        stream = found.get(correction.stream)
        if stream is None:
            there = ", ".join(found) or "none"
            raise OptionError(f"{scene.source}: no stream {correction.stream!r}; there are: {there}")
        clock = ClockCorrection(correction.offset_ns, correction.skew_ppm, correction.at_ns)
        if stream.kind is StreamKind.TRAJECTORY:
            trajectories[stream.source.name] = clock
        else:
            sensors[key_of(stream.source.id)] = clock
    if not corrections:
        return scene
    changed = retimed_scene(scene, sensors=sensors, trajectories=trajectories)
    entries = [{**msgspec.to_builtins(c), "reference": reference} for c in corrections]
    reported = with_ours(changed, clocks=[*(ours_of(scene).get("clocks") or ()), *entries])
    return with_warnings(reported, [_warning(c, reference) for c in corrections])


def _chosen(
    scene: Scene, found: Mapping[str, Stream], reference: str | None, names: Collection[str] | None
) -> list[Stream]:
    """The reference, and the streams to be compared with it."""
    for name in (*([reference] if reference else ()), *(names or ())):
        if name not in found:
            raise OptionError(f"{scene.source}: no stream {name!r}; there are: {', '.join(found) or 'none'}")
    wanted = [stream for stream in found.values() if names is None or stream.name in names]
    if reference is not None:
        first = found[reference]
    elif wanted:
        first = min(found.values(), key=lambda stream: _RANKS.index(stream.kind))
    else:
        return []
    return [first, *(stream for stream in wanted if stream is not first)]


def _compared(
    chosen: list[Stream], found: Mapping[str, Stream], progress: Progress | None, **limits: Any
) -> tuple[ClockComparison, ...]:
    """Each stream with the reference; and with the first trajectory what states nothing against that."""
    if not chosen:
        return ()
    first, *others = chosen
    second = next((s for s in found.values() if s.kind is StreamKind.TRAJECTORY and s is not first), None)
    comparisons: list[ClockComparison] = []

    def compare(against: Stream, stream: Stream) -> ClockComparison:
        method, estimate = compare_streams(against, stream, progress=progress, **limits)
        comparisons.append(
            ClockComparison(
                stream=stream.name, kind=stream.kind, reference=against.name, method=method, estimate=estimate
            )
        )
        return comparisons[-1]

    later = [
        stream
        for stream in others
        if compare(first, stream).estimate.verdict is ClockVerdict.NOT_OBSERVABLE or stream.kind is StreamKind.GNSS
    ]
    if second is not None:
        for stream in later:
            if stream is not second:
                compare(second, stream)
    return tuple(comparisons)


def _corrections(comparisons: Collection[ClockComparison], reference: str | None) -> tuple[AppliedCorrection, ...]:
    """What streams that are off are off against the reference, found directly, or through the first trajectory."""
    direct = {c.stream: c for c in comparisons if c.reference == reference}
    indirect = {c.stream: c for c in comparisons if c.reference != reference}
    found = []
    for stream, comparison in direct.items():
        other, through = indirect.get(stream), None
        at_ns, parts = comparison.estimate.at_ns, [comparison.estimate]
        if other is not None and _is_better(other, direct.get(other.reference), comparison):
            through, link = other.reference, direct[other.reference].estimate
            at_ns, parts = link.at_ns, [other.estimate, link]
        # of the sum of two corrections each counts only where it is off
        parts = [part for part in parts if part.is_off]
        if parts:
            offset_ns = sum((part.offset_ns or 0.0) + _skew(part) * 1e-6 * (at_ns - part.at_ns) for part in parts)
            skew_ppm = sum(map(_skew, parts))
            found.append(
                AppliedCorrection(stream=stream, offset_ns=offset_ns, skew_ppm=skew_ppm, at_ns=at_ns, through=through)
            )
    return tuple(found)


def _is_better(other: ClockComparison, link: ClockComparison | None, direct: ClockComparison) -> bool:
    """Whether a stream is known better through another one."""
    if link is None or ClockVerdict.NOT_OBSERVABLE in {other.estimate.verdict, link.estimate.verdict}:
        return False
    if direct.estimate.verdict is ClockVerdict.NOT_OBSERVABLE:
        return True
    parts = [e.estimate.offset_sigma_ns or 0.0 for e in (other, link)]
    return bool(sum(s * s for s in parts) < (direct.estimate.offset_sigma_ns or 0.0) ** 2)


def _skew(estimate: ClockEstimate) -> float:
    """The skew that is corrected: one that is surely there."""
    sure = estimate.skew_ppm is not None and abs(estimate.skew_ppm) > 3 * (estimate.skew_sigma_ppm or 0.0)
    return float(estimate.skew_ppm or 0.0) if sure else 0.0


def _warning(correction: AppliedCorrection, reference: str | None) -> DataWarning:
    message = f"its times were moved by {-correction.offset_ns / 1e6:+.3f} ms against {reference!r}" + (
        f", its clock slowed by {correction.skew_ppm:.1f} ppm" if correction.skew_ppm else ""
    )
    return repaired("clock-corrected", correction.stream, message)
