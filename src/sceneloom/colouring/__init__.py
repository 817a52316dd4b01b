"""colouring."""
