"""Calls of ROS services that endpoints answer, and of ROS services by endpoints."""
