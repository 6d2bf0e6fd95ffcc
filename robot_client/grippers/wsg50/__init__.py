"""The Schunk WSG-50 over TCP, in its binary protocol."""
