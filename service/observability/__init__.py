"""Events, log lines and traces."""
