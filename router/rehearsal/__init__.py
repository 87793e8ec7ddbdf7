"""Programs run without network on a simulated clock: table tests, and replay against another table."""
