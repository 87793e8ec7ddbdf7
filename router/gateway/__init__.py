"""ROS topics as JSON for clients that speak neither ROS nor protobuf, and what they send back."""
