"""UDP: sockets, the receive thread, and what the kernel reports about both."""
