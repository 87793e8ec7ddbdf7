"""Threads, wake events, and locks with timers."""
