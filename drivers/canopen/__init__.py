"""Drive arms with CANopen: a cyclic plane of frames and clocks, and a configuration plane of the canopen library."""
