"""ROS 2: the router's node, its publishers and subscriptions, discovered topics, installed types."""
