"""What people and programs say about a scene: every annotation of the Sensor Fusion Scene format, and attributes."""
