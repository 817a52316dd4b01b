"""From one format to another, through the scene."""
