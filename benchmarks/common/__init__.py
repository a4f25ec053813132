"""What several commands share: images, a graph in one process, other rasterisers, errors as one line."""
