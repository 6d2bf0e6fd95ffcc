"""What the service tells of itself: events, log lines, traces."""
