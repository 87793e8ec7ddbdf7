"""The router beside the C++ node that it replaces: the same traffic, the same machine, in turns.

`python -m benchmarks.versus` runs it; docs/design/performance.md explains it. Nothing here looks inside the process
under test, nor cares how fast it ought to be: aims are data of `scenarios.py`.
"""
