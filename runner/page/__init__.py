"""A page on a graph that runs: for the person who shows it something, and for the engineer beside them."""
