"""Drive arms with CANopen: cyclic frames by our own codec, configuration by the canopen library."""
