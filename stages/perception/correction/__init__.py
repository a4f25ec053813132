"""The robot's own arm as what its camera is corrected by."""
