"""A run: its processes are started, watched, replaced and asked."""
