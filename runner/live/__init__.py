"""A run that lives, as the command line sees it."""
