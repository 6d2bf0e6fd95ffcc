"""Tries that show whether a driver keeps the promises of its port, on the device itself or on an emulator of it."""
