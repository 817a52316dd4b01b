"""Places in pictures that nobody is to see: found, and hidden for good."""
