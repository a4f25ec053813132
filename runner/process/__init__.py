"""One process of a graph: a stage's, or the recorder's."""
