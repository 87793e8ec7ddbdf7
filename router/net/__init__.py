"""UDP: sockets, the receive thread, what the kernel dropped."""
