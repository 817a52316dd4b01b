"""Rules that look at the lines and files of a recording, where more is known than in the scene made of them."""
