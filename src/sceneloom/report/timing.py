"""When each stream delivers: rates, jitter, gaps, missing frames, overlaps; and the section about it."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.report.content import (
    COLOURS,
    NOTHING,
    PLOT_INCHES,
    WIDE_INCHES,
    Block,
    Column,
    Drawing,
    Section,
    Table,
    count,
    draw_svg,
    fixed,
    percent,
    short,
    text_column,
)
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.summary import GAP_FACTOR, Gap
from sceneloom.scene.types import Identifier
from sceneloom.visualization.canvas import several

_MOST_GAPS = 20  # gaps of a stream that are reported one by one: the longest
_MOST_STREAMS, _MOST_PLOTS = 40, 12  # so many streams and histograms of intervals are drawn
_MOST_BINS = 40
_WIDEST_BIN = 3.0  # intervals beyond so many usual ones fall into the last bin


class IntervalBins(msgspec.Struct, frozen=True, kw_only=True):
    """How many intervals are how long.

    Attributes:
        edges_ms: (B + 1) borders [ms]; longer intervals count in the last bin.
        counts: (B).
    """

    edges_ms: tuple[float, ...]
    counts: tuple[int, ...]


class Phase(msgspec.Struct, frozen=True, kw_only=True):
    """How a stream's timestamps lie to the nearest ones of the stream that the others are paired with [ms].

    Attributes:
        reference: id of that stream's sensor.
        median_ms: later is positive.
        spread_ms: half of the width that holds 95 % of the differences.
        farthest_ms: the largest of all, without sign.
    """

    reference: Identifier
    median_ms: float
    spread_ms: float
    farthest_ms: float


class StreamTiming(msgspec.Struct, frozen=True, kw_only=True):
    """One stream of timestamps: a sensor, or one stream of an inertial unit.

    Attributes:
        sensor, type: the sensor.
        stream: name of the stream within the sensor, empty where there is one only.
        count: timestamps.
        start, stop: first and last one, seconds after the scene's first; None without any.
        rate_hz: one over the usual interval.
        period_ms: the usual interval: the median [ms].
        jitter_ms: standard deviation of the intervals that are no gaps [ms].
        longest_ms: the longest interval [ms].
        gap_count: intervals longer than 1.5 usual ones.
        gaps: the longest of them, in order of time.
        missing: how many timestamps seem to be missing in the gaps, by the usual interval.
        missing_share: of those that should be there.
        repeated, backwards: intervals of nothing, and below nothing.
        bins: how long the intervals are; None for fewer than two.
        phase: against the reference stream; None for that itself, and without one.
    """

    sensor: Identifier
    type: str
    stream: str = ""
    count: int
    start: float | None = None
    stop: float | None = None
    rate_hz: float | None = None
    period_ms: float | None = None
    jitter_ms: float | None = None
    longest_ms: float | None = None
    gap_count: int = 0
    gaps: tuple[Gap, ...] = ()
    missing: int = 0
    missing_share: float = 0.0
    repeated: int = 0
    backwards: int = 0
    bins: IntervalBins | None = None
    phase: Phase | None = None

    @property
    def name(self) -> str:
        """What the stream is called."""
        return f"{self.sensor} {self.stream}" if self.stream else str(self.sensor)


class Timing(msgspec.Struct, frozen=True, kw_only=True):
    """The streams of a drive against each other.

    Attributes:
        overlap: when all streams with more than one timestamp give something, seconds after the scene's first
            timestamp; None where there is no such time.
        overlap_share: of the time from the first timestamp to the last.
    """

    streams: tuple[StreamTiming, ...]
    overlap: Gap | None = None
    overlap_share: float = 0.0

    @classmethod
    def of(cls, scene: Scene, *, start_ns: int) -> "Timing":
        """Look at the timestamps of all streams; no frame is read.

        Args:
            start_ns: the scene's first timestamp [ns].
        """
        # what others are paired with: the first lidar that has sweeps, else the first camera
        reference: LidarSensor | CameraSensor | None = next((x for x in scene.lidars if len(x.frames)), None)
        reference = reference or next((camera for camera in scene.cameras if len(camera.images)), None)
        found = []
        for sensor in scene.sensors:
            streams: dict[str, Int64Array] = {"": frame_times(sensor)}
            if isinstance(sensor, ImuSensor):
                streams = {name: samples.timestamps_ns for name, samples in sensor.streams.items()}
            elif not len(streams[""]) and str(sensor.type) in {"points", "odometry"}:
                continue
            for stream, times_ns in streams.items():
                timing = stream_timing(sensor.id, str(sensor.type), times_ns, start_ns=start_ns, stream=stream)
                if reference is not None and sensor is not reference:
                    phase = _phase(reference.id, times_ns, frame_times(reference))
                    timing = msgspec.structs.replace(timing, phase=phase)
                found.append(timing)
        overlap, share = _overlap(found)
        return cls(streams=tuple(found), overlap=overlap, overlap_share=share)

    def section(self) -> Section:
        """How even the streams are, what is missing in them, and how they lie to one another."""
        streams = [stream for stream in self.streams if stream.count]
        # one bar states nothing that the table does not
        uneven = [s for s in streams if s.bins is not None and s.count >= 4 and sum(map(bool, s.bins.counts)) > 1]
        intervals = [_intervals(stream) for stream in uneven[:_MOST_PLOTS]]
        gaps = [(stream.name, gap) for stream in streams for gap in stream.gaps]
        unlisted = sum(max(stream.gap_count - len(stream.gaps), 0) for stream in streams)
        more = f"{unlisted:,} shorter gaps are not listed." if unlisted else ""
        return Section(
            key="timing",
            name="Timing and gaps",
            absent=None if streams else "No stream has a timestamp.",
            facts=[("All streams together", percent(self.overlap_share, 0))] if len(streams) > 1 else [],
            blocks=[
                Block(plots=self._overview()),
                Block(tables=[Table("Rates, jitter and gaps of the streams", _STREAM_COLUMNS, streams)]),
                Block(lines=[self._explanation()], faint=True),
                Block(tables=[Table(f"Gaps: {len(gaps)}", _GAP_COLUMNS, gaps, folded=len(gaps) > 5, more=more)]),
                Block(heading="Intervals" if intervals else "", plots=intervals),
            ],
        )

    def _overview(self) -> list[Drawing]:
        shown = [s for s in self.streams if s.start is not None and s.stop is not None][:_MOST_STREAMS]
        if not shown:
            return []
        gaps = sum(stream.gap_count for stream in self.streams)
        spans = "; ".join(f"{s.name} from {s.start:.2f} to {s.stop:.2f} s" for s in shown)
        caption = "Bars: from the first timestamp to the last. Red: gaps. Green behind: when all give something."
        return [
            Drawing("Streams over time", f"{several(gaps, 'gap')}. {spans}", self._draw(shown), caption, kind="wide")
        ]

    def _draw(self, shown: Sequence[StreamTiming]) -> bytes:
        """The time that each stream covers, with its gaps."""

        def draw(axes: Any) -> None:
            if self.overlap is not None and len(shown) > 1:
                axes.axvspan(self.overlap.start, self.overlap.stop, color="#17663a", alpha=0.14, linewidth=0)
            for k, stream in enumerate(shown):
                start, stop = stream.start or 0.0, stream.stop or 0.0
                axes.barh(k, max(stop - start, 1e-9), left=start, height=0.4, color=COLOURS[0])
                axes.plot([start], [k], marker="|", color=COLOURS[0])
                for gap in stream.gaps:
                    axes.barh(k, gap.stop - gap.start, left=gap.start, height=0.6, color="#c4302b")
            axes.set_yticks(range(len(shown)), [short(stream.name) for stream in shown])
            axes.set_ylim(len(shown) - 0.4, -0.6)
            axes.set_xlabel("seconds after the first timestamp")

        return draw_svg((WIDE_INCHES, 0.8 + 0.3 * len(shown)), draw)

    def _explanation(self) -> str:
        references = dict.fromkeys(stream.phase.reference for stream in self.streams if stream.phase is not None)
        text = (
            "Jitter is the standard deviation of the intervals that are no gaps; a gap is longer than 1.5 usual "
            "intervals; missing is how many would fill the gaps."
        )
        if not references:
            return text
        return (
            f"{text} Beside the reference: how much later than the nearest timestamp of "
            f"{', '.join(map(str, references))} timestamps are, the median and what holds 95 % of them; timestamps of "
            "sweeps are their starts."
        )


_STREAM_COLUMNS = (
    text_column("Stream", lambda stream: stream.name),
    Column("Rate [Hz]", lambda stream: fixed(stream.rate_hz, 2)),
    Column("Interval [ms]", lambda stream: fixed(stream.period_ms, 2)),
    Column("Jitter [ms]", lambda stream: fixed(stream.jitter_ms, 3)),
    Column("Longest [ms]", lambda stream: fixed(stream.longest_ms, 1)),
    Column("Gaps", lambda stream: count(stream.gap_count)),
    Column(
        "Missing", lambda stream: f"{stream.missing:,} ({percent(stream.missing_share)})" if stream.missing else "0"
    ),
    Column("Repeated or backwards", lambda stream: f"{stream.repeated:,} / {stream.backwards:,}"),
    Column(
        "Beside the reference [ms]",
        lambda stream: (
            NOTHING if stream.phase is None else f"{stream.phase.median_ms:+.2f} ± {stream.phase.spread_ms:.2f}"
        ),
    ),
)

_GAP_COLUMNS = (
    text_column("Stream", lambda row: row[0]),
    Column("From [s]", lambda row: fixed(row[1].start, 3)),
    Column("To [s]", lambda row: fixed(row[1].stop, 3)),
    Column("Length [s]", lambda row: fixed(row[1].stop - row[1].start, 3)),
)


def _intervals(stream: StreamTiming) -> Drawing:
    bins, period_ms = stream.bins, stream.period_ms

    def draw(axes: Any) -> None:
        if bins is not None:
            axes.stairs(bins.counts, bins.edges_ms, fill=True, color=COLOURS[0])
        axes.set(xlabel="interval [ms]", ylabel="count")
        axes.locator_params(axis="x", nbins=4)

    text = f"Most intervals are about {period_ms:.2f} ms; the longest is {stream.longest_ms:.1f} ms"
    return Drawing(f"Intervals of {stream.name}", text, draw_svg(PLOT_INCHES, draw))


def stream_timing(
    sensor: Identifier, kind: str, times_ns: Int64Array, *, start_ns: int, stream: str = ""
) -> StreamTiming:
    """Look at the timestamps (N,) [ns] of one stream, in the order in which they stand."""
    if len(times_ns) == 0:
        return StreamTiming(sensor=sensor, type=kind, stream=stream, count=0)
    known = StreamTiming(
        sensor=sensor,
        type=kind,
        stream=stream,
        count=len(times_ns),
        start=(int(times_ns.min()) - start_ns) / 1e9,
        stop=(int(times_ns.max()) - start_ns) / 1e9,
    )
    steps = np.diff(times_ns)
    rising = steps[steps > 0]
    if len(rising) == 0:
        return msgspec.structs.replace(known, repeated=int((steps == 0).sum()), backwards=int((steps < 0).sum()))
    usual = float(np.median(rising))
    even = rising[rising <= GAP_FACTOR * usual]
    missing = int((np.rint(rising[rising > GAP_FACTOR * usual] / usual) - 1).sum())
    gaps = Gap.in_stream(np.unique(times_ns), start_ns)
    longest = sorted(gaps, key=lambda gap: gap.start - gap.stop)[:_MOST_GAPS]
    return msgspec.structs.replace(
        known,
        rate_hz=1e9 / usual,
        period_ms=usual / 1e6,
        jitter_ms=float(even.std()) / 1e6,
        longest_ms=float(rising.max()) / 1e6,
        gap_count=len(gaps),
        gaps=tuple(sorted(longest, key=lambda gap: gap.start)),
        missing=missing,
        missing_share=missing / (len(times_ns) + missing),
        repeated=int((steps == 0).sum()),
        backwards=int((steps < 0).sum()),
        bins=_bins(rising, usual),
    )


def _phase(reference: Identifier, times_ns: Int64Array, reference_ns: Int64Array) -> Phase | None:
    if len(times_ns) == 0 or len(reference_ns) == 0:
        return None
    known = np.sort(reference_ns)
    after = np.clip(np.searchsorted(known, times_ns), 1, max(len(known) - 1, 1))
    pair = np.stack([known[np.minimum(after - 1, len(known) - 1)], known[np.minimum(after, len(known) - 1)]])
    away = times_ns - pair
    nearest = away[np.argmin(np.abs(away), axis=0), np.arange(len(times_ns))] / 1e6
    low, median, high = np.percentile(nearest, (2.5, 50.0, 97.5)).tolist()
    return Phase(
        reference=reference, median_ms=median, spread_ms=(high - low) / 2, farthest_ms=float(np.abs(nearest).max())
    )


def _bins(steps: Int64Array, usual: float) -> IntervalBins:
    """Bins around the intervals that there are; single long ones fall into the last."""
    values = np.minimum(steps / 1e6, _WIDEST_BIN * usual / 1e6)
    low, high = float(values.min()), float(values.max())
    least = 0.02 * usual / 1e6
    if high - low < least:
        low, high = (low + high - least) / 2, (low + high + least) / 2
    counts, edges = np.histogram(values, bins=min(_MOST_BINS, max(5, len(values) // 3)), range=(low, high))
    return IntervalBins(edges_ms=tuple(edges.tolist()), counts=tuple(counts.tolist()))


def _overlap(streams: list[StreamTiming]) -> tuple[Gap | None, float]:
    spans = [(s.start, s.stop) for s in streams if s.count > 1 and s.start is not None and s.stop is not None]
    if not spans:
        return None, 0.0
    first, last = max(start for start, _ in spans), min(stop for _, stop in spans)
    whole = max(stop for _, stop in spans) - min(start for start, _ in spans)
    if last < first or whole <= 0:
        return None, 0.0
    return Gap(start=first, stop=last), (last - first) / whole
