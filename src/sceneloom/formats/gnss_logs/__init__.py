"""Logs of satellite receivers: NMEA 0183, UBX, and positions of RTKLIB."""
