"""Runs a graph of stages as processes: transport, recording, replay, supervision and views. Knows nothing of robots."""
