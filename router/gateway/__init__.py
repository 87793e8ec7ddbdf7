"""ROS topics for clients that speak neither ROS nor protobuf, as JSON, and what they send back.

Packets, documents, conversion and bookkeeping are plain code that sockets and rclpy never enter; `edges/gateway_*` and
`ros/topics.py` carry the bytes. `service.py` brings the two together, on one thread with an event loop.
"""
