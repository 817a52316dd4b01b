"""The rules of `sceneloom validate`: each with an id, a severity, a remedy, and a fix where that is safe."""
