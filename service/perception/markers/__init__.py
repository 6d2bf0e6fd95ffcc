"""The marker grid: detection, matching and tracking."""
