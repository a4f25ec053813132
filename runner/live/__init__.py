"""A graph that runs, as the command line sees it."""
