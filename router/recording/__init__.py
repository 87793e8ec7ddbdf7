"""What listeners receive, in MCAP files: the mirror, the last minute in memory, the writer, the reader."""
