"""From the frames of one attempt to a correction: networks, evidence, controllers."""
