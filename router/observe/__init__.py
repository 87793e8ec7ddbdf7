"""What a running router shows: metrics, status, HTTP with its pages, tap, Foxglove, /diagnostics."""
