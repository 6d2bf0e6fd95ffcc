"""A gripper that always holds; nothing is connected."""
