"""Annotations of every type, at the moments of the sweeps and pictures that they are about."""

from sceneloom.view.annotations.layers import AnnotationLayers, annotation_layers

__all__ = ["AnnotationLayers", "annotation_layers"]
