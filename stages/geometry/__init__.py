"""Arrays of numbers, rotations and poses, regions of a plane, the pinhole camera."""
