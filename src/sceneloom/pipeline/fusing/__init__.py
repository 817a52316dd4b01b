"""The main job: one scene in, one fused scene out."""
