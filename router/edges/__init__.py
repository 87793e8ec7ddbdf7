"""The modules that touch the outside world: sockets, rclpy, HTTP, the clock and the log."""
