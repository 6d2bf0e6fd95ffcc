"""The hard cases of each package, and their guards."""
