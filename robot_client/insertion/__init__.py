"""The insertion as a pure state machine: no clock, no socket, no device."""
