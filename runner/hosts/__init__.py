"""Several machines: their keys, the head, and an agent on each other host."""
