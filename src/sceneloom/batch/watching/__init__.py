"""Watching a run: figures out of its record, a page of them, and text for Prometheus."""

from sceneloom.batch.watching.figures import RunFigures, read_figures
from sceneloom.batch.watching.metrics import MetricsFile, format_metrics
from sceneloom.batch.watching.page import write_page

__all__ = ["MetricsFile", "RunFigures", "format_metrics", "read_figures", "write_page"]
