"""Images in and out of videos and PNG folders: exact reading, encoding, copying without encoding."""
