"""Pictures of what is said about a scene: in the photographs, from above, and over time."""
