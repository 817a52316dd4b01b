"""nerfstudio: transforms.json with posed pictures, as programs of radiance fields take them."""

from sceneloom.formats.nerfstudio.form import FORMAT

__all__ = ["FORMAT"]
