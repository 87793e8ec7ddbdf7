"""The ways to a gateway's clients: UDP, TCP, websocket and Zenoh."""
