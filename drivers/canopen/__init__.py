"""CANopen drives as an Arm: a cyclic plane of frames and clocks, and a configuration plane of the canopen library."""
