"""A configuration-driven declarative router between protobuf over UDP and ROS 2."""
