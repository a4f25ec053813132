"""PDDL, search, grasps and motion."""
