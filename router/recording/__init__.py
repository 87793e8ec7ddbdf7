"""What listeners receive, in MCAP files: the mirror, the ring, the writer, the reader."""
