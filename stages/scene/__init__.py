"""The object catalogue, meshes, relations and virtual objects."""
