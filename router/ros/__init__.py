"""The ROS node: publishers, subscriptions, QoS events, installed types. rclpy is imported here alone."""
