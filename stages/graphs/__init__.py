"""Graphs that come with the package: ``runner up tray`` finds them from any folder."""
