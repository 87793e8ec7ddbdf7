"""The router shown on this machine: simulator, router and a ROS subscriber, and whether messages arrived."""
