"""Where objects could be put, what would be hidden there, and what hides others now."""
