"""Loopback emulators that speak the bytes of the ABB controller, the WSG-50 and the two cameras."""
