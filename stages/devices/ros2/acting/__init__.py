"""An arm behind ROS 2 controllers: heard, commanded, watched."""
