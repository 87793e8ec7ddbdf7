"""ROS topics as JSON, in both directions, for clients without ROS and protobuf."""
