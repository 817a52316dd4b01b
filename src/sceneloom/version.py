"""The version of the package, in one location for the build and for the files that we write."""

__version__ = "0.1.0"
