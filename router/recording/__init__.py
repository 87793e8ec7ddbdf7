"""Recordings of received datagrams in MCAP files: the mirror, the last minute in memory, writer and reader."""
