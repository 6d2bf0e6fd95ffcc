"""The Schunk WSG-50 over TCP, in its binary and its text protocol."""
