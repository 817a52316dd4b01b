"""What the parts of a drive leave for the task that joins them."""
