"""Zenoh: sessions, keys and who may take part."""
