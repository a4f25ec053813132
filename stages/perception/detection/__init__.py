"""Candidates for the objects of a catalogue in a photograph, from their meshes alone."""
