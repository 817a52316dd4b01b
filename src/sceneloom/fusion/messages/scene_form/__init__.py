"""Records of DB34/T 4101-2022 as objects of the scene model, and back."""
