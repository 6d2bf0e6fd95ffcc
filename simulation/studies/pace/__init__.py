"""The cost of accuracy in seconds per box: settings compared on the same starts."""
