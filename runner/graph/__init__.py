"""A graph file: read, checked, and placed on hosts."""
