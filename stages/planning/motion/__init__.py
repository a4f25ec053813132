"""What the arm does: grasps and paths without collisions, in the scene as it is perceived, and their execution."""
