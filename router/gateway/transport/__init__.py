"""One module per transport: how frames reach clients, and what clients send is read."""
