"""Ego motion: where each sensor was when, and points brought into the world by it."""
