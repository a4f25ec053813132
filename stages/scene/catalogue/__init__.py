"""The object catalogue: what the system knows of every object before it looks, and how it is read."""

from stages.scene.catalogue.objects import (
    BUILT_IN,
    Catalogue,
    CatalogueObject,
    Faces,
    Grasp,
    GraspKind,
    Mesh,
    Primitive,
    Symmetries,
)

__all__ = [
    "BUILT_IN",
    "Catalogue",
    "CatalogueObject",
    "Faces",
    "Grasp",
    "GraspKind",
    "Mesh",
    "Primitive",
    "Symmetries",
]
