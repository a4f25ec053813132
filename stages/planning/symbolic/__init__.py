"""What is moved onto what, in which order: the problem, PDDL, and the search for a plan."""
