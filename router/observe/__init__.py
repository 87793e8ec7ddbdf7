"""Observing a running router: metrics, HTTP with the status page, tap, Foxglove, `/diagnostics`."""
