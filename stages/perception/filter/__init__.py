"""One object's pose: likelihood, first guesses, the schedule and the particle filter."""
