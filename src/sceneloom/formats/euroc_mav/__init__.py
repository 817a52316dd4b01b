"""Folders of the EuRoC datasets of micro aerial vehicles, and of all that are laid out like them."""
