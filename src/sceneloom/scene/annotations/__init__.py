"""What people and programs state about a scene: every annotation of the Sensor Fusion Scene format, and attributes."""
