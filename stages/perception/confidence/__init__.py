"""How far an estimated scene can be relied on: probabilities, what it leaves open, what is hidden and remembered."""
