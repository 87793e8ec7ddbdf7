"""Type definitions: protobuf descriptors, ROS interfaces, the lock file, limits of boards."""
