"""One drive ready to be logged, in time order, with its warnings and the layout of the viewer."""
