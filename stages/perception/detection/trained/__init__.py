"""The trained detector: its network, the images it learns from, training and evaluation."""
