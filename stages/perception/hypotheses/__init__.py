"""Scenes of several objects: which combinations of candidates there are, what each must cost, how it is estimated."""
