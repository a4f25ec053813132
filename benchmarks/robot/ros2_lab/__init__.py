"""A simulated lab that speaks nothing but ROS 2: a UR5e with a gripper and a camera, behind topics and actions."""
