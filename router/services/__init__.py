"""Calls of ROS services that endpoints answer."""
