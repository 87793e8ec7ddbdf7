"""The transports of gateways: UDP, TCP, websocket and Zenoh."""
