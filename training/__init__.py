"""Training of DirectionNN and MagnitudeNN on simulated probes. torch lives here and in export only."""
