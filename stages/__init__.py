"""What the robot does: perception, scene graphs, planning and execution as message-passing stages."""
