"""From a frame to a scene: detection, hypotheses, the particle filter, refinement, and how sure the result is."""
