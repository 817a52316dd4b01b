"""Detection fusion of a drive: lists of boxes in, objects out."""
