"""Collected trials as arrays and batches, with their labels."""
