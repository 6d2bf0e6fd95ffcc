"""What the commands beside the service itself do."""
