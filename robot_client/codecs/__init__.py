"""Pure encoders and decoders of the device protocols: bytes in, values out, no I/O."""
