"""What accuracy costs in seconds a box: settings swept together on the same starts."""
