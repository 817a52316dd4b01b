"""Images of what is stated about a scene: in the images, from above, and over time."""
