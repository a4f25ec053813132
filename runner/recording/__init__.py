"""A recording: the file, what is in it, where it comes from, and making it whole."""
