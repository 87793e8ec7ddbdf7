"""UDP: sockets, and what the kernel reports about them."""
