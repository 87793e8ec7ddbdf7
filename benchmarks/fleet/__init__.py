"""Many rovers and operators behind one Zenoh hub, in a network namespace: throughput, loss, latency and what fails."""
