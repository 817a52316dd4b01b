"""The version of the package, in one place for the build and for the files that we write."""

__version__ = "0.1.0"
