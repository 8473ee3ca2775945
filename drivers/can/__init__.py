"""CAN: frames, links to a bus, its state and its log; nothing of CANopen."""
