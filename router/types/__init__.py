"""What exists: protobuf descriptors, ROS interfaces, the lock file, what boards can hold."""
