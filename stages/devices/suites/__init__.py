"""Kinds of simulated worlds; each draws a goal and a start scene from a seed."""
