"""How late a router forwards and brakes while something presses on it. `python -m benchmarks.pressure --help`."""
