"""Drives that report neither where nor, on request, when they were: all is counted from their own beginning."""
