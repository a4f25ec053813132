"""Hand-eye calibration: where a robot's camera is, from pictures of a board and what the encoders say."""
