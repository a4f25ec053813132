"""A recording executed again: replay, what if, time travel."""
