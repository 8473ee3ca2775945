"""Access CAN buses: frames, links, bus state and logs, independent of CANopen."""
