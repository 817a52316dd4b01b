"""nerfstudio: transforms.json with posed pictures, as programs of radiance fields take them."""
