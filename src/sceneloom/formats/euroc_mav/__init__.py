"""Folders of the EuRoC datasets of micro aerial vehicles, and of all that are laid out like them."""

from sceneloom.formats.euroc_mav.form import FORMAT

__all__ = ["FORMAT"]
