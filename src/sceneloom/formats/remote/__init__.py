"""Files and folders behind URLs: range reads, retries, messages without secrets. fsspec is wrapped here alone."""
