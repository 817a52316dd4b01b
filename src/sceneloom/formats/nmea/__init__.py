"""Logs of NMEA 0183: lines of a satellite receiver."""
