"""Camera model, rendering, likelihood, particle filter, detection network and symmetry."""
