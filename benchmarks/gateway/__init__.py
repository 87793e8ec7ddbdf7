"""The router's gateways beside the C++ gateway that they replace: the same topics, the same machine, in turns.

`python -m benchmarks.gateway` runs it. Nothing here looks inside the process under test.
"""
