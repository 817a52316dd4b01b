"""Drives that tell neither where nor, on request, when they were: all is counted from their own beginning."""
