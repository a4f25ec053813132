"""ROS 2 as its nodes speak it over Zenoh (rmw_zenoh), with no ROS installation and no bridge."""
