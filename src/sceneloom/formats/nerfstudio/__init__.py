"""nerfstudio: transforms.json with posed images, as programs of radiance fields take them."""
