"""When the streams of the drive give something."""

from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.numbers.timing import StreamTiming, Timing
from sceneloom.report.page.content import Block, Column, Drawing, Section, Table
from sceneloom.report.page.texts import NOTHING, count, fixed, percent, several
from sceneloom.report.plots import MOST_STREAMS, draw_streams, histogram

MOST_PLOTS = 12
_COLUMNS = (
    Column("Stream", numeric=False),
    Column("Rate [Hz]"),
    Column("Interval [ms]"),
    Column("Jitter [ms]"),
    Column("Longest [ms]"),
    Column("Gaps"),
    Column("Missing"),
    Column("Repeated or backwards"),
    Column("Beside the reference [ms]"),
)


def timing_section(report: DriveReport) -> Section:
    """Report how even the streams are, what is missing in them, and how they lie to one another."""
    timing = report.timing
    streams = [stream for stream in timing.streams if stream.count]
    blocks = [
        Block(plots=_overview(timing)),
        Block(tables=[Table("Rates, jitter and gaps of the streams", _COLUMNS, [_row(s) for s in streams])]),
        Block(lines=_explained(timing), faint=True),
        Block(tables=[_gaps(streams)]),
        Block(heading="Intervals", plots=_intervals(streams)) if _intervals(streams) else Block(),
    ]
    facts = [("All streams together", percent(timing.overlap_share, 0))] if len(streams) > 1 else []
    absent = None if streams else "No stream has a timestamp."
    return Section(key="timing", name="Timing and gaps", absent=absent, facts=facts, blocks=blocks)


def _overview(timing: Timing) -> list[Drawing]:
    svg = draw_streams(timing)
    if svg is None:
        return []
    gaps = sum(stream.gap_count for stream in timing.streams)
    reported = "; ".join(
        f"{s.name} from {s.start:.2f} to {s.stop:.2f} s"
        for s in timing.streams[:MOST_STREAMS]
        if s.start is not None
    )
    caption = "Bars: from the first timestamp to the last. Red: gaps. Green behind: when all give something."
    return [Drawing("Streams over time", f"{several(gaps, 'gap')}. {reported}", svg, caption, kind="wide")]


def _row(stream: StreamTiming) -> list[str]:
    phase = stream.phase
    return [
        stream.name,
        fixed(stream.rate_hz, 2),
        fixed(stream.period_ms, 2),
        fixed(stream.jitter_ms, 3),
        fixed(stream.longest_ms, 1),
        count(stream.gap_count),
        f"{stream.missing:,} ({percent(stream.missing_share)})" if stream.missing else "0",
        f"{stream.repeated:,} / {stream.backwards:,}",
        NOTHING if phase is None else f"{phase.median_ms:+.2f} ± {phase.spread_ms:.2f}",
    ]


def _explained(timing: Timing) -> list[str]:
    references = {stream.phase.reference for stream in timing.streams if stream.phase is not None}
    reported = (
        "Jitter is the standard deviation of the intervals that are no gaps; a gap is longer than 1.5 usual intervals; "
        "missing is how many would fill the gaps."
    )
    if references:
        reported += (
            f" Beside the reference: how much later than the nearest timestamp of {', '.join(map(str, references))} "
            "timestamps are, the middle one and what holds 95 % of them; timestamps of sweeps are their starts."
        )
    return [reported]


def _gaps(streams: list[StreamTiming]) -> Table:
    rows = [
        [stream.name, fixed(gap.start, 3), fixed(gap.stop, 3), fixed(gap.stop - gap.start, 3)]
        for stream in streams
        for gap in stream.gaps
    ]
    untold = sum(max(stream.gap_count - len(stream.gaps), 0) for stream in streams)
    columns = (Column("Stream", numeric=False), Column("From [s]"), Column("To [s]"), Column("Length [s]"))
    more = f"{untold:,} shorter gaps are not listed." if untold else ""
    return Table(f"Gaps: {len(rows)}", columns, rows, folded=len(rows) > 5, more=more)


def _intervals(streams: list[StreamTiming]) -> list[Drawing]:
    found: list[Drawing] = []
    for stream in streams:
        if stream.bins is None or stream.period_ms is None or len(found) >= MOST_PLOTS or stream.count < 4:
            continue
        svg = histogram(stream.bins.edges_ms, stream.bins.counts, x_name="interval [ms]", y_name="count")
        reported = (
            f"Most intervals are about {stream.period_ms:.2f} ms; the longest is {stream.longest_ms:.1f} ms"
        )
        found.append(Drawing(f"Intervals of {stream.name}", reported, svg))
    return found
