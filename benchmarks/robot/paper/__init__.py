"""The paper's experiments with the robot (section VI-B), redone in simulation."""
