"""The object catalogue: what the system knows of every object before it looks, and how it is read."""

from stages.scene.catalogue.catalogue import BUILT_IN, Catalogue
from stages.scene.catalogue.objects import ASYMMETRIC, CatalogueObject, Grasp, Mesh, Primitive, Symmetries

__all__ = ["ASYMMETRIC", "BUILT_IN", "Catalogue", "CatalogueObject", "Grasp", "Mesh", "Primitive", "Symmetries"]
