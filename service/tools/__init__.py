"""Implementations of the commands other than the service itself."""
