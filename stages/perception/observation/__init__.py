"""From a frame to what particles are compared with: the support plane found and removed, the robot masked."""
