"""Drawings of a report: small scalable pictures whose colours follow the page, in the light and in the dark."""
