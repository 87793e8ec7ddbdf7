"""What a running router shows: metrics, HTTP with the status page, tap, Foxglove, `/diagnostics`."""
